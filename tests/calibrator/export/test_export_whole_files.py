"""``calibrator export`` on a full disk, onto links, and run again: nothing half-written, nothing left behind."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from calibrator.errors import FleetError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import write_parameters
from tests.calibrator.export.exports import parameters_for
from tests.calibrator.export.test_export_command import NAMES, export, refused
from tests.trust.signing_steps import full_disk


@pytest.fixture
def params(database: VehicleDatabase, tmp_path: Path) -> Path:
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), path)
    return path


def place(form: str, folder: Path) -> Path:
    """What --output is to name, so that the files are in that folder."""
    return folder if form == "c99" else folder / f"v1.{form}"


@pytest.mark.parametrize("form", NAMES)
@pytest.mark.parametrize("free_bytes", [0, 200])
def test_a_full_disk_names_the_file_and_leaves_nothing(
    form: str, free_bytes: int, params: Path, tmp_path: Path
) -> None:
    with full_disk(free_bytes):
        error = refused(params, "--format", form, "--output", place(form, tmp_path / "new" / "folder"))
    names = [str(tmp_path / "new" / "folder" / name) for name in NAMES[form]]
    assert str(error) in [f"{name}: cannot be written: File too large" for name in names]
    assert list(tmp_path.iterdir()) == [params]


def test_on_a_full_disk_the_files_of_the_export_before_stay_together(
    params: Path, database: VehicleDatabase, tmp_path: Path
) -> None:
    """The header, which is written first and has room, would not compile with the source of before."""
    out, all_branches = tmp_path / "out", dict.fromkeys(database.layout.branch_names, (0.05, 2.3))
    write_parameters(parameters_for(database, **all_branches), params)
    assert export(params, "--format", "c99", "--output", out).exit_code == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    sizes = [len(before[name]) for name in ("hv_correction.h", "hv_correction.c")]
    assert sizes[0] < sizes[1]
    write_parameters(parameters_for(database, **all_branches | {"battery": (0.06, 2.3)}), params)
    with full_disk(sum(sizes) // 2):
        error = refused(params, "--format", "c99", "--output", out, "--replace")
    assert str(error) == f"{out}/hv_correction.c: cannot be written: File too large"
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize("form", NAMES)
def test_the_same_export_again_is_no_error(form: str, params: Path, tmp_path: Path) -> None:
    arguments = (params, "--format", form, "--output", place(form, tmp_path / "out"))
    first = export(*arguments)
    (tmp_path / "out" / NAMES[form][0]).rename(tmp_path / "out" / f".{NAMES[form][0]}.partial-{(1 << 22) + 1}")
    again = export(*arguments)
    assert (again.exit_code, again.stdout) == (0, first.stdout)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == NAMES[form]


@pytest.mark.parametrize("form", NAMES)
@pytest.mark.parametrize("more", [[], ["--replace"]])
@pytest.mark.parametrize("exists", [False, True])
def test_a_link_is_not_replaced(form: str, more: list[str], exists: bool, params: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / NAMES[form][0]).symlink_to(tmp_path / "target")
    if exists:
        (tmp_path / "target").write_bytes(b"mine")
    with pytest.raises(FleetError, match=f"{NAMES[form][0]}: is a link, so it cannot be replaced"):
        raise refused(params, "--format", form, "--output", place(form, out), *more)
    assert [path.name for path in out.iterdir() if path.is_symlink()] == [NAMES[form][0]]
    assert (tmp_path / "target").exists() is exists


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo])
def test_what_is_no_file_is_not_replaced(make: Callable[[Path], object], params: Path, tmp_path: Path) -> None:
    make(tmp_path / "out.csv")
    error = refused(params, "--format", "csv", "--output", tmp_path / "out.csv", "--replace")
    assert isinstance(error, UserError)
    assert str(error).startswith(f"{tmp_path}/out.csv: is ")
    assert not (tmp_path / "out.csv").is_file()
