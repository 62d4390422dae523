"""Result of a calibration: parameter files, ``RESULT/results.parquet`` and ``RESULT/run.json``.

``results.parquet`` has one row per vehicle and branch; a vehicle that was left out has one row without branch.
Parameter files are rows of ``RESULT/parameters/NNNNN.parquet``, by the bucket of the vehicle, and for up to
:data:`MOST_FILES` vehicles also ``RESULT/params/VEHICLE.json``: a folder of a million files is no use.

A fleet is calibrated in chunks. Each chunk gives a :class:`ChunkResult`; what a result says of the fleet as a whole is
computed from them.
"""

import io
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from calibrator.errors import FleetError
from calibrator.evidence.vehicle_evidence import VehicleEvidence
from calibrator.summaries.buckets import bucket_of
from ecu_node.errors import ParameterError
from ecu_node.parameters import VehicleParameters, encode_parameters
from ecu_node.user_files import write_atomically

__all__ = [
    "LEFT_OUT",
    "PARTS",
    "ChunkResult",
    "RunRecord",
    "Written",
    "encode_chunk",
    "join_rows",
    "left_out_of",
    "parameters_of",
    "read_part",
    "read_results",
    "read_run",
    "write_parameter_files",
    "write_run",
    "written_of",
]

LEFT_OUT = "left out"
"""Stands for the verdict of a vehicle, or of a file of unclear vehicle, that has no parameters."""

MOST_FILES = 10_000
"""Vehicles whose parameters are files of their own in one folder."""
MOST_SORTED = 100_000
"""Rows of results that are put in the order of the vehicles."""
PARTS, FILES = "parameters", "params"
PARAMETERS_SCHEMA = pa.schema(
    [
        pa.field("vehicle", pa.string(), nullable=False),
        pa.field("drives", pa.string(), nullable=False, metadata={"meaning": "digest of the drives' files"}),
        pa.field("parameters", pa.string(), nullable=False, metadata={"meaning": "text of the parameter file"}),
        pa.field("evidence_value", pa.list_(pa.float32()), metadata={"meaning": "rows named in run.json"}),
        pa.field("evidence_sd", pa.list_(pa.float32()), metadata={"meaning": "standard deviation of the same"}),
        pa.field("evidence_explained", pa.list_(pa.float32()), metadata={"meaning": "what the estimate makes of it"}),
    ]
)

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

_REMEDY = "name a folder that 'calibrator calibrate --out' wrote"


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
    buckets: int = 0
    """Files that the parameters are spread over by the hash of the vehicle; 0: all are in the first."""
    left_out: dict[str, str]
    """Why vehicles have no parameters; of many the first ones."""
    left_out_count: int = 0
    full_scale_a: float = 0.0
    """Of the junction; 0: not known. [A]"""
    layout_sha256: str = ""
    dbc_sha256: str = ""
    notices: list[str]


@dataclass(frozen=True, kw_only=True)
class ChunkResult:
    """What some vehicles of a fleet gave, as files.

    Attributes
    ----------
    rows : bytes
        Their part of ``results.parquet``.
    parameters : bytes
        Parquet with the texts of their parameter files, see :data:`PARAMETERS_SCHEMA`.
    """

    rows: bytes
    parameters: bytes


@dataclass(frozen=True, kw_only=True)
class Written:
    """Parameters of one vehicle as they were written.

    Attributes
    ----------
    drives : str
        Digest of the drives' files; empty if it is not known.
    text : bytes
        Of the parameter file.
    evidence : VehicleEvidence or None
        What they were found from; None if it was not kept.
    """

    drives: str
    text: bytes
    evidence: VehicleEvidence | None = None


def encode_chunk(
    parameters: Sequence[VehicleParameters],
    left_out: Mapping[str, str],
    *,
    moved: Mapping[tuple[str, str], str] | None = None,
    drives: Mapping[str, str] | None = None,
    evidence: Mapping[str, VehicleEvidence] | None = None,
) -> ChunkResult:
    """Write down what a chunk gave.

    Parameters
    ----------
    parameters : sequence of VehicleParameters
        One per calibrated vehicle; one whose parameters cannot be written is left out.
    left_out : mapping of str to str
        Why the other vehicles have none.
    moved : mapping of (str, str) to str, or None
        What has moved since an earlier result, by vehicle and branch.
    drives : mapping of str to str, or None
        Digest of the drives' files by vehicle.
    evidence : mapping of str to VehicleEvidence, or None
        What the parameters were found from, by vehicle.

    Returns
    -------
    ChunkResult
        In the order of the vehicles' names.
    """
    rows: list[dict[str, Any]] = []
    texts: list[dict[str, Any]] = []
    reasons = dict(left_out)
    for item in sorted(parameters, key=lambda item: item.vehicle):
        try:
            text = encode_parameters(item, f"parameters of {item.vehicle}").decode()
        except ParameterError as error:
            reasons[item.vehicle] = f"{error}; look at its recordings"
            continue
        texts.append(
            {
                "vehicle": item.vehicle,
                "drives": (drives or {}).get(item.vehicle, ""),
                "parameters": text,
                **_evidence_columns((evidence or {}).get(item.vehicle)),
            }
        )
        rows += [{**row, "moved": (moved or {}).get((item.vehicle, row["branch"]))} for row in _rows(item)]
    rows += left_out_rows(reasons)
    return ChunkResult(rows=_parquet(rows, SCHEMA), parameters=_parquet(texts, PARAMETERS_SCHEMA))


