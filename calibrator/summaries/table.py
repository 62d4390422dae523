"""Records as Parquet, one row each.

Moments are symmetric, so their upper triangles are stored, row by row, one block after the other. A record has at most
:data:`MOST_BLOCKS` blocks: of longer drives neighbouring blocks are added, so a vehicle's size on disk and in memory
does not grow with the hours that it is driven between two summaries.
"""

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from calibrator.drive import Array
from calibrator.drives.delays import BranchDelays
from calibrator.errors import FleetError
from calibrator.summaries.fit_sums import LEVEL_EDGES_A, FitSums
from calibrator.summaries.identity import StoreIdentity
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.record import (
    IMPOSSIBLE,
    MOST_MOMENT,
    MOST_VARIANCE_A2,
    Known,
    Outline,
    Record,
    name_problem,
    outline_of,
    stored_problem,
)
from calibrator.summaries.vehicle_summary import VehicleSummary
from calibrator.summaries.zero_current import ZeroCurrent

__all__ = [
    "FIT_COLUMNS",
    "MOST_BLOCKS",
    "SCHEMA",
    "decode_known",
    "decode_outlines",
    "decode_records",
    "encode_records",
]

MOST_BLOCKS = 256
"""Of a record: two hours and more; their spread is known to a tenth. [1]"""

FIT_COLUMNS = ("levels", "fast_a2", "spikes", "temperature_c", "starts")
"""Columns with the fields of :class:`~calibrator.summaries.fit_sums.FitSums`; null where a record has none."""

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
        pa.field("recorded", _NAMES),
    ]
)


def encode_records(records: Sequence[Record], identity: StoreIdentity) -> bytes:
    """Write records, which have the inputs and branches of the store, as a Parquet file."""
    buffer = io.BytesIO()
    table = pa.Table.from_pylist([_row(record, identity) for record in records], schema=SCHEMA)
    pq.write_table(table, buffer, compression="snappy", use_dictionary=False, write_statistics=["vehicle"])
    return buffer.getvalue()


def decode_records(contents: Sequence[bytes], identity: StoreIdentity, where: str) -> list[Record]:
    """Read records from Parquet files.

    Parameters
    ----------
    contents : sequence of bytes
        The files.
    identity : StoreIdentity
        Of their store.
    where : str
        Of the files, for messages.

    Returns
    -------
    list of Record
        In the order of the files. One whose numbers make no sense, or are too few or too many, is damaged.

    Raises
    ------
    FleetError
        If a file is cut or no such file.
    """
    return list(_records(_table(contents, where), identity))


def decode_outlines(contents: Sequence[bytes], where: str) -> list[Outline]:
    """Read what there is of each vehicle, one per vehicle, without its moments; as :func:`decode_records`."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for row in _table(contents, where, ["vehicle", "drives", "problem", "duration_s"]).to_pylist():
        rows.setdefault(row["vehicle"] or "", []).append(row)
    return [outline_of(name, group) for name, group in rows.items()]


def decode_known(contents: Sequence[bytes], where: str) -> list[Known]:
    """Read which drives the records are of, without their moments; as :func:`decode_records`."""
    found = []
    for row in _table(contents, where, ["vehicle", "drives", "sources", "digests", "problem"]).to_pylist():
        drives, sources = _drives(row)
        digests = tuple(text or "" for text in row["digests"] or ())
        problem = row["problem"]
        found.append(
            Known(
                vehicle=row["vehicle"] or "",
                drives=drives,
                sources=sources,
                digests=digests,
                problem="" if problem is None else stored_problem(problem),
            )
        )
    return found


def _table(contents: Sequence[bytes], where: str, columns: list[str] | None = None) -> pa.Table:
    """Some columns of files, without the detour over data sets."""
    tables = [SCHEMA.empty_table() if columns is None else SCHEMA.empty_table().select(columns)]
    for content in contents:
        reason = "its columns are not those of summaries"
        try:
            file = pq.ParquetFile(pa.BufferReader(content), pre_buffer=False)
            if file.schema_arrow.equals(SCHEMA):
                tables.append(file.read(columns=columns, use_threads=False))
                tables[-1].validate(full=True)
                continue
        except (pa.ArrowException, OSError):
            reason = "it is cut, or no Parquet file"
        raise FleetError(f"{where}: damaged file of summaries: {reason}; remove it and summarise again")
    return pa.concat_tables(tables)


def _row(record: Record, identity: StoreIdentity) -> dict[str, Any]:
    row: dict[str, Any] = {
        "vehicle": record.vehicle,
        "drives": list(record.drives),
        "sources": list(record.sources),
        "digests": list(record.digests),
    }
    if record.found is None:
        return {**row, "problem": record.problem}
    found = record.found
    summary = _shortened(found.summary)
    upper = np.triu_indices(summary.moments.shape[1])
    place = [found.delays.branches.index(name) for name in identity.branches]
    return {
        **row,
        "duration_s": summary.duration_s,
        "moments": summary.moments[:, upper[0], upper[1]].ravel(),
        "noise_a2": summary.noise_a2.ravel(),
        **({} if summary.fit is None else {name: getattr(summary.fit, name).ravel() for name in FIT_COLUMNS}),
        "delay_reference": found.delays.branches[0],
        "delay_s": found.delays.delay_s[place],
        "delay_sd_s": np.where(found.delays.known, found.delays.sd_s, np.inf)[place],
        "zero_offset_a": found.zero_current.offset_a,
        "zero_sd_a": found.zero_current.sd_a,
        "recorded": sorted(found.recorded),
    }


def _shortened(summary: DriveSummary) -> DriveSummary:
    """The same with neighbouring blocks added until there are few enough; their noise is averaged by samples."""
    count = len(summary.moments)
    if count <= MOST_BLOCKS:
        return summary
    first = np.arange(0, count, -(-count // MOST_BLOCKS))
    samples = summary.moments[:, -1, -1]
    noise = np.add.reduceat(summary.noise_a2 * samples[:, None], first) / np.add.reduceat(samples, first)[:, None]
    fit = None if summary.fit is None else summary.fit.joined(first, samples)
    return replace(summary, moments=np.add.reduceat(summary.moments, first), noise_a2=noise, fit=fit)


def _records(table: pa.Table, identity: StoreIdentity) -> Iterable[Record]:
    rows = table.drop_columns(["moments", "noise_a2", *FIT_COLUMNS]).to_pylist()
    for row, summary in zip(rows, _summaries(table, identity), strict=True):
        name = row["vehicle"] or ""
        drives, sources = _drives(row)
        digests = tuple(text or "" for text in row["digests"] or ())
        record = Record(vehicle=name, drives=drives, sources=sources, found=None, digests=digests)
        if row["problem"] is not None:
            yield replace(record, problem=stored_problem(row["problem"]))
        elif problem := name_problem(name) or _row_problem(row, summary, identity.branches):
            yield replace(record, problem=problem, damaged=True)
        else:
            assert summary is not None
            yield replace(record, found=_vehicle(row, summary, identity.branches))


def _drives(row: Mapping[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Drives of a row, and their versions; these are unknown where they do not fit the drives."""
    drives, sources = (tuple(name or "" for name in row[column] or ()) for column in ("drives", "sources"))
    return drives, sources if len(sources) == len(drives) else ("",) * len(drives)


