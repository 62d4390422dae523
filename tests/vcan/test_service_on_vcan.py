"""The node as its service runs it, without any privilege, and the monitor beside it on a real SocketCAN bus."""

import json
import os
import subprocess
from pathlib import Path

import pytest

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import write_parameters
from tests.vcan.conftest import StartNode
from tests.vcan.patient_layout import write_patient_layout
from tests.vcan.processes import CHANNEL, ECU_NODE, LONGEST_WAIT_S, Recording, play, playing, running_node, wait_until
from tests.vcan.small_drive import BRANCHES, true_parameters, write_drive

UNPRIVILEGED = ["setpriv", "--bounding-set=-all", "--inh-caps=-all", "--ambient-caps=-all", "--no-new-privs"]
INSTANTS, CORRECTED_BATTERY, STATUS = 20, 0x510, 0x5F0


def filters() -> int:
    """Identifiers that sockets wait for on vcan0."""
    files = Path("/proc/net/can").glob("rcvlist_*")
    return sum(line.split()[0] == CHANNEL for file in files for line in file.read_text().splitlines() if line.split())


@pytest.fixture
def patient(tmp_path: Path) -> VehicleDatabase:
    """The layout with timeouts that a slow machine keeps."""
    return read_database(read_layout(write_patient_layout(tmp_path, timeout_s=30.0)))


def test_monitor_shows_branches_sums_and_node_status(patient: VehicleDatabase, tmp_path: Path) -> None:
    write_drive(tmp_path / "drive.log", patient, 500, standing_at_s=1.0)
    write_parameters(true_parameters(patient), tmp_path / "params.json")
    files = ["--layout", str(patient.layout.path), "--channel", CHANNEL]
    command = [*ECU_NODE, "monitor", *files, "--once", "4", "--json"]
    with running_node(tmp_path / "node.err", "--unsigned", "--params", str(tmp_path / "params.json"), *files) as node:
        before = filters()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as monitor:
            wait_until(lambda: filters() > before, "the monitor to listen")
            with playing(tmp_path / "drive.log"):
                out, _ = monitor.communicate(timeout=LONGEST_WAIT_S)
        assert node.stop() == 0
    view = json.loads(out)
    branches = {branch["name"]: branch for branch in view["branches"]}
    assert monitor.returncode == 0
    assert [name for name, branch in branches.items() if branch["is_seen"]] == list(BRANCHES)
    assert {branches[name]["quality"] for name in BRANCHES} == {"CORRECTED"}
    assert branches["motor"]["faults"]["corrupt"] > 0
    assert (view["node"]["state"], view["node"]["parameter_set"]) == ("CORRECTING", 7)
    assert abs(view["sums"]["corrected_a"]) < 1.0 < abs(view["sums"]["measured_a"])


def test_node_needs_no_capability(start_node: StartNode, drive: Path, here: Recording) -> None:
    """As in deploy/ecu-node@.service: an empty bounding set, no ambient capabilities, no new privileges."""
    with start_node(by=UNPRIVILEGED) as node:
        capabilities = Path(f"/proc/{node.process.pid}/status").read_text().partition("CapPrm:")[2].split()
        assert int(capabilities[0], 16) == 0
        play(drive)
        assert len(here.wait_for(CORRECTED_BATTERY, INSTANTS)) == INSTANTS
        assert here.wait_for(STATUS, 1)
        assert node.stop() == 0


def test_real_time_is_fifo_on_one_processor_with_locked_memory(start_node: StartNode) -> None:
    with start_node("--realtime") as node:
        number = node.process.pid
        status = Path(f"/proc/{number}/status").read_text()
        locked_kb = int(status.partition("VmLck:")[2].split()[0])
        scheduler, processors = os.sched_getscheduler(number), os.sched_getaffinity(number)
        assert node.stop() == 0
    assert "real time: SCHED_FIFO, memory lock, one processor" in node.messages
    assert (scheduler, len(processors)) == (os.SCHED_FIFO, 1)
    assert locked_kb > 1000
