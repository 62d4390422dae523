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


def test_frames_of_all_kinds_pass_both_ways_with_the_time_of_their_coming(buses: tuple[can.BusABC, can.BusABC]) -> None:
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
