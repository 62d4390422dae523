"""A signal's place in a frame: its raw integer read and written without touching any other bit.

The bytes that a signal touches are one integer of its own byte order; the signal is ``length`` bits of it, ``shift``
bits above the least significant one. A whole frame is never decoded, so bits that no signal of the DBC covers survive.
"""

from dataclasses import dataclass
from typing import Literal

from cantools.database.can import Signal

from ecu_node.errors import DatabaseError

__all__ = ["BitPlace", "bit_place"]

_BITS_PER_BYTE = 8
_LONGEST = 64
"""No CAN signal of integers is longer. [bit]"""


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
    order: Literal["little", "big"]
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
        An integer signal that is in every frame of its message.

    Returns
    -------
    BitPlace
        Its place.

    Raises
    ------
    DatabaseError
        If the signal is a floating-point number, multiplexed, or wider than 64 bits.
    """
    if signal.is_float:
        raise DatabaseError(f"signal {signal.name} is a floating-point number; the node corrects integer signals only")
    if signal.multiplexer_ids is not None:
        raise DatabaseError(f"signal {signal.name} is multiplexed; the node corrects signals of every frame only")
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
