"""Drives on disk: ``STORE/drives/VEHICLE/DRIVE.parquet``, one row per channel.

Columns: ``name``, ``kind`` (branch or input), ``time_s`` and ``value`` (lists of float64), ``good`` (list of bool). The
file's metadata carries schema version, vehicle, drive, and name and digest of the layout, because branch names and
signs mean something only together with it.
"""

import hashlib
import io
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from calibrator.drive import Channel, Drive, DriveFile
from calibrator.errors import DriveError
from ecu_node.errors import UserError
from ecu_node.layout import Layout, file_digest
from ecu_node.user_files import write_atomically

__all__ = [
    "drive_digest",
    "drive_outline",
    "has_drive",
    "is_plain_name",
    "iterate_drives",
    "list_drives",
    "read_drive_file",
    "require_plain_name",
    "write_drive",
]

SCHEMA_VERSION = 1
_FOLDER = "drives"
_METADATA = b"calibrator.drive"
_PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+@ -]{0,63}")
"""Also a file name on every system, and short enough for the parameter file."""
_SCHEMA = pa.schema(
    [
        pa.field("name", pa.string(), nullable=False),
        pa.field("kind", pa.string(), nullable=False),
        pa.field("time_s", pa.list_(pa.float64()), nullable=False),
        pa.field("value", pa.list_(pa.float64()), nullable=False),
        pa.field("good", pa.list_(pa.bool_()), nullable=False),
    ]
)


def is_plain_name(name: str) -> bool:
    """Whether a vehicle or drive may have this name, see :func:`require_plain_name`."""
    return _PLAIN_NAME.fullmatch(name) is not None and not name.endswith((" ", "."))


