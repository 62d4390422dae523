"""Posterior of a vehicle: explanations with their weights under the prior that is meant, by importance sampling.

Every explanation of :mod:`calibrator.estimator.explanations` is spread over draws from its fit. A draw weighs

    w = p(rows | draw) p(draw) / q(draw)                                                                      (M17)

with the prior p of the fleet and the density q of the draws. So the prior may have any shape, and probabilities,
confidence and harm are sums over the same draws. A constant of the feeding branch that vehicles share (a group of the
prior) is one more thing that a draw may have; column 0 of the weights is a vehicle of no group.
"""

from functools import cache
from math import exp, expm1, log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, qmc

from calibrator.compiled import compiled_with_notice, inner
from calibrator.drive import Array
from calibrator.estimator.explanations import WIDE_SD, Evidence, Fits, Integers, residual
from calibrator.estimator.prior import GRID, Prior

__all__ = ["DRAWS", "Draws", "draw_explanations", "size_evidence", "weigh"]

DRAWS = 64
"""Draws from each explanation; half of them mirror the others."""
OPEN_SD = 0.02
"""Standard deviation of a parameter from which on draws are weighed by the exact likelihood: rows curve. [1]"""
LOAD_GIVES_NONE = 100.0
"""Logarithm of the odds against a load that would supply current: finite, so that every vehicle has an explanation."""
GAIN, OFFSET, LOAD = 0, 1, 2
"""Rows of :attr:`Prior.log_density`."""
LOG_FIRST, LOG_STEP = float(np.log(GRID[0])), float(np.log(GRID[1] / GRID[0]))
LOG_ROOT_TAU = 0.5 * float(np.log(2.0 * np.pi))


class Draws(NamedTuple):
    """Draws of N vehicles from Q explanations each, M of each, before they are weighed.

    Attributes
    ----------
    fits : Fits
        The explanations.
    values : ndarray of shape (N, Q, M, P)
        Parameters. [1]
    place : ndarray of int of shape (N, Q, M, P)
        Where the sizes of faults and loads lie in the grid of the prior.
    base : ndarray of shape (N, Q, M)
        Logarithm of p(rows | draw) / q(draw), with the densities of signs and of the change to sizes.
    feed : int
        Branch that carries loads without a sensor.
    shared : ndarray of shape (2K + 1,)
        What all sensors of a branch share, see :class:`calibrator.estimator.explanations.Evidence`.
    """

    fits: Fits
    values: Array
    place: NDArray[np.int16]
    base: Array
    feed: int
    shared: Array


