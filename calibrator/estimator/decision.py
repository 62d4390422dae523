"""What to say of a vehicle: estimate, confidence, and whether correction could make a branch worse.

The estimate is the point near which, within the tolerance of "recovered", most of the posterior lies; that share is
the confidence (M18). Correction with d_hat, o_hat makes a branch worse on a drive with the moments E[i], E[i^2] where

    alpha^2 E[i^2] + 2 alpha beta E[i] + beta^2  >  d^2 E[i^2] + 2 d o E[i] + o^2                               (M19)

with alpha = (1 + d) / (1 + d_hat) - 1 and beta = (o - o_hat) / (1 + d_hat); its probability is a sum over the draws.
"""

from collections.abc import Sequence
from math import exp, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled_with_notice
from calibrator.drive import Array
from calibrator.estimator.posterior import Draws
from calibrator.score import TOLERANCE

__all__ = ["Explained", "Points", "best_estimate", "harm_probability", "points_of"]

NEGLIGIBLE = 1e-8
"""Weight of a draw below which it is left out. [1]"""
CANDIDATES, LEAST_CANDIDATE = 8, 0.01
"""Explanations that are tried as estimates, and the least probability of all but the first. [1]"""
EQUALLY_GOOD = 0.01
"""Difference of confidence below which the estimate of the more probable explanation is taken. [1]"""
SAME = 1e-3
"""Difference of two offsets that cancel, in fractions of full scale: neither is known better. [1]"""
RESOLUTION = 3e-4
"""Drift [1] and offset in fractions of full scale that are taken for zero: no sensor's resolution is finer."""


class Explained(NamedTuple):
    """Weighted draws of N vehicles under one law of the fleet.

    Attributes
    ----------
    probability : float
        Of this law.
    draws : Draws
        Of the vehicles.
    weight : ndarray of shape (N, Q, M, 1 + g)
        Of the draws, see :func:`calibrator.estimator.posterior.weigh`.
    group_centre : ndarray of shape (g,)
        What the vehicles of each group share, in fractions of full scale.
    """

    probability: float
    draws: Draws
    weight: Array
    group_centre: Array


class Points(NamedTuple):
    """Posterior of one vehicle as weighted points.

    Attributes
    ----------
    faults : ndarray of shape (n, 2K)
        Drifts [1], then offsets in fractions of full scale.
    weight : ndarray of shape (n,)
        Sums to 1, but for what is negligible.
    explanation : ndarray of int of shape (n,)
        Number of the explanation that a point comes from.
    law, fit : ndarray of int of shape (e,)
        Of each explanation: its law, and its place among the fits of the vehicle.
    """

    faults: Array
    weight: Array
    explanation: NDArray[np.int64]
    law: NDArray[np.int64]
    fit: NDArray[np.int64]


def points_of(laws: Sequence[Explained], vehicle: int) -> Points:
    """Posterior of one vehicle over all laws that explain its fleet."""
    faults, weight, number = [], [], []
    for i, law in enumerate(laws):
        K = law.draws.values.shape[3] // 3
        size = int(np.count_nonzero(law.weight[vehicle] > NEGLIGIBLE))
        some, w, which = np.empty((size, 2 * K)), np.empty(size), np.empty(size, np.int64)
        _collect(law.draws, law.weight[vehicle], law.group_centre, vehicle, some, w, which)
        faults.append(some)
        weight.append(w * law.probability)
        number.append(which * len(laws) + i)
    kinds, explanation = np.unique(np.concatenate(number), return_inverse=True)
    groups = np.array([law.weight.shape[3] for law in laws])
    of_law = kinds % len(laws)
    return Points(
        np.concatenate(faults), np.concatenate(weight), explanation, of_law, kinds // len(laws) // groups[of_law]
    )


