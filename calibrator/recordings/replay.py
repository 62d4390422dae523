"""Playing a CAN log onto a bus, with the timing of the recording or as fast as the bus takes it.

A log is read whole before the first frame is sent, so that a damaged one sends nothing. Data frames are played; error
and remote frames are left out. A frame goes out as CAN FD where its payload is longer than 8 bytes.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import can

from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import CLASSIC_BYTES, EXTENDED_BIT, Frames
from calibrator.recordings.frames import LOG_SUFFIXES, read_frames
from ecu_node.errors import BusError

__all__ = ["messages_of", "read_log", "replay"]

_SEND_LIMIT_S = 1.0
"""A bus that takes nothing for this long has nobody listening, or is off. [s]"""
_SEND_PAUSE_S = 0.0005


def read_log(path: Path) -> Frames:
    """Read one log.

    Parameters
    ----------
    path : Path
        The log; its suffix says the format.

    Returns
    -------
    Frames
        Its data frames in the order of the file.

    Raises
    ------
    LogError
        If the file is missing, a folder, of an unknown format, damaged or empty.
    """
    if path.is_dir():
        raise LogError(f"{path}: a folder; give one log file ({' '.join(LOG_SUFFIXES)}, each also .gz)")
    return read_frames(path)


def messages_of(frames: Frames) -> Iterator[can.Message]:
    """Make messages to be sent.

    Parameters
    ----------
    frames : Frames
        Of a log.

    Yields
    ------
    can.Message
        One per frame, in their order, with its time stamp [s].
    """
    for time_ns, key, length, data in zip(frames.time_ns, frames.key, frames.length, frames.data, strict=True):
        yield can.Message(
            timestamp=int(time_ns) * 1e-9,
            arbitration_id=int(key) & ~EXTENDED_BIT,
            is_extended_id=bool(int(key) & EXTENDED_BIT),
            is_fd=int(length) > CLASSIC_BYTES,
            data=data[: int(length)].tobytes(),
            is_rx=False,
        )


def replay(
    messages: Iterable[can.Message],
    bus: can.BusABC,
    *,
    speed: float = 1.0,
    progress: Callable[[int, float], None] | None = None,
) -> int:
    """Send messages in their order, at their instants.

    Parameters
    ----------
    messages : iterable of can.Message
        Frames with timestamps [s]; error frames are left out, a bus makes its own.
    bus : can.BusABC
        Where to.
    speed : float
        1 keeps the timing, 2 halves the time, 0 goes as fast as the bus takes frames. [1]
    progress : callable, optional
        Called after each frame with the number of frames sent and the time since the first one in the log [s].

    Returns
    -------
    int
        Number of frames sent.

    Raises
    ------
    BusError
        If the bus takes no frame for a second.
    """
    sent = 0
    begin_s = time.monotonic()
    first_s: float | None = None
    for message in messages:
        if message.is_error_frame:
            continue
        first_s = message.timestamp if first_s is None else first_s
        age_s = message.timestamp - first_s
        if speed > 0.0 and (wait_s := begin_s + age_s / speed - time.monotonic()) > 0.0:
            time.sleep(wait_s)
        _send(bus, message)
        sent += 1
        if progress is not None:
            progress(sent, age_s)
    return sent


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
