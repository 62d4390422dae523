"""Decode signals of a DBC, and check end-to-end protection, over whole columns of payloads.

A signal is a run of bits: little-endian (Intel) from its lowest bit upwards, big-endian (Motorola) from its highest bit
downwards. The bytes it touches are joined to one integer, shifted and masked; physical = raw * scale + offset.

A value is *present* where the frame carries the signal (multiplexing), and *good* where it may be used: the frame is
long enough, the raw value does not stand for "no value", and the physical value lies within the DBC's range (0 to 0
means no range). The codes for "no value" are those whose name in the DBC means "not available"; for the signals that
measure a branch, as on the node, they are all codes with a name and those of the layout's ``no_value``.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from cantools.database.can import Message, Signal
from fastcrc import crc8
from numpy.typing import NDArray

from calibrator.compiled import compiled
from calibrator.drive import LARGEST, Array, Mask
from ecu_node.core.e2e import protection_of
from ecu_node.database import VehicleDatabase, means_not_available
from ecu_node.errors import DatabaseError
from ecu_node.layout import ProfileP01
from ecu_node.summary import RANGE_SLACK

__all__ = [
    "Decoded",
    "SignalRange",
    "bit_range",
    "decode_signal",
    "message_is_sound",
    "p01_is_sound",
    "raw_values",
    "signal_range",
]

Raw = NDArray[np.int64] | NDArray[np.uint64] | NDArray[np.float64]

_WORD_BITS = 64
_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}


@dataclass(frozen=True, kw_only=True)
class Decoded:
    """One decoded signal of some frames.

    Attributes
    ----------
    value : ndarray of shape (n,)
        Physical values in the unit of the DBC; NaN where the frame is too short.
    present : ndarray of bool of shape (n,)
        Whether the frame carries the signal; False only for multiplexed signals.
    bad : mapping of str to ndarray of bool, shape (n,)
        Which values may not be used, by reason: ``too short``, ``not available`` (the code stands for no value),
        ``out of range`` (outside the DBC's range, or not a number).
    """

    value: Array
    present: Mask
    bad: Mapping[str, Mask]

    @property
    def good(self) -> Mask:
        """Whether each value is present and may be used, shape (n,)."""
        return np.asarray(self.present & ~np.logical_or.reduce(list(self.bad.values())))


def decode_signal(
    message: Message,
    signal: Signal,
    data: NDArray[np.uint8],
    length: NDArray[np.uint8],
    no_value: frozenset[int] | None = None,
) -> Decoded:
    """Decode one signal of frames of one identifier.

    Parameters
    ----------
    message : Message
        The message that the frames carry.
    signal : Signal
        One of its signals.
    data : ndarray of uint8, shape (n, W)
        Payloads; bytes beyond the length of a frame are 0.
    length : ndarray of uint8, shape (n,)
        Number of payload bytes of each frame.
    no_value : frozenset of int, optional
        Raw values that stand for no value, as :func:`ecu_node.database.codes_of_no_value` returns them; by default
        those whose name in the DBC means "not available".

    Returns
    -------
    Decoded
        Values, and which of them are present and good, one per frame.

    Raises
    ------
    DatabaseError
        If the signal is longer than 64 bits or a float of a width other than 16, 32 or 64 bits.
    """
    present, known = _presence(message, signal, data, length)
    raw, complete = raw_values(signal, data, length)
    with np.errstate(invalid="ignore", over="ignore"):  # a signalling NaN, or too large a number, in a float signal
        value = np.where(complete, raw.astype(np.float64) * float(signal.scale) + float(signal.offset), np.nan)
    whole = known & complete
    named = whole & _is_one_of(signal, raw, _named_bad(signal) if no_value is None else no_value)
    held = (np.abs(value) <= LARGEST) & signal_range(signal).holds(value)
    bad = {"too short": ~whole, "not available": named, "out of range": whole & ~named & ~held}
    return Decoded(value=value, present=present, bad=bad)


def raw_values(signal: Signal, data: NDArray[np.uint8], length: NDArray[np.uint8]) -> tuple[Raw, Mask]:
    """Return the raw values of one signal, and which frames are long enough for it.

    Parameters
    ----------
    signal : Signal
        The signal; its multiplexing is ignored.
    data, length : ndarray
        Payloads, and number of payload bytes of each frame, as in :func:`decode_signal`.

    Returns
    -------
    raw : ndarray of int64, uint64 or float64, shape (n,)
        Raw values; int64 for signed and uint64 for unsigned signals.
    complete : ndarray of bool, shape (n,)
        Whether the frame is long enough; otherwise the raw value has no meaning.

    Raises
    ------
    DatabaseError
        If the signal has a width that cannot be decoded, as in :func:`decode_signal`.
    """
    bits = signal.length
    if bits > _WORD_BITS or (signal.is_float and bits not in _FLOATS):
        raise DatabaseError(
            f"signal {signal.name} is a {'float' if signal.is_float else 'number'} of {bits} bits; "
            f"integers up to 64 bits and floats of 16, 32 or 64 bits can be decoded"
        )
    columns, shift = _bit_run(signal)
    last = max(columns)
    complete = length > last
    if last >= data.shape[1]:
        return np.zeros(len(data), np.int64), np.zeros(len(data), np.bool_)
    word = _joined(data, columns, shift)
    if bits < _WORD_BITS:
        word &= np.uint64((1 << bits) - 1)
    if signal.is_float:
        with np.errstate(invalid="ignore"):  # a signalling NaN warns when it is converted
            return word.astype(f"u{bits // 8}").view(_FLOATS[bits]).astype(np.float64), complete
    if signal.is_signed:
        sign = np.uint64(1 << (bits - 1))
        return ((word ^ sign) - sign).view(np.int64), complete
    return word, complete


@dataclass(frozen=True, kw_only=True)
class SignalRange:
    """Least and greatest physical value of a signal, and the tolerance for rounding."""

    low: float
    high: float
    slack: float

    def holds(self, value: Array) -> Mask:
        """Return which values lie inside the range; NaN does not."""
        return np.asarray((value >= self.low - self.slack) & (value <= self.high + self.slack))


def bit_range(signal: Signal, factor: float = 1.0) -> tuple[float, float]:
    """Return the least and greatest value that the bits of an integer signal can express, multiplied by a factor."""
    first = -(1 << signal.length - 1) if signal.is_signed else 0
    codes = (first, first + (1 << signal.length) - 1)
    low, high = sorted(factor * (code * float(signal.scale) + float(signal.offset)) for code in codes)
    return low, high


def signal_range(signal: Signal, factor: float = 1.0) -> SignalRange:
    """Return the valid range of one signal.

    Parameters
    ----------
    signal : Signal
        A signal of the DBC.
    factor : float
        Factor by which the physical values are multiplied, such as that of a unit.

    Returns
    -------
    SignalRange
        The range, infinite on a side that the DBC does not limit. 0 to 0 limits neither side: DBC files state it for
        signals without a range.
    """
    low = -math.inf if signal.minimum is None else float(signal.minimum)
    high = math.inf if signal.maximum is None else float(signal.maximum)
    if signal.minimum == signal.maximum == 0:
        low, high = -math.inf, math.inf
    ends = sorted((factor * low, factor * high))
    return SignalRange(low=ends[0], high=ends[1], slack=abs(factor * float(signal.scale)) * RANGE_SLACK)


def _bit_run(signal: Signal) -> tuple[list[int], int]:
    """Return the indices of a signal's bytes, least significant first, and how many bits of the first are below it."""
    if signal.byte_order == "little_endian":
        first, shift = divmod(signal.start, 8)
        return list(range(first, (signal.start + signal.length - 1) // 8 + 1)), shift
    highest = 8 * (signal.start // 8) + 7 - signal.start % 8
    lowest = highest + signal.length - 1
    return list(range(lowest // 8, highest // 8 - 1, -1)), 7 - lowest % 8


def _joined(data: NDArray[np.uint8], columns: list[int], shift: int) -> NDArray[np.uint64]:
    """Join the bytes in some columns, least significant first, to one integer per row without its lowest `shift` bits.

    A signal of 64 bits may touch nine bytes.
    """
    word = np.zeros(len(data), np.uint64)
    for place, column in enumerate(columns):
        byte, move = data[:, column].astype(np.uint64), 8 * place - shift
        word |= byte << np.uint64(move) if move >= 0 else byte >> np.uint64(-move)
    return word


def _presence(
    message: Message, signal: Signal, data: NDArray[np.uint8], length: NDArray[np.uint8]
) -> tuple[Mask, Mask]:
    """Return which frames carry a signal, and which are long enough to tell; shorter ones count as carrying it.

    No frame carries a signal whose multiplexer is missing from the message.
    """
    everywhere = np.ones(len(data), np.bool_)
    if signal.multiplexer_ids is None or signal.multiplexer_signal is None:
        return everywhere, everywhere
    selector = next((item for item in message.signals if item.name == signal.multiplexer_signal), None)
    if selector is None:
        return ~everywhere, everywhere
    present, known = _presence(message, selector, data, length)
    raw, complete = raw_values(selector, data, length)
    selected = np.isin(raw, np.array(signal.multiplexer_ids, raw.dtype))
    return present & (selected | ~complete), known & complete


def _named_bad(signal: Signal) -> frozenset[int]:
    return frozenset(int(code) for code, name in (signal.choices or {}).items() if means_not_available(str(name)))


def _is_one_of(signal: Signal, raw: Raw, codes: frozenset[int]) -> Mask:
    bad = np.zeros(len(raw), np.bool_)
    mask = (1 << signal.length) - 1
    for code in codes:
        if np.issubdtype(raw.dtype, np.floating):
            bad |= raw == code
        else:
            bad |= raw.view(np.uint64) & np.uint64(mask) == np.uint64(int(code) & mask)
    return bad


# ---- end-to-end protection

_NO_COUNTER = 15
_CRC = np.array([crc8.gsm_a(bytes([byte])) for byte in range(256)], np.uint8)
"""CRC of each byte value, with polynomial 0x1D and start and final value 0."""


def p01_is_sound(data: NDArray[np.uint8], length: NDArray[np.uint8], data_id: int) -> Mask:
    """Check the CRC and the counter's range in frames of one message that AUTOSAR E2E profile 1A protects.

    In this profile, byte 0 is CRC-8 SAE J1850 (polynomial 0x1D, start and final value 0x00) over the low and the high
    byte of the data identifier and the bytes after the CRC. AUTOSAR, "E2E Protocol Specification", profile 1, with both
    bytes of the data identifier included.

    Parameters
    ----------
    data : ndarray of uint8, shape (n, W)
        Payloads; bytes beyond the length of a frame are 0.
    length : ndarray of uint8, shape (n,)
        Number of payload bytes of each frame.
    data_id : int
        Data identifier of the message, 0 to 65535.

    Returns
    -------
    ndarray of bool, shape (n,)
        True where byte 0 is the right CRC and the counter, the low half of byte 1, is not 15; False for frames shorter
        than these 2 bytes.
    """
    crc = np.empty(len(data), np.uint8)
    _crc_of_rows(data, length, _CRC, _CRC[_CRC[data_id & 0xFF] ^ (data_id >> 8)], crc)
    return np.asarray((length >= 2) & (crc == data[:, 0]) & (data[:, 1] & 0x0F != _NO_COUNTER))


@compiled
def _crc_of_rows(
    data: NDArray[np.uint8], length: NDArray[np.uint8], table: NDArray[np.uint8], start: int, crc: NDArray[np.uint8]
) -> None:
    """Fill `crc` with the CRC of each row over its bytes after the first, begun with the value `start`."""
    for row in range(len(data)):
        value = start
        for column in range(1, length[row]):
            value = table[value ^ data[row, column]]
        crc[row] = value


def message_is_sound(
    database: VehicleDatabase, message: Message, data: NDArray[np.uint8], length: NDArray[np.uint8]
) -> Mask:
    """Check frames of one message against the end-to-end protection that the layout states for it.

    Parameters
    ----------
    database : VehicleDatabase
        DBC and layout.
    message : Message
        The message that the frames carry.
    data, length : ndarray
        Payloads, and number of payload bytes of each frame, as in :func:`p01_is_sound`.

    Returns
    -------
    ndarray of bool, shape (n,)
        True where the frame is long enough, its CRC right and its counter a possible value (its order is not checked);
        True everywhere if the message is not protected.
    """
    protection = protection_of(database, message)
    if protection is None:
        return np.ones(len(data), np.bool_)
    entry = database.layout.protection(message.name)
    if isinstance(entry, ProfileP01) and entry.data_id_mode == "both" and not entry.offset:
        return p01_is_sound(data, length, entry.data_id.get(message.name, message.frame_id & 0xFFFF))
    sound = np.zeros(len(data), np.bool_)
    for index, (row, size) in enumerate(zip(data, length.tolist(), strict=True)):
        if size >= protection.least_bytes:
            payload = bytearray(row[:size].tobytes())
            sound[index] = protection.counter_of(payload) < protection.modulus and protection.is_sound(payload)
    return sound