@cache
def _normal_draws(dimensions: int) -> Array:
    """Quasi-random points of a standard normal distribution and their mirror images, shape (DRAWS, dimensions)."""
    half = norm.ppf(qmc.Sobol(dimensions, scramble=True, rng=1).random(DRAWS // 2))
    return np.concatenate([half, -half])


def draw_explanations(fits: Fits, evidence: Evidence) -> Draws:
    """Spread the explanations of N vehicles over draws."""
    N, Q, P = fits.theta.shape
    values, place = np.zeros((N, Q, DRAWS, P)), np.zeros((N, Q, DRAWS, P), np.int16)
    base = np.full((N, Q, DRAWS), -np.inf)
    _draw(fits, evidence, _normal_draws(P), values, place, base)
    return Draws(fits=fits, values=values, place=place, base=base, feed=evidence.feed, shared=evidence.shared)


@inner
def _place(size: float) -> int:
    index = int((log(max(size, 1e-300)) - LOG_FIRST) / LOG_STEP + 0.5)
    return min(max(index, 0), len(GRID) - 1)


@compiled_with_notice
def _draw(fits: Fits, evidence: Evidence, normal: Array, values: Array, place: NDArray[np.int16], base: Array) -> None:
    N, P, M = fits.theta.shape[0], fits.theta.shape[2], len(normal)
    K = P // 3
    e = np.zeros(5 * K)
    for j in range(N):
        for q in range(fits.number[j]):
            theta, root, chosen = fits.theta[j, q], fits.root[j, q], np.flatnonzero(fits.support[j, q])
            widest = (root**2).sum(axis=1).max()
            for m in range(M):
                x = values[j, q, m]
                weight = fits.log_evidence[j, q]  # of the rows under the wide Gaussian ...
                fitted = fits.chi2[j, q]
                for p in chosen:
                    x[p] = theta[p]
                    for i in chosen:
                        x[p] += root[p, i] * normal[m, i]
                    weight += 0.5 * (x[p] / WIDE_SD) ** 2 + log(WIDE_SD) + LOG_ROOT_TAU  # ... whose density goes
                    fitted += (theta[p] ** 2 - x[p] ** 2) / WIDE_SD**2 + normal[m, p] ** 2
                for k in range(K):  # known is the offset, not what a doubtful gain makes of it in true currents
                    turn = x[1 + k] - theta[1 + k]
                    if turn != 0.0 and fits.support[j, q, 2 * K + k]:
                        x[2 * K + k] = (x[2 * K + k] + theta[2 * K + k] * turn) * exp(-turn)
                        weight -= turn
                if widest > OPEN_SD**2:
                    residual(x, evidence, j, e)
                    exact = 0.0
                    for r in range(5 * K):
                        total = 0.5 * evidence.precision[j, r, r] * e[r]
                        for s in range(r):
                            total += evidence.precision[j, r, s] * e[s]
                        exact += 2.0 * e[r] * total
                    weight += 0.5 * (fitted - exact)
                for p in chosen:
                    size, log_unit = abs(x[p]), 0.0
                    if p <= K:  # d = e^x - 1
                        size, log_unit = abs(expm1(x[p])), x[p]
                    elif 2 * K <= p < 3 * K:  # o = (1 + d) omega
                        log_unit = x[p - 2 * K + 1] + evidence.shared[p - K]
                        size *= exp(log_unit)
                    weight += log_unit - (log(2.0) if p < 3 * K else 0.0)  # faults are of either sign
                    place[j, q, m, p] = _place(size)
                base[j, q, m] = weight


@inner
def _terms(
    draws: Draws, prior: "_Tables", j: int, q: int, m: int, places: Integers, kinds: Integers
) -> tuple[float, int]:
    """Prior of a draw but for the feeding branch: log weight so far; fills places and kinds of the sizes it has."""
    fits, place = draws.fits, draws.place[j, q, m]
    K = place.shape[0] // 3
    n = 0
    for p in range(3 * K):
        if fits.support[j, q, p] and p != 2 * K + draws.feed:
            places[n], kinds[n] = place[p], GAIN if p <= K else OFFSET
            n += 1
    return draws.base[j, q, m] + prior.log_supports[fits.hardware[j, q], fits.sensor[j, q]], n


@inner
def _feeding(
    draws: Draws, prior: "_Tables", j: int, q: int, m: int, g: int, places: Integers, kinds: Integers, n: int
) -> tuple[float, int]:
    """Prior of the feeding branch's constant in a vehicle of group g (0: of none); -inf where it cannot be."""
    fits, x = draws.fits, draws.values[j, q, m]
    K = x.shape[0] // 3
    offset, load = 2 * K + draws.feed, 3 * K
    if fits.support[j, q, load]:
        if g == 0:
            places[n], kinds[n] = draws.place[j, q, m, load], LOAD
            return (prior.log_load if x[load] > 0.0 else -LOAD_GIVES_NONE), n + 1
        z = (x[load] - prior.group_centre[g - 1]) / prior.group_sd[g - 1]
        return prior.log_group[g - 1] - 0.5 * z * z - log(prior.group_sd[g - 1]) - LOG_ROOT_TAU, n
    if fits.support[j, q, offset]:
        if g == 0:
            places[n], kinds[n] = draws.place[j, q, m, offset], OFFSET
            return prior.log_none, n + 1
        gain = exp(x[1 + draws.feed] + draws.shared[K + draws.feed])
        own = x[offset] * gain - prior.group_centre[g - 1] * (1.0 if draws.shared[2 * K] else gain)
        places[n], kinds[n] = _place(abs(own)), OFFSET  # a fault beside what the group shares
        return prior.log_group[g - 1], n + 1
    return (prior.log_none if g == 0 else -np.inf), n


class _Tables(NamedTuple):
    """A prior as numbers and arrays, for compiled functions; logarithms of probabilities and densities."""

    log_supports: Array
    log_density: Array
    log_none: float
    log_load: float
    log_group: Array
    group_centre: Array
    group_sd: Array


def _tables(prior: Prior) -> _Tables:
    none = 1.0 - prior.load_share - float(prior.group_share.sum())
    return _Tables(
        log_supports=prior.log_supports,
        log_density=prior.log_density,
        log_none=log(max(none, 1e-12)),
        log_load=log(prior.load_share),
        log_group=np.log(prior.group_share),
        group_centre=prior.group_centre,
        group_sd=prior.group_sd,
    )


def weigh(draws: Draws, prior: Prior) -> tuple[Array, Array]:
    """Weights of the draws under a prior.

    Parameters
    ----------
    draws : Draws
        Of N vehicles.
    prior : Prior
        Of their fleet, with g groups.

    Returns
    -------
    weight : ndarray of shape (N, Q, M, 1 + g)
        Posterior probability of each draw in a vehicle of no group, and of each group; sums to 1 over a vehicle.
    log_evidence : ndarray of shape (N,)
        Logarithm of the probability density of each vehicle's rows.
    """
    weight = np.zeros((*draws.base.shape, 1 + len(prior.group_share)))
    log_evidence = np.empty(len(weight))
    _weigh(draws, _tables(prior), weight, log_evidence)
    return weight, log_evidence


@compiled_with_notice
def _weigh(draws: Draws, prior: _Tables, weight: Array, log_evidence: Array) -> None:
    N, _, M, G = weight.shape
    P = draws.values.shape[3]
    places, kinds = np.empty(P, np.int64), np.empty(P, np.int64)
    for j in range(N):
        count, best = draws.fits.number[j], -np.inf
        for q in range(count):
            for m in range(M):
                common, n = _terms(draws, prior, j, q, m, places, kinds)
                for g in range(G):
                    value, last = _feeding(draws, prior, j, q, m, g, places, kinds, n)
                    value += common
                    for i in range(last):
                        value += prior.log_density[kinds[i], places[i]]
                    weight[j, q, m, g] = value
                    best = max(best, value)
        weight[j, :count] = np.exp(weight[j, :count] - best)
        total = weight[j, :count].sum()
        weight[j, :count] /= total
        log_evidence[j] = best + log(total / M)


def size_evidence(draws: Draws, prior: Prior, kind: int, candidates: Array, *, every: int = 4) -> Array:
    """Log evidence of a fleet if the sizes of one kind of faults had other densities.

    Parameters
    ----------
    draws : Draws
        Of N vehicles.
    prior : Prior
        Of their fleet otherwise.
    kind : int
        :data:`GAIN` or :data:`OFFSET`.
    candidates : ndarray of shape (C, G)
        Densities at the grid of the prior.
    every : int
        Only every so many draws of an explanation are looked at.

    Returns
    -------
    ndarray of shape (C,)
        Sum over the vehicles.
    """
    evidence = np.zeros(len(candidates))
    _size_evidence(draws, _tables(prior), kind, np.ascontiguousarray(np.log(candidates).T), every, evidence)
    return evidence


@compiled_with_notice
def _size_evidence(draws: Draws, prior: _Tables, kind: int, candidates: Array, every: int, evidence: Array) -> None:
    N, _, M, P = draws.values.shape
    G, C = 1 + len(prior.group_centre), len(evidence)
    places, kinds = np.empty(P, np.int64), np.empty(P, np.int64)
    peak, total, value = np.empty(C), np.empty(C), np.empty(C)
    for j in range(N):
        peak[:], total[:] = -np.inf, 0.0
        for q in range(draws.fits.number[j]):
            for m in range(0, M, every):
                common, n = _terms(draws, prior, j, q, m, places, kinds)
                for g in range(G):
                    fixed, last = _feeding(draws, prior, j, q, m, g, places, kinds, n)
                    if fixed == -np.inf:
                        continue
                    fixed += common
                    for i in range(last):
                        if kinds[i] != kind:
                            fixed += prior.log_density[kinds[i], places[i]]
                    value[:] = fixed
                    for i in range(last):
                        if kinds[i] == kind:
                            for c in range(C):
                                value[c] += candidates[places[i], c]
                    for c in range(C):
                        if value[c] > peak[c]:
                            total[c] = total[c] * exp(peak[c] - value[c]) + 1.0
                            peak[c] = value[c]
                        elif value[c] > peak[c] - 25.0:
                            total[c] += exp(value[c] - peak[c])
        for c in range(C):
            evidence[c] += peak[c] + log(total[c])
