"""Calibration of a fleet: drives -> models -> unity drive -> fleet reference -> faults -> parameter files.

One bad vehicle never stops the fleet; who was left out stands in the report.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from calibrator.artificial.truth import FleetTruth, faults_of
from calibrator.drive import Array, DriveFile
from calibrator.drives.fleet_source import Equipment, FleetSource, find_fleet, probe_equipment
from calibrator.errors import FleetError
from calibrator.folders import require_new_folder
from calibrator.identification.vehicle_model import VehicleModel, read_vehicle_model
from calibrator.options import Classifier, Method
from calibrator.parameter_files import parameters_of
from calibrator.published.calibration import ExpectedFaults, calibrate_published
from calibrator.published.recovery import Recovery
from calibrator.report.progress import progress_bar
from calibrator.report.text import dumps, left_out_text, table
from calibrator.results import LeftOut, RunRecord, write_results
from ecu_node import __version__
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters

__all__ = ["CalibrationReport", "CalibrationSettings", "calibrate_fleet"]

LEAST_VEHICLES = 2
"""A single vehicle would be its own reference."""
MISFIT = 5.0
"""Simulation error over the fleet's median from which on a model is not one of the fleet. [1]"""


@dataclass(frozen=True, kw_only=True)
class CalibrationSettings:
    """How a fleet is calibrated.

    Attributes
    ----------
    method : Method
        Estimator.
    classifier : Classifier
        Of the published method.
    truth : FleetTruth or None
        For the perfect classifier.
    sparsity : float
        Of the artificial fleet that the tree is trained on. [%]
    magnitude : tuple of float
        Of the same: range of drifts [1] and of offsets in fractions of full scale.
    symmetric : bool
        Whether the fleet is symmetric as in the paper, so that its mean has no error of its own.
    branches : tuple of str or None
        Branches to use; None: those that the fleet has.
    hold_out : frozenset of str
        Vehicles that are calibrated, but from which nothing is learnt for the others.
    unity : str or None
        Vehicle whose held-out inputs are the unity drive; None: the one with the longest.
    seed : int
        Seed of the training fleet.
    """

    method: Method = Method.PUBLISHED
    classifier: Classifier = Classifier.TREE
    truth: FleetTruth | None = None
    sparsity: float = 80.0
    magnitude: tuple[float, float] = (0.05, 0.25)
    symmetric: bool = False
    branches: tuple[str, ...] | None = None
    hold_out: frozenset[str] = field(default_factory=frozenset)
    unity: str | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class CalibrationReport:
    """What a calibration found, in short."""

    result: str
    run: RunRecord
    verdicts: Mapping[str, int]
    hardware_suspected: int
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
            ("  hardware fault suspected", f"{self.hardware_suspected}"),
            ("vehicles left out", f"{len(run.left_out)}"),
            ("junction sum RMS, median, measured [A]", f"{self.junction_rms_measured_a:.2f}"),
            ("junction sum RMS, median, deployed [A]", f"{self.junction_rms_deployed_a:.2f}"),
            *((f"simulation SNR, median, {name} [dB]", f"{snr:.1f}") for name, snr in run.simulation_snr_db.items()),
        ]
        parts = [
            table((f"method {run.method}", ""), rows),
            "\n".join(f"notice: {notice}" for notice in run.notices),
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
    fleet = find_fleet(path)
    unknown = settings.hold_out - fleet.vehicles.keys()
    if unknown:
        raise FleetError(f"{path}: no vehicle {', '.join(sorted(unknown))} to hold out")
    equipment = probe_equipment(fleet, database, settings.branches)
    vehicles, left_out = _read_models(fleet, equipment, database, workers)
    if not vehicles:
        reason = next(iter(left_out.values()), "")
        raise FleetError(f"{path}: no vehicle has enough usable data; the first says: {reason}")
    vehicles = _without_misfits(vehicles, settings.hold_out, equipment, left_out)
    learning = _learning(vehicles, settings.hold_out)
    if len(learning) < LEAST_VEHICLES:
        reasons = "".join(f"; {name}: {reason}" for name, reason in left_out.items())
        raise FleetError(
            f"{path}: {len(learning)} usable vehicle to learn from, at least {LEAST_VEHICLES} are needed, "
            f"as every vehicle is compared with the mean of the fleet{reasons}"
        )
    unity = _unity_vehicle(learning, settings.unity)
    recovery = _recover(vehicles, unity, equipment, database, settings)
    left_out |= {vehicles[j].vehicle: reason for j, reason in recovery.failed.items()}
    created = datetime.now(UTC).isoformat(timespec="seconds")
    parameters = [
        parameters_of(
            vehicle,
            recovery,
            j,
            branches=equipment.branches,
            database=database,
            method=settings.method,
            fleet=path.resolve().name,
            fleet_size=len(vehicles),
            created=created,
        )
        for j, vehicle in enumerate(vehicles)
        if j not in recovery.failed
    ]
    run = RunRecord(
        tool=f"calibrator {__version__}",
        method=settings.method.value,
        fleet=path.resolve().name,
        layout=database.layout.name,
        branches=list(equipment.branches),
        model_inputs=list(equipment.inputs),
        created=created,
        unity_vehicle=unity.vehicle,
        unity_duration_s=database.layout.period_s * (len(unity.held_out_inputs) - unity.lead_in),
        simulation_snr_db=_median_snr_db(vehicles, equipment),
        vehicles=len(parameters),
        left_out=left_out,
        notices=list(equipment.notices),
    )
    write_results(out, parameters, [LeftOut(vehicle=v, reason=r) for v, r in left_out.items()], run)
    return _report(out, parameters, run)


def _read_models(
    fleet: FleetSource, equipment: Equipment, database: VehicleDatabase, workers: int
) -> tuple[list[VehicleModel], dict[str, str]]:
    """Models of the vehicles that can be used, and why the others cannot."""
    outcomes = Parallel(n_jobs=workers, return_as="generator")(
        delayed(_read_one)(entries, equipment, database) for entries in fleet.vehicles.values()
    )
    vehicles: list[VehicleModel] = []
    left_out = dict(fleet.left_out)
    with progress_bar("identify", len(fleet.vehicles), "vehicles") as progress:
        for done, (name, outcome) in enumerate(zip(fleet.vehicles, outcomes, strict=True), start=1):
            if isinstance(outcome, VehicleModel):
                vehicles.append(outcome)
            else:
                left_out[name] = outcome
            progress(done)
    return vehicles, left_out


def _read_one(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> VehicleModel | str:
    """Model of one vehicle, or the text of the error. One thread: the processes share the cores."""
    with threadpool_limits(1):
        try:
            return read_vehicle_model(entries, equipment, database)
        except UserError as error:
            return str(error)


def _learning(vehicles: Sequence[VehicleModel], hold_out: frozenset[str]) -> list[VehicleModel]:
    """Vehicles from which the fleet learns."""
    return [vehicle for vehicle in vehicles if vehicle.vehicle not in hold_out]


def _without_misfits(
    vehicles: Sequence[VehicleModel], hold_out: frozenset[str], equipment: Equipment, left_out: dict[str, str]
) -> list[VehicleModel]:
    """Vehicles whose models hold on their own last 20 % about as well as the fleet's do; the others are named."""
    usual_a = _median_error_a(_learning(vehicles, hold_out) or vehicles)
    kept: list[VehicleModel] = []
    for vehicle in vehicles:
        ratio = vehicle.simulation_error_a / np.maximum(usual_a, np.finfo(float).tiny)
        if ratio.max() <= MISFIT:
            kept.append(vehicle)
        else:
            left_out[vehicle.vehicle] = (
                f"its model misses the {equipment.branches[int(ratio.argmax())]} current of its own last 20 % "
                f"{ratio.max():.0f} times as far as the fleet's models do; record a drive with more varied use"
            )
    return kept


def _median_error_a(vehicles: Sequence[VehicleModel]) -> Array:
    """Median over vehicles of each branch's simulation error on held-out data, shape (K,). [A]"""
    return np.asarray(np.median([vehicle.simulation_error_a for vehicle in vehicles], axis=0))


def _unity_vehicle(vehicles: Sequence[VehicleModel], wanted: str | None) -> VehicleModel:
    """The vehicle whose held-out inputs become the unity drive: the one asked for, or the one with the longest."""
    if wanted is None:
        return max(vehicles, key=lambda vehicle: len(vehicle.held_out_inputs) - vehicle.lead_in)
    for vehicle in vehicles:
        if vehicle.vehicle == wanted:
            return vehicle
    raise FleetError(f"no usable vehicle {wanted!r} to take the unity drive from")


def _recover(
    vehicles: Sequence[VehicleModel],
    unity: VehicleModel,
    equipment: Equipment,
    database: VehicleDatabase,
    settings: CalibrationSettings,
) -> Recovery:
    """Simulate every vehicle on the unity drive (2) and estimate its faults."""
    simulated = [vehicle.model.simulate(unity.held_out_inputs)[unity.lead_in :] for vehicle in vehicles]
    names = [vehicle.vehicle for vehicle in vehicles]
    truth = None
    if settings.truth is not None:
        if tuple(settings.truth.branches) != equipment.branches:
            raise FleetError(f"the truth is of branches {settings.truth.branches}, the fleet has {equipment.branches}")
        truth = faults_of(settings.truth, names)
    return calibrate_published(
        simulated,
        junction_a2=np.array([float(np.sum(vehicle.moment_a2)) for vehicle in vehicles]),
        in_reference=np.array([name not in settings.hold_out for name in names]),
        simulation_error_a=_median_error_a(_learning(vehicles, settings.hold_out)),
        full_scale_a=database.layout.full_scale_a,
        classifier=settings.classifier,
        expected=ExpectedFaults(
            sparsity=settings.sparsity,
            magnitude=settings.magnitude,
            symmetric=settings.symmetric,
            seed=settings.seed,
        ),
        truth=truth,
    )


def _median_snr_db(vehicles: Sequence[VehicleModel], equipment: Equipment) -> dict[str, float]:
    median = np.nanmedian([vehicle.snr_db for vehicle in vehicles], axis=0)
    return dict(zip(equipment.branches, median.tolist(), strict=True))


def _report(out: Path, parameters: Sequence[VehicleParameters], run: RunRecord) -> CalibrationReport:
    verdicts = Counter[str](item.verdict for item in parameters)
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
        verdicts=dict(verdicts),
        hardware_suspected=sum(item.hardware_fault.suspected for item in parameters),
        junction_rms_measured_a=float(np.median(measured)),
        junction_rms_deployed_a=float(np.median(deployed)),
    )
