"""``calibrator export``: one file, written whole or not at all, and what is refused with one line."""

from pathlib import Path

import pytest

from calibrator.errors import ContradictionError, ExportError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import ParameterError
from ecu_node.parameters import write_parameters
from tests.calibrator.export.exports import export, refused
from tests.ecu_node.vehicles import SMALL_LAYOUT, MakeDatabase, parameters_for


@pytest.fixture
def params(database: VehicleDatabase, tmp_path: Path) -> Path:
    """The parameter file of a vehicle."""
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), path)
    return path


@pytest.mark.parametrize("form", ["c", "dcm", "cdfx"])
def test_export_replaces_a_different_file_only_with_replace(form: str, params: Path, tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--format", "hex"), "--format hex needs --elf PROGRAM"),
        (("--format", "dcm", "--elf", "v1.json"), "--format dcm takes no --elf PROGRAM"),
    ],
)
def test_contradictory_export_options_are_refused(words: tuple[str, ...], message: str, params: Path) -> None:
    words = tuple(str(params) if word == "v1.json" else word for word in words)
    with pytest.raises(ContradictionError, match=message):
        raise refused(params, *words, "--output", params.with_name("out"))
    assert [*params.parent.iterdir()] == [params]


def test_parameters_that_do_not_fit_are_refused(params: Path, tmp_path: Path, make_database: MakeDatabase) -> None:
    more = ("--format", "c", "--output", tmp_path / "out")
    with pytest.raises(ParameterError, match=r"v1\.json: parameters are for vehicle 'v1', this is 'v7'"):
        raise refused(params, *more, "--vehicle", "v7")
    with pytest.raises(ParameterError, match=r"made with layout hv_powertrain\.toml .*, this is .*small"):
        raise refused(params, *more, layout=make_database().layout.path)
    assert not (tmp_path / "out").exists()


def test_e2e_profile_unknown_to_the_c_core_is_reported(make_database: MakeDatabase, tmp_path: Path) -> None:
    layout = SMALL_LAYOUT + '\n[e2e]\nprofile = "P05"\noffset = 4\nmessages = ["Pair"]\n'
    database = make_database(layout)
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), tmp_path / "v1.json")
    run = export(tmp_path / "v1.json", "--format", "c", "--output", tmp_path / "v1.c", layout=database.layout.path)
    assert run.stderr.startswith("notice: the C core knows the E2E profiles P01 and P02: check Pair before hv_forward")
