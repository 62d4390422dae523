"""Posterior of a vehicle: which of its parameters are not zero, how well each choice fits, and how probable it is.

The P = 3K + 1 parameters of a vehicle with K branches, in the symbols of docs/method.md and with the names of
:class:`calibrator.estimator.evidence.ParameterPlaces`:

    0            eta               eta = log(1 + d_h)             hardware
    1 .. K       gains             lambda_k = log(1 + d_k)        gain of sensor k
    K+1 .. 2K-1  hardware_offsets  o_h,k, all k but the last      hardware
    2K .. 3K-1   offsets           omega_k = o_k / (1 + d_k)      offset of sensor k as seen in true currents
    3K           load              l                              load without a sensor, carried by the feeding branch

The 5K rows, with the names of :class:`calibrator.estimator.evidence.RowPlaces`; branches are counted from 0:

    0 .. K-1      slopes           3K-1 .. 4K-2  intercepts
    K .. 2K-2     ratios           4K-1          junction
    2K-1 .. 3K-2  gain_reads       4K .. 5K-1    offset_reads

Offsets and loads are in fractions of full scale. A support is the set of parameters that are not zero: one explanation.
Every support is fitted by Gauss-Newton steps on the evidence rows (M11), under a wide Gaussian prior (M12), and spread
over draws from its fit. A draw weighs

    w = p(rows | draw) p(draw) / q(draw)                                                                      (M17)

with the prior p of the fleet and the density q of the draws. So the prior may have any shape, and probabilities,
confidence and harm are sums over the same draws. A vehicle may also belong to a group of the prior, whose vehicles
share a constant of the feeding branch; column 0 of the weights is for a vehicle of no group.

For each vehicle some ten thousand residuals are evaluated in a millisecond, so the loops are compiled by numba; they
address rows and parameters by the numbers above.
"""

from dataclasses import dataclass, field
from functools import cache
from itertools import permutations
from math import exp, expm1, log
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, qmc

from calibrator.compiled import compiled, inner
from calibrator.drive import Array, Mask
from calibrator.estimator.evidence import TINY, EvidenceRows, ParameterPlaces, RowPlaces
from calibrator.estimator.prior import GRID, TAIL_RANGE, Prior

__all__ = [
    "DRAWS",
    "GAIN",
    "OFFSET",
    "WIDE_SD",
    "Draws",
    "Evidence",
    "FaultModel",
    "FaultSizes",
    "Fits",
    "Spread",
    "draw_explanations",
    "evidence_of",
    "explain",
    "fault_sizes",
    "fit_explanations",
    "residual",
    "row_residuals",
    "weigh",
]

Integers = NDArray[np.int64]

WIDE_SD = 0.4
"""Standard deviation of the wide Gaussian under which every support is fitted. [1]"""
MARGIN = 12.0
"""Distance of a support's log weight below the best one's from which on the support is not fitted any further."""
MOST_FITTED = 96
"""Largest number of supports of a vehicle that are kept, the most probable ones."""
MOST_MOVED = 48
"""Largest number of explanations of a vehicle that are added for currents that the hardware moves."""
MOST_PARAMETERS = 6
"""Largest number of parameters of a support; if 20 % of all parameters are faulty, few vehicles have more."""
MOST_TURN = 3.0
"""Largest logarithm by which a measured ratio can be off. [1]"""
LOWEST, HIGHEST, STEP = -2.5, 1.2, 0.5
"""Range of the logarithm of a gain, and the longest step of one iteration: gains from 0.08 to 3.3. [1]"""
MOST_STEPS, LAST_STEP = 7, 1e-7
"""Most Gauss-Newton steps, and size below which a step is the last one: far below what any row shows. [1]"""
DIFFERENCE = 1e-6
"""Step for derivatives of residuals by differences: rounding and curvature leave an error of 1e-9 of them. [1]"""
DRAWS = 64
"""Number of draws from each explanation; half of them mirror the others."""
OPEN_SD = 0.02
"""Standard deviation of a parameter above which draws need the exact likelihood: rows are not linear so far out. [1]"""
LOAD_GIVES_NONE = 100.0
"""Logarithm of the odds against a load that would supply current: finite, so that every vehicle has an explanation."""
GAIN, OFFSET, LOAD = 0, 1, 2
"""Rows of ``Prior.log_density``."""
NO_SIZE = len(GRID)
"""Index that stands for the size of a parameter that is zero; other sizes have an index of ``GRID``."""
NEGLIGIBLE = 1e-15
"""Weight of a draw below which no density of the sizes makes it matter. [1]"""
BETWEEN = np.sqrt(GRID[1:] * GRID[:-1])
"""Sizes between those of ``GRID``."""
LOG_FIRST, LOG_STEP = float(np.log(GRID[0])), float(np.log(GRID[1] / GRID[0]))
LOG_ROOT_TAU = 0.5 * float(np.log(2.0 * np.pi))

