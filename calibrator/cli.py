"""Command line of the calibrator. Results go to stdout, progress and messages to stderr."""

import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from calibrator.options import Classifier, ExperimentName, Method
from calibrator.report.progress import progress_bar
from calibrator.report.text import dumps
from ecu_node import __version__
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import UserError
from ecu_node.layout import read_layout

__all__ = ["app", "main"]

app = typer.Typer(
    help="Learn from recorded drives what each vehicle's high-voltage current sensors do wrong.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

LayoutOption = Annotated[Path, typer.Option("--layout", help="Layout (TOML) that says what the signals mean.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
WorkersOption = Annotated[int, typer.Option("--workers", min=1, help="Number of processes.")]


def main() -> None:
    """Run the command line: exit code 0 done, 1 failed, 2 wrong use."""
    debug = "--debug" in sys.argv[1:]
    try:
        app(args=[argument for argument in sys.argv[1:] if argument != "--debug"], prog_name="calibrator")
    except UserError as error:
        if debug:
            raise
        _fail(str(error))
    except OSError as error:
        if debug:
            raise
        _fail(f"{error.filename or 'file'}: {error.strerror or error}")
    except KeyboardInterrupt:
        print("calibrator: interrupted; nothing was written", file=sys.stderr)
        raise SystemExit(130) from None


def _fail(text: str) -> NoReturn:
    print(f"calibrator: {text}", file=sys.stderr)
    raise SystemExit(1)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"calibrator {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Learn from recorded drives what each vehicle's high-voltage current sensors do wrong."""


@app.command("import")
def import_(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or folders of them; a log's folder names its vehicle.")],
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Drive store to write to; drives are added to one that exists.")],
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Turn CAN logs of one or many vehicles into drives."""
    from calibrator.recordings.import_logs import import_logs

    report = import_logs(logs, _database(layout), out, workers=workers)
    _print_report(report.as_json() if json else report.as_text())
    if not report.drives:
        _fail(f"none of the logs could be used; {out} was not changed")


@app.command()
def simulate(
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Folder of the fleet, new or empty.")],
    vehicles: Annotated[int, typer.Option("--vehicles", min=1, help="Number of vehicles N.")],
    drives: Annotated[
        str, typer.Option("--drives", help="Drive store with the trips to drive, or 'builtin'.")
    ] = "builtin",
    currents: Annotated[int, typer.Option("--currents", min=2, max=16, help="Number of branches K.")] = 2,
    sparsity: Annotated[
        float, typer.Option("--sparsity", min=0, max=100, help="Share of zero fault parameters S [%].")
    ] = 80.0,
    magnitude: Annotated[
        tuple[float, float],
        typer.Option("--magnitude", help="Range of fault magnitudes: drifts, and offsets as fractions of full scale."),
    ] = (0.05, 0.25),
    common_drive: Annotated[bool, typer.Option("--common-drive", help="One trip for all vehicles.")] = False,
    symmetric: Annotated[
        bool, typer.Option("--symmetric", help="Mean of the fleet is the ideal vehicle (22).")
    ] = False,
    balanced: Annotated[bool, typer.Option("--balanced", help="No hardware faults in half of the vehicles.")] = False,
    noise: Annotated[float, typer.Option("--noise", min=0, help="Sensor noise (sd), fraction of full scale.")] = 0.001,
    delay: Annotated[float, typer.Option("--delay", min=0, help="Largest delay of a branch [ms].")] = 0.0,
    unmeasured: Annotated[
        tuple[float, float], typer.Option("--unmeasured", help="Load without a sensor: mean and sd over vehicles [A].")
    ] = (0.0, 0.0),
    minutes: Annotated[float, typer.Option("--minutes", min=0.1, help="Length of each built-in trip.")] = 10.0,
    unseen_minutes: Annotated[
        float, typer.Option("--unseen-minutes", min=0.1, help="Length of each unseen trip.")
    ] = 3.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of everything.")] = 0,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Write an artificial fleet: CAN logs of vehicles with known faults, and truth.json."""
    from calibrator.artificial.simulate import FleetPlan, simulate_fleet
    from calibrator.artificial.trips import choose_trips

    if not 0 <= magnitude[0] <= magnitude[1] < 1:
        raise typer.BadParameter(
            f"{magnitude[0]:g} {magnitude[1]:g}: expected 0 <= LO <= HI < 1", param_hint="--magnitude"
        )
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
    figures = {"vehicles": len(truth.vehicles), "branches": truth.branches, "out": str(out), "notices": trips.notices}
    lines = [f"{out}: {len(truth.vehicles)} vehicles with branches {', '.join(truth.branches)}"]
    _print_report(dumps(figures) if json else "\n".join([*lines, *(f"notice: {notice}" for notice in trips.notices)]))


@app.command()
def calibrate(
    fleet: Annotated[Path, typer.Argument(help="Drive store, or folder with a folder of logs per vehicle.")],
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Folder of the result, new or empty.")],
    method: Annotated[Method, typer.Option("--method", help="Estimator.")] = Method.PUBLISHED,
    classifier: Annotated[
        Classifier, typer.Option("--classifier", help="Tells hardware faults (published).")
    ] = Classifier.TREE,
    truth: Annotated[Path | None, typer.Option("--truth", help="truth.json, for the perfect classifier.")] = None,
    sparsity: Annotated[
        float, typer.Option("--sparsity", min=0, max=100, help="Of the tree's training fleet [%].")
    ] = 80.0,
    magnitude: Annotated[
        tuple[float, float],
        typer.Option("--magnitude", help="Of the tree's training fleet; drifts, offsets / full scale."),
    ] = (0.05, 0.25),
    symmetric: Annotated[bool, typer.Option("--symmetric", help="The fleet's mean is the ideal vehicle (22).")] = False,
    branches: Annotated[str | None, typer.Option("--branches", help="Branches to use, with commas.")] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option("--hold-out", help="Calibrate this vehicle, but learn nothing from it for others."),
    ] = None,
    unity: Annotated[
        str | None, typer.Option("--unity", help="Vehicle whose held-out data is the unity drive.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the classifier's training fleet.")] = 0,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Estimate the sensor faults of every vehicle and write its parameter file."""
    from calibrator.artificial.truth import read_truth
    from calibrator.fleet import CalibrationSettings, calibrate_fleet

    if (classifier is Classifier.PERFECT) != (truth is not None):
        raise typer.BadParameter("--classifier perfect and --truth FILE belong together", param_hint="--classifier")
    settings = CalibrationSettings(
        method=method,
        classifier=classifier,
        truth=read_truth(truth) if truth is not None else None,
        sparsity=sparsity,
        magnitude=magnitude,
        symmetric=symmetric,
        branches=tuple(branches.split(",")) if branches else None,
        hold_out=frozenset(hold_out or ()),
        unity=unity,
        seed=seed,
    )
    report = calibrate_fleet(fleet, _database(layout), out, settings, workers=workers)
    _print_report(report.as_json() if json else report.as_text())


@app.command()
def score(
    result: Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")],
    truth: Annotated[Path, typer.Option("--truth", help="truth.json that 'calibrator simulate' wrote.")],
    json: JsonOption = False,
) -> None:
    """Compare a result with the truth of its artificial fleet."""
    from calibrator.result_score import score_result

    figures = score_result(result, truth)
    _print_report(figures.as_json() if json else figures.as_text())


@app.command()
def experiment(
    name: Annotated[ExperimentName, typer.Argument(help="Which of the paper's experiments.")],
    quick: Annotated[
        bool, typer.Option("--quick", help="Small and fast: shows that it runs, not the figures.")
    ] = False,
    repetitions: Annotated[int | None, typer.Option("--repetitions", min=1, help="Trials per setting.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first trial.")] = 0,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for NAME.md, NAME.json and NAME.png.")] = None,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Repeat an experiment of the paper and print its figures beside the paper's."""
    from calibrator.experiments.runner import run_experiment

    result = run_experiment(
        name.value,
        quick=quick,
        seed=seed,
        repetitions=repetitions,
        out=out,
        console=None if json else Console(),
        jobs=workers,
    )
    if json:
        _print_report(result.to_json().decode())


def _database(layout: Path) -> VehicleDatabase:
    return read_database(read_layout(layout))


def _print_report(text: str) -> None:
    sys.stdout.write(text + "\n")
