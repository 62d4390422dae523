"""Looking at real recordings: a Tesla that drives, a BMW i3 that is charged at two stations."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.calibrator.command_here import calibrator
from tests.calibrator.doctor.artificial_logs import examined
from tests.real.test_junctions import I3_DBC, I3_LAYOUT

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def i3(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Layout of the car and the station."""
    folder = tmp_path_factory.mktemp("i3")
    (folder / "i3.dbc").write_text(I3_DBC)
    (folder / "layout.toml").write_text(I3_LAYOUT)
    return folder / "layout.toml"


def kirchhoff(*arguments: object) -> Any:
    done = calibrator("kirchhoff", *arguments, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)


@pytest.mark.parametrize(("name", "mean_a"), [("2019_Circontrol_midpoint", 2.6), ("2019_efacaec_mida", -1.0)])
def test_kirchhoff_sum_of_car_and_station_is_their_difference(
    name: str, mean_a: float, i3: Path, shared_data: Path
) -> None:
    found = kirchhoff(shared_data / "bmw_i3_charging" / f"{name}.csv.gz", "--layout", i3)
    assert found["before"]["sum"]["mean_a"] == pytest.approx(mean_a, abs=0.3)
    assert found["expected"]["parts_a"]["quantisation"] == pytest.approx(0.1 * 2**0.5 / 12**0.5, rel=0.01)
    assert found["expected"]["in_band"]["before"] < 0.3


def test_doctor_reports_constant_currents_of_a_charge_as_hint(i3: Path, shared_data: Path) -> None:
    doctor = examined(i3, shared_data / "bmw_i3_charging" / "2019_efacaec_mida.csv.gz")
    assert doctor.errors == []
    (still,) = doctor.findings("stands still")
    assert still.text.startswith("the currents stand still, the greatest at 125 A")
    assert "calibrate --trusted" in doctor.report["ready"]


def test_doctor_reports_no_error_at_the_end_of_a_charge(i3: Path, shared_data: Path) -> None:
    doctor = examined(i3, shared_data / "bmw_i3_charging" / "2019_Circontrol_end.csv.gz")
    assert doctor.errors == []
    assert {item.code for item in doctor.findings()} == {"bad frames", "too short", "mean"}
    assert "19 of 153 frames (12 %) cannot be used: not available 19" in doctor.findings("bad frames")[0].text


def test_most_of_the_tesla_sum_is_a_constant(shared_data: Path, tmp_path: Path) -> None:
    """Steps of 0.5 kW in both powers are 1.4 A each; a gain error of 2 % explains a third of how the sum varies."""
    (tmp_path / "layout.toml").write_text((ROOT / "dbc" / "tesla_model3.toml").read_text())
    (tmp_path / "Model3CAN.dbc").symlink_to(shared_data / "tesla_model3" / "Model3CAN.dbc")
    found = kirchhoff(shared_data / "tesla_model3" / "drive.log.gz", "--layout", tmp_path / "layout.toml")
    assert found["expected"]["parts_a"]["quantisation"] == pytest.approx(0.55, abs=0.02)
    before = found["residual"]["before"]
    assert before["constant"] == pytest.approx(0.92, abs=0.02)
    assert before["alone"]["battery"]["gain_error"] == pytest.approx(0.020, abs=0.003)
    assert "motor_front" not in before["alone"]  # it moves less than its steps