def require_plain_name(name: str, what: str) -> None:
    """Refuse a vehicle or drive name that cannot be a file name everywhere.

    Parameters
    ----------
    name : str
        The name.
    what : str
        What is named so, the start of the message.

    Raises
    ------
    DriveError
        If the name is empty, longer than 64 characters, has other characters than A to Z, a to z, 0 to 9, ``_ . + @ -``
        and blanks, does not start with a letter, a digit or ``_``, or ends with a dot or a blank.
    """
    if not is_plain_name(name):
        raise DriveError(
            f"{what} {name[:80]!r} cannot be used; expected 1 to 64 letters A to Z, digits, blanks or _ . + @ -, "
            f"not starting with a dash, dot, +, @ or blank, not ending with a dot or blank; rename it"
        )


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
    buffer = io.BytesIO()
    pq.write_table(_table(drive, layout), buffer, compression="zstd", use_dictionary=False)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, buffer.getvalue())
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
    with _reading(path):
        _check_identity(_about(pq.read_schema(path)), path, layout)
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
        If the folder is no store; also as :func:`read_drive_file` if `on_error` is not given.
    """
    for entry in list_drives(store):
        try:
            yield read_drive_file(entry.path, layout)
        except UserError as error:
            if on_error is None:
                raise
            on_error(error)


def read_drive_file(path: Path, layout: Layout) -> Drive:
    """Read one drive.

    Parameters
    ----------
    path : Path
        A file of a store.
    layout : Layout
        The layout it must have been made with.

    Returns
    -------
    Drive
        The drive.

    Raises
    ------
    DriveError
        If the file is cut, no drive, of another version, or was made with another layout.
    """
    with _reading(path):
        table = pq.read_table(io.BytesIO(path.read_bytes()), use_threads=False)
        about = _about(table.schema)
        _check_identity(about, path, layout)
        rows = {(kind, name): channel for kind, name, channel in _channels(table)}
        vehicle, name = str(about["vehicle"]), str(about["drive"])
    return Drive(
        vehicle=vehicle,
        name=name,
        branches={key: channel for (kind, key), channel in rows.items() if kind == "branch"},
        inputs={key: channel for (kind, key), channel in rows.items() if kind == "input"},
    )


def drive_outline(path: Path) -> tuple[int, ...]:
    """Rows and sizes of a drive's columns, without reading them: different for different recordings, as a rule.

    Parameters
    ----------
    path : Path
        A file of a store.

    Returns
    -------
    tuple of int
        Numbers of the file's directory.

    Raises
    ------
    DriveError
        If the file is no drive.
    """
    with _reading(path):
        about = pq.read_metadata(path)
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        columns = [group.column(k) for group in groups for k in range(group.num_columns)]
    sizes = [size for column in columns for size in (column.total_compressed_size, column.total_uncompressed_size)]
    return (about.num_rows, *sizes)


def drive_digest(path: Path) -> bytes:
    """Digest of the channels of a drive, whatever its name and vehicle.

    Parameters
    ----------
    path : Path
        A file of a store.

    Returns
    -------
    bytes
        The same for the same recording.

    Raises
    ------
    DriveError
        If the file is cut or no drive.
    """
    digest = hashlib.blake2b()
    with _reading(path):
        for kind, name, channel in _channels(pq.read_table(path, use_threads=False)):
            digest.update(f"{kind} {name} {len(channel.time_s)}".encode())
            for values in (channel.time_s, channel.value, channel.good):
                digest.update(np.ascontiguousarray(values).tobytes())
    return digest.digest()


def _path(store: Path, vehicle: str, name: str) -> Path:
    return store / _FOLDER / vehicle / f"{name}.parquet"


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """What a damaged file makes pyarrow raise becomes a DriveError."""
    try:
        yield
    except OSError as error:
        raise DriveError(
            f"{path}: cannot read the drive: {error.strerror or 'damaged'}; remove it and import it again"
        ) from None
    except (pa.ArrowException, AttributeError, KeyError, TypeError, ValueError) as error:
        raise DriveError(
            f"{path}: not a drive: {str(error).splitlines()[0][:120]}; remove it and import it again"
        ) from None


def _about(schema: pa.Schema) -> dict[str, Any]:
    about: dict[str, Any] = json.loads((schema.metadata or {})[_METADATA])
    return about


def _table(drive: Drive, layout: Layout) -> pa.Table:
    kinds = [("branch", drive.branches), ("input", drive.inputs)]
    rows = [
        {"name": name, "kind": kind, "time_s": channel.time_s, "value": channel.value, "good": channel.good}
        for kind, channels in kinds
        for name, channel in channels.items()
    ]
    about = {
        "schema_version": SCHEMA_VERSION,
        "vehicle": drive.vehicle,
        "drive": drive.name,
        "layout": layout.name,
        "layout_sha256": layout.digest,
        "dbc_sha256": file_digest(layout.dbc_path),
    }
    table = pa.Table.from_pylist(rows, schema=_SCHEMA)
    return table.replace_schema_metadata({_METADATA: json.dumps(about)})


def _check_identity(about: Mapping[str, object], path: Path, layout: Layout) -> None:
    if about["schema_version"] != SCHEMA_VERSION:
        raise DriveError(
            f"{path}: schema version {about['schema_version']!r}, expected {SCHEMA_VERSION}; import the logs again"
        )
    if about["layout_sha256"] != layout.digest:
        raise DriveError(
            f"{path}: made with layout {about['layout']} ({str(about['layout_sha256'])[:12]}), this is {layout.path} "
            f"({layout.digest[:12]}); import the logs again with this layout"
        )
    if about.get("dbc_sha256") != file_digest(layout.dbc_path):
        raise DriveError(f"{path}: made with another DBC than {layout.dbc_path}; import the logs again with this DBC")


def _channels(table: pa.Table) -> Iterator[tuple[str, str, Channel]]:
    for row in range(table.num_rows):
        time_s, value, good = (_row(table, column, row) for column in ("time_s", "value", "good"))
        if not len(time_s) == len(value) == len(good):
            raise ValueError("a channel has columns of different lengths")
        channel = Channel(time_s=time_s.astype(np.float64), value=value.astype(np.float64), good=good.astype(np.bool_))
        yield table.column("kind")[row].as_py(), table.column("name")[row].as_py(), channel


def _row(table: pa.Table, column: str, row: int) -> "np.ndarray[tuple[int], np.dtype[np.generic]]":
    values: np.ndarray[tuple[int], np.dtype[np.generic]] = table.column(column)[row].values.to_numpy(
        zero_copy_only=False
    )
    return values
