"""What a calibration found, in short: counted from the rows of its result."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from calibrator.posterior.verdict import CONFIDENT
from calibrator.report.text import dumps, left_out_text, reasons_text, table
from calibrator.results import RunRecord

__all__ = ["MOST_NAMED", "CalibrationReport", "report_of"]

MOST_NAMED = 1000
"""Vehicles that are named one by one; all of them stand in ``results.parquet``."""
_COLUMNS = (
    "vehicle",
    "branch",
    "verdict",
    "applied",
    "held_back",
    "confidence",
    "hardware_fault",
    "hardware_probability",
    "junction_rms_measured_a",
    "junction_rms_corrected_a",
    "reason",
    "moved",
)


@dataclass(frozen=True, kw_only=True)
class CalibrationReport:
    """What a calibration found, in short."""

    result: str
    parameters: str
    """Where in the result the parameter files are."""
    run: RunRecord
    verdicts: Mapping[str, int]
    undecided: Mapping[str, str]
    """Vehicles of which it cannot be told what is faulty, and what would decide."""
    corrected: Mapping[str, str]
    """Vehicles of which branches are corrected, and which."""
    hardware_suspected: Mapping[str, str]
    """Vehicles that are thought to differ from their fleet, and how probable that is."""
    held_back: Mapping[str, int]
    """Branches in which a fault was found that is not applied, by reason."""
    moved: Mapping[str, str]
    """Vehicles with sensors that have moved since an earlier result, and how."""
    junction_rms_measured_a: float
    """Median over vehicles. [A]"""
    junction_rms_deployed_a: float
    """The same with the parameters that the node applies. [A]"""

    def as_json(self) -> str:
        """The report as JSON."""
        values = {name: value for name, value in vars(self).items() if name != "run"}
        return dumps({**values, "run": self.run})

    def as_text(self) -> str:
        """The report for people."""
        run = self.run
        rows = [
            ("vehicles calibrated", f"{run.vehicles}"),
            *((f"  {verdict}", f"{count}") for verdict, count in self.verdicts.items()),
            ("  hardware fault suspected", f"{len(self.hardware_suspected)}"),
            ("vehicles left out", f"{len(run.left_out)}"),
            *((f"faults held back, {reason}", f"{count}") for reason, count in self.held_back.items()),
            ("junction sum RMS, median, measured [A]", f"{self.junction_rms_measured_a:.2f}"),
            ("junction sum RMS, median, deployed [A]", f"{self.junction_rms_deployed_a:.2f}"),
            *_detail_rows(run),
        ]
        parts = [
            table((f"method {run.method}", ""), rows),
            "\n".join(f"notice: {notice}" for notice in run.notices),
            reasons_text("corrected", self.corrected),
            reasons_text("moved since the earlier result", self.moved),
            reasons_text("hardware fault suspected", self.hardware_suspected),
            reasons_text("cannot tell", self.undecided),
            left_out_text(run.left_out),
            f"parameter files: {self.result}/{self.parameters}",
        ]
        return "\n\n".join(part for part in parts if part)


def report_of(result: Path, run: RunRecord, *, parameters: str, shown: Path) -> CalibrationReport:
    """Count what stands in a result.

    Parameters
    ----------
    result : Path
        Folder with ``results.parquet``.
    run : RunRecord
        How it was made.
    parameters : str
        Where in the folder the parameter files are.
    shown : Path
        What the folder is called for the user.

    Returns
    -------
    CalibrationReport
        At most :data:`MOST_NAMED` vehicles of a kind are named.
    """
    rows = pq.read_table(result / "results.parquet", columns=list(_COLUMNS))
    rows = rows.filter(pc.field("branch").is_valid())
    vehicles = rows.filter(pc.field("branch") == run.branches[0])
    applied = rows.group_by("vehicle", use_threads=False).aggregate([("applied", "any")])["applied_any"]
    measured_a = vehicles["junction_rms_measured_a"].to_numpy()
    deployed_a = np.where(applied.to_numpy(), vehicles["junction_rms_corrected_a"].to_numpy(), measured_a)
    return CalibrationReport(
        result=str(shown),
        parameters=parameters,
        run=run,
        verdicts=_counts(vehicles["verdict"]),
        undecided=_named(vehicles.filter(pc.field("verdict") == "cannot tell"), "reason"),
        corrected=_corrections(rows.filter((pc.field("verdict") == "corrected") & pc.field("applied"))),
        hardware_suspected={
            name: "" if probability is None else f"probability {probability:.1f}"
            for name, probability in _named(vehicles.filter(pc.field("hardware_fault")), "hardware_probability").items()
        },
        held_back=_counts(rows["held_back"].drop_null()),
        moved=_moved(rows.filter(pc.field("moved").is_valid())),
        junction_rms_measured_a=float(np.median(measured_a)),
        junction_rms_deployed_a=float(np.median(deployed_a)),
    )


def _counts(values: pa.ChunkedArray) -> dict[str, int]:
    return {item["values"]: item["counts"] for item in pc.value_counts(values).to_pylist()}


def _named(rows: pa.Table, column: str) -> dict[str, Any]:
    some = rows.slice(0, MOST_NAMED)
    return dict(zip(some["vehicle"].to_pylist(), some[column].to_pylist(), strict=True))


def _moved(rows: pa.Table) -> dict[str, str]:
    """Which branches of vehicles have moved, and how."""
    found: dict[str, list[str]] = {}
    for row in rows.select(["vehicle", "branch", "moved"]).slice(0, MOST_NAMED).to_pylist():
        found.setdefault(row["vehicle"], []).append(f"{row['branch']} {row['moved']}")
    return {name: "; ".join(texts) for name, texts in found.items()}


def _corrections(rows: pa.Table) -> dict[str, str]:
    """Which branches of vehicles are corrected, and a low confidence."""
    found: dict[str, list[str]] = {}
    confidence: dict[str, float | None] = {}
    for row in rows.select(["vehicle", "branch", "confidence"]).slice(0, MOST_NAMED).to_pylist():
        found.setdefault(row["vehicle"], []).append(row["branch"])
        confidence[row["vehicle"]] = row["confidence"]
    return {name: ", ".join(branches) + _doubt(confidence[name]) for name, branches in found.items()}


def _doubt(confidence: float | None) -> str:
    unsure = confidence is not None and confidence < CONFIDENT
    return f" (all of its faults: confidence {confidence:.2f})" if unsure else ""


def _detail_rows(run: RunRecord) -> list[tuple[str, str]]:
    """What a method tells of its run, for people."""
    snr = run.details.get("simulation_snr_db", {})
    agreeing = run.details.get("reference", {}).get("agreeing_share", {})
    rows = [(f"simulation SNR, median, {name} [dB]", f"{value:.1f}") for name, value in snr.items()]
    spread = run.details.get("hyperparameters", {}).get("model_spread", {})
    rows += [(f"vehicles that agree, {name}", f"{value:.0%}") for name, value in agreeing.items()]
    return rows + [(f"faultless vehicles differ by, {name}", f"{value:.1%}") for name, value in spread.items()]
