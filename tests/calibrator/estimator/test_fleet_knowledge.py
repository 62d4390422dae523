"""What users know of a fleet: trusted vehicles, a declared load, how many faults to expect."""

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from calibrator.drive import Mask
from calibrator.estimator.fleet_estimate import FleetEstimate, FleetReference, estimate_vehicles, learn_fleet
from calibrator.estimator.prior import known_prior
from calibrator.summaries.moments import DriveSummary
from ecu_node.layout import UnmeasuredLoad
from tests.calibrator.estimator.simulated_drives import Conditions, no_faults, summaries_of

FULL_SCALE_A, VEHICLES, NAMES = 400.0, 16, ("battery", "motor")


@cache
def drives(fault: str, load_a: float = 0.0) -> Sequence[DriveSummary]:
    """Of a fleet with one fault, in the sensors of a vehicle, in its hardware, or in a batch of sensors."""
    fleet = no_faults(VEHICLES, 2)
    if fault == "drift":
        fleet.drift[0, 1] = 0.06
    elif fault == "hardware":
        fleet.hardware_drift[2] = 0.1
    elif fault == "batch":
        fleet.offset_a[3:, 0] = 12.0
    return summaries_of(fleet, Conditions(samples=1200, model_error_a=0.5, unmeasured_a=load_a), seed=1)


def calibrated(
    summaries: Sequence[DriveSummary], trusted: Mask | None = None, load: UnmeasuredLoad | None = None
) -> tuple[FleetReference, FleetEstimate]:
    reference = learn_fleet(summaries, full_scale_a=FULL_SCALE_A, branches=NAMES, trusted=trusted, load=load)
    carrying = np.zeros(VEHICLES, bool) if trusted is None else trusted.copy()
    carrying[list(reference.distrusted)] = False
    return reference, estimate_vehicles(summaries, reference, trusted=carrying)


def first(count: int) -> Mask:
    return np.arange(VEHICLES) < count


def test_trusted_vehicles_carry_the_reference_where_most_of_the_fleet_share_an_offset() -> None:
    reference, found = calibrated(drives("batch"), first(3))
    assert reference.distrusted == {}
    assert not found.offset_a[:3].any()
    assert np.median(found.offset_a[3:, 0]) == pytest.approx(12.0, abs=1.0)


def test_trusted_vehicles_carry_the_reference_of_a_fleet_however_small() -> None:
    few = drives("none")[:4]
    for trusted, doubt in ((None, True), (np.arange(4) < 2, True), (np.arange(4) < 3, False)):
        learnt = learn_fleet(few, full_scale_a=FULL_SCALE_A, branches=NAMES, trusted=trusted)
        assert (learnt.vehicles, learnt.in_doubt) == (4, doubt)
        assert any("few for a fleet" in text for text in learnt.notices) == doubt


def test_trusted_vehicle_whose_sensors_disagree_is_not_trusted() -> None:
    trusted = first(4)
    reference, found = calibrated(drives("drift"), trusted)
    assert list(reference.distrusted) == [0]
    assert trusted[0], "what the user said stays"
    assert found.fault_probability[0].max() > 0.9
    assert (found.fault_probability[4:] < 0.2).all()


@pytest.mark.parametrize("count", [2, 4])
def test_trusted_vehicle_with_a_hardware_fault_does_not_carry_the_reference(count: int) -> None:
    reference, found = calibrated(drives("hardware"), first(count))
    assert reference.differing == ((2,) if count > 2 else ())  # two vehicles are evidence, and carry no reference
    assert found.hardware_probability[2] > 0.9
    assert (np.delete(found.hardware_probability, 2) < 0.5).all()


def test_load_is_found_from_the_fleet_or_taken_as_declared() -> None:
    summaries = drives("none", 3.0)
    found = learn_fleet(summaries, full_scale_a=FULL_SCALE_A, branches=NAMES)
    assert found.expected_a == pytest.approx(3.0, abs=0.3)
    assert any("sum to +3.0 A" in text and "declare the load" in text for text in found.notices)
    declared, estimate = calibrated(summaries, load=UnmeasuredLoad(mean_a=3.0, sd_a=0.1))
    assert declared.expected_a == pytest.approx(3.0)
    assert not declared.notices
    assert not estimate.corrected.any()


def test_expected_and_known_faults_are_used() -> None:
    summaries, counts = drives("drift"), np.zeros((3, 5))
    expected = learn_fleet(summaries, full_scale_a=FULL_SCALE_A, branches=NAMES, expected_faults=0.4)
    assert expected.models[0].prior.counts[:, 1:].sum() == pytest.approx(0.4, abs=0.02)
    counts[0, :2] = 0.75, 0.25
    prior = known_prior(counts, (0.05, 0.25))
    known = learn_fleet(summaries, full_scale_a=FULL_SCALE_A, branches=NAMES, known=prior)
    assert known.models[0].prior is prior
