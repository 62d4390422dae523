"""Explanations of a vehicle's evidence: which of its parameters are not zero, and how well each choice fits.

The P = 3K + 1 parameters of a vehicle with K branches, in the symbols of docs/method.md and with the names of
:class:`calibrator.estimator.rows.ParameterPlaces`:

    0            eta               eta = log(1 + d_h)             hardware
    1 .. K       gains             lambda_k = log(1 + d_k)        gain of sensor k
    K+1 .. 2K-1  hardware_offsets  o_h,k, all k but the last      hardware
    2K .. 3K-1   offsets           omega_k = o_k / (1 + d_k)      offset of sensor k as seen in true currents
    3K           load              l                              load without a sensor, carried by the feeding branch

The 5K rows, with the names of :class:`calibrator.estimator.rows.RowPlaces`; branches are counted from 0:

    0 .. K-1      slopes           3K-1 .. 4K-2  intercepts
    K .. 2K-2     ratios           4K-1          junction
    2K-1 .. 3K-2  gain_reads       4K .. 5K-1    offset_reads

Offsets and loads are in fractions of full scale. A support is the set of parameters that are not zero. Every support is
fitted by Gauss-Newton steps on the evidence rows (M11), under a wide Gaussian prior (M12); the prior that is meant
comes in later (:mod:`calibrator.estimator.posterior`). The loops are compiled by numba: tuples of arrays go in, arrays
are filled, and rows and parameters go by these numbers.
"""

from math import exp, expm1, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled_with_notice, inner
from calibrator.drive import Array, Mask
from calibrator.estimator.rows import parameter_places, row_places

Integers = NDArray[np.int64]

__all__ = ["WIDE_SD", "Evidence", "Fits", "evidence_of", "fit_explanations", "residual", "row_residuals"]

WIDE_SD = 0.4
"""Standard deviation of the wide Gaussian under which every support is fitted. [1]"""
MARGIN = 12.0
"""Logarithm of the weight below the best one from which on a support is not fitted any further."""
MOST_FITTED = 96
"""Supports of a vehicle that are kept, the most probable ones."""
MOST_PARAMETERS = 6
"""Largest number of parameters of a support; 20 faults of a hundred parameters leave few vehicles with more."""
MOST_TURN = 3.0
"""Largest logarithm by which a measured ratio can be off. [1]"""
LOWEST, HIGHEST, STEP = -2.5, 1.2, 0.5
"""Range of a parameter, and the longest step of one iteration: gains from 0.08 to 3.3. [1]"""
MOST_STEPS, LAST_STEP = 7, 1e-7
"""Gauss-Newton steps, and the size of a step that is the last one: far below what any row shows. [1]"""


class Evidence(NamedTuple):
    """Evidence rows of N vehicles, and those of a vehicle without faults.

    Attributes
    ----------
    values : ndarray of shape (N, 5K)
        Rows, relative ones first. [1]
    means : ndarray of shape (N, 2, K)
        Means of the fleet model's and of the measured currents, about which the lines of the constants pivot. [1]
    centre : ndarray of shape (5K,)
        Of the rows of vehicles without faults. [1]
    shared : ndarray of shape (2K + 1,)
        What all sensors of a branch share: offsets, in fractions of full scale, which the centre holds, and logarithms
        of gains; last 1 if what a group of vehicles shares is an offset of the feeding sensor, 0 if it is a load. An
        offset does not grow with the current: seen through a gain error it is another one, and a load is not (M16).
    precision, precision_relative : ndarray of shape (N, 5K, 5K) and (N, 3K - 1, 3K - 1)
        Inverse covariance of all rows, and of the relative rows alone.
    log_scale : ndarray of shape (N,)
        Logarithm of the probability density of the rows of a vehicle that are all at the centre.
    feed : int
        Branch that carries a load without a sensor.
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
        Number of explanations of each vehicle; what stands behind them in the other arrays means nothing.
    support : ndarray of bool of shape (N, Q, P)
        Which parameters are not zero.
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
    """Evidence with the inverses of its covariance (N, 5K, 5K); the other parameters as in :class:`Evidence`."""
    rows = values.shape[1]
    relative = row_places(rows // 5).relative
    precision = np.linalg.inv(covariance)
    return Evidence(
        values=np.ascontiguousarray(values),
        means=np.ascontiguousarray(means),
        centre=centre,
        shared=shared,
        precision=precision,
        precision_relative=np.linalg.inv(covariance[:, relative, relative]),
        log_scale=0.5 * (np.linalg.slogdet(precision)[1] - rows * np.log(2.0 * np.pi)),
        feed=feed,
    )


def fit_explanations(evidence: Evidence, log_prior: Array, log_load: float) -> Fits:
    """Fit the supports that may matter.

    Parameters
    ----------
    evidence : Evidence
        Of N vehicles.
    log_prior : ndarray of shape (K + 1, 2K + 1)
        Logarithm of the prior probability of one support with so many hardware and sensor faults, roughly: it decides
        which supports are looked at closely.
    log_load : float
        The same of a load without a sensor.

    Returns
    -------
    Fits
        The most probable supports of each vehicle.
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
    _fit_all(evidence, log_prior, log_load, fits)
    at, on = parameter_places(K), fits.support
    fits.hardware[:] = on[:, :, at.eta] + on[:, :, at.hardware_offsets].sum(axis=2)
    fits.sensor[:] = on[:, :, at.gains].sum(axis=2) + on[:, :, at.offsets].sum(axis=2)
    most = max(int(fits.number.max(initial=1)), 1)
    kept = {name: np.ascontiguousarray(values[:, :most]) for name, values in fits._asdict().items() if name != "number"}
    return fits._replace(**kept)


