"""Lines of a log of any length, from its begin or from its end, a block at a time."""

import hashlib
import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

from ecu_node.errors import UserError

__all__ = ["LogLine", "lines", "lines_from_the_end"]

_BLOCK = 8192
"""No line that is written is longer. [byte]"""


class LogLine(NamedTuple):
    """One line, without its end."""

    text: bytes
    """Of a line that is longer than any that is written, its begin alone."""
    digest: str
    """SHA-256 of all of it."""


def lines(path: Path) -> Iterator[LogLine]:
    """Lines of a file, the first one first.

    Parameters
    ----------
    path : Path
        The file; where there is none, there are no lines.

    Yields
    ------
    LogLine
        The last one also if its end is missing.

    Raises
    ------
    UserError
        If it cannot be read.
    """
    with _opened(path) as file:
        text, digest = b"", None
        while piece := file.readline(_BLOCK):
            part = piece.removesuffix(b"\n")
            if digest is None:
                text, digest = part, hashlib.sha256()
            digest.update(part)
            if piece.endswith(b"\n"):
                yield LogLine(text, digest.hexdigest())
                digest = None
        if digest is not None:
            yield LogLine(text, digest.hexdigest())


def lines_from_the_end(path: Path) -> Iterator[LogLine]:
    """Lines of a file, the last one first; parameters, values and errors as for :func:`lines`."""
    with _opened(path) as file:
        size = file.seek(0, os.SEEK_END)
        end = size - 1 if _read(file, size - 1, size) == b"\n" else size
        while size and end >= 0:
            start = _start(file, end)
            yield _line(file, start, end)
            end = start - 1


def _start(file: BinaryIO, end: int) -> int:
    """Where the line begins that ends there."""
    while end > 0:
        block_start = max(0, end - _BLOCK)
        newline = _read(file, block_start, end).rfind(b"\n")
        if newline >= 0:
            return block_start + newline + 1
        end = block_start
    return 0


def _line(file: BinaryIO, start: int, end: int) -> LogLine:
    digest = hashlib.sha256()
    for place in range(start, end, _BLOCK):
        digest.update(_read(file, place, min(end, place + _BLOCK)))
    return LogLine(_read(file, start, min(end, start + _BLOCK)), digest.hexdigest())


def _read(file: BinaryIO, start: int, end: int) -> bytes:
    file.seek(max(0, start))
    return file.read(end - start)


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)  # no waiting for a pipe
    except FileNotFoundError:
        yield io.BytesIO()
        return
    except OSError as error:
        raise UserError(f"{path}: cannot read the audit log: {error.strerror}") from None
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise UserError(f"{path}: cannot read the audit log: it is no file; remove it")
    with os.fdopen(handle, "rb") as file:
        try:
            yield file
        except OSError as error:
            raise UserError(f"{path}: cannot read the audit log: {error.strerror}") from None
