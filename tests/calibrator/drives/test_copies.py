"""A recording that is there twice counts once."""

import gzip
import shutil
from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Channel, Drive
from calibrator.drives.copies import without_copies
from calibrator.drives.fleet_source import FleetSource, find_fleet
from calibrator.drives.store import write_drive
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


def test_vehicle_that_is_a_copy_is_left_out_with_the_reason(tmp_path: Path) -> None:
    for vehicle, seed in (("V001", 1), ("V002", 2), ("V003", 1)):
        put(tmp_path / vehicle / "monday.log", log(seed))
        put(tmp_path / vehicle / "tuesday.log", log(10 + seed))
    fleet = without_copies(find_fleet(tmp_path))
    assert names(fleet) == {"V001": ["monday", "tuesday"], "V002": ["monday", "tuesday"]}
    assert list(fleet.left_out) == ["V003"]
    assert fleet.left_out["V003"].startswith("same recording as V001; a copy tells nothing new: ")


def test_drive_that_is_a_copy_is_left_out_and_the_vehicle_stays(tmp_path: Path) -> None:
    put(tmp_path / "V001" / "monday.log", log(1))
    put(tmp_path / "V001" / "tuesday.log", log(1))
    put(tmp_path / "V002" / "monday.log", log(2))
    put(tmp_path / "V002" / "tuesday.log", log(1))
    fleet = without_copies(find_fleet(tmp_path))
    assert names(fleet) == {"V001": ["monday"], "V002": ["monday"]}
    assert list(fleet.left_out) == ["V001/tuesday", "V002/tuesday"]
    assert all(reason.startswith("same recording as V001/monday; ") for reason in fleet.left_out.values())


def test_compression_does_not_make_another_recording(tmp_path: Path) -> None:
    put(tmp_path / "V001" / "drive.log", log(1))
    put(tmp_path / "V002" / "drive.log.gz", log(1))
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
    assert names(fleet) == {"V1": ["a"], "V2": ["a"]}
    assert set(fleet.left_out) == {"V1/b", "V3", "another one"}


def test_drives_of_a_store_that_differ_in_one_label_are_two(tmp_path: Path, database: VehicleDatabase) -> None:
    one, other = drive(1, "V1", "a"), drive(1, "V2", "a")
    other.branches["motor"].good[5] = False
    for item in (one, other):
        write_drive(tmp_path, item, database.layout)
    assert len(without_copies(find_fleet(tmp_path)).vehicles) == 2