def row_residuals(evidence: Evidence, theta: Array) -> Array:
    """What parameters (N, Q, P) leave of the rows of N vehicles, shape (N, Q, 5K)."""
    left = np.empty((*theta.shape[:2], evidence.values.shape[1]))
    _all_residuals(evidence, theta, left)
    return left


@compiled_with_notice
def _all_residuals(evidence: Evidence, theta: Array, left: Array) -> None:
    for j in range(theta.shape[0]):
        for q in range(theta.shape[1]):
            residual(theta[j, q], evidence, j, left[j, q])


@inner
def residual(theta: Array, evidence: Evidence, j: int, e: Array) -> None:
    """Fill e with the rows of vehicle j less what parameters make of them, (M11)."""
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
        batch = shared[k] * (unit - 1.0)  # of what the centre holds
        e[c + k] = seen - centre[c + k] - hardware - theta[2 * K + k] - batch
        e[c + K + 1 + k] = y[c + K + 1 + k] * unit - centre[c + K + 1 + k] - theta[2 * K + k]
        junction -= theta[2 * K + k] + batch
        if k:
            x = e[K + k - 1]
            junction -= means[1, k] * (unit * expm1(min(x, MOST_TURN)) - exp(-y[k]) * x)
    load = theta[3 * K] * (exp(-theta[1 + feed] - shared[K + feed]) if shared[2 * K] else 1.0)
    e[c + K] = junction - centre[c + K] - load
    e[c + feed] -= load


@inner
def _design(theta: Array, evidence: Evidence, j: int, e: Array, A: Array) -> None:
    """Fill A with minus the derivative of :func:`residual` by the parameters, at a residual e."""
    y, means, shared, feed = evidence.values[j], evidence.means[j], evidence.shared, evidence.feed
    K = len(y) // 5
    c = 3 * K - 1
    A[:] = 0.0
    A[c + K, 1] = y[c + K] * exp(-theta[1] - shared[K])
    for k in range(K):
        A[k, 0] = A[k, 1 + k] = A[2 * K - 1 + k, 1 + k] = 1.0
        unit = exp(-theta[1 + k] - shared[K + k])
        turn = exp(theta[0]) * exp(min(e[k], MOST_TURN))
        A[c + k, 0] = means[0, k] * (exp(theta[0]) - 1.0)
        A[c + k, 1 + k] = (y[c + k] - shared[k]) * unit + means[0, k] * (turn - 1.0)
        A[c + K, 1 + k] -= shared[k] * unit
        A[c + K + 1 + k, 1 + k] = y[c + K + 1 + k] * unit
        A[c + k, 2 * K + k] = A[c + K, 2 * K + k] = A[c + K + 1 + k, 2 * K + k] = 1.0
        if k < K - 1:
            A[c + k, K + 1 + k] = 1.0
            A[c + K - 1, K + 1 + k] = -1.0
        if k:
            row = K + k - 1
            A[row, 1], A[row, 1 + k] = 1.0, -1.0
            A[c + K, 1] -= means[1, k] * (unit * exp(min(e[row], MOST_TURN)) - exp(-y[k]))
            A[c + K, 1 + k] -= means[1, k] * (exp(-y[k]) - unit)
    scale = exp(-theta[1 + feed] - shared[K + feed]) if shared[2 * K] else 1.0
    A[c + feed, 3 * K] = A[c + K, 3 * K] = scale
    if shared[2 * K]:
        A[c + feed, 1 + feed] -= theta[3 * K] * scale
        A[c + K, 1 + feed] -= theta[3 * K] * scale


