"""Linear regression on second moments in blocks, with a weak prior and a covariance that the blocks themselves tell.

The estimate solves (Z^T Z + rho P) theta = Z^T y + rho P theta_0, with P the prior's precision and rho the long-run
variance of the residual: its variance times by how much neighbouring samples repeat each other. What each block moves
the estimate by (its influence) gives the covariance, correlation in time and heteroscedasticity included [1]_, and that
with any other regression on the same blocks.

.. [1] H. White, "A heteroskedasticity-consistent covariance matrix estimator", Econometrica 48 (1980) 817-838.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array

__all__ = ["BlockRegression", "Blocks", "VehicleRegressions", "products", "regress_blocks", "regress_vehicles"]

ROUNDS = 3
"""rho depends on the estimate and the estimate, weakly, on rho. [1]"""
LEAST_RHO = 1e-9
"""Of the mean square of y: a regression that fits exactly. [1]"""
TOO_FEW = 4.0
"""Blocks that tell no variance: two for slope and intercept, two as its own error makes the tails heavier than normal.
"""
LEAST_VARIANCE = 1e-12
"""Of y where it is zero throughout, so that the prior stays: below a microampere, in any unit that is used."""
SINGULAR = 1e-12
"""Eigenvalue over the largest one below which a direction is not told. [1]"""


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


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Which of the blocks of N vehicles, one after the other, belong to which vehicle.

    Attributes
    ----------
    first : ndarray of int of shape (N,)
        First block of each vehicle; every vehicle has one.
    vehicle : ndarray of int of shape (B,)
        Vehicle of each block.
    """

    first: NDArray[np.int64]
    vehicle: NDArray[np.int64]

    @classmethod
    def of_lengths(cls, lengths: Sequence[int]) -> "Blocks":
        """Blocks of vehicles that have so many each."""
        counts = np.asarray(lengths, np.int64)
        return cls(first=np.cumsum(counts) - counts, vehicle=np.repeat(np.arange(len(counts)), counts))

    @property
    def count(self) -> NDArray[np.int64]:
        """Number of blocks of each vehicle, shape (N,)."""
        return np.diff(np.append(self.first, len(self.vehicle)))

    def total(self, values: Array) -> Array:
        """Sums over the blocks of each vehicle, shape (N, ...) of (B, ...); whatever stands beside it."""
        return np.asarray(np.add.reduceat(np.ascontiguousarray(values), self.first, axis=0))


@dataclass(frozen=True, kw_only=True)
class VehicleRegressions:
    """The same regression of N vehicles.

    Attributes
    ----------
    estimate : ndarray of shape (N, p)
        theta of each.
    influence : ndarray of shape (B, p)
        Of all their blocks, see :class:`BlockRegression`.
    prior_covariance : ndarray of shape (N, p, p)
        What of each covariance is due to the prior.
    blocks : Blocks
        Whose blocks these are.
    """

    estimate: Array
    influence: Array
    prior_covariance: Array
    blocks: Blocks

    @property
    def sd(self) -> Array:
        """Standard deviations, shape (N, p)."""
        return np.asarray(
            np.sqrt(self.blocks.total(self.influence**2) + np.diagonal(self.prior_covariance, axis1=1, axis2=2))
        )

    def of_vehicle(self, j: int) -> BlockRegression:
        """Return the regression of one vehicle."""
        return BlockRegression(
            estimate=self.estimate[j],
            influence=self.influence[self.blocks.vehicle == j],
            prior_covariance=self.prior_covariance[j],
        )


def regress_vehicles(
    gram: Array, right: Array, power: Array, blocks: Blocks, *, prior_mean: Array, prior_precision: Array
) -> VehicleRegressions:
    """Regress y on z in each of N vehicles.

    Parameters
    ----------
    gram : ndarray of shape (B, p, p)
        Sums of z z^T per block, of all vehicles one after the other.
    right : ndarray of shape (B, p)
        Sums of z y per block.
    power : ndarray of shape (N,)
        Mean square of y over all blocks of a vehicle: the scale below which a residual is rounding.
    blocks : Blocks
        Whose blocks these are.
    prior_mean, prior_precision : ndarray of shape (p,)
        Independent Gaussian prior; precision zero where there is none.

    Returns
    -------
    VehicleRegressions
        In the units of y over z.
    """
    count, p = blocks.count, right.shape[1]
    Z, y = blocks.total(gram), blocks.total(right)
    least = np.maximum(LEAST_RHO * power, LEAST_VARIANCE)
    rho = least
    for _ in range(ROUNDS):
        inverse = _inverses(Z + rho[:, None, None] * np.diag(prior_precision))
        estimate = products(inverse, y + rho[:, None] * prior_precision * prior_mean)
        scores = right - products(gram, estimate[blocks.vehicle])
        turned = products(inverse[blocks.vehicle], scores)
        rho = np.maximum(blocks.total(np.sum(scores * turned, axis=1)) / p, least)
    turned -= (blocks.total(turned) / count[:, None])[blocks.vehicle]
    widened = np.sqrt(np.maximum(count, TOO_FEW + 1.0) / np.maximum(count - TOO_FEW, 1.0))
    prior_part = rho[:, None, None] ** 2 * (inverse * prior_precision) @ inverse
    return VehicleRegressions(
        estimate=estimate,
        influence=turned * widened[blocks.vehicle][:, None],
        prior_covariance=prior_part,
        blocks=blocks,
    )


def products(matrices: Array, vectors: Array) -> Array:
    """Each matrix times its vector, shape (N, q) of (N, q, p) and (N, p).

    The same to the bit for any N, which neither matmul nor einsum promise: these choose their way by the whole shape.
    """
    return np.asarray(np.sum(np.ascontiguousarray(matrices) * vectors[:, None, :], axis=2))


def _inverses(matrices: Array) -> Array:
    """Pseudo-inverses of symmetric matrices of shape (N, p, p), scaled to a diagonal of one."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), np.finfo(float).tiny))
    square = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.pinv(matrices * square, rcond=SINGULAR, hermitian=True) * square)


def regress_blocks(
    gram: Array, right: Array, power: float, *, prior_mean: Array, prior_precision: Array
) -> BlockRegression:
    """Regress y on z in one vehicle; as :func:`regress_vehicles`.

    Parameters
    ----------
    gram : ndarray of shape (B, p, p)
        Sums of z z^T per block.
    right : ndarray of shape (B, p)
        Sums of z y per block.
    power : float
        Mean square of y over all blocks.
    prior_mean, prior_precision : ndarray of shape (p,)
        Independent Gaussian prior; precision zero where there is none.

    Returns
    -------
    BlockRegression
        In the units of y over z.
    """
    one = Blocks.of_lengths([len(right)])
    fits = regress_vehicles(gram, right, np.array([power]), one, prior_mean=prior_mean, prior_precision=prior_precision)
    return fits.of_vehicle(0)
