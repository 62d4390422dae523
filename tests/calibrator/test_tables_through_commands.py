"""A fleet, and one plant, recorded as tables: the commands that take recordings or what is made of them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from calibrator.drive import Array
from calibrator.estimator.results import read_results
from tests.calibrator.command_here import reported, succeeded
from tests.calibrator.estimator.test_junction import recording

GAIN = {"V1": 0.08, "V4": -0.06}
"""Gain errors of motors. [1]"""
LAYOUT = """
schema = 1
name = "car"
full_scale_a = 400.0
model_inputs = ["demand", "heater_demand"]
branch = [
    { name = "battery", signal = "Ibat [A]", sign = 1 },
    { name = "motor", signal = "Imot [A]", sign = -1 },
    { name = "heater", signal = "Iheat [A]", sign = -1 },
]
input = [{ name = "demand", signal = "demand" }, { name = "heater_demand", signal = "heater_demand" }]
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Layout and tables (with decimal commas) of eight vehicles of the same kind."""
    place = tmp_path_factory.mktemp("tables")
    (place / "car.toml").write_text(LAYOUT)
    for seed in range(8):
        name = f"V{seed + 1}"
        true = recording(seed)
        frame = recording(seed, gain=(0.0, GAIN.get(name, 0.0), 0.0))
        rng = np.random.default_rng(100 + seed)
        table = pd.DataFrame({"Ibat [A]": frame["battery"], "Imot [A]": -frame["motor"], "Iheat [A]": -frame["heater"]})
        table["demand"] = 0.01 * true["motor"] + rng.normal(0.0, 0.002, len(true))
        table["heater_demand"] = (true["heater"] < -6.0).astype(int)
        (place / "logs" / name).mkdir(parents=True)
        table.rename_axis("time_s").to_csv(place / "logs" / name / "drive.csv", sep=";", decimal=",")
    return place


def run(place: Path, *words: str | Path) -> str:
    """Output of a command with the layout of the tables."""
    return succeeded(*words, "--layout", place / "car.toml", "--workers", 1)


@pytest.fixture(scope="module")
def result(place: Path) -> Path:
    run(place, "calibrate", place / "logs", "--out", place / "result")
    return place / "result"


def test_faults_of_a_fleet_recorded_as_tables_are_found(result: Path) -> None:
    rows = pd.DataFrame(read_results(result)).set_index(["vehicle", "branch"])
    assert set(rows.index[rows.applied]) == {(vehicle, "motor") for vehicle in GAIN}
    for vehicle, gain in GAIN.items():
        assert rows.drift[vehicle, "motor"] == pytest.approx(gain, abs=0.01)


def test_tables_give_the_same_result_directly_and_by_summaries(place: Path, result: Path, tmp_path: Path) -> None:
    run(place, "import", place / "logs", "--out", tmp_path / "drives")
    run(place, "summarise", tmp_path / "drives", "--out", tmp_path / "summaries")
    run(place, "calibrate", tmp_path / "summaries", "--out", tmp_path / "result")
    for row, expected in zip(read_results(tmp_path / "result"), read_results(result), strict=True):
        assert row["drift"] == pytest.approx(expected["drift"], abs=1e-6)


def test_identify_reads_all_vehicles_of_a_fleet_recorded_as_tables(place: Path) -> None:
    assert "vehicles: 8" in run(place, "identify", place / "logs")


def solar_plant(folder: Path) -> Path:
    """A table of three days with a row a minute: noise of 0.02 A, and a string of which the gain is 5 % off."""
    rng, rows = np.random.default_rng(2), 4320

    def wander(size_a: float) -> Array:
        return size_a * np.convolve(rng.normal(size=rows), np.full(15, 0.26), "same")

    sun, inverter = np.clip(np.sin(np.arange(rows) / 229.2), 0.0, None), 12.0 + wander(4.0)
    strings = [size_a * sun * (1.0 + wander(0.1)) for size_a in (20.0, 15.0)]
    true = {"Ibat": inverter - sum(strings), "I1": 1.05 * strings[0], "I2": strings[1], "Iinv": inverter}
    frame = pd.DataFrame({name: value + 0.02 * rng.normal(size=rows) for name, value in true.items()}).round(3)
    frame.index = pd.date_range("2026-06-01", periods=rows, freq="60s", name="time")
    frame.to_csv(folder / "solar.csv")
    return folder / "solar.csv"


def test_table_with_a_row_a_minute_passes_kirchhoff_layout_doctor_and_calibrate(tmp_path: Path) -> None:
    table, layout = solar_plant(tmp_path), tmp_path / "solar.toml"
    branches = ("--branches", "battery=Ibat,string1=I1,string2=I2,-inverter=Iinv")
    found = reported("kirchhoff", table, *branches)
    assert found["expected"]["parts_a"]["noise"] == pytest.approx(2.0 * 0.02, rel=0.15)
    succeeded("layout", "init", table, *branches, "--out", layout)
    assert layout.read_text().count("timeout_s = 300") == 4
    assert f"full_scale_a = {found['full_scale_a']:g}" in layout.read_text()
    found = reported("doctor", "--layout", layout, "--log", table)
    assert "calibrate --trusted" in found["ready"]
    assert [each["code"] for each in found["findings"]] == ["gain"]
    options = ["--trusted", "battery", "--load", "0:0.05", "--out", tmp_path / "result"]
    succeeded("calibrate", table, "--layout", layout, *options)
    results = pd.DataFrame(read_results(tmp_path / "result")).set_index("branch")
    assert results.drift["string1"] == pytest.approx(0.05, abs=0.01)
    assert results.index[results.applied].to_list() == ["string1"]


def test_two_currents_that_together_close_the_sum_are_branches(tmp_path: Path) -> None:
    found = reported("layout", "init", solar_plant(tmp_path))
    taken = {each["signal"]: (each["branch"], each["sign"]) for each in found["candidates"]}
    wanted = {"Ibat": ("battery", 1), "Iinv": ("motor", -1), "I1": ("auxiliary", 1), "I2": ("auxiliary_3", 1)}
    assert taken == wanted
