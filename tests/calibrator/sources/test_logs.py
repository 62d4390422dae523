"""Which log belongs to which vehicle, found without reading the logs; what branches a fleet has."""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Channel, Drive, FleetSource
from calibrator.drives.store import write_drive
from calibrator.errors import FleetError
from calibrator.files.storage import open_storage
from calibrator.sources.fleet_source import find_fleet, find_logs, probe_equipment
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError
from tests.calibrator.doctor.artificial_logs import true_drive


def drives(found: FleetSource) -> list[str]:
    return [f"{log.vehicle}/{log.name}" for logs in found.vehicles.values() for log in logs]


def make(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


@pytest.mark.parametrize(("files", "arguments", "found", "problems"), [
    (["logs/V1/monday.log.gz", "logs/V2/a.b.blf", "truth.json"], ["."], ["V1/monday", "V2/a.b"], []),
    (["V1/DRIVE1.LOG.GZ"], ["."], ["V1/DRIVE1"], []),
    (["V1/a.log"], ["V1", "V1/a.log", "."], ["V1/a"], []),  # named twice, read once
    (["V1/a.log", "V1/old/b.log"], ["V1", "V1/a.log"], ["V1/a", "old/b"], []),
    (["V1/a.log", "V1/old/b.log"], ["V1"], ["old/b"], ["V1/a.log: lies beside folders with logs; move it"]),
    (["V1/a.log", "V2/a.log", "b.log"], ["."], ["V1/a", "V2/a"], ["b.log: lies beside folders with logs"]),
    (["x/V1/a.log", "y/V1/b.log", "y/V2/a.log"], ["."], ["V2/a"],
     ["two vehicles with one name: V1 is in {}/x/V1 and in {}/y/V1; rename one folder"]),
    (["V1/a.log", "V1/a.blf", "V1/b.log"], ["."], ["V1/b"],
     ["vehicle V1: drive a is in {}/V1/a.blf and {}/V1/a.log; remove or rename one"]),
    (["V1/größe.log", "V2/a.log", "V2/a.blf", "V3/a.log"], ["."], ["V3/a"],
     ["größe.log: the file's name, which names the drive, 'größe' cannot be used", "vehicle V2: drive a is in"]),
    (["V1/a.log", "V2/notes.md", "V3/b/c.log", ".git/x", "notes.md"], ["."], ["V1/a", "b/c"],
     ["{}: no logs in V2; expected .log, .asc"]),
    (["V1/a.log", "empty/notes.md"], ["nothing", "empty", "V1"], ["V1/a"],
     ["nothing: no such file or folder", "empty: no logs in it; expected .log, .asc"]),
])  # fmt: skip
def test_logs_are_assigned_to_vehicles_by_folder_and_problems_are_reported(
    tmp_path: Path, files: list[str], arguments: list[str], found: list[str], problems: list[str]
) -> None:
    make(*(tmp_path / name for name in files))
    fleet = find_logs([tmp_path / argument for argument in arguments])
    assert drives(fleet) == found
    for problem, words in zip(fleet.left_out.values(), problems, strict=True):
        assert words.replace("{}", str(tmp_path)) in problem


def test_log_at_a_url_is_assigned_to_the_vehicle_of_its_folder() -> None:
    for name in ("a.log.gz", "b.log.gz"):
        open_storage("memory://logs/V1").write(name, b"")
    assert drives(find_logs(["memory://logs/V1/a.log.gz"])) == ["V1/a"]
    assert drives(find_fleet("memory://logs/V1/b.log.gz")) == ["V1/b"]
    (problem,) = find_logs(["memory://logs/V1/c.log.gz"]).left_out.values()
    assert problem.startswith("memory://logs/V1/c.log.gz: nothing is there, or no logs in it")


def test_archive_counts_as_a_vehicle_folder_and_a_damaged_one_is_reported(tmp_path: Path) -> None:
    make(tmp_path / "V1" / "a.log", tmp_path / "V1" / "b.log")
    with zipfile.ZipFile(tmp_path / "V2.ZIP", "w") as archive:
        archive.writestr("a.log", "")
    (tmp_path / "old.zip").write_bytes(b"no archive")
    (tmp_path / "V1" / "c.txt.gz").write_bytes(b"not packed")
    found = find_logs([tmp_path])
    assert drives(found) == ["V1/a", "V1/b", "V1/c", "V2/a"]
    (problem,) = found.left_out.values()
    assert problem.startswith(f"{tmp_path / 'old.zip'}: not a readable archive: ")


def test_folder_of_a_vehicle_may_be_a_symbolic_link(tmp_path: Path) -> None:
    make(tmp_path / "disk" / "V1" / "a.log")
    (tmp_path / "fleet").mkdir()
    (tmp_path / "fleet" / "V1").symlink_to(tmp_path / "disk" / "V1")
    (tmp_path / "disk" / "V1" / "back").symlink_to(tmp_path / "fleet")
    found = find_logs([tmp_path / "fleet"])
    assert drives(found) == ["V1/a"]
    assert not found.left_out


# What a fleet is equipped with


INPUTS = ("voltage", "torque", "speed")


def channel() -> Channel:
    return Channel(time_s=np.arange(100) * 0.1, value=np.ones(100), good=np.full(100, True))


@pytest.fixture
def store(database: VehicleDatabase, tmp_path: Path) -> Path:
    """One vehicle with battery, motor and auxiliary."""
    branches = {name: channel() for name in ("battery", "motor", "auxiliary")}
    drive = Drive(vehicle="V", name="d", branches=branches, inputs={name: channel() for name in INPUTS})
    write_drive(tmp_path, drive, database.layout)
    return tmp_path


@pytest.mark.parametrize(("branches", "beside"), [
    (None, []),
    (["battery", "motor"], ["branches recorded but not asked for, missing from the junction sum: auxiliary"]),
], ids=["all asked for", "auxiliary not asked for"])  # fmt: skip
def test_branches_not_recorded_or_not_requested_are_named_in_notices(
    store: Path, database: VehicleDatabase, branches: list[str] | None, beside: list[str]
) -> None:
    notices = [n for n in probe_equipment(find_fleet(store), database, branches).notices if n.startswith("branches")]
    assert notices == ["branches not recorded, taken as not fitted: dcdc, motor_rear", *beside]


def test_branches_of_a_vehicle_are_those_of_its_first_readable_drive(store: Path, database: VehicleDatabase) -> None:
    (store / "drives" / "V" / "a.parquet").touch()
    assert probe_equipment(find_fleet(store), database, None).branches == ("battery", "motor", "auxiliary")


@pytest.mark.parametrize(("branches", "words"), [
    (["battery", "battery"], "branch battery is asked for twice; name each branch once"),
    (["pack", "battery"], "no branch 'pack'; known are battery, motor"),
])  # fmt: skip
def test_wrong_branches_are_refused(store: Path, database: VehicleDatabase, branches: list[str], words: str) -> None:
    with pytest.raises((FleetError, LayoutError), match=words):
        probe_equipment(find_fleet(store), database, branches)


def test_inputs_that_are_computed_from_a_current_sensor_are_not_used(tmp_path: Path, database: VehicleDatabase) -> None:
    drive = true_drive()
    torque = replace(drive.branches["motor"], value=-0.76 * drive.branches["motor"].value)
    write_drive(tmp_path, replace(drive, inputs={**drive.inputs, "torque": torque}), database.layout)
    found = probe_equipment(find_fleet(tmp_path), database, None)
    notice = "torque (most like motor), as if computed from current sensors, with their noise and their faults"
    assert f"model inputs left out: {notice}" in found.notices
    assert found.inputs == ("heater_current", "aircon_current", "low_voltage_current")
