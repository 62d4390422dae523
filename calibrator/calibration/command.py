"""``calibrator calibrate`` and ``calibrator params``: a fleet's parameter files."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibrator.artificial.options import MagnitudeOption, SparsityOption, SymmetricOption
from calibrator.calibration.options import (
    ClassifierOption,
    HarmLimitOption,
    HoldOutOption,
    ReadingsOption,
    SchedulerOption,
    SensorModelsOption,
    SinceOption,
    TrustedOption,
    TruthOption,
    UnityOption,
    named_vehicles,
    require_own_options,
    require_truth_where_used,
)
from calibrator.files.folders import require_possible_folder
from calibrator.files.layout_files import vehicle_database
from calibrator.options import Classifier, Method
from calibrator.processes.interrupts import importing
from calibrator.processes.reading import TIME_LIMIT_S
from calibrator.terminal.options import (
    BranchesOption,
    FleetOrSummariesArgument,
    JsonOption,
    LayoutOption,
    SeedOption,
    TimeLimitOption,
    WorkersOption,
)
from calibrator.terminal.text import dumps, print_report
from ecu_node.standard_output import write_output
from ecu_node.user_files import write_atomically

if TYPE_CHECKING:
    from calibrator.fleet_truth import FleetTruth

__all__ = ["calibrate", "params"]


def calibrate(
    context: typer.Context,
    fleet: FleetOrSummariesArgument,
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Folder of the result, new or empty.")],
    method: Annotated[Method, typer.Option("--method", help="Estimator.")] = Method.POSTERIOR,
    harm_limit: HarmLimitOption = 0.001,
    trusted: TrustedOption = None,
    readings: ReadingsOption = None,
    sensor_models: SensorModelsOption = False,
    classifier: ClassifierOption = Classifier.TREE,
    truth: TruthOption = None,
    sparsity: SparsityOption = 80.0,
    magnitude: MagnitudeOption = (0.05, 0.25),
    symmetric: SymmetricOption = False,
    branches: BranchesOption = None,
    hold_out: HoldOutOption = None,
    unity: UnityOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 2,
    scheduler: SchedulerOption = None,
    since: SinceOption = None,
    time_limit: TimeLimitOption = TIME_LIMIT_S,
    json: JsonOption = False,
) -> None:
    """Estimate the sensor faults of every vehicle and write its parameter file.

    The default method, posterior, says how sure it is and corrects a branch only if that hardly harms. The options
    classifier, truth, sparsity, magnitude, symmetric, unity and seed are for the published method, which is kept as a
    reference: its classifier 'tree' is trained on an artificial fleet of this --sparsity, --magnitude and --seed.
    """
    with importing():
        from calibrator.calibration.calibrate_fleet import calibrate_fleet
        from calibrator.calibration.in_order import Workers
        from calibrator.calibration_settings import CalibrationSettings

    require_truth_where_used(classifier, truth, method)
    require_own_options(context, method)
    settings = CalibrationSettings(
        method=method,
        harm_limit=harm_limit,
        trusted=named_vehicles(trusted),
        readings=readings,
        sensor_models=sensor_models,
        classifier=classifier,
        truth=_truth_of(Path(fleet), truth) if truth is not None else None,
        sparsity=sparsity,
        magnitude=magnitude,
        symmetric=symmetric,
        branches=tuple(branches.split(",")) if branches else None,
        hold_out=named_vehicles(hold_out),
        unity=unity,
        seed=seed,
        time_limit_s=time_limit,
    )
    where = Workers(processes=workers, scheduler=scheduler)
    report = calibrate_fleet(fleet, vehicle_database(layout), out, settings, workers=where, since=since)
    print_report(report, json=json)


def params(
    result: Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")],
    vehicles: Annotated[list[str], typer.Argument(help="Vehicles.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for VEHICLE.json; files of that name are replaced.")],
    json: JsonOption = False,
) -> None:
    """Write the parameter files of some vehicles, of a fleet too large for a file each in one folder."""
    with importing():
        from calibrator.results.vehicle import parameters_of

    texts = {vehicle: parameters_of(result, vehicle) for vehicle in vehicles}
    require_possible_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    files = {vehicle: out / f"{vehicle}.json" for vehicle in texts}
    for vehicle, text in texts.items():
        write_atomically(files[vehicle], text)
    names = {vehicle: str(path) for vehicle, path in files.items()}
    write_output(dumps({"files": names}) if json else "\n".join(names.values()))


def _truth_of(fleet: Path, path: Path) -> "FleetTruth":
    """The truth, if it is that of the fleet's vehicles."""
    from calibrator.drives.fleet_id import require_same_fleet
    from calibrator.fleet_truth import faults_of, read_truth
    from calibrator.sources.fleet_source import find_fleet

    truth = read_truth(path)
    source = find_fleet(fleet)
    require_same_fleet(source.fleet_ids, truth.fleet_id, drives=fleet, truth=path)
    faults_of(truth, list(source.vehicles))
    return truth
