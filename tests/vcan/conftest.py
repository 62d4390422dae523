"""A real SocketCAN kernel with can-utils as the other party: run with ``tools/with_vcan``; nothing here ever skips."""

import shutil
import socket
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

import pytest

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from tests.vcan.processes import CHANNEL, NodeProcess, Recording, running_node, running_recording

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"


class StartNode(Protocol):
    """Starts ``ecu-node run`` with a parameter file and further options."""

    def __call__(self, params: Path, *options: str) -> AbstractContextManager[NodeProcess]: ...


@pytest.fixture(scope="session", autouse=True)
def socketcan() -> None:
    """Fail at once where the tests of this folder cannot run."""
    missing = [name for name in ("candump", "canplayer", "cansend") if shutil.which(name) is None]
    if missing:
        pytest.exit(f"{', '.join(missing)} not found: apt-get install can-utils", returncode=1)
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
            bus.bind((CHANNEL,))
    except OSError as error:
        pytest.exit(f"no SocketCAN with {CHANNEL} here ({error}); run tools/with_vcan", returncode=1)


@pytest.fixture(scope="session")
def database() -> VehicleDatabase:
    """The project's own layout and DBC."""
    return read_database(read_layout(LAYOUT))


@pytest.fixture
def start_node(tmp_path: Path) -> StartNode:
    """The node as a process of its own on vcan0."""

    def start(params: Path, *options: str) -> AbstractContextManager[NodeProcess]:
        return running_node(tmp_path / "node.err", "--params", str(params), "--layout", str(LAYOUT), *options)

    return start


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Recording]:
    """candump, recording vcan0 from before the test's first frame."""
    with running_recording(tmp_path / "recorded.log") as running:
        yield running
