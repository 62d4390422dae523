"""Write and read drives as files: ``STORE/drives/VEHICLE/DRIVE.parquet``, one row per channel.

Columns: ``name``, ``kind`` (branch or input), ``time_s`` and ``value`` (lists of float64), ``good`` (list of bool). The
file's metadata carries schema version, vehicle, drive, and name and digests of layout and DBC, because branch names and
signs mean something only together with these. A store is a folder or a place in object storage.
"""

import hashlib
import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from calibrator.drive import Channel, Drive, DriveFile
from calibrator.errors import DriveError
from calibrator.files.storage import Storage, open_storage
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout
from ecu_node.summary import SummaryFile, decode_summary

__all__ = [
    "DRIVES_FOLDER",
    "has_drive",
    "is_drive_file",
    "is_plain_name",
    "iterate_drives",
    "list_drives",
    "name_problem",
    "read_drive_file",
    "read_onboard_record",
    "recording_digest",
    "remove_leftovers",
    "require_plain_name",
    "write_drive",
]

DRIVES_FOLDER = "drives"
SCHEMA_VERSION = 1
_METADATA = b"calibrator.drive"
_SCHEMA = pa.schema(
    [
        pa.field("name", pa.string(), nullable=False),
        pa.field("kind", pa.string(), nullable=False),
        pa.field("time_s", pa.list_(pa.float64()), nullable=False),
        pa.field("value", pa.list_(pa.float64()), nullable=False),
        pa.field("good", pa.list_(pa.bool_()), nullable=False),
    ]
)
_PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+@ -]{0,63}")
"""Names that are also file names on every system, and short enough for the parameter file."""


def is_plain_name(name: str) -> bool:
    """Check whether a vehicle or drive may have this name, see :func:`require_plain_name`."""
    return _PLAIN_NAME.fullmatch(name) is not None and not name.endswith((" ", "."))


def name_problem(name: str, what: str) -> str:
    """Say why a vehicle or drive cannot have a name, see :func:`require_plain_name`; empty if it can."""
    expected = (
        "expected 1 to 64 letters A to Z, digits, blanks or _ . + @ -, not starting with a dash, dot, +, @ or blank, "
        "not ending with a dot or blank; rename it"
    )
    return "" if is_plain_name(name) else f"{what} {name[:80]!r} cannot be used; {expected}"


def require_plain_name(name: str, what: str) -> None:
    """Raise DriveError if the name of a vehicle or drive cannot be a file name on every system.

    Raises
    ------
    DriveError
        If the name is empty, longer than 64 characters, has other characters than A to Z, a to z, 0 to 9, ``_ . + @ -``
        and blanks, does not start with a letter, a digit or ``_``, or ends with a dot or a blank. The message begins
        with `what`, which says whose name it is.
    """
    if problem := name_problem(name, what):
        raise DriveError(problem)


def write_drive(store: str | Path, drive: Drive, layout: Layout) -> str:
    """Write one drive into a store, whole or not at all; an older drive of the same name is replaced.

    Parameters
    ----------
    store : str or Path
        Path or URL of the store; made if needed.
    drive, layout : Drive, Layout
        The drive, and the layout it was made with.

    Returns
    -------
    str
        Path or URL of the file.

    Raises
    ------
    DriveError
        If the name of vehicle or drive cannot be a file name on every system.
    UserError
        If the file cannot be written.
    """
    require_plain_name(drive.vehicle, "vehicle")
    require_plain_name(drive.name, f"vehicle {drive.vehicle}: drive")
    rows = [
        {"name": name, "kind": kind, "time_s": channel.time_s, "value": channel.value, "good": channel.good}
        for kind, channels in (("branch", drive.branches), ("input", drive.inputs))
        for name, channel in channels.items()
    ]
    about = {
        "schema_version": SCHEMA_VERSION,
        "vehicle": drive.vehicle,
        "drive": drive.name,
        "layout": layout.name,
        "layout_sha256": layout.digest,
        "dbc_sha256": layout.dbc_digest,
    }
    table = pa.Table.from_pylist(rows, schema=_SCHEMA).replace_schema_metadata({_METADATA: json.dumps(about)})
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd", use_dictionary=False)
    folder = _folder(store, drive.vehicle)
    folder.write(f"{drive.name}.parquet", buffer.getvalue())
    return f"{folder.url}/{drive.name}.parquet"


def remove_leftovers(store: str | Path, vehicles: Iterable[str], *, before_s: float) -> None:
    """Remove incomplete files of these vehicles, older than `before_s` [s since 1970], that a killed process left.

    Only in a store on this machine.
    """
    for folder in (_folder(store, vehicle) for vehicle in vehicles):
        if folder.is_local:
            for left in Path(folder.url).glob(".*.parquet.*"):
                if left.stat().st_mtime < before_s:
                    left.unlink(missing_ok=True)


def has_drive(store: str | Path, vehicle: str, name: str, layout: Layout) -> bool:
    """Check whether a store has a drive; DriveError if it is damaged or was made with another layout or DBC."""
    folder = _folder(store, vehicle)
    place = f"{folder.url}/{name}.parquet"
    with _reading(place), folder.opened(f"{name}.parquet") as file:
        if file is None:
            return False
        _check_identity(_about(pq.read_schema(file)), place, layout)
    return True


