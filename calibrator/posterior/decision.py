"""What to say of each vehicle: estimate, confidence, and which branches may be corrected.

Each state is spread by its standard deviations, over quasi-random points. The estimate is the state near which, within
the tolerance of "recovered", the most weight lies; that weight is the confidence. A branch is corrected if the
probability that correction makes it worse is below the harm limit. With alpha = (1 + d) / (1 + d_hat) - 1 and
beta = (o - o_hat) / (1 + d_hat), it does where

    alpha^2 E[i^2] + 2 alpha beta E[i] + beta^2  >  d^2 E[i^2] + 2 d o E[i] + o^2,

which is quadratic in d and in o: the probability is known in the one that matters more, for each value of the other.
Both sides are squares of a norm, the error's root mean square; so by the triangle inequality there is nothing to
integrate for a state whose points lie too close together to change which side is larger.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, qmc

from calibrator.compiled import in_place, inner
from calibrator.drive import Array
from calibrator.posterior.slab import NEVER
from calibrator.posterior.small_matrices import positive_quadratic
from calibrator.posterior.states import States
from calibrator.score import TOLERANCE

__all__ = ["NORMAL_STEPS", "best_estimate", "harm_probability"]

POINTS_PER_STATE = 64
"""Points by which the spread of one state is told; a power of two for the quasi-random rule."""
FARTHEST, STEPS = 6.0, 96
"""Standard deviations of the parameter that matters less up to which harm is integrated, and in how many steps."""
EQUALLY_GOOD = 0.01
"""Difference of confidence below which the more probable state is taken. [1]"""
CANDIDATES = 48
"""States that are tried as estimates, the most probable ones."""
_DEVIATIONS = np.linspace(-FARTHEST, FARTHEST, STEPS + 1)
NORMAL_STEPS = np.column_stack([_DEVIATIONS, np.exp(-0.5 * _DEVIATIONS**2) / np.exp(-0.5 * _DEVIATIONS**2).sum()])
"""Deviations of a standard normal parameter, and the share of each; shape (STEPS + 1, 2). [1]"""


def best_estimate(states: States, *, least: tuple[float, float]) -> tuple[NDArray[np.int64], Array]:
    """Find the state of each vehicle that most of the posterior is within tolerance of.

    Parameters
    ----------
    states : States
        Of N vehicles.
    least : tuple of float
        Least norms that drifts and offsets are counted with: the smallest faults of the fleet. [1]

    Returns
    -------
    state : ndarray of int of shape (N,)
        Position of the estimate among the vehicle's states.
    confidence : ndarray of shape (N,)
        Posterior probability that the estimate's drifts and offsets are both recovered: within 10 % of the true norm.
    """
    N, S = states.weight.shape
    covered = np.zeros((N, min(S, CANDIDATES)))
    _cover(*_spread_states(states), np.array(least), _normal_points(2 * states.branches), covered)
    state = np.argmax(covered >= covered.max(axis=1, keepdims=True) - EQUALLY_GOOD, axis=1)
    return state, np.minimum(covered[np.arange(N), state], 1.0)


def _spread_states(states: States) -> tuple[Array, Array, Array]:
    """Weights (N, S), and means and deviations (N, S, 2K) of drifts and offsets, as compiled code takes them."""
    K = states.branches
    mean = np.concatenate([states.drift, states.offset], axis=2)
    sd = np.concatenate([states.relative_sd[:, :, 1:], states.constant_sd[:, :, K - 1 :]], axis=2)
    return np.ascontiguousarray(states.weight), mean, sd


@cache
def _normal_points(dimensions: int) -> Array:
    """Quasi-random points of a standard normal distribution, shape (POINTS_PER_STATE, dimensions)."""
    return np.asarray(norm.ppf(qmc.Sobol(dimensions, scramble=True, rng=0).random(POINTS_PER_STATE)))


@in_place
def _cover(weight: Array, mean: Array, sd: Array, least: Array, normal: Array, covered: Array) -> None:
    """``covered`` (N, C) becomes the weight near each of the first states; 0 where it cannot be the largest."""
    for j in range(len(weight)):
        best = 0.0
        for c in range(covered.shape[1]):
            if weight[j, c] == 0.0:
                continue
            possible = 0.0
            for s in range(weight.shape[1]):
                if weight[j, s] > 0.0 and _surely_near(mean[j], sd[j], s, c, least) != 0:
                    possible += weight[j, s]
            if possible < best - EQUALLY_GOOD:
                continue
            for s in range(weight.shape[1]):
                if weight[j, s] > 0.0:
                    covered[j, c] += weight[j, s] * _share_near(mean[j], sd[j], s, c, least, normal)
            best = max(best, covered[j, c])


@inner
def _share_near(mean: Array, sd: Array, s: int, c: int, least: Array, normal: Array) -> float:
    """Share of state s that lies within tolerance of c's mean."""
    surely = _surely_near(mean, sd, s, c, least)
    if surely >= 0:
        return float(surely)
    count = 0
    for q in range(len(normal)):
        if _is_near(mean, sd, s, c, least, normal[q]):
            count += 1
    return count / len(normal)


