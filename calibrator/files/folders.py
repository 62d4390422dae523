"""Write files and folders so that they appear only when they are complete, and leave nothing incomplete on failure."""

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from glob import escape
from pathlib import Path

from calibrator.errors import FleetError
from calibrator.files.storage import DISK_FULL
from ecu_node.documents import write_atomically
from ecu_node.errors import UserError

__all__ = ["require_new_folder", "require_possible_file", "require_possible_folder", "whole_folder", "write_files"]


def require_possible_folder(out: Path) -> None:
    """Raise FleetError, before any work is done, if a folder cannot be made, or exists and cannot be written to.

    Access rights alone do not tell (a read-only disk, /proc), so a folder is made for a moment.
    """
    _require_possible(out.absolute(), out)


def require_possible_file(out: Path) -> None:
    """Raise FleetError, before any work is done, if a file cannot be written or replaced.

    Folders, links, devices, pipes and sockets are refused: writing would replace a link, not the file that it points
    to; and a device, pipe or socket would be replaced by a file.
    """
    if out.is_symlink():
        raise FleetError(f"{out}: is a link, so it cannot be replaced; name the file itself or another one")
    if out.is_dir():
        raise FleetError(f"{out}: is a folder; name a file in it")
    if out.exists() and not out.is_file():
        raise FleetError(f"{out}: is no file but a device, pipe or socket, which would be replaced; name a file")
    _require_possible(out.absolute().parent, out)


def require_new_folder(out: Path) -> None:
    """Raise FleetError if a folder to be written exists and is not empty, or cannot be made or replaced."""
    if out.is_symlink():
        raise FleetError(f"{out}: is a link, so it cannot be replaced; name the folder itself or choose another --out")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FleetError(f"{out}: exists and is not empty; choose another --out or remove it")
    if out.is_mount():
        raise FleetError(f"{out}: a disk is mounted there, so it cannot be replaced; choose a folder in it")
    _require_possible(_partial(out), out)


def _partial(out: Path) -> Path:
    """Return the hidden folder, beside the one wanted, that is filled before it is renamed."""
    out = out.absolute()
    return out.with_name(f".{out.name}.partial-{os.getpid()}")


def _require_possible(folder: Path, out: Path) -> None:
    """Raise FleetError, which names `out`, unless a trial inside a hidden folder shows that `folder` can be made."""
    if out.parts and out.parts[0].endswith(":"):
        raise FleetError(f"{out}: is a URL; name a folder of this machine, as nothing else can be written to")
    nearest = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
    if not nearest.is_dir():
        raise FleetError(f"{out}: cannot be made: {nearest} is a file; choose another folder")
    try:
        with tempfile.TemporaryDirectory(prefix=".trial-", dir=nearest) as trial:
            (Path(trial) / folder.relative_to(nearest)).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FleetError(f"{out}: nothing can be made in {nearest}: {error.strerror}; choose another folder") from None


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """Yield a hidden folder beside the one wanted, to be filled, and rename it when the block ends without error.

    Parameters
    ----------
    out : Path
        New or empty folder.

    Yields
    ------
    Path
        Folder to fill. It is removed if the block fails; one that a killed process left is removed by the next run. If
        it cannot be renamed, it stays, and the error names it.

    Raises
    ------
    FleetError
        If `out` is not empty, a link or a mount point, if it cannot be made or replaced, or if the disk is full.
    """
    require_new_folder(out)
    out, partial = out.absolute(), _partial(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        for left in out.parent.glob(f".{escape(out.name)}.partial-*"):
            if not Path("/proc", left.name.rpartition("-")[2]).exists():  # the process that made it is gone
                shutil.rmtree(left, ignore_errors=True)
        partial.mkdir()
    except OSError as error:
        raise FleetError(f"{out}: cannot be made: {error.strerror}; choose another folder") from None
    try:
        yield partial
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError) and error.errno in DISK_FULL:  # libraries leave out the name of the file
            where, reason = error.filename or out, os.strerror(error.errno)
            raise FleetError(f"{where}: cannot write it: {reason}; make room, or choose another --out") from None
        raise
    try:
        if out.exists():
            out.rmdir()
        partial.rename(out)
    except OSError as error:
        raise FleetError(f"{out}: cannot be replaced: {error.strerror}; what was made stands in {partial}") from None


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write files, each whole or not at all; folders are made if needed, files that exist are replaced.

    Raises
    ------
    UserError
        If a file cannot be written; the message names it. Files before it have been written.
    """
    for path, content in files.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content)
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror}; make room or choose another place") from None
