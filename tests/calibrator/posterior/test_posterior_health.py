"""Health of the fleet reference: what would fool it is noticed, and ordinary fleets raise no alarm."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.faults import Faults
from calibrator.posterior.estimate import Moments, estimate_fleet
from calibrator.posterior.health import ReferenceHealth, examine_reference
from ecu_node.layout import UnmeasuredLoad
from tests.calibrator.posterior.simulated_rows import FULL_SCALE_A, random_faults, rows_of

NAMES = ("battery", "motor", "auxiliary")


def examined(faults: Faults, *, seed: int = 0) -> ReferenceHealth:
    branches = faults.drift.shape[1]
    return examine_reference(rows_of(faults, seed=seed), NAMES[:branches], full_scale_a=FULL_SCALE_A)


def with_batch(faults: Faults, *, branch: int, drift: float, share: float) -> Faults:
    """The first so many vehicles get the same drift in one branch, and no other there."""
    changed = faults.drift.copy()
    changed[: int(share * len(faults)), branch] = drift
    return replace(faults, drift=changed)


@pytest.mark.parametrize("branches", [2, 3])
@pytest.mark.parametrize("sparsity", [60.0, 80.0])
@pytest.mark.parametrize("seed", range(4))
def test_ordinary_fleets_raise_no_alarm(branches: int, sparsity: float, seed: int) -> None:
    health = examined(random_faults(seed, vehicles=60, branches=branches, sparsity=sparsity), seed=seed)
    assert health.warnings == ()
    assert health.doubtful == ()


def with_drifts(vehicles: int, faulty: int, *, branch: int = 0, offset_a: float = 0.0, drift: float = 0.1) -> Faults:
    """A fleet without faults but for some vehicles' one sensor."""
    zero = np.zeros((vehicles, 2))
    d, o = zero.copy(), zero.copy()
    d[:faulty, branch], o[:faulty, branch] = drift * (-1.0) ** np.arange(faulty), offset_a
    return Faults(hardware_drift=np.zeros(vehicles), hardware_offset_a=zero, drift=d, offset_a=o)


@pytest.mark.parametrize("vehicles", [10, 20, 40, 80])
@pytest.mark.parametrize("faulty", [0, 1, 4])
def test_fleets_that_nearly_all_agree_raise_no_alarm(vehicles: int, faulty: int) -> None:
    for seed in range(5):
        health = examined(with_drifts(vehicles, faulty), seed=seed)
        assert (health.warnings, health.doubtful) == ((), ())
        assert health.least_vehicles <= 10


@pytest.mark.parametrize("vehicles", [10, 20, 40])
def test_a_fault_that_every_vehicle_has_is_noticed(vehicles: int) -> None:
    shared = with_drifts(vehicles, 0)
    gain = replace(shared, drift=shared.drift + np.array([0.06, 0.0]))
    offset = replace(shared, offset_a=shared.offset_a + np.array([0.0, 12.0]))
    for seed in range(5):
        assert any("breaks the junction law" in text for text in examined(gain, seed=seed).warnings)
        assert any("an offset that most vehicles share" in text for text in examined(offset, seed=seed).warnings)


def test_enough_trusted_vehicles_take_the_doubt_and_the_notice_says_so() -> None:
    fleet = with_batch(random_faults(1, vehicles=60, branches=2, sparsity=80.0), branch=0, drift=0.06, share=0.8)
    trusted = np.arange(60) >= 57
    rows = rows_of(fleet)
    carried = examine_reference(rows, NAMES[:2], full_scale_a=FULL_SCALE_A, trusted=trusted)
    assert carried.doubtful == ()
    assert any("the trusted vehicles carry the reference instead" in text for text in carried.warnings)
    few = examine_reference(rows, NAMES[:2], full_scale_a=FULL_SCALE_A, trusted=np.arange(60) >= 58)
    assert few.doubtful == (0, 1)
    assert any("with --trusted, at least 3 that use each branch" in text for text in few.warnings)


def test_gain_fault_of_most_vehicles_breaks_the_junction_law_and_names_both_branches_of_two() -> None:
    fleet = with_batch(random_faults(1, vehicles=60, branches=2, sparsity=80.0), branch=0, drift=0.06, share=0.8)
    health = examined(fleet)
    assert health.doubtful == (0, 1)
    assert any("breaks the junction law" in text and "battery or motor" in text for text in health.warnings)


@pytest.mark.parametrize("branch", [0, 1, 2])
def test_with_three_branches_the_batch_is_named_alone(branch: int) -> None:
    fleet = with_batch(random_faults(2, vehicles=60, branches=3, sparsity=80.0), branch=branch, drift=0.06, share=0.8)
    health = examined(fleet)
    assert health.doubtful == (branch,)
    assert f"in branch {NAMES[branch]};" in health.warnings[0]


@pytest.mark.parametrize("seed", range(4))
def test_a_batch_in_half_of_the_fleet_is_a_second_cluster_and_not_what_most_share(seed: int) -> None:
    none = np.zeros((16, 3))
    fleet = Faults(hardware_drift=np.zeros(16), hardware_offset_a=none, drift=none.copy(), offset_a=none.copy())
    fleet.drift[:8, 0] = 0.06
    health = examined(fleet, seed=seed)
    assert not any("breaks the junction law" in text for text in health.warnings)
    assert any("second cluster" in text and "battery" in text for text in health.warnings)


