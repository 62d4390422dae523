import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from calibrator.drive import Array
from calibrator.evidence.rows import UNKNOWN_VARIANCE, constant_design, relative_design
from calibrator.posterior.gaussian_block import Noise, integrate_constant, integrate_relative
from calibrator.posterior.slab import Slab
from calibrator.posterior.supports import Support, constant_support, relative_supports

K = 2
SLAB = Slab(0.05, 0.25)
DRAWS = 400_000


def covariance_of(rows: int, sd: float, seed: int = 0) -> Array:
    """Correlated errors of the told rows; bench readings (the last K) say nothing."""
    mixing = np.eye(rows) + 0.2 * np.random.default_rng(seed).normal(size=(rows, rows))
    R = sd**2 * mixing @ mixing.T
    R[-K:], R[:, -K:] = 0.0, 0.0
    R[-K:, -K:] = np.diag(np.full(K, UNKNOWN_VARIANCE))
    return R


def slab_draws(seed: int, dimensions: int) -> Array:
    rng = np.random.default_rng(seed)
    sign = rng.choice([-1.0, 1.0], size=(DRAWS, dimensions))
    return np.asarray(sign * rng.uniform(SLAB.low, SLAB.high, size=(DRAWS, dimensions)))


def slab_grid(dimensions: int, steps: int = 200) -> Array:
    """Equally weighted points of the prior: midpoints on both sides."""
    side = SLAB.low + (SLAB.high - SLAB.low) * (np.arange(steps) + 0.5) / steps
    axes = np.meshgrid(*[np.concatenate([-side[::-1], side])] * dimensions, indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=1)


def relative_support(*active: int) -> Support:
    return next(support for support in relative_supports(K) if support.active == active)


def log_mean_likelihood(y: Array, means: Array, R: Array) -> float:
    densities = multivariate_normal(np.zeros(len(y)), R).logpdf(y - means)
    return float(logsumexp(densities) - np.log(len(means)))


def relative_truth(y: Array, support: Support, R: Array, points: Array) -> float:
    """Brute force over points of the prior of the drifts."""
    means = np.log1p(points) @ relative_design(K)[:, list(support.active)].T
    return log_mean_likelihood(y, means, R)


@pytest.mark.parametrize("sd", [0.004, 0.015])
@pytest.mark.parametrize("active", [(0,), (1,), (2,), (0, 1), (1, 2)])
def test_relative_evidence_is_that_of_a_fine_grid(active: tuple[int, ...], sd: float) -> None:
    support, R = relative_support(*active), covariance_of(3 * K - 1, sd)
    y = np.zeros(3 * K - 1)
    y[: 2 * K - 1] = relative_design(K)[: 2 * K - 1, list(active)] @ np.log1p([0.12, -0.17][: len(active)]) + 0.5 * sd
    fit = integrate_relative(y[None, None], relative_design(K), support, Noise.of(R[None]), SLAB)
    expected = relative_truth(y, support, R, slab_grid(len(active)))
    assert fit.log_evidence[0, 0] == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("value", [0.045, 0.055, 0.245, 0.255])
def test_an_estimate_at_the_edge_of_the_slab_loses_the_mass_beyond(value: float) -> None:
    support, R = relative_support(1), covariance_of(3 * K - 1, 0.006)
    y = relative_design(K)[:, 1] * np.log1p(value)
    y[-K:] = 0.0
    fit = integrate_relative(y[None, None], relative_design(K), support, Noise.of(R[None]), SLAB)
    assert fit.log_evidence[0, 0, 0] == pytest.approx(relative_truth(y, support, R, slab_grid(1, 4000)), abs=0.05)


@pytest.mark.parametrize("active", [(0,), (1,), (2,), (0, 1), (1, 2), (0, 2)])
def test_constant_evidence_is_that_of_a_fine_grid(active: tuple[int, ...]) -> None:
    support, R = constant_support(K, active), covariance_of(2 * K + 1, 0.01)
    design, factor = constant_design(K), np.array([1.2, 0.85])
    scale = np.array([1.0, *factor])
    y = np.zeros(2 * K + 1)
    chosen = list(active)
    y[: K + 1] = design[: K + 1, chosen] @ (np.array([0.11, -0.16])[: len(chosen)] / scale[chosen]) + 0.004
    fit = integrate_constant(y[None, None], design, support, Noise.of(R[None]), SLAB, scale=scale[None, None])
    means = (slab_grid(len(chosen)) / scale[chosen]) @ design[:, chosen].T
    assert fit.log_evidence[0, 0] == pytest.approx(log_mean_likelihood(y, means, R), abs=0.02)


