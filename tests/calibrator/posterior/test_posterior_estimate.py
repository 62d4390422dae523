from dataclasses import replace

import numpy as np
import pytest

from calibrator.artificial.random_fleet import draw_faults
from calibrator.errors import FleetError
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows, with_load_spread
from calibrator.faults import Faults
from calibrator.posterior.estimate import FleetPosterior, Moments, estimate_fleet
from calibrator.posterior.hyperparameters import draw_hyperparameters, estimate_hyperparameters
from calibrator.posterior.slab import WIDEST
from calibrator.posterior.spread_starts import trusted_spread
from calibrator.posterior.unmeasured_load import unmeasured_load
from calibrator.score import recovered
from tests.calibrator.posterior.simulated_rows import (
    FULL_SCALE_A,
    Errors,
    parameters_of,
    prior_of,
    random_faults,
    rows_of,
)

K, VEHICLES = 2, 80


def moments_of(vehicles: int, branches: int = K) -> Moments:
    """Of usual drives: 60 A root mean square."""
    return Moments(mean_a=np.full((vehicles, branches), 5.0), mean_square_a2=np.full((vehicles, branches), 3600.0))


def estimate(faults: Faults, seed: int = 0, errors: Errors | None = None) -> FleetPosterior:
    rows = rows_of(faults, seed=seed, errors=errors)
    return estimate_fleet(rows, moments_of(len(faults), rows.branches), full_scale_a=FULL_SCALE_A)


def share_recovered(posterior: FleetPosterior, truth: Faults) -> float:
    return float(recovered(posterior.faults, truth, full_scale_a=FULL_SCALE_A, smallest_fault=0.05).mean())


@pytest.fixture(scope="module")
def truth() -> Faults:
    return random_faults(1, vehicles=VEHICLES, branches=K, sparsity=66.0)


@pytest.fixture(scope="module")
def posterior(truth: Faults) -> FleetPosterior:
    return estimate(truth, seed=1)


def test_faults_of_a_lopsided_fleet_are_recovered(truth: Faults, posterior: FleetPosterior) -> None:
    assert share_recovered(posterior, truth) > 0.85


def test_confidence_is_the_share_recovered(truth: Faults, posterior: FleetPosterior) -> None:
    right = recovered(posterior.faults, truth, full_scale_a=FULL_SCALE_A, smallest_fault=0.05)
    assert posterior.confidence.mean() == pytest.approx(right.mean(), abs=0.1)
    assert right[posterior.confidence > 0.95].mean() > 0.95


def test_probabilities_of_faults_tell_the_faulty_from_the_others(truth: Faults, posterior: FleetPosterior) -> None:
    faulty = (truth.drift != 0.0) | (truth.offset_a != 0.0)
    assert posterior.sensor_fault[faulty].mean() > 0.85
    assert posterior.sensor_fault[~faulty].mean() < 0.15
    hardware = truth.has_hardware_fault
    assert posterior.hardware_fault[hardware].mean() > posterior.hardware_fault[~hardware].mean() + 0.5


def test_hyperparameters_are_those_that_the_fleet_was_drawn_with(truth: Faults, posterior: FleetPosterior) -> None:
    learnt = posterior.hyperparameters
    assert learnt.prior.hardware_share == pytest.approx(truth.has_hardware_fault.mean(), abs=0.15)
    for slab, parameters in zip((learnt.prior.relative, learnt.prior.constant), parameters_of(truth), strict=True):
        magnitudes = np.abs(parameters[parameters != 0.0])
        assert slab.low == pytest.approx(magnitudes.min(), abs=0.015)
        assert slab.high == pytest.approx(magnitudes.max(), abs=0.015)
    assert np.abs(learnt.spread.mean).max() < 0.003
    np.testing.assert_allclose(learnt.prior.counts.sum(), 1.0)


