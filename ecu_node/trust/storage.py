"""Files that a power cut must not spoil: replaced whole, or added to at the end."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ecu_node.errors import UserError

__all__ = ["append_line", "locked", "move_file", "replace_file", "write_file"]

_CAREFUL = os.O_CLOEXEC | os.O_NOFOLLOW
"""Root writes into a folder that belongs to the node: a link there must not lead it to another file."""
_MODE = 0o644


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
        _write(path, content, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
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
        start = b"" if _ends_whole(path) else b"\n"
        _write(path, start + line + b"\n", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    except OSError as error:
        raise _not_written(path, error) from None


@contextmanager
def locked(folder: Path, *, wait: bool = True) -> Iterator[None]:
    """Keep other processes from changing a folder.

    Parameters
    ----------
    folder : Path
        It must exist.
    wait : bool
        Until no other process changes it; else that is an error.

    Raises
    ------
    UserError
        If there is no such folder, it must not be written, or another process changes it now.
    """
    try:
        handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | _CAREFUL, _MODE)
    except OSError as error:
        raise _unusable(folder, error) from None
    try:
        _lock(folder, handle, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


def _lock(folder: Path, handle: int, how: int) -> None:
    try:
        _give_to_owner_of(folder, handle)
        fcntl.flock(handle, how)
    except BlockingIOError:
        raise UserError(f"{folder}: another process changes it now; try again") from None
    except OSError as error:
        raise _unusable(folder, error) from None


def _unusable(folder: Path, error: OSError) -> UserError:
    return UserError(f"{folder}: cannot be used as state: {error.strerror}; name a folder made by 'ecu-node provision'")


def _not_written(path: Path, error: OSError) -> UserError:
    return UserError(f"{path}: cannot be written: {error.strerror}")


def _write(path: Path, content: bytes, flags: int) -> None:
    handle = os.open(path, flags | _CAREFUL, _MODE)
    try:
        _give_to_owner_of(path.parent, handle)
        done = 0
        while done < len(content):
            done += os.write(handle, content[done:])
        os.fsync(handle)
    finally:
        os.close(handle)


def _give_to_owner_of(folder: Path, handle: int) -> None:
    """What root writes belongs to whom the folder belongs to: the node, which must be able to go on with it."""
    if os.geteuid() == 0:
        owner = folder.stat()
        os.fchown(handle, owner.st_uid, owner.st_gid)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _ends_whole(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            if file.tell() == 0:
                return True
            file.seek(-1, os.SEEK_END)
            return file.read(1) == b"\n"
    except FileNotFoundError:
        return True
