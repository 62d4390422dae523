"""Command line of the calibrator. Results go to stdout, progress and messages to stderr."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from calibrator.doctor.command import doctor
from calibrator.errors import LogError
from calibrator.export.command import export
from calibrator.files.folders import require_new_folder, require_possible_file, require_possible_folder
from calibrator.interrupts import importing
from calibrator.kirchhoff.command import kirchhoff
from calibrator.options import Classifier, ExperimentName, Method
from calibrator.proposal.command import layout as layout_commands
from calibrator.reading_processes import TIME_LIMIT_S
from calibrator.report.command import report
from calibrator.signing.command import keys, revoke, sign
from calibrator.terminal.command_line import command_app, run_app
from calibrator.terminal.options import (
    BalancedOption,
    BankOption,
    BranchesOption,
    ClassifierOption,
    CommonDriveOption,
    CurrentsOption,
    DelayOption,
    DrivesOption,
    ExperimentDrivesOption,
    ExperimentLayoutOption,
    FleetArgument,
    FleetOrSummariesArgument,
    HarmLimitOption,
    HoldOutOption,
    JsonOption,
    LayoutOption,
    MagnitudeOption,
    MinutesOption,
    NoiseOption,
    PartOption,
    PolesOption,
    QuickOption,
    ReadingsOption,
    RepetitionsOption,
    ResultsFolderOption,
    SchedulerOption,
    SeedOption,
    SensorModelsOption,
    SinceOption,
    SparsityOption,
    StoreOption,
    SymmetricOption,
    TimeLimitOption,
    TrustedOption,
    TruthOption,
    UnityOption,
    UnmeasuredOption,
    UnseenMinutesOption,
    VehiclesOption,
    WorkersOption,
    named_vehicles,
    numbered_part,
    require_heeded_options,
    require_one_bank,
    require_own_options,
    require_truth_where_used,
)
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import dumps, print_report
from ecu_node import __version__
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import write_atomically
from ecu_node.standard_output import write_output, write_text

if TYPE_CHECKING:
    from calibrator.artificial.truth import FleetTruth

__all__ = ["app", "main"]

app = command_app(
    help="Learn from recorded drives what each vehicle's high-voltage current sensors do wrong.", no_args_is_help=True
)


def main() -> int:
    """Run the command line and return its exit code, see :data:`calibrator.terminal.command_line.EXIT_CODES`."""
    return run_app(app, "calibrator", sys.argv[1:])


def _version(wanted: bool) -> None:
    if wanted:
        print(f"calibrator {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error; may stand anywhere.")] = False,
) -> None:
    """Learn from recorded drives what each vehicle's high-voltage current sensors do wrong."""


app.add_typer(keys, name="keys")
app.add_typer(layout_commands, name="layout")
app.command()(sign)
app.command()(revoke)
app.command()(doctor)
app.command()(kirchhoff)


@app.command("import")
def import_(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or folders of them; a log's folder names its vehicle.")],
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Drive store to write to; drives are added to one that exists.")],
    workers: WorkersOption = 2,
    time_limit: TimeLimitOption = TIME_LIMIT_S,
    json: JsonOption = False,
) -> None:
    """Turn CAN logs of one or many vehicles into drives."""
    with importing():
        from calibrator.sources.import_logs import import_logs

    require_possible_folder(out)
    report = import_logs(logs, _database(layout), out, workers=workers, limit_s=time_limit)
    print_report(report, json=json)
    if not report.drives and not report.already_there:
        raise LogError(f"none of the logs could be used, for the reasons given above; {out} was not changed")


@app.command()
def simulate(
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Folder of the fleet, new or empty.")],
    vehicles: VehiclesOption,
    drives: DrivesOption = "builtin",
    currents: CurrentsOption = 2,
    sparsity: SparsityOption = 80.0,
    magnitude: MagnitudeOption = (0.05, 0.25),
    common_drive: CommonDriveOption = False,
    symmetric: SymmetricOption = False,
    balanced: BalancedOption = False,
    noise: NoiseOption = 0.001,
    delay: DelayOption = 0.0,
    unmeasured: UnmeasuredOption = (0.0, 0.0),
    minutes: MinutesOption = 10.0,
    unseen_minutes: UnseenMinutesOption = 3.0,
    seed: SeedOption = 0,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Write an artificial fleet: CAN logs of vehicles with known faults, and truth.json."""
    with importing():
        from calibrator.artificial.simulate import FleetPlan, simulate_fleet
        from calibrator.artificial.trips import choose_trips

    require_new_folder(out)
    database = _database(layout)
    plan = FleetPlan(
        vehicles=vehicles,
        currents=currents,
        sparsity=sparsity,
        magnitude=magnitude,
        balanced=balanced,
        symmetric=symmetric,
        common_drive=common_drive,
        noise=noise,
        delay_max_s=delay / 1e3,
        unmeasured_a=unmeasured,
        seed=seed,
    )
    trips = choose_trips(
        drives,
        database.layout,
        vehicles=vehicles,
        seed=seed,
        duration_s=60.0 * minutes,
        unseen_s=60.0 * unseen_minutes,
        common=common_drive,
    )
    with progress_bar("simulate", vehicles, "vehicles") as progress:
        truth = simulate_fleet(plan, trips, database, out, workers=workers, progress=progress)
    _print_fleet(truth, out, trips.notices, json=json)


@app.command()
def summarise(
    fleet: FleetArgument,
    layout: LayoutOption,
    out: StoreOption,
    branches: BranchesOption = None,
    bank: BankOption = None,
    part: PartOption = "1/1",
    workers: WorkersOption = 2,
    time_limit: TimeLimitOption = TIME_LIMIT_S,
    json: JsonOption = False,
) -> None:
    """Reduce drives to what the calibration needs of them: second moments, a few kilobytes per vehicle."""
    with importing():
        from calibrator.summaries.filter_bank import read_bank
        from calibrator.summaries.summarise_fleet import summarise_fleet

    report = summarise_fleet(
        fleet,
        _database(layout),
        out,
        branches=tuple(branches.split(",")) if branches else None,
        bank=read_bank(bank) if bank is not None else None,
        workers=workers,
        time_limit_s=time_limit,
        part=numbered_part(part),
    )
    print_report(report, json=json)


@app.command()
def identify(
    fleet: FleetArgument,
    layout: LayoutOption,
    bank: BankOption = None,
    poles: PolesOption = None,
    out: Annotated[Path | None, typer.Option("--out", help="File to write the filter bank to (JSON).")] = None,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Choose the filter bank that a fleet's vehicles share, and tell how well it simulates each of them.

    Without --bank or --poles it is chosen from some vehicles, by how well it simulates blocks of their drives that were
    held out. A vehicle whose own dynamics differ too much gets a model of its own, and is named.
    """
    with importing():
        from calibrator.identification.fleet_identification import identify_fleet
        from calibrator.summaries.filter_bank import read_bank

    require_one_bank(bank, poles)
    if out is not None:
        require_possible_file(out)
    report = identify_fleet(
        fleet,
        _database(layout),
        bank=read_bank(bank) if bank is not None else None,
        time_constants_s=[float(number) for number in poles.split(",")] if poles else [],
        workers=workers,
    )
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, report.bank.to_json())
    print_report(report, json=json)


