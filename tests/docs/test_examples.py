"""The examples are short, run, and show what their pages say."""

import runpy
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
import pytest

from tests.calibrator.command_here import calibrator as command
from tests.real.test_junctions import I3_DBC, I3_LAYOUT

EXAMPLES = Path(__file__).parents[2] / "examples"
I3_LOGS = {"circontrol": "2019_Circontrol_end.csv.gz", "efacec": "2019_eacaec_enda.csv.gz"}


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run an example as the gallery does, in its folder and without a window."""
    monkeypatch.chdir(EXAMPLES)
    plt.switch_backend("agg")
    yield lambda name: runpy.run_path(str(EXAMPLES / name))
    plt.close("all")


def test_trusted_battery_corrects_the_motor_of_one_car(run: Any) -> None:
    names = run("one_car.py")
    rows = names["calibrator"].parameters_.set_index("branch")
    assert rows.gain_error["motor"] == pytest.approx(0.06, abs=3.0 * rows.gain_error_sd["motor"])
    assert rows.corrected.to_dict() == {"battery": False, "motor": True, "heater": False}
    assert names["sums"].corrected.std() < 0.2 * names["sums"].measured.std()


def test_chargers_disagree_with_one_battery(run: Any) -> None:
    ratio = 1.0 / (1.0 + run("two_chargers.py")["found"].gain_error)  # battery over charger
    assert ratio["circontrol"] == pytest.approx(0.988, abs=0.003)
    assert ratio["efacec"] == pytest.approx(1.012, abs=0.003)


def test_table_of_the_chargers_equals_kirchhoff_output_for_its_logs(shared_data: Path, tmp_path: Path) -> None:
    """The command that the head of the table names gives its rows."""
    (tmp_path / "i3.dbc").write_text(I3_DBC)
    (tmp_path / "i3.toml").write_text(I3_LAYOUT)
    kept = pd.read_csv(EXAMPLES / "bmw_i3_two_chargers.csv", comment="#").groupby("station")
    for station, name in I3_LOGS.items():
        log, out = shared_data / "bmw_i3_charging" / name, tmp_path / "out.csv"
        assert command("kirchhoff", log, "--layout", tmp_path / "i3.toml", "--table", out).returncode == 0
        made = pd.read_csv(out).round(1)
        rows = kept.get_group(station).reset_index(drop=True)
        for column in ("battery", "charger"):
            pd.testing.assert_series_equal(made[f"{column}_a"], rows[column], check_names=False, atol=0.051)


def test_spreadsheet_in_german_is_calibrated(run: Any) -> None:
    rows = run("from_a_spreadsheet.py")["calibrator"].parameters_.set_index("branch")
    assert rows.gain_error["motor"] == pytest.approx(-0.05, abs=0.001)
    assert rows.corrected["motor"]


def test_node_removes_the_offset_from_another_drive(run: Any) -> None:
    sums = pd.read_csv(run("replay_and_node.py")["out"] / "sums.csv").filter(regex="^sum")
    before, after = (float((sums[name] ** 2).mean() ** 0.5) for name in sums)
    assert before > 40.0
    assert after < 1.0