@inner
def _normal_equations(
    precision: Array, A: Array, e: Array, theta: Array, chosen: Integers, n: int, H: Array, g: Array, work: Array
) -> float:
    """H = A' precision A + 1 / sd^2 and g = A' precision e - theta / sd^2 of n chosen columns; returns chi2."""
    rows = len(e)
    chi2 = 0.0
    for r in range(rows):
        total = 0.0
        for s in range(rows):
            total += precision[r, s] * e[s]
        work[0, r] = total
        chi2 += total * e[r]
    for i in range(n):
        p = chosen[i]
        for r in range(rows):
            total = 0.0
            for s in range(rows):
                total += precision[r, s] * A[s, p]
            work[1, r] = total
        for j in range(i + 1):
            total = 0.0
            for r in range(rows):
                total += work[1, r] * A[r, chosen[j]]
            H[i, j] = total
        H[i, i] += WIDE_SD**-2
        total = 0.0
        for r in range(rows):
            total += A[r, p] * work[0, r]
        g[i] = total - theta[p] / WIDE_SD**2
    return float(chi2)


@inner
def _append(H: Array, g: Array, order: Integers, n: int, L: Array, w: Array) -> float:
    """Add row order[n] of H to the Cholesky factor L; returns half the square of the new component of L^-1 g."""
    i = order[n]
    for a in range(n + 1):
        j = order[a]
        total = H[i, j] if i >= j else H[j, i]
        for b in range(a):
            total -= L[n, b] * L[a, b]
        L[n, a] = total / L[a, a] if a < n else sqrt(max(total, 1e-300))
    total = g[i]
    for b in range(n):
        total -= L[n, b] * w[b]
    w[n] = total / L[n, n]
    return float(0.5 * w[n] ** 2)


@inner
def _solve(H: Array, g: Array, order: Integers, n: int, L: Array, w: Array) -> None:
    """Fill w with the solution of H w = g, and L with the Cholesky factor of H; order becomes 0 .. n - 1."""
    for a in range(n):
        order[a] = a
        _append(H, g, order, a, L, w)
    for a in range(n - 1, -1, -1):
        for b in range(a + 1, n):
            w[a] -= L[b, a] * w[b]
        w[a] /= L[a, a]


@compiled_with_notice
def _fit_all(evidence: Evidence, log_prior: Array, log_load: float, fits: Fits) -> None:
    P = fits.theta.shape[2]
    scores: Array = np.empty(1 << 14)
    codes: Integers = np.empty(1 << 14, np.int64)
    for j in range(len(evidence.values)):
        found, scores, codes = _score(evidence, j, log_prior, log_load, scores, codes)
        kept = np.flatnonzero(scores[:found] > scores[:found].max() - MARGIN)
        kept = kept[np.argsort(-scores[kept])][: fits.theta.shape[1]]
        fits.number[j] = len(kept)
        for q in range(len(kept)):
            for p in range(P):
                fits.support[j, q, p] = (codes[kept[q]] >> p) & 1
            fits.log_evidence[j, q], fits.chi2[j, q] = _refine(
                evidence, j, fits.support[j, q], fits.theta[j, q], fits.root[j, q]
            )
            fits.log_evidence[j, q] += evidence.log_scale[j]


