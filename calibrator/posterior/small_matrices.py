"""Gaussian algebra on matrices of a few rows, and masses of a normal distribution; compiled."""

import math

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import inner
from calibrator.drive import Array
from calibrator.posterior.slab import LEAST_DEVIATION, NEVER

__all__ = [
    "LOG_2PI",
    "cholesky",
    "inverse",
    "log_mass",
    "normal_form",
    "normal_mass",
    "positive_quadratic",
    "quadratic",
    "solution",
    "sort_falling",
    "variances",
]

LOG_2PI = float(np.log(2.0 * np.pi))
TINY_PIVOT = 1e-150
"""Instead of a pivot that rounding made negative."""
SMALL, LARGE = 1e-150, 1e150
"""Between these a product of pivots is still a number after one more; beyond them its logarithm is taken first."""
_ROOT_HALF = math.sqrt(0.5)
_LEAST_MASS = float(np.finfo(float).tiny)


@inner
def cholesky(A: Array, active: NDArray[np.int64], count: int, L: Array) -> float:
    """Factor the rows and columns ``active[:count]`` of A into L L^T, in place; the logarithm of their determinant."""
    log_determinant, product = 0.0, 1.0
    for i in range(count):
        row = active[i]
        for j in range(i + 1):
            total = A[row, active[j]]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                total = max(total, TINY_PIVOT)
                L[i, i] = math.sqrt(total)
                if not SMALL < product < LARGE:
                    log_determinant += math.log(product)
                    product = 1.0
                product *= total
            else:
                L[i, j] = total / L[j, j]
    return log_determinant + math.log(product)


@inner
def quadratic(L: Array, b: Array, count: int, z: Array) -> float:
    """b^T (L L^T)^-1 b; z becomes L^-1 b."""
    squared = 0.0
    for i in range(count):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * z[k]
        z[i] = total / L[i, i]
        squared += z[i] * z[i]
    return squared


@inner
def solution(L: Array, z: Array, count: int, x: Array) -> None:
    """X becomes L^-T z, the solution of L L^T x = b if z is L^-1 b."""
    for i in range(count - 1, -1, -1):
        total = z[i]
        for k in range(i + 1, count):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]


@inner
def inverse(L: Array, count: int, work: Array, C: Array) -> None:
    """C becomes (L L^T)^-1; ``work`` is of the same shape."""
    for j in range(count):
        for i in range(j, count):
            total = 1.0 if i == j else 0.0
            for k in range(j, i):
                total -= L[i, k] * work[k, j]
            work[i, j] = total / L[i, i]
    for i in range(count):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, count):
                total += work[k, i] * work[k, j]
            C[i, j] = C[j, i] = total


@inner
def variances(L: Array, count: int, work: Array, out: Array) -> None:
    """``out`` becomes the diagonal of (L L^T)^-1."""
    for j in range(count):
        out[j] = 0.0
        for i in range(j, count):
            total = 1.0 if i == j else 0.0
            for k in range(j, i):
                total -= L[i, k] * work[k, j]
            work[i, j] = total / L[i, i]
            out[j] += work[i, j] * work[i, j]


@inner
def normal_form(X: Array, R: Array, y: Array, work: Array, A: Array, b: Array) -> float:
    """A becomes X^T R X and b becomes X^T R y, R the precision; y^T R y. ``work`` has at least the shape of X."""
    rows, P = X.shape
    for q in range(P):
        for r in range(rows):
            work[r, q] = 0.0
        for s in range(rows):
            if X[s, q] != 0.0:
                for r in range(rows):
                    work[r, q] += R[r, s] * X[s, q]
        b[q] = 0.0
        for r in range(rows):
            b[q] += work[r, q] * y[r]
        for p in range(q + 1):
            total = 0.0
            for r in range(rows):
                if X[r, p] != 0.0:
                    total += X[r, p] * work[r, q]
            A[p, q] = A[q, p] = total
    c = 0.0
    for r in range(rows):
        for s in range(rows):
            c += y[r] * R[r, s] * y[s]
    return c


@inner
def sort_falling(values: Array, order: NDArray[np.int64], count: int, work: NDArray[np.int64]) -> None:
    """Put the first so many positions in order of falling values; equal ones keep theirs; ``work`` is as long."""
    width = 1
    while width < count:
        for begin in range(0, count, 2 * width):
            middle, end = min(begin + width, count), min(begin + 2 * width, count)
            i, j = begin, middle
            for k in range(begin, end):
                if j >= end or (i < middle and values[order[i]] >= values[order[j]]):
                    work[k] = order[i]
                    i += 1
                else:
                    work[k] = order[j]
                    j += 1
        for k in range(count):
            order[k] = work[k]
        width *= 2


@inner
def normal_mass(low: float, high: float) -> float:
    """Of a standard normal variable between two values, the first of which is the smaller one."""
    if low > 0.0:
        low, high = -high, -low
    return 0.5 * (math.erfc(-high * _ROOT_HALF) - math.erfc(-low * _ROOT_HALF))


@inner
def log_mass(mean: float, sd: float, low: float, high: float, smaller: float) -> float:
    """As :meth:`calibrator.posterior.slab.Slab.log_mass`, of one value."""
    spread, magnitude, density = max(sd, LEAST_DEVIATION), abs(mean), 0.5 * (1.0 - smaller) / (high - low)
    if low + NEVER * spread < magnitude < high - NEVER * spread:
        return math.log(density)
    mass = normal_mass((low - magnitude) / spread, (high - magnitude) / spread)
    if spread * NEVER > low + magnitude:
        mass += normal_mass((low + magnitude) / spread, (high + magnitude) / spread)
    mass = max(mass, _LEAST_MASS) * density
    if smaller > 0.0:
        mass += normal_mass((-low - magnitude) / spread, (low - magnitude) / spread) * 0.5 * smaller / low
    return math.log(mass)


@inner
def positive_quadratic(square: float, linear: float, constant: float, mean: float, sd: float) -> float:
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
