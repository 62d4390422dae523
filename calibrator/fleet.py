"""Calibration of a fleet: drives -> what a method makes of them -> parameter files and report.

One bad vehicle never stops the fleet; who was left out stands in the report.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from calibrator.calibration_settings import CalibrationSettings, FleetOutcome
from calibrator.drives.copies import without_copies
from calibrator.drives.fleet_source import Equipment, FleetSource, find_fleet, probe_equipment
from calibrator.errors import FleetError
from calibrator.folders import require_new_folder
from calibrator.options import Method
from calibrator.parameter_files import RunIdentity
from calibrator.posterior.fleet import calibrate_fleet_posterior
from calibrator.posterior.verdict import CONFIDENT
from calibrator.published.fleet import calibrate_fleet_published
from calibrator.report.text import dumps, left_out_text, reasons_text, table
from calibrator.results import LeftOut, RunRecord, write_results
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters

__all__ = ["CalibrationReport", "CalibrationSettings", "calibrate_fleet"]

METHODS = {Method.POSTERIOR: calibrate_fleet_posterior, Method.PUBLISHED: calibrate_fleet_published}


@dataclass(frozen=True, kw_only=True)
class CalibrationReport:
    """What a calibration found, in short."""

    result: str
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
            reasons_text("hardware fault suspected", self.hardware_suspected),
            reasons_text("cannot tell", self.undecided),
            left_out_text(run.left_out),
            f"parameter files: {self.result}/params",
        ]
        return "\n\n".join(part for part in parts if part)


def calibrate_fleet(
    path: Path, database: VehicleDatabase, out: Path, settings: CalibrationSettings, *, workers: int
) -> CalibrationReport:
    """Calibrate every vehicle of a fleet and write the result folder.

    Parameters
    ----------
    path : Path
        The fleet, see :func:`calibrator.drives.fleet_source.find_fleet`.
    database : VehicleDatabase
        DBC and layout.
    out : Path
        Folder of the result, new or empty; it appears only when it is complete.
    settings : CalibrationSettings
        How.
    workers : int
        Number of processes.

    Returns
    -------
    CalibrationReport
        What was found; everything is on disk then.

    Raises
    ------
    UserError
        If the fleet as a whole cannot be calibrated.
    """
    require_new_folder(out)
    fleet = without_copies(find_fleet(path))
    if not fleet.vehicles:
        why = "; ".join(f"{name}: {reason}" for name, reason in fleet.left_out.items())
        raise FleetError(f"{path}: no drive that is one vehicle's alone; {why}")
    for names, what in ((settings.hold_out, "hold out"), (settings.trusted, "trust")):
        unknown = sorted(names - fleet.vehicles.keys())
        if unknown:
            reasons = [f"; {name}: {fleet.left_out[name]}" for name in unknown if name in fleet.left_out]
            raise FleetError(f"{path}: no vehicle {', '.join(unknown)} to {what}{''.join(reasons)}")
    both = settings.hold_out & settings.trusted
    if both:
        raise FleetError(
            f"vehicle {', '.join(sorted(both))} is both held out and trusted: the reference would be learnt from it"
        )
    equipment = probe_equipment(fleet, database, settings.branches, limit_s=settings.time_limit_s)
    identity = RunIdentity(
        database=database,
        method=settings.method,
        fleet=path.resolve().name,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    outcome = METHODS[settings.method](fleet, equipment, identity, settings, workers=workers)
    run = _record(fleet, equipment, identity, settings, outcome)
    left_out = [LeftOut(vehicle=vehicle, reason=reason) for vehicle, reason in outcome.left_out.items()]
    write_results(out, outcome.parameters, left_out, run)
    return _report(out, outcome, run)


def _record(
    fleet: FleetSource,
    equipment: Equipment,
    identity: RunIdentity,
    settings: CalibrationSettings,
    outcome: FleetOutcome,
) -> RunRecord:
    return RunRecord(
        tool=identity.tool,
        method=identity.method.value,
        fleet=identity.fleet,
        fleet_ids=sorted(fleet.fleet_ids),
        layout=identity.database.layout.name,
        branches=list(equipment.branches),
        model_inputs=list(equipment.inputs),
        settings=settings.record(),
        created=identity.created,
        details=dict(outcome.details),
        vehicles=len(outcome.parameters),
        left_out=dict(outcome.left_out),
        notices=[*fleet.notices, *equipment.notices, *outcome.notices],
    )


def _report(out: Path, outcome: FleetOutcome, run: RunRecord) -> CalibrationReport:
    parameters = outcome.parameters
    measured = [item.junction_residual.measured_a for item in parameters]
    deployed = [
        item.junction_residual.corrected_a
        if any(branch.apply for branch in item.branches.values())
        else item.junction_residual.measured_a
        for item in parameters
    ]
    return CalibrationReport(
        result=str(out),
        run=run,
        verdicts=dict(Counter[str](item.verdict for item in parameters)),
        undecided={item.vehicle: item.deciding_evidence for item in parameters if item.verdict == "cannot tell"},
        held_back=dict(
            Counter[str](
                branch.held_back for item in parameters for branch in item.branches.values() if branch.held_back
            )
        ),
        corrected={item.vehicle: _corrections(item) for item in parameters if item.verdict == "corrected"},
        hardware_suspected={
            item.vehicle: ""
            if item.hardware_fault.probability is None
            else f"probability {item.hardware_fault.probability:.1f}"
            for item in parameters
            if item.hardware_fault.suspected
        },
        junction_rms_measured_a=float(np.median(measured)),
        junction_rms_deployed_a=float(np.median(deployed)),
    )


def _corrections(item: VehicleParameters) -> str:
    """Which branches of a vehicle are corrected, and a low confidence."""
    names = ", ".join(name for name, branch in item.branches.items() if branch.apply)
    unsure = item.confidence is not None and item.confidence < CONFIDENT
    return f"{names} (all of its faults: confidence {item.confidence:.2f})" if unsure else names


def _detail_rows(run: RunRecord) -> list[tuple[str, str]]:
    """What a method tells of its run, for people."""
    snr = run.details.get("simulation_snr_db", {})
    agreeing = run.details.get("reference", {}).get("agreeing_share", {})
    rows = [(f"simulation SNR, median, {name} [dB]", f"{value:.1f}") for name, value in snr.items()]
    spread = run.details.get("hyperparameters", {}).get("model_spread", {})
    rows += [(f"vehicles that agree, {name}", f"{value:.0%}") for name, value in agreeing.items()]
    return rows + [(f"faultless vehicles differ by, {name}", f"{value:.1%}") for name, value in spread.items()]
