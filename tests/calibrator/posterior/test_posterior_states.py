from collections import defaultdict
from dataclasses import replace
from itertools import product
from math import comb

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.evidence.readings import no_readings, with_readings
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows, LineMeans, constant_design, relative_design
from calibrator.posterior.fault_prior import FaultPrior
from calibrator.posterior.slab import Slab
from calibrator.posterior.states import States, enumerate_states, mean_states
from calibrator.posterior.supports import Support, constant_supports, relative_supports
from calibrator.posterior.workspace import MOST_STATES
from tests.calibrator.posterior.simulated_rows import (
    FULL_SCALE_A,
    Errors,
    faults_of,
    no_spread,
    parameters_of,
    prior_of,
    random_faults,
    rows_of,
)

SHARP = Errors(slope=1e-3, ratio=3e-4, intercept=5e-4, junction=3e-4)


def paper_prior(branches: int, nonzero: int, *, low: float = 0.05) -> FaultPrior:
    """Section IV-B: so many of 3K parameters; in half of the vehicles those of the hardware are set to zero."""
    K, n = branches, nonzero
    counts = np.zeros((K + 1, 2 * K + 1))
    for hardware in range(min(n, K) + 1):
        share = comb(K, hardware) * comb(2 * K, n - hardware) / comb(3 * K, n) / 2.0
        counts[0, n - hardware] += share
        counts[hardware, n - hardware] += share
    slab = Slab(low, 0.25)
    return FaultPrior(counts=counts, relative=slab, constant=slab)


def slab_mass(slab: Slab, value: float, sd: float) -> float:
    """Probability of a Gaussian in both halves of the slab, times the density."""
    positive = norm.cdf(slab.high, value, sd) - norm.cdf(slab.low, value, sd)
    return slab.density * float(positive + norm.cdf(-slab.low, value, sd) - norm.cdf(-slab.high, value, sd))


def open_directions(support: Support, X: Array) -> list[int]:
    """The first parameters without which the others are determined by the rows."""
    pivots: list[int] = []
    while True:
        kept = [i for i in support.active if i not in pivots]
        rank = np.linalg.matrix_rank(X[:, kept]) if kept else 0
        if rank == len(kept):
            return pivots
        pivots.append(next(i for i in kept if np.linalg.matrix_rank(X[:, [k for k in kept if k != i]]) == rank))


def block(y: Array, X: Array, R: Array, support: Support, slab: Slab, unit: Array | None) -> list[tuple[float, Array]]:
    """Plain loop over the nodes of one support: log evidence, and parameters; drifts without unit, else offsets."""
    found = []
    pivots = open_directions(support, X)
    fitted = [i for i in support.active if i not in pivots]
    for node in slab.nodes(len(pivots)):
        theta = np.zeros(X.shape[1])
        theta[pivots] = np.log1p(node) if unit is None else node / unit[pivots]
        left = y - X @ theta
        log_evidence = -np.log(len(slab.nodes(len(pivots))))
        if fitted:
            C = np.linalg.inv(X[:, fitted].T @ np.linalg.inv(R) @ X[:, fitted])
            theta[fitted] = C @ X[:, fitted].T @ np.linalg.inv(R) @ left
            log_evidence += 0.5 * np.linalg.slogdet(2.0 * np.pi * C)[1]
        change = np.exp(theta) if unit is None else unit
        value = np.expm1(theta) if unit is None else theta * unit
        for place, i in enumerate(fitted):
            mass = slab_mass(slab, value[i], change[i] * np.sqrt(C[place, place]))
            log_evidence += np.log(max(mass, 1e-300)) + np.log(change[i])
        log_evidence += multivariate_normal(np.zeros(len(y)), R).logpdf(y - X @ theta)
        found.append((float(log_evidence), value))
    return found


