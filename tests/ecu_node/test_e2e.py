"""E2E profile 1: what is accepted, what is counted out."""

import pytest
from e2e.p01 import e2e_p01_check
from hypothesis import given
from hypothesis import strategies as st

from ecu_node.e2e import Check, Receiver, Sender

DATA_ID = 0x110


def stream(count: int, size: int = 8) -> list[bytes]:
    sender = Sender(DATA_ID)
    frames = []
    for _ in range(count):
        payload = bytearray(size)
        sender.protect(payload)
        frames.append(bytes(payload))
    return frames


def test_the_counter_starts_at_0_and_runs_to_14() -> None:
    assert [frame[1] for frame in stream(17)] == [*range(15), 0, 1]


def test_an_unbroken_stream_is_ok() -> None:
    receiver = Receiver(DATA_ID)
    assert {receiver.check(frame) for frame in stream(40)} == {Check.OK}


def test_protection_keeps_all_other_bits() -> None:
    payload = bytearray(b"\xaa\xbf\x01\x02\x03\x04\x05\x06")
    Sender(DATA_ID).protect(payload)
    assert payload[1:] == b"\xb0\x01\x02\x03\x04\x05\x06"
    assert e2e_p01_check(payload, DATA_ID)


@given(st.integers(0, 63), st.integers(1, 64))
def test_any_flipped_bit_is_noticed(bit: int, width: int) -> None:
    frame = int.from_bytes(stream(1)[0], "big")
    burst = ((1 << min(width, 8)) - 1) << bit & (1 << 64) - 1
    damaged = (frame ^ burst).to_bytes(8, "big")
    assert Receiver(DATA_ID).check(damaged) is Check.CORRUPT


def test_a_frame_of_another_message_is_corrupt() -> None:
    assert Receiver(DATA_ID + 1).check(stream(1)[0]) is Check.CORRUPT


@pytest.mark.parametrize("payload", [b"", b"\x00"])
def test_a_frame_without_room_for_the_header_is_corrupt(payload: bytes) -> None:
    assert Receiver(DATA_ID).check(payload) is Check.CORRUPT


def test_counter_15_is_impossible_with_any_crc() -> None:
    assert {Receiver(DATA_ID).check(bytes([crc, 15, 0, 0])) for crc in range(256)} == {Check.CORRUPT}


def test_a_repeated_frame_is_not_usable_and_a_gap_is() -> None:
    frames = stream(6)
    receiver = Receiver(DATA_ID)
    checks = [receiver.check(frames[k]) for k in (0, 1, 1, 2, 5)]
    assert checks == [Check.OK, Check.OK, Check.REPEATED, Check.OK, Check.LOST]
    assert [check.usable for check in checks] == [True, True, False, True, True]


def test_a_corrupt_frame_leaves_the_counter_as_it_was() -> None:
    frames = stream(3)
    receiver = Receiver(DATA_ID)
    receiver.check(frames[0])
    receiver.check(b"\x00" + frames[1][1:])
    assert receiver.check(frames[1]) is Check.OK
