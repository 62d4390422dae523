"""Recordings of real cars: trips of a BMW i3, imported once, its charges at two stations, and a drive of a Tesla."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.calibrator.command_here import once

ROOT = Path(__file__).parents[2]
LAYOUT = ROOT / "dbc" / "hv_powertrain.toml"
I3_DBC = """VERSION ""
NS_ :
BS_:
BU_: Car
BO_ 274 Battery: 8 Car
 SG_ BatteryCurrent : 0|16@1+ (0.1,-819.2) [-819.2|819.2] "A" Car
BO_ 690 Charger: 8 Car
 SG_ ChargerCurrent : 16|16@1+ (0.1,0) [0|6553.4] "A" Car
"""
I3_LAYOUT = """schema = 1
name = "i3_charging"
dbc = "i3.dbc"
full_scale_a = 200.0
branch = [
    { name = "battery", signal = "Battery.BatteryCurrent", sign = -1, timeout_s = 0.1 },
    { name = "charger", signal = "Charger.ChargerCurrent", sign = 1, timeout_s = 0.3, no_value = [65535] },
]
"""


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


@pytest.fixture(scope="session")
def i3_charges(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``layout.toml``, and in ``car`` the logs of each station in a folder of its own."""
    folder = tmp_path_factory.mktemp("i3")
    for path in (shared_data / "bmw_i3_charging").glob("*.csv.gz"):
        station = folder / "car" / ("circontrol" if "Circontrol" in path.name else "efacec")
        station.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, station)
    (folder / "i3.dbc").write_text(I3_DBC)
    (folder / "layout.toml").write_text(I3_LAYOUT)
    return folder


@pytest.fixture(scope="session")
def tesla(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``Model3CAN.dbc``, ``drive.log.gz`` and the layout of this repository, ``tesla_model3.toml``."""
    folder = tmp_path_factory.mktemp("tesla")
    for name in ("Model3CAN.dbc", "drive.log.gz"):
        (folder / name).symlink_to(shared_data / "tesla_model3" / name)
    shutil.copy(ROOT / "dbc" / "tesla_model3.toml", folder)
    return folder
