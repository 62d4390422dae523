from pathlib import Path

import can
import cantools
import msgspec
import numpy as np
import pytest
from e2e.p07 import e2e_p07_check
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrator.recordings.decode import message_is_sound
from calibrator.recordings.write_logs import encode_message, write_candump
from ecu_node.database import VehicleDatabase
from ecu_node.errors import DatabaseError
from ecu_node.layout import EndToEnd, ProfileP07, read_layout

BIG_ENDIAN_DBC = """VERSION ""
NS_ :
BS_:
BU_: X
BO_ 100 M: 8 X
 SG_ A : 7|16@0- (0.5,10) [0|0] "A" X
 SG_ B : 26|11@0+ (1,0) [0|0] "A" X
 SG_ C : 40|9@1- (-0.25,0) [0|0] "A" X
"""


def test_frames_decode_with_cantools_to_the_nearest_code(database: VehicleDatabase) -> None:
    time_s = np.arange(50) * 0.01
    current = 300.0 * np.sin(time_s * 30.0)
    series = encode_message(database, "HV_Motor", time_s, {"MotorCurrent": current})
    message = database.message("HV_Motor")
    decoded = [message.decode_simple(row.tobytes(), decode_choices=False) for row in series.data]
    np.testing.assert_allclose([float(str(d["MotorCurrent"])) for d in decoded], current, atol=0.01 + 1e-9)
    assert [d["AliveCounter"] for d in decoded] == [k % 15 for k in range(50)]


def test_frames_with_a_counter_of_several_bytes_are_written_and_read() -> None:
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
def test_missing_values_become_the_code_for_not_available_and_others_saturate(
    database: VehicleDatabase, value: float, expected: object
) -> None:
    series = encode_message(database, "HV_Motor", np.zeros(1), {"MotorCurrent": np.array([value])})
    decoded = database.message("HV_Motor").decode_simple(series.data[0].tobytes())
    assert decoded["MotorCurrent"] == (pytest.approx(expected) if isinstance(expected, float) else expected)
    assert decoded["MotorTorque"] == "SNA"


def test_float_signal_is_not_written_as_whole_number() -> None:
    database = big_endian_database(
        BIG_ENDIAN_DBC.replace("M: 8", "M: 16").replace("40|9@1-", "64|32@1-") + "SIG_VALTYPE_ 100 C : 1;\n"
    )
    with pytest.raises(DatabaseError, match=r"^signal C is a float; only whole-numbered signals can be written"):
        encode_message(database, "M", np.zeros(1), {"C": np.array([1.5])})
    assert len(encode_message(database, "M", np.zeros(1), {"B": np.array([1.0])}).data) == 1


@settings(max_examples=60)
@given(st.integers(-32768, 32767), st.integers(0, 2047), st.integers(-256, 255))
def test_both_byte_orders_agree_with_cantools(a: int, b: int, c: int) -> None:
    expected = big_endian_database().message("M").encode({"A": a * 0.5 + 10, "B": b, "C": c * -0.25}, strict=False)
    series = encode_message(
        big_endian_database(),
        "M",
        np.zeros(1),
        {"A": np.array([a * 0.5 + 10]), "B": np.array([float(b)]), "C": np.array([c * -0.25])},
    )
    assert series.data[0].tobytes() == expected


def big_endian_database(dbc: str = BIG_ENDIAN_DBC, **keys: EndToEnd) -> VehicleDatabase:
    layout = msgspec.structs.replace(read_layout(Path(__file__).parents[3] / "dbc" / "hv_powertrain.toml"), **keys)
    database = cantools.database.load_string(dbc)
    assert isinstance(database, cantools.database.can.Database)
    return VehicleDatabase(layout=layout, databases={"": database}, digest="0" * 64)


@pytest.mark.parametrize("suffix", [".log", ".log.gz"])
def test_log_reads_back_in_order_of_time(database: VehicleDatabase, tmp_path: Path, suffix: str) -> None:
    slow = encode_message(database, "HV_Dcdc", np.array([0.05, 0.15]), {"DcdcCurrent": np.ones(2)})
    fast = encode_message(database, "HV_Motor", np.array([0.0, 0.1, 0.2]), {"MotorCurrent": np.ones(3)})
    path = tmp_path / f"drive{suffix}"
    assert write_candump(path, [slow, fast]) == 5
    with can.LogReader(path) as reader:
        frames = list(reader)
    assert [f.arbitration_id for f in frames] == [288, 320, 288, 320, 288]
    assert [f.timestamp for f in frames] == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2])
    assert frames[1].data == slow.data[0].tobytes()
