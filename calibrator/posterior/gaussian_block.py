"""Evidence of one support: Gaussian likelihood of linear rows, integrated over slabs.

With y = X theta + e, e ~ N(0, R), and the slab's density on theta, the integral is

    N(y - X theta_hat; 0, R) sqrt(det(2 pi C)) prod_i mass_i,   C = (X^T R^-1 X)^-1,

mass_i being that of N(theta_hat_i, C_ii) under the slab. That is exact where all of the likelihood lies inside the
slab; at its edges the correlation between parameters is left out.

Rows can leave directions open: if all relative parameters are there, a common factor can move from d_h to the drifts
unseen, and if o_h,k and o_k are there, an offset from one to the other, unless some reading tells one of them. Which
directions are open depends on the rows of the vehicle, where their noise is least. One parameter of each, the pivot, is
set to the nodes of the slab in turn, and the others follow.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

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
    """Gaussian noise of the rows of N vehicles, the same for all S sets of rows of a vehicle or one for each.

    Attributes
    ----------
    precision : ndarray of shape (N, 1, r, r) or (N, S, r, r)
        Inverse covariance.
    log_determinant : ndarray of shape (N, 1) or (N, S)
        Of the covariance.
    """

    precision: Array
    log_determinant: Array

    @classmethod
    def of(cls, covariance: Array) -> "Noise":
        """From covariances of shape (N, r, r) or (N, S, r, r)."""
        each = covariance if covariance.ndim == 4 else covariance[:, None]
        return cls(np.linalg.inv(each), np.linalg.slogdet(each)[1])

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
    parameters : ndarray of shape (N, S, Q, P)
        Estimates; zero where not active.
    covariance : ndarray of shape (N, S, Q, P, P)
        Of the parameters that the rows are linear in; pivots deviate as far as their nodes lie apart.
    residual : ndarray of shape (N, S, Q, r)
        y - X theta.
    information : ndarray of shape (N, S, r, r)
        What the residual says of anything else that the rows are linear in.
    """

    log_evidence: Array
    parameters: Array
    covariance: Array
    residual: Array
    information: Array


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
        ``parameters`` are drifts, ``covariance`` is of their logarithms; those that no sensor has, of no weight, are
        cut to :data:`POSSIBLE_DRIFT`.
    """

    def integrate(which: Places, pivots: list[int], fitted: list[int]) -> BlockFit:
        drifts = slab.nodes(len(pivots))
        nodes = _Nodes(pivots, fitted, np.log1p(drifts), slab.cell_sd(len(pivots)) / (1.0 + drifts))
        fit, sd_at_node = _fit(rows[which], design, noise.take(which), nodes)
        drift, change = np.expm1(fit.parameters), fit.parameters[..., fitted]
        mass = slab.log_mass(drift[..., fitted], sd_at_node * (1.0 + drift[..., fitted]))
        log_evidence = fit.log_evidence + np.sum(mass + change, axis=-1)
        return replace(fit, log_evidence=log_evidence, parameters=np.clip(drift, *POSSIBLE_DRIFT))

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
        ``parameters`` are o_h and o, ``covariance`` is of o_h and omega.
    """

    def integrate(which: Places, pivots: list[int], fitted: list[int]) -> BlockFit:
        offsets = slab.nodes(len(pivots))
        nodes = _Nodes(pivots, fitted, offsets, np.full(offsets.shape, slab.cell_sd(len(pivots))))
        fit, sd_at_node = _fit(rows[which], design, noise.take(which), nodes)
        unit = scale[which][:, :, None]
        offset, change = fit.parameters * unit, np.log(unit[..., fitted])
        mass = slab.log_mass(offset[..., fitted], sd_at_node * unit[..., fitted])
        log_evidence = fit.log_evidence + np.sum(mass + change, axis=-1)
        return replace(fit, log_evidence=log_evidence, parameters=offset)

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
    sharpest = noise.log_determinant.argmin(axis=1)
    pivots = _pivots(X.T @ noise.precision[np.arange(len(sharpest)), sharpest] @ X, slab)
    patterns, which = np.unique(pivots, axis=0, return_inverse=True)
    places = [np.flatnonzero(which.ravel() == i) for i in range(len(patterns))]
    fits = [integrate(j, list(active[p]), list(active[~p])) for j, p in zip(places, patterns, strict=True)]
    return fits[0] if len(fits) == 1 else _put_together(fits, places)


