"""Evidence of one support: Gaussian likelihood of linear rows, integrated over slabs.

With y = X theta + e, e ~ N(0, R), and the slab's density on theta, the integral is

    N(y - X theta_hat; 0, R) sqrt(det(2 pi C)) prod_i mass_i,   C = (X^T R^-1 X)^-1,

mass_i being that of N(theta_hat_i, C_ii) under the slab. That is exact where all of the likelihood lies inside the
slab; at its edges the correlation between parameters is left out.

Rows can leave directions open: if all relative parameters are there, a common factor can move from d_h to the drifts
unseen, and if o_h,k and o_k are there, an offset from one to the other, unless some reading tells one of them. Which
directions are open depends on the rows of the vehicle. One parameter of each, the pivot, is set to the nodes of the
slab in turn, and the others follow.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.faults import Index
from calibrator.posterior.slab import Slab
from calibrator.posterior.supports import Support

__all__ = ["BlockFit", "Noise", "integrate_constant", "integrate_relative"]

Places = NDArray[np.int64]
POSSIBLE_DRIFT = (-0.9, 9.0)
"""Beyond it the scale between measured and true currents vanishes or explodes. [1]"""
TINY = 1e-9
"""Information on a parameter that no row tells. [1]"""
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

    def take(self, index: Index) -> "Noise":
        """Return the noise of some of the vehicles."""
        return Noise(self.precision[index], self.log_determinant[index])


@dataclass(frozen=True)
class BlockFit:
    """Result for one support, Q nodes and P parameters; S sets of rows per vehicle.

    Attributes
    ----------
    log_evidence : ndarray of shape (N, S, Q)
        Logarithm of the integral, each node with its share; minus infinity where a vehicle has fewer nodes.
    parameters, sd : ndarray of shape (N, S, Q, P)
        Estimates and standard deviations; zero where not active. Pivots deviate as far as their nodes lie apart.
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

    def integrate(which: Places, pivots: list[int], fitted: list[int]) -> BlockFit:
        nodes, apart = np.log1p(slab.nodes(len(pivots))), slab.spacing(len(pivots))
        fit, sd_at_node = _fit(rows[which], design, (pivots, fitted), noise.take(which), (nodes, apart))
        drift, change = np.expm1(fit.parameters), fit.parameters[..., fitted]
        mass = slab.log_mass(drift[..., fitted], sd_at_node[..., fitted] * (1.0 + drift[..., fitted]))
        log_evidence = fit.log_evidence + np.sum(mass + change, axis=-1)
        return BlockFit(log_evidence, np.clip(drift, *POSSIBLE_DRIFT), fit.sd * (1.0 + drift), fit.residual)

    return _each(integrate, design, support, noise, slab)


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

    def integrate(which: Places, pivots: list[int], fitted: list[int]) -> BlockFit:
        nodes, apart = slab.nodes(len(pivots)), slab.spacing(len(pivots))
        fit, sd_at_node = _fit(rows[which], design, (pivots, fitted), noise.take(which), (nodes, apart))
        unit = scale[which][:, :, None]
        offset, change = fit.parameters * unit, np.log(unit[..., fitted])
        mass = slab.log_mass(offset[..., fitted], sd_at_node[..., fitted] * unit[..., fitted])
        log_evidence = fit.log_evidence + np.sum(mass + change, axis=-1)
        return BlockFit(log_evidence, offset, fit.sd * unit, fit.residual)

    return _each(integrate, design, support, noise, slab)


def _each(
    integrate: Callable[[Places, list[int], list[int]], BlockFit],
    design: Array,
    support: Support,
    noise: Noise,
    slab: Slab,
) -> BlockFit:
    """Integrate all vehicles, those with the same pivots together."""
    active = np.array(support.active, np.int64)
    X = design[:, active]
    pivots = _pivots(X.T @ noise.precision @ X, slab.spacing(1))
    patterns, which = np.unique(pivots, axis=0, return_inverse=True)
    places = [np.flatnonzero(which.ravel() == i) for i in range(len(patterns))]
    fits = [integrate(j, list(active[p]), list(active[~p])) for j, p in zip(places, patterns, strict=True)]
    return fits[0] if len(fits) == 1 else _put_together(fits, places)