def _evidence_columns(evidence: VehicleEvidence | None) -> dict[str, list[float | None] | list[float]]:
    if evidence is None:
        return {}
    return {f"evidence_{name}": values for name, values in vars(evidence).items()}


def _evidence_of(row: Mapping[str, Any]) -> VehicleEvidence | None:
    if row.get("evidence_value") is None:
        return None
    return VehicleEvidence(value=row["evidence_value"], sd=row["evidence_sd"], explained=row["evidence_explained"])


def left_out_rows(left_out: Mapping[str, str]) -> list[dict[str, Any]]:
    """Rows of vehicles that have no parameters."""
    return [{"vehicle": vehicle, "verdict": LEFT_OUT, "reason": left_out[vehicle]} for vehicle in sorted(left_out)]


def _parquet(rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), buffer, compression="zstd")
    return buffer.getvalue()


def read_part(path: Path) -> dict[str, Written]:
    """Parameters of a chunk by vehicle, from a file of a result; none if there is no such file.

    Raises
    ------
    FleetError
        If the file is damaged.
    """
    try:
        rows = pq.ParquetFile(path).read(use_threads=False).to_pylist()
        return {
            row["vehicle"]: Written(drives=row["drives"], text=row["parameters"].encode(), evidence=_evidence_of(row))
            for row in rows
        }
    except FileNotFoundError:
        return {}
    except (pa.ArrowException, OSError, KeyError) as error:
        reason = str(error).partition("\n")[0][:120]
        raise FleetError(f"{path}: damaged part of a result: {reason}; calibrate again") from None


def join_rows(folder: Path, parts: Sequence[Path], left_out: Mapping[str, str]) -> int:
    """Join the rows of all chunks to ``results.parquet``; of up to :data:`MOST_FILES` vehicles in order of their names.

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
        path.write_bytes(_parquet(found, SCHEMA))
    return calibrated


def write_parameter_files(folder: Path, parts: Mapping[int, Path], *, vehicles: int) -> str:
    """Write the parameter files of a result.

    Parameters
    ----------
    folder : Path
        Of the result; it must exist.
    parts : mapping of int to Path
        Files with the parameters of each chunk, by its number.
    vehicles : int
        How many there are in all.

    Returns
    -------
    str
        Where they are for the user, within the folder.
    """
    (folder / PARTS).mkdir()
    for number, part in parts.items():
        shutil.copyfile(part, folder / PARTS / f"{number:05d}.parquet")
    if vehicles > MOST_FILES:
        return PARTS
    (folder / FILES).mkdir()
    for part in parts.values():
        for vehicle, written in read_part(part).items():
            write_atomically(folder / FILES / f"{vehicle}.json", written.text)
    return FILES


def parameters_of(result: Path, vehicle: str) -> bytes:
    """Text of the parameter file of one vehicle, as :func:`written_of`."""
    return written_of(result, vehicle).text


def written_of(result: Path, vehicle: str) -> Written:
    """Parameters of one vehicle.

    Parameters
    ----------
    result : Path
        Folder of a result.
    vehicle : str
        Name.

    Returns
    -------
    Written
        With the text as the node reads it.

    Raises
    ------
    FleetError
        If it is no result, or there are no parameters of this vehicle in it.
    """
    run = read_run(result)
    number = bucket_of(vehicle, run.buckets) if run.buckets else 0
    found = read_part(result / PARTS / f"{number:05d}.parquet")
    if vehicle not in found:
        if not (result / PARTS).is_dir():
            raise FleetError(f"{result / PARTS}: no such folder; give all that 'calibrator calibrate' wrote")
        why = _left_out_reason(result / "results.parquet", vehicle)
        if why is None:
            raise FleetError(f"{result}: no vehicle {vehicle!r} in it; results.parquet names all that are")
        raise FleetError(f"{result}: no parameters of vehicle {vehicle!r}, it was left out: {why}")
    return found[vehicle]


def _left_out_reason(path: Path, vehicle: str) -> str | None:
    """Why a vehicle has no parameters; None if nothing is said of it."""
    try:
        table = pq.ParquetFile(path).read(columns=["vehicle", "reason"], use_threads=False)
        rows = table.filter(pc.equal(table["vehicle"], vehicle)).to_pylist()
    except (pa.ArrowException, OSError):
        return None
    return str(rows[0]["reason"]) if rows else None


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


def write_run(folder: Path, run: RunRecord) -> None:
    """Write ``run.json``."""
    write_atomically(folder / "run.json", msgspec.json.format(msgspec.json.encode(run), indent=2) + b"\n")


def read_results(result: Path) -> list[dict[str, Any]]:
    """Rows of ``results.parquet`` of a result folder; FleetError if it is none."""
    path = result / "results.parquet"
    try:
        table = pq.read_table(path, use_threads=False)
    except (OSError, pa.ArrowInvalid) as error:
        first_line = str(error).splitlines()[0]
        raise FleetError(f"{path}: not a result of 'calibrator calibrate': {first_line}; {_REMEDY}") from None
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
        raise FleetError(f"{path}: not a result of 'calibrator calibrate': {error.strerror}; {_REMEDY}") from None
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
            "reason": item.deciding_evidence or None,
        }
        for name, branch in item.branches.items()
    ]
