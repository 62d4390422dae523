"""Evidence of one support: Gaussian likelihood of linear rows, integrated over slabs.

With y = X theta + e, e ~ N(0, R), and the slab's density on theta, the integral is

    N(y - X theta_hat; 0, R) sqrt(det(2 pi C)) prod_i mass_i,   C = (X^T R^-1 X)^-1,

mass_i being that of N(theta_hat_i, C_ii) under the slab. That is exact where all of the likelihood lies inside the
slab; at its edges the correlation between parameters is left out. Pivots (see
:mod:`calibrator.posterior.supports`) are set to the nodes of the slab in turn.
"""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.posterior.slab import Slab
from calibrator.posterior.supports import Support

__all__ = ["BlockFit", "Noise", "integrate_constant", "integrate_relative"]

POSSIBLE_DRIFT = (-0.9, 9.0)
"""Beyond it the scale between measured and true currents vanishes or explodes. [1]"""
LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Noise:
    """Gaussian noise of the rows of N vehicles: precision (N, r, r) and log-determinant (N,) of the covariance."""

    precision: Array
    log_determinant: Array

    @classmethod
    def of(cls, covariance: Array) -> "Noise":
        """From covariances of shape (N, r, r)."""
        return cls(np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1])


@dataclass(frozen=True)
class BlockFit:
    """Result for one support, Q nodes and P parameters; S sets of rows per vehicle.

    Attributes
    ----------
    log_evidence : ndarray of shape (N, S, Q)
        Logarithm of the integral, each node with its share.
    parameters, sd : ndarray of shape (N, S, Q, P)
        Estimates and standard deviations; zero where not active.
    residual : ndarray of shape (N, S, Q, r)
        y - X theta.
    """

    log_evidence: Array
    parameters: Array
    sd: Array
    residual: Array


def integrate_relative(rows: Array, design: Array, support: Support, noise: Noise, slab: Slab) -> BlockFit:
    """Integrate over (d_h, d_1 .. d_K).

    Parameters
    ----------
    rows : ndarray of shape (N, S, r)
        Logarithmic rows, centred.
    design : ndarray of shape (r, K + 1)
        Over (eta, lambda).
    support : Support
        Which parameters are not zero.
    noise : Noise
        Of the rows.
    slab : Slab
        Of the drifts themselves, not their logarithms.

    Returns
    -------
    BlockFit
        ``parameters`` are drifts; those that no sensor has, of no weight, are cut to :data:`POSSIBLE_DRIFT`.
    """
    nodes = slab.nodes(len(support.pivots))
    log_evidence, theta, sd, residual = _fit(rows, design, support, noise, np.log1p(nodes))
    drift = np.expm1(theta)
    sd = sd * (1.0 + drift)
    fitted = list(support.fitted)
    log_evidence += np.sum(slab.log_mass(drift[..., fitted], sd[..., fitted]) + theta[..., fitted], axis=-1)
    return BlockFit(log_evidence, np.clip(drift, *POSSIBLE_DRIFT), sd, residual)


def integrate_constant(
    rows: Array, design: Array, support: Support, noise: Noise, slab: Slab, *, scale: Array
) -> BlockFit:
    """Integrate over (o_h,1 .. o_h,K-1, o_1 .. o_K).

    Parameters
    ----------
    rows : ndarray of shape (N, S, r)
        Constant rows as seen in true currents, centred; in fractions of full scale.
    design : ndarray of shape (r, 2K - 1)
        Over (o_h, omega).
    support, noise, slab
        As in :func:`integrate_relative`; the slab is of o_h and o.
    scale : ndarray of shape (N, S, 2K - 1)
        1 for o_h, 1 + d_k for omega_k.

    Returns
    -------
    BlockFit
        ``parameters`` are o_h and o.
    """
    nodes = slab.nodes(len(support.pivots))
    log_evidence, theta, sd, residual = _fit(rows, design, support, noise, nodes)
    offset, sd = theta * scale[:, :, None], sd * scale[:, :, None]
    fitted = list(support.fitted)
    log_scale = np.log(scale[:, :, None, fitted])
    log_evidence += np.sum(slab.log_mass(offset[..., fitted], sd[..., fitted]) + log_scale, axis=-1)
    return BlockFit(log_evidence, offset, sd, residual)


def _fit(
    rows: Array, design: Array, support: Support, noise: Noise, pivots: Array
) -> tuple[Array, Array, Array, Array]:
    """Generalised least squares at each node: log evidence without the slab, estimates, deviations, residuals."""
    fitted = list(support.fitted)
    N, S, r = rows.shape
    Q, P = len(pivots), design.shape[1]
    y = rows[:, :, None, :] - pivots @ design[:, list(support.pivots)].T
    theta, sd = np.zeros((N, S, Q, P)), np.zeros((N, S, Q, P))
    theta[..., list(support.pivots)] = pivots
    constant = -0.5 * (noise.log_determinant + r * LOG_2PI)
    if fitted:
        X = design[:, fitted]
        weighted = noise.precision @ X
        C = np.linalg.inv(X.T @ weighted)
        estimate = np.matmul(y, (weighted @ C)[:, None])
        theta[..., fitted] = estimate
        sd[..., fitted] = np.sqrt(np.diagonal(C, axis1=1, axis2=2))[:, None, None]
        y = y - estimate @ X.T
        constant += 0.5 * (np.linalg.slogdet(C)[1] + len(fitted) * LOG_2PI)
    misfit = np.sum(np.matmul(y, noise.precision[:, None]) * y, axis=-1)
    return constant[:, None, None] - 0.5 * misfit - np.log(Q), theta, sd, y
