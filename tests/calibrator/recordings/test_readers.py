from pathlib import Path

import can
import cantools
import msgspec
import numpy as np
import pytest
from e2e.p07 import e2e_p07_check
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrator.drive import Drive
from calibrator.errors import LogError
from calibrator.recordings.decode import message_is_sound
from calibrator.recordings.readers import read_recording
from calibrator.recordings.write_logs import encode_message, write_candump
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import DatabaseError
from ecu_node.layout import EndToEnd, ProfileP07, read_layout
from tests.calibrator.conftest import LAYOUT

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


def recorded(folder: Path, *lines: tuple[float, str], dbc: str = POWER_DBC, layout: str = POWER_LAYOUT) -> Drive:
    """The drive of a log of frames at some times [s]."""
    (folder / "power.dbc").write_text(dbc)
    (folder / "power.toml").write_text(layout)
    (folder / "x.log").write_text("".join(f"({1e9 + time:.6f}) can0 {text}\n" for time, text in lines))
    database = read_database(read_layout(folder / "power.toml"))
    return read_recording(folder / "x.log", database, vehicle="v", name="d").drive


def test_current_has_the_sign_of_the_layout_and_is_in_ampere(tmp_path: Path) -> None:
    drive = recorded(tmp_path, (0.0, "00000003#9CFF"))
    np.testing.assert_allclose(drive.branches["battery"].value, [-10.0])
    with pytest.raises(LogError, match=r"no branch .* 0x003; expected "):  # of 11 bits, not of 29
        recorded(tmp_path, (0.0, "003#9CFF"))


def test_power_is_divided_by_the_latest_voltage_unless_stale(tmp_path: Path) -> None:
    lines = [(0.0, "001#1400"), (0.1, "002#A00F"), (0.1, "001#1400"), (0.2, "002#D007"), (0.25, "001#1400")]
    motor = recorded(tmp_path, *lines, (0.7, "001#1400"), (0.8, "001#1400")).branches["motor"]
    np.testing.assert_allclose(motor.time_s, [0.0, 0.1, 0.25, 0.7, 0.8], atol=1e-9)
    assert motor.good.tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(motor.value[1:3], [-10_000 / 400.0, -10_000 / 200.0])


def test_codes_for_no_value_in_dbc_or_layout_are_not_currents(tmp_path: Path) -> None:
    names = 'VAL_ 1 Power -200 "Signal_ungueltig" ;\nVAL_ 2 Voltage 4000 "Ersatzwert" ;\n'
    texts = ["002#A10F", "001#1400", "001#38FF", "001#9CFF", "001#1500", "002#A00F", "001#1400"]
    lines = list(zip((0.0, 0.1, 0.2, 0.3, 0.4, 0.41, 0.45), texts, strict=True))
    changed = {"dbc": POWER_DBC + names, "layout": POWER_LAYOUT + "no_value = [-100, 21]\n"}
    motor = recorded(tmp_path, *lines, **changed).branches["motor"]
    assert motor.good.tolist() == [True, False, False, False, True]
    np.testing.assert_allclose(motor.value[4], -10_000 / 400.1)
    assert recorded(tmp_path, *lines).branches["motor"].good.all()


def test_named_codes_of_an_input_are_values_unless_they_mean_not_available(tmp_path: Path) -> None:
    gear = '"V" A\n SG_ Gear : 16|8@1+ (1,0) [0|0] "" A\n'
    dbc = POWER_DBC.replace('"V" A\n', gear) + 'VAL_ 2 Gear 1 "Drive" 2 "Ungueltig" 3 "SNA" ;\n'
    layout = POWER_LAYOUT + '[[input]]\nname = "gear"\nsignal = "Volt.Gear"\n'
    lines = [(0.0, "001#1400"), (0.1, "002#A00F01"), (0.2, "002#A00F02"), (0.3, "002#A00F03")]
    assert recorded(tmp_path, *lines, dbc=dbc, layout=layout).inputs["gear"].good.tolist() == [True, True, False]


def test_sample_of_a_frame_with_wrong_crc_is_not_good(tmp_path: Path, database: VehicleDatabase) -> None:
    series = encode_message(database, "HV_Battery", np.array([0.0, 0.1]), {"BatteryCurrent": np.array([1.0, 2.0])})
    series.data[1, 0] ^= 1
    write_candump(tmp_path / "d.log", [series])
    battery = read_recording(tmp_path / "d.log", database, vehicle="v", name="d").drive.branches["battery"]
    assert battery.good.tolist() == [True, False]