def _put_together(fits: Sequence[BlockFit], places: Sequence[Places]) -> BlockFit:
    most, N = max(fit.log_evidence.shape[2] for fit in fits), sum(map(len, places))

    def whole(name: str, empty: float) -> Array:
        parts: list[Array] = [getattr(fit, name) for fit in fits]
        shape = list(parts[0].shape)
        nodes = [slice(0, part.shape[2]) for part in parts] if name != "information" else [slice(None)] * len(parts)
        shape[0], shape[2] = N, most if name != "information" else shape[2]
        found = np.full(shape, empty)
        for part, j, q in zip(parts, places, nodes, strict=True):
            found[j, :, q] = part
        return found

    return BlockFit(**{f.name: whole(f.name, -np.inf if f.name == "log_evidence" else 0.0) for f in fields(BlockFit)})


def _pivots(information: Array, slab: Slab) -> Mask:
    """Which of the active parameters are pivots, shape (N, P): the first that is open, until none is.

    A direction is open where its parameters' deviations are wider than nodes would lie apart with one pivot more.
    """
    N, P = information.shape[:2]
    pivots = np.zeros((N, P), bool)
    for _ in range(P):
        kept = ~pivots[:, :, None] & ~pivots[:, None, :]
        C = np.linalg.inv(np.where(kept, information, 0.0) + np.eye(P) * np.where(pivots, 1.0, TINY)[:, None])
        widest = np.array([slab.spacing(count + 1) for count in range(P + 1)])[pivots.sum(axis=1)]
        open_ = (np.diagonal(C, axis1=1, axis2=2) > widest[:, None] ** 2) & ~pivots
        if not open_.any():
            break
        vehicles = np.flatnonzero(open_.any(axis=1))
        pivots[vehicles, open_[vehicles].argmax(axis=1)] = True
    return pivots


@dataclass(frozen=True)
class _Nodes:
    """Positions of pivots and fitted parameters; values (Q, p) of the pivots and how far each stands for others."""

    pivots: list[int]
    fitted: list[int]
    values: Array
    sd: Array


def _fit(rows: Array, design: Array, noise: Noise, nodes: _Nodes) -> tuple[BlockFit, Array]:
    """Generalised least squares, without the slab's mass; and the fitted ones' deviations if the pivots were known."""
    N, S, r = rows.shape
    Q, P = len(nodes.values), design.shape[1]
    X, X_p = design[:, nodes.fitted], design[:, nodes.pivots]
    y = rows[:, :, None, :] - nodes.values @ X_p.T
    weighted = noise.precision @ X
    C = np.linalg.inv(X.T @ weighted)
    estimate = np.matmul(y, weighted @ C)
    y = y - estimate @ X.T
    theta = np.zeros((N, S, Q, P))
    theta[..., nodes.pivots], theta[..., nodes.fitted] = nodes.values, estimate
    constant = 0.5 * (np.linalg.slogdet(C)[1] + (len(nodes.fitted) - r) * LOG_2PI - noise.log_determinant)
    misfit = np.sum(np.matmul(y, noise.precision) * y, axis=-1)
    moved = np.zeros((*C.shape[:2], P, len(nodes.pivots)))
    moved[:, :, nodes.pivots] = np.eye(len(nodes.pivots))
    moved[:, :, nodes.fitted] = -C @ np.swapaxes(weighted, 2, 3) @ X_p
    spread = moved[:, :, None] * nodes.sd[:, None, :]
    covariance = spread @ np.swapaxes(spread, 3, 4)
    covariance[..., np.array(nodes.fitted, np.int64)[:, None], nodes.fitted] += C[:, :, None]
    fit = BlockFit(
        log_evidence=constant[:, :, None] - 0.5 * misfit - np.log(Q),
        parameters=theta,
        covariance=covariance,
        residual=y,
        information=noise.precision - weighted @ C @ np.swapaxes(weighted, 2, 3),
    )
    return fit, np.sqrt(np.diagonal(C, axis1=2, axis2=3))[:, :, None]
