"""Files that a power cut must not spoil: replaced whole, or added to at the end."""

import errno
import fcntl
import os
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ecu_node.errors import UserError

__all__ = ["append_line", "locked", "move_file", "replace_file", "write_file"]

_CAREFUL = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
"""Root writes into a folder that belongs to the node: a link there leads it nowhere, and no pipe keeps it waiting."""
_MODE = 0o644
LONGEST_WAIT_S = 30.0
"""For another process; one that was stopped never ends. [s]"""
MOMENT_S = 1.0
"""So long it is not told that a process waits. [s]"""
_ASK_EVERY_S = 0.01
"""[s]"""


def replace_file(path: Path, content: bytes) -> None:
    """Put new content in the place of a file: after a power cut either the old or the new one stands there, whole.

    Parameters
    ----------
    path : Path
        The file; only one process at a time may replace it, see :func:`locked`.
    content : bytes
        What is to stand there.

    Raises
    ------
    UserError
        If it cannot be written; the file is as before, unless the message says that it may not outlast a power cut.
    """
    temporary = path.with_name(f".{path.name}.new")
    write_file(temporary, content)
    move_file(temporary, path)


def write_file(path: Path, content: bytes) -> None:
    """Write a file that a power cut may leave half written.

    Parameters
    ----------
    path : Path
        The file; what stood there is gone.
    content : bytes
        What is to stand there, on the disk when this returns.

    Raises
    ------
    UserError
        If it cannot be written; no file is left.
    """
    try:
        path.unlink(missing_ok=True)
        handle = _open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        try:
            _write(handle, content)
        finally:
            os.close(handle)
        _sync_folder(path.parent)
    except OSError as error:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        raise _not_written(path, error) from None


def move_file(source: Path, target: Path) -> None:
    """Put a whole file in the place of another one, in one step.

    Parameters
    ----------
    source, target : Path
        In the same folder.

    Raises
    ------
    UserError
        If it cannot be done, or the disk does not say that it will last.
    """
    try:
        source.replace(target)
    except OSError as error:
        raise _not_written(target, error) from None
    try:
        _sync_folder(target.parent)
    except OSError as error:
        raise UserError(
            f"{target}: is written, but may not outlast a power cut: {error.strerror}; look at it with "
            f"'ecu-node inspect'"
        ) from None


def append_line(path: Path, line: bytes) -> None:
    """Add a line to a file; what a power cut left of a line before it becomes a line of its own.

    Parameters
    ----------
    path : Path
        The file; made if there is none.
    line : bytes
        Without its end.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    try:
        handle = _open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND)
        try:
            size = os.fstat(handle).st_size
            is_whole = size == 0 or os.pread(handle, 1, size - 1) == b"\n"
            _write(handle, (b"" if is_whole else b"\n") + line + b"\n")
        finally:
            os.close(handle)
        if size == 0:
            _sync_folder(path.parent)
    except OSError as error:
        raise _not_written(path, error) from None


@contextmanager
def locked(folder: Path, *, wait: bool = True, on_wait: Callable[[str], None] | None = None) -> Iterator[None]:
    """Keep other processes from changing a folder.

    Parameters
    ----------
    folder : Path
        It must exist.
    wait : bool
        For a while, until no other process changes it; else that is an error at once.
    on_wait : callable or None
        Takes one line for the user, once, if that takes more than a moment.

    Raises
    ------
    UserError
        If there is no such folder, it must not be written, or another process changes it now.
    """
    try:
        handle = _open(folder / "lock", os.O_RDWR | os.O_CREAT)
    except OSError as error:
        raise _unusable(folder, error) from None
    try:
        _lock(folder, handle, wait=wait, on_wait=on_wait)
        yield
    finally:
        os.close(handle)


def _lock(folder: Path, handle: int, *, wait: bool, on_wait: Callable[[str], None] | None) -> None:
    start_s = time.monotonic()
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if not wait:
                raise UserError(f"{folder}: another process changes it now") from None
        except OSError as error:
            raise _unusable(folder, error) from None
        else:
            return
        waited_s = time.monotonic() - start_s
        if waited_s >= LONGEST_WAIT_S:
            raise UserError(f"{folder}: another process changes it now; try again")
        if on_wait is not None and waited_s >= MOMENT_S:
            on_wait(f"{folder}: another process changes it now; waiting for it, {LONGEST_WAIT_S:g} s at most")
            on_wait = None
        time.sleep(_ASK_EVERY_S)


def _unusable(folder: Path, error: OSError) -> UserError:
    is_none = error.errno in (errno.ENOENT, errno.ENOTDIR)
    advice = "; name a folder made by 'ecu-node provision'" if is_none else ""
    return UserError(f"{folder}: cannot be used as state: {error.strerror}{advice}")


def _not_written(path: Path, error: OSError) -> UserError:
    return UserError(f"{path}: cannot be written: {error.strerror}")


def _open(path: Path, flags: int) -> int:
    """Open a file that is this folder's own, and belongs to whom the folder belongs to: the node goes on with it."""
    handle = os.open(path, flags | _CAREFUL, _MODE)
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "it is no file; remove it")
        owner = path.parent.stat()
        if os.geteuid() == 0 and (found.st_uid, found.st_gid) != (owner.st_uid, owner.st_gid):
            if found.st_nlink != 1:
                raise OSError(errno.EPERM, "it is another name of somebody else's file; remove it")
            os.fchown(handle, owner.st_uid, owner.st_gid)
    except BaseException:
        os.close(handle)
        raise
    return handle


def _write(handle: int, content: bytes) -> None:
    done = 0
    while done < len(content):
        done += os.write(handle, content[done:])
    os.fsync(handle)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
