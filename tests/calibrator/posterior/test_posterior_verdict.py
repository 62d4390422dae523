"""What is deployed: only what hardly harms, is within the limits, and rests on a reference that is not in doubt."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.posterior.estimate import FleetPosterior, Moments, estimate_fleet
from calibrator.posterior.verdict import decide
from ecu_node.database import VehicleDatabase
from tests.calibrator.posterior.simulated_rows import FULL_SCALE_A, random_faults, rows_of

LIMIT = 0.001


@pytest.fixture(scope="module")
def posterior() -> FleetPosterior:
    faults = random_faults(1, vehicles=60, branches=2, sparsity=80.0)
    moments = Moments(mean_a=np.full((60, 2), 10.0), mean_square_a2=np.full((60, 2), 2500.0))
    return estimate_fleet(rows_of(faults), moments, full_scale_a=FULL_SCALE_A)


def test_only_branches_with_a_fault_and_little_harm_are_corrected(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    decision = decide(posterior, database.layout, harm_limit=LIMIT, doubtful=())
    faulty = (posterior.faults.drift != 0.0) | (posterior.faults.offset_a != 0.0)
    assert decision.corrected.any()
    assert not (decision.corrected & ~faulty).any()
    assert (posterior.harm[decision.corrected] < LIMIT).all()


def test_verdicts_follow_from_what_is_corrected(posterior: FleetPosterior, database: VehicleDatabase) -> None:
    decision = decide(posterior, database.layout, harm_limit=LIMIT, doubtful=())
    for j, verdict in enumerate(decision.verdicts):
        assert (verdict == "corrected") == bool(decision.corrected[j].any())
        if verdict == "no sensor fault":
            assert posterior.confidence[j] >= 0.95
            assert not posterior.faults.drift[j].any()


def test_a_doubtful_branch_is_corrected_nowhere_and_nobody_is_cleared(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    decision = decide(posterior, database.layout, harm_limit=LIMIT, doubtful=(0,))
    assert not decision.corrected[:, 0].any()
    assert set(decision.held_back[:, 0].tolist()) == {"", "reference in doubt"}
    assert "no sensor fault" not in decision.verdicts


def test_a_hardware_fault_is_suspected_only_against_a_reference_that_is_in_no_doubt(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    sure = replace(posterior, hardware_fault=np.full(len(posterior), 0.9))
    assert decide(sure, database.layout, harm_limit=LIMIT, doubtful=()).hardware.all()
    assert not decide(sure, database.layout, harm_limit=LIMIT, doubtful=(1,)).hardware.any()


def test_nothing_is_corrected_where_no_harm_is_allowed(posterior: FleetPosterior, database: VehicleDatabase) -> None:
    decision = decide(posterior, database.layout, harm_limit=0.0, doubtful=())
    assert not decision.corrected.any()
    faulty = (posterior.faults.drift != 0.0) | (posterior.faults.offset_a != 0.0)
    assert (decision.held_back[faulty] == "harm limit").all()
    assert (decision.held_back[~faulty] == "").all()


def test_a_branch_that_moved_too_little_is_held_back_and_says_so(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    still = replace(posterior, identifiable=np.zeros_like(posterior.identifiable))
    decision = decide(still, database.layout, harm_limit=LIMIT, doubtful=())
    assert set(np.unique(decision.held_back)) == {"", "moved too little"}


def test_a_probability_of_harm_that_is_not_a_number_is_no_permission(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    unknown = replace(posterior, harm=np.full_like(posterior.harm, np.nan))
    assert not decide(unknown, database.layout, harm_limit=1.0, doubtful=()).corrected.any()


def test_parameters_beyond_the_limits_of_the_layout_are_not_deployed(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    wild = replace(posterior, faults=replace(posterior.faults, drift=np.full_like(posterior.faults.drift, 0.9)))
    sure = replace(wild, harm=np.zeros_like(wild.harm), identifiable=np.ones_like(wild.identifiable))
    decision = decide(sure, database.layout, harm_limit=LIMIT, doubtful=())
    assert not decision.corrected.any()
    assert (decision.held_back == "beyond the limits").all()
    unsure = decide(replace(sure, harm=np.ones_like(wild.harm)), database.layout, harm_limit=LIMIT, doubtful=(0,))
    assert unsure.held_back[0].tolist() == ["reference in doubt", "harm limit"]
