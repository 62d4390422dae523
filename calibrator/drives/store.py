"""Drives on disk: ``STORE/drives/VEHICLE/DRIVE.parquet``."""

from collections.abc import Callable, Iterator
from pathlib import Path

from calibrator.drive import Drive, DriveFile
from calibrator.drives.drive_file import encode_drive, read_drive_file, require_made_with
from calibrator.drives.plain_names import require_plain_name
from calibrator.errors import DriveError
from ecu_node.documents import write_atomically
from ecu_node.errors import UserError
from ecu_node.layout import Layout

__all__ = ["has_drive", "iterate_drives", "list_drives", "write_drive"]

_FOLDER = "drives"


def write_drive(store: Path, drive: Drive, layout: Layout) -> Path:
    """Write one drive into a store, whole or not at all; an older drive of the same name is replaced.

    Parameters
    ----------
    store : Path
        Folder of the store; made if needed.
    drive : Drive
        The drive.
    layout : Layout
        The layout it was made with.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    DriveError
        If vehicle or drive has a name that is no file name, or the folder cannot be written.
    """
    require_plain_name(drive.vehicle, "vehicle")
    require_plain_name(drive.name, f"vehicle {drive.vehicle}: drive")
    path = _path(store, drive.vehicle, drive.name)
    content = encode_drive(drive, layout)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)
    except OSError as error:
        raise DriveError(f"{path}: cannot write the drive: {error.strerror}; choose another folder") from None
    return path


def has_drive(store: Path, vehicle: str, name: str, layout: Layout) -> bool:
    """Whether a store has a drive already.

    Parameters
    ----------
    store : Path
        Folder of the store; there need not be one.
    vehicle, name : str
        Whose drive, and which.
    layout : Layout
        The layout it must have been made with.

    Returns
    -------
    bool
        True if it is there and was made with this layout and DBC.

    Raises
    ------
    DriveError
        If it is there, but is damaged or was made with another layout or DBC.
    """
    path = _path(store, vehicle, name)
    if not path.exists():
        return False
    require_made_with(path, layout)
    return True


def list_drives(store: Path) -> list[DriveFile]:
    """List the drives of a store, sorted by vehicle and name.

    Parameters
    ----------
    store : Path
        Folder of the store.

    Returns
    -------
    list of DriveFile
        What is there; nothing is opened.

    Raises
    ------
    DriveError
        If the folder is no store.
    """
    folder = store / _FOLDER
    if not folder.is_dir():
        raise DriveError(f"{store}: not a drive store: no folder '{_FOLDER}' in it; make one with 'calibrator import'")
    paths = sorted(folder.glob("*/[!.]*.parquet"), key=lambda path: (path.parent.name, path.stem))
    return [DriveFile(vehicle=path.parent.name, name=path.stem, path=path) for path in paths]


def iterate_drives(
    store: Path, layout: Layout, *, on_error: Callable[[UserError], None] | None = None
) -> Iterator[Drive]:
    """Read the drives of a store one after the other.

    Parameters
    ----------
    store : Path
        Folder of the store.
    layout : Layout
        The layout it must have been made with.
    on_error : callable, optional
        Called with the error of a file that cannot be used, which is then left out; by default it is raised.

    Yields
    ------
    Drive
        In the order of :func:`list_drives`.

    Raises
    ------
    DriveError
        If the folder is no store; also as :func:`.read_drive_file` if `on_error` is not given.
    """
    for entry in list_drives(store):
        try:
            yield read_drive_file(entry.path, layout)
        except UserError as error:
            if on_error is None:
                raise
            on_error(error)


def _path(store: Path, vehicle: str, name: str) -> Path:
    return store / _FOLDER / vehicle / f"{name}.parquet"
