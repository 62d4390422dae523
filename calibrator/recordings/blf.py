"""Check of a BLF file's structure, so that reading it ends and a cut is noticed.

A BLF file is a header ``LOGG`` and objects ``LOBJ``, each with its own size; most are containers, whose content, often
compressed, is again objects. A size of zero makes a reader go round for ever, and a file cut inside a container reads
as a shorter one without any error: both are found here before the file is read.
"""

import struct
import zlib
from typing import BinaryIO

from calibrator.errors import LogError

__all__ = ["check_blf"]

_FILE_HEADER = struct.Struct("<4sL8xQ")
"""Signature, size of the header, size of the file."""
_FILE_HEADER_BYTES = 144
_OBJECT_HEADER = struct.Struct("<4sHHLL")
"""Signature, size and version of the header, size of the object, type."""
_SMALLEST_OBJECT = 32
"""An object of header version 1 or 2 without content."""
_LARGEST_OBJECT = 1 << 28
"""Containers have some 128 KiB; a larger size is damage."""
_CONTAINER = 10
_CONTAINER_HEADER_BYTES = 16
_DEFLATE = 2
_CAN_TYPES = frozenset({1, 73, 86, 100, 101})
_LONGEST_PADDING = 8


class _DamageError(Exception):
    """What is wrong, and at which byte of the file."""

    def __init__(self, byte: int, text: str) -> None:
        super().__init__(f"at byte {byte} {text}")


def check_blf(file: BinaryIO, name: str) -> None:
    """Check that a BLF file is whole.

    Parameters
    ----------
    file : binary file
        The (uncompressed) content, at its start.
    name : str
        The file's name, for the message.

    Raises
    ------
    LogError
        If the file is no BLF file, is cut, or has an object of impossible size; the message gives the byte, what was
        expected there, and how many frames come before.
    """
    counter = _FrameCounter()
    try:
        _check(file, counter)
    except _DamageError as damage:
        raise LogError(
            f"{name}: truncated or damaged BLF: {damage}; {counter.frames} frames before it are readable; "
            f"copy the file again, or save the readable part with the tool that recorded it"
        ) from None


def _check(file: BinaryIO, counter: "_FrameCounter") -> None:
    size = _check_file_header(file)
    position = file.tell()
    while head := file.read(_OBJECT_HEADER.size):
        if len(head) < _OBJECT_HEADER.size:
            raise _DamageError(position, "the file ends inside an object's header")
        signature, _, _, length, kind = _OBJECT_HEADER.unpack(head)
        if signature != b"LOBJ" or not _OBJECT_HEADER.size <= length <= _LARGEST_OBJECT:
            raise _DamageError(position, f"'LOBJ' and a size are expected, found {signature!r} and {length}")
        content = file.read(length - _OBJECT_HEADER.size)
        if len(content) < length - _OBJECT_HEADER.size:
            raise _DamageError(position, f"an object of {length} bytes starts, but the file ends before")
        file.read(length % 4)
        if kind == _CONTAINER:
            counter.count(_container_content(content, position), position)
        position += length + length % 4
    if counter.tail.strip(b"\0"):
        raise _DamageError(position, "the last object is cut")
    if size > position:
        raise _DamageError(position, f"the file ends, but its header says {size} bytes")


def _check_file_header(file: BinaryIO) -> int:
    """Go behind the header and return the size of the file that it states, 0 if unknown."""
    head = file.read(_FILE_HEADER_BYTES)
    if len(head) < _FILE_HEADER_BYTES or head[:4] != b"LOGG":
        raise _DamageError(0, f"the header 'LOGG' of {_FILE_HEADER_BYTES} bytes is expected, found {head[:4]!r}")
    _, length, size = _FILE_HEADER.unpack_from(head)
    if not _FILE_HEADER_BYTES <= length <= _LARGEST_OBJECT:
        raise _DamageError(4, f"the size of the header is {length}")
    file.read(length - _FILE_HEADER_BYTES)
    return int(size)


def _container_content(content: bytes, position: int) -> bytes:
    if len(content) < _CONTAINER_HEADER_BYTES:
        raise _DamageError(position, "a container has no header")
    body = content[_CONTAINER_HEADER_BYTES:]
    if int.from_bytes(content[:2], "little") != _DEFLATE:
        return body
    stream = zlib.decompressobj()
    try:
        text = stream.decompress(body, _LARGEST_OBJECT)
    except zlib.error as error:
        raise _DamageError(position, f"a container cannot be decompressed ({error})") from None
    if not stream.eof:
        raise _DamageError(position, "a compressed container is not complete")
    return text


class _FrameCounter:
    """Walks the objects of the containers, which may go over from one container into the next."""

    def __init__(self) -> None:
        self.frames = 0
        self.tail = b""

    def count(self, content: bytes, position: int) -> None:
        data = self.tail + content
        here = 0
        while (start := data.find(b"LOBJ", here, here + _LONGEST_PADDING)) >= 0:
            if start + _OBJECT_HEADER.size > len(data):
                break
            _, _, version, length, kind = _OBJECT_HEADER.unpack_from(data, start)
            if not (_SMALLEST_OBJECT if version in {1, 2} else _OBJECT_HEADER.size) <= length <= _LARGEST_OBJECT:
                raise _DamageError(position, f"a container holds an object of {length} bytes")
            if start + length > len(data):
                break
            self.frames += kind in _CAN_TYPES
            here = start + length
        else:
            if here + _LONGEST_PADDING <= len(data):
                raise _DamageError(position, "a container holds something that is no object")
        self.tail = data[here:]