@pytest.mark.parametrize(("sd", "open_directions"), [(0.01, 1), (0.03, 1), (0.1, 2)])
def test_relative_evidence_with_pivots_is_that_of_many_draws(sd: float, open_directions: int) -> None:
    support, R = relative_support(0, 1, 2), covariance_of(3 * K - 1, sd)
    y = np.zeros(3 * K - 1)
    y[: 2 * K - 1] = relative_design(K)[: 2 * K - 1] @ np.log1p([0.1, -0.12, 0.15])
    fit = integrate_relative(y[None, None], relative_design(K), support, Noise.of(R[None]), SLAB)
    expected = relative_truth(y, support, R, slab_draws(1, 3))
    assert fit.log_evidence.shape[2] == len(SLAB.nodes(open_directions))
    assert logsumexp(fit.log_evidence) == pytest.approx(expected, abs=0.2)


def test_constant_evidence_with_a_pivot_is_that_of_many_draws() -> None:
    support, R = constant_support(K, (0, 1, 2)), covariance_of(2 * K + 1, 0.03)
    design, scale = constant_design(K), np.array([1.0, 1.1, 0.9])
    y = np.zeros(2 * K + 1)
    y[: K + 1] = design[: K + 1] @ (np.array([0.1, -0.12, 0.15]) / scale)
    fit = integrate_constant(y[None, None], design, support, Noise.of(R[None]), SLAB, scale=scale[None, None])
    expected = log_mean_likelihood(y, (slab_draws(2, 3) / scale) @ design.T, R)
    assert logsumexp(fit.log_evidence) == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize("active", [(1,), (0, 1), (0, 1, 2)])
def test_vague_rows_weigh_for_no_support(active: tuple[int, ...]) -> None:
    R = covariance_of(3 * K - 1, 5.0)
    fit = integrate_relative(
        np.zeros((1, 1, 3 * K - 1)), relative_design(K), relative_support(*active), Noise.of(R[None]), SLAB
    )
    density = multivariate_normal(np.zeros(3 * K - 1), R).logpdf(np.zeros(3 * K - 1))
    assert logsumexp(fit.log_evidence) == pytest.approx(density, abs=0.6)


def test_estimates_and_deviations_are_those_of_weighted_least_squares() -> None:
    support, R = relative_support(0, 2), covariance_of(3 * K - 1, 0.005)
    X = relative_design(K)[:, [0, 2]]
    y = np.random.default_rng(3).normal(0.0, 0.1, size=3 * K - 1)
    fit = integrate_relative(y[None, None], relative_design(K), support, Noise.of(R[None]), SLAB)
    L = np.linalg.inv(np.linalg.cholesky(R))
    theta = np.linalg.lstsq(L @ X, L @ y, rcond=None)[0]
    sd = np.sqrt(np.diag(np.linalg.inv(X.T @ np.linalg.inv(R) @ X)))
    np.testing.assert_allclose(fit.parameters[0, 0, 0], [np.expm1(theta[0]), 0.0, np.expm1(theta[1])], rtol=1e-9)
    np.testing.assert_allclose(np.diag(fit.covariance[0, 0, 0]), [sd[0] ** 2, 0.0, sd[1] ** 2], rtol=1e-9)
    np.testing.assert_allclose(fit.residual[0, 0, 0], y - X @ theta, atol=1e-12)


def test_the_empty_support_is_the_density_of_the_rows() -> None:
    R = covariance_of(3 * K - 1, 0.01)
    y = np.random.default_rng(4).normal(0.0, 0.02, size=3 * K - 1)
    fit = integrate_relative(y[None, None], relative_design(K), relative_support(), Noise.of(R[None]), SLAB)
    assert fit.log_evidence[0, 0, 0] == pytest.approx(multivariate_normal(np.zeros(len(y)), R).logpdf(y))
    assert not fit.parameters.any()


def test_vehicles_and_sets_of_rows_do_not_touch_each_other() -> None:
    R = np.stack([covariance_of(2 * K + 1, sd, seed) for seed, sd in enumerate((0.01, 0.02, 0.03))])
    rows = np.random.default_rng(5).normal(0.0, 0.1, size=(3, 2, 2 * K + 1))
    support, scale = constant_support(K, (0, 1, 2)), np.random.default_rng(6).uniform(0.8, 1.2, size=(3, 2, 2 * K - 1))
    together = integrate_constant(rows, constant_design(K), support, Noise.of(R), SLAB, scale=scale)
    for j in range(3):
        for s in range(2):
            alone = integrate_constant(
                rows[j : j + 1, s : s + 1],
                constant_design(K),
                support,
                Noise.of(R[j : j + 1]),
                SLAB,
                scale=scale[j : j + 1, s : s + 1],
            )
            nodes = alone.log_evidence.shape[2]
            np.testing.assert_allclose(together.log_evidence[j, s, :nodes], alone.log_evidence[0, 0], rtol=1e-10)
            np.testing.assert_allclose(together.parameters[j, s, :nodes], alone.parameters[0, 0], rtol=1e-10)
            assert np.isneginf(together.log_evidence[j, s, nodes:]).all()
    assert together.log_evidence.shape[2] == len(SLAB.nodes(1))


