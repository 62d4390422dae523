"""Result of a calibration: a folder that is written once and read by later commands.

``run.json`` says how it was made (:class:`RunRecord`). ``results.parquet`` has one row per vehicle and branch, and one
without branch for each vehicle that was left out. ``buckets/NNNNN.parquet`` has the same rows by bucket of the vehicle,
and in the first row of each vehicle the text of its parameter file. Up to :data:`MOST_FILES` vehicles also have a file
``params/VEHICLE.json`` each; a folder of a million files would be of no use.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from calibrator.drive import Array, Equipment, Mask
from calibrator.errors import FleetError
from calibrator.estimator.settings import CONFIDENT, RunIdentity
from calibrator.estimator.vehicle_report import held_back_lines
from calibrator.summaries.identity import bucket_of
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import dumps, left_out_text, reasons_text, table
from ecu_node.documents import write_atomically
from ecu_node.errors import ParameterError
from ecu_node.parameters import VehicleParameters, encode_parameters

__all__ = [
    "MOST_FILES",
    "PARTS",
    "SCHEMA",
    "Calibrated",
    "CalibrationReport",
    "RunRecord",
    "WrittenVehicle",
    "complete_result",
    "deployed_rms_a",
    "encode_chunk",
    "left_out_of",
    "part_file",
    "parts_of",
    "read_part",
    "read_results",
    "read_run",
    "result_rows",
    "written_of",
]

MOST_FILES = 10_000
"""Largest number of vehicles whose parameters are files of their own in one folder."""
MOST_SORTED = 100_000
"""Largest number of rows of results that are sorted by vehicle."""
MOST_NAMED = 1000
"""Largest number of vehicles that a report names one by one; all of them are in ``results.parquet``."""
PARTS, FILES, ROWS = "buckets", "params", "results.parquet"
LEFT_OUT = "left out"
"""Verdict in the rows of a vehicle without parameters, or of a file whose vehicle is unclear."""
REMEDY = "name a folder that 'calibrator calibrate --out' wrote"
Rows = list[dict[str, Any]]

_UNITS = {
    "drift": "1",
    "offset_a": "A",
    "drift_sd": "1",
    "offset_sd_a": "A",
    "delay_s": "s",
    "applied": None,
    "held_back": "",
    "confidence": "1",
    "fault_probability": "1",
    "harm_probability": "1",
    "hardware_fault": None,
    "hardware_probability": "1",
    "hardware_drift": "1",
    "hardware_offset_a": "A",
    "junction_rms_measured_a": "A",
    "junction_rms_corrected_a": "A",
    "duration_s": "s",
    "reason": "",
    "moved": "",
}
"""Columns after vehicle, branch and verdict: numbers with their unit, texts (empty), and flags (None)."""


def _column(name: str, unit: str | None) -> pa.Field:
    kind = pa.float64() if unit else pa.bool_() if unit is None else pa.string()
    return pa.field(name, kind, metadata={"unit": unit} if unit else None)


_NAMES = [pa.field(name, pa.string(), nullable=name == "branch") for name in ("vehicle", "branch", "verdict")]
SCHEMA = pa.schema([*_NAMES, *(_column(name, unit) for name, unit in _UNITS.items())])
"""Schema of ``results.parquet``."""
_EVIDENCE = ["evidence_value", "evidence_sd", "evidence_explained"]
_ONCE = ["drives", "parameters", *_EVIDENCE]
"""Columns that have values only in a vehicle's first row: digest of the drives' files, text of the parameter file, and
the rows of evidence named in ``run.json``: their values, standard deviations, and what the estimate predicts."""
PART_SCHEMA = pa.schema(
    [*SCHEMA, *(pa.field(name, pa.list_(pa.float32()) if name in _EVIDENCE else pa.string()) for name in _ONCE)]
)
"""Schema of a part, the vehicles of one bucket."""


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """How a result was made, the content of its ``run.json``."""

    tool: str
    method: str
    fleet: str
    layout: str
    branches: list[str]
    model_inputs: list[str]
    settings: dict[str, Any]
    """What the user chose: branches, held-out vehicles; for the posterior method also harm limit, trust, load, etc."""
    created: str
    details: dict[str, Any]
    """What the method records of its run: reference and hyperparameters of a fleet, gain ratios and constants of
    single junctions, or unity drive and simulation SNR of the published method."""
    vehicles: int
    buckets: int = 0
    """Number of files that parameters are spread over by the hash of the vehicle; 0: all are in the first."""
    left_out: dict[str, str]
    """Why vehicles have no parameters; if they are many, only the first ones."""
    left_out_count: int = 0
    full_scale_a: float = 0.0
    """Full scale of the junction; 0: not known. [A]"""
    layout_sha256: str = ""
    dbc_sha256: str = ""
    notices: list[str]


class WrittenVehicle(NamedTuple):
    """Parameters of one vehicle as they were written."""

    drives: str
    """Digest of the drives' files; empty: not known."""
    text: bytes
    evidence: Array | None
    """As in :class:`Calibrated`."""


