"""Hold the frames of a log as arrays, so that all later steps work on whole columns, and repair their time stamps.

A frame is kept as it was logged: time stamp, identifier, channel, length and payload. Error frames, remote
frames and damaged lines are not kept, only counted.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import can
import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask

__all__ = ["EXTENDED_BIT", "Frames", "LogTime", "concatenate_frames", "frame_key", "frames_of", "repaired_time"]

EXTENDED_BIT = 1 << 31
"""Set in a frame's key where the identifier has 29 bits, as in Linux' ``can_id``."""
LARGEST_IDENTIFIER = (1 << 29) - 1
CLASSIC_BYTES = 8
FD_BYTES = 64
LATEST_TIME_STAMP_NS = 9 * 10**18
"""Latest possible time stamp: larger ones do not fit into 64 bits, and no log has them. [ns]"""
NOTHING, DATA, ERROR, REMOTE, DAMAGED = range(5)
"""Kinds of lines or objects of a log, in :class:`FrameColumns`."""


def frame_key(frame_id: int, *, extended: bool) -> int:
    """Return the identifier as a key: with :data:`EXTENDED_BIT` set if it has 29 bits, unchanged if it has 11."""
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
        Number of payload bytes of each frame.
    data : ndarray of uint8, shape (n, 8) or (n, 64)
        Payloads; bytes beyond the length of a frame are 0. 64 columns if any frame is longer than 8 bytes.
    channels : tuple of str
        Names of the buses that the frames came from.
    error_frames, remote_frames, damaged : int
        Numbers of error frames, of remote frames, and of lines or frames that could not be read.
    first_damaged : int
        Number of the first damaged line of a text log, from 1; 0 if there is none, and for logs without lines or
        read by python-can.
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
    first_damaged: int = 0

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def time_s(self) -> Array:
        """Time since the first frame, in the order of the file, shape (n,). [s]"""
        return (self.time_ns - self.time_ns[:1]) * 1e-9

    def take(self, index: NDArray[np.int64] | Mask) -> "Frames":
        """Return the frames with these indices, or those where a mask is true; the counts stay those of the log."""
        columns: dict[str, Any] = {name: getattr(self, name)[index] for name in _COLUMNS}
        return replace(self, **columns)

    def messages(self) -> Iterator[can.Message]:
        """Yield the frames as messages to be sent, with time stamps [s]; those longer than 8 bytes are CAN FD."""
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
    """Join pieces of a log, or several logs, in the order given.

    Numbers of error, remote and damaged frames add up, and channels of the same name become one.
    """
    parts = parts or [FrameColumns.of(0, fd=False).frames()]
    if len(parts) == 1:
        return parts[0]
    channels = tuple(dict.fromkeys(name for part in parts for name in part.channels))
    width = max(part.data.shape[1] for part in parts)
    alike = [
        replace(
            part,
            channel=np.array([channels.index(name) for name in part.channels], np.uint32)[part.channel],
            data=np.pad(part.data, ((0, 0), (0, width - part.data.shape[1]))),
        )
        for part in parts
    ]
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in alike]) for name in _COLUMNS}
    counts = {name: sum(getattr(part, name) for part in parts) for name in _COUNTS}
    first_damaged = next((part.first_damaged for part in parts if part.first_damaged), 0)
    return Frames(**columns, **counts, channels=channels, first_damaged=first_damaged)


class FrameColumns(NamedTuple):
    """Arrays that compiled readers fill, one row per line or object: its kind, and the columns of :class:`Frames`.

    The reader numbers the channels as it likes; :meth:`frames` names them.
    """

    kind: NDArray[np.uint8]
    time_ns: NDArray[np.int64]
    key: NDArray[np.uint32]
    channel: NDArray[np.uint32]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]

    @classmethod
    def of(cls, rows: int, *, fd: bool) -> "FrameColumns":
        """Make columns of this many rows, for payloads of 8 bytes, or of 64 for CAN FD."""
        return cls(
            kind=np.zeros(rows, np.uint8),
            time_ns=np.zeros(rows, np.int64),
            key=np.zeros(rows, np.uint32),
            channel=np.zeros(rows, np.uint32),
            length=np.zeros(rows, np.uint8),
            data=np.zeros((rows, FD_BYTES if fd else CLASSIC_BYTES), np.uint8),
        )

    def frames(self, channels: Sequence[str] | None = None, *, rows: int | None = None) -> Frames:
        """Return the data frames, and the numbers of other frames, in the first `rows` rows or in all.

        `channels` are the names of the reader's channel numbers. Without names, each channel is named after its number
        minus one, as logs count channels from 1 and python-can from 0.
        """
        kind = self.kind[:rows]
        counts = np.bincount(kind, minlength=DAMAGED + 1).tolist()
        which = slice(rows) if counts[DATA] == len(kind) else np.flatnonzero(kind == DATA)
        channel = self.channel[which]
        if channels is None:
            numbers = np.flatnonzero(np.bincount(channel))
            channel = np.searchsorted(numbers, channel).astype(np.uint32)
            channels = [str(number - 1) for number in numbers.tolist()]
        return Frames(
            time_ns=self.time_ns[which],
            key=self.key[which],
            channel=channel,
            length=self.length[which],
            data=self.data[which],
            channels=tuple(channels),
            error_frames=counts[ERROR],
            remote_frames=counts[REMOTE],
            damaged=counts[DAMAGED],
        )


def frames_of(messages: Sequence[can.Message]) -> Frames:
    """Convert messages of python-can to frames; an impossible length, identifier or time stamp counts as damage."""
    columns = FrameColumns.of(len(messages), fd=any(len(message.data) > CLASSIC_BYTES for message in messages))
    channels: dict[str, int] = {}
    for row, message in enumerate(messages):
        size = len(message.data)
        if message.is_error_frame or message.is_remote_frame:
            columns.kind[row] = ERROR if message.is_error_frame else REMOTE
        elif not (
            (size <= FD_BYTES if message.is_fd else size == min(message.dlc, CLASSIC_BYTES))
            and 0 <= message.arbitration_id <= LARGEST_IDENTIFIER
            and 0.0 <= message.timestamp <= 1e-9 * LATEST_TIME_STAMP_NS
        ):
            columns.kind[row] = DAMAGED
        else:
            columns.kind[row], columns.time_ns[row] = DATA, round(message.timestamp * 1e9)
            columns.key[row] = frame_key(message.arbitration_id, extended=message.is_extended_id)
            columns.channel[row] = channels.setdefault(str(message.channel), len(channels))
            columns.length[row] = size
            columns.data[row, :size] = np.frombuffer(message.data, np.uint8)
    return columns.frames(tuple(channels))


# ---- time

LARGEST_DISORDER_S = 1.0
"""A larger step back shows that the clock was set: loggers mix up frames only within shorter times. [s]"""
LONGEST_PAUSE_S = 600.0
"""A bus that is silent for longer has been asleep; the pause is replaced by :data:`CLOCK_GAP_S`. [s]"""
CLOCK_GAP_S = 60.0
"""Length of the gap that replaces a clock step; longer than all time-outs of usual layouts. [s]"""


@dataclass(frozen=True, kw_only=True)
class LogTime:
    """Time of the frames of one log, sorted, and without the jumps of a clock that was set while recording.

    Attributes
    ----------
    order : ndarray of int64, shape (n,)
        Indices that sort the frames by time.
    time_s : ndarray of shape (n,)
        Time since the first frame, in that order, not decreasing. [s]
    disordered : int
        Number of frames whose time is before that of a frame logged earlier.
    clock_steps : int
        Number of jumps of the clock, or long pauses, each replaced by a gap of :data:`CLOCK_GAP_S`.
    """

    order: NDArray[np.int64]
    time_s: Array
    disordered: int
    clock_steps: int


def repaired_time(time_ns: NDArray[np.int64]) -> LogTime:
    """Sort time stamps, and replace jumps of the clock by gaps.

    Frames of several buses may be logged slightly out of order: they are sorted. A larger step back, or a step forward
    longer than any pause within a drive, is a step of the clock. The recording then continues after a gap of fixed
    length, so that nothing is interpolated across it and a wrong date cannot make a drive of years.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (n,)
        Time stamps in the order of the file, n > 0. [ns]

    Returns
    -------
    LogTime
        Order, time since the first frame, and what was repaired.
    """
    elapsed = (time_ns - time_ns[0]) * 1e-9
    step = np.diff(elapsed)
    jump = (step < -LARGEST_DISORDER_S) | (step > LONGEST_PAUSE_S)
    clock_steps = int(jump.sum())
    if clock_steps:
        elapsed = elapsed + np.concatenate([[0.0], np.cumsum(np.where(jump, CLOCK_GAP_S - step, 0.0))])
    if not clock_steps and not (step < 0.0).any():  # as nearly always
        return LogTime(order=np.arange(len(elapsed)), time_s=elapsed, disordered=0, clock_steps=0)
    order = np.argsort(elapsed, kind="stable")
    ordered = elapsed[order]
    return LogTime(
        order=order,
        time_s=ordered - ordered[0],
        disordered=int(np.sum(elapsed < np.maximum.accumulate(elapsed))),
        clock_steps=clock_steps,
    )