def _put_together(fits: Sequence[BlockFit], places: Sequence[Places]) -> BlockFit:
    most = max(fit.log_evidence.shape[2] for fit in fits)
    N, S = sum(map(len, places)), fits[0].log_evidence.shape[1]
    log_evidence = np.full((N, S, most), -np.inf)
    others = [
        np.zeros((N, S, most, width)) for width in (fits[0].parameters.shape[3],) * 2 + fits[0].residual.shape[3:]
    ]
    for fit, which in zip(fits, places, strict=True):
        nodes = fit.log_evidence.shape[2]
        log_evidence[which, :, :nodes] = fit.log_evidence
        for whole, part in zip(others, (fit.parameters, fit.sd, fit.residual), strict=True):
            whole[which, :, :nodes] = part
    return BlockFit(log_evidence, *others)


def _pivots(information: Array, widest: float) -> Mask:
    """Which of the active parameters are pivots, shape (N, P): the first that is open, until none is.

    A direction is open where its parameters' deviations are wider than the nodes lie apart.
    """
    N, P = information.shape[:2]
    pivots = np.zeros((N, P), bool)
    for _ in range(P):
        kept = ~pivots[:, :, None] & ~pivots[:, None, :]
        C = np.linalg.inv(np.where(kept, information, 0.0) + np.eye(P) * np.where(pivots, 1.0, TINY)[:, None])
        open_ = (np.diagonal(C, axis1=1, axis2=2) > widest**2) & ~pivots
        if not open_.any():
            break
        vehicles = np.flatnonzero(open_.any(axis=1))
        pivots[vehicles, open_[vehicles].argmax(axis=1)] = True
    return pivots


def _fit(
    rows: Array, design: Array, chosen: tuple[list[int], list[int]], noise: Noise, at: tuple[Array, float]
) -> tuple[BlockFit, Array]:
    """Generalised least squares, without the slab's mass; and deviations as if the pivots were known.

    ``chosen`` are pivots and fitted parameters, ``at`` the nodes and how far they lie apart.
    """
    (pivots, fitted), (nodes, apart) = chosen, at
    N, S, r = rows.shape
    Q, P = len(nodes), design.shape[1]
    X, X_p = design[:, fitted], design[:, pivots]
    y = rows[:, :, None, :] - nodes @ X_p.T
    theta, sd, sd_at_node = (np.zeros((N, S, Q, P)) for _ in range(3))
    theta[..., pivots], sd[..., pivots] = nodes, apart / np.sqrt(12.0)
    constant = -0.5 * (noise.log_determinant + r * LOG_2PI)
    if fitted:
        weighted = noise.precision @ X
        C = np.linalg.inv(X.T @ weighted)
        estimate = np.matmul(y, (weighted @ C)[:, None])
        variance = np.diagonal(C, axis1=1, axis2=2)
        follow = C @ np.swapaxes(weighted, 1, 2) @ X_p
        theta[..., fitted] = estimate
        sd_at_node[..., fitted] = np.sqrt(variance)[:, None, None]
        sd[..., fitted] = np.sqrt(variance + apart**2 / 12.0 * np.sum(follow**2, axis=2))[:, None, None]
        y = y - estimate @ X.T
        constant += 0.5 * (np.linalg.slogdet(C)[1] + len(fitted) * LOG_2PI)
    misfit = np.sum(np.matmul(y, noise.precision[:, None]) * y, axis=-1)
    return BlockFit(constant[:, None, None] - 0.5 * misfit - np.log(Q), theta, sd, y), sd_at_node