def test_an_offset_that_most_vehicles_share_is_noticed_and_doubted() -> None:
    fleet = random_faults(8, vehicles=60, branches=2, sparsity=80.0)
    offset = fleet.offset_a.copy()
    offset[:48, 1] += 8.0
    health = examined(replace(fleet, offset_a=offset))
    assert health.doubtful == (0, 1)
    assert any("no load without a sensor explains" in text for text in health.warnings)


def test_a_load_of_possible_size_is_taken_for_one() -> None:
    fleet = random_faults(8, vehicles=60, branches=2, sparsity=80.0)
    load = np.random.default_rng(2).normal(3.0, 1.0, 60)
    rows = rows_of(fleet)
    constant = rows.constant.copy()
    constant[:, 2] += load * (1.0 + fleet.drift[:, 0]) / FULL_SCALE_A
    health = examine_reference(replace(rows, constant=constant), NAMES[:2], full_scale_a=FULL_SCALE_A)
    assert health.doubtful == ()
    assert health.unmeasured_a == pytest.approx(3.0, abs=0.7)


@pytest.mark.parametrize(("sum_a", "told"), [(3.0, False), (9.0, True), (-3.0, True)])
def test_a_declared_load_is_expected_and_anything_else_is_an_offset(sum_a: float, told: bool) -> None:
    rows = rows_of(random_faults(8, vehicles=60, branches=2, sparsity=80.0))
    constant = rows.constant.copy()
    constant[:, 2] += sum_a / FULL_SCALE_A
    load = UnmeasuredLoad(mean_a=3.0, sd_a=0.5)
    health = examine_reference(replace(rows, constant=constant), NAMES[:2], full_scale_a=FULL_SCALE_A, load=load)
    assert any("which the declared load of 3 A does not explain" in text for text in health.warnings) == told
    assert len(health.warnings) == int(told)
    assert health.doubtful == ((0, 1) if told else ())
    assert health.unmeasured_a == 3.0


def test_two_variants_are_noticed_with_their_number() -> None:
    fleet = random_faults(3, vehicles=80, branches=2, sparsity=80.0)
    variant = np.arange(80) < 28
    fleet = replace(fleet, hardware_drift=np.where(variant, 0.12, fleet.hardware_drift))
    warnings = examined(fleet).warnings
    assert any("two variants of the vehicle" in text for text in warnings)


def test_a_branch_whose_sensors_are_all_faulty_is_named() -> None:
    rng = np.random.default_rng(4)
    fleet = random_faults(4, vehicles=60, branches=3, sparsity=80.0)
    drift = fleet.drift.copy()
    drift[:, 1] = rng.choice([-1.0, 1.0], 60) * rng.uniform(0.05, 0.25, 60)
    health = examined(replace(fleet, drift=drift))
    assert 1 in health.doubtful
    assert any("no cluster of vehicles agrees in branch motor" in text for text in health.warnings)


def test_small_fleet_is_told_how_many_vehicles_it_needs() -> None:
    health = examined(random_faults(5, vehicles=6, branches=2, sparsity=40.0))
    assert health.least_vehicles > 6
    assert any(f"at least {health.least_vehicles} are needed" in text for text in health.warnings)


def test_distance_of_the_mean_is_that_of_a_fleet_whose_faults_share_a_sign() -> None:
    fleet = random_faults(6, vehicles=200, branches=2, sparsity=60.0)
    fleet = replace(fleet, drift=np.abs(fleet.drift), hardware_drift=np.abs(fleet.hardware_drift))
    expected = np.mean(np.log1p(fleet.drift) + np.log1p(fleet.hardware_drift)[:, None], axis=0)
    np.testing.assert_allclose(examined(fleet).mean_distance, expected, atol=0.003)


def test_branches_come_back_in_their_own_order() -> None:
    fleet = with_batch(random_faults(2, vehicles=60, branches=3, sparsity=80.0), branch=2, drift=0.06, share=0.8)
    health = examined(fleet)
    turned = health.in_order(np.array([2, 0, 1]))
    assert turned.doubtful == (0,)
    assert turned.agreeing_share == (health.agreeing_share[2], health.agreeing_share[0], health.agreeing_share[1])


def test_trusted_vehicles_carry_the_reference_of_a_fleet_with_a_batch_fault() -> None:
    fleet = with_batch(random_faults(7, vehicles=60, branches=2, sparsity=80.0), branch=0, drift=0.06, share=0.8)
    faultless = ~fleet.has_sensor_fault & ~fleet.has_hardware_fault
    assert faultless.sum() >= 3
    moments = Moments(mean_a=np.full((60, 2), 10.0), mean_square_a2=np.full((60, 2), 2500.0))
    posterior = estimate_fleet(rows_of(fleet), moments, full_scale_a=FULL_SCALE_A, trusted=faultless)
    batch = np.arange(60) < 48
    found = np.abs(posterior.faults.drift[batch, 0] - fleet.drift[batch, 0]) < 0.01
    assert found.mean() > 0.8
