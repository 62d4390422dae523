from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Array, Channel, Drive
from calibrator.errors import LogError
from calibrator.recordings.readers import read_recording
from calibrator.recordings.write_logs import encode_message, write_candump
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from tests.calibrator.drive_logs import write_drive_log

POWER_DBC = """VERSION ""
BU_: A
BO_ 1 Power: 8 A
 SG_ Power : 0|16@1- (0.5,0) [-1000|1000] "kW" A
BO_ 2 Volt: 8 A
 SG_ Voltage : 0|16@1+ (0.1,0) [0|1000] "V" A
BO_ 2147483651 Batt: 8 A
 SG_ Current : 0|16@1- (100,0) [0|0] "mA" A
"""
POWER_LAYOUT = """
schema = 1
name = "power"
dbc = "power.dbc"
full_scale_a = 400
[[branch]]
name = "battery"
signal = "Batt.Current"
sign = 1
[[branch]]
name = "motor"
power = "Power.Power"
voltage = "Volt.Voltage"
sign = -1
timeout_s = 0.5
"""


@pytest.fixture
def power_database(tmp_path: Path) -> VehicleDatabase:
    (tmp_path / "power.dbc").write_text(POWER_DBC)
    (tmp_path / "power.toml").write_text(POWER_LAYOUT)
    return read_database(read_layout(tmp_path / "power.toml"))


def log_of(path: Path, lines: list[tuple[float, str]]) -> Path:
    path.write_text("".join(f"({1e9 + time:.6f}) can0 {text}\n" for time, text in lines))
    return path


def steady(values: list[float], period_s: float = 0.1) -> Channel:
    value = np.array(values)
    return Channel(time_s=period_s * np.arange(len(value)), value=value, good=np.isfinite(value))


def read_motor(path: Path, database: VehicleDatabase) -> Channel:
    return read_recording(path, database, vehicle="v", name="d").drive.branches["motor"]


def test_a_drive_written_as_a_log_is_read_back(tmp_path: Path, database: VehicleDatabase) -> None:
    written = Drive(
        vehicle="v",
        name="d",
        branches={"battery": steady([10.0, 11.0, np.nan]), "motor": steady([-9.0, -10.0, -11.0])},
        inputs={"voltage": steady([390.0, 391.0, 392.0]), "speed": steady([0.0, 50.0, np.nan])},
    )
    write_drive_log(tmp_path / "d.log.gz", written, database)
    read = read_recording(tmp_path / "d.log.gz", database, vehicle="v", name="d").drive
    assert set(read.branches) == {"battery", "motor"}
    for name, channel in (*written.branches.items(), *written.inputs.items()):
        found = {**read.branches, **read.inputs}[name]
        np.testing.assert_allclose(found.time_s, channel.time_s, atol=1e-9)
        assert np.array_equal(found.good, channel.good)
        np.testing.assert_allclose(found.value[found.good], channel.value[channel.good], atol=0.01)


def test_a_current_has_the_sign_of_the_layout_and_the_unit_of_the_dbc_is_turned_into_ampere(
    tmp_path: Path, power_database: VehicleDatabase
) -> None:
    drive = read_recording(
        log_of(tmp_path / "x.log", [(0.0, "00000003#9CFF")]), power_database, vehicle="v", name="d"
    ).drive
    np.testing.assert_allclose(drive.branches["battery"].value, [-10.0])


def test_an_identifier_of_11_bits_is_not_taken_for_one_of_29(tmp_path: Path, power_database: VehicleDatabase) -> None:
    with pytest.raises(LogError, match="no branch"):
        read_motor(log_of(tmp_path / "x.log", [(0.0, "003#9CFF")]), power_database)


def test_power_is_divided_by_the_latest_voltage_at_or_before_it_until_that_is_too_old(
    tmp_path: Path, power_database: VehicleDatabase
) -> None:
    lines = [(0.0, "001#1400"), (0.1, "002#A00F"), (0.1, "001#1400"), (0.2, "002#D007"), (0.25, "001#1400")]
    lines += [(0.7, "001#1400"), (0.8, "001#1400")]
    motor = read_motor(log_of(tmp_path / "x.log", lines), power_database)
    np.testing.assert_allclose(motor.time_s, [0.0, 0.1, 0.25, 0.7, 0.8], atol=1e-9)
    assert motor.good.tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(motor.value[1:3], [-10_000 / 400.0, -10_000 / 200.0])