def test_a_reading_of_one_sensor_closes_the_direction_of_its_offsets() -> None:
    """o_h, o_1 and o_2 of two branches: without a reading one direction is open, with one of o_1 none is."""
    design, support = constant_design(K), constant_support(K, (0, 1, 2))
    y, R = design @ np.array([0.1, -0.12, 0.15]), covariance_of(2 * K + 1, 0.001)
    y[-K:] = 0.0
    read, exact = y.copy(), R.copy()
    read[K + 1], exact[K + 1, K + 1] = -0.12, 1e-8
    one = np.ones((1, 1, 2 * K - 1))
    blind = integrate_constant(y[None, None], design, support, Noise.of(R[None]), SLAB, scale=one)
    seen = integrate_constant(read[None, None], design, support, Noise.of(exact[None]), SLAB, scale=one)
    assert blind.log_evidence.shape[2] == len(SLAB.nodes(1))
    assert seen.log_evidence.shape[2] == 1
    np.testing.assert_allclose(seen.parameters[0, 0, 0], [0.1, -0.12, 0.15], atol=1e-6)
    C = np.linalg.inv(design.T @ np.linalg.inv(exact) @ design)
    volume = 0.5 * np.linalg.slogdet(2.0 * np.pi * C)[1] + 3.0 * np.log(SLAB.density)
    left = read - design @ [0.1, -0.12, 0.15]
    density = -0.5 * (np.linalg.slogdet(2.0 * np.pi * exact)[1] + left @ np.linalg.inv(exact) @ left)
    assert seen.log_evidence[0, 0, 0] == pytest.approx(density + volume, abs=1e-6)


def test_pivots_deviate_as_far_as_their_nodes_lie_apart_and_what_follows_them_as_well() -> None:
    support, R = relative_support(0, 1, 2), covariance_of(3 * K - 1, 1e-5)
    y = np.zeros(3 * K - 1)
    y[: 2 * K - 1] = relative_design(K)[: 2 * K - 1] @ np.log1p([0.1, -0.12, 0.15])
    fit = integrate_relative(y[None, None], relative_design(K), support, Noise.of(R[None]), SLAB)
    apart = SLAB.spacing(1) / np.sqrt(12.0) / (1.0 + SLAB.nodes(1))
    deviations = np.sqrt(np.diagonal(fit.covariance[0, 0], axis1=1, axis2=2))
    np.testing.assert_allclose(deviations, np.repeat(apart, K + 1, axis=1), rtol=1e-4)


@pytest.mark.parametrize("branches", [3, 5])
@pytest.mark.parametrize("sd", [0.06, 0.08, 0.12])
def test_several_open_directions_are_integrated_to_a_nat(branches: int, sd: float) -> None:
    """All drifts active, a wide slab, errors about as large as nodes lie apart."""
    slab = Slab(0.002, 0.45)
    design = relative_design(branches)[:branches, 1:]
    rng = np.random.default_rng(branches)
    R = np.diag(np.full(branches, sd**2))
    sign = rng.choice([-1.0, 1.0], size=(200_000, branches))
    draws = np.log1p(sign * rng.uniform(slab.low, slab.high, size=sign.shape))
    for _ in range(4):
        y = design @ np.log1p(rng.uniform(-0.3, 0.3, branches))
        fit = log_evidence_of_drifts(y, design, R, slab)
        assert fit == pytest.approx(log_mean_likelihood(y, draws @ design.T, R), abs=0.8)


def log_evidence_of_drifts(y: Array, design: Array, R: Array, slab: Slab) -> float:
    """Evidence of drifts alone."""
    support = Support(tuple(range(len(y))), hardware=False)
    fit = integrate_relative(y[None, None], design, support, Noise.of(R[None]), slab)
    return float(logsumexp(fit.log_evidence))


@pytest.mark.parametrize("active", [(0, 2), (1, 2)])
def test_a_vague_state_beside_it_does_not_change_the_evidence_of_a_sharp_one(active: tuple[int, ...]) -> None:
    sharp = np.diag([1e-6, 1e-6, 1e-6, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE])
    vague = sharp + 0.01 * np.outer([0.0, 1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0, 0.0])
    support = constant_support(K, active)
    y = constant_design(K)[:, list(active)] @ np.array([0.1237, -0.1])
    y[3:] = 0.0
    found = []
    for place, noises in enumerate([(sharp, vague), (vague, sharp)]):
        fit = integrate_constant(
            np.stack([y, y])[None],
            constant_design(K),
            support,
            Noise.of(np.stack(noises)[None]),
            SLAB,
            scale=np.ones((1, 2, 2 * K - 1)),
        )
        found.append(float(logsumexp(fit.log_evidence[0, place])))
    assert found[0] == pytest.approx(found[1])
