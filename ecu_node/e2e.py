"""End-to-end protection: frames that come in are checked before anything is read from them, outgoing ones get a CRC.

So a frame that came in corrupt can never go out with a valid CRC. What the protections are is in
:mod:`ecu_node.e2e_profiles`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

__all__ = ["Check", "Protection", "Receiver"]


class Check(Enum):
    """Outcome of checking one frame."""

    OK = "valid, next in order"
    LOST = "valid, but a few frames before it were lost"
    REPEATED = "valid, but seen before"
    JUMPED = "valid, but its counter is further on than the layout allows"
    CORRUPT = "CRC or counter impossible"


@dataclass(frozen=True, kw_only=True)
class Protection:
    """How the frames of one message are protected.

    Attributes
    ----------
    header_mask : int
        Bits of CRC and counter in the frame read as one little-endian integer.
    least_bytes : int
        Bytes that a frame must have.
    modulus : int
        Number of codes of the counter, which runs from 0.
    max_step : int
        Largest step of the counter from one frame to the next that is used.
    is_sound : callable
        Whether the CRC of a payload is right; the counter is not looked at.
    counter_byte, counter_shift, counter_ones : int
        The counter of a payload is ``payload[counter_byte] >> counter_shift & counter_ones``.
    seal : callable
        Writes the CRC into a payload; its counter stays.
    advance : callable
        Lets the counter of a payload count on, and writes the CRC.
    """

    header_mask: int
    least_bytes: int
    modulus: int
    max_step: int
    is_sound: Callable[[bytearray], bool]
    counter_byte: int
    counter_shift: int = 0
    counter_ones: int
    seal: Callable[[bytearray], None]
    advance: Callable[[bytearray], None]

    def before_first(self, payload: bytearray) -> None:
        """Prepare an empty payload so that its counter is 0 after it has first advanced."""
        payload[self.counter_byte] |= (self.modulus - 1) << self.counter_shift


class Receiver:
    """Checks the frames of one message in the order of their arrival.

    Parameters
    ----------
    protection : Protection
        Of the message.

    Attributes
    ----------
    expected : int
        Counter of the next frame in order; -1 before the first intact one.
    """

    def __init__(self, protection: Protection) -> None:
        self.expected = -1
        self._protection = protection

    def check(self, payload: bytearray) -> Check:
        """Check one frame and remember its counter.

        Parameters
        ----------
        payload : bytearray
            Data of the frame.

        Returns
        -------
        Check
            A corrupt frame leaves the remembered counter as it was; after a jump the next frame in order is OK. The
            first intact frame is OK with any counter.
        """
        protection = self._protection
        if len(payload) < protection.least_bytes or not protection.is_sound(payload):
            return Check.CORRUPT
        counter = payload[protection.counter_byte] >> protection.counter_shift & protection.counter_ones
        if counter >= protection.modulus:
            return Check.CORRUPT
        before, self.expected = self.expected, (counter + 1) % protection.modulus
        step = 1 if before < 0 else (counter - before + 1) % protection.modulus
        if step == 0:
            return Check.REPEATED
        if step == 1:
            return Check.OK
        return Check.LOST if step <= protection.max_step else Check.JUMPED