MISFIT_SD = 4.0
"""Excess of chi square, in its standard deviations, above which a vehicle's covariance is made wider. [1]"""


class Evidence(NamedTuple):
    """Evidence rows of N vehicles, and those of a vehicle without faults.

    Attributes
    ----------
    values : ndarray of shape (N, 5K)
        Rows, relative ones first. [1]
    means : ndarray of shape (N, 2, K)
        Means of the fleet model's and of the measured currents, about which the lines of the constants pivot. [1]
    centre : ndarray of shape (5K,)
        Centre of the rows of vehicles without faults. [1]
    shared : ndarray of shape (2K + 1,)
        What all sensors of a branch share: K offsets, in fractions of full scale, which the centre includes, and K
        values log(1 + d). The last entry is 1 if what a group of vehicles shares is an offset of the feeding sensor,
        and 0 if it is a load: seen through a gain error an offset has another size, but a load has not, (M16) of
        docs/method.md.
    precision, precision_relative : ndarray of shape (N, 5K, 5K)
        Inverse covariance of all rows, and of the relative rows alone, with zeros in the others.
    log_scale : ndarray of shape (N,)
        Logarithm of the probability density of the rows of a vehicle that are all at the centre.
    feed : int
        Number of the branch that carries a load without a sensor, in the order of the rows.
    """

    values: Array
    means: Array
    centre: Array
    shared: Array
    precision: Array
    precision_relative: Array
    log_scale: Array
    feed: int


class Fits(NamedTuple):
    """Explanations of N vehicles, Q each at most.

    Attributes
    ----------
    number : ndarray of int of shape (N,)
        Number of explanations of each vehicle; entries beyond it in the other arrays are meaningless.
    support : ndarray of bool of shape (N, Q, P)
        Which parameters are not zero. If the hardware moves a current between two branches, that is one fault: only one
        of its two hardware offsets is marked here, ``theta`` has both.
    hardware, sensor : ndarray of int of shape (N, Q)
        Numbers of hardware and sensor faults.
    theta : ndarray of shape (N, Q, P)
        Most probable parameters under the wide Gaussian. [1]
    root : ndarray of shape (N, Q, P, P)
        Root of their covariance: theta + root z, with z standard normal, is a draw. [1]
    log_evidence : ndarray of shape (N, Q)
        Logarithm of the probability density of the rows under the wide Gaussian.
    chi2 : ndarray of shape (N, Q)
        Sum of squares of the whitened residuals. [1]
    """

    number: Integers
    support: Mask
    hardware: Integers
    sensor: Integers
    theta: Array
    root: Array
    log_evidence: Array
    chi2: Array


