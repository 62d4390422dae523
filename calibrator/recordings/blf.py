"""BLF files (Vector's binary logging format) into frame arrays, without a Python object per frame.

A BLF file is a header ``LOGG`` and objects ``LOBJ``, each with its own size; most are containers, whose content, often
compressed, is again objects, which may go over from one container into the next. There is no public specification; the
layout of the objects is that of python-can's reader, which is the oracle of the tests and takes ten times as long.

A size of zero makes a naive reader go round for ever, and a file cut inside a container reads as a shorter one without
any error: the structure is checked throughout, and damage is refused with its place.
"""

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import BinaryIO

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from calibrator.drive import Mask
from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import (
    CLASSIC_BYTES,
    EXTENDED_BIT,
    FD_BYTES,
    LARGEST_IDENTIFIER,
    LATEST_TIME_STAMP_NS,
    Frames,
    concatenate_frames,
)

__all__ = ["read_blf"]

_Bytes = NDArray[np.uint8]
_Places = NDArray[np.int64]

BATCH_BYTES = 1 << 21
"""Content of containers that is taken apart at a time: array operations on it cost more than their calls. [byte]"""
LARGEST_OBJECT = 1 << 28
"""Containers have some 128 KiB; a larger size is damage. [byte]"""
_FILE_HEADER = struct.Struct("<4sL8xQ16x8H")
"""Signature, size of the header, size of the file, date and time of the start (year, month, day of the week, ..)."""
_FILE_HEADER_BYTES = 144
_OBJECT_HEADER = struct.Struct("<4sHHLL")
"""Signature, size and version of the header, size of the object, type."""
_CONTAINER = 10
_CONTAINER_HEADER_BYTES = 16
_STORED, _DEFLATE = 0, 2
_SIGNATURE = b"LOBJ"
_LONGEST_PADDING = 4
"""Between objects; at the end of a file it may lack. [byte]"""
_TEN_MICROSECONDS = 1
"""Flag of the unit of time; nanoseconds otherwise."""
_TEN_MICROSECONDS_NS = 10_000
_FD_LENGTHS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64], np.int64)


def _record(size: int, fields: str) -> np.dtype[np.void]:
    """A record of some bytes, of whose fields are given: type, first byte and name."""
    parts = [re.split("[@ ]", field) for field in fields.split(", ")]
    formats, offsets, names = ([part[k] for part in parts] for k in range(3))
    return np.dtype({"names": names, "formats": formats, "offsets": [*map(int, offsets)], "itemsize": size})


_HEADER = _record(32, "<u2@6 version, <u4@8 size, <u4@12 kind, <u4@16 flags, <u8@24 time")
_BODY_AT = {1: 32, 2: 40}
"""Where a frame begins, by version of the header; objects of other versions are not known. [byte]"""


@dataclass(frozen=True, kw_only=True)
class _Kind:
    """A type of objects that are data or remote frames: fields before the payload, and bits in them."""

    fields: np.dtype[np.void]
    remote: int
    fd: tuple[str, int]
    """Field, and the bit in it that says CAN FD."""


_CLASSIC = _Kind(
    fields=_record(8, "<u2@0 channel, u1@2 flags, u1@3 dlc, <u4@4 identifier"), remote=0x80, fd=("flags", 0)
)
_FD = _Kind(
    fields=_record(20, "<u2@0 channel, u1@2 flags, u1@3 dlc, <u4@4 identifier, u1@13 fd_flags, u1@14 valid"),
    remote=0x80,
    fd=("fd_flags", 0x01),
)
_FD_64 = _Kind(
    fields=_record(40, "u1@0 channel, u1@1 dlc, u1@2 valid, <u4@4 identifier, <u4@12 flags, u1@35 extension_at"),
    remote=0x10,
    fd=("flags", 0x1000),
)
_KINDS = {1: _CLASSIC, 86: _CLASSIC, 100: _FD, 101: _FD_64}
_LEAST_BYTES = np.full((max(_BODY_AT) + 2, max(_KINDS) + 2), _OBJECT_HEADER.size)
"""Of an object, by version of its header and type; the last ones stand for all beyond. [byte]"""
for _version, _body_at in _BODY_AT.items():
    _LEAST_BYTES[_version] = _HEADER.itemsize
    for _number, _kind in _KINDS.items():
        _LEAST_BYTES[_version, _number] = _body_at + _kind.fields.itemsize
