"""``calibrator export``: files written whole or not at all, and what is refused with one line."""

import csv
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace
from typer.testing import CliRunner, Result

from calibrator.cli import app
from calibrator.errors import ContradictionError, ExportError, FleetError
from calibrator.export.checked import read_checked
from ecu_node.database import VehicleDatabase
from ecu_node.errors import ParameterError, UserError
from ecu_node.layout import file_digest
from ecu_node.parameters import encode_parameters, write_parameters
from tests.calibrator.export.exports import MakeDatabase, parameters_for
from tests.ecu_node.vehicles import LAYOUT

NAMES = {"dcm": ["v1.dcm"], "cdfx": ["v1.cdfx"], "csv": ["v1.csv"], "c99": ["hv_correction.c", "hv_correction.h"]}


@pytest.fixture
def params(database: VehicleDatabase, tmp_path: Path) -> Path:
    """The parameter file of a vehicle."""
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), path)
    return path


def export(*arguments: object, layout: Path = LAYOUT) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, arguments), "--layout", str(layout)])


def refused(*arguments: object, layout: Path = LAYOUT) -> UserError:
    error = export(*arguments, layout=layout).exception
    assert isinstance(error, UserError)
    assert "\n" not in str(error)
    return error


@pytest.mark.parametrize("form", NAMES)
def test_every_format_is_written_where_asked(form: str, params: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / ("folder" if form == "c99" else f"v1.{form}")
    run = export(params, "--format", form, "--output", out)
    folder = out if form == "c99" else out.parent
    assert (run.exit_code, run.stderr) == (0, "")
    assert sorted(path.name for path in folder.iterdir()) == NAMES[form]
    assert sorted(run.stdout.splitlines()) == sorted(str(folder / name) for name in NAMES[form])


@pytest.mark.parametrize("form", NAMES)
def test_files_that_exist_are_replaced_only_if_asked(form: str, params: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    there, other = folder / NAMES[form][-1], folder / "other.h"
    there.write_text("mine")
    other.write_text("mine")
    arguments = (params, "--format", form, "--output", folder if form == "c99" else there)
    with pytest.raises(ExportError, match="exists; choose another --output, or replace it with --replace"):
        raise refused(*arguments)
    assert [path.read_text() for path in sorted(folder.iterdir())] == ["mine", "mine"]
    assert export(*arguments, "--replace").exit_code == 0
    assert there.read_text() != "mine"
    assert other.read_text() == "mine"


def test_a_folder_is_no_file_and_a_file_is_no_folder(params: Path, tmp_path: Path) -> None:
    with pytest.raises(FleetError, match="is a folder; name a file in it"):
        raise refused(params, "--format", "dcm", "--output", tmp_path)
    with pytest.raises(FleetError, match=r"v1\.json is a file"):
        raise refused(params, "--format", "c99", "--output", params)


def test_several_vehicles_are_one_table(database: VehicleDatabase, params: Path, tmp_path: Path) -> None:
    write_parameters(replace(parameters_for(database, motor=(0.1, 0.0)), vehicle="v2"), tmp_path / "v2.json")
    assert export(params, tmp_path / "v2.json", "--format", "csv", "--output", tmp_path / "all.csv").exit_code == 0
    with (tmp_path / "all.csv").open(newline="") as file:
        assert [(row["vehicle"], row["branch"]) for row in csv.DictReader(file)] == [("v1", "battery"), ("v2", "motor")]


@pytest.mark.parametrize("form", ["dcm", "cdfx", "c99"])
def test_several_vehicles_are_refused_where_one_belongs(form: str, params: Path, tmp_path: Path) -> None:
    with pytest.raises(ContradictionError, match=f"2 parameter files: {form} holds one vehicle; .* --format csv"):
        raise refused(params, params, "--format", form, "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("form", NAMES)
def test_parameters_of_another_vehicle_are_refused(form: str, params: Path, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"v1\.json: parameters are for vehicle 'v1', this is 'v7'"):
        raise refused(params, "--format", form, "--output", tmp_path / "out", "--vehicle", "v7")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("form", NAMES)
def test_parameters_of_another_layout_are_refused(
    form: str, params: Path, tmp_path: Path, make_database: MakeDatabase
) -> None:
    layout = make_database().layout.path
    with pytest.raises(
        ParameterError, match=r"parameters were made with layout hv_powertrain\.toml .*, this is .*small"
    ):
        raise refused(params, "--format", form, "--output", tmp_path / "out", layout=layout)


def test_no_parameter_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"none\.json: no such parameter file"):
        raise refused(tmp_path / "none.json", "--format", "dcm", "--output", tmp_path / "out")


def test_a_key_that_stands_twice_is_told(params: Path, tmp_path: Path) -> None:
    params.write_text(params.read_text().replace('"offset_a":', '"offset_a": 1.0, "offset_a":', 1))
    with pytest.raises(ParameterError, match=r"offset_a.* twice"):
        raise refused(params, "--format", "dcm", "--output", tmp_path / "out")


def test_the_digest_is_of_what_was_read(
    params: Path, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
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
