import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from calibrator.cli import run_calibrator

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """A folder whose path is short, as the names of sockets must be."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def run_command(arguments: list[str]) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["calibrator", *arguments])
        return run_calibrator()