def test_spread_between_faultless_vehicles_is_learnt() -> None:
    wide = Errors(slope=0.010, ratio=0.0005, intercept=0.001, junction=0.0005)
    faults = random_faults(2, vehicles=VEHICLES, branches=K, sparsity=66.0)
    rows = rows_of(faults, seed=2, errors=wide)
    stated = replace(rows, covariance=np.repeat(Errors().covariance(K)[None], VEHICLES, axis=0))
    posterior = estimate_fleet(stated, moments_of(VEHICLES), full_scale_a=FULL_SCALE_A)
    learnt = np.sqrt(np.diag(posterior.hyperparameters.spread.covariance))[:K]
    np.testing.assert_allclose(learnt, np.sqrt(0.010**2 - 0.002**2), rtol=0.4)


def test_intercepts_that_err_more_than_blocks_tell_are_believed_less() -> None:
    """Three times the stated deviation in the first branch's intercept, in proportion to what is stated."""
    faults = random_faults(3, vehicles=200, branches=K, sparsity=66.0)
    rng = np.random.default_rng(3)
    rows = rows_of(faults, seed=3)
    scale = rng.uniform(0.3, 3.0, len(faults))
    intercepts = slice(3 * K - 1, 4 * K - 1)
    covariance = rows.covariance.copy()
    covariance[:, intercepts, intercepts] *= (scale**2)[:, None, None]
    error = np.sqrt(covariance[:, 3 * K - 1, 3 * K - 1]) * rng.normal(size=len(faults))
    constant = rows.constant.copy()
    constant[:, 0] += np.sqrt(9.0 - 1.0) * error * (1.0 + faults.drift[:, 0])
    stated = replace(rows, constant=constant, covariance=covariance)
    learnt = estimate_fleet(stated, moments_of(len(faults)), full_scale_a=FULL_SCALE_A).hyperparameters.spread
    first, second = np.broadcast_to(learnt.dispersion, K)
    assert 3.0 < first < 13.0
    assert 1.0 <= second < 2.5


def test_what_a_large_fleet_teaches_does_not_depend_on_its_order() -> None:
    faults = random_faults(4, vehicles=330, branches=K, sparsity=66.0)
    rows, order = rows_of(faults, seed=4), np.random.default_rng(4).permutation(330)
    plain, mixed = (
        estimate_fleet(some, moments_of(330), full_scale_a=FULL_SCALE_A) for some in (rows, rows.take(order))
    )
    np.testing.assert_allclose(mixed.confidence, plain.confidence[order], atol=1e-6)
    np.testing.assert_allclose(mixed.hyperparameters.spread.mean, plain.hyperparameters.spread.mean, atol=1e-9)


def test_trusted_vehicles_tell_the_reference_as_well_as_their_number_does(truth: Faults) -> None:
    rows = rows_of(truth, seed=1)
    trusted = np.zeros(VEHICLES, bool)
    trusted[np.flatnonzero(~truth.has_hardware_fault & ~(truth.drift.any(axis=1) | truth.offset_a.any(axis=1)))[:3]] = (
        True
    )
    best = estimate_hyperparameters(rows, [trusted_spread(rows, trusted)], free=np.zeros(5 * K, bool))
    drawn = draw_hyperparameters(rows, best, carriers=rows.take(trusted))
    deviation = np.std([each.spread.mean[0] for each in drawn])
    one = np.sqrt(np.median(rows.covariance[:, 0, 0]) + best.spread.covariance[0, 0])
    assert deviation == pytest.approx(one * np.sqrt(np.pi / 2.0 / 3.0), rel=0.5)


def test_a_trusted_vehicle_that_never_used_a_branch_says_nothing_of_its_centre(truth: Faults) -> None:
    rows = rows_of(truth, seed=1)
    relative, covariance = rows.relative.copy(), rows.covariance.copy()
    relative[0, 1], relative[1:3, 1], covariance[1:3, 1, 1] = 0.03, 0.0, UNKNOWN_VARIANCE
    trusted = np.arange(VEHICLES) < 3
    assert trusted_spread(replace(rows, relative=relative, covariance=covariance), trusted).mean[1] == 0.03