@inner
def _score(
    evidence: Evidence, j: int, log_prior: Array, log_load: float, scores: Array, codes: Integers
) -> tuple[int, Array, Integers]:
    """Rough log weights of the supports that may matter: constants linear about the gains that the relative rows tell.

    Constant parameters are added one at a time to a Cholesky factor, depth first, so that a support costs one row of
    it; a branch of the search ends where even all constant parameters together could not make it matter.
    """
    K, feed, most = evidence.values.shape[1] // 5, evidence.feed, MOST_PARAMETERS
    P, R, first = 3 * K + 1, 3 * K - 1, K + 1
    e, A, theta = np.zeros(5 * K), np.zeros((5 * K, P)), np.zeros(P)
    H, g, work = np.zeros((P, P)), np.zeros(P), np.zeros((2, 5 * K))
    L, w, chosen, order = np.zeros((P, P)), np.zeros(P), np.zeros(P, np.int64), np.zeros(P, np.int64)
    gain, logdet = np.zeros(P + 1), np.zeros(P + 1)
    hardware, sensor, load = np.zeros(P + 1, np.int64), np.zeros(P + 1, np.int64), np.zeros(P + 1, np.int64)
    best, found, log_wide = -np.inf, 0, log(WIDE_SD)
    for mask in range(1 << (K + 1)):
        n = 0
        for i in range(K + 1):
            if (mask >> i) & 1:
                chosen[n] = i
                n += 1
        if n > most:
            continue
        theta[:] = 0.0
        residual(theta, evidence, j, e)
        _design(theta, evidence, j, e, A)
        _normal_equations(evidence.precision_relative[j], A[:R], e[:R], theta, chosen, n, H, g, work)
        _solve(H, g, order, n, L, w)
        for a in range(n):
            theta[chosen[a]] = min(max(w[a], LOWEST), HIGHEST)
        residual(theta, evidence, j, e)
        _design(theta, evidence, j, e, A)
        for i in range(first, P):
            chosen[n + i - first] = i
        columns = n + P - first
        start = -0.5 * _normal_equations(evidence.precision[j], A, e, theta, chosen, columns, H, g, work)
        for a in range(n):
            start -= 0.5 * (theta[chosen[a]] / WIDE_SD) ** 2
        gain[0] = logdet[0] = 0.0
        for a in range(columns):  # all constant parameters together
            order[a] = a
            gain[a + 1] = gain[a] + _append(H, g, order, a, L, w)
            if a < n:
                logdet[a + 1] = logdet[a] + log(L[a, a])
        everything = gain[columns]
        hardware[0] = mask & 1
        sensor[0] = n - hardware[0]
        load[0] = 0
        depth, following = 0, n
        evaluate = True
        while True:
            if evaluate:
                m = n + depth
                score = start + gain[m] - logdet[m] - m * log_wide + log_prior[hardware[depth], sensor[depth]]
                score += log_load * load[depth]
                if found == len(scores):
                    scores = np.append(scores, np.empty(found))
                    codes = np.append(codes, np.empty(found, np.int64))
                code = mask
                for a in range(depth):
                    code |= 1 << chosen[order[n + a]]
                scores[found], codes[found] = score, code
                found += 1
                best = max(best, score)
                if score + everything - gain[m] < best - MARGIN - 3.0:
                    following = columns  # no descent from here
            evaluate = False
            if following < columns and n + depth < most:
                p = chosen[following]
                if p == 3 * K and _holds(order, n, depth, chosen, 2 * K + feed):
                    following += 1  # an offset of the feeding sensor and a load look the same
                    continue
                order[n + depth] = following
                m = n + depth
                gain[m + 1] = gain[m] + _append(H, g, order, m, L, w)
                logdet[m + 1] = logdet[m] + log(L[m, m])
                hardware[depth + 1] = hardware[depth] + (p < 2 * K)
                sensor[depth + 1] = sensor[depth] + (2 * K <= p < 3 * K)
                load[depth + 1] = load[depth] + (p == 3 * K)
                depth += 1
                following += 1
                evaluate = True
            else:
                if depth == 0:
                    break
                depth -= 1
                following = order[n + depth] + 1
    return found, scores, codes


@inner
def _holds(order: Integers, n: int, depth: int, chosen: Integers, parameter: int) -> bool:
    for a in range(depth):
        if chosen[order[n + a]] == parameter:
            return True
    return False


@inner
def _refine(evidence: Evidence, j: int, support: Mask, theta: Array, root: Array) -> tuple[float, float]:
    """Gauss-Newton on all rows; fills theta and root, returns log evidence and chi2."""
    K = evidence.values.shape[1] // 5
    P = 3 * K + 1
    e, A = np.zeros(5 * K), np.zeros((5 * K, P))
    H, g, work = np.zeros((P, P)), np.zeros(P), np.zeros((2, 5 * K))
    L, w, chosen, order = np.zeros((P, P)), np.zeros(P), np.flatnonzero(support), np.arange(P)
    n, chi2 = len(chosen), 0.0
    theta[:] = 0.0
    root[:] = 0.0
    for _ in range(MOST_STEPS):
        residual(theta, evidence, j, e)
        if n:
            _design(theta, evidence, j, e, A)
        chi2 = _normal_equations(evidence.precision[j], A, e, theta, chosen, n, H, g, work)
        _solve(H, g, order, n, L, w)
        if n == 0 or np.abs(w[:n]).max() < LAST_STEP:
            break
        for a in range(n):
            p = chosen[a]
            theta[p] = min(max(theta[p] + min(max(w[a], -STEP), STEP), LOWEST), HIGHEST)
    value = -0.5 * chi2
    for a in range(n):
        value -= 0.5 * (theta[chosen[a]] / WIDE_SD) ** 2 + log(WIDE_SD) + log(L[a, a])
        for b in range(a, -1, -1):  # rows of L^-1, whose transpose is the root of the covariance
            total = 1.0 if a == b else 0.0
            for i in range(b, a):
                total -= L[a, i] * root[chosen[b], chosen[i]]
            root[chosen[b], chosen[a]] = total / L[a, a]
    return value, chi2