def brute_force(rows: FleetRows, prior: FaultPrior) -> list[tuple[float, Array]]:
    """All explanations of one vehicle by plain loops, without bench readings: log weight, and parameters."""
    K, told, told_constant = rows.branches, 2 * rows.branches - 1, rows.branches + 1
    R = rows.covariance[0]
    first, second = R[:told, :told], R[3 * K - 1 : 4 * K, 3 * K - 1 : 4 * K]
    found = []
    log_prior = prior.log_supports()
    for support in relative_supports(K):
        for log_relative, relative in block(
            rows.relative[0, :told], relative_design(K)[:told], first, support, prior.relative, None
        ):
            factor = 1.0 + relative[1:]
            seen = rows.constant[0, :told_constant] / np.append(factor, factor[0])
            unit = np.append(np.ones(K - 1), factor)
            for constant in constant_supports(K):
                hardware = int(support.hardware) + sum(i < K - 1 for i in constant.active)
                share = log_prior[hardware, len(support.active) + len(constant.active) - hardware]
                if np.isneginf(share):
                    continue
                design = constant_design(K)[:told_constant]
                for log_constant, values in block(seen, design, second, constant, prior.constant, unit):
                    weight = share + log_relative + log_constant
                    found.append((float(weight), np.append(relative, values)))
    return found


def every_parameter(states: States) -> Array:
    return np.concatenate([states.relative, states.constant], axis=2)


def first_parameters(states: States) -> Array:
    return every_parameter(states)[:, 0]


@pytest.mark.parametrize(("branches", "nonzero", "sparsity"), [(2, 1, 80.0), (2, 2, 60.0), (2, 4, 40.0), (3, 2, 80.0)])
def test_best_support_without_noise_is_that_of_a_brute_force_search(
    branches: int, nonzero: int, sparsity: float
) -> None:
    faults = random_faults(branches, vehicles=12, branches=branches, sparsity=sparsity)
    rows, prior = rows_of(faults, errors=SHARP, noise=0.0), paper_prior(branches, nonzero)
    states = enumerate_states(rows, prior, no_spread(branches))
    for j in range(len(rows)):
        every = brute_force(rows.take(slice(j, j + 1)), prior)
        total: dict[tuple[bool, ...], float] = defaultdict(lambda: -np.inf)
        for weight, values in every:
            total[tuple(values != 0.0)] = np.logaddexp(total[tuple(values != 0.0)], weight)
        best = max(total, key=total.__getitem__)
        probability = np.exp(total[best] - logsumexp(list(total.values())))
        of_best = np.all((every_parameter(states)[j] != 0.0) == best, axis=1)
        assert states.weight[j, of_best].sum() == pytest.approx(probability, abs=0.01)
        assert any(np.allclose(first_parameters(states)[j], values, atol=1e-6) for _, values in every)


def without_hardware(prior: FaultPrior) -> FaultPrior:
    counts = prior.counts.copy()
    counts[1:] = 0.0
    return replace(prior, counts=counts / counts.sum())


@pytest.mark.parametrize(
    ("prior", "tolerance"),
    [
        (without_hardware(prior_of(2)), 1e-3),
        # The plain loops leave out what the errors of drifts, and the width of nodes, make of hardware offsets.
        (prior_of(2), 0.02),
    ],
)
def test_evidence_with_noise_is_the_sum_over_all_explanations(prior: FaultPrior, tolerance: float) -> None:
    faults = random_faults(4, vehicles=6, branches=2, sparsity=40.0)
    possible = ~faults.has_hardware_fault | (prior.hardware_share > 0.0)
    rows = rows_of(faults, errors=Errors(), seed=3).take(possible)
    assert len(rows) >= 3
    states = enumerate_states(rows, prior, no_spread(2))
    for j in range(len(rows)):
        expected = logsumexp([weight for weight, _ in brute_force(rows.take(slice(j, j + 1)), prior)])
        unknown = -0.5 * 4 * np.log(2.0 * np.pi * 100.0)
        assert states.log_evidence[j] == pytest.approx(expected + unknown, abs=tolerance)


@pytest.mark.parametrize("branches", [2, 3, 4])
def test_sparse_faults_are_found(branches: int) -> None:
    faults = random_faults(5, vehicles=60, branches=branches, sparsity=80.0)
    states = enumerate_states(rows_of(faults), prior_of(branches), no_spread(branches))
    truth = np.concatenate(parameters_of(faults), axis=1)
    assert (np.abs(first_parameters(states) - truth).max(axis=1) < 0.01).mean() >= 0.95


