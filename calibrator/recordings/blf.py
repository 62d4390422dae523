"""Read BLF files (Vector's binary logging format) into frame arrays; compiled code parses their objects.

A BLF file is a header ``LOGG`` and objects ``LOBJ``, each with its own size. Most objects are containers, whose
content, often compressed, is again a sequence of objects; one of these may continue in the next container. There is no
public specification; objects are taken to be built as python-can's reader has them, with which the tests compare.

An object of size zero makes a naive reader loop for ever, and a file cut inside a container reads as a shorter file
without any error. So the structure is checked throughout, and damage is refused with its place.
"""

import struct
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from calibrator.compiled import compiled, inner
from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import (
    CLASSIC_BYTES,
    DAMAGED,
    DATA,
    ERROR,
    EXTENDED_BIT,
    FD_BYTES,
    LARGEST_IDENTIFIER,
    LATEST_TIME_STAMP_NS,
    REMOTE,
    FrameColumns,
    Frames,
    concatenate_frames,
)
from calibrator.recordings.log_files import UNREADABLE, open_log

__all__ = ["blf_frames", "read_blf"]

BATCH_BYTES = 1 << 21
"""Containers are parsed together once their content is this long. [byte]"""
LARGEST_OBJECT = 1 << 28
"""Objects of a larger size count as damage: containers have some 128 KiB. [byte]"""
_FILE_HEADER = struct.Struct("<4sL8xQ16x8H")
"""Signature, size of the header, size of the file, start: year, month, day of the week, day, hour, minute,
second, millisecond."""
_FILE_HEADER_BYTES = 144
_OBJECT_HEADER = struct.Struct("<4sHHLL")
"""Signature, size and version of the header, size of the object, type."""
_OBJECT_HEADER_BYTES = 16
_SIGNATURE = int.from_bytes(b"LOBJ", "little")
_CONTAINER = 10
_CONTAINER_HEADER_BYTES = 16
_STORED, _DEFLATE = 0, 2
_LONGEST_PADDING = 4
"""Up to this much padding stands between objects; at the end of a file it may be missing. [byte]"""
_CLASSIC, _CLASSIC_2, _FD, _FD_64 = 1, 86, 100, 101
"""Types of objects that hold data or remote frames."""
_ERROR, _ERROR_EXT, _ERROR_FD = 2, 73, 104
_TEN_MICROSECONDS = 1
"""Value of an object's flags if its time counts in units of 10 us; otherwise it counts in nanoseconds."""
_TEN_MICROSECONDS_NS = 10_000
_SOUND, _IMPOSSIBLE, _NO_OBJECT, _WIDE = range(4)
"""How parsing a batch ended. ``_WIDE``: a payload is longer than the 8 bytes for which there are columns."""


class _DamageError(Exception):
    """A damage of the file: what is wrong, and at which byte."""

    def __init__(self, byte: int, text: str) -> None:
        super().__init__(f"at byte {byte} {text}")


def read_blf(path: Path) -> Frames:
    """Read all frames of a BLF file, gzipped or not; see :func:`blf_frames`."""
    with open_log(path) as file:
        return blf_frames(file, str(path))


