"""From summaries to what is corrected: known truth, one vehicle at a time, limits, few vehicles, batches."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.estimator.decision import FleetEstimate
from calibrator.estimator.fleet_estimate import FleetReference, estimate_vehicles, learn_fleet
from calibrator.faults import Faults
from calibrator.score import harmed
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise_samples
from tests.calibrator.estimator.simulated_drives import PERIOD_S, Conditions, drive_of, no_faults, summaries_of
from tests.calibrator.estimator.simulated_rows import random_faults

SCALE_A, VEHICLES, K = 400.0, 24, 2
NAMES = ["battery", "motor"]


@pytest.fixture(scope="module")
def truth() -> Faults:
    return random_faults(3, vehicles=VEHICLES, branches=K, full_scale_a=SCALE_A)


@pytest.fixture(scope="module")
def summaries(truth: Faults) -> list[DriveSummary]:
    return list(summaries_of(truth, Conditions(model_error_a=0.3), seed=3))


@pytest.fixture(scope="module")
def reference(summaries: list[DriveSummary]) -> FleetReference:
    return learn_fleet(summaries, full_scale_a=SCALE_A, branches=NAMES)


def worse(found: FleetEstimate, truth: Faults, summaries: list[DriveSummary]) -> bool:
    """Whether a correction does harm on a drive of the same means."""
    drift, offset_a = (np.where(found.corrected, each, 0.0) for each in (found.drift, found.offset_a))
    mean_a = np.array([summary.mean_a for summary in summaries])
    applied = replace(truth, drift=drift, offset_a=offset_a)
    return bool(harmed(applied, truth, mean_a=mean_a, mean_square_a2=mean_a**2 + 900.0).any())


def test_faults_beyond_the_limits_are_found_and_not_corrected(
    truth: Faults, summaries: list[DriveSummary], reference: FleetReference
) -> None:
    free, limited = (estimate_vehicles(summaries, reference, limits=limits) for limits in (None, (0.1, 1e3)))
    beyond = free.corrected & (np.abs(free.drift) > 0.1)
    assert beyond.any()
    assert (limited.held_back[beyond] == "beyond the limits").all()
    assert not limited.corrected[beyond].any()
    np.testing.assert_array_equal(limited.drift, free.drift)


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (-1.0, "1 A in branch battery goes with +1 A in branch motor"),
        (0.1, "1 A in branch motor goes with -10 A in branch battery"),
        (360.0, "1 A in branch battery goes with -3.6e+02 A in branch motor"),
    ],
)
def test_a_wrong_sign_or_unit_in_most_vehicles_is_refused(
    summaries: list[DriveSummary], factor: float, told: str
) -> None:
    def wrong(summary: DriveSummary) -> DriveSummary:
        moments = summary.moments.copy()
        moments[:, -2, :] *= factor  # of the motor
        moments[:, :, -2] *= factor
        return replace(summary, moments=moments)

    most, few = ([*map(wrong, summaries[n:]), *summaries[:n]] for n in (4, 20))
    with pytest.raises(FleetError, match=re.escape(f"{told}, expected -1 A; check sign and unit of branch")):
        learn_fleet(most, full_scale_a=SCALE_A, branches=NAMES)
    assert learn_fleet(few, full_scale_a=SCALE_A, branches=NAMES).vehicles == VEHICLES


def test_an_offset_that_all_battery_sensors_share_harms_nobody_and_is_said(truth: Faults) -> None:
    batch = replace(truth, offset_a=truth.offset_a + np.array([12.0, 0.0]))
    summaries = list(summaries_of(batch, Conditions(model_error_a=0.3), seed=4))
    learnt = learn_fleet(summaries, full_scale_a=SCALE_A, branches=NAMES)
    assert any("sum to +12" in notice for notice in learnt.notices)
    found = estimate_vehicles(summaries, learnt)
    assert not worse(found, batch, summaries)


@pytest.mark.parametrize(("vehicles", "branch", "gain"), [(5, 0, 0.1), (8, 1, -0.09), (8, 0, 0.03), (12, 1, 0.02)])
def test_gain_error_that_all_sensors_of_a_branch_share_is_said_and_not_corrected_in_either(
    vehicles: int, branch: int, gain: float
) -> None:
    batch = no_faults(vehicles, K)
    batch.drift[:, branch] = gain
    summaries = list(summaries_of(batch, Conditions(samples=900), seed=vehicles))
    learnt = learn_fleet(summaries, full_scale_a=SCALE_A, branches=NAMES)
    assert any("a gain error that a batch of sensors shares" in notice for notice in learnt.notices)
    assert not estimate_vehicles(summaries, learnt).corrected.any()


def test_pit_of_the_truth_lies_between_zero_and_one(
    truth: Faults, summaries: list[DriveSummary], reference: FleetReference
) -> None:
    for pit in estimate_vehicles(summaries, reference).pit(truth.drift, truth.offset_a):
        assert pit.shape == (VEHICLES, K)
        assert ((pit >= 0.0) & (pit <= 1.0 + 1e-9)).all()
        assert 0.3 < pit.mean() < 0.7


@pytest.mark.parametrize("step_a", [0.0, 0.37])
def test_branch_that_shows_a_constant_in_each_vehicle_blames_nobody(step_a: float) -> None:
    """Its gain is open, though its variance and that of its model are not zero but rounding."""
    rng, summaries = np.random.default_rng(6), []
    for j in range(8):
        drive = drive_of(rng, no_faults(1, K).take(0), Conditions(samples=360))
        still_a = np.full(360, round(1.1 + step_a * j, 2))
        currents_a = np.column_stack([drive.currents_a - [1.0, 0.0] * still_a[:, None], still_a])
        still = replace(drive, branch_names=(*drive.branch_names, "still"), currents_a=currents_a)
        summaries.append(summarise_samples([still], period_s=PERIOD_S))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        learnt = learn_fleet(summaries, full_scale_a=SCALE_A, branches=[*NAMES, "still"])
    found = estimate_vehicles(summaries, learnt)
    assert not found.identifiable[:, 2].any()
    assert not found.corrected.any()
