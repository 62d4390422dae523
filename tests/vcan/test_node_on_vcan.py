"""The node as a process on a real SocketCAN bus, with can-utils playing and recording."""

import json
import os
import signal
import subprocess
from collections.abc import Iterable
from pathlib import Path

import pytest

from ecu_node.bus.wiring import InForce, Mode
from ecu_node.core.status import Reason, State
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import write_parameters
from tests.vcan.conftest import BATTERY_CORRECTED, MARKER, STATUS, StartNode, state_of
from tests.vcan.patient_layout import write_patient_layout
from tests.vcan.processes import (
    CHANNEL,
    ECU_NODE,
    LONGEST_WAIT_S,
    OTHER_CHANNEL,
    LoggedFrame,
    Recording,
    data_of,
    frames_of,
    generate,
    play,
    playing,
    running_node,
    wait_until,
)
from tests.vcan.small_drive import BRANCHES, VEHICLE, sent_by_core, true_parameters, write_drive

INSTANTS = 150
CORRECTED = (0x510, 0x520, 0x530)
OWN = {f"{identifier:03X}" for identifier in (*CORRECTED, STATUS, MARKER)}


def test_drive_is_corrected_and_other_frames_are_unchanged(
    database: VehicleDatabase, tmp_path: Path, start_node: StartNode, here: Recording
) -> None:
    drive = write_drive(tmp_path / "drive.log", database, 250)
    expected = sent_by_core(database, Mode.OVERLAY, drive)
    with start_node("--vehicle", VEHICLE) as node:
        play(tmp_path / "drive.log")
        recorded = {identifier: here.wait_for(identifier, 250) for identifier in CORRECTED}
        status = here.wait_for(STATUS, 10)
        assert node.stop() == 0
    for identifier, found in recorded.items():
        assert found == data_of(expected, identifier)
    here.wait_for_marker(MARKER)
    assert [frame for frame in here.frames if frame.identifier not in OWN] == drive
    assert state_of(status[-1]) == (State.CORRECTING, Reason.NONE)
    assert [data[1] & 15 for data in status] == [k % 15 for k in range(len(status))]
    assert node.messages.endswith("ecu-node: ended: frames in 775, answers 750, corrupt 25\n")


def test_measured_values_pass_through_with_unfit_parameters(
    database: VehicleDatabase, params: Path, tmp_path: Path, start_node: StartNode, here: Recording
) -> None:
    drive = write_drive(tmp_path / "drive.log", database, 20)
    expected = sent_by_core(database, Mode.OVERLAY, drive, InForce(parameters=None, reason=Reason.WRONG_VEHICLE))
    with start_node("--vehicle", "v9999") as node:
        play(tmp_path / "drive.log")
        for identifier in CORRECTED:
            assert here.wait_for(identifier, 20) == data_of(expected, identifier)
        (status, *_) = here.wait_for(STATUS, 1)
        assert node.stop() == 0
    assert state_of(status) == (State.PASSING_THROUGH, Reason.WRONG_VEHICLE)
    why = f"{params}: parameters are for vehicle 'v0007', this is 'v9999'"
    assert f"passing measured values through: {why}" in node.messages


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_sigterm_or_sigint_ends_the_node_within_a_second(start_node: StartNode, how: signal.Signals) -> None:
    with start_node() as node:
        assert node.stop(how, within_s=1.0) == 0
    assert node.messages.splitlines()[-1] == "ecu-node: ended: no frames"


@pytest.mark.parametrize("name", ["nocan0", "lo"])
def test_name_of_no_can_interface_is_refused_in_one_line(tmp_path: Path, start_node: StartNode, name: str) -> None:
    words = f"{name}: cannot open the bus: no CAN interface of this name"
    with pytest.raises(AssertionError, match=words), start_node("--channel", name):
        pass  # it does not start
    assert (tmp_path / "node.err").read_text().count("\n") == 1


# ---- as its service runs it, without any privilege; the monitor beside it


UNPRIVILEGED = ["setpriv", "--bounding-set=-all", "--inh-caps=-all", "--ambient-caps=-all", "--no-new-privs"]


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
        assert len(here.wait_for(BATTERY_CORRECTED, INSTANTS)) == INSTANTS
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


# ---- a gateway between vcan0, where the sensors are, and vcan1


NOISE, BACK = "345", "346"
"""Identifiers of cangen's standard frames towards the vehicle and back; its extended ones are random."""
EXTENDED = "18FF1234"
"""Identifier of the drive's extended frames."""


def apart(frames: Iterable[LoggedFrame]) -> dict[str, list[LoggedFrame]]:
    """Sort frames into those of branches, of others, and noise, each in their order; leave out status and `BACK`."""
    found: dict[str, list[LoggedFrame]] = {"branches": [], "others": [], "noise": []}
    for item in frames:
        if item.identifier == NOISE or (len(item.identifier) == 8 and item.identifier != EXTENDED):
            found["noise"].append(item)
        elif item.identifier not in {f"{STATUS:03X}", BACK}:
            found["branches" if item.identifier in {"110", "120", "130"} else "others"].append(item)
    return found


def test_gateway_changes_currents_and_crcs_and_nothing_else(
    database: VehicleDatabase, drive: Path, start_gateway: StartNode, here: Recording, there: Recording
) -> None:
    with start_gateway("--vehicle", VEHICLE, "--fd") as node:
        with playing(drive) as player:
            generate(CHANNEL, 150, "-I", NOISE, "-m")
            generate(CHANNEL, 50, "-e")
            generate(OTHER_CHANNEL, 50, "-I", BACK)
            generate(OTHER_CHANNEL, 10, "-I", BACK, "-R")
            assert player.wait() == 0
        total = len(frames_of(drive)) + 260
        sent = here.wait_for_frames(total)
        stopped = INSTANTS // 10
        arrived_at_least = total - stopped
        wait_until(
            lambda: sum(item.identifier != f"{STATUS:03X}" for item in there.frames) >= arrived_at_least,
            "all frames on the other bus",
        )
        assert node.stop() == 0
    before, after = apart(sent), apart(there.frames)
    assert len(before["noise"]) == 200
    assert any(item.data.startswith("#") for item in before["noise"]), "FD frames, too"
    assert (after["noise"], after["others"]) == (before["noise"], before["others"])
    assert after["branches"] == sent_by_core(database, Mode.GATEWAY, before["branches"])
    assert after["branches"] != before["branches"]
    back = [[item for item in side.frames if item.identifier == BACK] for side in (here, there)]
    assert len(back[0]) == 60
    assert back[0] == back[1]
    assert here.frames == sent, "nothing comes back, and the status stays where it belongs"
    counted = f"forwarded {len(after['branches'])}, not passed on {stopped}, corrupt {stopped}"
    assert node.messages.endswith(f"{counted}\n")
