"""A real SocketCAN kernel with can-utils as the other party: run with ``tools/with_vcan``; nothing here ever skips."""

import os
import shutil
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

from ecu_node.core.status import Reason, State
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import write_parameters
from tests.vcan.patient_layout import write_patient_layout
from tests.vcan.processes import CHANNEL, OTHER_CHANNEL, NodeProcess, Recording, running_node, running_recording
from tests.vcan.small_drive import true_parameters, write_drive

STATUS, BATTERY, AUXILIARY, BATTERY_CORRECTED, MARKER = 0x5F0, 0x110, 0x130, 0x510, 0x7F0


def state_of(frame: bytes) -> tuple[State, Reason]:
    """State and reason in a status frame."""
    return State(frame[1] >> 4), Reason(frame[2])


StartNode = Callable[..., AbstractContextManager[NodeProcess]]
"""Starts ``ecu-node run`` with some options, with other `params` and `by` another program if they are given."""


@pytest.fixture(scope="session", autouse=True)
def socketcan() -> None:
    """Fail at once where the tests of this folder cannot run."""
    missing = [name for name in ("candump", "cangen", "cangw", "canplayer", "cansend") if shutil.which(name) is None]
    if missing:
        pytest.exit(f"{', '.join(missing)} not found: apt-get install can-utils", returncode=1)
    if os.geteuid() != 0:
        pytest.exit("not root, which taking interfaces down needs; run tools/with_vcan", returncode=1)
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
            bus.bind((CHANNEL,))
    except OSError as error:
        pytest.exit(f"no SocketCAN with {CHANNEL} here ({error}); run tools/with_vcan", returncode=1)


@pytest.fixture(scope="session", autouse=True)
def long_queues(socketcan: None) -> Iterator[None]:
    """Let sockets hold the frames of many seconds: a slow kernel on a busy machine may pause any process that long."""
    setting = Path("/proc/sys/net/core/rmem_default")
    before = setting.read_text()
    setting.write_text("8000000")
    yield
    setting.write_text(before)


@pytest.fixture(scope="session")
def database(tmp_path_factory: pytest.TempPathFactory) -> VehicleDatabase:
    """Layout and DBC of the vehicle of these tests."""
    return read_database(read_layout(write_patient_layout(tmp_path_factory.mktemp("vehicle"))))


@pytest.fixture
def params(database: VehicleDatabase, tmp_path: Path) -> Path:
    """A parameter file with the true faults of the small drive."""
    path = tmp_path / "params.json"
    write_parameters(true_parameters(database), path)
    return path


@pytest.fixture
def drive(database: VehicleDatabase, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Log of the small drive, with as many instants as the module of the test says."""
    write_drive(tmp_path / "drive.log", database, request.module.INSTANTS)
    return tmp_path / "drive.log"


@pytest.fixture
def start_node(database: VehicleDatabase, params: Path, tmp_path: Path) -> StartNode:
    """The node as a process of its own on vcan0; what it says is in node.err, of a second one in node2.err."""
    logs, default, layout = (tmp_path / name for name in ("node.err", "node2.err")), params, str(database.layout.path)

    def start(*options: str, params: Path | None = None, by: Sequence[str] = ()) -> AbstractContextManager[NodeProcess]:
        files = ("--unsigned", "--params", str(params or default), "--layout", layout)
        return running_node(next(logs), *files, *options, by=by)

    return start


@pytest.fixture
def start_gateway(start_node: StartNode, there: Recording) -> StartNode:
    """The node as a gateway between vcan0 and vcan1, from when its status has come there."""

    @contextmanager
    def start(*options: str, by: Sequence[str] = ()) -> Iterator[NodeProcess]:
        with start_node("--gateway", OTHER_CHANNEL, *options, by=by) as node:
            there.wait_for(STATUS, len(there.data_of(STATUS)) + 1)
            yield node

    return start


@pytest.fixture
def here(tmp_path: Path) -> Iterator[Recording]:
    """candump, recording vcan0 from before the test's first frame."""
    with running_recording(tmp_path / "here.log") as running:
        yield running


@pytest.fixture
def there(tmp_path: Path) -> Iterator[Recording]:
    """candump, recording vcan1 from before the test's first frame."""
    with running_recording(tmp_path / "there.log", OTHER_CHANNEL) as running:
        yield running
