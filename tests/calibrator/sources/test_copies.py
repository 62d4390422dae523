"""A recording that is there twice counts once."""

import gzip
import shutil
from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Channel, Drive
from calibrator.drives.store import write_drive
from calibrator.sources.copies import without_copies
from calibrator.sources.fleet_source import FleetSource, find_fleet
from ecu_node.database import VehicleDatabase

DriveNames = dict[str, list[str]]


def log(seed: int, frames: int = 3000) -> bytes:
    values = np.random.default_rng(seed).integers(256, size=frames)
    return b"".join(b"(%d.000000) can0 110#%02X\n" % (k, value) for k, value in enumerate(values))


def put(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)


def names(fleet: FleetSource) -> DriveNames:
    return {vehicle: [entry.name for entry in entries] for vehicle, entries in fleet.vehicles.items()}


def test_vehicles_with_the_same_recordings_are_both_left_out_as_it_cannot_be_told_whose_they_are(
    tmp_path: Path,
) -> None:
    for vehicle, seed in (("V001", 1), ("V002", 2), ("V003", 1)):
        put(tmp_path / vehicle / "monday.log", log(seed))
        put(tmp_path / vehicle / "tuesday.log", log(10 + seed))
    fleet = without_copies(find_fleet(tmp_path))
    assert names(fleet) == {"V002": ["monday", "tuesday"]}
    assert fleet.left_out["V001"].startswith("same recording as V003; it cannot be told whose it is")
    assert fleet.left_out["V003"].startswith("same recording as V001; it cannot be told whose it is")


def test_a_recording_of_two_vehicles_is_left_out_of_both_and_they_keep_their_others(tmp_path: Path) -> None:
    put(tmp_path / "A" / "monday.log", log(1))
    put(tmp_path / "A" / "tuesday.log", log(2))
    put(tmp_path / "B" / "monday.log", log(2))
    put(tmp_path / "B" / "wednesday.log", log(3))
    fleet = without_copies(find_fleet(tmp_path))
    assert names(fleet) == {"A": ["monday"], "B": ["wednesday"]}
    assert [notice.split(";")[0] for notice in fleet.notices] == [
        "vehicle A: drive tuesday is left out: same recording as B/monday",
        "vehicle B: drive monday is left out: same recording as A/tuesday",
    ]
    assert not fleet.left_out


def test_a_recording_that_a_vehicle_has_twice_counts_once(tmp_path: Path) -> None:
    put(tmp_path / "V001" / "monday.log", log(1))
    put(tmp_path / "V001" / "tuesday.log", log(1))
    fleet = without_copies(find_fleet(tmp_path))
    assert names(fleet) == {"V001": ["monday"]}
    assert fleet.notices == ("vehicle V001: drive tuesday is the same recording as monday, and counts once",)


def test_compression_does_not_make_another_recording(tmp_path: Path) -> None:
    put(tmp_path / "V001" / "drive.log", log(1))
    put(tmp_path / "V001" / "other.log.gz", log(1))
    assert names(without_copies(find_fleet(tmp_path))) == {"V001": ["drive"]}


@pytest.mark.parametrize("change", [0, 20_000, 70_000])
def test_logs_that_differ_in_one_character_are_two(tmp_path: Path, change: int) -> None:
    content = bytearray(log(1, frames=4000))
    put(tmp_path / "V001" / "drive.log", bytes(content))
    content[change] ^= 1
    put(tmp_path / "V002" / "drive.log", bytes(content))
    fleet = find_fleet(tmp_path)
    assert without_copies(fleet) == fleet


def test_empty_and_damaged_logs_are_left_to_those_who_read_them(tmp_path: Path) -> None:
    for vehicle in ("V001", "V002"):
        put(tmp_path / vehicle / "empty.log", b"")
        put(tmp_path / vehicle / "cut.log.gz", b"")
        (tmp_path / vehicle / "cut.log.gz").write_bytes(gzip.compress(log(1))[:100])
    fleet = find_fleet(tmp_path)
    assert without_copies(fleet) == fleet


def drive(seed: int, vehicle: str, name: str) -> Drive:
    rng = np.random.default_rng(seed)
    value = rng.normal(size=100)
    value[3] = np.nan
    channel = Channel(time_s=0.1 * np.arange(100), value=value, good=np.isfinite(value))
    return Drive(vehicle=vehicle, name=name, branches={"battery": channel, "motor": channel}, inputs={})


def test_copies_in_a_store_are_found_whatever_their_names(tmp_path: Path, database: VehicleDatabase) -> None:
    for seed, vehicle, name in ((1, "V1", "a"), (1, "V1", "b"), (2, "V2", "a"), (2, "another one", "long name")):
        write_drive(tmp_path, drive(seed, vehicle, name), database.layout)
    shutil.copytree(tmp_path / "drives" / "V1", tmp_path / "drives" / "V3")
    fleet = without_copies(find_fleet(tmp_path))
    assert names(fleet) == {}
    assert set(fleet.left_out) == {"V1", "V2", "V3", "another one"}


def test_drives_of_a_store_that_differ_in_one_label_are_two(tmp_path: Path, database: VehicleDatabase) -> None:
    one, other = drive(1, "V1", "a"), drive(1, "V2", "a")
    other.branches["motor"].good[5] = False
    for item in (one, other):
        write_drive(tmp_path, item, database.layout)
    assert len(without_copies(find_fleet(tmp_path)).vehicles) == 2