def list_drives(store: Path) -> list[DriveFile]:
    """List the drives of a store on this machine, sorted by vehicle and name; DriveError if it is no store."""
    folder = store / DRIVES_FOLDER
    if not folder.is_dir():
        raise DriveError(
            f"{store}: not a drive store: no folder '{DRIVES_FOLDER}' in it; make one with 'calibrator import'"
        )
    paths = sorted(folder.glob("*/[!.]*.parquet"), key=lambda path: (path.parent.name, path.stem))
    return [DriveFile(vehicle=path.parent.name, name=path.stem, place=str(path)) for path in paths]


def iterate_drives(store: Path, layout: Layout) -> Iterator[Drive]:
    """Read the drives of a store on this machine, made with this layout, in the order of :func:`list_drives`."""
    for entry in list_drives(store):
        yield read_drive_file(Path(entry.place), layout)


def is_drive_file(path: Path) -> bool:
    """Check whether a file is a drive of a store, and not any other Parquet table. A damaged one counts as a drive."""
    if path.suffix != ".parquet":
        return False
    try:
        return _METADATA in (pq.read_schema(path).metadata or {})
    except NotADirectoryError:  # the file is in an archive, which never holds a store
        return False
    except (OSError, pa.ArrowException):
        return True


def read_drive_file(path: Path, layout: Layout) -> Drive:
    """Read one drive of a store; DriveError if it is cut, is no drive, or was made with another layout or DBC."""
    with _reading(str(path)):
        table = pq.ParquetFile(pa.BufferReader(path.read_bytes())).read(use_threads=False)
        about = _about(table.schema)
        _check_identity(about, str(path), layout)
        channels: dict[str, dict[str, Channel]] = {"branch": {}, "input": {}}
        columns = [
            [item.values.to_numpy(zero_copy_only=False).astype(of_type) for item in table[column]]
            for column, of_type in (("time_s", np.float64), ("value", np.float64), ("good", np.bool_))
        ]
        names = table["kind"].to_pylist(), table["name"].to_pylist()
        for kind, name, time_s, value, good in zip(*names, *columns, strict=True):
            if not len(time_s) == len(value) == len(good):
                raise ValueError("a channel has columns of different lengths")
            channels[kind][name] = Channel(time_s=time_s, value=value, good=good)
        vehicle, name = str(about["vehicle"]), str(about["drive"])
    return Drive(vehicle=vehicle, name=name, branches=channels["branch"], inputs=channels["input"])


def recording_digest(drive: Drive) -> str:
    """Return a digest of a drive's channels, without the names of drive and vehicle: equal for copies only."""
    digest = hashlib.blake2b(digest_size=16)
    for channels in (drive.branches, drive.inputs):
        for name, channel in channels.items():
            digest.update(f"{name} {len(channel.time_s)} ".encode())
            for values in (channel.time_s, channel.value, channel.good):
                digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _folder(store: str | Path, vehicle: str) -> Storage:
    return open_storage(store).folder(DRIVES_FOLDER).folder(vehicle)


@contextmanager
def _reading(place: str) -> Iterator[None]:
    """Turn what pyarrow raises for a damaged file into a DriveError."""
    try:
        yield
    except OSError as error:
        raise DriveError(
            f"{place}: cannot read the drive: {error.strerror or 'damaged'}; remove it and import it again"
        ) from None
    except (pa.ArrowException, AttributeError, KeyError, TypeError, ValueError) as error:
        raise DriveError(
            f"{place}: not a drive: {str(error).splitlines()[0][:120]}; remove it and import it again"
        ) from None


def _about(schema: pa.Schema) -> dict[str, Any]:
    about: dict[str, Any] = json.loads((schema.metadata or {})[_METADATA])
    return about


def _check_identity(about: Mapping[str, object], place: str, layout: Layout) -> None:
    if about["schema_version"] != SCHEMA_VERSION:
        raise DriveError(
            f"{place}: schema version {about['schema_version']!r}, expected {SCHEMA_VERSION}; import the logs again"
        )
    if about["layout_sha256"] != layout.digest:
        raise DriveError(
            f"{place}: made with layout {about['layout']} ({str(about['layout_sha256'])[:12]}), this is {layout.path} "
            f"({layout.digest[:12]}); import the logs again with this layout"
        )
    if about.get("dbc_sha256") != layout.dbc_digest:
        raise DriveError(f"{place}: made with another DBC than {layout.dbc_path}; import the logs again with this DBC")


def read_onboard_record(path: Path, database: VehicleDatabase) -> SummaryFile:
    """Read a summary that a node made on board; DriveError if it is damaged or made with another layout or DBC."""
    try:
        record = decode_summary(path.read_bytes())
    except OSError as error:
        raise DriveError(f"{path}: cannot be read: {error.strerror}; copy it again from the vehicle") from None
    except ValueError as error:
        raise DriveError(f"{path}: not a node's summary, or damaged: {error}; copy it again") from None
    for what, its, mine in (
        ("layout", record.layout_sha256, database.layout.digest),
        ("DBC", record.dbc_sha256, database.digest),
    ):
        if its != mine:
            raise DriveError(f"{path}: made with another {what} than {database.layout.path}; use the vehicle's own")
    return record
