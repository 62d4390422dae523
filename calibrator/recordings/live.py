"""A live bus: its frames as if they came from a log, and a log played onto it."""

import time
from collections.abc import Iterable, Iterator

import can

from calibrator.recordings.frame_arrays import Frames, frames_of
from calibrator.recordings.log_files import reason_of
from ecu_node.bus.adapters import connect
from ecu_node.errors import BusError

__all__ = ["play_frames", "record_bus"]

_POLL_S = 0.1
"""Drivers that wait in C notice Ctrl-C only between calls. [s]"""
_SEND_LIMIT_S = 1.0
"""A bus that takes nothing for this long has nobody listening, or is off. [s]"""
_SEND_PAUSE_S = 0.0005


def record_bus(interface: str, channel: str | None, duration_s: float) -> Frames:
    """Take everything that comes over a bus for some time.

    Parameters
    ----------
    interface, channel : str, str or None
        Of python-can, such as ``socketcan`` and ``vcan0``.
    duration_s : float
        How long to listen. [s]

    Returns
    -------
    Frames
        At least one frame; those until then if Ctrl-C ends it early.

    Raises
    ------
    BusError
        If the bus cannot be opened, or nothing comes.
    """
    messages: list[can.Message] = []
    try:
        with connect(interface, channel) as bus:
            end_s = time.monotonic() + duration_s
            while (left_s := end_s - time.monotonic()) > 0.0:
                message = bus.recv(timeout=min(left_s, _POLL_S))
                if message is not None:
                    messages.append(message)
    except KeyboardInterrupt:
        if not messages:
            raise
    except (can.CanError, OSError) as error:
        raise BusError(
            f"{interface}:{channel}: cannot listen to the bus: {reason_of(error)}; check --interface and --channel"
        ) from None
    frames = frames_of(messages)
    if not len(frames):
        raise BusError(
            f"{interface}:{channel}: no frame in {duration_s:g} s; check that something is sent, or listen longer"
        )
    return frames


def play_frames(messages: Iterable[can.Message], bus: can.BusABC, *, speed: float = 1.0) -> Iterator[float]:
    """Send messages in their order, at their instants.

    Parameters
    ----------
    messages : iterable of can.Message
        Frames with timestamps [s].
    bus : can.BusABC
        Where to.
    speed : float
        1 keeps the timing, 2 halves the time, 0 goes as fast as the bus takes frames. [1]

    Yields
    ------
    float
        Of each frame, when it is sent: its time since the first one in the log. [s]

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
                raise BusError(f"{bus.channel_info}: the bus takes no frame: {error}") from None
            time.sleep(_SEND_PAUSE_S)
        else:
            return
