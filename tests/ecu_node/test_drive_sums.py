"""Drives summed up by a node: frames in, records out. tests/calibrator/summaries compares them with the log."""

import argparse
import math
import re
import shutil
from pathlib import Path

import msgspec
import pytest

from ecu_node import summary as rule
from ecu_node.bus import on_board_summary as room
from ecu_node.bus.on_board_summary import OnBoardSummary, on_board_summary
from ecu_node.core.signals import FrameKey
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.summary import SummaryFile, decode_summary, encode_summary, unpacked
from tests.ecu_node.processes import bench_node, running
from tests.ecu_node.vehicles import SMALL_LAYOUT, MakeDatabase

OPEN_S, OFFSET_A, HEATER_W, NET_V = 8.0, 5.0, 2000, 400.0
WITH_CONTACTOR = f"""{SMALL_LAYOUT}
input = [{{ name = "net", signal = "Net.Voltage" }}]
contactor = {{ input = "net", open = [0.0] }}
"""


class Drive:
    """A vehicle whose battery feeds motor and heater; the sensor of the battery has an offset."""

    def __init__(self, folder: Path, database: VehicleDatabase) -> None:
        self.said, self.folder, self.database = list[str](), folder / "V1", database
        self.summary = OnBoardSummary(folder, "V1", database, delays={}, say=self.said.append)
        self.stamp_s = 1000.0

    def go_on(self, duration_s: float, open_s: float = OPEN_S) -> None:
        """Send frames at 10 Hz; the contactors are open in the first `open_s` seconds."""
        for step in range(round(10.0 * duration_s)):
            flows = step >= 10.0 * open_s
            motor_a, heater_a = flows * (50.0 + 30.0 * math.sin(0.37 * step)), flows * HEATER_W / NET_V
            battery, motor = round((motor_a + heater_a + OFFSET_A) / 0.1), round(-motor_a / 0.05)
            pair = battery.to_bytes(2, "big", signed=True) + motor.to_bytes(2, "big", signed=True) + bytes(4)
            self.take(258, False, (round(NET_V / 0.01) * flows).to_bytes(2, "little"))
            self.take(512, True, HEATER_W.to_bytes(4, "little"))
            self.take(256, False, pair)
            self.stamp_s += 0.1

    def ended(self) -> list[SummaryFile]:
        """End the node, and return its records."""
        self.summary.close()
        return self.records()

    def take(self, identifier: int, extended: bool, payload: bytes) -> None:
        self.summary.take(FrameKey(identifier, extended), bytearray(payload), self.stamp_s)

    def records(self) -> list[SummaryFile]:
        return [decode_summary(path.read_bytes()) for path in sorted(self.folder.glob("*.summary"))]


@pytest.fixture
def drive(make_database: MakeDatabase, tmp_path: Path) -> Drive:
    return Drive(tmp_path / "sums", make_database(WITH_CONTACTOR))


def test_record_has_mean_currents_and_the_offset_at_open_contactors(drive: Drive) -> None:
    drive.go_on(120.0)
    for battery in (3000, 500):  # of two samples at one instant the last one counts
        drive.take(256, False, battery.to_bytes(2, "big") + bytes(6))
    drive.take(999, False, bytes(8))
    (record,) = drive.ended()
    assert record.branches == ["battery", "motor", "heater"]
    assert record.zero_offset_a == [pytest.approx(OFFSET_A), pytest.approx(0.0), None]
    battery_a, motor_a, heater_a = unpacked(record.mean)
    assert heater_a == pytest.approx(-HEATER_W / NET_V)
    assert battery_a + motor_a + heater_a == pytest.approx(OFFSET_A, abs=0.05)
    assert record.starts == [True]


def test_clock_step_starts_a_new_drive(drive: Drive) -> None:
    drive.go_on(60.0)
    drive.stamp_s += 3600.0
    drive.go_on(60.0)
    (record,) = drive.ended()
    assert record.starts == [True, True]


