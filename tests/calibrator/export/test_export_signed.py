"""``calibrator export`` of signed files: the parameters that are signed, and a word that nobody checked who signed."""

from pathlib import Path

import pytest

from ecu_node.database import VehicleDatabase
from ecu_node.errors import ParameterError, UserError
from ecu_node.layout import file_digest
from ecu_node.parameters import write_parameters
from tests.calibrator.export.exports import parameters_for
from tests.calibrator.export.test_export_command import NAMES, export, refused
from tests.trust.signing import Signers, make_signers


@pytest.fixture(scope="module")
def signers(tmp_path_factory: pytest.TempPathFactory) -> Signers:
    return make_signers(tmp_path_factory.mktemp("keys"))


@pytest.fixture
def signed(signers: Signers, database: VehicleDatabase, tmp_path: Path) -> Path:
    """A signed file of a vehicle."""
    path = tmp_path / "signed.json"
    path.write_bytes(signers.parameters(parameters_for(database, battery=(0.05, 2.3)), 7))
    return path


@pytest.mark.parametrize("form", NAMES)
def test_signed_parameters_give_the_same_but_for_the_digest(
    form: str, signed: Path, database: VehicleDatabase, tmp_path: Path
) -> None:
    plain = tmp_path / "plain" / signed.name
    plain.parent.mkdir()
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), plain)
    texts = []
    for path in (signed, plain):
        out = path.with_name(f"v1.{form}")
        run = export(path, "--format", form, "--output", out)
        assert run.exit_code == 0, run.stderr
        files = sorted(out.iterdir()) if out.is_dir() else [out]
        texts.append("".join(item.read_text() for item in files).replace(file_digest(path), "DIGEST"))
        assert ("signatures, number and times were not checked" in run.stderr) is (path == signed)
    first, second = ([line for line in text.splitlines() if "HV_EXPORT" not in line] for text in texts)
    assert first == second
    assert any("DIGEST" in line for line in first)


def test_it_is_told_what_was_not_checked(signed: Path, tmp_path: Path) -> None:
    run = export(signed, "--format", "csv", "--output", tmp_path / "out.csv")
    assert run.stderr.splitlines() == [
        "notice: signed.json: signed, number 7, to hold from 2026-06-01T12:00:00Z to 2027-06-01T12:00:00Z; "
        "signatures, number and times were not checked, 'ecu-node verify' does"
    ]


def test_signed_parameters_are_checked_as_others_are(signed: Path, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"signed\.json: parameters are for vehicle 'v1', this is 'v7'"):
        raise refused(signed, "--format", "csv", "--output", tmp_path / "out", "--vehicle", "v7")


@pytest.mark.parametrize("cut", [1, 10, 300])
def test_a_damaged_signed_file_is_told_as_such(cut: int, signed: Path, tmp_path: Path) -> None:
    signed.write_bytes(signed.read_bytes()[:-cut])
    error = refused(signed, "--format", "csv", "--output", tmp_path / "out")
    assert str(error).startswith(f"{signed}: not a signed file: ")


def test_other_signed_statements_are_no_parameters(signers: Signers, tmp_path: Path) -> None:
    path = tmp_path / "other.json"
    for content in (signers.revocation(7, 5), signers.key_set(signers.keys())):
        path.write_bytes(content)
        error = refused(path, "--format", "csv", "--output", tmp_path / "out")
        assert isinstance(error, UserError)
        assert str(error).startswith(f"{path}: signed, but no parameters")


def test_parameters_and_the_same_signed_are_not_two_rows(
    signed: Path, database: VehicleDatabase, tmp_path: Path
) -> None:
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), tmp_path / "v1.json")
    for pair in ((signed, signed), (tmp_path / "v1.json", signed)):
        error = refused(*pair, "--format", "csv", "--output", tmp_path / "out")
        assert str(error).startswith(f"signed.json: says the same as {pair[0].name}, ")
    assert not (tmp_path / "out").exists()
