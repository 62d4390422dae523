"""One drive as a Parquet file: one row per channel.

Columns: ``name``, ``kind`` (branch or input), ``time_s`` and ``value`` (lists of float64), ``good`` (list of bool). The
file's metadata carries schema version, vehicle, drive, and name and digest of the layout, because branch names and
signs mean something only together with it.
"""

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from calibrator.drive import Channel, Drive
from calibrator.errors import DriveError
from ecu_node.layout import Layout

__all__ = ["drive_digest", "drive_outline", "encode_drive", "is_drive_file", "read_drive_file", "require_made_with"]

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


def is_drive_file(path: Path) -> bool:
    """Whether a file is one of a store: Parquet, but no table of somebody else's. A damaged one counts."""
    if path.suffix != ".parquet":
        return False
    try:
        return _METADATA in (pq.read_schema(path).metadata or {})
    except NotADirectoryError:  # in an archive, where no store is
        return False
    except (OSError, pa.ArrowException):
        return True


def encode_drive(drive: Drive, layout: Layout) -> bytes:
    """Content of the file of a drive, made with this layout."""
    buffer = io.BytesIO()
    pq.write_table(_table(drive, layout), buffer, compression="zstd", use_dictionary=False)
    return buffer.getvalue()


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
        "dbc_sha256": layout.dbc_digest,
    }
    table = pa.Table.from_pylist(rows, schema=_SCHEMA)
    return table.replace_schema_metadata({_METADATA: json.dumps(about)})


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


def require_made_with(path: Path, layout: Layout) -> None:
    """Refuse a file of a store that is damaged, or was made with another layout or DBC; its columns are not read."""
    with _reading(path):
        _check_identity(_about(pq.read_schema(path)), path, layout)


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
    if about.get("dbc_sha256") != layout.dbc_digest:
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
