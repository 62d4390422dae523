"""Algebra on a few rows as numpy and scipy say, at the ends of floating point as well."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from calibrator.compiled import in_place
from calibrator.drive import Array
from calibrator.posterior.slab import Slab
from calibrator.posterior.small_matrices import (
    cholesky,
    inverse,
    log_mass,
    normal_form,
    normal_mass,
    positive_quadratic,
    quadratic,
    solution,
    sort_falling,
    variances,
)

SIZE = 7
"""Of the room, which is larger than what is worked on."""
ACTIVE = [5, 0, 3, 6, 2]


@in_place
def solve(
    A: Array, active: NDArray[np.int64], count: int, b: Array, L: Array, z: Array, work: Array, C: Array, told: Array
) -> None:
    """``told`` becomes log determinant and b^T A^-1 b, then A^-1 b, and the diagonal of A^-1."""
    told[0, 0] = cholesky(A, active, count, L)
    told[0, 1] = quadratic(L, b, count, z)
    solution(L, z, count, told[1])
    inverse(L, count, work, C)
    variances(L, count, work, told[2])


@in_place
def form(X: Array, R: Array, y: Array, work: Array, A: Array, b: Array) -> float:
    return normal_form(X, R, y, work, A, b)


@in_place
def sort(values: Array, order: NDArray[np.int64], count: int, work: NDArray[np.int64]) -> None:
    sort_falling(values, order, count, work)


@in_place
def mass_between(low: float, high: float) -> float:
    return normal_mass(low, high)


@in_place
def log_mass_of(mean: float, sd: float, low: float, high: float, smaller: float) -> float:
    return log_mass(mean, sd, low, high, smaller)


@in_place
def positive_share(square: float, linear: float, constant: float, mean: float, sd: float) -> float:
    return positive_quadratic(square, linear, constant, mean, sd)


def solved(A: Array, active: list[int], b: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Log determinant and b^T A^-1 b, A^-1 b, variances, L, and A^-1; the rest of the room must be as it was."""
    L, work, C = (np.full((SIZE, SIZE), np.nan) for _ in range(3))
    z, told, n = np.full(SIZE, np.nan), np.full((3, SIZE), np.nan), len(active)
    solve(A, np.array([*active, 0], np.int64), n, b, L, z, work, C, told)
    for used in (z[n:], told[1:, n:], C[n:], C[:, n:], L[n:]):
        assert np.isnan(used).all()
    return told[0, :2], told[1, :n], told[2, :n], np.tril(L[:n, :n]), C[:n, :n]


@pytest.mark.parametrize("count", range(6))
def test_chosen_rows_and_columns_are_solved_as_numpy_does(count: int) -> None:
    rng = np.random.default_rng(count)
    mixing = rng.normal(size=(SIZE, SIZE))
    A, b, active = mixing @ mixing.T + 0.1 * np.eye(SIZE), rng.normal(size=SIZE), ACTIVE[:count]
    chosen = A[np.ix_(active, active)]
    told, x, variance, L, C = solved(A, active, b)
    expected = np.linalg.inv(chosen)
    np.testing.assert_allclose(told, [np.linalg.slogdet(chosen)[1], b[:count] @ expected @ b[:count]], rtol=1e-9)
    np.testing.assert_allclose(x, expected @ b[:count], rtol=1e-8)
    np.testing.assert_allclose(variance, np.diag(expected), rtol=1e-8)
    np.testing.assert_allclose(C, expected, rtol=1e-8)
    np.testing.assert_allclose(L, np.linalg.cholesky(chosen), rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-100, 1e-60, 1e60, 1e100])
def test_a_determinant_beyond_floating_point_still_has_its_logarithm(scale: float) -> None:
    """Exact readings of many parameters, or rows that say nothing: the product of the pivots is no number."""
    told = solved(np.diag(np.full(SIZE, scale)), ACTIVE, np.zeros(SIZE))[0]
    assert told[0] == pytest.approx(len(ACTIVE) * np.log(scale), rel=1e-12)


def test_a_pivot_that_rounding_made_negative_is_a_tiny_one() -> None:
    A = np.eye(SIZE)
    A[5, 5], A[5, 0], A[0, 5] = 1.0, 1.0 + 1e-15, 1.0 + 1e-15
    told, *_, L, _ = solved(A, [5, 0], np.zeros(SIZE))
    assert np.isfinite(L).all()
    assert told[0] < -300.0