@pytest.mark.parametrize("sparsity", [60.0, 40.0])
def test_weights_are_probabilities_for_fleets_that_the_prior_describes(sparsity: float) -> None:
    nonzero = round((1.0 - sparsity / 100.0) * 6)
    faults = random_faults(6, vehicles=600, branches=2, sparsity=sparsity)
    states = enumerate_states(rows_of(faults, seed=6), paper_prior(2, nonzero), no_spread(2))
    truth = np.concatenate(parameters_of(faults), axis=1) != 0.0
    present = every_parameter(states) != 0.0
    right = np.all(present == truth[:, None, :], axis=2)
    of_best = np.all(present == present[:, :1], axis=2)
    confidence, hit = np.sum(states.weight * of_best, axis=1), right[:, 0]
    error = np.sqrt(np.sum(confidence * (1.0 - confidence))) / len(hit)
    assert abs(hit.mean() - confidence.mean()) < 3.0 * error


def test_errors_of_the_right_state_are_as_large_as_stated() -> None:
    faults = random_faults(7, vehicles=400, branches=3, sparsity=80.0)
    states = enumerate_states(rows_of(faults, seed=7), prior_of(3), no_spread(3))
    truth = np.concatenate(parameters_of(faults), axis=1)
    found, sd = first_parameters(states), np.concatenate([states.relative_sd[:, 0], states.constant_sd[:, 0]], axis=1)
    right = np.all((found != 0.0) == (truth != 0.0), axis=1)
    z = ((found - truth)[right] / np.where(sd[right] > 0.0, sd[right], 1.0))[truth[right] != 0.0]
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("branches", [2, 3, 4])
def test_weights_sum_to_one_and_fall(branches: int) -> None:
    rows = rows_of(random_faults(8, vehicles=20, branches=branches, sparsity=60.0))
    states = enumerate_states(rows, prior_of(branches), no_spread(branches))
    np.testing.assert_allclose(states.weight.sum(axis=1), 1.0, atol=1e-4)
    assert (states.weight.sum(axis=1) < 1.0 + 1e-9).all()
    assert (np.diff(states.weight, axis=1) <= 0.0).all()
    assert states.weight.shape[1] <= MOST_STATES


@pytest.mark.parametrize("branches", [2, 3, 5])
def test_order_of_the_vehicles_does_not_matter(branches: int) -> None:
    rows = rows_of(random_faults(9, vehicles=70, branches=branches, sparsity=70.0), seed=9)
    order = np.random.default_rng(9).permutation(len(rows))
    prior, spread = prior_of(branches), no_spread(branches)
    plain, other = enumerate_states(rows, prior, spread), enumerate_states(rows.take(order), prior, spread)
    np.testing.assert_allclose(other.log_evidence, plain.log_evidence[order], rtol=1e-9)
    np.testing.assert_allclose(other.weight, plain.weight[order], atol=1e-9)
    np.testing.assert_allclose(first_parameters(other), first_parameters(plain)[order], atol=1e-9)


def test_order_of_the_branches_does_not_matter_except_for_the_first_and_last() -> None:
    K, order = 4, [0, 2, 1, 3]
    faults = random_faults(10, vehicles=20, branches=K, sparsity=80.0)
    swapped = replace(
        faults,
        hardware_offset_a=faults.hardware_offset_a[:, order],
        drift=faults.drift[:, order],
        offset_a=faults.offset_a[:, order],
    )
    prior, spread = prior_of(K), no_spread(K)
    plain = enumerate_states(rows_of(faults, noise=0.0), prior, spread)
    other = enumerate_states(rows_of(swapped, noise=0.0), prior, spread)
    np.testing.assert_allclose(other.log_evidence, plain.log_evidence, atol=1e-4)
    np.testing.assert_allclose(other.drift[:, 0], plain.drift[:, 0][:, order], atol=1e-9)
    np.testing.assert_allclose(other.offset[:, 0], plain.offset[:, 0][:, order], atol=1e-9)


def test_another_full_scale_changes_nothing_but_the_unit() -> None:
    K, unit = 2, 0.5
    rows, prior = rows_of(random_faults(11, vehicles=30, branches=K, sparsity=60.0), seed=11), prior_of(K)
    scale = np.concatenate([np.ones(3 * K - 1), np.full(2 * K + 1, unit)])
    scaled = FleetRows(
        relative=rows.relative, constant=unit * rows.constant, covariance=rows.covariance * np.outer(scale, scale)
    )
    slab = Slab(unit * prior.constant.low, unit * prior.constant.high)
    plain = enumerate_states(rows, prior, no_spread(K))
    other = enumerate_states(scaled, replace(prior, constant=slab), no_spread(K))
    np.testing.assert_allclose(other.weight, plain.weight, atol=1e-9)
    np.testing.assert_allclose(other.constant[:, 0], unit * plain.constant[:, 0], atol=1e-12)
    np.testing.assert_allclose(other.relative[:, 0], plain.relative[:, 0], atol=1e-12)


