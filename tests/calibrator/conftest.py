import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"


@pytest.fixture(scope="session")
def two_vehicles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fleet of two vehicles with a log each."""
    from tests.calibrator.command_here import made_once  # noqa: PLC0415 (which has the layout from here)

    options = ("--vehicles", 2, "--currents", 2, "--minutes", 2.5, "--unseen-minutes", 0.1, "--seed", 5)
    return made_once(tmp_path_factory, "two_vehicles", "simulate", *options)


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """A folder whose path is short, as the names of sockets must be."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)
