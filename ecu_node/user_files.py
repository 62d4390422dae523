"""Files that a user names: regular ones of a bearable size are read, and nothing else is opened; written whole.

A pipe would keep the reader waiting, a device would never end.
"""

import hashlib
import os
import stat
import tempfile
from pathlib import Path

from ecu_node.errors import UserError

__all__ = ["UnsuitableFileError", "read_user_file", "text_digest", "write_atomically"]

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


class UnsuitableFileError(UserError):
    """What a name leads to is no regular file, or too large; the message says what it is."""


def _require_suitable(found: os.stat_result, largest_bytes: int) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = next((name for is_kind, name in _KINDS if is_kind(found.st_mode)), "no regular file")
        raise UnsuitableFileError(f"it is {kind}; a file is expected")
    if found.st_size > largest_bytes:
        raise _too_large(largest_bytes)


def read_user_file(path: Path, *, largest_bytes: int) -> bytes:
    """Read a file; what is no regular one is not opened.

    Parameters
    ----------
    path : Path
        As the user wrote it.
    largest_bytes : int
        Size that is still accepted. [byte]

    Returns
    -------
    bytes
        Its content.

    Raises
    ------
    UnsuitableFileError
        If it is something else, or larger; its text is to stand behind the name of the file.
    OSError
        If there is no such file, or it cannot be read.
    """
    _require_suitable(path.stat(), largest_bytes)
    with open(path, "rb", opener=_open_without_waiting) as file:
        _require_suitable(os.fstat(file.fileno()), largest_bytes)  # the folder's owner may have put another one there
        content = file.read(largest_bytes + 1)  # the kernel's own files have no size
    if len(content) > largest_bytes:
        raise _too_large(largest_bytes)
    return content


def _open_without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)


def text_digest(content: bytes) -> str:
    """SHA-256 of a text, the same for LF and CRLF line ends."""
    return hashlib.sha256(content.replace(b"\r\n", b"\n")).hexdigest()


def _too_large(largest_bytes: int) -> UnsuitableFileError:
    return UnsuitableFileError(f"it is larger than {largest_bytes} bytes, which no such file is")


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file by new content; after a power cut either the old or the new one stands there."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
