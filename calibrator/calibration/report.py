"""What a calibration found, in short: counted from the rows of its result."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from calibrator.drive import Array
from calibrator.posterior.verdict import CONFIDENT
from calibrator.results.counts import Counts, count_rows, deployed_rms_a
from calibrator.results.run_record import RunRecord
from calibrator.terminal.text import dumps, left_out_text, reasons_text, table

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
    hardware_count: int
    """How many there are."""
    held_back: Mapping[str, int]
    """Branches in which a fault was found that is not applied, by reason."""
    moved: Mapping[str, str]
    """Vehicles with sensors that have moved since an earlier result, and how."""
    moved_count: int
    """How many there are."""
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
            ("  hardware fault suspected", f"{self.hardware_count}"),
            ("vehicles left out", f"{run.left_out_count}"),
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
    tally = _Tally()
    for batch in pq.ParquetFile(result / "results.parquet").iter_batches(columns=list(_COLUMNS)):
        rows = pa.Table.from_batches([batch])
        tally.add(rows.filter(pc.field("branch").is_valid()), run.branches)
    return CalibrationReport(
        result=str(shown),
        parameters=parameters,
        run=run,
        verdicts=dict(tally.counts.verdicts),
        undecided=tally.undecided,
        corrected=tally.corrected,
        hardware_suspected=tally.hardware,
        hardware_count=tally.counts.hardware_suspected,
        held_back=dict(tally.counts.held_back),
        moved=tally.moved,
        moved_count=tally.counts.moved_vehicles,
        junction_rms_measured_a=float(np.median(np.concatenate(tally.measured_a))),
        junction_rms_deployed_a=float(np.median(np.concatenate(tally.deployed_a))),
    )


@dataclass(kw_only=True)
class _Tally:
    """Counts and names over the rows, a few vehicles at a time; a vehicle's rows stand together, one per branch."""

    counts: Counts = field(default_factory=Counts)
    undecided: dict[str, str] = field(default_factory=dict)
    corrected: dict[str, str] = field(default_factory=dict)
    hardware: dict[str, str] = field(default_factory=dict)
    moved: dict[str, str] = field(default_factory=dict)
    measured_a: list[Array] = field(default_factory=list)
    deployed_a: list[Array] = field(default_factory=list)
    rest: pa.Table | None = None

    def add(self, rows: pa.Table, branches: Sequence[str]) -> None:
        """Count rows; those of a vehicle whose others are still to come wait."""
        rows = rows if self.rest is None else pa.concat_tables([self.rest, rows])
        whole = rows.num_rows - rows.num_rows % len(branches)
        self.rest, rows = rows.slice(whole), rows.slice(0, whole)
        vehicles = rows.filter(pc.field("branch") == branches[0])
        applied = rows["applied"].to_numpy().reshape(-1, len(branches))
        measured_a, corrected_a = (vehicles[f"junction_rms_{name}_a"].to_numpy() for name in ("measured", "corrected"))
        self.measured_a.append(measured_a)
        self.deployed_a.append(deployed_rms_a(applied, measured_a=measured_a, corrected_a=corrected_a))
        self.counts += count_rows(rows, branches)
        _name(
            self.undecided, vehicles.filter(pc.field("verdict") == "cannot tell"), lambda rows: rows[0]["reason"] or ""
        )
        suspected = vehicles.filter(pc.field("hardware_fault"))
        _name(self.hardware, suspected, lambda rows: _probability(rows[0]["hardware_probability"]))
        moved = rows.filter(pc.field("moved").is_valid())
        _name(self.moved, moved, lambda rows: "; ".join(f"{row['branch']} {row['moved']}" for row in rows))
        corrected = rows.filter((pc.field("verdict") == "corrected") & pc.field("applied"))
        _name(self.corrected, corrected, _corrections)


def _name(found: dict[str, str], rows: pa.Table, text: Callable[[list[dict[str, Any]]], str]) -> None:
    """Name vehicles with what their rows say, until there are enough."""
    if len(found) >= MOST_NAMED or not rows.num_rows:
        return
    for name, group in groupby(rows.to_pylist(), key=lambda row: str(row["vehicle"])):
        if len(found) == MOST_NAMED:
            return
        found[name] = text(list(group))


def _corrections(rows: list[dict[str, Any]]) -> str:
    """Which branches of a vehicle are corrected, and a low confidence."""
    return ", ".join(row["branch"] for row in rows) + _doubt(rows[0]["confidence"])


def _probability(value: float | None) -> str:
    return "" if value is None else f"probability {value:.1f}"


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
