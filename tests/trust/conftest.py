"""Signers, a vehicle, and its state."""

import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from calibrator.cli import main as calibrator_main
from calibrator.signing.key_files import PASSPHRASE_VARIABLE
from ecu_node.cli import main
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import VehicleParameters, write_parameters
from ecu_node.trust.activation import accept, conclude
from ecu_node.trust.provision import provision
from tests.ecu_node.vehicles import LAYOUT, parameters_for
from tests.trust.signing import NOW, VEHICLE, Run, Signers, make_signers


@pytest.fixture(scope="session")
def database() -> VehicleDatabase:
    """The project's own layout and DBC."""
    return read_database(read_layout(LAYOUT))


@pytest.fixture(scope="session")
def signers(tmp_path_factory: pytest.TempPathFactory) -> Signers:
    return make_signers(tmp_path_factory.mktemp("keys"))


@pytest.fixture(scope="session")
def parameters(database: VehicleDatabase) -> VehicleParameters:
    return parameters_for(database, battery=(0.05, 2.0), motor=(0.0, -1.0))


@pytest.fixture
def state(tmp_path: Path, signers: Signers) -> Path:
    """State of a new vehicle."""
    folder = tmp_path / "state"
    provision(folder, VEHICLE, signers.keys(), NOW)
    return folder


@pytest.fixture
def two_slots(tmp_path: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase) -> Path:
    """State of a vehicle with numbers 5 and 6, the latter in force in slot b."""
    folder, now = tmp_path / "state", datetime.now(UTC)
    provision(folder, VEHICLE, signers.keys(), now)
    for number in (5, 6):
        accept(folder, signers.parameters(parameters, number, not_before=now - timedelta(days=1)), "f", database, now)
        conclude(folder, number, passed=True, text="seen", now=now)
    return folder


@pytest.fixture
def now() -> datetime:
    return datetime.now(UTC)


@pytest.fixture
def in_force(tmp_path: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase) -> Path:
    """State of a vehicle with number 5 in force."""
    folder, now = tmp_path / "state", datetime.now(UTC)
    provision(folder, VEHICLE, signers.keys(), now)
    accept(folder, signers.parameters(parameters, 5, not_before=now - timedelta(days=1)), "f", database, now)
    conclude(folder, 5, passed=True, text="seen", now=now)
    return folder


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """The command line in this process: exit code, output, errors."""

    def run(*arguments: object) -> tuple[int, str, str]:
        code = main([str(argument) for argument in arguments])
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def calibrator(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """The command line in this process: exit code, output, errors; without a passphrase in the environment."""
    monkeypatch.delenv(PASSPHRASE_VARIABLE, raising=False)

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["calibrator", *map(str, arguments)])
        code = calibrator_main()
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def keys(calibrator: Run, tmp_path: Path) -> Path:
    """Folder with keys of a, b and c, not encrypted, and the set of them."""
    folder = tmp_path / "keys"
    for name in "abc":
        assert calibrator("keys", "new", name, "--no-passphrase", "--out", folder)[0] == 0
    public = [folder / f"{name}.pub" for name in "abc"]
    assert calibrator("keys", "set", *public, "--threshold", 2, "--out", folder / "set.json")[0] == 0
    return folder


@pytest.fixture
def params(parameters: VehicleParameters, tmp_path: Path) -> Path:
    path = tmp_path / "v1.json"
    write_parameters(parameters, path)
    return path
