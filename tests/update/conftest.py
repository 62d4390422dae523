"""A repository, and a vehicle that trusts it."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from ecu_node.update.signers import PASSPHRASE_VARIABLE
from tests.ecu_node.vehicles import parameters_for
from tests.update.repo import Repo, drifting, pass_trial


@pytest.fixture(scope="session", autouse=True)
def _without_passphrase() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(PASSPHRASE_VARIABLE, raising=False)
        yield


@pytest.fixture(scope="session")
def parameters(database: VehicleDatabase) -> VehicleParameters:
    return parameters_for(database, battery=(0.05, 2.0), motor=(0.0, -1.0))


@pytest.fixture(scope="session")
def other(parameters: VehicleParameters) -> VehicleParameters:
    """Newer parameters of the same vehicle, a small step from the first."""
    return replace(drifting(parameters, 0.06), number=301)


@pytest.fixture(scope="session")
def offered(tmp_path_factory: pytest.TempPathFactory, parameters: VehicleParameters) -> Repo:
    """A repository that offers parameters for v1 and v2; not to be changed, see :func:`repo`."""
    made = Repo(tmp_path_factory.mktemp("offered"))
    made.create()
    made.add(parameters)
    made.offer(parameters, vehicle="v2")
    made.provision(made.folder / "new")
    made.provision(made.folder / "in force")
    made.updated(made.folder / "in force")
    pass_trial(made.folder / "in force")
    return made


@pytest.fixture
def repo(offered: Repo, tmp_path: Path) -> Repo:
    return offered.copy(tmp_path)


@pytest.fixture
def new(offered: Repo, tmp_path: Path) -> Path:
    """State of a vehicle that holds nothing yet."""
    return Path(shutil.copytree(offered.folder / "new", tmp_path / "v1"))


@pytest.fixture
def state(offered: Repo, tmp_path: Path) -> Path:
    """State of a vehicle with set 300 in force."""
    return Path(shutil.copytree(offered.folder / "in force", tmp_path / "v1 in force"))
