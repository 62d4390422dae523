"""Records of a store: each is the result of reading some drives of one vehicle, and one row of a Parquet file.

Moments are symmetric, so only their upper triangles are stored, row by row, one block after the other. A record has at
most :data:`MOST_BLOCKS` blocks: neighbouring blocks of longer drives are added up, so a vehicle's size on disk and in
memory does not grow with the hours that it is driven between two summaries. Records of a vehicle add up.
"""

import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from calibrator.drive import Array
from calibrator.drives.delays import BranchDelays
from calibrator.drives.store import require_plain_name
from calibrator.errors import DriveError, FleetError
from calibrator.summaries.identity import StoreIdentity
from calibrator.summaries.moments import LEVEL_EDGES_A, DriveSummary, FitSums
from calibrator.summaries.vehicle_summary import VehicleSummary, ZeroCurrent, added_summaries, too_short
from calibrator.terminal.text import counted

__all__ = ["SCHEMA", "Outline", "Record", "decode_records", "drives_digest", "encode_records", "joined_records"]

IMPOSSIBLE = "its summary holds impossible numbers; look at its recordings, and summarise them again"
"""Reason for leaving a vehicle out, as the user reads it."""
FEWEST_BLOCKS = 4
"""Least number of blocks of a vehicle: fewer do not show the uncertainty. A block made on board spans minutes. [1]"""
MOST_BLOCKS = 256
"""Most blocks of a record: they cover two hours or more, and show the spread between blocks to a tenth. [1]"""
MOST_MOMENT, MOST_VARIANCE_A2 = 1e30, 1e10
"""Limits of sums of products (in any unit) and of the variance of a current [A^2], far beyond any real recording."""

_FLOATS, _NAMES = pa.list_(pa.float64()), pa.list_(pa.string())
SCHEMA = pa.schema(
    [
        pa.field("vehicle", pa.string(), nullable=False),
        pa.field("drives", _NAMES, nullable=False),
        pa.field("sources", _NAMES, nullable=False),
        pa.field("digests", _NAMES),
        pa.field("problem", pa.string()),
        pa.field("duration_s", pa.float64(), metadata={"unit": "s"}),
        pa.field("moments", _FLOATS, metadata={"shape": "(B, p (p + 1) / 2), p: filtered inputs, branches [A], 1"}),
        pa.field("noise_a2", _FLOATS, metadata={"shape": "(B, K)", "unit": "A^2"}),
        pa.field("levels", _FLOATS, metadata={"shape": "(K, L, p + 1), p and the square of the current", "unit": "A"}),
        pa.field("fast_a2", _FLOATS, metadata={"shape": "(B, K, K)", "unit": "A^2"}),
        pa.field("spikes", _FLOATS, metadata={"shape": "(B, K, 2)"}),
        pa.field("temperature_c", _FLOATS, metadata={"shape": "(B,), NaN where not known", "unit": "degC"}),
        pa.field("starts", pa.list_(pa.bool_()), metadata={"shape": "(B,)"}),
        pa.field("delay_reference", pa.string()),
        pa.field("delay_s", _FLOATS, metadata={"shape": "(K,)", "unit": "s"}),
        pa.field("delay_sd_s", _FLOATS, metadata={"shape": "(K,), infinite where not known", "unit": "s"}),
        pa.field("zero_offset_a", _FLOATS, metadata={"shape": "(K,), NaN where there was no window", "unit": "A"}),
        pa.field("zero_sd_a", _FLOATS, metadata={"shape": "(K,)", "unit": "A"}),
    ]
)
_ABOUT = ["vehicle", "drives", "sources", "digests", "problem", "duration_s"]
"""Columns that describe a record; the others hold the numbers of its summary."""
_NUMBERS = [field.name for field in SCHEMA if field.type in {_FLOATS, pa.list_(pa.bool_())}]


@dataclass(frozen=True, kw_only=True)
class Record:
    """Result of reading some drives of one vehicle together.

    Attributes
    ----------
    vehicle : str
        Name of the vehicle.
    drives : tuple of str
        Names of the drives.
    sources : tuple of str
        Version of each drive's file when it was read, see :class:`.DriveFile`.
    digests : tuple of str
        Digest of the content of each drive, see :func:`.recording_digest`; empty if the drives could not be read.
    found : VehicleSummary or None
        Summary of the drives; None if they cannot be used, or if :func:`decode_records` did not read it.
    problem : str
        Why the drives cannot be used; empty if they can.
    """

    vehicle: str
    drives: tuple[str, ...]
    sources: tuple[str, ...]
    found: VehicleSummary | None
    problem: str = ""
    digests: tuple[str, ...] = ()
    duration_s: float = 0.0
    """Duration of the usable data in the drives, as it is stored. [s]"""


