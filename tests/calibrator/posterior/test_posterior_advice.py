"""What would decide: between explanations, about a reference in doubt, about a sensor beyond the limits."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.posterior.advice import advise, deciding_evidence
from calibrator.posterior.estimate import FleetPosterior, Moments, estimate_fleet
from calibrator.posterior.explain import FaultExplanation, explanations
from calibrator.posterior.health import ReferenceHealth
from calibrator.posterior.verdict import decide
from ecu_node.database import VehicleDatabase
from tests.calibrator.posterior.simulated_rows import FULL_SCALE_A, random_faults, rows_of

NAMES = ("battery", "motor")


def explanation(probability: float, *, drift: tuple[float, float], offset: tuple[float, float]) -> FaultExplanation:
    return FaultExplanation(probability, 0.0, np.zeros(2), np.array(drift), np.array(offset))


def test_one_explanation_leaves_nothing_to_decide() -> None:
    assert deciding_evidence([explanation(1.0, drift=(0.1, 0.0), offset=(0.0, 0.0))], NAMES, FULL_SCALE_A) == ""


def test_offsets_are_decided_by_a_zero_current_window() -> None:
    found = [
        explanation(0.6, drift=(0.0, 0.0), offset=(0.1, 0.0)),
        explanation(0.4, drift=(0.0, 0.0), offset=(0.0, 0.1)),
    ]
    text = deciding_evidence(found, NAMES, FULL_SCALE_A)
    assert "zero-current window" in text
    assert "battery sensor then shows +40.0 A or +0.0 A" in text


def test_drifts_are_decided_by_a_check_of_the_sensor_that_differs_most() -> None:
    found = [
        explanation(0.6, drift=(0.1, 0.0), offset=(0.0, 0.0)),
        explanation(0.4, drift=(0.0, -0.2), offset=(0.0, 0.0)),
    ]
    text = deciding_evidence(found, NAMES, FULL_SCALE_A)
    assert "check of the motor sensor" in text
    assert "+0.0% or -20.0%" in text


def test_explanations_that_differ_in_the_vehicle_alone_ask_for_its_inspection() -> None:
    same = explanation(0.5, drift=(0.1, 0.0), offset=(0.0, 0.0))
    assert "inspect the hardware" in deciding_evidence([same, same], NAMES, FULL_SCALE_A)


def test_of_a_branch_that_is_held_back_the_explanation_in_its_way_is_looked_at_not_the_second() -> None:
    found = [
        explanation(0.958, drift=(0.1, 0.0), offset=(0.0, 0.02)),
        explanation(0.040, drift=(0.2, 0.0), offset=(0.0, 0.02)),
        explanation(0.002, drift=(0.1, 0.0), offset=(0.02, 0.0)),
    ]
    assert "battery sensor against a reference" in deciding_evidence(found, NAMES, FULL_SCALE_A)
    text = deciding_evidence(found, NAMES, FULL_SCALE_A, concerned={1})
    assert "battery sensor then shows +0.0 A or +8.0 A" in text


def test_an_improbable_explanation_is_no_rival_where_nothing_is_held_back() -> None:
    found = [
        explanation(0.99, drift=(0.1, 0.0), offset=(0.0, 0.0)),
        explanation(0.01, drift=(0.0, 0.1), offset=(0.0, 0.0)),
    ]
    assert deciding_evidence(found, NAMES, FULL_SCALE_A) == ""
    assert "check of the" in deciding_evidence(found, NAMES, FULL_SCALE_A, concerned={0})


def test_explanations_that_agree_on_the_branch_held_back_do_not_decide_on_it() -> None:
    found = [
        explanation(0.6, drift=(0.1, 0.0), offset=(0.0, 0.0)),
        explanation(0.4, drift=(0.2, 0.0), offset=(0.0, 0.0)),
    ]
    assert deciding_evidence(found, NAMES, FULL_SCALE_A, concerned={1}) == ""


@pytest.fixture(scope="module")
def posterior() -> FleetPosterior:
    faults = random_faults(1, vehicles=30, branches=2, sparsity=80.0)
    moments = Moments(mean_a=np.full((30, 2), 10.0), mean_square_a2=np.full((30, 2), 2500.0))
    return estimate_fleet(rows_of(faults), moments, full_scale_a=FULL_SCALE_A)


def advice_on_first_faulty(
    posterior: FleetPosterior, database: VehicleDatabase, *, doubtful: tuple[int, ...] = (), harm_limit: float = 0.0
) -> str:
    decision = decide(posterior, database.layout, harm_limit=harm_limit, doubtful=doubtful)
    j = int(np.flatnonzero((decision.held_back != "").any(axis=1))[0])
    found = explanations(posterior.states, j)
    return advise(posterior, decision, j, found, branches=NAMES, layout=database.layout)


def test_a_reference_in_doubt_is_decided_by_trusted_vehicles(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    health = ReferenceHealth(
        agreeing_share=(1.0, 1.0),
        mean_distance=(0.0, 0.0),
        least_vehicles=5,
        unmeasured_a=0.0,
        doubtful=(0, 1),
        warnings=(),
    )
    text = advice_on_first_faulty(replace(posterior, health=health), database, doubtful=(0, 1))
    assert "in doubt for branch battery, motor" in text
    assert "--trusted" in text


def test_a_sensor_beyond_the_limits_is_to_be_replaced(posterior: FleetPosterior, database: VehicleDatabase) -> None:
    wild = replace(
        posterior,
        faults=replace(posterior.faults, drift=np.full_like(posterior.faults.drift, 0.9)),
        harm=np.zeros_like(posterior.harm),
        identifiable=np.ones_like(posterior.identifiable),
    )
    text = advice_on_first_faulty(wild, database, harm_limit=0.001)
    assert "the battery sensor is off by +90.0%" in text
    assert "replace the sensor" in text
    unsure = replace(wild, harm=np.ones_like(posterior.harm))
    assert "replace the sensor" not in advice_on_first_faulty(unsure, database, harm_limit=0.001)


def test_branches_in_another_order_than_the_states_keep_their_names(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    explanations_of_offsets = [
        explanation(0.99, drift=(0.0, 0.0), offset=(0.02, 0.0)),
        explanation(0.01, drift=(0.0, 0.0), offset=(0.0, 0.02)),
    ]
    turned = replace(posterior, order=(1, 0))
    decision = decide(turned, database.layout, harm_limit=0.0, doubtful=())
    j = int(np.flatnonzero((decision.held_back != "").any(axis=1))[0])
    text = advise(turned, decision, j, explanations_of_offsets, branches=NAMES, layout=database.layout)
    assert "the motor sensor then shows +8.0 A or +0.0 A" in text
    for k in (0, 1):
        held = replace(decision, held_back=np.where(np.arange(2) == k, "harm limit", "")[None].repeat(30, axis=0))
        same_elsewhere = [
            explanation(0.99, drift=(0.0, 0.0), offset=(0.02, 0.0)),
            explanation(0.01, drift=(0.0, 0.0), offset=(0.0, 0.0)),
        ]
        text = advise(turned, held, j, same_elsewhere, branches=NAMES, layout=database.layout)
        assert ("zero-current window" in text) == (k == 1), "the states' first branch is the second one here"
        assert k == 1 or text.startswith(f"more drives would decide: the {NAMES[k]} sensor")


def test_where_nothing_else_is_in_the_way_more_drives_decide(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    decision = decide(posterior, database.layout, harm_limit=0.0, doubtful=())
    j = int(np.argmax(posterior.confidence))
    found = explanations(posterior.states, j)[:1]
    text = advise(posterior, decision, j, found, branches=NAMES, layout=database.layout)
    assert text.startswith("more drives would decide: the ")


def test_the_fault_that_is_known_least_for_its_size_needs_more_drives(
    posterior: FleetPosterior, database: VehicleDatabase
) -> None:
    faults = replace(
        posterior.faults,
        drift=np.tile([0.0, 0.06], (30, 1)),
        offset_a=np.tile([60.0, 0.0], (30, 1)),
    )
    unsure = replace(
        posterior,
        faults=faults,
        drift_sd=np.tile([0.0005, 0.006], (30, 1)),
        offset_sd_a=np.tile([3.0, 0.5], (30, 1)),
    )
    decision = decide(posterior, database.layout, harm_limit=1.0, doubtful=())
    decision = replace(decision, held_back=np.full_like(decision.held_back, ""))
    found = [explanation(1.0, drift=(0.0, 0.06), offset=(0.15, 0.0))]
    text = advise(unsure, decision, 0, found, branches=NAMES, layout=database.layout)
    assert text.startswith("more drives would decide: the motor sensor's drift is known to +-0.60%")