class Calibrated(NamedTuple):
    """What was found for a vehicle that has parameters."""

    parameters: VehicleParameters
    evidence: Array | None = None
    """Evidence that they were found from, shape (3, 5K), see :func:`.reported_evidence`; None: not kept."""
    drives: str = ""
    """Digest of the drives' files; empty: not known."""
    moved: Mapping[str, str] = {}
    """How sensors have moved since an earlier result, by branch."""


def encode_chunk(found: Mapping[str, Calibrated | str]) -> bytes:
    """Encode what was found for some vehicles as the content of a part file of the result.

    Parameters
    ----------
    found : mapping of str to Calibrated or str
        By vehicle what was found, or why it is left out; one whose parameters cannot be written is left out as well.

    Returns
    -------
    bytes
        Parquet, with the columns of :data:`PART_SCHEMA`; vehicles are sorted by name, those left out come last.
    """
    rows, left_out = Rows(), dict[str, str]()
    for name, item in sorted(found.items()):
        if isinstance(item, str):
            left_out[name] = item
            continue
        try:
            rows += _rows_of(item)
        except ParameterError as error:
            left_out[name] = f"{error}; look at its recordings"
    return _parquet(pa.Table.from_pylist(rows + _left_out_rows(left_out), schema=PART_SCHEMA))


def _rows_of(found: Calibrated) -> Rows:
    """Return the rows of a vehicle, one per branch; a row may have keys that are no columns, which are not written."""
    item = found.parameters
    hardware, residual = item.hardware_fault, item.junction_residual
    measured_a, corrected_a = residual.measured_a, residual.corrected_a
    if item.provenance.fleet_size == 1:  # the user declared the expected sum; in a fleet it is estimated
        measured_a, corrected_a = residual.about_expected()
    rows: Rows = [
        {
            **msgspec.structs.asdict(branch),
            "vehicle": item.vehicle,
            "branch": name,
            "verdict": item.verdict,
            "applied": branch.apply,
            "confidence": item.confidence,
            "hardware_fault": hardware.suspected,
            "hardware_probability": hardware.probability,
            "hardware_drift": hardware.drift,
            "hardware_offset_a": hardware.offset_a.get(name, 0.0),
            "junction_rms_measured_a": measured_a,
            "junction_rms_corrected_a": corrected_a,
            "duration_s": item.provenance.duration_s,
            "reason": item.deciding_evidence or "; ".join(held_back_lines(item)) or None,
            "moved": found.moved.get(name),
        }
        for name, branch in item.branches.items()
    ]
    text = encode_parameters(item, f"parameters of {item.vehicle}").decode()
    rows[0] |= {"drives": found.drives, "parameters": text}
    rows[0] |= {} if found.evidence is None else dict(zip(_EVIDENCE, found.evidence, strict=True))
    return rows


def _left_out_rows(left_out: Mapping[str, str]) -> Rows:
    return [{"vehicle": vehicle, "verdict": LEFT_OUT, "reason": left_out[vehicle]} for vehicle in sorted(left_out)]


def _parquet(rows: pa.Table) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(rows, buffer, compression="zstd")
    return buffer.getvalue()


