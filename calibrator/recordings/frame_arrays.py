"""Frames of a log as arrays, so that everything after reading works on whole columns.

A frame is kept as it was logged: time stamp, identifier, channel, length and payload. Error and remote frames carry no
payload; they and damaged lines are counted.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask

__all__ = ["EXTENDED_BIT", "FrameCollector", "Frames", "concatenate_frames", "frame_key"]

EXTENDED_BIT = 1 << 31
"""Set in a frame's key where the identifier has 29 bits, as in Linux' ``can_id``."""
LARGEST_IDENTIFIER = (1 << 29) - 1
CLASSIC_BYTES = 8
FD_BYTES = 64
LATEST_TIME_STAMP_NS = 9 * 10**18
"""Larger time stamps do not fit into 64 bits, and no log has them. [ns]"""


def frame_key(frame_id: int, *, extended: bool) -> int:
    """Identifier and its kind in one number: the identifier, with :data:`EXTENDED_BIT` where it has 29 bits."""
    return frame_id | EXTENDED_BIT if extended else frame_id


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Data frames of one log, in the order of the file.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        Time stamps as logged: since 1970 where the format knows the date, else since the start of the log. [ns]
    key : ndarray of uint32, shape (n,)
        Identifiers, see :func:`frame_key`.
    channel : ndarray of uint32, shape (n,)
        Index into `channels`.
    length : ndarray of uint8, shape (n,)
        Payload bytes of each frame.
    data : ndarray of uint8, shape (n, 8) or (n, 64)
        Payloads, zeros after the length; 64 columns where any frame is longer than 8 bytes.
    channels : tuple of str
        Names of the buses that the frames came from.
    error_frames, remote_frames, damaged : int
        What the log has besides: error frames, remote frames, and lines or frames that could not be read.
    """

    time_ns: NDArray[np.int64]
    key: NDArray[np.uint32]
    channel: NDArray[np.uint32]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]
    channels: tuple[str, ...]
    error_frames: int = 0
    remote_frames: int = 0
    damaged: int = 0

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def time_s(self) -> Array:
        """Time since the first frame, in the order of the file, shape (n,). [s]"""
        return (self.time_ns - self.time_ns[:1]) * 1e-9

    def take(self, index: NDArray[np.int64] | Mask) -> "Frames":
        """Return some of the frames; the counts stay those of the log."""
        columns: dict[str, Any] = {name: getattr(self, name)[index] for name in _COLUMNS}
        return replace(self, **columns)

    def messages(self) -> Iterator[can.Message]:
        """Yield the frames as messages to be sent, each with its time stamp [s]; CAN FD where longer than 8 bytes."""
        for time_ns, key, length, data in zip(self.time_ns, self.key, self.length, self.data, strict=True):
            yield can.Message(
                timestamp=int(time_ns) * 1e-9,
                arbitration_id=int(key) & ~EXTENDED_BIT,
                is_extended_id=bool(int(key) & EXTENDED_BIT),
                is_fd=int(length) > CLASSIC_BYTES,
                data=data[: int(length)].tobytes(),
                is_rx=False,
            )


_COLUMNS = ("time_ns", "key", "channel", "length", "data")
_COUNTS = ("error_frames", "remote_frames", "damaged")


def concatenate_frames(parts: Sequence[Frames]) -> Frames:
    """Join the pieces of one log; counts add up, channels are merged by name."""
    parts = [FrameCollector().frames(), *parts]
    channels = tuple(dict.fromkeys(name for part in parts for name in part.channels))
    number = {name: index for index, name in enumerate(channels)}
    width = max(part.data.shape[1] for part in parts)
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in ("time_ns", "key", "length")
    }
    counts: dict[str, Any] = {name: sum(getattr(part, name) for part in parts) for name in _COUNTS}
    return Frames(
        **columns,
        **counts,
        channel=np.concatenate(
            [np.array([*map(number.get, part.channels)], np.uint32)[part.channel] for part in parts]
        ),
        data=np.concatenate([_widened(part.data, width) for part in parts]),
        channels=channels,
    )


def _widened(data: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    missing = width - data.shape[1]
    return np.pad(data, ((0, 0), (0, missing))) if missing else data


class FrameCollector:
    """Takes messages of python-can one by one and gives them back as :class:`Frames`."""

    def __init__(self) -> None:
        self._time_ns: list[int] = []
        self._key: list[int] = []
        self._channel: list[int] = []
        self._payload: list[bytes | bytearray] = []
        self._channels: dict[str, int] = {}
        self.counts = dict.fromkeys(_COUNTS, 0)

    def __len__(self) -> int:
        return len(self._time_ns)

    def add(self, message: can.Message) -> None:
        """Take one message; one with an impossible length, identifier or time stamp is counted as damaged."""
        if message.is_error_frame:
            self.counts["error_frames"] += 1
        elif message.is_remote_frame:
            self.counts["remote_frames"] += 1
        elif not _is_possible(message):
            self.counts["damaged"] += 1
        else:
            self._time_ns.append(round(message.timestamp * 1e9))
            self._key.append(frame_key(message.arbitration_id, extended=message.is_extended_id))
            self._channel.append(self._channels.setdefault(str(message.channel), len(self._channels)))
            self._payload.append(message.data)

    def frames(self) -> Frames:
        """Everything taken so far."""
        length = np.fromiter(map(len, self._payload), np.uint8, len(self._payload))
        width = FD_BYTES if np.any(length > CLASSIC_BYTES) else CLASSIC_BYTES
        payload = b"".join(bytes(data).ljust(width, b"\0") for data in self._payload)
        return Frames(
            time_ns=np.array(self._time_ns, np.int64),
            key=np.array(self._key, np.uint32),
            channel=np.array(self._channel, np.uint32),
            length=length,
            data=np.frombuffer(payload, np.uint8).reshape(-1, width),
            channels=tuple(self._channels),
            **self.counts,
        )


def _is_possible(message: can.Message) -> bool:
    """Whether the payload has the length that a classic frame says, or fits into any, and identifier and time do."""
    size = len(message.data)
    return (
        (size <= FD_BYTES if message.is_fd else size == min(message.dlc, CLASSIC_BYTES))
        and 0 <= message.arbitration_id <= LARGEST_IDENTIFIER
        and 0.0 <= message.timestamp <= 1e-9 * LATEST_TIME_STAMP_NS
    )
