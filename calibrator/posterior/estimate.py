"""The default estimator: from the evidence of a fleet to the posterior of each vehicle."""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.evidence.rows import FleetRows
from calibrator.faults import Faults, Index
from calibrator.posterior.decision import best_estimate, harm_probability
from calibrator.posterior.fault_prior import FaultPrior
from calibrator.posterior.health import ReferenceHealth
from calibrator.posterior.hyperparameters import (
    Hyperparameters,
    draw_hyperparameters,
    estimate_hyperparameters,
)
from calibrator.posterior.spread_rows import free_centres
from calibrator.posterior.spread_starts import FEWEST_TRUSTED, initial_spreads, trusted_spread, uncarried_centres
from calibrator.posterior.states import States, enumerate_states, mean_states

__all__ = ["FleetLaw", "FleetPosterior", "Moments", "estimate_fleet", "estimate_vehicles", "learn_law"]

MOST_GAIN_SD = 0.1
"""Standard deviation from which on a gain is not told: smaller than the faults that matter. [1]"""


@dataclass(frozen=True, kw_only=True)
class Moments:
    """Mean (N, K) [A] and mean square (N, K) [A^2] of each vehicle's measured currents."""

    mean_a: Array
    mean_square_a2: Array

    def take(self, index: Index) -> "Moments":
        """Return the moments of some of the vehicles."""
        return Moments(mean_a=self.mean_a[index], mean_square_a2=self.mean_square_a2[index])


@dataclass(frozen=True, kw_only=True)
class FleetPosterior:
    """What the posterior says of N vehicles with K branches.

    Attributes
    ----------
    faults : Faults
        Estimates.
    confidence : ndarray of shape (N,)
        Probability that the estimate is recovered: drifts and offsets each within 10 % of their true norm. [1]
    drift_sd : ndarray of shape (N, K)
        Root mean square of the posterior's distance from the estimate. [1]
    offset_sd_a : ndarray of shape (N, K)
        The same for the offsets. [A]
    sensor_fault : ndarray of shape (N, K)
        Probability that each sensor is faulty. [1]
    hardware_fault : ndarray of shape (N,)
        Probability of a hardware fault. [1]
    harm : ndarray of shape (N, K)
        Probability that correcting makes the branch worse. [1]
    hyperparameters : Hyperparameters
        What was learnt of the fleet.
    identifiable : ndarray of bool of shape (N, K)
        False where a branch moved too little for its gain to be told.
    states : States
        The explanations of each vehicle, branches in the order ``order``.
    order : tuple of int
        Branches of the states: position of each in the vehicle's own order.
    health : ReferenceHealth or None
        Of the fleet reference, if it was examined.
    rows : FleetRows or None
        What it was estimated from, branches in the order ``order``; None if it was not kept.
    """

    faults: Faults
    confidence: Array
    drift_sd: Array
    offset_sd_a: Array
    sensor_fault: Array
    hardware_fault: Array
    harm: Array
    identifiable: Mask
    hyperparameters: Hyperparameters
    states: States
    order: tuple[int, ...]
    health: ReferenceHealth | None = None
    rows: FleetRows | None = None

    def __len__(self) -> int:
        return len(self.confidence)


@dataclass(frozen=True, kw_only=True)
class FleetLaw:
    """What a fleet tells of its faults and of its drives: with it, every vehicle is estimated by itself.

    Attributes
    ----------
    hyperparameters : Hyperparameters
        The most likely ones.
    drawn : tuple of Hyperparameters
        Others that explain the fleet about as well, over which a small fleet is averaged; else the best alone.
    usual_mean_a, usual_mean_square_a2 : ndarray of shape (K,)
        Of the fleet's usual drive. [A], [A^2]
    """

    hyperparameters: Hyperparameters
    drawn: tuple[Hyperparameters, ...]
    usual_mean_a: Array
    usual_mean_square_a2: Array


def estimate_fleet(
    rows: FleetRows,
    moments: Moments,
    *,
    full_scale_a: float,
    given: FaultPrior | None = None,
    trusted: Mask | None = None,
    load: float | None = None,
) -> FleetPosterior:
    """Learn the law of a fleet, and estimate the faults of each of its vehicles.

    Parameters
    ----------
    rows, moments, full_scale_a, given, trusted, load
        As for :func:`learn_law`.

    Returns
    -------
    FleetPosterior
        In the order of the rows.
    """
    law = learn_law(rows, moments, given=given, trusted=trusted, load=load)
    return estimate_vehicles(rows, moments, law, full_scale_a=full_scale_a)


def learn_law(
    rows: FleetRows,
    moments: Moments,
    *,
    given: FaultPrior | None = None,
    trusted: Mask | None = None,
    load: float | None = None,
) -> FleetLaw:
    """Learn what the vehicles of a fleet have in common.

    Parameters
    ----------
    rows : FleetRows
        Evidence of N vehicles.
    moments : Moments
        Of their measured currents.
    given : FaultPrior or None
        Prior of the faults, if it is known; None: estimated from the fleet.
    trusted : ndarray of bool of shape (N,) or None
        Vehicles that were found faultless, whose rows hold that reading; where at least :data:`FEWEST_TRUSTED` of them
        tell a row, they alone carry its centre.
    load : float or None
        Mean load that no branch measures, in fractions of full scale, if it is known; its spread is then in the
        covariance of the rows. None: estimated from the fleet. [1]

    Returns
    -------
    FleetLaw
        For these and other vehicles of the fleet.
    """
    _require_fit(rows, moments)
    starts, free, carriers = initial_spreads(rows), np.asarray(free_centres(rows.branches), bool), None
    if trusted is not None and np.count_nonzero(trusted) >= FEWEST_TRUSTED:
        starts, free, carriers = [trusted_spread(rows, trusted)], uncarried_centres(rows, trusted), rows.take(trusted)
    if load is not None:
        starts, free[4 * rows.branches - 1] = [start.with_load(load) for start in starts], False
    best = estimate_hyperparameters(rows, starts, given=given, free=free)
    mean_a = np.median(moments.mean_a, axis=0)
    return FleetLaw(
        hyperparameters=best,
        drawn=tuple(draw_hyperparameters(rows, best, given=given, carriers=carriers)),
        usual_mean_a=mean_a,
        usual_mean_square_a2=np.maximum(np.median(moments.mean_square_a2, axis=0), mean_a**2),
    )


