"""Vehicles that have no parameters, and why: rows of ``RESULT/results.parquet`` without branch."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

__all__ = ["LEFT_OUT", "left_out_of", "left_out_reason", "left_out_rows"]

LEFT_OUT = "left out"
"""Stands for the verdict of a vehicle, or of a file of unclear vehicle, that has no parameters."""


def left_out_rows(left_out: Mapping[str, str]) -> list[dict[str, Any]]:
    """Rows of vehicles that have no parameters."""
    return [{"vehicle": vehicle, "verdict": LEFT_OUT, "reason": left_out[vehicle]} for vehicle in sorted(left_out)]


def left_out_of(folder: Path, *, most: int) -> tuple[dict[str, str], int]:
    """Vehicles of ``results.parquet`` that have no parameters, and why, so many at most; and how many there are."""
    found: dict[str, str] = {}
    count = 0
    file = pq.ParquetFile(folder / "results.parquet")
    for batch in file.iter_batches(columns=["vehicle", "branch", "reason"]):
        rows = batch.filter(pc.is_null(batch["branch"])).select(["vehicle", "reason"])
        count += rows.num_rows
        for row in rows.slice(0, max(most - len(found), 0)).to_pylist():
            found[row["vehicle"]] = row["reason"]
    return found, count


def left_out_reason(path: Path, vehicle: str) -> str | None:
    """Why a vehicle has no parameters; None if nothing is said of it."""
    try:
        table = pq.ParquetFile(path).read(columns=["vehicle", "reason"], use_threads=False)
        rows = table.filter(pc.equal(table["vehicle"], vehicle)).to_pylist()
    except (pa.ArrowException, OSError):
        return None
    return str(rows[0]["reason"]) if rows else None
