"""Faults of docs/fault_table.md that need a kernel, or a process of their own."""

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ecu_node.bus.wiring import Mode
from ecu_node.core.status import Quality, Reason, State
from ecu_node.database import VehicleDatabase
from tests.vcan.conftest import AUXILIARY, BATTERY, BATTERY_CORRECTED, MARKER, STATUS, StartNode, state_of
from tests.vcan.processes import (
    CHANNEL,
    OTHER_CHANNEL,
    Recording,
    bring_up,
    data_of,
    frames_of,
    play,
    playing,
    run_tool,
    running_recording,
    send,
    wait_until,
)
from tests.vcan.small_drive import frames_at, sent_by_core

INSTANTS = 45
"""Length of the drive: a multiple of the counter's 15 codes, so that it can be played twice without a jump."""


def qualities(frames: list[bytes]) -> set[int]:
    return {frame[1] >> 4 & 3 for frame in frames}


def wait_for_correcting(here: Recording) -> None:
    wait_until(lambda: state_of(here.data_of(STATUS)[-1]) == (State.CORRECTING, Reason.NONE), "the node to correct")


def send_branches(database: VehicleDatabase, k: int) -> None:
    """Send one frame of each branch."""
    for frame in frames_at(database, k):
        send("#".join(frame))


@pytest.fixture
def bus_is_back() -> Iterator[None]:
    """Restore vcan0 for the next test."""
    yield
    if not Path(f"/sys/class/net/{CHANNEL}").exists():
        run_tool("ip", "link", "add", CHANNEL, "type", "vcan")
    bring_up(CHANNEL)


@pytest.mark.parametrize("how", ["down", "deleted"])
@pytest.mark.usefixtures("bus_is_back")
def test_node_corrects_again_after_its_bus_failed(tmp_path: Path, drive: Path, start_node: StartNode, how: str) -> None:
    with start_node() as node:
        with running_recording(tmp_path / "before.log") as before:
            play(drive)
            before.wait_for(BATTERY_CORRECTED, INSTANTS)
        if how == "deleted":
            run_tool("ip", "link", "del", CHANNEL)
            node.wait_for("the bus failed")
            run_tool("ip", "link", "add", CHANNEL, "type", "vcan")
        else:
            run_tool("ip", "link", "set", CHANNEL, "down")
            node.wait_for("the bus failed")
        bring_up(CHANNEL)
        node.wait_for("the bus is open again")
        with running_recording(tmp_path / "after.log") as after:
            play(drive)
            corrected = after.wait_for(BATTERY_CORRECTED, INSTANTS)
            wait_for_correcting(after)
        assert node.stop() == 0
    assert qualities(corrected) == {Quality.CORRECTED}
    lines = node.messages.splitlines()
    told = [("the bus failed" in line, "is open again" in line) for line in lines]
    assert [pair for pair in told if any(pair)] == [(1, 0), (0, 1)]
    assert "reopened 1" in lines[-1]


def test_full_send_queue_loses_frames_but_does_not_stop_the_gateway(
    database: VehicleDatabase, drive: Path, start_gateway: StartNode, there: Recording
) -> None:
    expected = data_of(sent_by_core(database, Mode.GATEWAY, frames_of(drive)), BATTERY)
    with start_gateway() as node:
        run_tool("tc", "qdisc", "add", "dev", OTHER_CHANNEL, "root", "plug", "limit", "400")
        try:
            play(drive)
        finally:
            run_tool("tc", "qdisc", "del", "dev", OTHER_CHANNEL, "root")
        assert node.process.poll() is None
        play(drive)
        wait_until(lambda: there.data_of(BATTERY)[-INSTANTS:] == expected, "the second drive")
        assert node.stop() == 0
    assert len(there.data_of(BATTERY)) < 2 * INSTANTS
    assert "send errors" in node.messages.splitlines()[-1]
    assert "bus failed" not in node.messages


def test_gateway_drops_error_frames(database: VehicleDatabase, start_gateway: StartNode, there: Recording) -> None:
    with start_gateway() as node:
        send("20000004#0008000000000000")
        send("20000040#0000000000000000")
        send_branches(database, 0)
        there.wait_for(AUXILIARY, 1)
        assert node.stop() == 0
    assert "frames in 3, rewritten 3, forwarded 3, bus errors 2, bus off 1" in node.messages
    assert {item.identifier for item in there.frames} == {"110", "120", "130", "5F0"}


def test_second_gateway_refuses_to_start_and_the_first_continues(start_gateway: StartNode, there: Recording) -> None:
    with start_gateway() as first:
        words = "vcan0 and vcan1: another gateway works between them on this computer; stop one"
        with pytest.raises(AssertionError, match=words), start_gateway():
            pass  # it refuses to start
        there.wait_for(STATUS, len(there.data_of(STATUS)) + 3)
        assert first.stop() == 0
    counters = [data[1] & 15 for data in there.data_of(STATUS)]
    assert counters == [k % 15 for k in range(len(counters))], "all of the first one"


def test_clock_step_is_not_a_fault(database: VehicleDatabase, start_node: StartNode, here: Recording) -> None:
    k = 0
    with start_node() as node:
        here.wait_for(STATUS, 1)
        right_s = time.time() - time.monotonic()
        try:
            for step_s in (0.0, 3600.0, -0.4, -86400.0):
                time.clock_settime(time.CLOCK_REALTIME, time.monotonic() + right_s + step_s)
                for _ in range(2):
                    send_branches(database, k)
                    k += 1
                here.wait_for(BATTERY_CORRECTED, k)
                here.wait_for(STATUS, len(here.data_of(STATUS)) + 2)
        finally:
            time.clock_settime(time.CLOCK_REALTIME, time.monotonic() + right_s)
        assert node.stop() == 0
    assert qualities(here.data_of(BATTERY_CORRECTED)) == {Quality.CORRECTED}
    assert {state_of(data)[0] for data in here.data_of(STATUS)} <= {State.STARTING, State.CORRECTING}


def test_restarted_node_corrects_again_after_a_kill(drive: Path, start_node: StartNode, here: Recording) -> None:
    with playing(drive, endlessly=True):
        with start_node() as node:
            here.wait_for(BATTERY_CORRECTED, 5)
            assert node.stop(signal.SIGKILL) == -signal.SIGKILL
        here.wait_for_marker(MARKER)
        first = len(here.data_of(BATTERY_CORRECTED))
        with start_node() as node:
            here.wait_for(BATTERY_CORRECTED, first + 20)
            wait_for_correcting(here)
            assert node.stop() == 0
    corrected = here.data_of(BATTERY_CORRECTED)
    assert qualities(corrected) == {Quality.CORRECTED}
    counters = [data[1] & 15 for data in corrected]
    assert counters[first : first + 20] == [k % 15 for k in range(20)], "receivers see it count from 0 again"
