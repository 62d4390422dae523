"""Play a log onto a live bus."""

import time
from collections.abc import Iterable, Iterator

import can

from ecu_node.errors import BusError

__all__ = ["play_frames"]

_SEND_LIMIT_S = 1.0
"""A bus that takes no frame for this long has no listener, or is off. [s]"""
_SEND_PAUSE_S = 0.0005


def play_frames(messages: Iterable[can.Message], bus: can.BusABC, *, speed: float = 1.0) -> Iterator[float]:
    """Send messages in their order, each at its instant relative to the first one.

    Parameters
    ----------
    messages : iterable of can.Message
        Frames with timestamps [s].
    bus : can.BusABC
        The bus to send them to.
    speed : float
        1 keeps the timing, 2 halves the time, 0 goes as fast as the bus takes frames. [1]

    Yields
    ------
    float
        After each frame is sent: its time in the log since the first frame. [s]

    Raises
    ------
    BusError
        If the bus takes no frame for a second.
    """
    begin_s = time.monotonic()
    first_s: float | None = None
    for message in messages:
        first_s = message.timestamp if first_s is None else first_s
        age_s = message.timestamp - first_s
        if speed > 0.0 and (wait_s := begin_s + age_s / speed - time.monotonic()) > 0.0:
            time.sleep(wait_s)
        _send(bus, message)
        yield age_s


def _send(bus: can.BusABC, message: can.Message) -> None:
    give_up_s = time.monotonic() + _SEND_LIMIT_S
    while True:
        try:
            bus.send(message)
        except can.CanError as error:
            if time.monotonic() > give_up_s:
                is_fd_to_classic = message.is_fd and bus.protocol is can.CanProtocol.CAN_20
                advice = "; a CAN FD frame needs --fd" if is_fd_to_classic else ""
                raise BusError(f"{bus.channel_info}: the bus takes no frame: {error}{advice}") from None
            time.sleep(_SEND_PAUSE_S)
        else:
            return