@app.command()
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
    report = calibrate_fleet(fleet, _database(layout), out, settings, workers=where, since=since)
    print_report(report, json=json)


@app.command()
def params(
    result: Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")],
    vehicles: Annotated[list[str], typer.Argument(help="Vehicles.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for VEHICLE.json; files of that name are replaced.")],
    json: JsonOption = False,
) -> None:
    """Write the parameter files of some vehicles, of a fleet too large for a file each in one folder."""
    with importing():
        from calibrator.results import parameters_of

    texts = {vehicle: parameters_of(result, vehicle) for vehicle in vehicles}
    require_possible_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    files = {vehicle: out / f"{vehicle}.json" for vehicle in texts}
    for vehicle, text in texts.items():
        write_atomically(files[vehicle], text)
    names = {vehicle: str(path) for vehicle, path in files.items()}
    write_output(dumps({"files": names}) if json else "\n".join(names.values()))


app.command()(export)
app.command()(report)


@app.command()
def score(
    result: Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")],
    truth: Annotated[Path, typer.Option("--truth", help="truth.json that 'calibrator simulate' wrote.")],
    json: JsonOption = False,
) -> None:
    """Compare a result with the truth of its artificial fleet."""
    with importing():
        from calibrator.artificial.result_score import score_result

    figures = score_result(result, truth)
    print_report(figures, json=json)


@app.command()
def experiment(
    context: typer.Context,
    name: Annotated[ExperimentName, typer.Argument(help="Which experiment, or all.")],
    quick: QuickOption = False,
    repetitions: RepetitionsOption = None,
    seed: SeedOption = 0,
    drives: ExperimentDrivesOption = None,
    layout: ExperimentLayoutOption = None,
    out: ResultsFolderOption = None,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Run an experiment and print the paper's figures, the published method and the default side by side.

    'calibration' runs nothing: it pools the confidences of the experiments that were recorded in --out before. Options
    that an experiment does not heed are refused.
    """
    require_heeded_options(context, name)
    with importing():
        from calibrator.experiments.runner import CALIBRATION, EXPERIMENTS, RunOptions, run_experiments

    if out is not None:
        require_possible_folder(out)
        require_possible_folder(out.absolute().parent)
    names = (*EXPERIMENTS, CALIBRATION) if name is ExperimentName.ALL else (name.value,)
    options = RunOptions(quick=quick, seed=seed, repetitions=repetitions, jobs=workers, layout=layout, drives=drives)
    results = run_experiments(names, options, out=out, console=None if json else Console())
    if json:
        texts = [result.to_json().decode().rstrip() for result in results]
        write_output(texts[0] if len(texts) == 1 else f"[{','.join(texts)}]")


def _truth_of(fleet: Path, path: Path) -> "FleetTruth":
    """The truth, if it is that of the fleet's vehicles."""
    from calibrator.artificial.truth import faults_of, read_truth
    from calibrator.drives.fleet_id import require_same_fleet
    from calibrator.sources.fleet_source import find_fleet

    truth = read_truth(path)
    source = find_fleet(fleet)
    require_same_fleet(source.fleet_ids, truth.fleet_id, drives=fleet, truth=path)
    faults_of(truth, list(source.vehicles))
    return truth


def _database(layout: Path) -> VehicleDatabase:
    return read_database(read_layout(layout))


def _print_fleet(truth: "FleetTruth", out: Path, notices: Sequence[str], *, json: bool) -> None:
    figures = {"vehicles": len(truth.vehicles), "branches": truth.branches, "out": str(out), "notices": notices}
    lines = [f"{out}: {len(truth.vehicles)} vehicles with branches {', '.join(truth.branches)}"]
    if json:
        write_output(dumps(figures))
    else:
        write_text("\n".join([*lines, *(f"notice: {notice}" for notice in notices)]))