def complete_result(
    result: Path,
    out: Path,
    identity: RunIdentity,
    equipment: Equipment,
    *,
    details: Mapping[str, object],
    notices: Sequence[str],
    others: Mapping[str, str] = {},
    buckets: int = 0,
) -> "CalibrationReport":
    """Complete a result folder from its parts, and report.

    Parameters
    ----------
    result, out : Path
        Temporary folder of the result, and the path that it will have.
    identity : RunIdentity
        Identity of the run.
    equipment : Equipment
        Branches and inputs of the fleet, and notices about them.
    details : mapping of str to JSON values
        What the method records of its run.
    notices : sequence of str
        Notices of the method for the user, one line each.
    others : mapping of str to str
        Why files whose vehicle is unclear are in none of the parts.
    buckets : int
        Number of parts that vehicles are spread over; 0: all are in the first.

    Returns
    -------
    CalibrationReport
        Report on all vehicles of the result.

    Raises
    ------
    FleetError
        If no vehicle has parameters.
    """
    layout = identity.database.layout
    vehicles, left_out = join_rows(result, others), left_out_of(result)
    if not vehicles:
        why = next(iter(left_out.values()), "there is none")
        raise FleetError(f"{identity.fleet}: no vehicle can be calibrated; the first: {why}")
    with progress_bar("write the result", None):
        where = write_parameter_files(result, vehicles=vehicles)
    run = RunRecord(
        tool=identity.tool,
        method=identity.settings.method.value,
        fleet=identity.fleet,
        layout=layout.name,
        branches=list(equipment.branches),
        model_inputs=list(equipment.inputs),
        settings=identity.settings.record(),
        created=identity.created,
        details=dict(details),
        vehicles=vehicles,
        buckets=buckets,
        left_out=dict(list(left_out.items())[:MOST_NAMED]),
        left_out_count=len(left_out),
        full_scale_a=layout.full_scale_a,
        layout_sha256=layout.digest,
        dbc_sha256=identity.database.digest,
        notices=[*equipment.notices, *notices],
    )
    write_run(result, run)
    return report_of(result, run, parameters=where, shown=out)


def join_rows(folder: Path, left_out: Mapping[str, str]) -> int:
    """Join the rows of all parts to ``results.parquet``; up to :data:`MOST_SORTED` rows are sorted by vehicle.

    Parameters
    ----------
    folder : Path
        Folder of the result, with its parts.
    left_out : mapping of str to str
        Why files whose vehicle is unclear were left out.

    Returns
    -------
    int
        Number of vehicles that have parameters.
    """
    path, calibrated = folder / ROWS, 0
    with pq.ParquetWriter(path, SCHEMA, compression="zstd") as writer:
        for part in parts_of(folder).values():
            found = pq.read_table(part, columns=SCHEMA.names, use_threads=False)
            calibrated += len(pc.unique(found.filter(pc.field("branch").is_valid())["vehicle"]))
            writer.write_table(found)
        writer.write_table(pa.Table.from_pylist(_left_out_rows(left_out), schema=SCHEMA))
    if pq.read_metadata(path).num_rows <= MOST_SORTED:
        rows = pq.read_table(path, use_threads=False)
        keys = pa.table({"left_out": pc.equal(rows["verdict"], LEFT_OUT), "vehicle": rows["vehicle"]})
        order = pc.sort_indices(keys, [(name, "ascending") for name in keys.column_names])  # branches keep their order
        path.write_bytes(_parquet(rows.take(order)))
    return calibrated


def write_parameter_files(folder: Path, *, vehicles: int) -> str:
    """Write a parameter file for each vehicle of a result, unless there are too many.

    Return the name of the subfolder that holds the parameters: that of these files, or that of the parts.
    """
    if vehicles > MOST_FILES:
        return PARTS
    (folder / FILES).mkdir(exist_ok=True)
    for part in parts_of(folder).values():
        for vehicle, written in read_part(part).items():
            write_atomically(folder / FILES / f"{vehicle}.json", written.text)
    return FILES


def parts_of(result: Path) -> dict[int, Path]:
    """Find the part files of a result, by the numbers of their buckets."""
    return {int(path.stem): path for path in sorted((result / PARTS).glob(f"{'[0-9]' * 5}.parquet"))}


def part_file(result: Path, number: int) -> Path:
    """Return the path of the part file that holds the vehicles of bucket ``number``, whether it exists or not."""
    return result / PARTS / f"{number:05d}.parquet"


def read_part(path: Path) -> dict[str, WrittenVehicle]:
    """Read the parameters in a part file by vehicle; none if there is no such file, FleetError if it is damaged."""
    try:
        rows = pq.ParquetFile(path).read(["vehicle", *_ONCE], use_threads=False)
        found = {}
        for row in rows.filter(pc.field("parameters").is_valid()).to_pylist():
            kept = row["evidence_value"] is not None
            evidence = np.array([row[name] for name in _EVIDENCE], float) if kept else None
            found[row["vehicle"]] = WrittenVehicle(row["drives"], row["parameters"].encode(), evidence)
        return found
    except FileNotFoundError:
        return {}
    except (pa.ArrowException, OSError, KeyError) as error:
        raise FleetError(f"{path}: damaged part of a result: {_first_line(error)}; calibrate again") from None


