"""The node's own way over SocketCAN beside python-can's, on a real kernel."""

import random
import time
from collections.abc import Iterator

import can
import pytest

from ecu_node.bus.adapters import connect
from ecu_node.bus.steady_bus import SocketCanLink
from tests.ecu_node.test_socketcan import fields, random_frame
from tests.vcan.processes import CHANNEL

FRAMES = 200
LONGEST_WAIT_S = 5.0


@pytest.fixture
def buses() -> Iterator[tuple[can.BusABC, can.BusABC]]:
    """Two python-can buses on one interface."""
    with connect("socketcan", CHANNEL, fd=True) as one, connect("socketcan", CHANNEL, fd=True) as other:
        yield one, other


def test_frames_of_all_kinds_pass_both_ways_with_the_time_of_their_coming(
    buses: tuple[can.BusABC, can.BusABC],
) -> None:
    rng = random.Random(2)
    link, other = SocketCanLink(buses[0].socket), buses[1]  # type: ignore[attr-defined]
    for _ in range(FRAMES):
        frame = random_frame(rng)
        before_s = time.time()
        other.send(frame)
        found = link.receive(LONGEST_WAIT_S)
        assert found is not None
        assert fields(found) == fields(frame)
        assert before_s - 1e-3 <= found.timestamp <= time.time() + 1e-3
        assert link.send([frame], 0) == 1
        back = other.recv(LONGEST_WAIT_S)
        assert back is not None
        assert fields(back) == fields(frame)


def test_a_burst_comes_whole_and_in_order(buses: tuple[can.BusABC, can.BusABC]) -> None:
    near, far = (SocketCanLink(bus.socket) for bus in buses)  # type: ignore[attr-defined]
    frames = [can.Message(arbitration_id=number, is_extended_id=False, data=bytes([number])) for number in range(150)]
    done = 0
    while done < len(frames):
        done += near.send(frames, done)
    came = [far.receive(LONGEST_WAIT_S) for _ in frames]
    assert [message.arbitration_id for message in came if message is not None] == list(range(150))
    stamps = [message.timestamp for message in came if message is not None]
    assert stamps == sorted(stamps)
    assert far.receive(0.05) is None
