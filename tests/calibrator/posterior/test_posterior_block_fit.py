"""Evidence of one support: as brute force over the prior says, and least squares of what it fits."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from calibrator.compiled import in_place
from calibrator.drive import Array
from calibrator.evidence.rows import UNKNOWN_VARIANCE, constant_design, relative_design
from calibrator.posterior.block_fit import fit_node, weigh_nodes
from calibrator.posterior.normal import Normal, Scratch, scratch_of
from calibrator.posterior.open_directions import open_directions
from calibrator.posterior.slab import Slab
from calibrator.posterior.slab_nodes import SlabNodes, slab_nodes

K = 2
SLAB = Slab(0.05, 0.25)
DRAWS = 400_000


@dataclass(frozen=True)
class Fit:
    """Logarithms of the integral at Q nodes; parameters (Q, P), and covariance (Q, P, P) of what rows are linear in."""

    log_evidence: Array
    parameters: Array
    covariance: Array


@in_place
def weigh(
    rows: Normal,
    active: NDArray[np.int64],
    pivots: int,
    nodes: SlabNodes,
    unit: Array,
    floor: float,
    room: Scratch,
    out: Array,
) -> int:
    return weigh_nodes(rows, active, len(active), pivots, nodes, unit, floor, room, out)


@in_place
def find_pivots(A: Array, active: NDArray[np.int64], spacing: Array, room: Scratch) -> int:
    return open_directions(A, active, len(active), spacing, room)


@in_place
def fit_at_node(
    rows: Normal,
    active: NDArray[np.int64],
    pivots: int,
    nodes: SlabNodes,
    q: int,
    room: Scratch,
    theta: Array,
    C: Array,
) -> None:
    fit_node(rows, active, len(active), pivots, nodes, q, room, theta, C)


def fitted(
    y: Array,
    design: Array,
    active: Sequence[int],
    R: Array,
    *,
    scale: Array | None = None,
    slab: Slab | None = None,
    sharp: Array | None = None,
    floor: float = -np.inf,
) -> Fit:
    """Relative rows without a scale, else constant ones; directions are open as under the covariance ``sharp``."""
    P, precision = design.shape[1], np.linalg.inv(R)
    unit = np.ones(P) if scale is None else scale
    nodes = slab_nodes(slab or SLAB, P, logarithmic=scale is None, hardware=0)
    density = -0.5 * (len(y) * np.log(2.0 * np.pi) + np.linalg.slogdet(R)[1])
    rows = Normal(design.T @ precision @ design, design.T @ precision @ y, np.array([y @ precision @ y, density]))
    room, out, places = scratch_of(max(design.shape)), np.zeros(nodes.values.shape[1]), np.array(active, np.int64)
    information = design.T @ np.linalg.inv(R if sharp is None else sharp) @ design
    pivots = find_pivots(information, places, nodes.spacing, room)
    count = weigh(rows, places, pivots, nodes, unit, floor, room, out)
    theta, C = np.zeros((count, P)), np.zeros((count, P, P))
    for q in range(count):
        fit_at_node(rows, places, pivots, nodes, q, room, theta[q], C[q])
    return Fit(out[:count], np.expm1(theta) if scale is None else theta * unit, C)


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


def log_mean_likelihood(y: Array, means: Array, R: Array) -> float:
    densities = multivariate_normal(np.zeros(len(y)), R).logpdf(y - means)
    return float(logsumexp(densities) - np.log(len(means)))


def relative_truth(y: Array, active: Sequence[int], R: Array, points: Array) -> float:
    """Brute force over points of the prior of the drifts."""
    means = np.log1p(points) @ relative_design(K)[:, list(active)].T
    return log_mean_likelihood(y, means, R)


@pytest.mark.parametrize("sd", [0.004, 0.015])
@pytest.mark.parametrize("active", [(0,), (1,), (2,), (0, 1), (1, 2)])
def test_relative_evidence_is_that_of_a_fine_grid(active: tuple[int, ...], sd: float) -> None:
    R = covariance_of(3 * K - 1, sd)
    y = np.zeros(3 * K - 1)
    y[: 2 * K - 1] = relative_design(K)[: 2 * K - 1, list(active)] @ np.log1p([0.12, -0.17][: len(active)]) + 0.5 * sd
    fit = fitted(y, relative_design(K), active, R)
    expected = relative_truth(y, active, R, slab_grid(len(active)))
    assert fit.log_evidence[0] == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("value", [0.045, 0.055, 0.245, 0.255])
def test_an_estimate_at_the_edge_of_the_slab_loses_the_mass_beyond(value: float) -> None:
    active, R = (1,), covariance_of(3 * K - 1, 0.006)
    y = relative_design(K)[:, 1] * np.log1p(value)
    y[-K:] = 0.0
    fit = fitted(y, relative_design(K), active, R)
    assert fit.log_evidence[0] == pytest.approx(relative_truth(y, active, R, slab_grid(1, 4000)), abs=0.05)


@pytest.mark.parametrize("active", [(0,), (1,), (2,), (0, 1), (1, 2), (0, 2)])
def test_constant_evidence_is_that_of_a_fine_grid(active: tuple[int, ...]) -> None:
    R = covariance_of(2 * K + 1, 0.01)
    design, factor = constant_design(K), np.array([1.2, 0.85])
    scale = np.array([1.0, *factor])
    y = np.zeros(2 * K + 1)
    chosen = list(active)
    y[: K + 1] = design[: K + 1, chosen] @ (np.array([0.11, -0.16])[: len(chosen)] / scale[chosen]) + 0.004
    fit = fitted(y, design, active, R, scale=scale)
    means = (slab_grid(len(chosen)) / scale[chosen]) @ design[:, chosen].T
    assert fit.log_evidence[0] == pytest.approx(log_mean_likelihood(y, means, R), abs=0.02)


@pytest.mark.parametrize(("sd", "open_directions"), [(0.01, 1), (0.03, 1), (0.1, 2)])
def test_relative_evidence_with_pivots_is_that_of_many_draws(sd: float, open_directions: int) -> None:
    active, R = (0, 1, 2), covariance_of(3 * K - 1, sd)
    y = np.zeros(3 * K - 1)
    y[: 2 * K - 1] = relative_design(K)[: 2 * K - 1] @ np.log1p([0.1, -0.12, 0.15])
    fit = fitted(y, relative_design(K), active, R)
    expected = relative_truth(y, active, R, slab_draws(1, 3))
    assert len(fit.log_evidence) == len(SLAB.nodes(open_directions))
    assert logsumexp(fit.log_evidence) == pytest.approx(expected, abs=0.2)


def test_constant_evidence_with_a_pivot_is_that_of_many_draws() -> None:
    active, R = (0, 1, 2), covariance_of(2 * K + 1, 0.03)
    design, scale = constant_design(K), np.array([1.0, 1.1, 0.9])
    y = np.zeros(2 * K + 1)
    y[: K + 1] = design[: K + 1] @ (np.array([0.1, -0.12, 0.15]) / scale)
    fit = fitted(y, design, active, R, scale=scale)
    expected = log_mean_likelihood(y, (slab_draws(2, 3) / scale) @ design.T, R)
    assert logsumexp(fit.log_evidence) == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize("active", [(1,), (0, 1), (0, 1, 2)])
def test_vague_rows_weigh_for_no_support(active: tuple[int, ...]) -> None:
    R = covariance_of(3 * K - 1, 5.0)
    fit = fitted(np.zeros(3 * K - 1), relative_design(K), active, R)
    density = multivariate_normal(np.zeros(3 * K - 1), R).logpdf(np.zeros(3 * K - 1))
    assert logsumexp(fit.log_evidence) == pytest.approx(density, abs=0.6)


def test_estimates_and_deviations_are_those_of_weighted_least_squares() -> None:
    active, R = (0, 2), covariance_of(3 * K - 1, 0.005)
    X = relative_design(K)[:, [0, 2]]
    y = np.random.default_rng(3).normal(0.0, 0.1, size=3 * K - 1)
    fit = fitted(y, relative_design(K), active, R)
    L = np.linalg.inv(np.linalg.cholesky(R))
    theta = np.linalg.lstsq(L @ X, L @ y, rcond=None)[0]
    sd = np.sqrt(np.diag(np.linalg.inv(X.T @ np.linalg.inv(R) @ X)))
    np.testing.assert_allclose(fit.parameters[0], [np.expm1(theta[0]), 0.0, np.expm1(theta[1])], rtol=1e-9)
    np.testing.assert_allclose(np.diag(fit.covariance[0]), [sd[0] ** 2, 0.0, sd[1] ** 2], rtol=1e-9)


def test_the_empty_support_is_the_density_of_the_rows() -> None:
    R = covariance_of(3 * K - 1, 0.01)
    y = np.random.default_rng(4).normal(0.0, 0.02, size=3 * K - 1)
    fit = fitted(y, relative_design(K), (), R)
    assert fit.log_evidence[0] == pytest.approx(multivariate_normal(np.zeros(len(y)), R).logpdf(y))
    assert not fit.parameters.any()


@pytest.mark.parametrize("below", [1.0, 3.0, 10.0])
def test_what_is_left_out_below_a_floor_lies_below_it(below: float) -> None:
    active, R = (0, 1, 2), covariance_of(3 * K - 1, 0.01)
    y = np.zeros(3 * K - 1)
    y[: 2 * K - 1] = relative_design(K)[: 2 * K - 1] @ np.log1p([0.1, -0.12, 0.15])
    every = fitted(y, relative_design(K), active, R).log_evidence
    floor = every.max() - below
    kept = fitted(y, relative_design(K), active, R, floor=floor).log_evidence
    np.testing.assert_array_equal(kept[every >= floor], every[every >= floor])
    assert (np.isneginf(kept) | (kept == every)).all()
    assert len(fitted(y, relative_design(K), active, R, floor=every.max() + 20.0).log_evidence) == 0


def test_a_reading_of_one_sensor_closes_the_direction_of_its_offsets() -> None:
    """o_h, o_1 and o_2 of two branches: without a reading one direction is open, with one of o_1 none is."""
    design, active = constant_design(K), (0, 1, 2)
    y, R = design @ np.array([0.1, -0.12, 0.15]), covariance_of(2 * K + 1, 0.001)
    y[-K:] = 0.0
    read, exact = y.copy(), R.copy()
    read[K + 1], exact[K + 1, K + 1] = -0.12, 1e-8
    one = np.ones(2 * K - 1)
    blind = fitted(y, design, active, R, scale=one)
    seen = fitted(read, design, active, exact, scale=one)
    assert len(blind.log_evidence) == len(SLAB.nodes(1))
    assert len(seen.log_evidence) == 1
    np.testing.assert_allclose(seen.parameters[0], [0.1, -0.12, 0.15], atol=1e-6)
    C = np.linalg.inv(design.T @ np.linalg.inv(exact) @ design)
    volume = 0.5 * np.linalg.slogdet(2.0 * np.pi * C)[1] + 3.0 * np.log(SLAB.density)
    left = read - design @ [0.1, -0.12, 0.15]
    density = -0.5 * (np.linalg.slogdet(2.0 * np.pi * exact)[1] + left @ np.linalg.inv(exact) @ left)
    assert seen.log_evidence[0] == pytest.approx(density + volume, abs=1e-6)


def test_pivots_deviate_as_far_as_their_nodes_lie_apart_and_what_follows_them_as_well() -> None:
    active, R = (0, 1, 2), covariance_of(3 * K - 1, 1e-5)
    y = np.zeros(3 * K - 1)
    y[: 2 * K - 1] = relative_design(K)[: 2 * K - 1] @ np.log1p([0.1, -0.12, 0.15])
    fit = fitted(y, relative_design(K), active, R)
    apart = SLAB.spacing(1) / np.sqrt(12.0) / (1.0 + SLAB.nodes(1))
    deviations = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))
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
    return float(logsumexp(fitted(y, design, range(len(y)), R, slab=slab).log_evidence))


@pytest.mark.parametrize("active", [(0, 2), (1, 2)])
def test_directions_that_sharp_rows_close_stay_closed_in_vague_ones(active: tuple[int, ...]) -> None:
    sharp = np.diag([1e-6, 1e-6, 1e-6, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE])
    vague = sharp + 0.01 * np.outer([0.0, 1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0, 0.0])
    y = constant_design(K)[:, list(active)] @ np.array([0.1237, -0.1])
    y[3:] = 0.0
    one = np.ones(2 * K - 1)
    for R in (sharp, vague):
        assert len(fitted(y, constant_design(K), active, R, scale=one, sharp=sharp).log_evidence) == 1
    assert len(fitted(y, constant_design(K), active, vague, scale=one).log_evidence) > 1
