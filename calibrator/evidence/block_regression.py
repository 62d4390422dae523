"""Linear regression on second moments in blocks, with a weak prior and a covariance that the blocks themselves tell.

The estimate solves (Z^T Z + rho P) theta = Z^T y + rho P theta_0, with P the prior's precision and rho the long-run
variance of the residual: its variance times by how much neighbouring samples repeat each other. What each block moves
the estimate by (its influence) gives the covariance, correlation in time and heteroscedasticity included [1]_, and that
with any other regression on the same blocks.

.. [1] H. White, "A heteroskedasticity-consistent covariance matrix estimator", Econometrica 48 (1980) 817-838.
"""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array

__all__ = ["BlockRegression", "regress_blocks"]

ROUNDS = 3
"""rho depends on the estimate and the estimate, weakly, on rho. [1]"""
LEAST_RHO = 1e-9
"""Of the mean square of y: a regression that fits exactly. [1]"""
TOO_FEW = 4.0
"""Blocks that tell no variance: two for slope and intercept, two as its own error makes the tails heavier than normal.
"""
LEAST_VARIANCE = 1e-12
"""Of y where it is zero throughout, so that the prior stays: below a microampere, in any unit that is used."""


@dataclass(frozen=True, kw_only=True)
class BlockRegression:
    """Result of one regression.

    Attributes
    ----------
    estimate : ndarray of shape (p,)
        theta.
    influence : ndarray of shape (B, p)
        What each block moves the estimate by; the sum of their products is the covariance of the sampling error.
    prior_covariance : ndarray of shape (p, p)
        What of the covariance is due to the prior.
    """

    estimate: Array
    influence: Array
    prior_covariance: Array

    @property
    def sd(self) -> Array:
        """Standard deviations, shape (p,)."""
        return np.asarray(np.sqrt(np.sum(self.influence**2, axis=0) + np.diag(self.prior_covariance)))


def regress_blocks(
    gram: Array, right: Array, power: float, *, prior_mean: Array, prior_precision: Array
) -> BlockRegression:
    """Regress y on z.

    Parameters
    ----------
    gram : ndarray of shape (B, p, p)
        Sums of z z^T per block.
    right : ndarray of shape (B, p)
        Sums of z y per block.
    power : float
        Mean square of y over all blocks: the scale below which a residual is rounding.
    prior_mean, prior_precision : ndarray of shape (p,)
        Independent Gaussian prior; precision zero where there is none.

    Returns
    -------
    BlockRegression
        In the units of y over z.
    """
    count, p = right.shape
    Z, y = gram.sum(axis=0), right.sum(axis=0)
    least = max(LEAST_RHO * power, LEAST_VARIANCE)
    rho = least
    for _ in range(ROUNDS):
        A = Z + rho * np.diag(prior_precision)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(A), np.finfo(float).tiny))
        inverse = np.linalg.pinv(A * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)
        estimate = inverse @ (y + rho * prior_precision * prior_mean)
        scores = right - gram @ estimate
        rho = max(float(np.mean(np.einsum("bp,pq,bq->b", scores, inverse, scores))) * count / p, least)
    scores = scores - scores.mean(axis=0)
    influence = scores @ inverse * np.sqrt(max(count, TOO_FEW + 1.0) / max(count - TOO_FEW, 1.0))
    prior_part = rho**2 * inverse @ np.diag(prior_precision) @ inverse
    return BlockRegression(estimate=estimate, influence=influence, prior_covariance=prior_part)
