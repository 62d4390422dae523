"""What to say of each vehicle: estimate, confidence, and which branches may be corrected.

Each state is spread by its standard deviations, over quasi-random points. The estimate is the state near which, within
the tolerance of "recovered", the most weight lies; that weight is the confidence. A branch is corrected if the
probability that correction makes it worse is below the harm limit. With alpha = (1 + d) / (1 + d_hat) - 1 and
beta = (o - o_hat) / (1 + d_hat), it does where

    alpha^2 E[i^2] + 2 alpha beta E[i] + beta^2  >  d^2 E[i^2] + 2 d o E[i] + o^2,

which is quadratic in d and in o: the probability is known in the one that matters more, for each value of the other.
"""

import math
from functools import cache

import numpy as np
from scipy.stats import norm, qmc

from calibrator.compiled import compiled, inlined, inner
from calibrator.drive import Array
from calibrator.posterior.small_matrices import normal_mass
from calibrator.posterior.states import States
from calibrator.score import TOLERANCE

__all__ = ["best_estimate", "harm_probability"]

POINTS_PER_STATE = 64
"""Points by which the spread of one state is told; a power of two for the quasi-random rule."""
FARTHEST, STEPS = 6.0, 96
"""Standard deviations of the parameter that matters less up to which harm is integrated, and in how many steps."""
EQUALLY_GOOD = 0.01
"""Difference of confidence below which the more probable state is taken. [1]"""
CANDIDATES = 48
"""States that are tried as estimates, the most probable ones."""
_STEP = 2.0 * FARTHEST / STEPS


def best_estimate(states: States, vehicle: int, *, least: tuple[float, float]) -> tuple[int, float]:
    """Find the state that most of the posterior is within tolerance of.

    Parameters
    ----------
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
    K, j = states.branches, vehicle
    covered = _covered(
        states.weight[j],
        np.stack([states.drift[j], states.relative_sd[j, :, 1:]]),
        np.stack([states.offset[j], states.constant_sd[j, :, K - 1 :]]),
        np.array(least),
        _normal_points(2 * K),
    )
    state = int(np.argmax(covered >= covered.max() - EQUALLY_GOOD))
    return state, min(float(covered[state]), 1.0)


@cache
def _normal_points(dimensions: int) -> Array:
    """Quasi-random points of a standard normal distribution, shape (POINTS_PER_STATE, dimensions)."""
    return np.asarray(norm.ppf(qmc.Sobol(dimensions, scramble=True, rng=0).random(POINTS_PER_STATE)))


@compiled
def _covered(weight: Array, drift: Array, offset: Array, least: Array, normal: Array) -> Array:
    """Weight near each of the first states, (C,); ``drift`` and ``offset`` (2, S, K) are means and deviations."""
    S, K = drift.shape[1:]
    covered = np.zeros(min(S, CANDIDATES))
    for s in range(S):
        if weight[s] == 0.0:
            continue
        for c in range(len(covered)):
            near_drift = _surely_near(drift, s, c, least[0])
            near_offset = _surely_near(offset, s, c, least[1])
            if near_drift == 0 or near_offset == 0:
                continue
            count = 0
            for point in normal:
                is_near = near_drift == 1 or _is_near(drift, s, c, least[0], point[:K])
                if is_near and (near_offset == 1 or _is_near(offset, s, c, least[1], point[K:])):
                    count += 1
            covered[c] += weight[s] * count / len(normal)
    return covered


@inlined
def _surely_near(values: Array, s: int, c: int, least: float) -> int:
    """Whether all of state s lies within tolerance of c's mean: 1 if so, 0 if nothing does, -1 if points must tell."""
    distance, size, widest = 0.0, 0.0, 0.0
    for k in range(values.shape[2]):
        distance += (values[0, s, k] - values[0, c, k]) ** 2
        size += values[0, s, k] ** 2
        widest += values[1, s, k] ** 2
    distance, size, widest = math.sqrt(distance), math.sqrt(size), FARTHEST * math.sqrt(widest)
    if distance + widest <= TOLERANCE * max(size - widest, least):
        return 1
    if distance - widest > TOLERANCE * max(size + widest, least):
        return 0
    return -1