@inner
def _surely_near(mean: Array, sd: Array, s: int, c: int, least: Array) -> int:
    """Whether all of state s lies within tolerance of c's mean: 1 if so, 0 if nothing does, -1 if points must tell."""
    K, surely = mean.shape[1] // 2, 1
    for part in range(2):
        distance, size, widest = 0.0, 0.0, 0.0
        for k in range(part * K, (part + 1) * K):
            distance += (mean[s, k] - mean[c, k]) ** 2
            size += mean[s, k] ** 2
            widest += sd[s, k] ** 2
        distance, size, widest = math.sqrt(distance), math.sqrt(size), FARTHEST * math.sqrt(widest)
        if distance - widest > TOLERANCE * max(size + widest, least[part]):
            return 0
        if distance + widest > TOLERANCE * max(size - widest, least[part]):
            surely = -1
    return surely


@inner
def _is_near(mean: Array, sd: Array, s: int, c: int, least: Array, normal: Array) -> bool:
    """Whether one point of state s lies within tolerance of c's mean."""
    K = mean.shape[1] // 2
    for part in range(2):
        distance, size = 0.0, 0.0
        for k in range(part * K, (part + 1) * K):
            value = mean[s, k] + sd[s, k] * normal[k]
            distance += (value - mean[c, k]) ** 2
            size += value**2
        if distance > (TOLERANCE * max(math.sqrt(size), least[part])) ** 2:
            return False
    return True


def harm_probability(states: States, drift: Array, offset: Array, *, mean: Array, mean_square: Array) -> Array:
    """Probability that correcting makes each branch worse.

    Parameters
    ----------
    states : States
        Of N vehicles.
    drift, offset : ndarray of shape (N, K)
        Estimates; offsets in fractions of full scale. [1]
    mean, mean_square : ndarray of shape (N, M, K)
        Moments of the true currents on M drives, in fractions of full scale and their squares. [1]

    Returns
    -------
    ndarray of shape (N, K)
        Of the drive on which it is largest, with the weight of the states that were left out; 0 where the estimate is
        zero, as nothing is changed.
    """
    harm = np.zeros(drift.shape)
    estimate, moments = np.stack([drift, offset], axis=2), np.stack([mean, mean_square], axis=3)
    _sum_harm(*_spread_states(states), estimate, moments, NORMAL_STEPS, harm)
    kept = np.cumsum(states.weight, axis=1)[:, -1]  # one after the other: states of weight zero change no digit
    dropped = np.maximum(1.0 - kept, 0.0)[:, None]
    changed = (drift != 0.0) | (offset != 0.0)
    return np.where(changed, np.minimum(harm + dropped, 1.0), 0.0)