def _summaries(table: pa.Table, identity: StoreIdentity) -> list[DriveSummary | None]:
    """Summary of each record; None where it is not there, or not of a whole number of blocks."""
    K = len(identity.branches)
    p = identity.bank.width + K + 1
    values, triangle = _lengths(table, "noise_a2"), p * (p + 1) // 2
    blocks = values // K
    whole = (blocks > 0) & (values == K * blocks) & (_lengths(table, "moments") == triangle * blocks)
    has_fit = np.minimum(_lengths(table, FIT_COLUMNS[0]), 1)
    L = len(LEVEL_EDGES_A) + 1
    sizes = {"levels": K * L * (p + 1), "fast_a2": blocks * K * K, "spikes": 2 * blocks * K}
    for name in FIT_COLUMNS:
        whole &= _lengths(table, name) == has_fit * sizes.get(name, blocks)
    bank = identity.bank.identity
    kept = table.select(["moments", "noise_a2", *FIT_COLUMNS]).filter(pa.array(whole))
    triangles, noise = _numbers(kept, "moments").reshape(-1, triangle), _numbers(kept, "noise_a2").reshape(-1, K)
    moments, upper = np.empty((len(triangles), p, p)), np.triu_indices(p)
    moments[:, upper[0], upper[1]] = moments[:, upper[1], upper[0]] = triangles
    levels = _numbers(kept, "levels").reshape(-1, K, L, p + 1)
    fast, spikes = (_numbers(kept, name).reshape(-1, K, w) for name, w in (("fast_a2", K), ("spikes", 2)))
    warm_c, starts = _numbers(kept, "temperature_c"), _numbers(kept, "starts") > 0.0
    found: list[DriveSummary | None] = []
    start = fit_start = record = 0
    for count, is_whole, with_fit in zip(blocks.tolist(), whole.tolist(), has_fit.tolist(), strict=True):
        if not is_whole:
            found.append(None)
            continue
        own, own_fit, fit = slice(start, start + count), slice(fit_start, fit_start + count), None
        if with_fit:
            fit = FitSums(
                levels=levels[record],
                fast_a2=fast[own_fit],
                spikes=spikes[own_fit],
                temperature_c=warm_c[own_fit],
                starts=starts[own_fit],
            )
            record, fit_start = record + 1, own_fit.stop
        summary = DriveSummary(
            moments=moments[own],
            noise_a2=noise[own],
            branches=K,
            period_s=identity.bank.period_s,
            bank=bank,
            fit=fit,
        )
        found.append(summary)
        start = own.stop
    return found


