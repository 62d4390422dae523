"""BLF files (Vector's binary logging format) into frame arrays, without a Python object per frame.

A BLF file is a header ``LOGG`` and objects ``LOBJ``, each with its own size; most are containers, whose content, often
compressed, is again objects, which may go over from one container into the next. There is no public specification; the
layout of the objects is that of python-can's reader, which is the oracle of the tests.

A size of zero makes a naive reader go round for ever, and a file cut inside a container reads as a shorter one without
any error: the structure is checked throughout, and damage is refused with its place.
"""

import struct
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import BinaryIO

from calibrator.errors import LogError
from calibrator.recordings.blf_objects import LARGEST_OBJECT, OBJECT_HEADER, BlfDamageError, ObjectStream
from calibrator.recordings.frame_arrays import Frames, concatenate_frames

__all__ = ["read_blf"]

_FILE_HEADER = struct.Struct("<4sL8xQ16x8H")
"""Signature, size of the header, size of the file, date and time of the start (year, month, day of the week, ..)."""
_FILE_HEADER_BYTES = 144
_CONTAINER = 10
_CONTAINER_HEADER_BYTES = 16
_STORED, _DEFLATE = 0, 2
_LONGEST_PADDING = 3
"""Behind an object; the last one may lack it. [byte]"""
BATCH_BYTES = 1 << 21
"""Content of containers that is taken apart at a time: array operations on it cost more than their calls. [byte]"""


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
    except BlfDamageError as damage:
        frames = sum(map(len, parts))
        raise LogError(
            f"{name}: truncated or damaged BLF: {damage}; {frames} frames before it are readable; "
            f"copy the file again, or save the readable part with the tool that recorded it"
        ) from None
    return concatenate_frames(parts)


def _parts(file: BinaryIO) -> Iterator[Frames]:
    """Frames of some containers at a time."""
    size, start_ns = _file_header(file)
    stream = ObjectStream(start_ns)
    for batch in _batches(_containers(file)):
        yield from _batch_frames(stream, batch)
    position = file.tell()
    if stream.is_cut:
        raise BlfDamageError(position, "the last object is cut")
    if size > position + _LONGEST_PADDING:
        raise BlfDamageError(position, f"the file ends, but its header says {size} bytes")


def _containers(file: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Content of each container, and the byte at which it starts."""
    position = file.tell()
    while head := file.read(OBJECT_HEADER.size):
        if len(head) < OBJECT_HEADER.size:
            raise BlfDamageError(position, "the file ends inside an object's header")
        signature, _, _, length, kind = OBJECT_HEADER.unpack(head)
        if signature != b"LOBJ" or not OBJECT_HEADER.size <= length <= LARGEST_OBJECT:
            raise BlfDamageError(position, f"'LOBJ' and a size are expected, found {signature!r} and {length}")
        content = file.read(length - OBJECT_HEADER.size)
        if len(content) < length - OBJECT_HEADER.size:
            raise BlfDamageError(position, f"an object of {length} bytes starts, but the file ends before")
        file.read(length % 4)
        if kind == _CONTAINER:
            yield _container_content(content, position), position
        position += length + length % 4


def _batches(containers: Iterator[tuple[bytes, int]]) -> Iterator[list[tuple[bytes, int]]]:
    """Containers of some size together; those before a damage come before its error."""
    batch: list[tuple[bytes, int]] = []
    damage: BlfDamageError | None = None
    try:
        for container in containers:
            batch.append(container)
            if sum(len(content) for content, _ in batch) >= BATCH_BYTES:
                yield batch
                batch = []
    except BlfDamageError as error:
        damage = error
    yield batch
    if damage is not None:
        raise damage


def _batch_frames(stream: ObjectStream, batch: list[tuple[bytes, int]]) -> Iterator[Frames]:
    """Frames of containers, one by one if they are damaged, so that the damaged one is named."""
    if not batch:
        return
    try:
        frames = iter([stream.frames(b"".join(content for content, _ in batch), batch[0][1])])
    except BlfDamageError:
        frames = (stream.frames(content, position) for content, position in batch)
    yield from frames


def _file_header(file: BinaryIO) -> tuple[int, int]:
    """Go behind the header; the size of the file that it states, 0 if unknown, and the start in ns since 1970."""
    head = file.read(_FILE_HEADER_BYTES)
    if len(head) < _FILE_HEADER_BYTES or head[:4] != b"LOGG":
        raise BlfDamageError(0, f"the header 'LOGG' of {_FILE_HEADER_BYTES} bytes is expected, found {head[:4]!r}")
    _, length, size, *start = _FILE_HEADER.unpack_from(head)
    if not _FILE_HEADER_BYTES <= length <= LARGEST_OBJECT:
        raise BlfDamageError(4, f"the size of the header is {length}")
    file.read(length - _FILE_HEADER_BYTES)
    return int(size), _start_ns(*start)


def _start_ns(year: int, month: int, _weekday: int, day: int, *of_day: int) -> int:
    """Windows' SYSTEMTIME since 1970; 0 where there is no date. [ns]"""
    hour, minute, second, milliseconds = of_day
    try:
        start = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return 0
    return max(int(start.timestamp()), 0) * 10**9 + milliseconds * 10**6


def _container_content(content: bytes, position: int) -> bytes:
    if len(content) < _CONTAINER_HEADER_BYTES:
        raise BlfDamageError(position, "a container has no header")
    body, method = content[_CONTAINER_HEADER_BYTES:], int.from_bytes(content[:2], "little")
    if method == _STORED:
        return body
    if method != _DEFLATE:
        raise BlfDamageError(position, f"a container is compressed by a method {method} that is not known")
    stream = zlib.decompressobj()
    try:
        text = stream.decompress(body, LARGEST_OBJECT)
    except zlib.error as error:
        raise BlfDamageError(position, f"a container cannot be decompressed ({error})") from None
    if not stream.eof:
        raise BlfDamageError(position, "a compressed container is not complete")
    return text