def test_a_mean_of_the_fleet_is_taken_out_first() -> None:
    K = 2
    rows = rows_of(random_faults(12, vehicles=20, branches=K, sparsity=100.0))
    mean = np.zeros(5 * K)
    mean[:K], mean[3 * K - 1] = 0.07, -0.03
    moved = FleetRows(
        relative=rows.relative + mean[: 3 * K - 1],
        constant=rows.constant + mean[3 * K - 1 :],
        covariance=rows.covariance,
    )
    plain = enumerate_states(rows, prior_of(K), no_spread(K))
    other = enumerate_states(moved, prior_of(K), replace(no_spread(K), mean=mean))
    np.testing.assert_allclose(other.weight[:, 0], plain.weight[:, 0], atol=1e-4)
    assert not first_parameters(other).any()


def test_rows_that_say_nothing_leave_the_prior() -> None:
    vague = Errors(slope=5.0, ratio=5.0, intercept=5.0, junction=5.0)
    rows, prior = rows_of(random_faults(13, vehicles=4, branches=2, sparsity=60.0), errors=vague), prior_of(2)
    states = enumerate_states(rows, prior, no_spread(2))
    values = np.concatenate([rows.relative, rows.constant], axis=1)
    density = multivariate_normal(np.zeros(10), rows.covariance[0]).logpdf(values)
    np.testing.assert_allclose(states.log_evidence, density, atol=0.8)
    nothing = prior.counts[0, 0]
    best = np.exp(np.log(states.weight[:, 0]) + states.log_evidence - density)
    assert first_parameters(states).any(axis=1).sum() == 0
    assert (best >= nothing * 0.99).all()


def test_ever_smaller_errors_make_the_simplest_explanation_sure() -> None:
    faults = random_faults(14, vehicles=20, branches=3, sparsity=89.0)
    sure = [
        enumerate_states(
            rows_of(faults, errors=Errors(slope=s, ratio=s, intercept=s, junction=s), noise=0.0),
            prior_of(3),
            no_spread(3),
        ).weight[:, 0]
        for s in (0.02, 0.002)
    ]
    assert sure[1].mean() > sure[0].mean()
    assert sure[1].min() > 0.95


@pytest.mark.parametrize("branches", [2, 3])
def test_exact_readings_of_the_offsets_make_no_false_drifts(branches: int) -> None:
    """A hardware offset and a sensor offset in one branch, both known once the sensors were read without a current."""
    K = branches
    relative, constant = np.zeros((1, K + 1)), np.zeros((1, 2 * K - 1))
    constant[0, 0], constant[0, K - 1] = 0.113, -0.171
    truth = faults_of(relative, constant)
    readings = replace(no_readings(1, K), offset_a=truth.offset_a, offset_sd_a=np.full((1, K), 1e-4 * FULL_SCALE_A))
    rows = with_readings(rows_of(truth, seed=2), readings, full_scale_a=FULL_SCALE_A)
    states = enumerate_states(rows, prior_of(K), no_spread(K))
    false_drift = (states.relative[0] != 0.0).any(axis=1)
    assert states.weight[0, false_drift].sum() < 0.05
    np.testing.assert_allclose(states.constant[0, 0], constant[0], atol=0.003)
    assert states.weight[0, 0] > 0.9


def test_a_drift_that_no_row_tells_keeps_its_prior() -> None:
    """The third branch hardly moves: whether its sensor drifts, and how far, is as open as before."""
    K = 3
    rows = rows_of(faults_of(np.zeros((1, K + 1)), np.zeros((1, 2 * K - 1))), noise=0.0)
    covariance = rows.covariance.copy()
    for row in (K - 1, 2 * K - 2):
        covariance[:, row, row] = UNKNOWN_VARIANCE
    prior = prior_of(K)
    states = enumerate_states(replace(rows, covariance=covariance), prior, no_spread(K))
    drift, weight = states.drift[0, :, 2], states.weight[0]
    alone = (states.hardware_count[0] == 0) & (states.sensor_count[0] == 1) & (drift != 0.0)
    log_share = prior.log_supports()
    expected = np.exp(log_share[0, 1] - logsumexp([log_share[0, 0], log_share[0, 1]]))
    nothing = (states.hardware_count[0] == 0) & (states.sensor_count[0] == 0)
    found = weight[alone].sum() / (weight[alone].sum() + weight[nothing].sum())
    assert found == pytest.approx(expected, rel=0.05)
    magnitudes = np.abs(drift[alone])
    assert magnitudes.min() < 0.07
    assert magnitudes.max() > 0.23
    assert np.sum(weight[alone] * np.sign(drift[alone])) == pytest.approx(0.0, abs=1e-3)


