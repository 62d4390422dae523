"""A result as columns: N vehicles with K branches, from ``results.parquet``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.estimator.results import SCHEMA, Counts, RunRecord, count_rows, deployed_rms_a, read_run

__all__ = ["FleetTable", "read_fleet_table"]

_OF_VEHICLES = {
    "confidence": "confidence",
    "hardware_probability": "hardware_probability",
    "hardware_drift": "hardware_drift",
    "measured_a": "junction_rms_measured_a",
    "corrected_a": "junction_rms_corrected_a",
    "duration_s": "duration_s",
}
_OF_BRANCHES = {
    "drift": "drift",
    "offset_a": "offset_a",
    "drift_sd": "drift_sd",
    "offset_sd_a": "offset_sd_a",
    "delay_s": "delay_s",
    "fault_probability": "fault_probability",
    "harm_probability": "harm_probability",
    "hardware_offset_a": "hardware_offset_a",
}
Names = NDArray[np.object_]


@dataclass(frozen=True, kw_only=True)
class FleetTable:
    """A result. Numbers that a method does not give are NaN, texts None.

    Attributes
    ----------
    run : RunRecord
        How it was made.
    counts : Counts
        Of all its vehicles.
    vehicle, verdict, reason : ndarray of str, shape (N,)
        Names of the vehicles that have parameters, what was found, and what would decide.
    confidence, hardware_probability, hardware_drift : ndarray of shape (N,)
        Of the verdict; of a hardware fault, and its size d_h. [1]
    suspected : ndarray of bool, shape (N,)
        Whether a hardware fault is suspected.
    measured_a, corrected_a : ndarray of shape (N,)
        Root mean square of the Kirchhoff sum before and after correction with what is applied. [A]
    duration_s : ndarray of shape (N,)
        Length of the drives used. [s]
    drift, offset_a, drift_sd, offset_sd_a : ndarray of shape (N, K)
        Sensor faults and their standard deviations. [1], [A]
    delay_s : ndarray of shape (N, K)
        How much later than the largest branch each is seen. [s]
    fault_probability, harm_probability : ndarray of shape (N, K)
        That the sensor is faulty; that its correction makes it worse. [1]
    hardware_offset_a : ndarray of shape (N, K)
        What a hardware fault adds to each current. [A]
    applied : ndarray of bool, shape (N, K)
        Branches that the node corrects.
    held_back, moved : ndarray of str, shape (N, K)
        Why a fault that was found is not applied; what has moved since an earlier result.
    left_out, left_out_reason : ndarray of str, shape (L,)
        Vehicles, or files of unclear vehicle, without parameters, and why.
    """

    run: RunRecord
    counts: Counts
    vehicle: Names
    verdict: Names
    reason: Names
    suspected: Mask
    confidence: Array
    hardware_probability: Array
    hardware_drift: Array
    measured_a: Array
    corrected_a: Array
    duration_s: Array
    drift: Array
    offset_a: Array
    drift_sd: Array
    offset_sd_a: Array
    delay_s: Array
    fault_probability: Array
    harm_probability: Array
    hardware_offset_a: Array
    applied: Mask
    held_back: Names
    moved: Names
    left_out: Names
    left_out_reason: Names

    def __len__(self) -> int:
        return len(self.vehicle)

    @property
    def branches(self) -> Sequence[str]:
        """Names of the K branches."""
        return self.run.branches

    @property
    def faulty(self) -> Mask:
        """Sensors in which a fault was found, shape (N, K)."""
        return np.asarray((self.drift != 0.0) | (self.offset_a != 0.0))

    @property
    def error_a(self) -> Array:
        """What each sensor is off by at full scale, |d| I + |o|, shape (N, K). [A]"""
        return np.asarray(np.abs(self.drift) * self.run.full_scale_a + np.abs(self.offset_a))

    @property
    def corrected(self) -> Mask:
        """Vehicles of which the node corrects some branch, shape (N,); faults of all-zero size correct nothing."""
        return np.asarray((self.applied & self.faulty).any(axis=1))

    @property
    def deployed_a(self) -> Array:
        """Root mean square of the Kirchhoff sum with what the node applies, shape (N,). [A]"""
        return deployed_rms_a(self.applied, measured_a=self.measured_a, corrected_a=self.corrected_a)

    def places(self, vehicles: Sequence[str]) -> NDArray[np.int64]:
        """Where each of some vehicles stands in this table, -1 where it does not."""
        place = {name: j for j, name in enumerate(self.vehicle)}
        return np.array([place.get(name, -1) for name in vehicles], np.int64)


def read_fleet_table(result: Path) -> FleetTable:
    """Read a result.

    Parameters
    ----------
    result : Path
        Folder that ``calibrator calibrate`` wrote.

    Returns
    -------
    FleetTable
        Vehicles in the order of the result.

    Raises
    ------
    FleetError
        If it is no result, or not a whole one.
    """
    run, path = read_run(result), result / "results.parquet"
    try:
        table = pq.ParquetFile(path).read(use_threads=False)
    except FileNotFoundError:
        raise FleetError(f"{path}: is missing; give the whole folder that 'calibrator calibrate' wrote") from None
    except (OSError, pa.ArrowException) as error:
        first_line = str(error).partition("\n")[0]
        raise FleetError(
            f"{path}: cannot be read: {first_line}; give a folder that 'calibrator calibrate' wrote"
        ) from None
    missing = [name for name in SCHEMA.names if name not in table.column_names]
    if missing:
        raise FleetError(f"{path}: no column {', '.join(missing)}; calibrate again with this version")
    if not run.full_scale_a:
        raise FleetError(f"{result / 'run.json'}: no full_scale_a, it is of an older version; calibrate again")
    rows = table.filter(pc.is_valid(table["branch"]))
    others = table.filter(pc.is_null(table["branch"]))
    branches, K = run.branches, len(run.branches)
    if not K or rows["branch"].to_pylist() != list(branches) * (rows.num_rows // K):
        raise FleetError(
            f"{path}: the rows are not those of vehicles with the branches {', '.join(branches)} of run.json; "
            f"calibrate again"
        )
    first = rows.take(pa.array(range(0, rows.num_rows, K), pa.int64()))
    return FleetTable(
        run=run,
        counts=count_rows(rows, branches),
        vehicle=_texts(first, "vehicle"),
        verdict=_texts(first, "verdict"),
        reason=_texts(first, "reason"),
        suspected=_flags(first, "hardware_fault"),
        **{name: _numbers(first, column) for name, column in _OF_VEHICLES.items()},
        **{name: _numbers(rows, column).reshape(-1, K) for name, column in _OF_BRANCHES.items()},
        applied=_flags(rows, "applied").reshape(-1, K),
        held_back=_texts(rows, "held_back").reshape(-1, K),
        moved=_texts(rows, "moved").reshape(-1, K),
        left_out=_texts(others, "vehicle"),
        left_out_reason=_texts(others, "reason"),
    )


def _numbers(table: pa.Table, column: str) -> Array:
    return np.asarray(table[column].cast(pa.float64()).to_numpy(zero_copy_only=False), np.float64)


def _flags(table: pa.Table, column: str) -> Mask:
    return np.asarray(pc.fill_null(table[column], False).to_numpy(zero_copy_only=False), np.bool_)


def _texts(table: pa.Table, column: str) -> Names:
    return np.array(table[column].to_pylist(), dtype=object)
