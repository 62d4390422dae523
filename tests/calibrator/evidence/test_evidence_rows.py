import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.evidence.rows import FleetRows, constant_design, relative_design

BRANCHES = pytest.mark.parametrize("branches", [2, 3, 5])


def some_rows(vehicles: int, branches: int) -> FleetRows:
    K = branches
    return FleetRows(
        relative=np.arange(vehicles * (3 * K - 1.0)).reshape(vehicles, -1),
        constant=np.zeros((vehicles, 2 * K + 1)),
        covariance=np.repeat(np.eye(5 * K)[None], vehicles, axis=0),
    )


@BRANCHES
def test_relative_rows_are_the_logarithms_of_slopes_gain_ratios_and_readings(branches: int) -> None:
    K, rng = branches, np.random.default_rng(branches)
    d, d_h = rng.uniform(-0.2, 0.2, K), 0.1
    slopes, ratios = (1.0 + d) * (1.0 + d_h), (1.0 + d[0]) / (1.0 + d[1:])
    rows = relative_design(K) @ np.log1p(np.append(d_h, d))
    np.testing.assert_allclose(rows, np.log(np.concatenate([slopes, ratios, 1.0 + d])), atol=1e-12)


@BRANCHES
def test_constant_rows_are_intercepts_junction_constant_and_readings_in_true_currents(branches: int) -> None:
    K, rng = branches, np.random.default_rng(branches)
    d, o, o_h = rng.uniform(-0.2, 0.2, (3, K))
    o_h -= o_h.mean()
    b, c = (1.0 + d) * o_h + o, (1.0 + d[0]) * np.sum(o / (1.0 + d))
    rows = constant_design(K) @ np.append(o_h[:-1], o / (1.0 + d))
    expected = np.concatenate([b / (1.0 + d), [c / (1.0 + d[0])], o / (1.0 + d)])
    np.testing.assert_allclose(rows, expected, atol=1e-12)


def test_some_vehicles_can_be_taken() -> None:
    rows = some_rows(4, 2)
    assert len(rows.take(np.array([True, False, True, False]))) == 2
    np.testing.assert_array_equal(rows.take(slice(1, 3)).relative, rows.relative[1:3])
    assert rows.branches == 2


def test_rows_that_do_not_fit_their_covariance_are_refused() -> None:
    rows = some_rows(2, 2)
    with pytest.raises(FleetError, match=r"do not fit a covariance of shape \(2, 10, 10\): expected \(N, 3K - 1\)"):
        FleetRows(relative=rows.relative[:, :4], constant=rows.constant, covariance=rows.covariance)
    with pytest.raises(FleetError, match=r"rows of shape \(2, 5\) and \(1, 5\) do not fit"):
        FleetRows(relative=rows.relative, constant=rows.constant[:1], covariance=rows.covariance)


def test_a_covariance_that_is_not_finite_is_refused() -> None:
    rows = some_rows(2, 2)
    with pytest.raises(FleetError, match="evidence is not finite"):
        FleetRows(relative=rows.relative, constant=rows.constant, covariance=rows.covariance + np.inf)