# Logs that are written


BIG_ENDIAN_DBC = """VERSION ""
NS_ :
BS_:
BU_: X
BO_ 100 M: 8 X
 SG_ A : 7|16@0- (0.5,10) [0|0] "A" X
 SG_ B : 26|11@0+ (1,0) [0|0] "A" X
 SG_ C : 40|9@1- (-0.25,0) [0|0] "A" X
"""


def test_frames_of_e2e_profile_7_with_a_counter_of_4_bytes_are_written_and_checked() -> None:
    dbc = BIG_ENDIAN_DBC.replace("M: 8", "M: 32")
    database = big_endian_database(dbc, e2e=ProfileP07(messages=["M"], offset=8))
    count = 300
    series = encode_message(database, "M", np.arange(float(count)), {"B": np.arange(float(count))})
    assert all(e2e_p07_check(row.tobytes(), 100, offset=8) for row in series.data)
    assert [int.from_bytes(row[20:24].tobytes()) for row in series.data] == list(range(count))
    length = np.full(count, 32, np.uint8)
    length[1], length[2] = 27, 31
    series.data[3, 0] ^= 1
    sound = message_is_sound(database, database.message("M"), series.data, length)
    assert np.flatnonzero(~sound).tolist() == [1, 2, 3]


@pytest.mark.parametrize(("value", "expected"), [(np.nan, "SNA"), (1e6, 650.0), (-1e6, -650.0)])
def test_missing_values_become_sna_and_large_saturate(
    database: VehicleDatabase, value: float, expected: object
) -> None:
    series = encode_message(database, "HV_Motor", np.zeros(1), {"MotorCurrent": np.array([value])})
    decoded = database.message("HV_Motor").decode_simple(series.data[0].tobytes())
    assert decoded["MotorCurrent"] == (pytest.approx(expected) if isinstance(expected, float) else expected)
    assert decoded["MotorTorque"] == "SNA"


def test_writing_a_floating_point_signal_is_refused() -> None:
    dbc = BIG_ENDIAN_DBC.replace("M: 8", "M: 16").replace("40|9@1-", "64|32@1-")
    database = big_endian_database(f"{dbc}SIG_VALTYPE_ 100 C : 1;\n")
    with pytest.raises(DatabaseError, match=r"^signal C is a float; only whole-numbered signals can be written"):
        encode_message(database, "M", np.zeros(1), {"C": np.array([1.5])})
    assert len(encode_message(database, "M", np.zeros(1), {"B": np.array([1.0])}).data) == 1


@settings(max_examples=60)
@given(st.integers(-32768, 32767), st.integers(0, 2047), st.integers(-256, 255), st.floats(-0.49, 0.49))
def test_values_are_written_as_the_nearest_codes_in_both_byte_orders(a: int, b: int, c: int, e: float) -> None:
    database = big_endian_database()
    expected = database.message("M").encode({"A": a * 0.5 + 10, "B": b, "C": c * -0.25}, strict=False)
    values = {"A": np.array([(a + e) * 0.5 + 10]), "B": np.array([b + e]), "C": np.array([(c + e) * -0.25])}
    assert encode_message(database, "M", np.zeros(1), values).data[0].tobytes() == expected


def big_endian_database(dbc: str = BIG_ENDIAN_DBC, **keys: EndToEnd) -> VehicleDatabase:
    layout = msgspec.structs.replace(read_layout(LAYOUT), **keys)
    database = cantools.database.load_string(dbc)
    assert isinstance(database, cantools.database.can.Database)
    return VehicleDatabase(layout=layout, databases={"": database}, digest="0" * 64)


@pytest.mark.parametrize("suffix", [".log", ".log.gz"])
def test_written_log_is_read_back_in_time_order(database: VehicleDatabase, tmp_path: Path, suffix: str) -> None:
    slow = encode_message(database, "HV_Dcdc", np.array([0.05, 0.15]), {"DcdcCurrent": np.ones(2)})
    fast = encode_message(database, "HV_Motor", np.array([0.0, 0.1, 0.2]), {"MotorCurrent": np.ones(3)})
    path = tmp_path / f"drive{suffix}"
    assert write_candump(path, [slow, fast]) == 5
    with can.LogReader(path) as reader:
        frames = list(reader)
    assert [f.arbitration_id for f in frames] == [288, 320, 288, 320, 288]
    assert [f.timestamp for f in frames] == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2])
    assert frames[1].data == slow.data[0].tobytes()