@in_place
def _sum_harm(
    weight: Array, mean: Array, sd: Array, estimate: Array, moments: Array, steps: Array, harm: Array
) -> None:
    """``harm`` (N, K) becomes the weight of what is made worse, of the worst drive.

    ``estimate`` (N, K, 2) is drift and offset, ``moments`` (N, M, K, 2), ``steps`` (Q, 2) deviations and their shares.
    """
    for j in range(len(weight)):
        for k in range(harm.shape[1]):
            if estimate[j, k, 0] == 0.0 and estimate[j, k, 1] == 0.0:
                continue
            for m in range(moments.shape[1]):
                total = 0.0
                for s in range(weight.shape[1]):
                    if weight[j, s] > 0.0:
                        total += weight[j, s] * _harm_of(
                            mean[j, s], sd[j, s], k, estimate[j, k], moments[j, m, k], steps
                        )
                harm[j, k] = max(harm[j, k], total)


@inner
def _harm_of(mean: Array, sd: Array, k: int, estimate: Array, moments: Array, steps: Array) -> float:
    """Probability that correcting branch k makes it worse under one state."""
    K = len(mean) // 2
    d, d_sd, o, o_sd = mean[k], sd[k], mean[K + k], sd[K + k]
    surely = _surely_worse(d, o, d_sd, o_sd, estimate, moments)
    if surely >= 0:
        return float(surely)
    in_drift = d_sd * math.sqrt(moments[1]) > o_sd
    if (o_sd if in_drift else d_sd) == 0.0:
        return _worse(d, o, in_drift, d_sd, o_sd, estimate, moments)
    total = 0.0
    for step in range(len(steps)):
        z = steps[step, 0]
        d_z, o_z = (d, o + o_sd * z) if in_drift else (d + d_sd * z, o)
        total += steps[step, 1] * _worse(d_z, o_z, in_drift, d_sd, o_sd, estimate, moments)
    return total


@inner
def _surely_worse(d: float, o: float, d_sd: float, o_sd: float, estimate: Array, moments: Array) -> int:
    """Whether correction makes it worse all over a state: 1 if so, 0 if nowhere, -1 if it depends on the point."""
    unit, widest = 1.0 + estimate[0], NEVER * (d_sd * math.sqrt(moments[1]) + o_sd)
    with_it = _error_rms((d - estimate[0]) / unit, (o - estimate[1]) / unit, moments)
    without = _error_rms(d, o, moments)
    if with_it + widest / unit < without - widest:
        return 0
    if with_it - widest / unit > without + widest:
        return 1
    return -1


@inner
def _error_rms(drift: float, offset: float, moments: Array) -> float:
    """Root mean square of the error that a drift and an offset make of currents with these moments."""
    return math.sqrt(max((drift * moments[1] + 2.0 * offset * moments[0]) * drift + offset**2, 0.0))


@inner
def _worse(d: float, o: float, in_drift: bool, d_sd: float, o_sd: float, estimate: Array, moments: Array) -> float:
    """Probability that correction makes it worse if one of drift and offset is known, and the other has its spread."""
    surely = _surely_worse(d, o, d_sd if in_drift else 0.0, 0.0 if in_drift else o_sd, estimate, moments)
    if surely >= 0:
        return float(surely)
    m, s = moments[0], moments[1]
    d_hat, o_hat = estimate[0], estimate[1]
    unit = 1.0 + d_hat
    if in_drift:
        away = (o - o_hat) / unit
        square = (1.0 / unit**2 - 1.0) * s
        linear = 2.0 * (away * m / unit - d_hat * s / unit**2 - o * m)
        constant = (d_hat / unit) ** 2 * s - 2.0 * d_hat / unit * away * m + away**2 - o**2
        return positive_quadratic(square, linear, constant, d, d_sd)
    away = (d - d_hat) / unit
    square = 1.0 / unit**2 - 1.0
    linear = 2.0 * (away * m / unit - o_hat / unit**2 - d * m)
    constant = (away**2 - d**2) * s - 2.0 * away * m * o_hat / unit + (o_hat / unit) ** 2
    return positive_quadratic(square, linear, constant, o, o_sd)
