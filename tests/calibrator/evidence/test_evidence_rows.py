import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.evidence.rows import FleetRows, LineMeans, constant_design, relative_design

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


@BRANCHES
def test_constants_turn_with_their_ratios_about_the_means(branches: int) -> None:
    """Whatever the errors of slopes and gain ratios, given the truth the constants are exact."""
    K, rng = branches, np.random.default_rng(branches)
    d_h, d, o, o_h = 0.1, *rng.uniform(-0.2, 0.2, (3, K))
    o_h -= o_h.mean()
    true = rng.uniform(-0.1, 0.1, K)
    true -= true.mean()
    measured = (1.0 + d) * ((1.0 + d_h) * true + o_h) + o
    error = rng.normal(0.0, 0.3, 2 * K - 1)
    relative = relative_design(K) @ np.log1p(np.append(d_h, d))
    relative[: 2 * K - 1] += error
    b = measured - np.exp(relative[:K]) * true
    c = measured[0] + np.exp(relative[K : 2 * K - 1]) @ measured[1:]
    rows = FleetRows(
        relative=relative[None],
        constant=np.concatenate([b, [c], np.zeros(K)])[None],
        covariance=np.eye(5 * K)[None],
        means=LineMeans(model=true[None], measured=measured[None]),
    )
    assert rows.means is not None
    residual = np.concatenate([error, np.zeros(K)])
    seen = rows.constant_seen(np.append(d_h, d)[None, None], residual[None, None])[0, 0, : K + 1]
    linear = rows.means.lever(rows.relative)[0] @ error
    expected = np.append(o_h + o / (1.0 + d), np.sum(o / (1.0 + d)))
    np.testing.assert_allclose(seen - linear, expected, atol=1e-12)


def test_intercepts_at_the_means_do_not_turn_with_the_slopes() -> None:
    K = 2
    means = LineMeans(model=np.array([[0.3, -0.3]]), measured=np.array([[0.4, -0.2]]))
    relative, own = np.zeros((1, 3 * K - 1)), np.array([[4e-6, 1e-6], [1e-6, 9e-6]])
    turn = np.eye(5 * K)
    turn[3 * K - 1 : 4 * K, : 2 * K - 1] = means.lever(relative)[0]
    at_means = np.diag(np.full(5 * K, 1e-4))
    at_means[3 * K - 1 : 4 * K - 1, 3 * K - 1 : 4 * K - 1] = own
    rows = FleetRows(
        relative=relative, constant=np.zeros((1, 2 * K + 1)), covariance=(turn @ at_means @ turn.T)[None], means=means
    )
    np.testing.assert_allclose(rows.intercept_covariance()[0], own, atol=1e-18)
    whole, added = rows.dispersed(np.array([4.0, 1.0]))
    np.testing.assert_allclose(np.diag(added[0]), [12e-6, 0.0])
    np.testing.assert_allclose(
        np.diag(whole[0] - rows.covariance[0])[3 * K - 1 :], [12e-6, 0.0, 0.0, 0.0, 0.0], atol=1e-18
    )
    assert (np.linalg.eigvalsh(whole[0]) > 0.0).all()


def test_means_are_taken_with_their_vehicles() -> None:
    means = LineMeans(model=np.arange(4.0).reshape(2, 2), measured=np.arange(4.0, 8.0).reshape(2, 2))
    rows = FleetRows(**{**vars(some_rows(2, 2)), "means": means})
    taken = rows.take(np.array([1])).means
    assert taken is not None
    np.testing.assert_array_equal(taken.model, [[2.0, 3.0]])
    np.testing.assert_array_equal(taken.measured, [[6.0, 7.0]])