def test_a_load_is_found_beside_a_larger_batch_of_offsets() -> None:
    rng = np.random.default_rng(1)
    constant = np.repeat([-0.01, 0.0075, 0.05], [45, 35, 20]) + 1e-4 * rng.normal(size=100)
    load = unmeasured_load(constant, np.full(100, 1e-4))
    assert load.centre == pytest.approx(0.0075, abs=2e-4)
    assert load.share == pytest.approx(0.35, abs=0.05)


def test_a_load_that_is_the_same_in_every_vehicle_is_found() -> None:
    rng = np.random.default_rng(1)
    sd = np.full(16, 3e-5)
    load = unmeasured_load(0.0075 + 1.5 * sd * rng.normal(size=16), sd)
    assert load.centre == pytest.approx(0.0075, abs=1e-4)
    assert load.share > 0.9


def test_a_declared_load_takes_the_place_of_the_one_that_few_vehicles_tell() -> None:
    truth = random_faults(4, vehicles=8, branches=K, sparsity=66.0)
    load = 0.0075 + 0.0025 * np.random.default_rng(2).normal(size=8)
    rows = rows_of(truth, seed=3)
    rows.constant[:, K] += load * (1.0 + truth.drift[:, 0])
    told = with_load_spread(rows, 0.0025)
    given = estimate_fleet(told, moments_of(8), full_scale_a=FULL_SCALE_A, load=0.0075, given=prior_of(K))
    assert given.hyperparameters.spread.mean[4 * K - 1] == 0.0075
    wrong = estimate_fleet(told, moments_of(8), full_scale_a=FULL_SCALE_A, load=0.03, given=prior_of(K))
    assert given.hyperparameters.log_evidence > wrong.hyperparameters.log_evidence + 5.0


def test_the_spread_of_loads_widens_the_constant_alone(truth: Faults) -> None:
    rows = rows_of(truth)
    added = with_load_spread(rows, 0.0025).covariance - rows.covariance
    expected = np.zeros((5 * K, 5 * K))
    expected[4 * K - 1, 4 * K - 1] = 0.0025**2
    np.testing.assert_allclose(added, np.broadcast_to(expected, added.shape), atol=1e-12)


def test_a_large_fleet_with_few_trusted_vehicles_keeps_the_doubt_about_its_centre(truth: Faults) -> None:
    rows = rows_of(truth, seed=1)
    many = rows.take(np.tile(np.arange(VEHICLES), 3))
    best = estimate_hyperparameters(rows, [trusted_spread(rows, np.arange(VEHICLES) < 2)], free=np.zeros(5 * K, bool))
    (only,) = draw_hyperparameters(many, best, carriers=rows.take(slice(0, 2)))
    added = only.spread.covariance - best.spread.covariance
    one = np.median(rows.covariance[:, 0, 0]) + best.spread.covariance[0, 0]
    assert added[0, 0] == pytest.approx(one * np.pi / 2.0 / 2.0, rel=0.2)
    assert added[K, K] == 0.0


def test_a_given_prior_is_kept(truth: Faults) -> None:
    prior = prior_of(K)
    posterior = estimate_fleet(rows_of(truth), moments_of(VEHICLES), full_scale_a=FULL_SCALE_A, given=prior)
    assert posterior.hyperparameters.prior == prior
    assert share_recovered(posterior, truth) > 0.85


def test_a_fleet_without_faults_gets_no_corrections() -> None:
    none = draw_faults(
        np.random.default_rng(3),
        vehicles=40,
        branches=K,
        sparsity=100.0,
        magnitude=(0.05, 0.25),
        full_scale_a=FULL_SCALE_A,
    )
    posterior = estimate(none, seed=3)
    assert np.abs(posterior.faults.drift).max() < 0.005
    assert np.abs(posterior.faults.offset_a).max() < 0.005 * FULL_SCALE_A
    assert posterior.sensor_fault.mean() < 0.1