def _lengths(table: pa.Table, name: str) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    """Number of values in each row of a column of lists; 0 where there is no list."""
    counts = pc.fill_null(pc.list_value_length(table.column(name)), 0)
    return np.asarray(counts.to_numpy(), np.int64)


def _numbers(table: pa.Table, name: str) -> Array:
    """All values of a column of lists; NaN where there is none."""
    lists = table.column(name).combine_chunks()
    return np.asarray(lists.flatten().to_numpy(zero_copy_only=False), np.float64)


def _vehicle(row: dict[str, Any], summary: DriveSummary, branches: tuple[str, ...]) -> VehicleSummary:
    reference = row["delay_reference"]
    names = (reference, *(name for name in branches if name != reference))
    place = [branches.index(name) for name in names]
    sd: Array = np.array(row["delay_sd_s"])[place]
    return VehicleSummary(
        vehicle=row["vehicle"],
        drives=tuple(row["drives"]),
        summary=summary,
        delays=BranchDelays(branches=names, delay_s=np.array(row["delay_s"])[place], sd_s=sd, known=np.isfinite(sd)),
        zero_current=ZeroCurrent(offset_a=np.array(row["zero_offset_a"]), sd_a=np.array(row["zero_sd_a"])),
        recorded=frozenset(row["recorded"]),
    )


# ---- whether a row makes sense: buckets come from disks and tools that may have spoilt them

_NAME_COLUMNS = ("drives", "sources", "recorded")
_PER_BRANCH = ("delay_s", "delay_sd_s", "zero_offset_a", "zero_sd_a")


def _row_problem(row: Mapping[str, Any], summary: DriveSummary | None, branches: Sequence[str]) -> str:
    """Why the summary that a row holds cannot be used.

    Parameters
    ----------
    row : mapping of str to values
        Columns of a record that has no problem, but ``moments``, ``noise_a2`` and those of the fit sums.
    summary : DriveSummary or None
        Made of these two; None if they are not of a whole number of blocks.
    branches : sequence of str
        Names of the K branches.

    Returns
    -------
    str
        Why not, and what to do; empty if it can.
    """
    spoilt = _spoilt_columns(row, summary, branches)
    if spoilt:
        return (
            f"its summary is damaged: {' and '.join(spoilt)} do not fit the other columns; summarise its drives again"
        )
    assert summary is not None
    possible = _possible_moments(summary) and _possible_delays(row) and _possible_offsets(row)
    return "" if possible and 0.0 < row["duration_s"] < math.inf else IMPOSSIBLE


def _spoilt_columns(row: Mapping[str, Any], summary: DriveSummary | None, branches: Sequence[str]) -> list[str]:
    """Columns in which values are missing, or which have too few or too many."""
    spoilt = ["moments, noise_a2 and fit sums"] if summary is None else []
    spoilt += [name for name in _NAME_COLUMNS if row[name] is None or None in row[name]]
    if not spoilt and len(row["drives"]) != len(row["sources"]):
        spoilt.append("sources")
    spoilt += [
        name for name in _PER_BRANCH if row[name] is None or None in row[name] or len(row[name]) != len(branches)
    ]
    spoilt += ["delay_reference"] if row["delay_reference"] not in branches else []
    return spoilt + (["duration_s"] if row["duration_s"] is None else [])


def _possible_moments(summary: DriveSummary) -> bool:
    """Every sum is finite, no sum of squares negative, every block has samples, noise is a variance of a current."""
    moments, noise = summary.moments, summary.noise_a2
    squares = np.diagonal(moments, axis1=1, axis2=2)
    fit = summary.fit
    if fit is not None and not (
        np.abs(fit.levels).max() < MOST_MOMENT
        and fit.levels[..., -1].min() >= 0.0
        and np.abs(fit.fast_a2).max() < MOST_MOMENT
        and 0.0 <= fit.spikes.min() <= fit.spikes.max() < math.inf
        and not np.isinf(fit.temperature_c).any()
    ):
        return False
    return bool(
        np.abs(moments).max() < MOST_MOMENT  # nor is not-a-number
        and squares.min() >= 0.0
        and squares[:, -1].min() > 0.0
        and noise.min() >= 0.0
        and noise.max() <= MOST_VARIANCE_A2
    )


def _possible_delays(row: Mapping[str, Any]) -> bool:
    """A delay is a number, or not known: then its deviation is infinite."""
    pairs = zip(row["delay_s"], row["delay_sd_s"], strict=True)
    return all(sd == math.inf or (0.0 <= sd < math.inf and math.isfinite(delay)) for delay, sd in pairs)


def _possible_offsets(row: Mapping[str, Any]) -> bool:
    """An offset is a number with a deviation, or there was no window: then both are not-a-number."""
    pairs = zip(row["zero_offset_a"], row["zero_sd_a"], strict=True)
    return all(
        (math.isnan(offset) and math.isnan(sd)) or (math.isfinite(offset) and 0.0 < sd < math.inf)
        for offset, sd in pairs
    )
