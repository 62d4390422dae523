"""Real sensors in one junction: a Tesla's inverters against its battery, a BMW i3's battery against two chargers."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from calibrator import JunctionCalibrator, read_log
from tests.calibrator.command_here import calibrator as command


@pytest.fixture(scope="module")
def stations(i3_charges: Path) -> JunctionCalibrator:
    return JunctionCalibrator(meter="charger", trusted=["battery"]).fit(i3_charges / "car", i3_charges / "layout.toml")


def test_gain_ratio_of_the_battery_to_each_charging_station_is_found(stations: JunctionCalibrator) -> None:
    """At 124 A the battery reads 2.5 A less than one station, and 1.0 A more than the other."""
    rows = stations.parameters_.set_index(["vehicle", "branch"]).xs("charger", level="branch")
    ratio = 1.0 / (1.0 + rows.gain_error)  # battery over charger
    assert ratio["circontrol"] == pytest.approx(0.988, abs=0.003)
    assert ratio["efacec"] == pytest.approx(1.012, abs=0.003)
    assert (rows.gain_error_sd < 0.0035).all()
    assert not any(each.parameters.findings for each in stations.vehicles_.values()), "a ramp is no fault of a sensor"


def test_two_charging_stations_both_trusted_that_differ_are_reported_as_a_contradiction(
    i3_charges: Path, tmp_path: Path
) -> None:
    """The meters of the two differ by 2.4 %; nothing is corrected."""
    done = command(
        "calibrate", i3_charges / "car", "--layout", i3_charges / "layout.toml",
        "--meter", "charger", "--trusted", "charger", "--out", tmp_path / "r",
    )  # fmt: skip
    assert done.returncode == 0
    assert "what is known contradicts itself" in done.stdout
    assert not pd.read_parquet(tmp_path / "r" / "results.parquet").applied.any()


def test_offset_of_a_station_is_known_only_if_the_load_of_the_car_is_declared(
    i3_charges: Path, stations: JunctionCalibrator
) -> None:
    """Between plug and battery the car draws 0.7 to 0.9 A that no branch measures; once declared, no offset is left."""
    knowing = JunctionCalibrator(meter="charger", trusted=["battery"], load=(0.8, 0.1))
    open_, declared = stations.parameters_, knowing.fit(i3_charges / "car", i3_charges / "layout.toml").parameters_
    assert (open_[open_.branch == "charger"].offset_sd_a > 1.0).all()
    chargers = declared[declared.branch == "charger"]
    assert (chargers.offset_a.abs() < 3.0 * chargers.offset_sd_a).all()
    assert (chargers.offset_sd_a < 0.6).all()


def test_rear_inverter_reads_two_percent_less_than_the_battery(tesla: Path) -> None:
    """Least squares on the same samples agree; the front inverter's current hardly varied, so its gain is not known."""
    found = JunctionCalibrator(trusted=["battery"]).fit(tesla / "drive.log.gz", tesla / "tesla_model3.toml")
    rows = found.parameters_.set_index("branch")
    frame = read_log(tesla / "drive.log.gz", tesla / "tesla_model3.toml").to_frame().dropna()
    others = np.column_stack([frame.motor_rear, frame.motor_front, np.ones(len(frame))])
    direct = -1.0 / np.linalg.lstsq(others, frame.battery, rcond=None)[0][0] - 1.0
    assert direct == pytest.approx(-0.02, abs=0.003)
    assert rows.gain_error["motor_rear"] == pytest.approx(direct, abs=rows.gain_error_sd["motor_rear"])
    assert rows.gain_error_sd["motor_rear"] < 0.01
    assert rows.gain_error_sd["motor_front"] > 0.05
    assert not rows.corrected.any()
    assert "the gain of motor_front needs a drive in which that current varies more" in found.summary()
    assert not any(each.parameters.findings for each in found.vehicles_.values())
    assert any("the sensors sum to +4.1" in notice for notice in found.notices_), "the load of the car"
