"""Worlds do what they say to the vehicles that have them, and nothing to the others."""

import numpy as np
import pytest

from calibrator.experiments.attacks import WORLDS
from calibrator.experiments.recorded_trips import NOISE, RecordedCase, RecordedFleet, record_vehicles, recorded_trial
from tests.calibrator.experiments.small_trials import small_fleet

SOUND = RecordedCase(sparsity=100.0)


@pytest.fixture(scope="module")
def fleet() -> RecordedFleet:
    return small_fleet(trips=20, samples=1800)


@pytest.mark.parametrize("world", WORLDS)
def test_world_changes_the_currents_of_those_that_have_it_alone(fleet: RecordedFleet, world: str) -> None:
    trips, case = fleet.with_branches(2), RecordedCase(sparsity=100.0, world=world)
    plain, attacked = (record_vehicles(fleet, one, trips, 2) for one in (SOUND, case))
    pairs = zip(plain.samples, attacked.samples, strict=True)
    changed = [not np.array_equal(a.currents_a, b.currents_a) for a, b in pairs]
    assert attacked.attack is not None
    np.testing.assert_array_equal(changed, attacked.attack.has)
    assert any(changed) == bool(WORLDS[world].share)


def test_truth_and_unseen_drive_are_those_of_the_world(fleet: RecordedFleet) -> None:
    sound, inverted, load, quadratic = (
        recorded_trial(fleet, RecordedCase(sparsity=100.0, world=world), 2)
        for world in ("", "inverted in 10%", "load 5 A in 30%", "quadratic 5-20 %")
    )
    np.testing.assert_array_equal(np.any(inverted.truth.drift == -2.0, axis=1), inverted.attacked)
    assert load.attacked is not None
    more_a = load.unseen.mean_a - sound.unseen.mean_a
    np.testing.assert_allclose(more_a[:, 0], 5.0 * load.attacked, atol=1e-9)
    np.testing.assert_allclose(load.unseen.error_mean_square_a2, 0.0, atol=1e-18)
    bent = np.any(quadratic.unseen.error_mean_square_a2 > 1e-6, axis=1)
    np.testing.assert_array_equal(bent, quadratic.attacked)
    sized = recorded_trial(fleet, RecordedCase(world="faults 30-60 %"), 3)
    sizes = np.abs(sized.truth.drift[sized.truth.drift != 0.0])
    assert sized.smallest_fault == 0.3 <= sizes.min() <= sizes.max() <= 0.6


def test_step_is_half_way_and_over_on_the_unseen_drive(fleet: RecordedFleet) -> None:
    trips = fleet.with_branches(2)
    vehicles = record_vehicles(fleet, RecordedCase(sparsity=100.0, world="gain step of 15 % midway"), trips, 2)
    assert vehicles.attack is not None
    j = int(np.flatnonzero(vehicles.attack.has)[0])
    k, size, half = vehicles.attack.branch[j], vehicles.attack.size[j], len(trips[j]) // 2
    ideal, measured = trips[j].matrix_a()[:, k], vehicles.samples[j].currents_a[:, k]
    for part, gain in ((slice(0, half), 1.0), (slice(half, None), 1.0 + size)):
        noise_a = np.std(measured[part] - gain * ideal[part])
        assert noise_a == pytest.approx(NOISE * fleet.full_scale_a, rel=0.2)
    assert abs(size) == pytest.approx(0.15)
    i, i_m = vehicles.currents_a(j, trips[j].matrix_a(), trips[j + 1].matrix_a())
    np.testing.assert_allclose(i_m[:, k], (1.0 + size) * i[:, k])