def estimate_vehicles(rows: FleetRows, moments: Moments, law: FleetLaw, *, full_scale_a: float) -> FleetPosterior:
    """Estimate the faults of some vehicles, each by itself.

    Parameters
    ----------
    rows : FleetRows
        Evidence of N vehicles.
    moments : Moments
        Of their measured currents.
    law : FleetLaw
        Of their fleet.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    FleetPosterior
        In the order of the rows.
    """
    _require_fit(rows, moments)
    if not full_scale_a > 0.0:
        raise FleetError(f"full scale must be positive, not {full_scale_a:g} A")
    states = mean_states([enumerate_states(rows, each.prior, each.spread) for each in law.drawn])
    return _decided(states, rows, law, moments=moments, full_scale_a=full_scale_a)


def _require_fit(rows: FleetRows, moments: Moments) -> None:
    """Refuse an empty fleet, and moments of another one."""
    if not len(rows):
        raise FleetError("no vehicle to estimate the faults of")
    expected = (len(rows), rows.branches)
    if moments.mean_a.shape != expected or moments.mean_square_a2.shape != expected:
        raise FleetError(
            f"moments of shape {moments.mean_a.shape} and {moments.mean_square_a2.shape} do not fit the evidence: "
            f"expected {expected}"
        )


def _true_moments(moments: Moments, law: FleetLaw, *, drift: Array, offset_a: Array) -> tuple[Array, Array]:
    """Moments of the true currents on each vehicle's own drives and on the fleet's usual one, both (N, 2, K)."""
    mean, square = moments.mean_a, moments.mean_square_a2
    own_mean = (mean - offset_a) / (1.0 + drift)
    own_square = np.maximum((square - 2.0 * offset_a * mean + offset_a**2) / (1.0 + drift) ** 2, own_mean**2)
    usual = (law.usual_mean_a, law.usual_mean_square_a2)
    usual_mean, usual_square = (np.broadcast_to(values, mean.shape) for values in usual)
    return np.stack([own_mean, usual_mean], axis=1), np.stack([own_square, usual_square], axis=1)


def _decided(
    states: States, rows: FleetRows, law: FleetLaw, *, moments: Moments, full_scale_a: float
) -> FleetPosterior:
    """Estimate of each vehicle, and what the posterior says of it."""
    K, prior = states.branches, law.hyperparameters.prior
    state, confidence = best_estimate(states, least=(prior.relative.low, prior.constant.low))
    chosen = (np.arange(len(states)), state)
    drift, offset = states.drift[chosen], states.offset[chosen]
    mean_a, square_a2 = _true_moments(moments, law, drift=drift, offset_a=offset * full_scale_a)
    mean, square = mean_a / full_scale_a, square_a2 / full_scale_a**2
    free = states.constant[chosen][:, : K - 1] * full_scale_a
    faulty = (states.drift != 0.0) | (states.offset != 0.0)
    return FleetPosterior(
        faults=Faults(
            hardware_drift=states.relative[chosen][:, 0],
            hardware_offset_a=np.column_stack([free, -free.sum(axis=1)]),
            drift=drift,
            offset_a=offset * full_scale_a,
        ),
        confidence=confidence,
        drift_sd=_distance_rms(states.weight, states.drift, states.relative_sd[:, :, 1:], drift),
        offset_sd_a=_distance_rms(states.weight, states.offset, states.constant_sd[:, :, K - 1 :], offset)
        * full_scale_a,
        sensor_fault=_expected(states.weight, faulty),
        hardware_fault=_expected(states.weight, states.hardware[:, :, None])[:, 0],
        harm=harm_probability(states, drift, offset, mean=mean, mean_square=square),
        identifiable=_identifiable(rows),
        hyperparameters=law.hyperparameters,
        states=states,
        order=tuple(range(K)),
    )


def _distance_rms(weight: Array, mean: Array, sd: Array, estimate: Array) -> Array:
    """Root mean square of the posterior's distance from the estimate (N, K)."""
    return np.asarray(np.sqrt(_expected(weight, (mean - estimate[:, None]) ** 2 + sd**2)))


def _expected(weight: Array, values: Array | Mask) -> Array:
    """Mean over the states, shape (N, K) of (N, S) and (N, S, K).

    One state after the other: those with which others of the fleet are filled up, of weight zero, change no digit.
    """
    return np.asarray(np.cumsum(weight[:, :, None] * values, axis=1)[:, -1])


def _identifiable(rows: FleetRows) -> Mask:
    """Branches whose gain some row tells better than :data:`MOST_GAIN_SD`: slope, gain ratio, or a bench reading."""
    K = rows.branches
    sd = np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2))
    slope, ratio, reading = sd[:, :K], sd[:, K : 2 * K - 1], sd[:, 2 * K - 1 : 3 * K - 1]
    best = np.minimum(slope, reading)
    best[:, 1:] = np.minimum(best[:, 1:], ratio)
    return np.asarray(best < MOST_GAIN_SD)