class Outline(NamedTuple):
    """Names of a vehicle's usable drives, and why the vehicle cannot be calibrated (an empty text if it can)."""

    vehicle: str
    drives: tuple[str, ...]
    problem: str

    @classmethod
    def of(cls, records: Sequence[Record]) -> "Outline":
        """Return the outline of a vehicle from its records, which may come without their summaries."""
        usable = [record for record in records if not record.problem]
        drives = tuple(name for record in usable for name in record.drives)
        duration_s = sum(record.duration_s for record in usable)
        return cls(records[0].vehicle, drives, too_short(duration_s, len(drives)) if usable else records[-1].problem)


def drives_digest(records: Sequence[Record], choices: object) -> str:
    """Return a digest of the usable drives of a vehicle and of the user's choices for it.

    It changes when a drive is added, when its file changes, and when the ``repr`` of the choices changes.
    """
    known = sorted(
        pair for record in records if record.found for pair in zip(record.drives, record.sources, strict=True)
    )
    return hashlib.blake2b(repr((known, choices)).encode(), digest_size=16).hexdigest()


def joined_records(records: Sequence[Record]) -> VehicleSummary:
    """Add up the summaries of one or more records of one vehicle, see :func:`.added_summaries`.

    Raises
    ------
    DriveError
        If no record can be used, all together are too short or have too few blocks, or numbers are impossible.
    """
    usable = [record.found for record in records if record.found is not None]
    if not usable:
        raise DriveError(records[-1].problem)
    found = added_summaries(usable)
    summary, drives = found.summary, len(found.drives)
    if problem := too_short(summary.duration_s, drives):
        raise DriveError(problem)
    if len(summary.moments) < FEWEST_BLOCKS:
        blocks = f"{counted(len(summary.moments), 'block')} in {counted(drives, 'drive')}"
        raise DriveError(f"{blocks}; at least {FEWEST_BLOCKS} are needed")
    if not np.abs(summary.moments).max() < MOST_MOMENT or summary.variance_a2.max() > MOST_VARIANCE_A2:
        raise DriveError(IMPOSSIBLE)
    return found


# ---- as Parquet


def encode_records(records: Sequence[Record], identity: StoreIdentity) -> bytes:
    """Return the content of a Parquet file with records; they must have the inputs and branches of the store."""
    buffer = io.BytesIO()
    table = pa.Table.from_pylist([_row(record, identity) for record in records], schema=SCHEMA)
    pq.write_table(
        table,
        buffer,
        compression="snappy",
        use_dictionary=False,
        write_statistics=["vehicle"],
        write_page_checksum=True,
    )
    return buffer.getvalue()


_upper = cache(np.triu_indices)


def _row(record: Record, identity: StoreIdentity) -> dict[str, Any]:
    row = {name: getattr(record, name) for name in ("vehicle", "drives", "sources", "digests")}
    if record.found is None:
        return {**row, "problem": record.problem}
    found, summary = record.found, record.found.summary.shortened(MOST_BLOCKS)
    upper = _upper(summary.moments.shape[1])
    place = [found.delays.branches.index(name) for name in identity.equipment.branches]
    return {
        **row,
        "duration_s": summary.duration_s,
        "moments": summary.moments[:, upper[0], upper[1]].ravel(),
        "noise_a2": summary.noise_a2.ravel(),
        **({} if summary.fit is None else {name: value.ravel() for name, value in vars(summary.fit).items()}),
        "delay_reference": found.delays.branches[0],
        "delay_s": found.delays.delay_s[place],
        "delay_sd_s": np.where(found.delays.known, found.delays.sd_s, np.inf)[place],
        "zero_offset_a": found.zero_current.offset_a,
        "zero_sd_a": found.zero_current.sd_a,
    }


