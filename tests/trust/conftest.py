"""Signers, a vehicle, and its state."""

from pathlib import Path

import pytest

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import VehicleParameters
from ecu_node.trust.activation import provision
from tests.ecu_node.vehicles import LAYOUT, parameters_for
from tests.trust.signing import NOW, VEHICLE, Signers, make_signers


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
