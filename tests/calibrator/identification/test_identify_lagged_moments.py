import numpy as np

from calibrator.drive import Array, Mask
from calibrator.identification.lagged_moments import lagged_moments


def by_rows(z: Array, lags: int, valid: Mask) -> Array:
    """Every row of lagged data that holds valid samples only."""
    starts = [t for t in range(len(z) - lags + 1) if valid[t : t + lags].all()]
    return np.array([z[t : t + lags].ravel() for t in starts])


def test_moments_equal_those_of_the_rows_across_gaps() -> None:
    rng = np.random.default_rng(0)
    z = rng.normal(size=(200, 3)) + 5.0
    valid = rng.random(200) > 0.03
    z[~valid] = np.nan
    rows = by_rows(z, 6, valid)
    moments = lagged_moments(z, 6, valid)
    centred = rows - rows.mean(axis=0)
    assert moments.rows == len(rows)
    np.testing.assert_allclose(moments.gram, centred.T @ centred, atol=1e-9)


def test_one_lag_is_the_plain_second_moment() -> None:
    z = np.random.default_rng(1).normal(size=(50, 2))
    moments = lagged_moments(z, 1, np.ones(50, bool))
    np.testing.assert_allclose(moments.gram, 50 * np.cov(z.T, bias=True), atol=1e-12)


def test_too_few_samples_in_a_row_give_no_rows() -> None:
    moments = lagged_moments(np.ones((30, 2)), 6, np.arange(30) % 6 != 0)
    assert moments.rows == 0
    assert not moments.gram.any()
