"""Objects in the containers of a BLF file, taken apart column by column."""

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from calibrator.drive import Mask
from calibrator.recordings.frame_arrays import (
    CLASSIC_BYTES,
    EXTENDED_BIT,
    FD_BYTES,
    LATEST_TIME_STAMP_NS,
    Frames,
    concatenate_frames,
)

__all__ = ["LARGEST_OBJECT", "OBJECT_HEADER", "BlfDamageError", "ObjectStream"]

_Bytes = NDArray[np.uint8]
_Index = NDArray[np.int64]

OBJECT_HEADER = struct.Struct("<4sHHLL")
"""Signature, size and version of the header, size of the object, type."""
LARGEST_OBJECT = 1 << 28
"""Containers have some 128 KiB; a larger size is damage. [byte]"""
_SHORT_HEADER = np.dtype(
    [("signature", "<u4"), ("header_size", "<u2"), ("version", "<u2"), ("size", "<u4"), ("kind", "<u4")]
)
_HEADER = np.dtype(
    [
        ("signature", "<u4"),
        ("header_size", "<u2"),
        ("version", "<u2"),
        ("size", "<u4"),
        ("kind", "<u4"),
        ("flags", "<u4"),
        ("client", "V4"),
        ("time", "<u8"),
    ]
)
_CLASSIC = np.dtype([("channel", "<u2"), ("flags", "u1"), ("dlc", "u1"), ("identifier", "<u4")])
_FD = np.dtype(
    [
        ("channel", "<u2"),
        ("flags", "u1"),
        ("dlc", "u1"),
        ("identifier", "<u4"),
        ("frame_length", "<u4"),
        ("bits", "u1"),
        ("fd_flags", "u1"),
        ("valid", "u1"),
        ("reserved", "V5"),
    ]
)
_FD_64 = np.dtype(
    [
        ("channel", "u1"),
        ("dlc", "u1"),
        ("valid", "u1"),
        ("attempts", "u1"),
        ("identifier", "<u4"),
        ("frame_length", "<u4"),
        ("flags", "<u4"),
        ("timing", "V18"),
        ("direction", "u1"),
        ("extension_at", "u1"),
        ("crc", "V4"),
    ]
)
_BODY_AT = {1: 32, 2: 40}
"""Where a frame begins, by version of the header; objects of other versions are not known. [byte]"""
_SIGNATURE = b"LOBJ"
_LONGEST_PADDING = 4
"""Between objects. [byte]"""
_PADDING = _HEADER.itemsize + _FD_64.itemsize + FD_BYTES
"""Room behind the last object, so that fields may be taken before it is known whether they are whole. [byte]"""
_TEN_MICROSECONDS = 1
"""Flag of the unit of time; nanoseconds otherwise."""
_TEN_MICROSECONDS_NS = 10_000
_IDENTIFIER_MASK = (1 << 29) - 1
_REMOTE, _FD_FRAME = 0x80, 0x01
_REMOTE_64, _FD_FRAME_64 = 0x10, 0x1000
_ERROR_KINDS = (2, 73, 104)
_FD_LENGTHS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64], np.int64)


class BlfDamageError(Exception):
    """What is wrong, and at which byte of the file."""

    def __init__(self, byte: int, text: str) -> None:
        super().__init__(f"at byte {byte} {text}")


@dataclass(frozen=True, kw_only=True)
class _Columns:
    """What the objects of one type say of their frames, arrays of length n.

    ``told`` is the payload's length by the length code, ``length`` the one that is stated beside it, ``there`` how many
    bytes of it the object holds; the others are zero.
    """

    channel: _Index
    identifier: NDArray[np.uint32]
    remote: Mask
    fd: Mask
    told: _Index
    length: _Index
    there: _Index