def written_of(result: Path, vehicle: str) -> WrittenVehicle:
    """Read the parameters of one vehicle; FleetError if the folder is no result, or has none of this vehicle."""
    run = read_run(result)
    found = read_part(part_file(result, bucket_of(vehicle, run.buckets) if run.buckets else 0))
    if vehicle in found:
        return found[vehicle]
    if not (result / PARTS).is_dir():
        raise FleetError(f"{result / PARTS}: no such folder; give all that 'calibrator calibrate' wrote")
    reason = left_out_of(result).get(vehicle)
    if reason is None:
        raise FleetError(f"{result}: no vehicle {vehicle!r} in it; {ROWS} names all that are")
    raise FleetError(f"{result}: no parameters of vehicle {vehicle!r}, it was left out: {reason}")


def left_out_of(result: Path) -> dict[str, str]:
    """Read from ``results.parquet`` which vehicles have no parameters, and why; FleetError if it is no result."""
    found = result_rows(result, ["vehicle", "branch", "reason"])
    return {row["vehicle"]: row["reason"] for row in found.filter(pc.field("branch").is_null()).to_pylist()}


def read_results(result: Path) -> Rows:
    """Read the rows of ``results.parquet`` in a result folder; FleetError if it is no result."""
    rows: Rows = result_rows(result, SCHEMA.names).to_pylist()
    return rows


def result_rows(result: Path, columns: list[str]) -> pa.Table:
    """Read columns of ``results.parquet`` in a result folder; FleetError if it is no result, or lacks one of them."""
    path = result / ROWS
    try:
        found = pq.read_table(path, columns=columns, use_threads=False)
    except (OSError, pa.ArrowInvalid) as error:
        why = "no such file" if isinstance(error, FileNotFoundError) else _first_line(error)
        raise FleetError(f"{path}: not a result of 'calibrator calibrate': {why}; {REMEDY}") from None
    if missing := [name for name in columns if name not in found.column_names]:
        raise FleetError(f"{path}: column {', '.join(missing)} is missing; write the result anew with this version")
    return found


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0][:120]


def write_run(folder: Path, run: RunRecord) -> None:
    """Write ``run.json`` into a result folder."""
    write_atomically(folder / "run.json", msgspec.json.format(msgspec.json.encode(run), indent=2) + b"\n")


