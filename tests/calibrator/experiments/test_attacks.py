"""Worlds do what they say to the vehicles that have them, and nothing to the others."""

import numpy as np
import pytest

from calibrator.experiments.attacks import WORLDS
from calibrator.experiments.baselines import BASELINES
from calibrator.experiments.figures import judge
from calibrator.experiments.methods import POSTERIOR
from calibrator.experiments.recorded_trips import NOISE, RecordedCase, RecordedFleet, record_vehicles, recorded_trial
from tests.calibrator.experiments.small_trials import small_fleet

SOUND = RecordedCase(sparsity=100.0)


@pytest.fixture(scope="module")
def fleet() -> RecordedFleet:
    return small_fleet(trips=20, samples=1800)


@pytest.mark.parametrize("world", WORLDS)
def test_world_changes_the_currents_of_those_that_have_it_alone(fleet: RecordedFleet, world: str) -> None:
    trips = fleet.with_branches(2)
    case = RecordedCase(sparsity=100.0, world=world)
    plain, attacked = (record_vehicles(fleet, one, trips, 3).samples for one in (SOUND, case))
    trial = recorded_trial(fleet, case, 3)
    assert trial.attacked is not None
    changed = [not np.array_equal(a.currents_a, b.currents_a) for a, b in zip(plain, attacked, strict=True)]
    np.testing.assert_array_equal(changed, trial.attacked)
    if WORLDS[world].share:
        assert any(changed)


def test_truth_and_unseen_drive_are_those_of_the_world(fleet: RecordedFleet) -> None:
    inverted = recorded_trial(fleet, RecordedCase(sparsity=100.0, world="inverted in 10%"), 3)
    assert inverted.attacked is not None
    np.testing.assert_array_equal(np.any(inverted.truth.drift == -2.0, axis=1), inverted.attacked)
    load = recorded_trial(fleet, RecordedCase(sparsity=100.0, world="load 5 A in 30%"), 3)
    without = recorded_trial(fleet, SOUND, 3)
    more_a = load.unseen.mean_a - without.unseen.mean_a
    assert load.attacked is not None
    np.testing.assert_allclose(more_a[:, 0], 5.0 * load.attacked, atol=1e-9)
    np.testing.assert_allclose(load.unseen.error_mean_square_a2, 0.0, atol=1e-18)
    quadratic = recorded_trial(fleet, RecordedCase(sparsity=100.0, world="quadratic 5-20 %"), 3)
    assert quadratic.attacked is not None
    np.testing.assert_array_equal(np.any(quadratic.unseen.error_mean_square_a2 > 1e-6, axis=1), quadratic.attacked)


def test_nothing_is_sure_of_a_vehicle_with_an_inverted_sensor(fleet: RecordedFleet) -> None:
    trial = recorded_trial(fleet, RecordedCase(sparsity=100.0, world="inverted in 10%"), 3)
    found = POSTERIOR.estimate(trial)
    assert trial.attacked is not None
    assert found.confidence is not None
    assert trial.attacked.any()
    assert found.confidence[trial.attacked].max() < 0.1
    assert np.median(found.confidence[~trial.attacked]) > 0.9


def test_step_is_half_way_and_over_on_the_unseen_drive(fleet: RecordedFleet) -> None:
    case = RecordedCase(sparsity=100.0, world="gain step of 15 % midway")
    trips = fleet.with_branches(2)
    vehicles = record_vehicles(fleet, case, trips, 3)
    assert vehicles.attack is not None
    j = int(np.flatnonzero(vehicles.attack.has)[0])
    k, half = vehicles.attack.branch[j], len(trips[j]) // 2
    ideal, measured = trips[j].matrix_a()[:, k], vehicles.samples[j].currents_a[:, k]
    noise_a = NOISE * fleet.full_scale_a
    for part, gain in ((slice(0, half), 1.0), (slice(half, None), 1.0 + vehicles.attack.size[j])):
        assert np.std(measured[part] - gain * ideal[part]) == pytest.approx(noise_a, rel=0.2)
    assert abs(vehicles.attack.size[j]) == pytest.approx(0.15)
    i, i_m = vehicles.currents_a(j, trips[j].matrix_a(), trips[j + 1].matrix_a())
    np.testing.assert_allclose(i_m[:, k], (1.0 + vehicles.attack.size[j]) * i[:, k])


def test_recovery_counts_faults_of_the_size_of_the_world(fleet: RecordedFleet) -> None:
    trial = recorded_trial(fleet, RecordedCase(world="faults 30-60 %"), 3)
    assert trial.smallest_fault == 0.3
    sizes = np.abs(trial.truth.drift[trial.truth.drift != 0.0])
    assert 0.3 <= sizes.min() <= sizes.max() <= 0.6
    assert "named" not in judge(BASELINES[2].estimate(trial), trial)
