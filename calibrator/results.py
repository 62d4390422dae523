"""Result of a calibration: ``RESULT/params/VEHICLE.json``, ``RESULT/results.parquet`` and ``RESULT/run.json``.

``results.parquet`` has one row per vehicle and branch; a vehicle that was left out has one row without branch. The
folder appears only when it is complete.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from calibrator.errors import FleetError
from calibrator.folders import whole_folder
from ecu_node.parameters import VehicleParameters, write_atomically, write_parameters

__all__ = ["LeftOut", "RunRecord", "read_results", "read_run", "write_results"]

LEFT_OUT = "left out"
"""Stands for the verdict of a vehicle, or of a file of unclear vehicle, that has no parameters."""

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
    ]
)


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """A vehicle without parameters, and why."""

    vehicle: str
    reason: str


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """How a result was made."""

    tool: str
    method: str
    fleet: str
    fleet_ids: list[str] = []
    """Artificial fleets that the drives come from; empty if they are recorded."""
    layout: str
    branches: list[str]
    model_inputs: list[str]
    settings: dict[str, Any]
    """What the user chose: hold-out and trusted vehicles, harm limit, or the published method's classifier."""
    created: str
    details: dict[str, Any]
    """What the method tells of its run: unity drive and simulation SNR, or reference, delays and hyper-parameters."""
    vehicles: int
    left_out: dict[str, str]
    notices: list[str]


def write_results(
    out: Path, parameters: Sequence[VehicleParameters], left_out: Sequence[LeftOut], run: RunRecord
) -> None:
    """Write a whole result folder, or none.

    Parameters
    ----------
    out : Path
        New or empty folder.
    parameters : sequence of VehicleParameters
        One per calibrated vehicle.
    left_out : sequence of LeftOut
        The other vehicles.
    run : RunRecord
        How it was made.

    Raises
    ------
    FleetError
        If the folder exists and is not empty.
    """
    with whole_folder(out) as folder:
        (folder / "params").mkdir()
        for item in parameters:
            write_parameters(item, folder / "params" / f"{item.vehicle}.json")
        rows = [row for item in parameters for row in _rows(item)]
        rows += [{"vehicle": v.vehicle, "verdict": LEFT_OUT, "reason": v.reason} for v in left_out]
        pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), folder / "results.parquet", compression="zstd")
        write_atomically(folder / "run.json", msgspec.json.format(msgspec.json.encode(run), indent=2) + b"\n")


def read_results(result: Path) -> list[dict[str, Any]]:
    """Rows of ``results.parquet`` of a result folder; FleetError if it is none."""
    path = result / "results.parquet"
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        first_line = str(error).splitlines()[0]
        raise FleetError(f"{path}: not a result of 'calibrator calibrate': {first_line}") from None
    missing = [name for name in SCHEMA.names if name not in table.column_names]
    if missing:
        raise FleetError(f"{path}: column {', '.join(missing)} is missing; write the result anew with this version")
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


def read_run(result: Path) -> RunRecord:
    """``run.json`` of a result folder; FleetError if it is none."""
    path = result / "run.json"
    try:
        return msgspec.json.decode(path.read_bytes(), type=RunRecord)
    except OSError as error:
        raise FleetError(f"{path}: not a result of 'calibrator calibrate': {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FleetError(f"{path}: not a run of 'calibrator calibrate': {error}; calibrate again") from None


def _rows(item: VehicleParameters) -> list[dict[str, Any]]:
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
        }
        for name, branch in item.branches.items()
    ]