def read_run(result: Path) -> RunRecord:
    """Read ``run.json`` of a result folder; FleetError if it is no result."""
    path = result / "run.json"
    try:
        return msgspec.json.decode(path.read_bytes(), type=RunRecord)
    except OSError as error:
        raise FleetError(f"{path}: not a result of 'calibrator calibrate': {error.strerror}; {REMEDY}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FleetError(f"{path}: not a run of 'calibrator calibrate': {error}; calibrate again") from None


def deployed_rms_a(applied: Mask, *, measured_a: Array, corrected_a: Array) -> Array:
    """Return the RMS of the Kirchhoff sum with what the node applies, shape (N,); as measured if that is nothing. [A]

    Parameters
    ----------
    applied : ndarray of bool, shape (N, K)
        Branches that the node corrects.
    measured_a, corrected_a : ndarray of shape (N,)
        RMS of the Kirchhoff sum as measured, and with what is applied. [A]
    """
    return np.where(applied.any(axis=1), corrected_a, measured_a)


@dataclass(frozen=True, kw_only=True)
class CalibrationReport:
    """Summary of a calibration, as text and as JSON; each list names at most :data:`MOST_NAMED` vehicles."""

    result: str
    """Folder; empty: not written."""
    parameters: str
    """Where in the result the parameter files are."""
    run: RunRecord
    verdicts: Mapping[str, int]
    """Number of vehicles with each verdict."""
    undecided: Mapping[str, str]
    """Vehicles with the verdict "cannot tell", and what would decide."""
    corrected: Mapping[str, str]
    """Vehicles with corrected branches, and which these are."""
    hardware_suspected: Mapping[str, str]
    """Vehicles that are thought to differ from their fleet, and how probable that is."""
    hardware_count: int
    held_back: Mapping[str, int]
    """Number of branches in which a fault was found but is not corrected, by reason."""
    moved: Mapping[str, str]
    """Vehicles with sensors that have moved since an earlier result, and how."""
    moved_count: int
    junction_rms_measured_a: float
    """Median over vehicles of the RMS of the junction sum, as measured. [A]"""
    junction_rms_deployed_a: float
    """Median over vehicles of the RMS of the junction sum, with the parameters that the node applies. [A]"""

    def as_json(self) -> str:
        """Return the report as JSON."""
        return dumps(vars(self))

    def as_text(self) -> str:
        """Return the report as readable text."""
        run, details = self.run, self.run.details
        load_a = details.get("declared_load_a", 0.0)
        by_branch = {
            "simulation SNR, median, {} [dB]": (details.get("simulation_snr_db", {}), "{:.1f}"),
            "vehicles that agree, {} [%]": (details.get("reference", {}).get("agreeing_share", {}), "{:.0%}"),
            "faultless vehicles differ by, {} [%]": (
                details.get("hyperparameters", {}).get("model_spread", {}),
                "{:.1%}",
            ),
        }
        about = (", median" if run.vehicles > 1 else "") + (f" about the {load_a:g} A declared" if load_a else "")
        rows = [
            ("vehicles calibrated", f"{run.vehicles}"),
            *((f"  {verdict}", f"{count}") for verdict, count in self.verdicts.items()),
            ("  hardware fault suspected", f"{self.hardware_count}"),
            ("vehicles left out", f"{run.left_out_count}"),
            *((f"faults held back, {reason}", f"{count}") for reason, count in self.held_back.items()),
            (f"junction sum RMS{about}, measured [A]", f"{self.junction_rms_measured_a:.2f}"),
            (f"junction sum RMS{about}, corrected [A]", f"{self.junction_rms_deployed_a:.2f}"),
            *(
                (what.format(name), digits.format(value).rstrip("%"))
                for what, (values, digits) in by_branch.items()
                for name, value in values.items()
            ),
        ]
        parts = [
            table((f"method {run.method}", ""), rows),
            "\n".join(f"notice: {notice}" for notice in run.notices),
            reasons_text("corrected", self.corrected),
            reasons_text("moved since the earlier result", self.moved),
            reasons_text("hardware fault suspected", self.hardware_suspected),
            reasons_text("cannot tell", self.undecided),
            left_out_text(run.left_out),
            f"parameter files: {self.result}/{self.parameters}" if self.result else "",
        ]
        return "\n\n".join(part for part in parts if part)


def report_of(result: Path, run: RunRecord, *, parameters: str, shown: Path) -> CalibrationReport:
    """Make the report on a result from its folder.

    Parameters
    ----------
    result : Path
        Folder with ``results.parquet``.
    run : RunRecord
        How it was made.
    parameters : str
        Where in the folder the parameter files are.
    shown : Path
        Path of the folder as the user knows it.

    Returns
    -------
    CalibrationReport
        Report on all vehicles of the result.
    """
    rows = pd.read_parquet(result / ROWS, use_threads=False)
    rows = rows[rows["branch"].notna()].astype({"applied": bool, "hardware_fault": bool})
    vehicles = rows[rows["branch"] == run.branches[0]]  # one row per vehicle, for what concerns all of it
    measured_a, corrected_a = (vehicles[f"junction_rms_{name}_a"].to_numpy() for name in ("measured", "corrected"))
    applied = rows["applied"].to_numpy().reshape(-1, len(run.branches))
    suspected, moved = vehicles[vehicles["hardware_fault"]], rows[rows["moved"].notna()]

    def said(rows: pd.DataFrame, text: Callable[[pd.DataFrame], str]) -> dict[str, str]:
        """Return a text on each of the first :data:`MOST_NAMED` vehicles."""
        return {str(name): text(mine) for name, mine in islice(rows.groupby("vehicle", sort=False), MOST_NAMED)}

    def corrected(mine: pd.DataFrame) -> str:
        names, confidence = ", ".join(mine["branch"]), mine["confidence"].iloc[0]
        unsure = f" (all of its faults within 10 %: probability {confidence:.2f})"
        return names + unsure if confidence < CONFIDENT else names

    def probability(mine: pd.DataFrame) -> str:
        value = mine["hardware_probability"].iloc[0]
        return "" if np.isnan(value) else f"probability {value:.1f}"

    return CalibrationReport(
        result=str(shown),
        parameters=parameters,
        run=run,
        verdicts=vehicles["verdict"].value_counts(sort=False).to_dict(),
        undecided=said(vehicles[vehicles["verdict"] == "cannot tell"], lambda mine: mine["reason"].fillna("").iloc[0]),
        corrected=said(rows[(rows["verdict"] == "corrected") & rows["applied"]], corrected),
        hardware_suspected=said(suspected, probability),
        hardware_count=len(suspected),
        held_back=rows["held_back"].value_counts(sort=False).to_dict(),
        moved=said(moved, lambda mine: "; ".join(mine["branch"] + " " + mine["moved"])),
        moved_count=moved["vehicle"].nunique(),
        junction_rms_measured_a=float(np.median(measured_a)),
        junction_rms_deployed_a=float(
            np.median(deployed_rms_a(applied, measured_a=measured_a, corrected_a=corrected_a))
        ),
    )