_ERROR_KINDS = (2, 73, 104)
_ROOM = _HEADER.itemsize + _FD_64.fields.itemsize + FD_BYTES
"""Behind the last object, so that fields may be taken before it is known whether they are whole. [byte]"""


class _DamageError(Exception):
    """What is wrong, and at which byte of the file."""

    def __init__(self, byte: int, text: str) -> None:
        super().__init__(f"at byte {byte} {text}")


def read_blf(file: BinaryIO, name: str) -> Frames:
    """Read all frames of a BLF file.

    Parameters
    ----------
    file : binary file
        The (uncompressed) content, at its start.
    name : str
        The file's name, for messages.

    Returns
    -------
    Frames
        In the order of the file.

    Raises
    ------
    LogError
        If the file is no BLF file, is cut, or has an object of impossible size; the message gives the byte, what was
        expected there, and how many frames come before.
    """
    parts: list[Frames] = []
    try:
        parts.extend(_parts(file))
    except _DamageError as damage:
        frames = sum(map(len, parts))
        raise LogError(
            f"{name}: truncated or damaged BLF: {damage}; {frames} frames before it are readable; "
            f"copy the file again, or save the readable part with the tool that recorded it"
        ) from None
    return concatenate_frames(parts)


def _parts(file: BinaryIO) -> Iterator[Frames]:
    """Frames of some containers at a time; those before a damage come before its error."""
    size, start_ns = _file_header(file)
    containers, tail, damage = _containers(file), b"", None
    while damage is None:
        batch, damage = _batch(containers)
        if not batch:
            break
        contents = [tail, *(content for content, _ in batch), bytes(_ROOM)]
        data = b"".join(contents)
        at, end, wrong = _objects(data)
        yield _frames(data, at, start_ns)
        if wrong:
            container = int(np.searchsorted(np.cumsum([*map(len, contents[:-2])]), end, side="right")) - 1
            raise _DamageError(batch[max(container, 0)][1], wrong)
        tail = data[end:-_ROOM]
    if damage is not None:
        raise damage
    if tail.strip(b"\0"):
        raise _DamageError(file.tell(), "the last object is cut")
    if size >= file.tell() + _LONGEST_PADDING:
        raise _DamageError(file.tell(), f"the file ends, but its header says {size} bytes")


def _file_header(file: BinaryIO) -> tuple[int, int]:
    """Go behind the header; the size of the file that it states, 0 if unknown, and the start in ns since 1970."""
    head = file.read(_FILE_HEADER_BYTES)
    if len(head) < _FILE_HEADER_BYTES or head[:4] != b"LOGG":
        raise _DamageError(0, f"the header 'LOGG' of {_FILE_HEADER_BYTES} bytes is expected, found {head[:4]!r}")
    _, length, size, year, month, _, day, hour, minute, second, milliseconds = _FILE_HEADER.unpack_from(head)
    if not _FILE_HEADER_BYTES <= length <= LARGEST_OBJECT:
        raise _DamageError(4, f"the size of the header is {length}")
    file.read(length - _FILE_HEADER_BYTES)
    try:
        start_s = int(datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp())
    except ValueError:  # there is no date
        return size, 0
    start_ns = max(start_s, 0) * 10**9 + milliseconds * 10**6
    return size, start_ns if start_ns <= LATEST_TIME_STAMP_NS else 0


