"""What 'make package' built, installed into clean environments: run with ``pytest tests/package``; slow, with pip."""

import shutil
import tarfile
from collections.abc import Callable
from importlib import reload
from pathlib import Path

import can.io.mf4
import pytest
from msgspec.structs import replace

from ecu_node import __version__
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import write_parameters
from tests.ecu_node.vehicles import LAYOUT, parameters_for
from tests.package.clean_venv import ROOT, CleanVenv, new_venv

DIST = ROOT / "dist"
VEHICLE = "V001"
Installed = Callable[..., CleanVenv]

reload(can.io.mf4)  # with its writer: tests/conftest.py imports python-can without asammdf, which takes long


@pytest.fixture(scope="session")
def wheel() -> Path:
    """The wheel of this version."""
    names = [path.name for path in DIST.glob("*.whl")]
    assert names == [f"hv_current_correction-{__version__}-py3-none-any.whl"], "run 'make package'"
    return DIST / names[0]


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """Function from extras to a clean environment with the wheel and them, made once."""
    folder = tmp_path_factory.mktemp("environments")
    made: dict[tuple[str, ...], CleanVenv] = {}

    def environment(*extras: str) -> CleanVenv:
        if extras not in made:
            made[extras] = new_venv(folder / "-".join(("node", *extras)), wheel, *extras)
        return made[extras]

    return environment


@pytest.fixture(scope="session")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source distribution, unpacked."""
    folder = tmp_path_factory.mktemp("source")
    with tarfile.open(DIST / f"hv_current_correction-{__version__}.tar.gz") as archive:
        archive.extractall(folder, filter="data")
    return folder / f"hv_current_correction-{__version__}"


@pytest.fixture(scope="session")
def car(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a layout, its DBC, and parameters that correct the battery current."""
    folder = tmp_path_factory.mktemp("car")
    shutil.copy(LAYOUT.with_suffix(".dbc"), folder)
    shutil.copy(LAYOUT, folder / "my_car.toml")
    database = read_database(read_layout(folder / "my_car.toml"))
    parameters = replace(parameters_for(database, battery=(0.05, 2.0)), vehicle=VEHICLE)
    write_parameters(parameters, folder / "V001.json")
    return folder


@pytest.fixture(scope="session")
def fleet(installed: Installed, car: Path) -> Path:
    """Logs of six vehicles, by the built-in drives."""
    options = ("--layout", "my_car.toml", "--vehicles", 6, "--currents", 2, "--minutes", 2, "--out", "fleet")
    done = installed("demo").run("calibrator", "simulate", *options, folder=car)
    assert done.returncode == 0, done.stderr
    return car / "fleet"


@pytest.fixture(scope="session")
def drive(fleet: Path) -> Path:
    """The log of one vehicle of the fleet."""
    return fleet / "logs" / VEHICLE / "drive.log.gz"
