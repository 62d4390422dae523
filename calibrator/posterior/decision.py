"""What to say of each vehicle: estimate, confidence, and which branches may be corrected.

The states become weighted points (each state spread by its standard deviations). The estimate is the state near which,
within the tolerance of "recovered", the most weight lies; that weight is the confidence. A branch is corrected if the
weight of the points for which correction makes it worse is below the harm limit. What matters for that are tails, and
one branch alone, so it is told by many more points of two dimensions each.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, qmc

from calibrator.drive import Array, Mask
from calibrator.posterior.states import States
from calibrator.score import TOLERANCE, correction_error_rms

__all__ = ["Points", "best_estimates", "branch_points", "harm_probability", "spread_points"]

POINTS_PER_STATE, TAIL_POINTS = 64, 1024
"""Points by which the spread of one state is told, and its tails; powers of two for the quasi-random rule."""
LIKELY, UNLIKELY = 1e-2, 1e-7
"""Weight of a state from which on its tails matter, and below which it counts as harmful without a look. [1]"""
EQUALLY_GOOD = 0.01
"""Difference of confidence below which the more probable state is taken. [1]"""
CANDIDATES = 48
"""States that are tried as estimates, the most probable ones."""


@dataclass(frozen=True)
class Points:
    """Weighted points of the posterior of one vehicle.

    Attributes
    ----------
    weight : ndarray of shape (P,)
        Sums to 1, less what was left out.
    drift, offset : ndarray of shape (P, K)
        Of the sensors; offsets in fractions of full scale. [1]
    """

    weight: Array
    drift: Array
    offset: Array


def spread_points(states: States, vehicle: int) -> Points:
    """Points of one vehicle's posterior.

    Parameters
    ----------
    states : States
        Of the fleet.
    vehicle : int
        Which vehicle.

    Returns
    -------
    Points
        :data:`POINTS_PER_STATE` of each state.
    """
    chosen = np.arange(states.weight.shape[1])
    return _points(states, vehicle, chosen, _normal(2 * states.branches, POINTS_PER_STATE))


def branch_points(states: States, vehicle: int) -> Points:
    """Points of the posterior of each branch of one vehicle; between branches they say nothing.

    Parameters
    ----------
    states : States
        Of the fleet.
    vehicle : int
        Which vehicle.

    Returns
    -------
    Points
        :data:`TAIL_POINTS` of each likely state, :data:`POINTS_PER_STATE` of the others.
    """
    weight = states.weight[vehicle]
    lots = [
        _points(states, vehicle, np.flatnonzero(chosen), np.repeat(_normal(2, count), states.branches, axis=1))
        for chosen, count in (
            (weight >= LIKELY, TAIL_POINTS),
            ((weight < LIKELY) & (weight >= UNLIKELY), POINTS_PER_STATE),
        )
    ]
    return Points(*(np.concatenate([getattr(lot, name) for lot in lots]) for name in ("weight", "drift", "offset")))


def _normal(dimensions: int, count: int) -> Array:
    """Quasi-random points of independent standard normal distributions, shape (count, dimensions)."""
    uniform = qmc.Sobol(dimensions, scramble=True, rng=0).random(count)
    return np.asarray(norm.ppf(uniform))


def _points(states: States, vehicle: int, chosen: NDArray[np.int64], normal: Array) -> Points:
    """Chosen states of one vehicle, spread as the columns of ``normal`` say: K for drifts, K for offsets."""
    K, count = states.branches, len(normal)
    drift, offset = states.drift[vehicle, chosen], states.offset[vehicle, chosen]
    drift_sd, offset_sd = states.relative_sd[vehicle, chosen, 1:], states.constant_sd[vehicle, chosen, K - 1 :]
    return Points(
        np.repeat(states.weight[vehicle, chosen] / count, count),
        (drift[:, None] + drift_sd[:, None] * normal[:, :K]).reshape(-1, K),
        (offset[:, None] + offset_sd[:, None] * normal[:, K:]).reshape(-1, K),
    )


def best_estimates(points: Points, states: States, vehicle: int, *, least: tuple[float, float]) -> tuple[int, float]:
    """Find the state that most of the posterior is within tolerance of.

    Parameters
    ----------
    points : Points
        Of the vehicle.
    states : States
        Of the fleet.
    vehicle : int
        Which vehicle.
    least : tuple of float
        Least norms that drifts and offsets are counted with: the smallest faults of the fleet. [1]

    Returns
    -------
    state : int
        Position of the estimate among the vehicle's states.
    confidence : float
        Posterior probability that the estimate's drifts and offsets are both recovered: within 10 % of the true norm.
    """
    candidates = slice(0, CANDIDATES)
    near = _near(points.drift, states.drift[vehicle, candidates], least[0])
    near &= _near(points.offset, states.offset[vehicle, candidates], least[1])
    covered = near @ points.weight
    state = int(np.argmax(covered >= covered.max() - EQUALLY_GOOD))
    return state, float(covered[state])


def harm_probability(points: Points, drift: Array, offset: Array, *, mean: Array, mean_square: Array) -> Array:
    """Probability that correcting makes each branch worse.

    Parameters
    ----------
    points : Points
        Of the vehicle.
    drift, offset : ndarray of shape (K,)
        Estimate; offsets in fractions of full scale. [1]
    mean, mean_square : ndarray of shape (M, K)
        Moments of the true currents on M drives, in fractions of full scale and their squares. [1]

    Returns
    -------
    ndarray of shape (K,)
        Of the drive on which it is largest, points left out counted as worse; 0 where the estimate is zero, as nothing
        is changed.
    """

    def error(with_drift: Array, with_offset: Array) -> Array:
        return correction_error_rms(
            true_drift=points.drift[:, None],
            true_offset_a=points.offset[:, None],
            drift=with_drift,
            offset_a=with_offset,
            mean_a=mean,
            mean_square_a2=mean_square,
        )

    nothing = np.zeros_like(drift)
    worse = error(drift, offset) > error(nothing, nothing)
    left_out = max(1.0 - points.weight.sum(), 0.0)
    probability = np.minimum(np.einsum("p,pmk->mk", points.weight, worse).max(axis=0) + left_out, 1.0)
    changed = (drift != 0.0) | (offset != 0.0)
    return np.asarray(np.where(changed, probability, 0.0))


def _near(points: Array, candidates: Array, least: float) -> Mask:
    """Whether each candidate (C, K) is within tolerance of each point (P, K), shape (C, P)."""
    squared = np.sum(candidates**2, axis=1)[:, None] + np.sum(points**2, axis=1) - 2.0 * candidates @ points.T
    norm_of_points = np.maximum(np.linalg.norm(points, axis=1), least)
    return np.asarray(squared <= (TOLERANCE * norm_of_points) ** 2)