def test_silence_of_a_minute_ends_a_drive(drive: Drive) -> None:
    drive.go_on(60.0)
    drive.summary.look(0.0)
    assert drive.records() == []
    drive.summary.look(room.DRIVE_GAP_S + 1.0)
    assert len(drive.records()) == 1


def test_single_branch_makes_no_record(drive: Drive) -> None:
    for _ in range(4000):
        drive.take(256, False, b"\0\x32")  # without the motor
        drive.stamp_s += 0.1
    assert drive.ended() == []


@pytest.mark.parametrize(("flows_s", "records"), [(2.0, 0), (5.5, 0), (6.5, 1)])
def test_drive_shorter_than_a_fifth_of_a_block_makes_no_record(drive: Drive, flows_s: float, records: int) -> None:
    drive.go_on(flows_s, open_s=0.0)
    assert len(drive.ended()) == records


def test_noise_equals_that_of_rounding_where_no_four_samples_are_consecutive(drive: Drive) -> None:
    for _ in range(60):
        drive.go_on(0.3, open_s=0.0)
        drive.stamp_s += 0.7
    (record,) = drive.ended()
    steps_a = [drive.database.current_step_a(name) for name in record.branches]
    assert [*unpacked(record.noise_a2)] == pytest.approx([step_a**2 / 12.0 for step_a in steps_a])


def test_full_record_file_is_followed_by_another(drive: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "MOST_BATCHES", 1)
    drive.go_on(400.0)
    records = drive.ended()
    assert len(records) == 3
    assert [record.starts for record in records] == [[True], [False], [False]]
    assert [record.zero_offset_a[0] for record in records] == [pytest.approx(OFFSET_A), None, None]


def test_write_failure_and_its_end_are_each_logged_once(drive: Drive) -> None:
    shutil.rmtree(drive.folder)
    for _ in range(2):
        drive.go_on(60.0)
        drive.summary.end_drive()
    drive.folder.mkdir()
    drive.go_on(60.0)
    (record,) = drive.ended()
    assert drive.said == [
        "--summary: No such file or directory; records are lost until that has changed",
        "--summary: records are written again",
    ]
    assert record.starts == [True, True, True]


def test_record_of_another_version_or_damaged_is_refused(drive: Drive) -> None:
    drive.go_on(60.0)
    (record,) = drive.ended()
    other = msgspec.structs.replace(record, schema_version=1)
    with pytest.raises(ValueError, match=f"schema version 1, expected {rule.SCHEMA_VERSION}"):
        decode_summary(encode_summary(other))
    content = encode_summary(record)
    for damaged in (content[: len(content) // 2], b"no summary", content[:2] + content[3:]):
        with pytest.raises(ValueError, match=r"cut, or too large|Error -3"):
            decode_summary(damaged)


def test_unusable_summary_folder_or_vehicle_is_refused(make_database: MakeDatabase, tmp_path: Path) -> None:
    database = make_database(SMALL_LAYOUT)
    (tmp_path / "file").touch()
    options = argparse.Namespace(summary=tmp_path / "file", vehicle="V1")
    with pytest.raises(UserError, match=r"--summary .*/file: cannot be used: .*; name another folder"):
        on_board_summary(options, {}, database, None, print)
    for vehicle in ("../V1", "V\0001"):
        options = argparse.Namespace(summary=tmp_path, vehicle=vehicle)
        with pytest.raises(UserError, match=re.escape(f"--summary: vehicle {vehicle!r} cannot name a folder; rename")):
            on_board_summary(options, {}, database, None, print)


def test_node_with_summary_option_creates_the_folder_of_its_vehicle(tmp_path: Path) -> None:
    with running(*bench_node(tmp_path, "sums"), "--summary", str(tmp_path / "sums")) as log:
        assert "running on virtual sums" in log[-1]
    assert list((tmp_path / "sums" / "V1").iterdir()) == []
