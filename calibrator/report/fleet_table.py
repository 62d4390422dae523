"""A result as columns: N vehicles with K branches from ``results.parquet``, and what their parameter files add."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.estimator.results import (
    ROWS,
    SCHEMA,
    RunRecord,
    deployed_rms_a,
    part_file,
    read_part,
    read_run,
    result_rows,
)
from calibrator.summaries.identity import bucket_of
from calibrator.terminal.progress import shown
from calibrator.terminal.text import few_reasons
from ecu_node.parameters import Explanation, SensorFinding

OPEN_GAIN, OPEN_OFFSET = 0.1, 0.05
"""A gain, or an offset over full scale, counts as not known if its standard deviation is above this or missing. [1]"""

__all__ = ["FleetTable", "ParameterDetails", "read_details", "read_fleet_table"]


@dataclass(frozen=True, kw_only=True)
class FleetTable:
    """Result of a calibration as columns over N vehicles and K branches.

    Attributes
    ----------
    folder : Path
        Folder of the result.
    run : RunRecord
        How it was made.
    columns : mapping of str to ndarray of shape (N, K)
        Columns of ``results.parquet``, in its order of the vehicles that have parameters: numbers (NaN where the method
        gives none), flags, texts (empty where there is none). What belongs to the vehicle as a whole is the same in all
        K places. Added are for each sensor: ``faulty``, a fault was found and is corrected or held back (if the method
        gives no probabilities: any fault); ``error_a``, its error at full scale [A]; ``open_gain`` and
        ``open_offset``, its gain or offset is not known, as the standard deviation is too large.
    left_out : mapping of str to str
        Vehicles without parameters, or files whose vehicle is unclear, with the reason.
    """

    folder: Path
    run: RunRecord
    columns: Mapping[str, NDArray[Any]]
    left_out: Mapping[str, str]

    def __len__(self) -> int:
        return len(self.vehicle)

    @property
    def vehicle(self) -> NDArray[np.object_]:
        """Names of the vehicles, shape (N,)."""
        return self.of_vehicles("vehicle")

    def __getitem__(self, column: str) -> NDArray[Any]:
        """Return a column, shape (N, K)."""
        return self.columns[column]

    def of_vehicles(self, column: str) -> NDArray[Any]:
        """Return a column that belongs to the vehicle as a whole, shape (N,)."""
        return self.columns[column][:, 0]

    def only(self, vehicle: str) -> "FleetTable":
        """Return the table of one vehicle alone."""
        chosen = self.vehicle == vehicle
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return replace(self, columns=columns, left_out={})

    @property
    def branches(self) -> Sequence[str]:
        """Names of the K branches."""
        return self.run.branches

    @property
    def corrected(self) -> Mask:
        """Whether the node corrects some branch of each vehicle, shape (N,); a fault of size 0 is no correction."""
        return np.asarray((self["applied"] & self["faulty"]).any(axis=1))

    @property
    def deployed_a(self) -> Array:
        """Root mean square of each vehicle's Kirchhoff sum with what the node applies, shape (N,). [A]"""
        measured_a, corrected_a = (self.of_vehicles(f"junction_rms_{name}_a") for name in ("measured", "corrected"))
        return deployed_rms_a(self["applied"], measured_a=measured_a, corrected_a=corrected_a)


def read_fleet_table(result: Path) -> FleetTable:
    """Read the folder that ``calibrator calibrate`` wrote; FleetError if it is no result, or not a complete one."""
    run, frame = read_run(result), result_rows(result, SCHEMA.names).to_pandas()
    if not run.full_scale_a:
        raise FleetError(f"{result / 'run.json'}: no full_scale_a, it is of an older version; calibrate again")
    types = {field.name: {pa.bool_(): bool, pa.string(): object}.get(field.type) for field in SCHEMA}
    types = {name: kind for name, kind in types.items() if kind is not None}
    frame = frame.fillna({name: False if kind is bool else "" for name, kind in types.items()}).astype(types)
    is_row, K = frame["branch"] != "", len(run.branches)
    rows, others = frame[is_row], frame[~is_row]
    if not K or rows["branch"].tolist() != list(run.branches) * (len(rows) // K):
        raise FleetError(
            f"{result / ROWS}: the rows are not those of vehicles with the branches {', '.join(run.branches)} of "
            f"run.json; calibrate again"
        )
    left_out = dict(zip(others["vehicle"], others["reason"].replace("", "no reason is stored"), strict=True))
    if rows.empty:
        raise FleetError(f"{result}: no vehicle in it has parameters{few_reasons(left_out)}")
    c = {name: rows[name].to_numpy().reshape(-1, K) for name in SCHEMA.names}
    settled = ~c["applied"] & ~c["held_back"].astype(bool) & np.isfinite(c["fault_probability"])
    c["faulty"] = ((c["drift"] != 0.0) | (c["offset_a"] != 0.0)) & ~settled
    c["error_a"] = c["faulty"] * (np.abs(c["drift"]) * run.full_scale_a + np.abs(c["offset_a"]))
    c["open_gain"] = ~(c["drift_sd"] <= OPEN_GAIN)
    c["open_offset"] = ~(c["offset_sd_a"] <= OPEN_OFFSET * run.full_scale_a)
    return FleetTable(folder=result, run=run, columns=c, left_out=left_out)


class _Identifiable(msgspec.Struct, frozen=True):
    identifiable: bool = True


class ParameterDetails(msgspec.Struct, frozen=True):
    """Contents of a parameter file that the columns do not have."""

    branches: dict[str, _Identifiable]
    """By branch, whether its gain could be estimated."""
    explanations: list[Explanation] = []
    """Competing explanations, the most probable first; empty where only one was left."""
    findings: list[SensorFinding] = []
    """Findings in the recordings of the vehicle."""


def read_details(table: FleetTable, listed: NDArray[np.int64]) -> tuple[dict[int, ParameterDetails], list[str], Array]:
    """Read what the parameter files of n vehicles add to the table; ``listed`` has their places in it, shape (n,).

    Returns
    -------
    files : dict of int to ParameterDetails
        Details by the vehicle's place in the table.
    names : list of str
        Names of the R rows of evidence: ratios [1], then constants [A]; empty if the method keeps no evidence.
    rows : ndarray of shape (n, 3, R)
        Measured value of each row, its standard deviation, and what the estimate predicts; NaN where not known.

    Raises
    ------
    FleetError
        If a file is missing or damaged.
    """
    run, names = table.run, list(table.run.details.get("evidence", []))
    order = {str(table.vehicle[j]): i for i, j in enumerate(listed.tolist())}
    files: dict[int, ParameterDetails] = {}
    rows = np.full((len(listed), 3, len(names)), np.nan)
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
            if written.evidence is not None and written.evidence.shape[1] == len(names):
                rows[i] = written.evidence
    if missing := [str(table.vehicle[j]) for j in listed.tolist() if j not in files]:
        raise FleetError(
            f"{table.folder / 'parameters'}: no parameters of vehicle {missing[0]} there; give the whole folder that "
            f"'calibrator calibrate' wrote"
        )
    return files, names, rows