def test_the_normal_form_is_that_of_matrix_products() -> None:
    rng = np.random.default_rng(1)
    X = np.array([[1.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.7, -1.3, 0.0], [1.0, 1.0, 1.0]])
    mixing, y = rng.normal(size=(4, 4)), rng.normal(size=4)
    R = mixing @ mixing.T
    work, A, b = np.full((SIZE, SIZE), np.nan), np.full((3, 3), np.nan), np.full(3, np.nan)
    assert form(X, R, y, work, A, b) == pytest.approx(y @ R @ y, rel=1e-12)
    np.testing.assert_allclose(A, X.T @ R @ X, rtol=1e-12)
    np.testing.assert_allclose(b, X.T @ R @ y, rtol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 7, 8, 9, 16, 21])
def test_positions_are_sorted_by_falling_values_and_equal_ones_keep_theirs(count: int) -> None:
    rng = np.random.default_rng(count)
    values, order = rng.integers(0, 6, size=30).astype(float), rng.permutation(30)
    expected = sorted(order[:count], key=lambda place: -values[place]) + list(order[count:])
    sort(values, order, count, np.full(30, -1))
    assert list(order) == expected


@pytest.mark.parametrize(
    ("low", "high"),
    [(-1.0, 2.0), (-0.3, 0.0), (0.0, 0.4), (0.5, 3.0), (8.0, 9.0), (-9.0, -8.0), (30.0, 31.0), (-31.0, -30.0)],
)
def test_the_mass_between_two_values_is_exact_in_both_tails(low: float, high: float) -> None:
    """A difference of two numbers next to 1 would be 0."""
    near, far = sorted((abs(low), abs(high)))
    expected = norm.cdf(high) - norm.cdf(low) if low * high < 0.0 else norm.sf(near) - norm.sf(far)
    assert mass_between(low, high) == pytest.approx(expected, rel=1e-12, abs=0.0)


def test_the_mass_beyond_a_value_reaches_to_infinity() -> None:
    assert mass_between(-np.inf, np.inf) == 1.0
    assert mass_between(5.0, np.inf) == pytest.approx(norm.sf(5.0), rel=1e-12, abs=0.0)
    assert mass_between(-np.inf, -5.0) == pytest.approx(norm.sf(5.0), rel=1e-12, abs=0.0)


@pytest.mark.parametrize("sd", [0.0, 1e-4, 0.004, 0.02, 0.1, 1.0, 30.0])
@pytest.mark.parametrize("slab", [Slab(0.05, 0.25), Slab(0.002, 0.45), Slab(0.05, 0.25, 0.01), Slab(0.002, 0.45, 0.4)])
def test_the_mass_of_one_value_is_that_of_the_slab(slab: Slab, sd: float) -> None:
    for mean in np.linspace(-0.5, 0.5, 42):
        expected = float(slab.log_mass(np.array(mean), np.array(sd)))
        told = log_mass_of(float(mean), sd, slab.low, slab.high, slab.smaller)
        assert told == pytest.approx(expected, abs=1e-6)


def share_of_draws(square: float, linear: float, constant: float, mean: float, sd: float) -> float:
    """Plainly, over equally probable values."""
    x = norm.ppf((np.arange(20_000) + 0.5) / 20_000, mean, sd)
    return float(np.mean((square * x + linear) * x + constant > 0.0))


@pytest.mark.parametrize("square", [-1.5, 0.0, 1.5])
@pytest.mark.parametrize("linear", [-2.0, 0.0, 2.0])
@pytest.mark.parametrize("constant", [-0.8, 0.0, 0.3, 4.0])
@pytest.mark.parametrize(("mean", "sd"), [(0.0, 1.0), (0.7, 0.5), (-0.9, 2.0)])
def test_a_quadratic_is_positive_on_the_share_of_equally_probable_values(
    square: float, linear: float, constant: float, mean: float, sd: float
) -> None:
    expected = share_of_draws(square, linear, constant, mean, sd)
    assert positive_share(square, linear, constant, mean, sd) == pytest.approx(expected, abs=1.5e-4)


@pytest.mark.parametrize(("constant", "expected"), [(1.0, 0.0), (0.5, 0.0), (0.0, 0.0), (-1.0, 1.0)])
def test_a_quadratic_of_a_value_without_spread_is_positive_or_not(constant: float, expected: float) -> None:
    assert positive_share(2.0, -3.0, -constant + 1.0, 1.0, 0.0) == expected


@pytest.mark.parametrize("linear", [-1.0, 1.0])
@pytest.mark.parametrize("square", [-1e-17, 1e-17])
def test_a_quadratic_that_hardly_bends_is_as_exact_as_a_line(square: float, linear: float) -> None:
    """The root near the mean would be the difference of two equal numbers."""
    assert positive_share(square, linear, 0.3, 0.0, 0.5) == pytest.approx(
        positive_share(0.0, linear, 0.3, 0.0, 0.5), rel=1e-12
    )
