"""What the parameter files of a result hold beyond ``results.parquet``: evidence, and competing explanations."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.estimator.results import PARTS
from calibrator.report.fleet_table import FleetTable
from calibrator.terminal.progress import shown
from ecu_node.parameters import Explanation

__all__ = ["Evidence", "ratio_count", "read_evidence"]

_COLUMNS = ("evidence_value", "evidence_sd", "evidence_explained")


class _Explained(msgspec.Struct, frozen=True):
    """Of a parameter file, what a page tells beyond the table."""

    explanations: list[Explanation] = []


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Evidence of n vehicles.

    Attributes
    ----------
    names : sequence of str
        Of the R rows: ratios [1], then constants [A].
    ratios : int
        How many of them are ratios.
    value, sd, explained : ndarray of shape (n, R)
        What was found, its standard deviation, and what the estimate explains of it; NaN where nothing is told.
    explanations : sequence of sequence of Explanation
        Competing ones, most probable first; mostly none.
    """

    names: Sequence[str]
    ratios: int
    value: Array
    sd: Array
    explained: Array
    explanations: Sequence[Sequence[Explanation]]


def read_evidence(result: Path, table: FleetTable, listed: NDArray[np.int64]) -> Evidence:
    """Read the evidence of some vehicles of a result.

    Parameters
    ----------
    result : Path
        Its folder.
    table : FleetTable
        Its vehicles.
    listed : ndarray of int of shape (n,)
        Which of them.

    Returns
    -------
    Evidence
        In this order. A method that keeps none has no rows.

    Raises
    ------
    FleetError
        If the parameters of the result are missing or damaged.
    """
    names = table.run.details.get("evidence", [])
    place = {name: j for j, name in enumerate(table.vehicle[listed])}
    found = np.full((3, len(listed), len(names)), np.nan)
    explanations: list[Sequence[Explanation]] = [()] * len(listed)
    parts = sorted((result / PARTS).glob("[0-9]*.parquet"))
    if not parts:
        raise FleetError(
            f"{result / PARTS}: no parameters there; give the whole folder that 'calibrator calibrate' wrote"
        )
    for part in shown(parts, "read evidence", len(parts), "files"):
        rows = _read(part)
        where = np.array([place.get(name, -1) for name in rows["vehicle"].to_pylist()], np.int64)
        rows, where = rows.filter(pa.array(where >= 0)), where[where >= 0]
        for j, text in zip(where.tolist(), rows["parameters"].to_pylist(), strict=True):
            explanations[j] = _explanations(text, part)
        for values, column in zip(found, _COLUMNS, strict=True):
            _put(rows[column], where, values)
    return Evidence(
        names=names,
        ratios=ratio_count(names),
        value=found[0],
        sd=found[1],
        explained=found[2],
        explanations=explanations,
    )


def ratio_count(names: Sequence[str]) -> int:
    """How many of the rows of evidence are ratios: those before the intercepts."""
    return sum(not name.startswith(("intercept ", "junction ", "offset ")) for name in names)


def _read(part: Path) -> pa.Table:
    try:
        table = pq.ParquetFile(part).read(use_threads=False)
        missing = [name for name in ("vehicle", "parameters") if name not in table.column_names]
    except (pa.ArrowException, OSError) as error:
        reason = str(error).partition("\n")[0][:120]
        raise FleetError(f"{part}: damaged part of a result: {reason}; calibrate again") from None
    if missing:
        raise FleetError(f"{part}: damaged part of a result: no column {', '.join(missing)}; calibrate again")
    for name in _COLUMNS:
        if name not in table.column_names:
            table = table.append_column(name, pa.nulls(table.num_rows, pa.list_(pa.float32())))
    return table


def _explanations(text: str, part: Path) -> Sequence[Explanation]:
    try:
        return msgspec.json.decode(text, type=_Explained).explanations
    except msgspec.DecodeError as error:
        raise FleetError(f"{part}: damaged part of a result: {error}; calibrate again") from None


def _put(column: pa.ChunkedArray, where: NDArray[np.int64], values: Array) -> None:
    """Lists of numbers into the rows of their vehicles; a list of another length tells nothing."""
    lists = column.combine_chunks()
    fits = np.asarray(pc.fill_null(pc.equal(pc.list_value_length(lists), values.shape[1]), False))
    if fits.any() and values.shape[1]:
        numbers = lists.filter(pa.array(fits)).flatten().to_numpy(zero_copy_only=False)
        values[where[fits]] = numbers.reshape(-1, values.shape[1])
