"""From drive summaries to the posterior: trusted vehicles carry the reference, as far as they can be trusted."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Mask
from calibrator.faults import Faults
from calibrator.posterior.bench import contradicted_readings, trust_notices
from calibrator.posterior.calibration import calibrate_posterior
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.health import ReferenceHealth
from ecu_node.layout import UnmeasuredLoad
from tests.calibrator.evidence.simulated_drives import Conditions, no_faults, summaries_of

FULL_SCALE_A = 400.0
VEHICLES = 16


def calibrated(
    faults: Faults,
    trusted: Mask,
    *,
    load: UnmeasuredLoad | None = None,
    load_a: float = 0.0,
) -> tuple[FleetPosterior, ReferenceHealth]:
    summaries = summaries_of(faults, Conditions(model_error_a=0.5, unmeasured_a=load_a), seed=1)
    posterior = calibrate_posterior(summaries, full_scale_a=FULL_SCALE_A, trusted=trusted, load=load)
    assert posterior.health is not None
    return posterior, posterior.health


def with_offset(vehicles: slice, branch: int, offset_a: float) -> Faults:
    fleet = no_faults(VEHICLES, 2)
    fleet.offset_a[vehicles, branch] = offset_a
    return fleet


def first(count: int) -> Mask:
    return np.arange(VEHICLES) < count


@pytest.mark.parametrize("offset_a", [5.0, 12.0])
def test_trusted_vehicles_carry_the_reference_where_most_of_the_fleet_share_an_offset(offset_a: float) -> None:
    posterior, health = calibrated(with_offset(slice(3, None), 0, offset_a), first(3))
    assert health.distrusted == {}
    assert health.doubtful == ()
    assert not posterior.faults.offset_a[:3].any()
    assert posterior.sensor_fault[3:, 0].mean() > 0.5
    assert any("most vehicles share" in text for text in health.warnings)
    assert not any("as is taken here" in text for text in health.warnings)


def test_a_load_that_the_trusted_vehicles_show_as_well_is_taken_for_one() -> None:
    posterior, health = calibrated(no_faults(VEHICLES, 2), first(3), load_a=3.0)
    assert health.distrusted == {}
    assert health.unmeasured_a == pytest.approx(3.0, abs=0.3)
    assert not posterior.faults.offset_a.any()


def test_a_declared_load_makes_the_rest_an_offset_that_most_share() -> None:
    load = UnmeasuredLoad(mean_a=0.0, sd_a=0.1)
    _, health = calibrated(no_faults(VEHICLES, 2), first(0), load_a=5.0, load=load)
    assert any("the declared load of 0 A does not explain" in text for text in health.warnings)
    assert health.doubtful == (0, 1)


def test_a_trusted_vehicle_whose_sensors_disagree_is_not_trusted() -> None:
    fleet = no_faults(VEHICLES, 2)
    fleet.drift[0, 1] = 0.06
    trusted = first(4)
    posterior, health = calibrated(fleet, trusted)
    assert list(health.distrusted) == [0]
    assert trusted[0], "what the user said stays, so that every pass finds and tells it anew"
    assert trust_notices([f"V{j}" for j in range(VEHICLES)], trusted, health)[0].startswith("vehicle V0 is not trusted")
    assert posterior.sensor_fault[0, 1] > 0.9
    assert (posterior.sensor_fault[4:] < 0.1).all()


def test_a_trusted_vehicle_with_a_hardware_fault_does_not_carry_the_reference() -> None:
    fleet = no_faults(VEHICLES, 2)
    fleet = replace(fleet, hardware_drift=np.where(np.arange(VEHICLES) == 2, 0.1, 0.0))
    posterior, health = calibrated(fleet, first(4))
    assert health.differing == (2,)
    assert posterior.hardware_fault[2] > 0.9
    assert (np.delete(posterior.hardware_fault, 2) < 0.5).all()


def test_a_bench_reading_that_the_drives_contradict_is_found_and_a_possible_one_is_not() -> None:
    fleet = no_faults(VEHICLES, 2)
    fleet.offset_a[0, 1] = 40.0
    posterior, _ = calibrated(fleet, first(0))
    names = [f"V{j}" for j in range(VEHICLES)]
    nothing = (np.nan, np.nan)
    bench = {
        ("V0", "motor"): (*nothing, 40.0, 0.5),
        ("V0", "battery"): (0.2, 0.002, *nothing),
        ("V1", "battery"): (*nothing, -30.0, 0.5),
        ("V2", "motor"): (0.001, 0.002, 0.1, 0.5),
        ("gone", "motor"): (0.4, 0.002, *nothing),
    }
    found = contradicted_readings(posterior, bench, names, ("battery", "motor"), FULL_SCALE_A)
    assert set(found) == {("V0", "battery"), ("V1", "battery")}
    assert found["V1", "battery"].startswith("vehicle V1: the bench reading of its battery sensor is not what its")


def test_two_trusted_vehicles_are_evidence_and_do_not_carry_the_reference() -> None:
    fleet = no_faults(VEHICLES, 2)
    fleet = replace(fleet, hardware_drift=np.where(np.arange(VEHICLES) == 1, 0.1, 0.0))
    posterior, health = calibrated(fleet, first(2))
    assert (health.distrusted, health.differing) == ({}, ())
    assert posterior.hardware_fault[1] > 0.9
    assert (np.delete(posterior.hardware_fault, 1) < 0.5).all()
    (notice,) = trust_notices([f"V{j}" for j in range(VEHICLES)], first(2), health)
    assert notice == "only 2 of the trusted vehicles can carry the reference, 3 are needed: it is the fleet's"
    assert trust_notices([], first(3), health) == trust_notices([], first(0), health) == []