def _containers(file: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Content of each container, and the byte at which it starts."""
    position = file.tell()
    while head := file.read(_OBJECT_HEADER.size):
        if len(head) < _OBJECT_HEADER.size:
            raise _DamageError(position, "the file ends inside an object's header")
        signature, _, _, length, kind = _OBJECT_HEADER.unpack(head)
        if signature != _SIGNATURE or not _OBJECT_HEADER.size <= length <= LARGEST_OBJECT:
            raise _DamageError(position, f"'LOBJ' and a size are expected, found {signature!r} and {length}")
        content = file.read(length - _OBJECT_HEADER.size)
        if len(content) < length - _OBJECT_HEADER.size:
            raise _DamageError(position, f"an object of {length} bytes starts, but the file ends before")
        file.read(length % _LONGEST_PADDING)
        if kind == _CONTAINER:
            yield _container_content(content, position), position
        position += length + length % _LONGEST_PADDING


def _container_content(content: bytes, position: int) -> bytes:
    if len(content) < _CONTAINER_HEADER_BYTES:
        raise _DamageError(position, "a container has no header")
    body, method = content[_CONTAINER_HEADER_BYTES:], int.from_bytes(content[:2], "little")
    if method == _STORED:
        return body
    if method != _DEFLATE:
        raise _DamageError(position, f"a container is compressed by a method {method} that is not known")
    stream = zlib.decompressobj()
    try:
        text = stream.decompress(body, LARGEST_OBJECT)
    except zlib.error as error:
        raise _DamageError(position, f"a container cannot be decompressed ({error})") from None
    if not stream.eof:
        raise _DamageError(position, "a compressed container is not complete")
    return text


def _batch(containers: Iterator[tuple[bytes, int]]) -> tuple[list[tuple[bytes, int]], _DamageError | None]:
    """The next containers of some size together, and the damage that ended them."""
    batch: list[tuple[bytes, int]] = []
    size = 0
    try:
        for content, position in containers:
            batch.append((content, position))
            size += len(content)
            if size >= BATCH_BYTES:
                break
    except _DamageError as damage:
        return batch, damage
    return batch, None


def _objects(data: bytes) -> tuple[_Places, int, str]:
    """Where the complete objects start, where what is left over begins, and what is wrong there; empty for nothing."""
    buffer, length = np.frombuffer(data, np.uint8), len(data) - _ROOM
    starts = np.flatnonzero(buffer[: max(length - _OBJECT_HEADER.size + 1, 0)] == _SIGNATURE[0])
    for offset in range(1, len(_SIGNATURE)):
        starts = starts[buffer[starts + offset] == _SIGNATURE[offset]]
    header = _fields(buffer, starts, _HEADER)
    size = header["size"].astype(np.int64)
    last = np.array(_LEAST_BYTES.shape) - 1
    least = _LEAST_BYTES[np.minimum(header["version"], last[0]), np.minimum(header["kind"], last[1])]
    possible = (size >= least) & (size <= LARGEST_OBJECT)
    gap = starts - np.concatenate([[0], (starts + size)[:-1]])
    wrong = ""
    if possible.all() and np.all((gap >= 0) & (gap <= _LONGEST_PADDING)):
        complete = np.flatnonzero(starts + size <= length)
    else:
        complete, wrong = _walk(starts, size, possible, length)
    end = int(starts[complete[-1]] + size[complete[-1]]) if complete.size else 0
    if end + 2 * _LONGEST_PADDING <= length and data.find(_SIGNATURE, end, end + 2 * _LONGEST_PADDING) < 0:
        wrong = "a container holds something that is no object"
    return starts[complete], end, wrong


def _walk(starts: _Places, size: _Places, possible: Mask, length: int) -> tuple[_Places, str]:
    """Which signatures are those of complete objects, and what ends them: a payload may hold the same letters."""
    found, here, wrong = [], 0, ""
    while (k := int(np.searchsorted(starts, here))) < len(starts) and starts[k] <= here + _LONGEST_PADDING:
        if not possible[k]:
            wrong = f"a container holds an object of {size[k]} bytes, which is impossible for its type"
        if wrong or starts[k] + size[k] > length:
            break
        found.append(k)
        here = int(starts[k] + size[k])
    return np.array(found, np.int64), wrong


def _fields(buffer: _Bytes, at: _Places, fields: np.dtype[np.void]) -> NDArray[np.void]:
    """Records that start at these bytes, shape (n,)."""
    if not at.size:
        return np.zeros(0, fields)
    rows: NDArray[np.void] = sliding_window_view(buffer, fields.itemsize)[at].view(fields)[:, 0]
    return rows


def _frames(data: bytes, at: _Places, start_ns: int) -> Frames:
    """Frames of the objects that start at these bytes."""
    buffer = np.frombuffer(data, np.uint8)
    headers = _fields(buffer, at, _HEADER)
    body_at = np.select([headers["version"] == version for version in _BODY_AT], list(_BODY_AT.values()), 0)
    parts, places = [], []
    for number, kind in _KINDS.items():
        which = np.flatnonzero((headers["kind"] == number) & (body_at > 0))
        if which.size:
            frames, kept = _frames_of_kind(buffer, at[which] + body_at[which], kind, headers[which], start_ns)
            parts.append(frames)
            places.append(which[kept])
    joined = concatenate_frames(parts) if len(parts) != 1 else parts[0]
    if len(parts) > 1:
        joined = joined.take(np.argsort(np.concatenate(places), kind="stable"))
    unknown = int(np.sum(np.isin(headers["kind"], list(_KINDS)) & (body_at == 0)))
    errors = int(np.isin(headers["kind"], _ERROR_KINDS).sum())
    return replace(joined, error_frames=errors, damaged=joined.damaged + unknown)


def _frames_of_kind(
    buffer: _Bytes, body_at: _Places, kind: _Kind, headers: NDArray[np.void], start_ns: int
) -> tuple[Frames, _Places]:
    """Data frames of objects of one type, whose bodies start at these bytes, and which of the objects they are."""
    body, payload_at = _fields(buffer, body_at, kind.fields), body_at + kind.fields.itemsize
    remote, is_fd = body["flags"] & kind.remote > 0, body[kind.fd[0]] & kind.fd[1] > 0
    by_code = _FD_LENGTHS[np.minimum(body["dlc"], len(_FD_LENGTHS) - 1)]
    classic = np.minimum(by_code, CLASSIC_BYTES)
    length = body["valid"].astype(np.int64) if kind is not _CLASSIC else classic
    size = headers["size"].astype(np.int64)
    if kind is _FD_64:
        size = np.where(body["extension_at"] > 0, body["extension_at"], size)
    there = (
        size - kind.fields.itemsize - np.select([headers["version"] == v for v in _BODY_AT], list(_BODY_AT.values()))
    )
    time_ns = _time_ns(headers, start_ns)
    sound = np.where(is_fd, length <= FD_BYTES, length == classic) & (time_ns >= 0)
    kept = np.flatnonzero(sound & ~remote)
    width = FD_BYTES if np.any(length[kept] > CLASSIC_BYTES) else CLASSIC_BYTES
    payloads = sliding_window_view(buffer, width)[payload_at[kept]]
    payloads[np.arange(width) >= np.minimum(there, length)[kept, None]] = 0
    numbers, channel = np.unique(body["channel"][kept], return_inverse=True)
    frames = Frames(
        time_ns=time_ns[kept],
        key=body["identifier"][kept] & np.uint32(LARGEST_IDENTIFIER | EXTENDED_BIT),
        channel=channel.astype(np.uint32),
        length=length[kept].astype(np.uint8),
        data=payloads,
        channels=tuple(str(number - 1) for number in numbers.tolist()),
        remote_frames=int(remote.sum()),
        damaged=int(np.sum(~sound & ~remote)),
    )
    return frames, kept


def _time_ns(headers: NDArray[np.void], start_ns: int) -> _Places:
    """Time stamps since 1970, -1 where impossible. [ns]"""
    time, coarse = headers["time"].copy(), headers["flags"] == _TEN_MICROSECONDS
    latest = max(LATEST_TIME_STAMP_NS - start_ns, 0)
    possible = time <= np.where(coarse, np.uint64(latest // _TEN_MICROSECONDS_NS), np.uint64(latest))
    time[coarse] *= np.uint64(_TEN_MICROSECONDS_NS)
    time_ns = np.where(possible, time, 0).astype(np.int64) + start_ns
    return np.asarray(np.where(possible, time_ns, -1))