def evidence_of(values: Array, covariance: Array, means: Array, *, centre: Array, shared: Array, feed: int) -> Evidence:
    """Make the evidence with the inverses of its covariance (N, 5K, 5K); other arguments as in :class:`Evidence`."""
    rows = values.shape[1]
    relative = RowPlaces(rows // 5).relative
    of_relative = np.zeros_like(covariance)
    precision, log_det = _inverse(covariance)
    of_relative[:, relative, relative], _ = _inverse(covariance[:, relative, relative])
    return Evidence(
        values=np.ascontiguousarray(values),
        means=np.ascontiguousarray(means),
        centre=centre,
        shared=shared,
        precision=precision,
        precision_relative=of_relative,
        log_scale=-0.5 * (log_det + rows * np.log(2.0 * np.pi)),
        feed=feed,
    )


def _inverse(covariance: Array) -> tuple[Array, Array]:
    """Return the inverse of covariances (N, r, r), positive definite in spite of rounding, and log determinants (N,).

    Rows that are exact to 1e-5 beside a spread of some percent that they have in common need this.
    """
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    square = sd[:, :, None] * sd[:, None, :]
    values, vectors = np.linalg.eigh(covariance / square)
    inverse = (vectors / values[:, None]) @ np.swapaxes(vectors, 1, 2) / square
    return inverse, np.log(values).sum(axis=1) + 2.0 * np.log(sd).sum(axis=1)


def fit_explanations(evidence: Evidence, log_prior: Array, log_load: float) -> Fits:
    """Fit to each vehicle the supports that may have a share in its posterior.

    Parameters
    ----------
    evidence : Evidence
        Evidence of N vehicles.
    log_prior : ndarray of shape (K + 1, 2K + 1)
        Rough logarithm of the prior probability of one support, by its numbers of hardware and sensor faults; it
        decides which supports are looked at closely.
    log_load : float
        Rough logarithm of the prior probability of a load without a sensor.

    Returns
    -------
    Fits
        The most probable supports of each vehicle, at most :data:`MOST_FITTED`.
    """
    N, rows = evidence.values.shape
    K = rows // 5
    P = 3 * K + 1
    fits = Fits(
        number=np.zeros(N, np.int64),
        support=np.zeros((N, MOST_FITTED, P), bool),
        hardware=np.zeros((N, MOST_FITTED), np.int64),
        sensor=np.zeros((N, MOST_FITTED), np.int64),
        theta=np.zeros((N, MOST_FITTED, P)),
        root=np.zeros((N, MOST_FITTED, P, P)),
        log_evidence=np.full((N, MOST_FITTED), -np.inf),
        chi2=np.zeros((N, MOST_FITTED)),
    )
    backwards = np.maximum.accumulate(np.maximum.accumulate(log_prior[::-1, ::-1], axis=0), axis=1)
    best_ahead = np.ascontiguousarray(backwards[::-1, ::-1])  # of as many faults or more, as few may be rarer
    _fit_all(evidence, log_prior, best_ahead, log_load, fits)
    at, on = ParameterPlaces(K), fits.support
    fits.hardware[:] = on[:, :, at.eta] + on[:, :, at.hardware_offsets].sum(axis=2)
    fits.sensor[:] = on[:, :, at.gains].sum(axis=2) + on[:, :, at.offsets].sum(axis=2)
    most = max(int(fits.number.max(initial=1)), 1)
    kept = {name: np.ascontiguousarray(values[:, :most]) for name, values in fits._asdict().items() if name != "number"}
    return fits._replace(**kept)


def row_residuals(evidence: Evidence, theta: Array) -> Array:
    """Return the rows of N vehicles minus what Q sets of parameters (N, Q, P) predict, shape (N, Q, 5K).

    Equation (M11) of docs/method.md.
    """
    left = np.empty((*theta.shape[:2], evidence.values.shape[1]))
    _all_residuals(evidence, theta, left)
    return left


@compiled
def _all_residuals(evidence: Evidence, theta: Array, left: Array) -> None:
    """Fill ``left`` with what :func:`row_residuals` returns."""
    for j in range(theta.shape[0]):
        for q in range(theta.shape[1]):
            residual(theta[j, q], evidence, j, left[j, q])


@inner
def residual(theta: Array, evidence: Evidence, j: int, e: Array) -> None:
    """Fill e with the residuals of vehicle j: its rows minus what the parameters predict, (M11) of docs/method.md."""
    y, means, centre = evidence.values[j], evidence.means[j], evidence.centre
    shared, feed, K = evidence.shared, evidence.feed, len(evidence.values[j]) // 5
    c, oh_last = 3 * K - 1, 0.0  # first of the intercepts; hardware offset of the last branch
    first = theta[1] + shared[K]
    for k in range(K):
        gain = theta[1 + k] + shared[K + k]
        e[k] = y[k] - centre[k] - theta[0] - gain
        e[2 * K - 1 + k] = y[2 * K - 1 + k] - centre[2 * K - 1 + k] - gain
        if k:
            e[K + k - 1] = y[K + k - 1] - centre[K + k - 1] - first + gain
            oh_last -= theta[K + k]
    junction = y[c + K] * exp(-first)
    for k in range(K):
        unit = exp(-theta[1 + k] - shared[K + k])  # true current per measured current
        seen = y[c + k] * unit  # a constant as seen in true currents
        seen += means[0, k] * (exp(theta[0]) * expm1(min(e[k], MOST_TURN)) - e[k])  # pivots with its slope
        hardware = theta[K + 1 + k] if k < K - 1 else oh_last
        batch = shared[k] * (unit - 1.0)  # change of the offset that the centre includes
        e[c + k] = seen - centre[c + k] - hardware - theta[2 * K + k] - batch
        e[c + K + 1 + k] = y[c + K + 1 + k] - centre[c + K + 1 + k] - shared[k] - theta[2 * K + k] / unit
        junction -= theta[2 * K + k] + batch
        if k:
            x = e[K + k - 1]
            junction -= means[1, k] * (unit * expm1(min(x, MOST_TURN)) - exp(-y[k]) * x)
    load = theta[3 * K]
    if shared[2 * K]:  # it is an offset of the feeding sensor
        e[c + K + 1 + feed] -= load
        load *= exp(-theta[1 + feed] - shared[K + feed])
    e[c + K] = junction - centre[c + K] - load
    e[c + feed] -= load


@compiled
def _fit_all(evidence: Evidence, log_prior: Array, best_ahead: Array, log_load: float, fits: Fits) -> None:
    """Fill ``fits``, except for the numbers of faults; ``best_ahead`` is the best prior of as many faults or more."""
    for j in range(len(evidence.values)):
        scores, codes = _rough_weights(evidence, j, log_prior, best_ahead, log_load)
        kept = np.flatnonzero(scores > scores.max() - MARGIN)
        kept = kept[np.argsort(-scores[kept])][: fits.theta.shape[1]]
        fits.number[j] = len(kept)
        for q in range(len(kept)):
            for p in range(fits.theta.shape[2]):
                fits.support[j, q, p] = (codes[kept[q]] >> p) & 1
            fits.log_evidence[j, q], fits.chi2[j, q] = _refine(
                evidence, j, np.flatnonzero(fits.support[j, q]), fits.theta[j, q], fits.root[j, q]
            )
            fits.log_evidence[j, q] += evidence.log_scale[j]


@inner
def _normal_equations(
    evidence: Evidence, j: int, theta: Array, chosen: Integers, precision: Array
) -> tuple[Array, Array, float]:
    """Return H and g of the Gauss-Newton step, H step = g, of the chosen parameters under the wide prior; and chi2."""
    n, e = len(chosen), np.empty(evidence.values.shape[1])
    A = np.empty((n, len(e)))  # minus the derivatives, a row per parameter
    residual(theta, evidence, j, e)
    for a in range(n):
        before = theta[chosen[a]]
        theta[chosen[a]] = before + DIFFERENCE
        residual(theta, evidence, j, A[a])
        theta[chosen[a]] = before
        A[a] = (e - A[a]) / DIFFERENCE
    weighted, H, g = A @ precision, np.empty((n, n)), np.empty(n)
    for a in range(n):
        for b in range(a + 1):
            H[a, b] = H[b, a] = (weighted[a] * A[b]).sum()
        H[a, a] += WIDE_SD**-2
        g[a] = (weighted[a] * e).sum() - theta[chosen[a]] / WIDE_SD**2
    return H, g, float(e @ (precision @ e))


@inner
def _without(H: Array, g: Array, i: int) -> tuple[Array, Array]:
    """Return the normal equations of the parameters after number i once that one is fitted (Schur complement)."""
    rest, right = H[i + 1 :, i + 1 :].copy(), g[i + 1 :].copy()
    for a in range(len(right)):
        share = H[i, i + 1 + a] / H[i, i]
        right[a] -= share * g[i]
        for b in range(len(right)):
            rest[a, b] -= share * H[i, i + 1 + b]
        rest[a, a] = max(rest[a, a], WIDE_SD**-2)  # of the prior alone; less is rounding, where rows are nearly exact
    return rest, right


@inner
def _rough_weights(
    evidence: Evidence, j: int, log_prior: Array, best_ahead: Array, log_load: float
) -> tuple[Array, Integers]:
    """Return rough log weights of the supports that may matter, and the supports: bit p is set if parameter p is.

    Once a set of gains is fitted to the relative rows, the constants are linear: they are eliminated one by one from
    the normal equations, depth first. A branch of the search ends where it could not matter even with all remaining
    constants, and with the best prior of as many faults or more.
    """
    K, log_wide = evidence.values.shape[1] // 5, log(WIDE_SD)
    P, feeding_offset = 3 * K + 1, 2 * K + evidence.feed
    best, scores, codes = -np.inf, [0.0 for _ in range(0)], [0 for _ in range(0)]
    of_gains, of_relative, _ = _normal_equations(
        evidence, j, np.zeros(P), np.arange(K + 1), evidence.precision_relative[j]
    )
    for mask in range(1 << (K + 1)):
        gains = np.array([p for p in range(K + 1) if (mask >> p) & 1], np.int64)
        n, theta = len(gains), np.zeros(P)
        if n > MOST_PARAMETERS:
            continue
        if n:
            fitted = np.linalg.solve(of_gains[gains][:, gains], of_relative[gains])
            theta[gains] = np.minimum(np.maximum(fitted, LOWEST), HIGHEST)
        columns = np.concatenate((gains, np.arange(K + 1, P)))
        H, g, chi2 = _normal_equations(evidence, j, theta, columns, evidence.precision[j])
        weight = -0.5 * chi2 - 0.5 * ((theta / WIDE_SD) ** 2).sum()
        for _ in range(n):
            weight += 0.5 * g[0] ** 2 / H[0, 0] - 0.5 * log(H[0, 0]) - log_wide
            H, g = _without(H, g, 0)
        possible = 0.5 * (g * np.linalg.solve(H, g)).sum()  # what all constants together could add
        hardware = mask & 1
        sensor = n - hardware
        scores.append(weight + log_prior[hardware, sensor])
        codes.append(mask)
        best = max(best, scores[-1])
        stack = [(K + 1, n, hardware, sensor, 0, mask, weight, possible, H, g)]
        while stack:
            first, size, hardware, sensor, load, code, weight, possible, H, g = stack.pop()
            for p in range(first, P if size < MOST_PARAMETERS else first):
                if p == 3 * K and (code >> feeding_offset) & 1:
                    continue  # a load and an offset of the feeding sensor look the same
                i, h, s, loads = p - first, hardware + (p < 2 * K), sensor + (2 * K <= p < 3 * K), load + (p == 3 * K)
                gain = 0.5 * g[i] ** 2 / H[i, i]
                value = weight + gain - 0.5 * log(H[i, i]) - log_wide
                scores.append(value + log_prior[h, s] + log_load * loads)
                codes.append(code | (1 << p))
                best = max(best, scores[-1])
                if value + best_ahead[h, s] + log_load * loads + possible - gain > best - MARGIN - 3.0:
                    rest, right = _without(H, g, i)
                    stack.append((p + 1, size + 1, h, s, loads, codes[-1], value, possible - gain, rest, right))
    return np.array(scores), np.array(codes)


@inner
def _refine(evidence: Evidence, j: int, chosen: Integers, theta: Array, root: Array) -> tuple[float, float]:
    """Fit the chosen parameters by Gauss-Newton on all rows; fill theta and root, return log evidence and chi2."""
    for _ in range(MOST_STEPS):
        H, g, chi2 = _normal_equations(evidence, j, theta, chosen, evidence.precision[j])
        if not len(chosen):
            return -0.5 * chi2, chi2
        step = np.linalg.solve(H, g)
        if np.abs(step).max() < LAST_STEP:
            break
        for a in range(len(chosen)):
            p = chosen[a]
            if p <= len(theta) // 3:  # a gain; constants are linear beside them
                theta[p] = min(max(theta[p] + min(max(step[a], -STEP), STEP), LOWEST), HIGHEST)
            else:
                theta[p] += step[a]
    L = np.linalg.cholesky(H)
    inverse = np.linalg.inv(L)  # its transpose is a root of the covariance
    value = -0.5 * chi2
    for a in range(len(chosen)):
        value -= 0.5 * (theta[chosen[a]] / WIDE_SD) ** 2 + log(WIDE_SD) + log(L[a, a])
        for b in range(a + 1):
            root[chosen[b], chosen[a]] = inverse[a, b]
    return value, chi2


class Draws(NamedTuple):
    """Draws from the explanations of N vehicles, not weighted yet: M (:data:`DRAWS`) from each of Q, of P parameters.

    Attributes
    ----------
    fits : Fits
        The explanations.
    values : ndarray of shape (N, Q, M, P)
        Parameters; 0 where the support lacks them. [1]
    place : ndarray of int of shape (N, Q, M, P)
        Index of the size of each fault and load in :data:`~calibrator.estimator.prior.GRID`; :data:`NO_SIZE` where the
        support lacks it.
    base : ndarray of shape (N, Q, M)
        Logarithm of p(rows | draw) / q(draw), where q is the density from which it was drawn; with the probability of
        the signs and the change of variables to sizes.
    feed : int
        Number of the branch that carries loads without a sensor.
    shared : ndarray of shape (2K + 1,)
        What all sensors of a branch share, see :class:`calibrator.estimator.posterior.Evidence`.
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
    """Draw :data:`DRAWS` sets of parameters from each explanation of N vehicles."""
    N, Q, P = fits.theta.shape
    values, place = np.zeros((N, Q, DRAWS, P)), np.full((N, Q, DRAWS, P), NO_SIZE, np.int16)
    base = np.full((N, Q, DRAWS), -np.inf)
    _draw(fits, evidence, _normal_draws(P), values, place, base)
    return Draws(fits=fits, values=values, place=place, base=base, feed=evidence.feed, shared=evidence.shared)


@inner
def _place(size: float) -> int:
    """Return the index of the size of a fault in :data:`~calibrator.estimator.prior.GRID`."""
    index = int((log(max(size, 1e-300)) - LOG_FIRST) / LOG_STEP + 0.5)
    return min(max(index, 0), len(GRID) - 1)


@compiled
def _draw(fits: Fits, evidence: Evidence, normal: Array, values: Array, place: NDArray[np.int16], base: Array) -> None:
    """Fill ``values``, ``place`` and ``base`` of :class:`Draws`; ``normal`` (M, P) is standard normal."""
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
                    weight += 0.5 * (x[p] / WIDE_SD) ** 2 + log(WIDE_SD) + LOG_ROOT_TAU  # ... which is taken out
                    fitted += (theta[p] ** 2 - x[p] ** 2) / WIDE_SD**2 + normal[m, p] ** 2
                for k in range(K):  # the offset is known, but with a doubtful gain its size in true currents is not
                    change = x[1 + k] - theta[1 + k]
                    if change != 0.0 and fits.support[j, q, 2 * K + k]:
                        x[2 * K + k] = (x[2 * K + k] + theta[2 * K + k] * change) * exp(-change)
                        weight -= change
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


def _with_moved_currents(draws: Draws, log_prior: Array, log_load: float, read: Mask) -> Draws:
    """Add the explanations in which the hardware moves a current between two branches, neither of them the last.

    Offsets x and y of the sensors p and r (as seen in true currents) have the same rows as an offset x + y of p beside
    a hardware offset y in r and -y in p; if x + y may be zero, also as that hardware offset alone. The parameters of a
    support have one fault for it only if either branch is the last, so these explanations are made from those with
    offsets of both sensors, (M17a) of docs/method.md. ``theta`` and ``values`` have both hardware offsets; ``support``
    and ``place`` have one, as they are one fault. ``log_prior`` and ``log_load`` are those of :func:`fit_explanations`;
    ``read`` (N, K) says which offsets were read directly: a reading tells the two apart.
    """
    fits, K, N = draws.fits, read.shape[1], len(read)
    pairs = permutations(range(K - 1), 2)
    kinds = [(p, r, alone) for p, r in pairs for alone in ((False, True) if p < r else (False,))]
    if not kinds:
        return draws
    of_load = log_load * fits.support[:, :, 3 * K]
    on = np.moveaxis(fits.support, 2, 0)
    score = np.full((len(kinds), *fits.hardware.shape), -np.inf)
    for each, (p, r, alone) in zip(score, kinds, strict=True):
        both = on[2 * K + p] & on[2 * K + r] & ~(on[K + 1 + p] & on[K + 1 + r]) & (fits.hardware < K)
        j, q = np.nonzero(both & ~(read[:, [p]] | read[:, [r]]))
        rough = log_prior[fits.hardware[j, q] + 1, fits.sensor[j, q] - 1 - alone] + of_load[j, q]
        each[j, q] = fits.log_evidence[j, q] + rough + (_zero_sum(fits, j, q, p, r)[0] if alone else 0.0)
    least = (fits.log_evidence + log_prior[fits.hardware, fits.sensor] + of_load).max(axis=1) - MARGIN
    ranked = -np.sort(-np.moveaxis(score, 1, 0).reshape(N, -1), axis=1)
    if ranked.shape[1] > MOST_MOVED:
        least = np.maximum(least, ranked[:, MOST_MOVED])
    found = []
    for each, (p, r, alone) in zip(score, kinds, strict=True):
        j, q = np.nonzero(each > least[:, None])
        found.append((j, _moved_current(draws, j, q, p, r, alone=alone)))
    vehicle = np.concatenate([j for j, _ in found])
    order, more = np.argsort(vehicle, kind="stable"), np.bincount(vehicle, minlength=N)
    number = fits.number + more
    place = np.repeat(fits.number - np.cumsum(more) + more, more) + np.arange(len(vehicle))  # behind those that are
    extended: dict[str, Any] = {}
    for name, values in _by_explanation(draws).items():
        longer = np.zeros((N, max(number.max(), values.shape[1]), *values.shape[2:]), values.dtype)
        longer[:, : values.shape[1]] = values
        longer[vehicle[order], place] = np.concatenate([new[name] for _, new in found])[order]
        extended[name] = longer
    values, place, base = (extended.pop(name) for name in ("values", "place", "base"))
    return draws._replace(fits=Fits(number=number, **extended), values=values, place=place, base=base)


def _by_explanation(draws: Draws) -> dict[str, NDArray[Any]]:
    """Return the arrays of draws and of their fits that have an entry for each explanation, shape (N, Q, ...)."""
    of_fits = {name: values for name, values in draws.fits._asdict().items() if name != "number"}
    return {**of_fits, "values": draws.values, "place": draws.place, "base": draws.base}


def _zero_sum(fits: Fits, j: Integers, q: Integers, p: int, r: int) -> tuple[Array, Array]:
    """Return what log evidence n explanations (j, q) gain if the offsets of p and r sum to zero, and the regression.

    Shapes (n,) and (n, P): in the draws of an explanation the sum is normal, and if it is zero each parameter is what
    regression on it leaves.
    """
    K, theta, root = fits.theta.shape[2] // 3, fits.theta[j, q], fits.root[j, q]
    of_sum, root_sum = theta[:, 2 * K + p] + theta[:, 2 * K + r], root[:, 2 * K + p] + root[:, 2 * K + r]
    variance = np.maximum(np.sum(root_sum**2, axis=1), TINY)
    gained = -0.5 * (of_sum**2 / variance + np.log(variance / WIDE_SD**2))
    return gained, np.einsum("npi,ni->np", root, root_sum) / variance[:, None]


def _moved_current(draws: Draws, j: Integers, q: Integers, p: int, r: int, *, alone: bool) -> dict[str, NDArray[Any]]:
    """Make explanations in which a current is moved from branch p to r, ``alone`` or beside an offset of sensor p.

    They are made from the n explanations (j, q); returned is what :func:`_by_explanation` does, shape (n, ...).
    """
    K, new = draws.values.shape[3] // 3, {name: values[j, q] for name, values in _by_explanation(draws).items()}
    offset_p, offset_r, hardware_p, hardware_r = 2 * K + p, 2 * K + r, K + 1 + p, K + 1 + r
    gained, share = _zero_sum(draws.fits, j, q, p, r) if alone else (np.zeros(len(j)), np.zeros((len(j), 3 * K + 1)))
    gain_p, gain_r = (np.exp(new["values"][:, :, 1 + k] + draws.shared[K + k]) for k in (p, r))
    for offset, gain in ((offset_p, gain_p), (offset_r, gain_r)):  # without one it is two faults equal by chance
        new["base"][np.abs(new["values"][:, :, offset] * gain) < TAIL_RANGE[0]] = -np.inf

    def move(x: Array) -> tuple[Array, Array]:
        """Move the current in parameters x (n, P, ...); return the offset that is left in p, and what is moved."""
        x -= share[:, :, None] * (x[:, offset_p] + x[:, offset_r])[:, None]
        left, moved = (0.0 if alone else 1.0) * (x[:, offset_p] + x[:, offset_r]), x[:, offset_r].copy()
        x[:, offset_p], x[:, offset_r] = left, 0.0
        x[:, hardware_p] -= moved
        x[:, hardware_r] += moved
        return left, moved

    move(new["theta"][:, :, None])
    move(new["root"])
    left, moved = move(np.swapaxes(new["values"], 1, 2))
    new["hardware"] += 1
    new["sensor"] -= 1 + alone
    new["log_evidence"] += gained
    # sizes of offsets are in measured currents, those of the hardware in true ones
    new["base"] += gained[:, None] - np.log(gain_r)
    if alone:  # one sign less; and the wide Gaussian of the sum is taken out
        new["base"] += log(2.0) - log(WIDE_SD) - LOG_ROOT_TAU - np.log(gain_p)
    slot = np.arange(len(j)), np.where(new["support"][:, hardware_r], hardware_p, hardware_r)
    support, place = new["support"], np.swapaxes(new["place"], 1, 2)
    support[:, offset_p], support[:, offset_r], support[slot] = not alone, False, True
    place[:, offset_p] = NO_SIZE if alone else np.searchsorted(BETWEEN, np.abs(left * gain_p))
    place[:, offset_r], place[slot] = NO_SIZE, np.searchsorted(BETWEEN, np.abs(moved))
    return new


@inner
def _terms(
    draws: Draws, prior: "_Tables", j: int, q: int, m: int, places: Integers, kinds: Integers
) -> tuple[float, int]:
    """Return a draw's log weight, still without the densities of its fault sizes, and the number n of these sizes.

    Their places and kinds are filled in. Offset and load of the feeding branch are left to :func:`_feeding`.
    """
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
    """Return the log prior of the feeding branch's constant in group g (0: no group), and n, one more if it has a size.

    It is -inf if the draw is impossible in the group.
    """
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
        places[n], kinds[n] = _place(abs(own)), OFFSET  # its own fault beside what the group shares
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
    """Weight the draws by a prior, equation (M17) of docs/method.md.

    Parameters
    ----------
    draws : Draws
        Draws of N vehicles.
    prior : Prior
        Prior of their fleet, with g groups.

    Returns
    -------
    weight : ndarray of shape (N, Q, M, 1 + g)
        Posterior probability of each draw with the vehicle in no group, and in each group; sums to 1 for a vehicle.
    log_evidence : ndarray of shape (N,)
        Logarithm of the probability density of each vehicle's rows.
    """
    return _weighed(draws, prior)[:2]


def _weighed(draws: Draws, prior: Prior) -> tuple[Array, Array, NDArray[np.int16]]:
    """Return what :func:`weigh` does, and the place of the feeding sensor's offset, shape (N, Q, M, 1 + g)."""
    weight = np.zeros((*draws.base.shape, 1 + len(prior.group_share)))
    log_evidence, place = np.empty(len(weight)), np.full(weight.shape, NO_SIZE, np.int16)
    _weigh(draws, _tables(prior), weight, log_evidence, place)
    return weight, log_evidence, place


@compiled
def _weigh(draws: Draws, prior: _Tables, weight: Array, log_evidence: Array, feeding: NDArray[np.int16]) -> None:
    """Fill the last three arguments with what :func:`_weighed` returns."""
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
                    if last > n and kinds[n] == OFFSET:
                        feeding[j, q, m, g] = places[n]
                    weight[j, q, m, g] = value
                    best = max(best, value)
        weight[j, :count] = np.exp(weight[j, :count] - best)
        total = weight[j, :count].sum()
        weight[j, :count] /= total
        log_evidence[j] = best + log(total / M)


class FaultSizes(NamedTuple):
    """Sizes of the faults of one kind in the D weighted draws of a fleet that matter, vehicle after vehicle.

    Attributes
    ----------
    place : ndarray of int of shape (D, n)
        Places of the sizes in :data:`~calibrator.estimator.prior.GRID`, filled up with :data:`NO_SIZE`.
    weight : ndarray of shape (D,)
        Weights of the draws.
    first : ndarray of int
        Index of the first of the D draws of each vehicle that has any.
    log_density : ndarray of shape (G,)
        Logarithm of the density of sizes in the prior by which the draws are weighted.
    """

    place: Integers
    weight: Array
    first: Integers
    log_density: Array

    def evidence(self, densities: Array) -> Array:
        """Return the log evidence of the fleet for other densities (C, G) of these sizes, up to a constant, (C,)."""
        change = np.pad((np.log(densities) - self.log_density).T, ((0, 1), (0, 0)))
        log_factor = sum(change[place] for place in self.place.T)
        return np.asarray(np.log(np.add.reduceat(self.weight[:, None] * np.exp(log_factor), self.first)).sum(axis=0))


def fault_sizes(draws: Draws, prior: Prior, kind: int, *, every: int = 4) -> FaultSizes:
    """Collect the sizes of drifts or offsets in the draws of a fleet, and their weights by a prior.

    Parameters
    ----------
    draws, prior : Draws, Prior
        Draws and prior of the fleet.
    kind : int
        :data:`GAIN` or :data:`OFFSET`.
    every : int
        Only every n-th draw of an explanation is used, for n = ``every``.

    Returns
    -------
    FaultSizes
        Sizes in draws that are not negligible with any density.
    """
    weight, _, feeding = _weighed(draws, prior)
    at = ParameterPlaces(prior.branches)
    vehicle, q, m, g = np.nonzero(weight[:, :, ::every] > NEGLIGIBLE)
    m *= every
    place = draws.place[vehicle, q, m].astype(np.int64)
    place[:, at.offset(draws.feed)] = feeding[vehicle, q, m, g]
    of_kind = place[:, : at.hardware_offsets.start] if kind == GAIN else place[:, at.hardware_offsets.start : at.load]
    of_kind = np.sort(of_kind, axis=1)
    most = int((of_kind < NO_SIZE).sum(axis=1).max(initial=1))
    first = np.flatnonzero(np.diff(vehicle, prepend=-1))
    return FaultSizes(of_kind[:, :most], weight[vehicle, q, m, g], first, prior.log_density[kind])


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Model spread: how vehicles without any fault are distributed in the rows of the evidence.

    Attributes
    ----------
    mean : ndarray of shape (5K,)
        Centre of each row: remaining error of the fleet model, and mean unmeasured load. [1]
    covariance : ndarray of shape (5K, 5K)
        Covariance over the vehicles. [1]
    dispersion : ndarray of shape (K,)
        Actual variance of each intercept over that expected from its blocks, at least 1: errors of a model last longer
        than a block.
    shared : ndarray of shape (2K + 1,)
        What all sensors of a branch share, see :class:`calibrator.estimator.posterior.Evidence`.
    """

    mean: Array
    covariance: Array
    dispersion: Array
    shared: Array

    def of_rows(self, rows: EvidenceRows) -> Array:
        """Return the covariance of rows of vehicles without faults, sampling errors included, shape (N, 5K, 5K)."""
        return rows.dispersed(self.dispersion)[0] + self.covariance


@dataclass(frozen=True, kw_only=True)
class FaultModel:
    """One fault model that explains a fleet: how vehicles without faults differ, and which faults there are.

    Attributes
    ----------
    probability : float
        Probability of this model among all that are kept.
    spread : Spread
        Model spread of vehicles without faults.
    priors : tuple of (float, Prior)
        All priors of the faults that explain the fleet nearly as well as the best one, with their probabilities; the
        first is the best.
    log_evidence : float
        Log evidence of the vehicles that it was learnt from.
    """

    probability: float = 1.0
    spread: Spread
    priors: tuple[tuple[float, Prior], ...]
    log_evidence: float = field(default=-np.inf)

    @property
    def prior(self) -> Prior:
        """The best prior."""
        return self.priors[0][1]


def explain(rows: EvidenceRows, model: FaultModel, *, feed: int) -> Draws:
    """Explain vehicles with the best prior and the model spread of a fault model; their draws are not weighted yet.

    Where even the best explanation of a vehicle fits badly, its covariance is multiplied by chi square over the degrees
    of freedom (Birge ratio): something about it is not in the model, and nothing is known as well as it seems.
    """
    prior, spread = model.prior, model.spread
    n_h, n_s = np.indices(prior.counts.shape)
    rough = prior.log_supports + 0.5 * (n_h + n_s)  # a slab is about that much denser than the wide Gaussian
    log_load = float(np.log(prior.load_share + prior.group_share.sum())) + 2.0
    covariance = spread.of_rows(rows)

    def fitted(covariance: Array) -> Draws:
        evidence = evidence_of(rows.values, covariance, rows.means, centre=spread.mean, shared=spread.shared, feed=feed)
        return draw_explanations(fit_explanations(evidence, rough, log_load), evidence)

    draws = fitted(covariance)
    fits = draws.fits
    score = fits.log_evidence + rough[fits.hardware, fits.sensor] + log_load * fits.support[:, :, -1]
    best = np.argmax(np.where(np.arange(score.shape[1]) < fits.number[:, None], score, -np.inf), axis=1)
    picked = (np.arange(len(rows)), best)
    free = np.maximum(rows.known.sum(axis=1) - fits.support[picked].sum(axis=1), 1.0)
    bad = fits.chi2[picked] > free + MISFIT_SD * np.sqrt(2.0 * free)
    if bad.any():
        wider = (fits.chi2[picked] / free)[:, None, None]
        draws = fitted(np.where(bad[:, None, None], wider, 1.0) * covariance)
    return _with_moved_currents(draws, rough, log_load, rows.known[:, rows.places.offset_reads])
