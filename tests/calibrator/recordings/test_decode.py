from collections.abc import Sequence
from math import nan
from typing import Any, Literal

import numpy as np
import pytest
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from e2e.p01 import e2e_p01_check, e2e_p01_protect
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from calibrator.drive import LARGEST
from calibrator.recordings.decode import decode_signal, p01_is_sound
from ecu_node.database import means_not_available
from ecu_node.errors import DatabaseError


def payloads(rows: list[bytes], width: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    data = np.frombuffer(b"".join(row.ljust(width, b"\0") for row in rows), np.uint8).reshape(-1, width)
    return data, np.array([len(row) for row in rows], np.uint8)


def one_signal(
    length: int,
    *,
    signed: bool = False,
    scale: float = 1,
    size: int = 8,
    choices: dict[int, str] | None = None,
    limits: tuple[float | None, float | None] = (None, None),
) -> tuple[Message, Signal]:
    conversion = BaseConversion.factory(scale=scale, offset=0, choices=choices, is_float=False)  # type: ignore[arg-type]
    signal = Signal("S", 0, length, is_signed=signed, conversion=conversion, minimum=limits[0], maximum=limits[1])
    return Message(1, "M", size, [signal]), signal


def by_cantools(message: Message, row: bytes) -> dict[str, Any]:
    """Values of all signals that the frame holds completely."""
    values = message.decode(row, decode_choices=False, allow_truncated=True)
    assert isinstance(values, dict)
    return values


BYTE_ORDERS: tuple[Literal["little_endian", "big_endian"], ...] = ("little_endian", "big_endian")


def a_signal(
    draw: st.DrawFn, size: int, name: str, *, first: int = 0, under: str | None = None, pages: Sequence[int] = ()
) -> Signal:
    """Any signal within `size` bytes from byte `first` on; if under a selector, on some pages of that."""
    is_float = draw(st.booleans()) and size >= 2
    floats = st.sampled_from([bits for bits in (16, 32, 64) if bits <= 8 * size])
    length = draw(floats if is_float else st.integers(1, min(64, 8 * size)))
    return Signal(
        name,
        *draw(places(first, size, length)),
        is_signed=not is_float and draw(st.booleans()),
        conversion=BaseConversion.factory(scale=draw(SCALES), offset=draw(OFFSETS), is_float=is_float),
        multiplexer_signal=under,
        multiplexer_ids=list(pages) if under else None,
    )


SCALES = st.one_of(st.sampled_from([1, 4, -3, 0.02, -0.1]), st.floats(1e-6, 1e3), st.floats(-1e3, -1e-6))
OFFSETS = st.sampled_from([0, -1000, 500.0, 0.25])


@st.composite
def places(
    draw: st.DrawFn, first: int, size: int, length: int
) -> tuple[int, int, Literal["little_endian", "big_endian"]]:
    """Start bit, length and byte order of a signal within some bytes."""
    bit = draw(st.integers(0, 8 * size - length)) + 8 * first
    byte_order = draw(st.sampled_from(BYTE_ORDERS))
    return (bit if byte_order == "little_endian" else 8 * (bit // 8) + 7 - bit % 8), length, byte_order


@st.composite
def multiplexed_messages(draw: st.DrawFn) -> Message:
    """Pages within pages: a selector, another one on some of its pages, and signals on every page of both."""
    size = draw(st.sampled_from([8, 12, 64]))
    inner = draw(st.lists(st.integers(1, size - 1), min_size=4, max_size=4, unique=True))
    (a, b, c, d, e), ends = sorted([0, *inner]), [*sorted(inner), size]  # cantools decodes nothing that overlaps
    pages, sub_pages = (list(range(1 << draw(st.integers(1, 3)))) for _ in range(2))
    split, sub_split = draw(st.integers(1, len(pages) - 1)), draw(st.integers(1, len(sub_pages) - 1))
    selectors = [
        Signal("Top", *draw(places(a, ends[0] - a, len(pages).bit_length() - 1)), is_multiplexer=True),
        Signal(
            "Sub",
            *draw(places(b, ends[1] - b, len(sub_pages).bit_length() - 1)),
            is_multiplexer=True,
            multiplexer_signal="Top",
            multiplexer_ids=pages[split:],
        ),
    ]
    leaves = [
        a_signal(draw, ends[2] - c, "Always", first=c),
        a_signal(draw, ends[3] - d, "Both", first=d, under="Top", pages=pages),
        a_signal(draw, ends[4] - e, "Page", first=e, under="Top", pages=pages[:split]),
        a_signal(draw, ends[4] - e, "SubPage", first=e, under="Sub", pages=sub_pages[:sub_split]),
        a_signal(draw, ends[4] - e, "SubRest", first=e, under="Sub", pages=sub_pages[sub_split:]),
    ]
    return Message(1, "M", size, [*selectors, *leaves])


@given(multiplexed_messages(), st.lists(st.binary(min_size=64, max_size=64), min_size=1, max_size=8), st.data())
def test_nested_multiplexed_signals_of_frames_of_any_length_decode_as_in_cantools(
    message: Message, rows: list[bytes], data: st.DataObject
) -> None:
    lengths = st.one_of(st.just(message.length), st.integers(0, message.length))
    rows = [row[: data.draw(lengths)] for row in rows]
    expected, whole = [by_cantools(message, row) for row in rows], [len(row) == message.length for row in rows]
    for signal in message.signals:
        decoded = decode_signal(message, signal, *payloads(rows, 64 if message.length > 8 else 8))
        present = np.array([signal.name in values for values in expected])
        np.testing.assert_array_equal(decoded.present[whole], present[whole])
        values = np.array([float(values.get(signal.name, nan)) for values in expected])
        np.testing.assert_allclose(decoded.value[decoded.good], values[decoded.good], rtol=1e-15)
        assert decoded.good.tolist() == (np.abs(values) <= LARGEST).tolist()


@pytest.mark.parametrize("code", [-32768, 0x8000])
def test_code_for_not_available_gives_no_value_in_signed_or_unsigned_notation(code: int) -> None:
    message, signal = one_signal(16, signed=True, scale=0.02, choices={code: "SNA", 1: "Standby"})
    decoded = decode_signal(message, signal, *payloads([b"\x00\x80", b"\x01\x00", b"\xff\xff"], 8))
    assert decoded.good.tolist() == [False, True, True]
    np.testing.assert_allclose(decoded.value[1:], [0.02, -0.02])


NO_VALUE = ["SNA", "sna", "Signal not available", "Signal_Not_Available", "SignalNotAvailable", "Invalid",
            "INVALID_VALUE", "Error", "ErrorIndicator", "Not Defined", "N/A", "Init", "unavailable"]  # fmt: skip
VALUES = ["No error", "Initialised", "Open", "Closed", "Erroneous gear", "Snail mode", "Valid"]


@pytest.mark.parametrize(("name", "expected"), [*((name, True) for name in NO_VALUE), *((n, False) for n in VALUES)])
def test_names_in_the_dbc_that_mean_not_available_are_recognised(name: str, expected: bool) -> None:
    assert means_not_available(name) == expected


@pytest.mark.parametrize(("limits", "good"), [
    ((-1.0, 1.0), [True, True, False]), ((0.0, 0.0), [True, True, True]), ((None, None), [True, True, True]),
    ((0.5, None), [False, True, True]), ((None, 0.5), [True, False, False]), ((0.0, 1.0), [True, True, False]),
    ((None, 0.0), [True, False, False]),
])  # fmt: skip
def test_value_outside_the_range_of_the_dbc_is_not_good(limits: tuple[float, float], good: list[bool]) -> None:
    message, signal = one_signal(8, scale=0.1, limits=limits)
    decoded = decode_signal(message, signal, *payloads([b"\0", b"\x0a", b"\x0b"], 8))
    assert decoded.good.tolist() == good


def test_signal_of_more_than_64_bits_is_refused() -> None:
    message, signal = one_signal(65, size=64)
    with pytest.raises(DatabaseError, match="signal S is a number of 65 bits"):
        decode_signal(message, signal, *payloads([bytes(64)], 64))


@given(st.binary(min_size=2, max_size=64), st.integers(0, 0xFFFF), st.integers(0, 10_000))
def test_crc_of_profile_1_agrees_with_the_e2e_package(content: bytes, data_id: int, flip: int) -> None:
    right = bytearray(content)
    right[1] &= 0xF7
    e2e_p01_protect(right, data_id, length=len(right), increment_counter=False)
    wrong = bytearray(right)
    wrong[flip % len(wrong)] ^= 1 << (flip % 8)
    data, length = payloads([bytes(right), bytes(wrong)], 64)
    expected = [e2e_p01_check(row, data_id, length=len(row)) for row in (right, wrong)]
    assert p01_is_sound(data, length, data_id).tolist() == expected == [True, False]


def test_frame_too_short_for_crc_and_counter_fails_the_e2e_check() -> None:
    assert not p01_is_sound(*payloads([b"", b"\0"], 8), 0).any()
