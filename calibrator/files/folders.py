"""Files and folders that appear only when they are complete, and what is left of none that could not be written."""

import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from calibrator.errors import FleetError
from ecu_node.errors import UserError

__all__ = [
    "made_folder",
    "remove_abandoned",
    "require_new_folder",
    "require_own_file",
    "require_possible_file",
    "require_possible_folder",
    "whole_folder",
    "write_files",
]

_PARTIAL = re.compile(r"\.(?P<name>.+)\.partial-(?P<process>[0-9]+)")
"""Name of a file while it is written: whose it is, and by which process."""
_MODE = 0o644


def require_possible_folder(out: Path) -> None:
    """Raise FleetError, before any work is done, if a folder neither exists nor can be made, or nothing can be in it.

    Rights alone do not tell (a read-only disk, /proc), so a folder is made for a moment.
    """
    _require_possible(out.absolute(), out)


def require_possible_file(out: Path) -> None:
    """Raise FleetError, before any work is done, if a file cannot be written or replaced."""
    if out.is_dir():
        raise FleetError(f"{out}: is a folder; name a file in it")
    if out.exists() and not out.is_file():
        raise FleetError(f"{out}: is no file but a device, pipe or socket, which would be replaced; name a file")
    require_possible_folder(out.absolute().parent)


def require_new_folder(out: Path) -> None:
    """Raise FleetError if a folder to be written exists and holds something, or cannot be made or replaced."""
    if out.is_symlink():
        raise FleetError(f"{out}: is a link, so it cannot be replaced; name the folder itself or choose another --out")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FleetError(f"{out}: exists and is not empty; choose another --out or remove it")
    if out.is_mount():
        raise FleetError(f"{out}: a disk is mounted there, so it cannot be replaced; choose a folder in it")
    _require_possible(_partial(out), out)


def _partial(out: Path) -> Path:
    """Where a folder is filled: beside it, hidden."""
    out = out.absolute()
    return out.with_name(f".{out.name}.partial-{os.getpid()}")


def _require_possible(folder: Path, out: Path) -> None:
    """Make a folder in a hidden one, and remove both; `out` is what the user calls it."""
    nearest = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
    if not nearest.is_dir():
        raise FleetError(f"{out}: cannot be made: {nearest} is a file; choose another folder")
    try:
        with TemporaryDirectory(prefix=".trial-", dir=nearest) as trial:
            (Path(trial) / folder.relative_to(nearest)).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FleetError(f"{out}: nothing can be made in {nearest}: {error.strerror}; choose another folder") from None


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """Fill a hidden folder beside the one wanted, and rename it when the block ends well.

    Parameters
    ----------
    out : Path
        New or empty folder.

    Yields
    ------
    Path
        Folder to fill. It is removed if the block fails; one that a killed process left is removed by the next run. If
        it cannot be renamed, it stays and is named.

    Raises
    ------
    FleetError
        If the folder is not empty or cannot be made.
    """
    require_new_folder(out)
    out, partial = out.absolute(), _partial(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(out)
        partial.mkdir()
    except OSError as error:
        raise FleetError(f"{out}: cannot be made: {error.strerror}; choose another folder") from None
    try:
        yield partial
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    try:
        if out.exists():
            out.rmdir()
        partial.rename(out)
    except OSError as error:
        raise FleetError(f"{out}: cannot be replaced: {error.strerror}; what was made stands in {partial}") from None


def _remove_abandoned(out: Path) -> None:
    """Remove what processes that are gone have left."""
    for left in out.parent.glob(f".{out.name}.partial-*"):
        number = left.name.rpartition("-")[2]
        if number.isdecimal() and not _is_running(int(number)):
            shutil.rmtree(left, ignore_errors=True)


def require_own_file(path: Path) -> None:
    """Refuse, before anything is written, a name that leads to something else than a regular file of that name.

    Parameters
    ----------
    path : Path
        File to be written or replaced; there may be none yet.

    Raises
    ------
    FleetError
        If it is a link, which would be replaced and not what it leads to; or a folder, device or pipe.
    """
    if path.is_symlink():
        raise FleetError(f"{path}: is a link, so it cannot be replaced; name the file itself or another one")
    if path.is_dir():
        raise FleetError(f"{path}: is a folder; name a file in it")
    if path.exists() and not path.is_file():
        raise FleetError(f"{path}: is no regular file; name another one")


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder, and those above it that are missing; if the block fails, remove those of them that are empty.

    Parameters
    ----------
    folder : Path
        New or not.

    Raises
    ------
    FleetError
        If it cannot be made.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FleetError(f"{folder}: cannot be made: {error.strerror}; choose another folder") from None
        yield
    except BaseException:
        for path in missing:
            with suppress(OSError):
                path.rmdir()
        raise


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write files that belong together: all of them beside their places first, hidden, and then into their places.

    Parameters
    ----------
    files : mapping of Path to bytes
        Contents; folders must exist, files that exist are replaced.

    Raises
    ------
    UserError
        If one cannot be written; it is named, and none of them has changed.
    """
    partial: dict[Path, Path] = {}
    path = None
    try:
        for path, content in files.items():
            partial[path] = path.with_name(f".{path.name}.partial-{os.getpid()}")
            _write(partial[path], content)
        for path, written in partial.items():
            written.replace(path)
    except BaseException as error:
        for left in partial.values():
            with suppress(OSError):
                left.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise UserError(f"{path}: cannot be written: {error.strerror}") from None
        raise


def _write(path: Path, content: bytes) -> None:
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _MODE), "wb") as file:
        file.write(content)
        file.flush()
        os.fchmod(file.fileno(), _MODE)
        os.fsync(file.fileno())


def remove_abandoned(files: Iterable[Path]) -> None:
    """Remove what processes that were killed have left of these files.

    Parameters
    ----------
    files : iterable of Path
        As :func:`write_files` was to write them.
    """
    names: dict[Path, set[str]] = {}
    for path in files:
        names.setdefault(path.parent, set()).add(path.name)
    for folder, wanted in names.items():
        with suppress(OSError):
            for left in list(folder.iterdir()):
                found = _PARTIAL.fullmatch(left.name)
                if found and found["name"] in wanted and not _is_running(int(found["process"])):
                    left.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