@compiled_with_notice
def _collect(
    draws: Draws, weight: Array, group_centre: Array, j: int, faults: Array, w: Array, which: NDArray[np.int64]
) -> None:
    _, M, G = weight.shape
    K, n = faults.shape[1] // 2, 0
    for q in range(draws.fits.number[j]):
        for m in range(M):
            for g in range(G):
                if weight[q, m, g] <= NEGLIGIBLE:
                    continue
                x = draws.values[j, q, m]
                for k in range(K):
                    gain = exp(x[1 + k] + draws.shared[K + k])
                    offset = x[2 * K + k] * gain
                    if k == draws.feed and g > 0:
                        if draws.shared[2 * K] and offset == 0.0:
                            offset = group_centre[g - 1]
                        elif not draws.shared[2 * K] and offset != 0.0:
                            offset -= group_centre[g - 1] * gain
                    if x[2 * K + k] != 0.0 or abs(offset + draws.shared[k]) > SAME:
                        offset += draws.shared[k]
                    else:
                        offset = 0.0  # what the group and all sensors share cancel
                    faults[n, k], faults[n, K + k] = gain - 1.0, offset
                w[n], which[n] = weight[q, m, g], q * G + g
                n += 1


def best_estimate(points: Points, smallest: Array) -> tuple[Array, float]:
    """Find the point that most of the posterior is within tolerance of.

    Parameters
    ----------
    points : Points
        Of one vehicle.
    smallest : ndarray of shape (2,)
        Least norms that drifts and offsets are counted with: the smallest faults of the fleet. [1]

    Returns
    -------
    faults : ndarray of shape (2K,)
        Drifts [1] and offsets in fractions of full scale.
    confidence : float
        Posterior probability that both are within 10 % of the truth in the Euclidean norm.
    """
    mass = np.bincount(points.explanation, points.weight)
    tried: list[Array] = []
    for c in np.argsort(-mass, kind="stable")[:CANDIDATES]:
        if tried and mass[c] < LEAST_CANDIDATE:
            break
        own = np.flatnonzero(points.explanation == c)
        tried.append(points.weight[own] @ points.faults[own] / mass[c])
        tried += [points.faults[i] for i in own[np.argsort(-points.weight[own], kind="stable")[:2]]]
    candidates = np.array(tried)
    candidates[np.abs(candidates) < RESOLUTION] = 0.0
    covered = np.zeros(len(candidates))
    _cover(points.faults, points.weight, candidates, smallest, covered)
    best = int(np.argmax(covered >= covered.max() - EQUALLY_GOOD))
    return candidates[best], float(min(covered[best], 1.0))


@compiled_with_notice
def _cover(faults: Array, weight: Array, candidates: Array, smallest: Array, covered: Array) -> None:
    K = faults.shape[1] // 2
    for c in range(len(candidates)):
        for i in range(len(faults)):
            near = True
            for part in range(2):
                distance, size = 0.0, 0.0
                for k in range(part * K, (part + 1) * K):
                    distance += (faults[i, k] - candidates[c, k]) ** 2
                    size += faults[i, k] ** 2
                if distance > (TOLERANCE * max(sqrt(size), smallest[part])) ** 2:
                    near = False
                    break
            if near:
                covered[c] += weight[i]


def harm_probability(points: Points, estimate: Array, mean: Array, mean_square: Array) -> Array:
    """Probability that correction makes each branch worse.

    Parameters
    ----------
    points : Points
        Of one vehicle.
    estimate : ndarray of shape (2K,)
        What the branches would be corrected with.
    mean, mean_square : ndarray of shape (D, K)
        Moments of the true currents on D drives, in fractions of full scale and their squares.

    Returns
    -------
    ndarray of shape (K,)
        That it does so on any of the drives; 0 where nothing would be corrected.
    """
    harm = np.zeros(len(estimate) // 2)
    _harm(points.faults, points.weight, estimate, mean, mean_square, harm)
    return np.minimum(harm, 1.0)


@compiled_with_notice
def _harm(faults: Array, weight: Array, estimate: Array, mean: Array, square: Array, harm: Array) -> None:
    K = len(harm)
    for k in range(K):
        d_hat, o_hat = estimate[k], estimate[K + k]
        if d_hat == 0.0 and o_hat == 0.0:
            continue
        for i in range(len(faults)):
            d, o = faults[i, k], faults[i, K + k]
            alpha, beta = (1.0 + d) / (1.0 + d_hat) - 1.0, (o - o_hat) / (1.0 + d_hat)
            for s in range(len(mean)):
                with_it = alpha * alpha * square[s, k] + 2.0 * alpha * beta * mean[s, k] + beta * beta
                without = d * d * square[s, k] + 2.0 * d * o * mean[s, k] + o * o
                if with_it > without:
                    harm[k] += weight[i]
                    break
