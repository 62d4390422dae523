"""Trusted vehicles that contradict themselves do not carry the reference."""

import re

import numpy as np
import pytest

from calibrator.evidence.rows import FleetRows
from calibrator.posterior.trust import broken_trust
from ecu_node.layout import UnmeasuredLoad
from tests.calibrator.posterior.simulated_rows import FULL_SCALE_A, faults_of, rows_of

NAMES = ("battery", "motor", "auxiliary")
VEHICLES = 30


def found(relative: np.ndarray, constant: np.ndarray, trusted: list[int]) -> dict[int, str]:
    rows = rows_of(faults_of(relative, constant), seed=3)
    return broken_trust(rows, np.isin(np.arange(VEHICLES), trusted), NAMES, full_scale_a=FULL_SCALE_A)


def test_vehicles_without_faults_keep_the_trust() -> None:
    assert found(np.zeros((VEHICLES, 4)), np.zeros((VEHICLES, 5)), [0, 1, 2]) == {}


def test_a_trusted_vehicle_with_a_drift_is_found_and_others_with_one_are_not_looked_at() -> None:
    relative = np.zeros((VEHICLES, 4))
    relative[[1, 7], 2] = 0.05
    texts = found(relative, np.zeros((VEHICLES, 5)), [0, 1, 2])
    assert list(texts) == [1]
    assert re.match(r"the gains of its sensors motor and battery differ by [+-][45]\.\d%", texts[1])


def with_constant(constant_a: dict[int, float], others_a: float) -> FleetRows:
    rows = rows_of(faults_of(np.zeros((VEHICLES, 4)), np.zeros((VEHICLES, 5))), seed=3)
    rows.constant[:, 3] += np.array([constant_a.get(j, others_a) for j in range(VEHICLES)]) / FULL_SCALE_A
    return rows


@pytest.mark.parametrize("others_a", [0.0, 5.0, -12.0])
def test_a_trusted_vehicle_with_an_offset_that_no_load_makes_is_found_whatever_the_others_have(others_a: float) -> None:
    rows = with_constant({0: 0.0, 1: 3.0, 2: -9.0}, others_a)
    texts = broken_trust(rows, np.arange(VEHICLES) < 3, NAMES, full_scale_a=FULL_SCALE_A)
    assert list(texts) == [2]
    assert re.match(r"its currents sum to -[89]\.\d A on average, which no load without a sensor explains", texts[2])


def test_a_declared_load_says_what_a_trusted_vehicle_has_to_show() -> None:
    rows = with_constant({0: 3.0, 1: 3.4, 2: 0.0}, 0.0)
    load = UnmeasuredLoad(mean_a=3.0, sd_a=0.1)
    texts = broken_trust(rows, np.arange(VEHICLES) < 3, NAMES, full_scale_a=FULL_SCALE_A, load=load)
    assert list(texts) == [2]
    assert "which the declared load of 3 A does not explain" in texts[2]


def test_a_hardware_fault_is_no_breach_of_the_junction_law() -> None:
    relative, constant = np.zeros((VEHICLES, 4)), np.zeros((VEHICLES, 5))
    relative[0, 0], constant[0, :2] = 0.1, 0.05
    assert found(relative, constant, [0, 1, 2]) == {}
