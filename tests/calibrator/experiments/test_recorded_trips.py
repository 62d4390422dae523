from dataclasses import replace

import numpy as np
import pytest

from calibrator.artificial.random_fleet import FaultSettings
from calibrator.errors import FleetError
from calibrator.experiments.attacks import WORLDS
from calibrator.experiments.figures import judge
from calibrator.experiments.methods import PERFECT, POSTERIOR
from calibrator.experiments.recorded_trips import NOISE, RecordedCase, RecordedFleet, record_vehicles, recorded_trial
from calibrator.experiments.trial import drawn_distribution
from calibrator.faults import true_currents
from tests.calibrator.experiments.small_trials import small_fleet


@pytest.fixture(scope="module")
def fleet() -> RecordedFleet:
    return small_fleet()


def test_recorded_samples_obey_the_fault_model_within_noise_and_quantisation(fleet: RecordedFleet) -> None:
    case = RecordedCase(branches=3, sparsity=60.0, unmeasured_a=(3.0, 1.0))
    trips = fleet.with_branches(3)
    vehicles = record_vehicles(fleet, case, trips, 0)
    truth, noise_a = vehicles.truth, NOISE * fleet.full_scale_a
    for j, samples in enumerate(vehicles.samples):
        true = (samples.currents_a - truth.offset_a[j]) / (1.0 + truth.drift[j])
        sums = true.sum(axis=1)
        assert sums.mean() == pytest.approx(vehicles.unmeasured_a[j], abs=0.1)
        assert sums.std() == pytest.approx(noise_a * np.sqrt(np.sum((1.0 + truth.drift[j]) ** -2)), rel=0.1)
        steps = samples.currents_a / [fleet.database.current_step_a(name) for name in samples.branch_names]
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    assert vehicles.unmeasured_a.std() > 0.3


def test_default_method_recovers_recorded_vehicles_that_defeat_the_published_method(fleet: RecordedFleet) -> None:
    trial = recorded_trial(fleet, RecordedCase(), 0)
    default, published = (judge(m.estimate(trial), trial) for m in (POSTERIOR, PERFECT))
    assert default["recovery_rate"].mean() >= 0.9
    assert not default["harmed"].any()
    assert published["recovery_rate"].mean() < 0.6
    # corrections are judged on the trip of the next vehicle, whose hardware fault is another one
    following, faults = fleet.with_branches(2)[1].matrix_a(), trial.truth.take(0)
    np.testing.assert_allclose(trial.unseen.mean_a[0], true_currents(following, faults).mean(axis=0))


@pytest.mark.parametrize(("branches", "sparsity", "balanced"), [(2, 20.0, True), (2, 80.0, False), (3, 60.0, True)])
def test_known_distribution_of_faults_matches_drawn_fleets(branches: int, sparsity: float, balanced: bool) -> None:
    rng, vehicles = np.random.default_rng(1), 40_000
    settings = FaultSettings(sparsity=sparsity, balanced=balanced)
    known = drawn_distribution(settings, branches)
    assert known is not None
    assert known.counts.sum() == pytest.approx(1.0)
    drawn = settings.draw(rng, vehicles=vehicles, branches=branches, full_scale_a=400.0)
    for faults in (drawn, known.draw(rng, vehicles, 400.0)):
        hardware = (faults.hardware_drift != 0.0) + np.count_nonzero(faults.hardware_offset_a[:, :-1], axis=1)
        sensor = np.count_nonzero(faults.drift, axis=1) + np.count_nonzero(faults.offset_a, axis=1)
        counts = np.zeros((branches + 1, 2 * branches + 1))
        np.add.at(counts, (hardware, sensor), 1.0 / vehicles)
        np.testing.assert_allclose(known.counts, counts, atol=0.01)
        sizes = np.abs(faults.drift[faults.drift != 0.0])
        assert (sizes.min(), sizes.mean(), sizes.max()) == pytest.approx((0.05, 0.15, 0.25), abs=0.002)
        np.testing.assert_allclose(faults.hardware_offset_a.sum(axis=1), 0.0, atol=1e-9)


