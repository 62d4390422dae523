"""The junction watch on recorded drives of a BMW i3, with loads that switch, noise and sensors that drift when warm."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

from ecu_node.core.status import Reason, State
from tests.ecu_node.junctions import Junction, three_branches

COLUMNS = (7, 8, 15)
"""Battery voltage [V], battery current [A], heating power [kW]."""
PERIOD_S = 0.1
"""Sample period of the recordings. [s]"""
HOURS = float(os.environ.get("HV_WATCH_HOURS", "0.2"))
"""Simulated time; ``make soak`` takes 24 h. [h]"""


class RecordedDrives:
    """True currents of some trips, one after the other, for a :class:`~tests.ecu_node.junctions.Junction`."""

    def __init__(self, paths: list[Path], seed: int) -> None:
        parts = [
            np.genfromtxt(path, delimiter=";", skip_header=1, encoding="cp1252", usecols=COLUMNS) for path in paths
        ]
        table = np.concatenate([part[np.isfinite(part).all(axis=1)] for part in parts])
        self.battery_a = [*map(float, -table[:, 1])]
        self.heater_a = [*map(float, 1000.0 * table[:, 2] / table[:, 0])]
        random = np.random.default_rng(seed)
        self.compressor_a = [0.0] * len(self.battery_a)
        for start in random.integers(0, len(self.battery_a), len(self.battery_a) // 300):
            length, current_a = int(random.integers(5, 200)), float(random.uniform(5.0, 60.0))
            self.compressor_a[start : start + length] = [current_a] * len(self.compressor_a[start : start + length])
        self.duration_s = PERIOD_S * (len(self.battery_a) - 2)

    def __call__(self, time_s: float) -> dict[str, float]:
        late_a = self._at(time_s - 0.008)  # the motor's sensor is 8 ms late
        battery_a, heater_a = self._at(time_s)
        return {"battery": battery_a, "motor": late_a[0] - late_a[1], "heater": heater_a}

    def _at(self, time_s: float) -> tuple[float, float]:
        place = (time_s % self.duration_s) / PERIOD_S
        index = int(place)
        share = place - index
        battery_a = self.battery_a[index] * (1.0 - share) + self.battery_a[index + 1] * share
        return battery_a + self.compressor_a[index], self.heater_a[index] + self.compressor_a[index]


def warming(junction: Junction) -> None:
    """Let sensors drift as they do when they get warm: 0.5 % and 0.4 A, over 40 minutes."""

    def drifting(shown_a: float, phase: float) -> float:
        swing = math.sin(2.0 * math.pi * junction.now_s / 2400.0 + phase)
        return shown_a * (1.0 + 0.005 * swing) + 0.4 * swing

    junction.wrong = {
        "battery": lambda shown_a: drifting(shown_a, 0.0),
        "motor": lambda shown_a: drifting(shown_a, 2.0),
        "heater": lambda shown_a: drifting(shown_a, 4.0),
    }


def watched(folder: Path, paths: list[Path], duration_s: float, period_s: float, seed: int) -> Junction:
    """The junction of a node with right parameters, after it has driven some recorded drives."""
    junction = Junction(three_branches(folder), sd_a=1.2, sd_per_a=0.012, period_s=period_s, seed=seed)
    warming(junction)
    junction.run(duration_s, RecordedDrives(paths, seed))
    return junction


@pytest.mark.parametrize("period_s", [0.02, 0.1])
def test_node_with_right_parameters_keeps_correcting_on_real_drives(
    tmp_path: Path, shared_data: Path, period_s: float
) -> None:
    paths = sorted((shared_data / "bmw_i3_summer").glob("*.csv.gz"))[3 : 6 if HOURS < 1.0 else None]
    junction = watched(tmp_path, paths, 3600.0 * HOURS, period_s, seed=1)
    assert junction.corrector.latched_branches == ()
    assert junction.corrector.state() == (State.CORRECTING, Reason.NONE)


@pytest.mark.parametrize("name", ["battery", "motor"])
def test_branch_whose_sensor_breaks_on_real_drives_is_latched_within_100_ms(
    tmp_path: Path, shared_data: Path, name: str
) -> None:
    paths = sorted((shared_data / "bmw_i3_summer").glob("*.csv.gz"))[3:4]
    drives = RecordedDrives(paths, seed=1)
    junction = Junction(three_branches(tmp_path), sd_a=1.2, sd_per_a=0.012, period_s=0.02)
    junction.run(300.0, drives)
    junction.wrong = {name: lambda shown_a: shown_a + 50.0}
    junction.run(1.0, drives)
    assert junction.fell_back_s is not None
    assert junction.fell_back_s - 300.0 <= 0.1
    assert junction.corrector.latched_branches == (name,)
    assert junction.corrected_after == 0
