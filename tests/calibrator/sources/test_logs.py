"""Which log belongs to which vehicle; nothing is opened."""

import zipfile
from pathlib import Path

from calibrator.drive import FleetSource
from calibrator.files.storage import open_storage
from calibrator.sources.fleet_source import find_fleet, find_logs


def drives(found: FleetSource) -> list[tuple[str, str]]:
    return [(log.vehicle, log.name) for logs in found.vehicles.values() for log in logs]


def make(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_the_folder_names_the_vehicle_and_the_file_the_drive(tmp_path: Path) -> None:
    make(tmp_path / "logs" / "V1" / "monday.log.gz", tmp_path / "logs" / "V2" / "a.b.blf", tmp_path / "truth.json")
    found = find_logs([tmp_path])
    assert drives(found) == [("V1", "monday"), ("V2", "a.b")]
    assert not found.left_out


def test_a_log_beside_the_folders_of_vehicles_is_left_out_and_named(tmp_path: Path) -> None:
    make(tmp_path / "V1" / "a.log", tmp_path / "V2" / "a.log", tmp_path / "copy of a.log")
    found = find_logs([tmp_path])
    assert list(found.vehicles) == ["V1", "V2"]
    (problem,) = found.left_out.values()
    assert problem.startswith(f"{tmp_path / 'copy of a.log'}: lies beside folders with logs; move it")


def test_a_log_that_is_named_itself_is_of_its_folder_whatever_lies_beside_it(tmp_path: Path) -> None:
    make(tmp_path / "V1" / "a.log", tmp_path / "V1" / "old" / "b.log")
    found = find_logs([tmp_path / "V1", tmp_path / "V1" / "a.log"])
    assert drives(found) == [("V1", "a"), ("old", "b")]
    assert not found.left_out
    assert len(find_logs([tmp_path / "V1"]).left_out) == 1


def test_log_at_a_url_is_of_its_folder_too() -> None:
    for name in ("a.log.gz", "b.log.gz"):
        open_storage("memory://logs/V1").write(name, b"")
    assert drives(find_logs(["memory://logs/V1/a.log.gz"])) == [("V1", "a")]
    assert drives(find_fleet("memory://logs/V1/b.log.gz")) == [("V1", "b")]
    (problem,) = find_logs(["memory://logs/V1/c.log.gz"]).left_out.values()
    assert problem.startswith("memory://logs/V1/c.log.gz: nothing is there, or no logs in it")


def test_a_file_named_twice_is_read_once(tmp_path: Path) -> None:
    make(tmp_path / "V1" / "a.log")
    found = find_logs([tmp_path / "V1", tmp_path / "V1" / "a.log", tmp_path])
    assert len(drives(found)) == 1
    assert not found.left_out


def test_two_vehicles_with_one_name_are_left_out_and_the_rest_goes_on(tmp_path: Path) -> None:
    make(tmp_path / "x" / "V1" / "a.log", tmp_path / "y" / "V1" / "b.log", tmp_path / "y" / "V2" / "a.log")
    found = find_logs([tmp_path])
    assert list(found.vehicles) == ["V2"]
    (problem,) = found.left_out.values()
    assert problem.startswith(f"two vehicles with one name: V1 is in {tmp_path / 'x' / 'V1'} and in")


def test_two_files_of_one_drive_are_left_out_and_named(tmp_path: Path) -> None:
    make(tmp_path / "V1" / "a.log", tmp_path / "V1" / "a.blf", tmp_path / "V1" / "b.log")
    found = find_logs([tmp_path])
    assert drives(found) == [("V1", "b")]
    (problem,) = found.left_out.values()
    assert "vehicle V1: drive a is in" in problem
    assert "a.blf and" in problem


def test_an_argument_that_does_not_exist_or_has_no_logs_is_a_problem(tmp_path: Path) -> None:
    make(tmp_path / "V1" / "a.log")
    (tmp_path / "empty").mkdir()
    found = find_logs([tmp_path / "nothing", tmp_path / "empty", tmp_path / "V1"])
    assert len(drives(found)) == 1
    missing, empty = found.left_out.values()
    assert "nothing: no such file or folder" in missing
    assert "empty: no logs in it" in empty


def test_what_is_damaged_beside_logs_is_a_problem_or_a_log_and_the_rest_goes_on(tmp_path: Path) -> None:
    make(tmp_path / "V1" / "a.log", tmp_path / "V1" / "b.log")
    (tmp_path / "old.zip").write_bytes(b"no archive")
    (tmp_path / "V1" / "c.txt.gz").write_bytes(b"not packed")
    found = find_logs([tmp_path])
    assert drives(found) == [("V1", "a"), ("V1", "b"), ("V1", "c")]
    (problem,) = found.left_out.values()
    assert problem.startswith(f"{tmp_path / 'old.zip'}: not a readable archive: ")


def test_a_vehicle_all_of_whose_files_are_left_out_is_none(tmp_path: Path) -> None:
    make(tmp_path / "V1" / "größe.log", tmp_path / "V2" / "a.log", tmp_path / "V2" / "a.blf", tmp_path / "V3" / "a.log")
    found = find_logs([tmp_path])
    assert list(found.vehicles) == ["V3"]
    assert len(found.left_out) == 2


def test_suffixes_in_capitals_are_no_part_of_a_name(tmp_path: Path) -> None:
    make(tmp_path / "V1" / "DRIVE1.LOG.GZ")
    with zipfile.ZipFile(tmp_path / "V2.ZIP", "w") as archive:
        archive.writestr("a.log", "")
    assert drives(find_logs([tmp_path])) == [("V1", "DRIVE1"), ("V2", "a")]


def test_folder_of_a_vehicle_may_be_a_link(tmp_path: Path) -> None:
    make(tmp_path / "disk" / "V1" / "a.log")
    (tmp_path / "fleet").mkdir()
    (tmp_path / "fleet" / "V1").symlink_to(tmp_path / "disk" / "V1")
    (tmp_path / "disk" / "V1" / "back").symlink_to(tmp_path / "fleet")
    found = find_logs([tmp_path / "fleet"])
    assert drives(found) == [("V1", "a")]
    assert not found.left_out