class ObjectStream:
    """The objects of the containers of one file, one after the other."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._tail = b""

    @property
    def is_cut(self) -> bool:
        """Whether the last object is not complete."""
        return bool(self._tail.strip(b"\0"))

    def frames(self, content: bytes, position: int) -> Frames:
        """Frames of the next container, or of several joined.

        Parameters
        ----------
        content : bytes
            The content, decompressed.
        position : int
            Byte of the file where the (first) container starts, for messages.

        Returns
        -------
        Frames
            Those of all objects that are complete now.

        Raises
        ------
        BlfDamageError
            If something else than an object is met, or one of impossible size; the stream is then as before.
        """
        data = b"".join([self._tail, content, bytes(_PADDING)])
        at, end = _objects(data[:-_PADDING], position)
        frames = _frames(np.frombuffer(data, np.uint8), at, position, self._start_ns)
        self._tail = data[end:-_PADDING]
        return frames


def _objects(data: bytes, position: int) -> tuple[_Index, int]:
    """Where the complete objects start, and where what is left over begins."""
    buffer = np.frombuffer(data, np.uint8)
    starts = np.flatnonzero(buffer[: max(len(data) - OBJECT_HEADER.size + 1, 0)] == _SIGNATURE[0])
    for offset in range(1, len(_SIGNATURE)):
        starts = starts[buffer[starts + offset] == _SIGNATURE[offset]]
    header = _fields(buffer, starts, _SHORT_HEADER)
    size = header["size"].astype(np.int64)
    least = np.where(np.isin(header["version"], list(_BODY_AT)), _HEADER.itemsize, OBJECT_HEADER.size)
    possible = (size >= least) & (size <= LARGEST_OBJECT)
    gap = starts - np.concatenate([[0], (starts + size)[:-1]])
    if possible.all() and np.all((gap >= 0) & (gap <= _LONGEST_PADDING)):
        complete = np.flatnonzero(starts + size <= len(data))
    else:
        complete = _walk(starts, size, possible, len(data), position)
    end = int(starts[complete[-1]] + size[complete[-1]]) if complete.size else 0
    if end + 2 * _LONGEST_PADDING <= len(data) and data.find(_SIGNATURE, end, end + 2 * _LONGEST_PADDING) < 0:
        raise BlfDamageError(position, "a container holds something that is no object")
    return starts[complete], end


def _walk(starts: _Index, size: _Index, possible: Mask, length: int, position: int) -> _Index:
    """Which of the signatures are those of complete objects: a payload may hold the same letters."""
    found, here = [], 0
    while True:
        k = int(np.searchsorted(starts, here))
        if k == len(starts) or starts[k] > here + _LONGEST_PADDING:
            break
        if not possible[k]:
            raise BlfDamageError(position, f"a container holds an object of {size[k]} bytes")
        if starts[k] + size[k] > length:
            break
        found.append(k)
        here = int(starts[k] + size[k])
    return np.array(found, np.int64)


def _fields(buffer: _Bytes, at: _Index, fields: np.dtype[np.void]) -> NDArray[np.void]:
    """Records that start at these bytes, shape (n,)."""
    if not at.size:
        return np.zeros(0, fields)
    rows: NDArray[np.void] = sliding_window_view(buffer, fields.itemsize)[at].view(fields)[:, 0]
    return rows


def _frames(buffer: _Bytes, at: _Index, position: int, start_ns: int) -> Frames:
    """Frames of the objects that start at these bytes of a buffer with room behind them."""
    header = _fields(buffer, at, _HEADER)
    body_at = np.select([header["version"] == version for version in _BODY_AT], list(_BODY_AT.values()), 0)
    is_frame = np.isin(header["kind"], list(_READERS))
    unknown = int(np.sum(is_frame & (body_at == 0)))
    parts, places = [], []
    for kind, (fields, read) in _READERS.items():
        which = np.flatnonzero((header["kind"] == kind) & (body_at > 0))
        if not which.size:
            continue
        heads = _fields(buffer, at[which], _HEADER)
        space = heads["size"].astype(np.int64) - body_at[which] - fields.itemsize
        if space.min() < 0:
            raise BlfDamageError(position, "a container holds an object too short for its frame")
        payload_at = at[which] + body_at[which] + fields.itemsize
        columns = read(_fields(buffer, payload_at - fields.itemsize, fields), heads, space)
        frames, kept = _as_frames(buffer, payload_at, columns, _time_ns(heads, start_ns))
        parts.append(frames)
        places.append(which[kept])
    joined = concatenate_frames(parts) if len(parts) != 1 else parts[0]
    if len(parts) > 1:
        joined = joined.take(np.argsort(np.concatenate(places), kind="stable"))
    errors = int(np.isin(header["kind"], _ERROR_KINDS).sum())
    return replace(joined, error_frames=errors, damaged=joined.damaged + unknown)


def _time_ns(header: NDArray[np.void], start_ns: int) -> _Index:
    """Time stamps since 1970, -1 where impossible. [ns]"""
    time, coarse = header["time"].copy(), header["flags"] == _TEN_MICROSECONDS
    latest = max(LATEST_TIME_STAMP_NS - start_ns, 0)
    possible = time <= np.where(coarse, np.uint64(latest // _TEN_MICROSECONDS_NS), np.uint64(latest))
    time[coarse] *= np.uint64(_TEN_MICROSECONDS_NS)
    time_ns = np.where(possible, time, 0).astype(np.int64) + start_ns
    return np.asarray(np.where(possible, time_ns, -1))


def _as_frames(buffer: _Bytes, payload_at: _Index, columns: _Columns, time_ns: _Index) -> tuple[Frames, _Index]:
    """Data frames of one type of object, and which of the objects they are."""
    fits = np.where(columns.fd, columns.length <= FD_BYTES, columns.length == np.minimum(columns.told, CLASSIC_BYTES))
    sound = fits & (time_ns >= 0)
    kept = np.flatnonzero(sound & ~columns.remote)
    length, there = columns.length[kept], columns.there[kept]
    width = FD_BYTES if np.any(length > CLASSIC_BYTES) else CLASSIC_BYTES
    data = sliding_window_view(buffer, width)[payload_at[kept]]
    data[np.arange(width) >= there[:, None]] = 0
    numbers, channel = np.unique(columns.channel[kept], return_inverse=True)
    identifier = columns.identifier[kept]
    frames = Frames(
        time_ns=time_ns[kept],
        key=identifier & np.uint32(_IDENTIFIER_MASK | EXTENDED_BIT),
        channel=channel.astype(np.uint32),
        length=length.astype(np.uint8),
        data=data,
        channels=tuple(str(number - 1) for number in numbers.tolist()),
        remote_frames=int(columns.remote.sum()),
        damaged=int(np.sum(~sound & ~columns.remote)),
    )
    return frames, kept


def _classic(body: NDArray[np.void], _header: NDArray[np.void], space: _Index) -> _Columns:
    length = np.minimum(body["dlc"], CLASSIC_BYTES).astype(np.int64)
    return _columns(body, body["flags"] & _REMOTE, np.zeros(len(body)), (length, length, space))


def _fd(body: NDArray[np.void], _header: NDArray[np.void], space: _Index) -> _Columns:
    told = _FD_LENGTHS[np.minimum(body["dlc"], len(_FD_LENGTHS) - 1)]
    return _columns(body, body["flags"] & _REMOTE, body["fd_flags"] & _FD_FRAME, (told, body["valid"], space))


def _fd_64(body: NDArray[np.void], header: NDArray[np.void], space: _Index) -> _Columns:
    told = _FD_LENGTHS[np.minimum(body["dlc"], len(_FD_LENGTHS) - 1)]
    behind = np.where(body["extension_at"] > 0, header["size"].astype(np.int64) - body["extension_at"], 0)
    lengths = (told, body["valid"], space - behind)
    return _columns(body, body["flags"] & _REMOTE_64, body["flags"] & _FD_FRAME_64, lengths)


def _columns(
    body: NDArray[np.void], remote: NDArray[np.generic], fd: NDArray[np.generic], lengths: tuple[_Index, _Index, _Index]
) -> _Columns:
    told, length, space = (np.asarray(values, np.int64) for values in lengths)
    return _Columns(
        channel=body["channel"].astype(np.int64),
        identifier=body["identifier"],
        remote=remote != 0,
        fd=fd != 0,
        told=told,
        length=length,
        there=np.clip(space, 0, length),
    )


_READERS: dict[int, tuple[np.dtype[np.void], Callable[[NDArray[np.void], NDArray[np.void], _Index], _Columns]]] = {
    1: (_CLASSIC, _classic),
    86: (_CLASSIC, _classic),
    100: (_FD, _fd),
    101: (_FD_64, _fd_64),
}
"""Types of objects that are data or remote frames: the fields before the payload, and how they are to be read."""
