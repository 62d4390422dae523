"""Files that appear only when they are complete, and what is left of none that could not be written."""

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from calibrator.errors import FleetError
from ecu_node.errors import UserError

__all__ = ["made_folder", "remove_abandoned", "require_own_file", "write_files"]

_PARTIAL = re.compile(r"\.(?P<name>.+)\.partial-(?P<process>[0-9]+)")
"""Name of a file while it is written: whose it is, and by which process."""
_MODE = 0o644


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
