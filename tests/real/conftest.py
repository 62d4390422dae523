"""The recorded trips of a BMW i3, imported once for all tests."""

import json
from pathlib import Path

import pytest

from tests.calibrator.command_here import once
from tests.real.delay_trips import import_trips


@pytest.fixture(scope="session")
def i3_store(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drive store of all trips; the account of the import lies beside it."""

    def make(folder: Path) -> None:
        folder.mkdir()
        (folder / "account.json").write_text(import_trips(shared_data, folder / "store"))

    return once(tmp_path_factory, "i3", make) / "store"


@pytest.fixture(scope="session")
def i3_notices(i3_store: Path) -> dict[str, list[str]]:
    """What the import said of each trip."""
    account = json.loads((i3_store.parent / "account.json").read_text())
    assert account["failed"] == {}
    return {name: drive["notices"] for name, drive in account["drives"].items()}