def test_impossible_rows_still_give_probabilities() -> None:
    rows = rows_of(random_faults(15, vehicles=2, branches=2, sparsity=80.0), errors=SHARP)
    rows.relative[0, :2], rows.constant[1, :2] = 3.0, -40.0
    states = enumerate_states(rows, paper_prior(2, 1), no_spread(2))
    np.testing.assert_allclose(states.weight.sum(axis=1), 1.0, atol=1e-4)
    assert (states.weight.sum(axis=1) < 1.0 + 1e-9).all()
    assert np.isfinite(states.log_evidence).all()


def test_rows_that_are_not_finite_are_refused() -> None:
    rows = rows_of(random_faults(16, vehicles=2, branches=2, sparsity=80.0))
    with pytest.raises(FleetError, match="evidence is not finite; leave out the vehicles that have none"):
        FleetRows(relative=rows.relative * np.nan, constant=rows.constant, covariance=rows.covariance)


def test_mean_of_equal_posteriors_is_the_same_posterior() -> None:
    rows = rows_of(random_faults(17, vehicles=5, branches=2, sparsity=60.0))
    states = enumerate_states(rows, prior_of(2), no_spread(2))
    both = mean_states([states, states])
    np.testing.assert_allclose(both.weight.sum(axis=1), 1.0, atol=1e-4)
    np.testing.assert_allclose(both.log_evidence, states.log_evidence)
    np.testing.assert_allclose(first_parameters(both), first_parameters(states))
    np.testing.assert_allclose(both.weight[:, :2].sum(axis=1), states.weight[:, 0], rtol=1e-3)
    assert mean_states([states]) is states


def test_counts_of_hardware_and_sensor_faults_are_read_from_the_parameters() -> None:
    faults = random_faults(18, vehicles=30, branches=2, sparsity=60.0)
    states = enumerate_states(rows_of(faults), prior_of(2), no_spread(2))
    for s, j in product(range(5), range(30)):
        hardware = int(states.relative[j, s, 0] != 0.0) + int(states.constant[j, s, 0] != 0.0)
        assert states.hardware[j, s] == (hardware > 0)
        assert states.hardware_count[j, s] == hardware
        every = np.sum(states.relative[j, s] != 0.0) + np.sum(states.constant[j, s] != 0.0)
        assert states.sensor_count[j, s] == every - hardware


@pytest.mark.parametrize("sd", [0.001, 0.01, 0.03, 0.05])
def test_a_drift_told_by_the_mean_current_alone_makes_no_false_offset(sd: float) -> None:
    """The second branch hardly moves, so its slope and gain ratio are vague, but it carries a tenth of full scale."""
    K, N, own = 2, 20, 3e-4
    rng = np.random.default_rng(int(1000 * sd))
    d, true = np.array([0.0, 0.15]), np.array([-0.1, 0.1])
    measured = (1.0 + d) * true
    relative = np.zeros((N, 3 * K - 1))
    error = rng.normal(size=(N, 2 * K - 1)) * [0.001, sd, sd]
    relative[:, : 2 * K - 1] = relative_design(K)[: 2 * K - 1] @ np.log1p(np.append(0.0, d)) + error
    noise = own * rng.normal(size=(N, K + 1))
    b = (1.0 + d) * (true + noise[:, :K]) - np.exp(relative[:, :K]) * true
    c = measured[0] + np.exp(relative[:, K]) * measured[1] + noise[:, K]
    means = LineMeans(model=np.tile(true, (N, 1)), measured=np.tile(measured, (N, 1)))
    turn = np.repeat(np.eye(5 * K)[None], N, axis=0)
    turn[:, 3 * K - 1 : 4 * K, : 2 * K - 1] = means.lever(relative)
    unknown = np.full(K, UNKNOWN_VARIANCE)
    at_means = np.diag(np.concatenate([[1e-6, sd**2, sd**2], unknown, np.full(K + 1, own**2), unknown]))
    rows = FleetRows(
        relative=relative,
        constant=np.concatenate([b, c[:, None], np.zeros((N, K))], axis=1),
        covariance=turn @ at_means @ np.swapaxes(turn, 1, 2),
        means=means,
    )
    states = enumerate_states(rows, prior_of(K), no_spread(K))
    false_offset = (states.constant != 0.0).any(axis=2)
    assert np.sum(states.weight * false_offset, axis=1).mean() < 0.03
    drift = np.sum(states.weight * states.drift[:, :, 1], axis=1)
    np.testing.assert_allclose(drift, 0.15, atol=0.02)
    assert np.median(np.abs(drift - 0.15)) < min(sd, 2.0 * own / 0.1)