def blf_frames(file: BinaryIO, name: str) -> Frames:
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
        The frames in the order of the file.

    Raises
    ------
    LogError
        If the file is no BLF file, is cut or damaged (as by an object of impossible size); the message gives the byte,
        what is wrong there, and how many frames come before it.
    """
    parts: list[Frames] = []
    try:
        size, start_ns = _file_header(file, name)
        tail, fd = b"", False
        for batch in _batches(file):
            contents = [tail, *(content for content, _ in batch)]
            data = b"".join(contents)
            numbers = _Numbers.of(data)
            ended = _WIDE
            while ended == _WIDE:
                columns = FrameColumns.of(len(data) // _OBJECT_HEADER_BYTES + 1, fd=fd)
                ended, rows, end, wrong_size = _take_apart(numbers, start_ns, columns)
                fd = fd or ended == _WIDE
            parts.append(columns.frames(rows=rows))
            if ended != _SOUND:
                container = int(np.searchsorted(np.cumsum([*map(len, contents[:-1])]), end, side="right")) - 1
                impossible = f"an object of {wrong_size} bytes, which is impossible for its type"
                what = impossible if ended == _IMPOSSIBLE else "something that is no object"
                raise _DamageError(batch[max(container, 0)][1], f"a container holds {what}")
            tail = data[end:]
        if tail.strip(b"\0"):
            raise _DamageError(file.tell(), "the last object is cut")
        if size >= file.tell() + _LONGEST_PADDING:
            raise _DamageError(file.tell(), f"the file ends, but its header says {size} bytes")
    except _DamageError as damage:
        raise LogError(
            f"{name}: truncated or damaged BLF: {damage}; {sum(map(len, parts))} frames before it are readable; "
            f"copy the file again, or save the readable part with the tool that recorded it"
        ) from None
    return concatenate_frames(parts)


def _batches(file: BinaryIO) -> Iterator[list[tuple[bytes, int]]]:
    """Yield what :func:`_containers` yields, in lists with :data:`BATCH_BYTES` or more of content.

    If the file is damaged, the containers before the damage are yielded before the error is raised.
    """
    batch: list[tuple[bytes, int]] = []
    try:
        for container in _containers(file):
            batch.append(container)
            if sum(len(content) for content, _ in batch) >= BATCH_BYTES:
                yield batch
                batch = []
    except _DamageError:
        if batch:
            yield batch
        raise
    if batch:
        yield batch


def _file_header(file: BinaryIO, name: str) -> tuple[int, int]:
    """Read the header; return the file size that it states (0: none), and the start in ns since 1970 (0: no date)."""
    head = file.read(_FILE_HEADER_BYTES)
    if head[:4] != b"LOGG":
        raise LogError(
            f"{name}: not a BLF log, which begins with 'LOGG' (found {head[:4]!r}); give the file the suffix of its "
            f"format, or copy it again"
        )
    if len(head) < _FILE_HEADER_BYTES:
        raise _DamageError(0, f"a header of {_FILE_HEADER_BYTES} bytes is expected, found {len(head)}")
    _, length, size, year, month, _, day, hour, minute, second, milliseconds = _FILE_HEADER.unpack_from(head)
    if not _FILE_HEADER_BYTES <= length <= LARGEST_OBJECT:
        raise _DamageError(4, f"the size of the header is {length}")
    file.read(length - _FILE_HEADER_BYTES)
    try:
        start_s = int(datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp())
    except ValueError:  # the header has no valid date
        return size, 0
    start_ns = max(start_s, 0) * 10**9 + milliseconds * 10**6
    return size, start_ns if start_ns <= LATEST_TIME_STAMP_NS else 0


def _containers(file: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Yield the content of each container, and the byte at which the container starts."""
    position = file.tell()
    while head := file.read(_OBJECT_HEADER_BYTES):
        if len(head) < _OBJECT_HEADER_BYTES:
            raise _DamageError(position, "the file ends inside an object's header")
        signature, _, _, length, kind = _OBJECT_HEADER.unpack(head)
        if signature != b"LOBJ" or not _OBJECT_HEADER_BYTES <= length <= LARGEST_OBJECT:
            raise _DamageError(position, f"'LOBJ' and a size are expected, found {signature!r} and {length}")
        content = file.read(length - _OBJECT_HEADER_BYTES)
        if len(content) < length - _OBJECT_HEADER_BYTES:
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
    stream = isal_zlib.decompressobj()
    try:
        text: bytes = stream.decompress(body, LARGEST_OBJECT)
    except UNREADABLE as error:
        raise _DamageError(position, f"a container cannot be decompressed ({error})") from None
    if not stream.eof:
        raise _DamageError(position, "a compressed container is not complete")
    return text


class _Numbers(NamedTuple):
    """Views of n bytes, shape (n,): element k is the little-endian number of 1, 2, 4 or 8 bytes from byte k on."""

    u8: NDArray[np.uint8]
    u16: NDArray[np.uint16]
    u32: NDArray[np.uint32]
    u64: NDArray[np.uint64]

    @classmethod
    def of(cls, content: bytes) -> "_Numbers":
        """View a copy of the bytes, followed by zeros so that the last numbers can be read."""
        padded, n = content + bytes(8), len(content)
        return cls(*(np.ndarray((n,), kind, padded, strides=(1,)) for kind in ("<u1", "<u2", "<u4", "<u8")))


