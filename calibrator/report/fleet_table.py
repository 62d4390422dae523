"""A result as columns: N vehicles with K branches from ``results.parquet``, and what their parameter files add."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.estimator.results import SCHEMA, RunRecord, deployed_rms_a, part_file, read_part, read_run
from calibrator.summaries.buckets import bucket_of
from calibrator.terminal.progress import shown
from calibrator.terminal.text import few_reasons
from ecu_node.parameters import Explanation, Finding

__all__ = ["Details", "FleetTable", "ParameterDetails", "read_details", "read_fleet_table"]


@dataclass(frozen=True, kw_only=True)
class FleetTable:
    """A result.

    Attributes
    ----------
    folder : Path
        Of the result.
    run : RunRecord
        How it was made.
    vehicle : ndarray of str, shape (N,)
        Names of the vehicles that have parameters, in the order of the result.
    columns : mapping of str to ndarray of shape (N, K)
        Columns of ``results.parquet``: numbers (NaN where the method gives none), flags, texts (None where there is
        none). What belongs to the vehicle as a whole is the same in all K places.
    left_out : mapping of str to str
        Vehicles, or files of unclear vehicle, without parameters, and why.
    """

    folder: Path
    run: RunRecord
    vehicle: NDArray[np.object_]
    columns: Mapping[str, NDArray[Any]]
    left_out: Mapping[str, str]

    def __len__(self) -> int:
        return len(self.vehicle)

    def __getitem__(self, column: str) -> NDArray[Any]:
        """Return a column, shape (N, K)."""
        return self.columns[column]

    def of_vehicles(self, column: str) -> NDArray[Any]:
        """Return a column that belongs to the vehicle as a whole, shape (N,)."""
        return self.columns[column][:, 0]

    def only(self, vehicle: str) -> "FleetTable":
        """Return the result of one of the vehicles alone."""
        chosen = self.vehicle == vehicle
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return replace(self, vehicle=self.vehicle[chosen], columns=columns, left_out={})

    @property
    def branches(self) -> Sequence[str]:
        """Names of the K branches."""
        return self.run.branches

    @property
    def faulty(self) -> Mask:
        """Sensors in which a fault was found, shape (N, K): corrected, held back, or found without a probability."""
        settled = ~self["applied"] & ~self["held_back"].astype(bool) & np.isfinite(self["fault_probability"])
        return np.asarray(((self["drift"] != 0.0) | (self["offset_a"] != 0.0)) & ~settled)

    @property
    def error_a(self) -> Array:
        """Error of each faulty sensor at full scale: of its gain and of its offset, shape (N, K). [A]"""
        return np.asarray(self.faulty * (np.abs(self["drift"]) * self.run.full_scale_a + np.abs(self["offset_a"])))

    @property
    def corrected(self) -> Mask:
        """Vehicles of which the node corrects a branch, shape (N,); a fault of size 0 corrects nothing."""
        return np.asarray((self["applied"] & self.faulty).any(axis=1))

    @property
    def deployed_a(self) -> Array:
        """Root mean square of the Kirchhoff sum with what the node applies, shape (N,). [A]"""
        measured_a, corrected_a = (self.of_vehicles(f"junction_rms_{name}_a") for name in ("measured", "corrected"))
        return deployed_rms_a(self["applied"], measured_a=measured_a, corrected_a=corrected_a)


def read_fleet_table(result: Path) -> FleetTable:
    """Read the folder that ``calibrator calibrate`` wrote; FleetError if it is no result, or not a whole one."""
    run, path = read_run(result), result / "results.parquet"
    try:
        table = pq.ParquetFile(path).read(use_threads=False)
    except FileNotFoundError:
        raise FleetError(f"{path}: is missing; give the whole folder that 'calibrator calibrate' wrote") from None
    except (OSError, pa.ArrowException) as error:
        why = str(error).partition("\n")[0]
        raise FleetError(f"{path}: cannot be read: {why}; give a folder that 'calibrator calibrate' wrote") from None
    missing = [name for name in SCHEMA.names if name not in table.column_names]
    if missing:
        raise FleetError(f"{path}: no column {', '.join(missing)}; calibrate again with this version")
    if not run.full_scale_a:
        raise FleetError(f"{result / 'run.json'}: no full_scale_a, it is of an older version; calibrate again")
    rows, K = table.filter(pc.field("branch").is_valid()), len(run.branches)
    if not K or rows["branch"].to_pylist() != list(run.branches) * (rows.num_rows // K):
        raise FleetError(
            f"{path}: the rows are not those of vehicles with the branches {', '.join(run.branches)} of run.json; "
            f"calibrate again"
        )
    columns = {field.name: _values(rows[field.name], field.type).reshape(-1, K) for field in SCHEMA}
    others = table.filter(pc.field("branch").is_null()).select(["vehicle", "reason"]).to_pylist()
    left_out = {row["vehicle"]: row["reason"] or "no reason is stored" for row in others}
    if not rows.num_rows:
        raise FleetError(f"{result}: no vehicle in it has parameters{few_reasons(left_out)}")
    return FleetTable(folder=result, run=run, vehicle=columns["vehicle"][:, 0], columns=columns, left_out=left_out)


def _values(column: pa.ChunkedArray, kind: pa.DataType) -> NDArray[Any]:
    if kind == pa.bool_():
        return np.asarray(pc.fill_null(column, False).to_numpy(zero_copy_only=False), np.bool_)
    if kind == pa.float64():
        return np.asarray(column.cast(kind).to_numpy(zero_copy_only=False), np.float64)
    return np.array(column.to_pylist(), dtype=object)


class _Identifiable(msgspec.Struct, frozen=True):
    identifiable: bool = True


class ParameterDetails(msgspec.Struct, frozen=True):
    """What a parameter file has beyond the columns."""

    branches: dict[str, _Identifiable]
    """Whether the gain of each could be estimated."""
    explanations: list[Explanation] = []
    """Competing ones, the most probable first; none where one was left."""
    findings: list[Finding] = []
    """Of the check of fit."""


@dataclass(frozen=True, kw_only=True)
class Details:
    """What the parameter files of n vehicles add.

    Attributes
    ----------
    files : mapping of int to ParameterDetails
        By the vehicle's place in the table.
    names : sequence of str
        Of the R rows of evidence: ratios [1], then constants [A]; none if the method keeps no evidence.
    value, sd, explained : ndarray of shape (n, R)
        What was measured, its standard deviation, and what the estimate predicts; NaN where it is not known.
    """

    files: Mapping[int, ParameterDetails]
    names: Sequence[str]
    value: Array
    sd: Array
    explained: Array

    @property
    def ratios(self) -> int:
        """How many rows of the evidence are ratios: those before the intercepts."""
        return sum(not name.startswith(("intercept ", "junction ", "offset ")) for name in self.names)


def read_details(table: FleetTable, listed: NDArray[np.int64]) -> Details:
    """Read the parameter files of some vehicles, given by their places; FleetError if one is missing or damaged."""
    run, names = table.run, table.run.details.get("evidence", [])
    order = {str(table.vehicle[j]): i for i, j in enumerate(listed.tolist())}
    files: dict[int, ParameterDetails] = {}
    rows = np.full((3, len(listed), len(names)), np.nan)
    numbers = sorted({bucket_of(name, run.buckets) if run.buckets else 0 for name in order})
    for number in shown(numbers, "read parameters", len(numbers), "files"):
        part = part_file(table.folder, number)
        for vehicle, written in read_part(part).items():
            if (i := order.get(vehicle)) is None:
                continue
            try:
                files[int(listed[i])] = msgspec.json.decode(written.text, type=ParameterDetails)
            except msgspec.DecodeError as error:
                raise FleetError(f"{part}: damaged part of a result: {error}; calibrate again") from None
            evidence = written.evidence
            if evidence is not None and len(evidence.value) == len(names):
                rows[:, i] = np.array([evidence.value, evidence.sd, evidence.explained], float)
    if len(files) < len(listed):
        missing = next(str(table.vehicle[j]) for j in listed.tolist() if j not in files)
        raise FleetError(
            f"{table.folder / 'parameters'}: no parameters of vehicle {missing} there; give the whole folder that "
            f"'calibrator calibrate' wrote"
        )
    return Details(files=files, names=names, value=rows[0], sd=rows[1], explained=rows[2])