def test_a_drift_that_no_row_tells_shows_in_the_hardware_offset_that_it_scales() -> None:
    """The third branch hardly moves. Both hardware offsets sum to zero once its drift is taken out."""
    K, drift, hardware = 3, 0.2, 0.239
    measured = np.array([hardware, 0.0, -(1.0 + drift) * hardware])
    relative, constant = np.zeros((1, 3 * K - 1)), np.zeros((1, 2 * K + 1))
    constant[0, :K], constant[0, K] = measured, measured.sum()
    means = LineMeans(model=np.zeros((1, K)), measured=measured[None])
    at_means = Errors().covariance(K)
    for row in (K - 1, 2 * K - 2):
        at_means[row, row] = UNKNOWN_VARIANCE
    turn = np.eye(5 * K)
    turn[3 * K - 1 : 4 * K, : 2 * K - 1] = means.lever(relative)[0]
    rows = FleetRows(relative=relative, constant=constant, covariance=(turn @ at_means @ turn.T)[None], means=means)
    states = enumerate_states(rows, prior_of(K), no_spread(K))
    few = (states.sensor_count[0] == 1) & (states.hardware_count[0] == 1)
    right = few & (np.abs(states.drift[0, :, 2] - drift) < 0.02) & (np.abs(states.constant[0, :, 0] - hardware) < 0.01)
    other = few & (np.abs(states.offset[0, :, 2] + drift * hardware) < 0.01)
    assert states.weight[0, right].sum() > 0.1
    assert states.weight[0, right | other].sum() > 0.8


@pytest.mark.parametrize("slope_sd", [0.03, 0.1])
def test_an_offset_that_a_window_shows_does_not_move_with_the_drift(slope_sd: float) -> None:
    """Slope and gain ratio are off by 5 %; the mean current and the reading put the drift right."""
    true, d, o = np.array([-0.1, 0.1]), np.array([0.0, 0.15]), np.array([0.0, 0.1])
    measured, own = (1.0 + d) * true + o, 3e-4
    relative = np.zeros((1, 3 * 2 - 1))
    relative[0, :3] = relative_design(2)[:3] @ np.log1p(np.append(0.0, d)) + np.array([0.0, -0.05, 0.05])
    at_zero = measured - np.exp(relative[0, :2]) * true
    junction = measured[0] + np.exp(relative[0, 2]) * measured[1]
    means = LineMeans(model=true[None], measured=measured[None])
    turn = np.eye(10)
    turn[5:8, :3] = means.lever(relative)[0]
    variance = [1e-6, slope_sd**2, slope_sd**2, *[UNKNOWN_VARIANCE] * 2, *[own**2] * 3, UNKNOWN_VARIANCE, 2.5e-4**2]
    rows = FleetRows(
        relative=relative,
        constant=np.array([[*at_zero, junction, 0.0, o[1]]]),
        covariance=(turn @ np.diag(variance) @ turn.T)[None],
        means=means,
    )
    states = enumerate_states(rows, prior_of(2, hardware=0.02), no_spread(2))
    likely = states.weight[0] > 0.05
    assert likely.any()
    assert np.all(np.abs(states.offset[0, likely, 1] - o[1]) < 4.0 * states.constant_sd[0, likely, 2])
    assert np.all(states.constant_sd[0, likely, 2] < 5e-4)
