"""A signal's place in a frame: its raw integer read and written without touching any other bit.

The bytes that a signal touches are one integer of its own byte order; the signal is ``length`` bits of it, ``shift``
bits above the least significant one. A whole frame is never decoded, so bits that no signal of the DBC covers survive.
A multiplexed signal is in a frame only if the multiplexers above it have one of its codes.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

from cantools.database.can import Message, Signal

from ecu_node.errors import DatabaseError

__all__ = ["BitPlace", "Multiplexer", "Order", "PlacedSignal", "WordField", "bit_place", "placed_signal"]

_BITS_PER_BYTE = 8
_LONGEST = 64
"""No CAN signal of integers is longer. [bit]"""


Order = Literal["little", "big"]
"""Byte order."""


class WordField(NamedTuple):
    """A signal in a whole payload of one length, read as one integer of the signal's byte order.

    ``raw = ((word >> shift & ones) ^ sign) - sign``.
    """

    shift: int
    ones: int
    sign: int
    """The sign bit of a two's complement; 0 if the signal has none."""


@dataclass(frozen=True, kw_only=True)
class BitPlace:
    """Where the raw integer of one signal stands.

    Attributes
    ----------
    first, end : int
        The signal touches the bytes ``first`` to ``end - 1`` of the payload.
    order : "little" or "big"
        Byte order.
    shift : int
        Bits below the signal in the integer made of these bytes.
    length : int
        Width of the signal, 1 to 64. [bit]
    signed : bool
        Whether the raw integer is a two's complement.
    """

    first: int
    end: int
    order: Order
    shift: int
    length: int
    signed: bool

    @property
    def lowest(self) -> int:
        """Least raw integer that the width can hold."""
        return -(1 << (self.length - 1)) if self.signed else 0

    @property
    def highest(self) -> int:
        """Greatest raw integer that the width can hold."""
        return (1 << (self.length - self.signed)) - 1

    @property
    def mask(self) -> int:
        """The signal's bits in the payload read as one little-endian integer."""
        field = ((1 << self.length) - 1) << self.shift
        placed = bytes(self.first) + field.to_bytes(self.end - self.first, self.order)
        return int.from_bytes(placed, "little")

    def in_word(self, payload_bytes: int) -> WordField | None:
        """The signal in payloads of some length [byte]; None if they are too short to hold it."""
        if payload_bytes < self.end:
            return None
        ones = (1 << self.length) - 1
        below = self.first if self.order == "little" else payload_bytes - self.end
        shift = self.shift + _BITS_PER_BYTE * below
        sign = 1 << (self.length - 1) if self.signed else 0
        return WordField(shift, ones, sign)

    def extract(self, payload: bytes | bytearray) -> int | None:
        """Read the raw integer.

        Parameters
        ----------
        payload : bytes
            Data of a frame, 0 to 64 bytes.

        Returns
        -------
        int or None
            The raw integer; None if the frame is too short to hold the signal.
        """
        if len(payload) < self.end:
            return None
        field = int.from_bytes(payload[self.first : self.end], self.order) >> self.shift
        raw = field & ((1 << self.length) - 1)
        return raw - (1 << self.length) if raw > self.highest else raw

    def put(self, payload: bytearray, raw: int) -> bool:
        """Write the raw integer in place; all other bits stay as they are.

        Parameters
        ----------
        payload : bytearray
            Data of a frame, changed in place.
        raw : int
            Between :attr:`lowest` and :attr:`highest`.

        Returns
        -------
        bool
            False if the frame is too short to hold the signal; it is then unchanged.

        Raises
        ------
        ValueError
            If the raw integer does not fit the width: the caller saturates, nothing wraps.
        """
        if not self.lowest <= raw <= self.highest:
            raise ValueError(f"raw code {raw} does not fit into {self.length} bits")
        if len(payload) < self.end:
            return False
        ones = (1 << self.length) - 1
        field = int.from_bytes(payload[self.first : self.end], self.order)
        field = field & ~(ones << self.shift) | (raw & ones) << self.shift
        payload[self.first : self.end] = field.to_bytes(self.end - self.first, self.order)
        return True


def bit_place(signal: Signal) -> BitPlace:
    """Find the place of a signal of the DBC.

    Parameters
    ----------
    signal : Signal
        An integer signal; where it is multiplexed, see :func:`placed_signal`.

    Returns
    -------
    BitPlace
        Its place.

    Raises
    ------
    DatabaseError
        If the signal is a floating-point number or wider than 64 bits.
    """
    if signal.is_float:
        raise DatabaseError(f"signal {signal.name} is a floating-point number; the node corrects integer signals only")
    if not 1 <= signal.length <= _LONGEST:
        raise DatabaseError(f"signal {signal.name} has {signal.length} bits; 1 to {_LONGEST} are expected")
    if signal.byte_order == "little_endian":
        low, high = signal.start, signal.start + signal.length - 1
        shift = low % _BITS_PER_BYTE
    else:  # the start bit is the most significant one, numbered from the top of its byte here
        low = signal.start - signal.start % _BITS_PER_BYTE + (_BITS_PER_BYTE - 1 - signal.start % _BITS_PER_BYTE)
        high = low + signal.length - 1
        shift = _BITS_PER_BYTE - 1 - high % _BITS_PER_BYTE
    return BitPlace(
        first=low // _BITS_PER_BYTE,
        end=high // _BITS_PER_BYTE + 1,
        order="little" if signal.byte_order == "little_endian" else "big",
        shift=shift,
        length=signal.length,
        signed=signal.is_signed,
    )


@dataclass(frozen=True, kw_only=True)
class Multiplexer:
    """A signal that tells which others a frame has.

    Attributes
    ----------
    place : BitPlace
        Of the multiplexer.
    codes : frozenset of int
        Its raw codes with which the other signal is in the frame.
    """

    place: BitPlace
    codes: frozenset[int]


@dataclass(frozen=True, kw_only=True)
class PlacedSignal:
    """A signal, and the multiplexers that decide whether it is in a frame."""

    place: BitPlace
    above: tuple[Multiplexer, ...] = ()

    @property
    def end(self) -> int:
        """Bytes that a payload must have for the signal and its multiplexers to be in it."""
        return max(self.place.end, *(item.place.end for item in self.above), 0)

    def code(self, payload: bytes | bytearray) -> int | None:
        """Raw code of the signal in a payload; None if it is not there."""
        if all(item.place.extract(payload) in item.codes for item in self.above):
            return self.place.extract(payload)
        return None


def placed_signal(message: Message, signal: Signal) -> PlacedSignal:
    """Find out where a signal of the DBC stands, and in which frames.

    Parameters
    ----------
    message : Message
        The signal's message.
    signal : Signal
        Any of its signals.

    Returns
    -------
    PlacedSignal
        All multiplexers of it must have one of their codes, the nearest one first; none for a signal of every frame.

    Raises
    ------
    DatabaseError
        As :func:`bit_place`, for the signal or one of its multiplexers.
    """
    found = []
    inner = signal
    while inner.multiplexer_ids is not None and inner.multiplexer_signal is not None:
        above = message.get_signal_by_name(inner.multiplexer_signal)
        found.append(Multiplexer(place=bit_place(above), codes=frozenset(inner.multiplexer_ids)))
        inner = above
    return PlacedSignal(place=bit_place(signal), above=tuple(found))
