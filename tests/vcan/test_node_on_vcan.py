"""The node as a process on a real SocketCAN bus, with can-utils playing and recording."""

import os
import signal
from collections.abc import Iterable
from pathlib import Path

import pytest

from ecu_node.bus.wiring import Mode
from ecu_node.core.status import Reason, State
from ecu_node.database import VehicleDatabase
from tests.vcan.conftest import BATTERY_CORRECTED, MARKER, STATUS, StartNode, state_of
from tests.vcan.processes import (
    CHANNEL,
    OTHER_CHANNEL,
    LoggedFrame,
    Recording,
    data_of,
    frames_of,
    generate,
    play,
    playing,
    wait_until,
)
from tests.vcan.small_drive import VEHICLE, sent_by_core, write_drive

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


# ---- as its service runs it, without any privilege


UNPRIVILEGED = ["setpriv", "--bounding-set=-all", "--inh-caps=-all", "--ambient-caps=-all", "--no-new-privs"]


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
        wait_until(lambda: len(here.frames) >= total, "all frames on the first bus")
        sent = here.frames
        stopped = INSTANTS // 10

        def have_arrived() -> bool:
            return sum(item.identifier != f"{STATUS:03X}" for item in there.frames) >= total - stopped

        wait_until(have_arrived, "all frames on the other bus")
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
