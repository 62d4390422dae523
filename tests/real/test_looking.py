"""Looking at real recordings: a Tesla that drives, a BMW i3 that is charged at two stations."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.calibrator.command_here import calibrator
from tests.calibrator.doctor.artificial_logs import examined
from tests.real.conftest import ROOT


def kirchhoff(*arguments: object) -> Any:
    done = calibrator("kirchhoff", *arguments, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("name", "mean_a"), [("circontrol/2019_Circontrol_midpoint", 2.6), ("efacec/2019_efacaec_mida", -1.0)]
)
def test_kirchhoff_sum_of_car_and_station_is_their_difference(name: str, mean_a: float, i3_charges: Path) -> None:
    found = kirchhoff(i3_charges / "car" / f"{name}.csv.gz", "--layout", i3_charges / "layout.toml")
    assert found["before"]["sum"]["mean_a"] == pytest.approx(mean_a, abs=0.3)
    assert found["expected"]["parts_a"]["quantisation"] == pytest.approx(0.1 * 2**0.5 / 12**0.5, rel=0.01)
    assert found["expected"]["in_band"]["before"] < 0.3


def test_doctor_reports_constant_currents_of_a_charge_but_no_error(i3_charges: Path) -> None:
    doctor = examined(i3_charges / "layout.toml", i3_charges / "car" / "efacec" / "2019_efacaec_mida.csv.gz")
    assert doctor.errors == []
    (still,) = doctor.findings("stands still")
    assert still.text.startswith("the currents stand still, the greatest at 125 A")
    assert "calibrate --trusted" in doctor.report["ready"]


def test_doctor_reports_no_error_at_the_end_of_a_charge(i3_charges: Path) -> None:
    doctor = examined(i3_charges / "layout.toml", i3_charges / "car" / "circontrol" / "2019_Circontrol_end.csv.gz")
    assert doctor.errors == []
    assert {item.code for item in doctor.findings()} == {"bad frames", "too short", "mean"}
    assert "19 of 153 frames (12 %) cannot be used: not available 19" in doctor.findings("bad frames")[0].text


def test_constant_makes_92_percent_of_the_mean_square_of_the_tesla_sum(tesla: Path) -> None:
    """What varies is small: steps of 0.5 kW in the powers are 1.4 A each, and a gain error of 2 % explains a third."""
    found = kirchhoff(tesla / "drive.log.gz", "--layout", tesla / "tesla_model3.toml")
    assert found["expected"]["parts_a"]["quantisation"] == pytest.approx(0.55, abs=0.02)
    before = found["residual"]["before"]
    assert before["constant"] == pytest.approx(0.92, abs=0.02)
    assert before["alone"]["battery"]["gain_error"] == pytest.approx(0.020, abs=0.003)
    assert before["alone"]["battery"]["gain_share"] == pytest.approx(0.34, abs=0.03)
    assert "motor_front" not in before["alone"]  # it moves less than its steps


def test_table_of_two_chargers_equals_kirchhoff_output_for_its_logs(i3_charges: Path, tmp_path: Path) -> None:
    """The command that the head of the table names gives its rows."""
    kept = pd.read_csv(ROOT / "examples" / "bmw_i3_two_chargers.csv", comment="#").groupby("station")
    for log in ("circontrol/2019_Circontrol_end.csv.gz", "efacec/2019_eacaec_enda.csv.gz"):
        place, out = i3_charges / "car" / log, tmp_path / "out.csv"
        done = calibrator("kirchhoff", place, "--layout", i3_charges / "layout.toml", "--table", out)
        assert done.returncode == 0
        made, rows = pd.read_csv(out).round(1), kept.get_group(place.parent.name)
        for column in ("battery", "charger"):
            np.testing.assert_allclose(made[f"{column}_a"], rows[column], atol=0.051)
