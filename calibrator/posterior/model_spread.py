"""Model spread: what vehicles without faults differ by, estimated from what the explanations of a fleet leave.

A few vehicles differ more than the others (a stuck input, an odd trip). With a small probability the spread of a
vehicle has :data:`OUTLIER_VARIANCE` times the variance; so they neither widen the spread nor pass for faulty.
"""

from dataclasses import replace

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.rows import FleetRows, constant_design, relative_design
from calibrator.posterior.fault_prior import OUTLIER_VARIANCE, FaultPrior, ModelSpread
from calibrator.posterior.spread_rows import GUESSED_OUTLIER_SHARE, guessed_spread, least_spread
from calibrator.posterior.states import States

__all__ = ["SPREAD_VEHICLES", "USED_STATES", "next_spread"]

USED_STATES = 24
"""States of each vehicle that are looked at, the most probable ones. [1]"""
SPREAD_VEHICLES = 5.0
"""Weight of the guess of the model spread, in vehicles."""
GUESSED_DISPERSION = 2.0
"""Guess of the variance of intercepts over what their blocks tell. [1]"""
OUTLIER_VEHICLES = 2.0
"""Weight of the guess of the share of vehicles that differ more, in vehicles."""


def next_spread(rows: FleetRows, states: States, prior: FaultPrior, spread: ModelSpread, free: Array) -> ModelSpread:
    """Mean and covariance of what is left of the rows once the states are taken out.

    Parameters
    ----------
    rows : FleetRows
        Evidence of N vehicles.
    states : States
        Their explanations under the present hyper-parameters.
    prior, spread : FaultPrior, ModelSpread
        The present hyper-parameters.
    free : ndarray of bool, shape (5K,)
        Rows whose centre is estimated.

    Returns
    -------
    ModelSpread
        The next one.
    """
    used = min(USED_STATES, states.weight.shape[1])
    every = states.weight[:, :used] / states.weight[:, :used].sum(axis=1, keepdims=True)
    residual = _residuals(rows, states, used, spread.mean)
    parts = []
    for wide, scale in ((False, 1.0), (True, OUTLIER_VARIANCE)):
        weight = every * (states.outlier[:, :used] == wide)
        if weight.sum() > 0.0:
            scaled = replace(spread, covariance=scale * spread.covariance)
            parts.append((weight / scale, *_left(rows, states, prior, scaled, residual)))
    told = sum(float(weight.sum()) for weight, _, _ in parts)
    centre = sum(np.einsum("ns,nsa->a", weight, left) for weight, left, _ in parts) / told
    mean = np.where(free, centre, spread.mean)
    scatter = np.zeros_like(spread.covariance)
    for weight, left, hidden in parts:
        deviation = left - mean
        scatter += np.einsum("ns,nsa,nsb->ab", weight, deviation, deviation) + np.einsum("ns,nsab->ab", weight, hidden)
    share = SPREAD_VEHICLES / (SPREAD_VEHICLES + len(rows))
    covariance = (1.0 - share) * scatter / len(rows) + share * guessed_spread(rows)
    outliers = float(np.sum(every * states.outlier[:, :used]))
    return ModelSpread(
        mean=mean,
        covariance=covariance + np.diag(least_spread(rows.branches) ** 2),
        dispersion=_next_dispersion(rows, states, prior, replace(spread, mean=mean), residual),
        outlier_share=(outliers + OUTLIER_VEHICLES * GUESSED_OUTLIER_SHARE) / (len(rows) + OUTLIER_VEHICLES),
    )


def _residuals(rows: FleetRows, states: States, used: int, mean: Array) -> Array:
    """Rows less what each state explains of them, shape (N, S, 5K); ``mean`` is the fleet's centre so far."""
    K = rows.branches
    relative, constant = states.relative[:, :used], states.constant[:, :used].copy()
    factor = 1.0 + relative[:, :, 1:]
    constant[:, :, K - 1 :] /= factor
    first = rows.relative[:, None] - np.log1p(relative) @ relative_design(K).T
    seen = rows.constant_seen(relative, first - mean[: first.shape[2]])
    return np.concatenate([first, seen - constant @ constant_design(K).T], axis=2)


def _left(
    rows: FleetRows, states: States, prior: FaultPrior, spread: ModelSpread, residual: Array
) -> tuple[Array, Array]:
    """Expected deviation of each vehicle (N, S, 5K), and its covariance (N, S, 5K, 5K)."""
    covariance = spread.covariance
    precision = np.linalg.inv(rows.dispersed(spread.dispersion)[0] + covariance)
    gain = covariance @ precision
    left = spread.mean + np.einsum("nab,nsb->nsa", gain, residual - spread.mean)
    hidden = covariance - gain @ covariance
    return left, hidden[:, None] + _hidden_by_parameters(states, residual.shape[1], prior, precision, gain)


def _next_dispersion(rows: FleetRows, states: States, prior: FaultPrior, spread: ModelSpread, residual: Array) -> Array:
    """1 and the expected square of what intercepts err more than blocks tell, over what these tell; usual vehicles."""
    K, used = rows.branches, residual.shape[1]
    b = slice(3 * K - 1, 4 * K - 1)
    weight = states.weight[:, :used] * ~states.outlier[:, :used]
    whole, added = rows.dispersed(spread.dispersion)
    precision = np.linalg.inv(whole + spread.covariance)
    gain = added @ precision[:, b]
    error = np.einsum("nab,nsb->nsa", gain, residual - spread.mean)
    hidden = (added - gain[:, :, b] @ added)[:, None] + _hidden_by_parameters(states, used, prior, precision, gain)
    stated = np.diagonal(rows.intercept_covariance(), axis1=1, axis2=2)[:, None]
    more = (error**2 + np.diagonal(hidden, axis1=2, axis2=3)) / stated
    guess = SPREAD_VEHICLES * (GUESSED_DISPERSION - 1.0)
    return np.asarray(1.0 + (np.einsum("ns,nsk->k", weight, more) + guess) / (weight.sum() + SPREAD_VEHICLES))


def _hidden_by_parameters(states: States, used: int, prior: FaultPrior, precision: Array, gain: Array) -> Array:
    """Covariance of the spread that the fitted parameters of each state hide, shape (N, S, 5K, 5K)."""
    K = states.branches
    design = np.zeros((5 * K, 3 * K))
    design[: 3 * K - 1, : K + 1] = relative_design(K)
    design[3 * K - 1 :, K + 1 :] = constant_design(K)
    active = np.concatenate([states.relative[:, :used] != 0.0, states.constant[:, :used] != 0.0], axis=2)
    slab = np.concatenate([np.full(K + 1, prior.relative.high), np.full(2 * K - 1, prior.constant.high)])
    information = np.einsum("ra,nrs,sb->nab", design, precision, design)[:, None] * (
        active[..., :, None] & active[..., None, :]
    )
    C = np.linalg.inv(information + np.eye(3 * K) / slab**2) * active[..., None, :]
    shown = (gain @ design)[:, None] * active[..., None, :]
    return np.asarray(shown @ C @ np.swapaxes(shown, 2, 3))