def decode_records(content: bytes, identity: StoreIdentity, where: str, *, whole: bool = True) -> list[Record]:
    """Read the records of a Parquet file.

    Parameters
    ----------
    content : bytes
        Content of the file.
    identity : StoreIdentity
        Identity of its store.
    where : str
        Where the file is, for messages.
    whole : bool
        Whether to read the summaries as well, and not only names, versions, digests and problems of the drives.

    Returns
    -------
    list of Record
        Records in the order of the file.

    Raises
    ------
    FleetError
        If the file is damaged or cut, or is not a file of summaries.
    DriveError
        If the name of a vehicle cannot be a file name.
    """
    reason = "its columns are not those of this store"
    try:
        file = pq.ParquetFile(pa.BufferReader(content), pre_buffer=False, page_checksum_verification=True)
        if file.schema_arrow.equals(SCHEMA):
            table = file.read(columns=None if whole else _ABOUT, use_threads=False)
            return _records(table, identity, where, whole=whole)
    except (pa.ArrowException, OSError):
        reason = "it is cut or changed, or no Parquet file"
    except ValueError:  # lists of wrong lengths
        pass
    raise FleetError(f"{where}: damaged file of summaries: {reason}; remove it and summarise again")


def _records(table: pa.Table, identity: StoreIdentity, where: str, *, whole: bool) -> list[Record]:
    rows, found = table.drop_columns(_NUMBERS if whole else []).to_pylist(), []
    numbers = {name: _values(table, name) for name in _NUMBERS} if whole else {}
    bank = identity.bank.identity
    for place, row in enumerate(rows):
        require_plain_name(row["vehicle"], f"{where}: vehicle")  # its parameter file is named after it
        problem = " ".join((row["problem"] or "").split())
        own = {name: each[place] for name, each in numbers.items()}
        record = Record(
            vehicle=row["vehicle"],
            drives=tuple(row["drives"]),
            sources=tuple(row["sources"]),
            digests=tuple(row["digests"]),
            found=_vehicle(row, own, identity, bank) if whole and not problem else None,
            problem=problem,
            duration_s=row["duration_s"] or 0.0,
        )
        found.append(record)
    return found


def _values(table: pa.Table, name: str) -> list[Array]:
    """Return the numbers in each row of a column of lists: NaN for a null number, an empty array for a null list."""
    lists = table.column(name).combine_chunks()
    values = np.asarray(lists.values.to_numpy(zero_copy_only=False), np.float64)
    return [values[start:stop] for start, stop in pairwise(lists.offsets.to_numpy().tolist())]


def _vehicle(
    row: Mapping[str, Any], numbers: Mapping[str, Array], identity: StoreIdentity, bank: str
) -> VehicleSummary:
    """Return the summary in a row; raise ValueError if it has too few or too many numbers."""
    K, L = len(identity.equipment.branches), len(LEVEL_EDGES_A) + 1
    p = identity.bank.width + K + 1
    noise_a2 = numbers["noise_a2"].reshape(-1, K)
    B, upper = len(noise_a2), _upper(p)
    moments, fit = np.empty((B, p, p)), None
    moments[:, upper[0], upper[1]] = moments[:, upper[1], upper[0]] = numbers["moments"].reshape(B, len(upper[0]))
    if numbers["levels"].size:
        fit = FitSums(
            levels=numbers["levels"].reshape(K, L, p + 1),
            fast_a2=numbers["fast_a2"].reshape(B, K, K),
            spikes=numbers["spikes"].reshape(B, K, 2),
            temperature_c=numbers["temperature_c"].reshape(B),
            starts=numbers["starts"].reshape(B) > 0.0,
        )
    first = identity.equipment.branches.index(row["delay_reference"])
    order = [first, *(k for k in range(K) if k != first)]
    delay_s, sd_s = numbers["delay_s"][order], numbers["delay_sd_s"][order]
    return VehicleSummary(
        vehicle=row["vehicle"],
        drives=tuple(row["drives"]),
        summary=DriveSummary(
            moments=moments,
            noise_a2=noise_a2,
            branches=K,
            period_s=identity.bank.period_s,
            bank=bank,
            fit=fit,
        ),
        delays=BranchDelays(
            branches=tuple(identity.equipment.branches[k] for k in order),
            delay_s=delay_s,
            sd_s=sd_s,
            known=np.isfinite(sd_s),
        ),
        zero_current=ZeroCurrent(offset_a=numbers["zero_offset_a"], sd_a=numbers["zero_sd_a"]),
    )
