"""Competing explanations of one vehicle."""

from collections import defaultdict

import numpy as np
import pytest

from calibrator.posterior.explain import explanations
from calibrator.posterior.states import enumerate_states
from tests.calibrator.posterior.simulated_rows import faults_of, no_spread, prior_of, rows_of


def test_two_equal_explanations_of_two_slopes_are_both_told() -> None:
    relative = np.array([[0.0, 0.12, -0.08]])
    faults = faults_of(relative, np.zeros((1, 3)))
    states = enumerate_states(rows_of(faults, noise=0.0), prior_of(2), no_spread(2))
    found = explanations(states, 0)
    assert [each.probability for each in found] == sorted((each.probability for each in found), reverse=True)
    assert any(np.allclose(each.drift, [0.12, -0.08], atol=2e-3) for each in found)
    assert any(each.hardware_drift != 0.0 for each in found)
    assert found[1].probability > 0.02


def test_a_clear_vehicle_has_one_explanation() -> None:
    faults = faults_of(np.zeros((1, 3)), np.zeros((1, 3)))
    found = explanations(enumerate_states(rows_of(faults, noise=0.0), prior_of(2), no_spread(2)), 0)
    assert found[0].probability > 0.99
    assert not any([found[0].hardware_drift, *found[0].drift, *found[0].offset])


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
