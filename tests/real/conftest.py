"""The recorded trips of a BMW i3, imported once for all tests."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.calibrator.command_here import once

ROOT = Path(__file__).parents[2]
LAYOUT = ROOT / "dbc" / "hv_powertrain.toml"


@pytest.fixture(scope="session")
def i3_store(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drive store of all trips; the account of the import lies beside it."""

    def make(folder: Path) -> None:
        folder.mkdir()
        command: list[str | Path] = [sys.executable, ROOT / "tools" / "import_bmw_i3.py", shared_data / "bmw_i3_summer"]
        command += ["--layout", LAYOUT, "--out", folder / "store", "--json"]
        (folder / "account.json").write_bytes(subprocess.run(command, capture_output=True, check=True).stdout)

    return once(tmp_path_factory, "i3", make) / "store"


@pytest.fixture(scope="session")
def i3_notices(i3_store: Path) -> dict[str, list[str]]:
    """What the import said of each trip."""
    account = json.loads((i3_store.parent / "account.json").read_text())
    assert account["failed"] == {}
    return {name: drive["notices"] for name, drive in account["drives"].items()}