@compiled
def _take_apart(  # noqa: PLR0912, PLR0915 (see below)
    data: _Numbers, start_ns: int, columns: FrameColumns
) -> tuple[int, int, int, int]:
    """Parse objects, and fill one row of `columns` per frame.

    Returns how parsing ended (such as ``_SOUND``), the number of rows filled, the byte at which the unparsed rest
    begins, and the size of an impossible object (0: none). All is one function with a name for each array: arrays
    passed to another function, or taken out of a tuple, would be reference-counted in each round of the loop, which
    takes seven times as long as the parsing itself.
    """
    u8, u16, u32, u64 = data
    kinds, time_ns, keys, channels, lengths, payloads = columns
    here, row, n = 0, 0, len(u8)
    while True:
        at = here
        while at - here <= _LONGEST_PADDING and at + 4 <= n and u32[at] != _SIGNATURE:
            at += 1
        if at - here > _LONGEST_PADDING or at + 4 > n:
            lost = here + 2 * _LONGEST_PADDING <= n
            return (_NO_OBJECT if lost else _SOUND), row, here, 0
        if at + _OBJECT_HEADER_BYTES > n:
            return _SOUND, row, here, 0
        version, size, kind = u16[at + 6], _integer(u32[at + 8]), u32[at + 12]
        is_frame = kind in (_CLASSIC, _CLASSIC_2, _FD, _FD_64)
        fields = 8 if kind in (_CLASSIC, _CLASSIC_2) else 20 if kind == _FD else 40
        known = version in (1, 2)
        body = 32 if version == 1 else 40
        least = _OBJECT_HEADER_BYTES if not known else body + fields if is_frame else 32
        if size < least or size > LARGEST_OBJECT:
            return _IMPOSSIBLE, row, here, size
        if at + size > n:
            return _SOUND, row, here, 0
        if is_frame and not known:
            kinds[row] = DAMAGED
            row += 1
        elif is_frame:
            b = at + body
            if fields == 40:  # CAN FD 64
                channel, code, length = _integer(u8[b]), _integer(u8[b + 1]), _integer(u8[b + 2])
                flags, extension = u32[b + 12], _integer(u8[b + 35])
                remote, fd = flags & 0x10 > 0, flags & 0x1000 > 0
                have = (extension if extension > 0 else size) - fields - body
            else:
                channel, code = _integer(u16[b]), _integer(u8[b + 3])
                remote, fd = u8[b + 2] & 0x80 > 0, fields == 20 and u8[b + 13] & 1 > 0
                length = _integer(u8[b + 14]) if fields == 20 else min(code, CLASSIC_BYTES)
                have = size - fields - body
            unit = _TEN_MICROSECONDS_NS if u32[at + 16] == _TEN_MICROSECONDS else 1
            sound = length <= FD_BYTES if fd else length == min(code, CLASSIC_BYTES)
            if remote:
                kinds[row] = REMOTE
            elif not sound or u64[at + 24] > np.uint64(max(LATEST_TIME_STAMP_NS - start_ns, 0) // unit):
                kinds[row] = DAMAGED
            elif length > payloads.shape[1]:
                return _WIDE, row, here, 0
            else:
                kinds[row] = DATA
                for k in range(min(length, have)):
                    payloads[row, k] = u8[b + fields + k]
                time_ns[row] = start_ns + np.int64(u64[at + 24]) * unit
                keys[row] = u32[b + 4] & np.uint32(LARGEST_IDENTIFIER | EXTENDED_BIT)
                channels[row], lengths[row] = channel, length
            row += 1
        elif kind in (_ERROR, _ERROR_EXT, _ERROR_FD):
            kinds[row] = ERROR
            row += 1
        here = at + size


@inner
def _integer(number: np.unsignedinteger) -> int:
    """Make a number signed: numba would turn a mix of unsigned and signed integers into floating point."""
    return int(np.int64(number))