@inlined
def _is_near(values: Array, s: int, c: int, least: float, normal: Array) -> bool:
    """Whether one point of state s lies within tolerance of c's mean."""
    distance, size = 0.0, 0.0
    for k in range(values.shape[2]):
        value = values[0, s, k] + values[1, s, k] * normal[k]
        distance += (value - values[0, c, k]) ** 2
        size += value**2
    return distance <= (TOLERANCE * max(math.sqrt(size), least)) ** 2


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
    K, j = states.branches, vehicle
    return _harm(
        states.weight[j],
        np.stack([states.drift[j], states.relative_sd[j, :, 1:]]),
        np.stack([states.offset[j], states.constant_sd[j, :, K - 1 :]]),
        np.stack([drift, offset]),
        np.stack([mean, mean_square]),
    )


@compiled
def _harm(weight: Array, drift: Array, offset: Array, estimate: Array, moments: Array) -> Array:
    """As above; ``drift`` and ``offset`` (2, S, K) are means and deviations, ``moments`` (2, M, K)."""
    S, K = drift.shape[1:]
    total = 0.0
    for step in range(STEPS + 1):
        total += math.exp(-0.5 * (step * _STEP - FARTHEST) ** 2)
    harm = np.zeros(K)
    for k in range(K):
        if estimate[0, k] == 0.0 and estimate[1, k] == 0.0:
            continue
        largest = 0.0
        for m in range(moments.shape[1]):
            square, sum_ = moments[1, m, k], 0.0
            for s in range(S):
                if weight[s] == 0.0:
                    continue
                d, d_sd, o, o_sd = drift[0, s, k], drift[1, s, k], offset[0, s, k], offset[1, s, k]
                in_drift = d_sd * math.sqrt(square) > o_sd
                less_sd = o_sd if in_drift else d_sd
                if less_sd == 0.0:
                    sum_ += weight[s] * _worse(d, o, in_drift, d_sd, o_sd, estimate[:, k], moments[:, m, k])
                    continue
                inner_sum = 0.0
                for step in range(STEPS + 1):
                    z = step * _STEP - FARTHEST
                    d_z, o_z = (d, o + o_sd * z) if in_drift else (d + d_sd * z, o)
                    inner_sum += math.exp(-0.5 * z * z) * _worse(
                        d_z, o_z, in_drift, d_sd, o_sd, estimate[:, k], moments[:, m, k]
                    )
                sum_ += weight[s] * inner_sum / total
            largest = max(largest, sum_)
        harm[k] = min(largest + max(1.0 - weight.sum(), 0.0), 1.0)
    return harm


@inner
def _worse(d: float, o: float, in_drift: bool, d_sd: float, o_sd: float, estimate: Array, moments: Array) -> float:
    """Probability that correction makes it worse if one of drift and offset is known, and the other has its spread."""
    m, s = moments[0], moments[1]
    d_hat, o_hat = estimate[0], estimate[1]
    unit = 1.0 + d_hat
    if in_drift:
        away = (o - o_hat) / unit
        square = (1.0 / unit**2 - 1.0) * s
        linear = 2.0 * (away * m / unit - d_hat * s / unit**2 - o * m)
        constant = (d_hat / unit) ** 2 * s - 2.0 * d_hat / unit * away * m + away**2 - o**2
        return _positive_quadratic(square, linear, constant, d, d_sd)
    away = (d - d_hat) / unit
    square = 1.0 / unit**2 - 1.0
    linear = 2.0 * (away * m / unit - o_hat / unit**2 - d * m)
    constant = (away**2 - d**2) * s - 2.0 * away * m * o_hat / unit + (o_hat / unit) ** 2
    return _positive_quadratic(square, linear, constant, o, o_sd)


@inner
def _positive_quadratic(square: float, linear: float, constant: float, mean: float, sd: float) -> float:
    """Probability that square x^2 + linear x + constant is positive for x ~ N(mean, sd^2), which may be 0."""
    a, b = (square * mean + linear) * mean + constant, 2.0 * square * mean + linear
    # In t = x - mean: square t^2 + b t + a. Roots by the form that does not cancel.
    if sd == 0.0 or (square == 0.0 and b == 0.0):
        return 1.0 if a > 0.0 else 0.0
    if square == 0.0:
        return normal_mass(-a / b / sd, np.inf) if b > 0.0 else normal_mass(-np.inf, -a / b / sd)
    discriminant = b * b - 4.0 * square * a
    if discriminant <= 0.0:
        return 1.0 if square > 0.0 else 0.0
    q = -0.5 * (b + math.copysign(math.sqrt(discriminant), b))
    first = q / square
    second = a / q if q != 0.0 else 0.0
    lower, upper = min(first, second) / sd, max(first, second) / sd
    if square > 0.0:
        return normal_mass(-np.inf, lower) + normal_mass(upper, np.inf)
    return normal_mass(lower, upper)
