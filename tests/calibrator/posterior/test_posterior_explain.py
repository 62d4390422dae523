"""Competing explanations, and what would decide between them."""

from collections import defaultdict

import numpy as np
import pytest

from calibrator.posterior.explain import FaultExplanation, deciding_evidence, explanations
from calibrator.posterior.states import enumerate_states
from tests.calibrator.posterior.simulated_rows import FULL_SCALE_A, faults_of, no_spread, prior_of, rows_of

NAMES = ("battery", "motor")


def explanation(probability: float, *, drift: tuple[float, float], offset: tuple[float, float]) -> FaultExplanation:
    return FaultExplanation(probability, 0.0, np.zeros(2), np.array(drift), np.array(offset))


def test_two_equal_explanations_of_two_slopes_are_both_told() -> None:
    relative = np.array([[0.0, 0.12, -0.08]])
    faults = faults_of(relative, np.zeros((1, 3)))
    states = enumerate_states(rows_of(faults, noise=0.0), prior_of(2), no_spread(2))
    found = explanations(states, 0)
    assert [each.probability for each in found] == sorted((each.probability for each in found), reverse=True)
    assert any(np.allclose(each.drift, [0.12, -0.08], atol=2e-3) for each in found)
    assert any(each.hardware_drift != 0.0 for each in found)
    assert len(found) > 1


def test_a_clear_vehicle_has_one_explanation_and_nothing_to_decide() -> None:
    faults = faults_of(np.zeros((1, 3)), np.zeros((1, 3)))
    found = explanations(enumerate_states(rows_of(faults, noise=0.0), prior_of(2), no_spread(2)), 0)
    assert len(found) == 1
    assert deciding_evidence(found, NAMES, FULL_SCALE_A) == ""


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


@pytest.mark.parametrize("vehicles", [1, 5])
def test_probabilities_are_those_of_the_states(vehicles: int) -> None:
    relative = np.tile([0.1, 0.15, 0.0], (vehicles, 1))
    states = enumerate_states(rows_of(faults_of(relative, np.zeros((vehicles, 3)))), prior_of(2), no_spread(2))
    for j in range(vehicles):
        expected: dict[tuple[float, ...], float] = defaultdict(float)
        for s, weight in enumerate(states.weight[j]):
            expected[tuple(np.sign([*states.relative[j, s], *states.constant[j, s]]))] += float(weight)
        found = explanations(states, j)
        assert found[0].probability == pytest.approx(max(expected.values()))
        for each in found:
            signs = np.sign([each.hardware_drift, *each.drift, each.hardware_offset[0], *each.offset])
            assert each.probability == pytest.approx(expected[tuple(signs)])