def fleet_with_small_offsets(seed: int, vehicles: int = 100) -> Faults:
    """Sensors alone are faulty: drifts of 7 to 25 %, offsets of 3 to 10 A, and of two branches of 0.3 to 0.9 A only."""
    rng, branches = np.random.default_rng(seed), 3
    largest = np.concatenate([np.full(branches, 0.25), FULL_SCALE_A * np.array([0.025, 0.0022, 0.0022])])
    faults = np.zeros((vehicles, 2 * branches))
    for vehicle in range(vehicles):
        for place in rng.choice(2 * branches, rng.choice(3, p=[0.45, 0.4, 0.15]), replace=False):
            faults[vehicle, place] = largest[place] * rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.0)
    none = np.zeros((vehicles, branches))
    return Faults(
        hardware_drift=none[:, 0], hardware_offset_a=none, drift=faults[:, :branches], offset_a=faults[:, branches:]
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_offsets_smaller_than_the_smallest_looked_for_are_no_hardware_fault(seed: int) -> None:
    """A hardware current and an offset that cancel on one branch would leave the same small offset of another."""
    faults = fleet_with_small_offsets(seed)
    small = ((faults.offset_a != 0.0) & (np.abs(faults.offset_a) < WIDEST.low * FULL_SCALE_A)).any(axis=1)
    posterior = estimate(faults, seed=seed, errors=Errors(intercept=0.0006, junction=0.00005))
    assert small.sum() > 15
    assert posterior.hardware_fault.max() < 0.1
    assert posterior.hyperparameters.prior.hardware_share < 0.02
    found = np.abs(posterior.faults.offset_a - faults.offset_a).max(axis=1) < 0.3
    assert found[small].mean() > 0.6
    corrected = (posterior.harm < 1e-3) & (posterior.faults.offset_a != 0.0)
    left = np.abs(posterior.faults.offset_a - faults.offset_a)
    assert (left < np.abs(faults.offset_a))[corrected].all()


def test_an_error_of_the_reference_common_to_all_is_taken_out(truth: Faults, posterior: FleetPosterior) -> None:
    rows = rows_of(truth, seed=1)
    relative = rows.relative.copy()
    relative[:, :K] += 0.03
    moved = estimate_fleet(
        FleetRows(relative=relative, constant=rows.constant, covariance=rows.covariance),
        moments_of(VEHICLES),
        full_scale_a=FULL_SCALE_A,
    )
    np.testing.assert_allclose(moved.hyperparameters.spread.mean[:K], 0.03, atol=0.003)
    assert share_recovered(moved, truth) == pytest.approx(share_recovered(posterior, truth), abs=0.05)


def test_what_is_sure_does_no_harm(truth: Faults, posterior: FleetPosterior) -> None:
    deployed = (posterior.harm < 1e-3) & ((posterior.faults.drift != 0.0) | (posterior.faults.offset_a != 0.0))
    before = np.hypot(truth.drift, truth.offset_a / FULL_SCALE_A)
    left = np.hypot(posterior.faults.drift - truth.drift, (posterior.faults.offset_a - truth.offset_a) / FULL_SCALE_A)
    assert deployed.sum() > 30
    assert (left < before)[deployed].all()


def test_deviations_are_those_of_the_errors(truth: Faults, posterior: FleetPosterior) -> None:
    sure = posterior.confidence > 0.99
    z = (posterior.faults.drift - truth.drift)[sure] / np.maximum(posterior.drift_sd[sure], 1e-4)
    assert np.sqrt(np.mean(z[truth.drift[sure] != 0.0] ** 2)) < 2.0


def test_evidence_of_the_wrong_shape_is_refused() -> None:
    rows = rows_of(random_faults(5, vehicles=3, branches=K, sparsity=66.0))
    with pytest.raises(FleetError, match="do not fit a covariance"):
        replace(rows, covariance=rows.covariance[:2])
