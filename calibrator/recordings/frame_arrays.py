"""Frames of a log as arrays, so that everything after reading works on whole columns.

A frame is kept as it was logged: time stamp, identifier, channel, length and payload. Error and remote frames carry no
payload; they and damaged lines are counted.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import can
import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask

__all__ = ["EXTENDED_BIT", "FrameCollector", "Frames", "concatenate_frames", "frame_key"]

EXTENDED_BIT = 1 << 31
"""Set in a frame's key where the identifier has 29 bits, as in Linux' ``can_id``."""
CLASSIC_BYTES = 8
FD_BYTES = 64
LATEST_TIME_STAMP_NS = 9 * 10**18
"""Larger time stamps do not fit into 64 bits, and no log has them. [ns]"""

_Scalar = TypeVar("_Scalar", bound=np.generic)


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
    def start_s(self) -> float:
        """Time stamp of the first frame, as logged. [s]"""
        return float(self.time_ns[0]) * 1e-9 if len(self) else 0.0

    @property
    def time_s(self) -> Array:
        """Time since the first frame, in the order of the file, shape (n,). [s]"""
        return (self.time_ns - self.time_ns[:1]) * 1e-9

    def take(self, index: NDArray[np.int64] | Mask) -> "Frames":
        """Return some of the frames; the counts stay those of the log."""
        return Frames(
            time_ns=self.time_ns[index],
            key=self.key[index],
            channel=self.channel[index],
            length=self.length[index],
            data=self.data[index],
            channels=self.channels,
            error_frames=self.error_frames,
            remote_frames=self.remote_frames,
            damaged=self.damaged,
        )


def concatenate_frames(parts: Sequence[Frames]) -> Frames:
    """Join the pieces of one log; counts add up, channels are merged by name."""
    channels = tuple(dict.fromkeys(name for part in parts for name in part.channels))
    number = {name: index for index, name in enumerate(channels)}
    width = max((part.data.shape[1] for part in parts), default=CLASSIC_BYTES)
    return Frames(
        time_ns=_join([part.time_ns for part in parts], np.int64),
        key=_join([part.key for part in parts], np.uint32),
        channel=_join([_renumbered(part, number) for part in parts], np.uint32),
        length=_join([part.length for part in parts], np.uint8),
        data=np.concatenate([np.zeros((0, width), np.uint8), *(_widened(part.data, width) for part in parts)]),
        channels=channels,
        error_frames=sum(part.error_frames for part in parts),
        remote_frames=sum(part.remote_frames for part in parts),
        damaged=sum(part.damaged for part in parts),
    )


class FrameCollector:
    """Takes messages of python-can one by one and gives them back as :class:`Frames`."""

    def __init__(self) -> None:
        self._time_ns: list[int] = []
        self._key: list[int] = []
        self._channel: list[int] = []
        self._payload: list[bytes | bytearray] = []
        self._channels: dict[str, int] = {}
        self.error_frames = 0
        self.remote_frames = 0
        self.damaged = 0

    def __len__(self) -> int:
        return len(self._time_ns)

    def add(self, message: can.Message) -> None:
        """Take one message. A frame shorter than it says, or with an impossible time stamp, is counted as damaged."""
        if message.is_error_frame:
            self.error_frames += 1
        elif message.is_remote_frame:
            self.remote_frames += 1
        elif not 0.0 <= message.timestamp <= 1e-9 * LATEST_TIME_STAMP_NS or _is_cut(message):
            self.damaged += 1
        else:
            self._time_ns.append(round(message.timestamp * 1e9))
            self._key.append(message.arbitration_id | (EXTENDED_BIT if message.is_extended_id else 0))
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
            error_frames=self.error_frames,
            remote_frames=self.remote_frames,
            damaged=self.damaged,
        )


def _is_cut(message: can.Message) -> bool:
    """Whether the payload is shorter than the length of a classic frame says, or longer than any frame."""
    if message.is_fd:
        return len(message.data) > FD_BYTES
    return len(message.data) != min(message.dlc, CLASSIC_BYTES)


def _join(arrays: Sequence[NDArray[_Scalar]], dtype: type[_Scalar]) -> NDArray[_Scalar]:
    return np.concatenate([np.zeros(0, dtype), *arrays])


def _renumbered(part: Frames, number: dict[str, int]) -> NDArray[np.uint32]:
    return np.array([number[name] for name in part.channels], np.uint32)[part.channel]


def _widened(data: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    missing = width - data.shape[1]
    return np.pad(data, ((0, 0), (0, missing))) if missing else data
