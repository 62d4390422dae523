"""``calibrator export``: one file, written whole or not at all, and what is refused with one line."""

import csv
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from calibrator.errors import ContradictionError, ExportError, FleetError
from calibrator.export.core import read_checked
from ecu_node.database import VehicleDatabase
from ecu_node.errors import ParameterError, UserError
from ecu_node.layout import file_digest
from ecu_node.parameters import encode_parameters, write_parameters
from tests.calibrator.export.exports import MakeDatabase, export, parameters_for, refused
from tests.disk import full_disk
from tests.ecu_node.vehicles import LAYOUT, SMALL_LAYOUT

FORMATS = ("c", "dcm", "cdfx", "csv")
"""Those that need no compiled program; the others write in the same way."""


@pytest.fixture
def params(database: VehicleDatabase, tmp_path: Path) -> Path:
    """The parameter file of a vehicle."""
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), path)
    return path


@pytest.mark.parametrize("form", FORMATS)
def test_file_is_written_where_asked_and_replaced_only_if_asked(form: str, params: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / f"v1.{form}"
    arguments = (params, "--format", form, "--output", out)
    for _ in range(2):  # the same again is no error
        run = export(*arguments)
        assert (run.exit_code, run.stderr, run.stdout) == (0, "", f"{out}\n")
    content = out.read_bytes()
    out.write_text("mine")
    with pytest.raises(ExportError, match="exists; choose another --output, or replace it with --replace"):
        raise refused(*arguments)
    assert out.read_text() == "mine"
    assert export(*arguments, "--replace").exit_code == 0
    assert (out.read_bytes(), len(list(out.parent.iterdir()))) == (content, 1)


def test_several_vehicles_are_one_table(database: VehicleDatabase, params: Path, tmp_path: Path) -> None:
    write_parameters(replace(parameters_for(database, motor=(0.1, 0.0)), vehicle="v2"), tmp_path / "v2.json")
    assert export(params, tmp_path / "v2.json", "--format", "csv", "--output", tmp_path / "all.csv").exit_code == 0
    with (tmp_path / "all.csv").open(newline="") as file:
        assert [(row["vehicle"], row["branch"]) for row in csv.DictReader(file)] == [("v1", "battery"), ("v2", "motor")]


def test_contradictions_of_the_command_line_are_refused(params: Path, tmp_path: Path) -> None:
    out = ("--output", tmp_path / "out")
    cases = [
        ((params, params, "--format", "dcm"), "2 parameter files: dcm holds one vehicle; .* --format csv"),
        ((params, params, "--format", "csv"), r"v1\.json: says the same as v1\.json, .* give each parameter set once"),
        ((params, "--format", "hex"), "--format hex needs --elf PROGRAM"),
        ((params, "--format", "csv", "--elf", params), "--format csv takes no --elf PROGRAM"),
    ]
    for words, message in cases:
        with pytest.raises(ContradictionError, match=message):
            raise refused(*words, *out)
    assert list(tmp_path.iterdir()) == [params]


def test_parameters_that_do_not_fit_are_refused(params: Path, tmp_path: Path, make_database: MakeDatabase) -> None:
    more = ("--format", "c", "--output", tmp_path / "out")
    with pytest.raises(ParameterError, match=r"v1\.json: parameters are for vehicle 'v1', this is 'v7'"):
        raise refused(params, *more, "--vehicle", "v7")
    with pytest.raises(ParameterError, match=r"made with layout hv_powertrain\.toml .*, this is .*small"):
        raise refused(params, *more, layout=make_database().layout.path)
    with pytest.raises(ParameterError, match=r"none\.json: no such parameter file"):
        raise refused(tmp_path / "none.json", *more)
    params.write_text(params.read_text().replace('"offset_a":', '"offset_a": 1.0, "offset_a":', 1))
    with pytest.raises(ParameterError, match=r"offset_a.* twice"):
        raise refused(params, *more)
    assert not (tmp_path / "out").exists()


def test_protection_that_the_core_does_not_know_is_told(make_database: MakeDatabase, tmp_path: Path) -> None:
    layout = SMALL_LAYOUT + '\n[e2e]\nprofile = "P05"\noffset = 4\nmessages = ["Pair"]\n'
    database = make_database(layout)
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), tmp_path / "v1.json")
    run = export(tmp_path / "v1.json", "--format", "c", "--output", tmp_path / "v1.c", layout=database.layout.path)
    assert run.stderr.startswith("notice: the C core knows the E2E profiles P01 and P02: check Pair before hv_forward")


def test_digest_is_of_what_was_read(params: Path, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not of a file that takes its place meanwhile."""
    digest, decode = file_digest(params), msgspec.json.decode
    other = encode_parameters(parameters_for(database, battery=(0.3, 0.0)), "other")

    def replaced_meanwhile(*arguments: Any, **more: Any) -> Any:
        params.write_bytes(other)
        return decode(*arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(msgspec.json, "decode", replaced_meanwhile)
        checked = read_checked(params, database, None)
    assert (checked.parameters.branches["battery"].drift, checked.digest) == (0.05, digest)


def test_names_that_are_no_text_are_written_escaped(database: VehicleDatabase, tmp_path: Path) -> None:
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), tmp_path / "v\udcff.json")
    command = [sys.executable, "-m", "calibrator", "export", f"{tmp_path}/v\udcff.json", "--layout", str(LAYOUT)]
    done = subprocess.run(
        [*command, "--format", "csv", "--out", f"{tmp_path}/o\udcff.csv"],
        env={**os.environ, "PYTHONIOENCODING": "utf-8:strict"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{tmp_path}/o\\udcff.csv\n", "")


def test_full_disk_names_the_file_and_leaves_nothing(params: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "folder" / "v1.c"
    with full_disk(200):
        error = refused(params, "--format", "c", "--output", out)
    assert str(error) == f"{out}: cannot be written: File too large"
    assert list(tmp_path.iterdir()) == [params]


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo, lambda path: path.symlink_to("target")])
def test_what_is_no_file_is_not_replaced(make: Callable[[Path], object], params: Path, tmp_path: Path) -> None:
    make(tmp_path / "out.csv")
    before = (tmp_path / "out.csv").lstat().st_ino
    error = refused(params, "--format", "csv", "--output", tmp_path / "out.csv", "--replace")
    assert isinstance(error, FleetError | UserError)
    assert str(error).startswith(f"{tmp_path}/out.csv: is ")
    assert (tmp_path / "out.csv").lstat().st_ino == before
