"""A fleet whose recordings are tables, through every command that takes recordings or what is made of them."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from calibrator.estimator.results import read_results
from tests.calibrator.command_here import calibrator
from tests.calibrator.estimator.test_junction import recording

GAIN = {"V1": 0.08, "V4": -0.06}
"""Gain errors of motors. [1]"""
LAYOUT = """
schema = 1
name = "car"
full_scale_a = 400.0
model_inputs = ["demand", "heater_demand"]
[[branch]]
name = "battery"
signal = "Ibat [A]"
sign = 1
[[branch]]
name = "motor"
signal = "Imot [A]"
sign = -1
[[branch]]
name = "heater"
signal = "Iheat [A]"
sign = -1
[[input]]
name = "demand"
signal = "demand"
[[input]]
name = "heater_demand"
signal = "heater_demand"
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Layout, and tables with German numbers, of eight vehicles of the same kind."""
    place = tmp_path_factory.mktemp("tables")
    (place / "car.toml").write_text(LAYOUT)
    for seed in range(8):
        name = f"V{seed + 1}"
        true = recording(seed)
        frame = recording(seed, gain=(0.0, GAIN.get(name, 0.0), 0.0))
        rng = np.random.default_rng(100 + seed)
        table = pd.DataFrame(
            {
                "Ibat [A]": frame["battery"],
                "Imot [A]": -frame["motor"],
                "Iheat [A]": -frame["heater"],
                "demand": 0.01 * true["motor"] + rng.normal(0.0, 0.002, len(true)),
                "heater_demand": (true["heater"] < -6.0).astype(int),
            }
        )
        (place / "logs" / name).mkdir(parents=True)
        table.rename_axis("time_s").to_csv(place / "logs" / name / "drive.csv", sep=";", decimal=",")
    return place


def run(place: Path, *words: str | Path) -> str:
    """Output of a command with the layout of the tables."""
    done = calibrator(*words, "--layout", place / "car.toml")
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def result(place: Path) -> Path:
    run(place, "calibrate", place / "logs", "--out", place / "result", "--workers", "1")
    return place / "result"


def test_faults_of_the_fleet_are_found(result: Path) -> None:
    rows = pd.DataFrame(read_results(result)).set_index(["vehicle", "branch"])
    assert set(rows.index[rows.applied]) == {(vehicle, "motor") for vehicle in GAIN}
    for vehicle, gain in GAIN.items():
        assert rows.drift[vehicle, "motor"] == pytest.approx(gain, abs=0.01)


@pytest.mark.parametrize("middle", ["import", "summarise"])
def test_drives_and_summaries_of_tables_give_the_same(place: Path, result: Path, tmp_path: Path, middle: str) -> None:
    run(place, middle, place / "logs", "--out", tmp_path / "store", "--workers", "1")
    run(place, "calibrate", tmp_path / "store", "--out", tmp_path / "result", "--workers", "1")
    for row, expected in zip(read_results(tmp_path / "result"), read_results(result), strict=True):
        assert row["drift"] == pytest.approx(expected["drift"], abs=1e-6)


def test_table_is_looked_at(place: Path) -> None:
    drive = place / "logs" / "V2" / "drive.csv"
    findings = json.loads(run(place, "doctor", "--log", drive, "--json"))
    assert not [each for each in findings["findings"] if each["level"] == "error"]
    assert "battery" in run(place, "kirchhoff", drive)


def test_table_is_compared_before_and_after(place: Path, result: Path) -> None:
    drive, params = place / "logs" / "V1" / "drive.csv", result / "params" / "V1.json"
    figures = json.loads(run(place, "kirchhoff", drive, "--parameters", params, "--json"))
    assert figures["after"]["sum"]["rmse_a"] < 0.3 * figures["before"]["sum"]["rmse_a"]


def test_filter_bank_is_chosen_for_tables(place: Path) -> None:
    assert "vehicles: 8" in run(place, "identify", place / "logs", "--workers", "1")


def test_report_of_tables(result: Path, tmp_path: Path) -> None:
    done = calibrator("report", result, "--out", tmp_path / "report.html")
    assert done.returncode == 0, done.stderr
    assert "V4" in (tmp_path / "report.html").read_text()


def test_table_has_no_frames_to_replay(place: Path) -> None:
    done = calibrator("replay", place / "logs" / "V1" / "drive.csv", "--interface", "virtual", "--channel", "c")
    assert done.returncode == 1
    assert "table" in done.stderr
    assert "Traceback" not in done.stderr