@pytest.mark.long
def test_faults_can_be_drawn_from_the_learnt_prior_for_the_same_trips(fleet: RecordedFleet) -> None:
    first, own = (recorded_trial(fleet, RecordedCase(own_prior=prior), 0) for prior in (None, POSTERIOR))
    assert not np.array_equal(own.truth.drift, first.truth.drift)
    learnt = POSTERIOR.estimate(first).learnt
    assert own.drawn_from is not None
    assert learnt is not None
    np.testing.assert_array_equal(own.drawn_from.counts, learnt.counts)
    assert judge(POSTERIOR.estimate(own), own)["recovery_rate"].mean() >= 0.8


def test_recorded_case_of_a_given_drive_length_has_the_requested_number_of_vehicles(fleet: RecordedFleet) -> None:
    trial = recorded_trial(fleet, RecordedCase(vehicles=15, minutes=2.0), 0)
    assert len(trial.truth) == len(trial.evidence.slopes) == 15
    with pytest.raises(FleetError, match="3 usable trips, at least 4 are needed"):
        recorded_trial(fleet, RecordedCase(vehicles=3, minutes=2.0), 0)


def test_delays_are_removed_unless_they_are_to_be_left_in(fleet: RecordedFleet) -> None:
    few, case = fleet.take(4, duration_s=150.0), RecordedCase(delay_max_s=0.3)
    trial, left_in = (recorded_trial(few, replace(case, delays_left_in=left), 0) for left in (False, True))
    assert trial.delay_error_s is not None
    assert trial.delay_error_s.shape == (4, 1)
    assert np.abs(trial.delay_error_s).max() < 0.01
    assert left_in.delay_error_s is None
    np.testing.assert_array_equal(left_in.truth.drift, trial.truth.drift)


# Worlds change the vehicles that they affect as they are defined, and no others


SOUND = RecordedCase(sparsity=100.0)


@pytest.fixture(scope="module")
def many() -> RecordedFleet:
    return small_fleet(trips=20, samples=1800)


@pytest.mark.parametrize("world", WORLDS)
def test_attack_changes_only_the_currents_of_affected_vehicles(many: RecordedFleet, world: str) -> None:
    trips, case = many.with_branches(2), RecordedCase(sparsity=100.0, world=world)
    plain, attacked = (record_vehicles(many, one, trips, 2) for one in (SOUND, case))
    pairs = zip(plain.samples, attacked.samples, strict=True)
    changed = [not np.array_equal(a.currents_a, b.currents_a) for a, b in pairs]
    assert attacked.attack is not None
    np.testing.assert_array_equal(changed, attacked.attack.has)
    assert any(changed) == bool(WORLDS[world].share)


def test_truth_and_unseen_drive_include_the_attack(many: RecordedFleet) -> None:
    sound, inverted, load, quadratic = (
        recorded_trial(many, RecordedCase(sparsity=100.0, world=world), 2)
        for world in ("", "inverted in 10%", "load 5 A in 30%", "quadratic 5-20 %")
    )
    np.testing.assert_array_equal(np.any(inverted.truth.drift == -2.0, axis=1), inverted.attacked)
    assert load.attacked is not None
    more_a = load.unseen.mean_a - sound.unseen.mean_a
    np.testing.assert_allclose(more_a[:, 0], 5.0 * load.attacked, atol=1e-9)
    np.testing.assert_allclose(load.unseen.error_mean_square_a2, 0.0, atol=1e-18)
    bent = np.any(quadratic.unseen.error_mean_square_a2 > 1e-6, axis=1)
    np.testing.assert_array_equal(bent, quadratic.attacked)
    sized = recorded_trial(many, RecordedCase(world="faults 30-60 %"), 3)
    sizes = np.abs(sized.truth.drift[sized.truth.drift != 0.0])
    assert sized.smallest_fault == 0.3 <= sizes.min() <= sizes.max() <= 0.6
