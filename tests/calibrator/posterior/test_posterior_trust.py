"""Trusted vehicles that contradict themselves do not carry the reference."""

import re

import numpy as np
import pytest

from calibrator.posterior.trust import broken_trust
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


@pytest.mark.parametrize("load", [0.0, 0.0075])
def test_a_trusted_vehicle_with_an_offset_is_found_beside_any_load_without_a_sensor(load: float) -> None:
    rng = np.random.default_rng(1)
    rows = rows_of(faults_of(np.zeros((VEHICLES, 4)), np.zeros((VEHICLES, 5))), seed=3)
    rows.constant[:, 3] += load + 0.1 * load * rng.normal(size=VEHICLES)
    rows.constant[2, 3] += 0.03
    texts = broken_trust(rows, np.arange(VEHICLES) < 3, NAMES, full_scale_a=FULL_SCALE_A)
    assert list(texts) == [2]
    usual = re.search(r"sum to \+1[0-9.]+ A on average, (\S+) A being usual", texts[2])
    assert usual is not None
    assert float(usual[1]) == pytest.approx(load * FULL_SCALE_A, abs=0.5)


def test_a_hardware_fault_is_no_breach_of_the_junction_law() -> None:
    relative, constant = np.zeros((VEHICLES, 4)), np.zeros((VEHICLES, 5))
    relative[0, 0], constant[0, :2] = 0.1, 0.05
    assert found(relative, constant, [0, 1, 2]) == {}
