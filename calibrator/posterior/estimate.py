"""The default estimator: from the evidence of a fleet to the posterior of each vehicle."""

from collections.abc import Sequence
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
from calibrator.posterior.model_spread import (
    FEWEST_TRUSTED,
    free_centres,
    initial_spreads,
    trusted_spread,
    uncarried_centres,
)
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
    vehicles = [_of_vehicle(states, j, law, moments=moments, full_scale_a=full_scale_a) for j in range(len(rows))]
    return _joined(vehicles, rows, states, law.hyperparameters, full_scale_a)


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


@dataclass(frozen=True)
class _Vehicle:
    state: int
    confidence: float
    variance: Array
    harm: Array


def _of_vehicle(states: States, j: int, law: FleetLaw, *, moments: Moments, full_scale_a: float) -> _Vehicle:
    prior = law.hyperparameters.prior
    state, confidence = best_estimate(states, j, least=(prior.relative.low, prior.constant.low))
    drift, offset = states.drift[j, state], states.offset[j, state]
    distance = np.concatenate([states.drift[j] - drift, states.offset[j] - offset], axis=1)
    sd = np.concatenate([states.relative_sd[j, :, 1:], states.constant_sd[j, :, states.branches - 1 :]], axis=1)
    variance = np.asarray(states.weight[j] @ (distance**2 + sd**2))
    mean, mean_square = _true_moments(moments, law, j, drift=drift, offset_a=offset * full_scale_a)
    mean, mean_square = mean / full_scale_a, mean_square / full_scale_a**2
    harm = harm_probability(states, j, drift, offset, mean=mean, mean_square=mean_square)
    return _Vehicle(state, confidence, variance, harm)


def _true_moments(moments: Moments, law: FleetLaw, j: int, *, drift: Array, offset_a: Array) -> tuple[Array, Array]:
    """Moments of the true currents on the vehicle's own drives and on the fleet's usual one, each of shape (2, K)."""
    mean, square = moments.mean_a[j], moments.mean_square_a2[j]
    own_mean = (mean - offset_a) / (1.0 + drift)
    own_square = np.maximum((square - 2.0 * offset_a * mean + offset_a**2) / (1.0 + drift) ** 2, own_mean**2)
    return np.stack([own_mean, law.usual_mean_a]), np.stack([own_square, law.usual_mean_square_a2])


def _joined(
    vehicles: Sequence[_Vehicle], rows: FleetRows, states: States, hyperparameters: Hyperparameters, full_scale_a: float
) -> FleetPosterior:
    K, N = states.branches, len(vehicles)
    chosen = (np.arange(N), [vehicle.state for vehicle in vehicles])
    free = states.constant[chosen][:, : K - 1] * full_scale_a
    sd = np.sqrt([vehicle.variance for vehicle in vehicles])
    faulty = (states.drift != 0.0) | (states.offset != 0.0)
    return FleetPosterior(
        faults=Faults(
            hardware_drift=states.relative[chosen][:, 0],
            hardware_offset_a=np.column_stack([free, -free.sum(axis=1)]),
            drift=states.drift[chosen],
            offset_a=states.offset[chosen] * full_scale_a,
        ),
        confidence=np.array([vehicle.confidence for vehicle in vehicles]),
        drift_sd=sd[:, :K],
        offset_sd_a=sd[:, K:] * full_scale_a,
        sensor_fault=np.einsum("ns,nsk->nk", states.weight, faulty),
        hardware_fault=np.sum(states.weight * states.hardware, axis=1),
        harm=np.stack([vehicle.harm for vehicle in vehicles]),
        identifiable=_identifiable(rows),
        hyperparameters=hyperparameters,
        states=states,
        order=tuple(range(K)),
    )


def _identifiable(rows: FleetRows) -> Mask:
    """Branches whose gain some row tells better than :data:`MOST_GAIN_SD`: slope, gain ratio, or a bench reading."""
    K = rows.branches
    sd = np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2))
    slope, ratio, reading = sd[:, :K], sd[:, K : 2 * K - 1], sd[:, 2 * K - 1 : 3 * K - 1]
    best = np.minimum(slope, reading)
    best[:, 1:] = np.minimum(best[:, 1:], ratio)
    return np.asarray(best < MOST_GAIN_SD)
