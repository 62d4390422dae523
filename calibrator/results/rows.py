"""What a result says of each sensor: ``RESULT/results.parquet``, one row per vehicle and branch.

A vehicle that was left out has one row without branch.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from calibrator.errors import FleetError
from calibrator.results.left_out import LEFT_OUT, left_out_rows
from calibrator.results.parquet_bytes import parquet_bytes
from calibrator.results.run_record import REMEDY
from ecu_node.parameters import VehicleParameters

__all__ = ["SCHEMA", "join_rows", "read_results", "vehicle_rows"]

MOST_SORTED = 100_000
"""Rows of results that are put in the order of the vehicles."""

SCHEMA = pa.schema(
    [
        pa.field("vehicle", pa.string(), nullable=False),
        pa.field("branch", pa.string()),
        pa.field("verdict", pa.string(), nullable=False),
        pa.field("drift", pa.float64(), metadata={"unit": "1"}),
        pa.field("offset_a", pa.float64(), metadata={"unit": "A"}),
        pa.field("drift_sd", pa.float64(), metadata={"unit": "1"}),
        pa.field("offset_sd_a", pa.float64(), metadata={"unit": "A"}),
        pa.field("delay_s", pa.float64(), metadata={"unit": "s"}),
        pa.field("applied", pa.bool_()),
        pa.field("held_back", pa.string()),
        pa.field("confidence", pa.float64(), metadata={"unit": "1"}),
        pa.field("fault_probability", pa.float64(), metadata={"unit": "1"}),
        pa.field("harm_probability", pa.float64(), metadata={"unit": "1"}),
        pa.field("hardware_fault", pa.bool_()),
        pa.field("hardware_probability", pa.float64(), metadata={"unit": "1"}),
        pa.field("hardware_drift", pa.float64(), metadata={"unit": "1"}),
        pa.field("hardware_offset_a", pa.float64(), metadata={"unit": "A"}),
        pa.field("junction_rms_measured_a", pa.float64(), metadata={"unit": "A"}),
        pa.field("junction_rms_corrected_a", pa.float64(), metadata={"unit": "A"}),
        pa.field("duration_s", pa.float64(), metadata={"unit": "s"}),
        pa.field("reason", pa.string()),
        pa.field("moved", pa.string()),
    ]
)


def vehicle_rows(item: VehicleParameters) -> list[dict[str, Any]]:
    """Rows of a vehicle, one per branch."""
    return [
        {
            "vehicle": item.vehicle,
            "branch": name,
            "verdict": item.verdict,
            "drift": branch.drift,
            "offset_a": branch.offset_a,
            "drift_sd": branch.drift_sd,
            "offset_sd_a": branch.offset_sd_a,
            "delay_s": branch.delay_s,
            "applied": branch.apply,
            "held_back": branch.held_back,
            "confidence": item.confidence,
            "fault_probability": branch.fault_probability,
            "harm_probability": branch.harm_probability,
            "hardware_fault": item.hardware_fault.suspected,
            "hardware_probability": item.hardware_fault.probability,
            "hardware_drift": item.hardware_fault.drift,
            "hardware_offset_a": item.hardware_fault.offset_a.get(name, 0.0),
            "junction_rms_measured_a": item.junction_residual.measured_a,
            "junction_rms_corrected_a": item.junction_residual.corrected_a,
            "duration_s": item.provenance.duration_s,
            "reason": item.deciding_evidence or None,
        }
        for name, branch in item.branches.items()
    ]


def join_rows(folder: Path, parts: Sequence[Path], left_out: Mapping[str, str]) -> int:
    """Join the rows of all chunks to ``results.parquet``; up to :data:`MOST_SORTED` rows in order of the vehicles.

    Parameters
    ----------
    folder : Path
        Of the result; it must exist.
    parts : sequence of Path
        Files with the rows of each chunk.
    left_out : mapping of str to str
        Vehicles, or files of unclear vehicle, that are in no chunk, and why.

    Returns
    -------
    int
        Number of vehicles that have parameters.
    """
    path, calibrated, rows, others = folder / "results.parquet", 0, 0, dict(left_out)
    with pq.ParquetWriter(path, SCHEMA, compression="zstd") as writer:
        for part in parts:
            table = pq.read_table(part, schema=SCHEMA, use_threads=False)
            vehicles = pc.unique(table["vehicle"]).to_pylist()
            calibrated += len(pc.unique(table.filter(pc.field("branch").is_valid())["vehicle"]))
            rows += table.num_rows
            for name in others.keys() & set(vehicles):
                del others[name]
            writer.write_table(table)
        writer.write_table(pa.Table.from_pylist(left_out_rows(others), schema=SCHEMA))
    if rows <= MOST_SORTED:
        found = pq.read_table(path, schema=SCHEMA, use_threads=False).to_pylist()
        found.sort(key=lambda row: (row["verdict"] == LEFT_OUT, row["vehicle"]))  # stable: branches keep their order
        path.write_bytes(parquet_bytes(found, SCHEMA))
    return calibrated


def read_results(result: Path) -> list[dict[str, Any]]:
    """Rows of ``results.parquet`` of a result folder; FleetError if it is none."""
    path = result / "results.parquet"
    try:
        table = pq.read_table(path, use_threads=False)
    except (OSError, pa.ArrowInvalid) as error:
        first_line = str(error).splitlines()[0]
        raise FleetError(f"{path}: not a result of 'calibrator calibrate': {first_line}; {REMEDY}") from None
    missing = [name for name in SCHEMA.names if name not in table.column_names]
    if missing:
        raise FleetError(f"{path}: column {', '.join(missing)} is missing; write the result anew with this version")
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows
