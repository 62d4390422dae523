"""Many frames per system call: the link reads what python-can writes, and python-can reads what the link writes."""

import errno
import random
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any

import can
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame, dissect_can_frame

from ecu_node.bus.steady_bus import MOST_AT_ONCE, SocketCanLink

CLASSIC_BYTES, FD_BYTES = 16, 72
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
Ends = tuple[SocketCanLink, socket.socket]


@pytest.fixture
def ends() -> Iterator[Ends]:
    """A link, and the other end of its socket: a pair of datagram sockets, on which the system calls work as on CAN."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    far.settimeout(1.0)
    with near, far:
        yield SocketCanLink(near), far


def random_frame(rng: random.Random) -> can.Message:
    """Any data or remote frame."""
    extended, is_fd = rng.random() < 0.5, rng.random() < 0.5
    remote = not is_fd and rng.random() < 0.2
    length = rng.choice(FD_LENGTHS if is_fd else range(9))
    number, data = rng.randrange(1 << (29 if extended else 11)), None if remote else rng.randbytes(length)
    kind: dict[str, Any] = {"is_extended_id": extended, "is_remote_frame": remote, "is_fd": is_fd}
    for flag in ("bitrate_switch", "error_state_indicator"):
        kind[flag] = is_fd and rng.random() < 0.5
    return can.Message(arbitration_id=number, dlc=length, data=data, **kind)


def is_same(frame: can.Message, other: can.Message) -> bool:
    """Whether all fields of two frames but their times are equal."""
    return frame.equals(other, timestamp_delta=None, check_channel=False, check_direction=False)


def received(link: SocketCanLink, count: int) -> list[can.Message]:
    found: list[can.Message] = []
    while len(found) < count and (message := link.receive(1.0)) is not None:
        found.append(message)
    return found


def test_frames_of_all_kinds_are_read_and_written_as_python_can_does(ends: Ends) -> None:
    link, far = ends
    rng = random.Random(0)
    for _ in range(50):
        frames = [random_frame(rng) for _ in range(20)]
        for frame in frames:
            far.send(build_can_frame(frame))
        assert [is_same(*pair) for pair in zip(received(link, 20), frames, strict=True)] == [True] * 20
        done = 0
        while done < len(frames):
            done += link.send(frames, done)
        for frame in frames:
            raw = far.recv(128)
            assert len(raw) == (FD_BYTES if frame.is_fd else CLASSIC_BYTES)
            *head, data = dissect_can_frame(raw)
            assert head == [*dissect_can_frame(build_can_frame(frame))[:3]]
            assert frame.is_remote_frame or data == bytes(frame.data)


def test_error_frame_is_read_as_an_error_frame(ends: Ends) -> None:
    link, far = ends
    far.send(struct.pack("=IB3x8s", 0x20000040, 8, bytes(8)))
    (message,) = received(link, 1)
    assert message.is_error_frame
    assert message.arbitration_id == 0x40


def test_more_frames_than_fit_one_system_call_arrive_complete_and_in_order(ends: Ends) -> None:
    link, far = ends
    count = 2 * MOST_AT_ONCE + 5
    for number in range(count):
        far.send(build_can_frame(can.Message(arbitration_id=number)))
    came = []
    while (message := link.receive(0.0)) is not None:
        came.append(message.arbitration_id)
    assert came == list(range(count))


def test_frame_has_its_own_kernel_timestamp_or_0_but_never_that_of_another_frame(ends: Ends) -> None:
    link, far = ends
    frame, before_s = build_can_frame(can.Message(arbitration_id=1)), time.time()
    far.send(frame)
    (dated,) = received(link, 1)
    assert before_s <= dated.timestamp <= time.time()
    assert link.asked_s <= link.read_s <= time.monotonic()
    link._socket.setsockopt(socket.SOL_SOCKET, 35, 0)
    far.send(frame)
    (undated,) = received(link, 1)
    assert undated.timestamp == 0.0


def test_number_of_newly_dropped_frames_of_a_closed_bus_is_0(ends: Ends) -> None:
    link, _ = ends
    link.close()
    assert link.newly_dropped() == 0


def test_sending_to_a_full_queue_returns_the_number_of_accepted_frames(ends: Ends) -> None:
    link, far = ends
    frames = [can.Message(arbitration_id=number) for number in range(1000)]
    done = 0

    def fill() -> None:
        nonlocal done
        while True:
            done += link.send(frames, done)

    with pytest.raises(OSError, match="unavailable") as caught:
        fill()
    assert caught.value.errno in {errno.EAGAIN, errno.ENOBUFS}
    numbers = [dissect_can_frame(far.recv(128))[0] & 0x1FFFFFFF for _ in range(done)]
    assert numbers == list(range(done))
    assert link.send(frames, done) >= 1