def test_codes_with_any_name_and_those_of_the_layout_are_no_currents_as_on_the_node(
    tmp_path: Path, power_database: VehicleDatabase
) -> None:
    names = 'VAL_ 1 Power -200 "Signal_ungueltig" ;\nVAL_ 2 Voltage 4000 "Ersatzwert" ;\n'
    (tmp_path / "power.dbc").write_text(POWER_DBC + names)
    (tmp_path / "power.toml").write_text(POWER_LAYOUT + "no_value = [-100, 21]\n")
    database = read_database(read_layout(tmp_path / "power.toml"))
    texts = ["002#A10F", "001#1400", "001#38FF", "001#9CFF", "001#1500", "002#A00F", "001#1400"]
    lines = list(zip((0.0, 0.1, 0.2, 0.3, 0.4, 0.41, 0.45), texts, strict=True))
    motor = read_motor(log_of(tmp_path / "x.log", lines), database)
    assert motor.good.tolist() == [True, False, False, False, True]
    np.testing.assert_allclose(motor.value[4], -10_000 / 400.1)
    before = read_motor(log_of(tmp_path / "y.log", lines), power_database)
    assert before.good.all()


def test_names_of_an_input_are_values_unless_they_mean_not_available(tmp_path: Path) -> None:
    gear = ' SG_ Gear : 16|8@1+ (1,0) [0|0] "" A\n'
    dbc = POWER_DBC.replace('[0|1000] "V" A\n', f'[0|1000] "V" A\n{gear}')
    (tmp_path / "power.dbc").write_text(dbc + 'VAL_ 2 Gear 1 "Drive" 2 "Ungueltig" 3 "SNA" ;\n')
    (tmp_path / "power.toml").write_text(POWER_LAYOUT + '[[input]]\nname = "gear"\nsignal = "Volt.Gear"\n')
    database = read_database(read_layout(tmp_path / "power.toml"))
    lines = [(0.0, "001#1400"), (0.1, "002#A00F01"), (0.2, "002#A00F02"), (0.3, "002#A00F03")]
    drive = read_recording(log_of(tmp_path / "x.log", lines), database, vehicle="v", name="d").drive
    assert drive.inputs["gear"].good.tolist() == [True, True, False]


def test_a_log_without_any_branch_lists_what_it_has_and_what_is_expected(
    tmp_path: Path, database: VehicleDatabase
) -> None:
    path = log_of(tmp_path / "x.log", [(0.0, "7FF#00"), (0.1, "18DAF110#00")])
    with pytest.raises(LogError, match=r"x\.log: no branch .* 0x7FF, 0x18DAF110; expected HV_Battery \(0x110\)"):
        read_recording(path, database, vehicle="v", name="d")


def test_an_input_that_is_never_available_is_left_out_and_reported(tmp_path: Path, database: VehicleDatabase) -> None:
    drive = Drive(vehicle="v", name="d", branches={"battery": steady([1.0, 2.0])}, inputs={})
    write_drive_log(tmp_path / "d.log", drive, database)
    recording = read_recording(tmp_path / "d.log", database, vehicle="v", name="d")
    assert "voltage" not in recording.drive.inputs
    assert "voltage: 2 of 2 frames not usable" in map(str, recording.report.notices())


def test_a_frame_with_a_wrong_crc_is_labelled(tmp_path: Path, database: VehicleDatabase) -> None:
    series = encode_message(database, "HV_Battery", np.array([0.0, 0.1]), {"BatteryCurrent": np.array([1.0, 2.0])})
    series.data[1, 0] ^= 1
    write_candump(tmp_path / "d.log", [series])
    battery = read_recording(tmp_path / "d.log", database, vehicle="v", name="d").drive.branches["battery"]
    assert battery.good.tolist() == [True, False]


def test_corrected_frames_are_read_beside_the_measured_ones(tmp_path: Path, database: VehicleDatabase) -> None:
    time_s: Array = np.array([0.0, 0.1])
    measured = encode_message(database, "HV_Motor", time_s, {"MotorCurrent": np.array([10.0, 20.0])})
    corrected = encode_message(database, "HV_MotorCorrected", time_s, {"MotorCurrentCorrected": np.array([9.0, 18.0])})
    write_candump(tmp_path / "d.log", [measured, corrected])
    recording = read_recording(tmp_path / "d.log", database, vehicle="v", name="d")
    np.testing.assert_allclose(recording.drive.branches["motor"].value, [-10.0, -20.0])
    np.testing.assert_allclose(recording.corrected["motor"].value, [-9.0, -18.0])
