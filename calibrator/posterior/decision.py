"""What to say of each vehicle: estimate, confidence, and which branches may be corrected.

The states become weighted points (each state spread by its standard deviations). The estimate is the state near which,
within the tolerance of "recovered", the most weight lies; that weight is the confidence. A branch is corrected if the
probability that correction makes it worse is below the harm limit. With alpha = (1 + d) / (1 + d_hat) - 1 and
beta = (o - o_hat) / (1 + d_hat), it does where

    alpha^2 E[i^2] + 2 alpha beta E[i] + beta^2  >  d^2 E[i^2] + 2 d o E[i] + o^2,

which is quadratic in d and in o: the probability is known in the one that matters more, for each value of the other.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, qmc

from calibrator.drive import Array, Mask
from calibrator.posterior.states import States
from calibrator.score import TOLERANCE

__all__ = ["Points", "best_estimates", "harm_probability", "spread_points"]

POINTS_PER_STATE = 64
"""Points by which the spread of one state is told; a power of two for the quasi-random rule."""
FARTHEST, STEPS = 6.0, 96
"""Standard deviations of the parameter that matters less up to which harm is integrated, and in how many steps."""
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
        Sums to 1 at most.
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
    K = states.branches
    drift, offset = states.drift[vehicle], states.offset[vehicle]
    drift_sd, offset_sd = states.relative_sd[vehicle, :, 1:], states.constant_sd[vehicle, :, K - 1 :]
    normal = norm.ppf(qmc.Sobol(2 * K, scramble=True, rng=0).random(POINTS_PER_STATE))
    return Points(
        np.repeat(states.weight[vehicle] / POINTS_PER_STATE, POINTS_PER_STATE),
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
    return state, min(float(covered[state]), 1.0)


def harm_probability(
    states: States, vehicle: int, drift: Array, offset: Array, *, mean: Array, mean_square: Array
) -> Array:
    """Probability that correcting makes each branch worse.

    Parameters
    ----------
    states : States
        Of the fleet.
    vehicle : int
        Which vehicle.
    drift, offset : ndarray of shape (K,)
        Estimate; offsets in fractions of full scale. [1]
    mean, mean_square : ndarray of shape (M, K)
        Moments of the true currents on M drives, in fractions of full scale and their squares. [1]

    Returns
    -------
    ndarray of shape (K,)
        Of the drive on which it is largest, with the weight of the states that were left out; 0 where the estimate is
        zero, as nothing is changed.
    """
    K, weight = states.branches, states.weight[vehicle]
    d, d_sd = states.drift[vehicle, :, None], states.relative_sd[vehicle, :, None, 1:]
    o, o_sd = states.offset[vehicle, :, None], states.constant_sd[vehicle, :, None, K - 1 :]
    z = np.linspace(-FARTHEST, FARTHEST, STEPS + 1)
    share, z = norm.pdf(z) / norm.pdf(z).sum(), z[:, None]
    worst = np.full(K, max(1.0 - float(weight.sum()), 0.0))
    worse = []
    for m, s in zip(mean, mean_square, strict=True):
        in_offset = _positive_quadratic(*_in_offset(d + d_sd * z, drift, offset, (m, s)), o, o_sd)
        in_drift = _positive_quadratic(*_in_drift(o + o_sd * z, drift, offset, (m, s)), d, d_sd)
        worse.append(np.where(d_sd * np.sqrt(s) > o_sd, in_drift, in_offset))
    worst += np.einsum("s,q,msqk->mk", weight, share, np.stack(worse)).max(axis=0)
    changed = (drift != 0.0) | (offset != 0.0)
    return np.asarray(np.where(changed, np.minimum(worst, 1.0), 0.0))


Coefficients = tuple[Array, Array, Array]


def _in_offset(d: Array, drift: Array, offset: Array, moments: tuple[Array, Array]) -> Coefficients:
    """Mean square error with correction less that without, as a polynomial in the offset; falling powers."""
    (m, s), unit = moments, 1.0 + drift
    away = (d - drift) / unit
    linear = 2.0 * (away * m / unit - offset / unit**2 - d * m)
    constant = (away**2 - d**2) * s - 2.0 * away * m * offset / unit + (offset / unit) ** 2
    return 1.0 / unit**2 - 1.0, linear, constant


def _in_drift(o: Array, drift: Array, offset: Array, moments: tuple[Array, Array]) -> Coefficients:
    """The same as a polynomial in the drift."""
    (m, s), unit = moments, 1.0 + drift
    away = (o - offset) / unit
    linear = 2.0 * (away * m / unit - drift * s / unit**2 - o * m)
    constant = (drift / unit) ** 2 * s - 2.0 * drift / unit * away * m + away**2 - o**2
    return (1.0 / unit**2 - 1.0) * s, linear, constant


def _positive_quadratic(square: Array, linear: Array, constant: Array, mean: Array, sd: Array) -> Array:
    """Probability that square x^2 + linear x + constant is positive for x ~ N(mean, sd^2), which may be 0."""
    a, b = (square * mean + linear) * mean + constant, 2.0 * square * mean + linear
    # In t = x - mean: square t^2 + b t + a. Roots by the form that does not cancel.
    discriminant = b**2 - 4.0 * square * a
    q = -0.5 * (b + np.where(b < 0.0, -1.0, 1.0) * np.sqrt(np.maximum(discriminant, 0.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = np.where(square == 0.0, np.inf, q / square), np.where(q == 0.0, 0.0, a / q)
        lower, upper = np.minimum(first, second), np.maximum(first, second)
        below, above = norm.cdf(lower / sd), norm.sf(upper / sd)
        on_line = np.where(b > 0.0, norm.sf(second / sd), norm.cdf(second / sd))
    outside = below + above
    curved = np.where(discriminant <= 0.0, square > 0.0, np.where(square > 0.0, outside, 1.0 - outside))
    straight = np.where(b == 0.0, a > 0.0, on_line)
    return np.where(sd > 0.0, np.where(square == 0.0, straight, curved), a > 0.0)


def _near(points: Array, candidates: Array, least: float) -> Mask:
    """Whether each candidate (C, K) is within tolerance of each point (P, K), shape (C, P)."""
    squared = np.sum(candidates**2, axis=1)[:, None] + np.sum(points**2, axis=1) - 2.0 * candidates @ points.T
    norm_of_points = np.maximum(np.linalg.norm(points, axis=1), least)
    return np.asarray(squared <= (TOLERANCE * norm_of_points) ** 2)
