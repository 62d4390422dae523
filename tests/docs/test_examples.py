"""The examples run, and show what their pages say."""

import runpy
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run an example as the gallery does, in its folder and without a window."""
    monkeypatch.chdir(EXAMPLES)
    plt.switch_backend("agg")
    yield lambda name: runpy.run_path(str(EXAMPLES / name))
    plt.close("all")


def test_one_car_example_corrects_the_motor_by_the_trusted_battery(run: Any) -> None:
    names = run("one_car.py")
    rows = names["calibrator"].parameters_.set_index("branch")
    assert rows.gain_error["motor"] == pytest.approx(0.06, abs=3.0 * rows.gain_error_sd["motor"])
    assert rows.corrected.to_dict() == {"battery": False, "motor": True, "heater": False}
    assert names["sums"].corrected.std() < 0.2 * names["sums"].measured.std()


def test_two_chargers_example_finds_the_gain_ratio_of_battery_and_each_charger(run: Any) -> None:
    ratio = 1.0 / (1.0 + run("two_chargers.py")["found"].gain_error)  # battery over charger
    assert ratio["circontrol"] == pytest.approx(0.988, abs=0.003)
    assert ratio["efacec"] == pytest.approx(1.012, abs=0.003)


def test_spreadsheet_example_in_german_format_is_calibrated(run: Any) -> None:
    rows = run("from_a_spreadsheet.py")["calibrator"].parameters_.set_index("branch")
    assert rows.gain_error["motor"] == pytest.approx(-0.05, abs=0.001)
    assert rows.corrected["motor"]


def test_node_of_the_replay_example_reduces_the_kirchhoff_sum_of_another_drive(run: Any) -> None:
    sums = pd.read_csv(run("replay_and_node.py")["out"] / "sums.csv").filter(regex="^sum")
    before, after = (float((sums[name] ** 2).mean() ** 0.5) for name in sums)
    assert before > 40.0
    assert after < 1.0
