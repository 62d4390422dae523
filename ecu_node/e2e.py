"""AUTOSAR E2E profile 1, variant 1A: an 8-bit CRC in byte 0 and a 4-bit counter in the low nibble of byte 1.

The CRC covers a data identifier, which is not sent, and the whole frame; the counter runs from 0 to 14. Incoming frames
are checked before anything is read from them; outgoing ones get a counter of their own and a new CRC. So a frame that
came in corrupt can never go out with a valid CRC.
"""

from enum import Enum

from e2e.p01 import e2e_p01_check, e2e_p01_protect

__all__ = ["HEADER_MASK", "Check", "Receiver", "Sender"]

HEADER_MASK = 0xFFF
"""Bits of CRC and counter in the frame read as one little-endian integer."""

_HEADER_BYTES = 2
_COUNTER_MASK = 0x0F
_COUNTER_MODULUS = 15


class Check(Enum):
    """Outcome of checking one frame."""

    OK = "valid, next in order"
    LOST = "valid, but frames before it were lost"
    REPEATED = "valid, but seen before"
    CORRUPT = "CRC or counter impossible"

    @property
    def usable(self) -> bool:
        """Whether the content is new and intact."""
        return self in {Check.OK, Check.LOST}


class Receiver:
    """Checks the frames of one message in the order of their arrival.

    Parameters
    ----------
    data_id : int
        Data identifier of the message, 16 bits.
    """

    def __init__(self, data_id: int) -> None:
        self._data_id = data_id
        self._last: int | None = None

    def check(self, payload: bytes | bytearray) -> Check:
        """Check one frame and remember its counter.

        Parameters
        ----------
        payload : bytes
            Data of the frame.

        Returns
        -------
        Check
            A corrupt frame leaves the remembered counter as it was. The first intact frame is OK with any counter.
        """
        if len(payload) < _HEADER_BYTES or not e2e_p01_check(bytearray(payload), self._data_id):
            return Check.CORRUPT
        counter = payload[1] & _COUNTER_MASK
        step = 1 if self._last is None else (counter - self._last) % _COUNTER_MODULUS
        self._last = counter
        if step == 0:
            return Check.REPEATED
        return Check.OK if step == 1 else Check.LOST


class Sender:
    """Protects the frames of one message; the counter of the first frame is 0.

    Parameters
    ----------
    data_id : int
        Data identifier of the message, 16 bits.
    """

    def __init__(self, data_id: int) -> None:
        self._data_id = data_id
        self._next = 0

    def protect(self, payload: bytearray) -> None:
        """Write counter and CRC into a frame of at least 2 bytes, in place."""
        payload[1] = payload[1] & ~_COUNTER_MASK | self._next
        e2e_p01_protect(payload, self._data_id, increment_counter=False)
        self._next = (self._next + 1) % _COUNTER_MODULUS
