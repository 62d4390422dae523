"""Run experiments by name: tables on the console; in a folder NAME.json, NAME.md and NAME.png, with an index beside."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from calibrator.errors import FleetError
from calibrator.experiments.calibration_experiment import calibration_experiment
from calibrator.experiments.common_drive import DURATION_S, CommonDrive, builtin_common_drive
from calibrator.experiments.delay_experiment import delay_experiment
from calibrator.experiments.judging import Effort
from calibrator.experiments.paper_experiments import (
    asymmetry_experiment,
    classifier_experiment,
    snr_experiment,
    sparsity_experiment,
    statespace_experiment,
)
from calibrator.experiments.picture import write_picture
from calibrator.experiments.recorded_experiments import (
    attacks_experiment,
    coverage_experiment,
    data_experiment,
    phase_experiment,
    real_experiment,
)
from calibrator.experiments.recorded_fleet import RecordedFleet, builtin_fleet, read_fleet
from calibrator.experiments.recorded_trial import RecordedCase
from calibrator.experiments.result import ExperimentResult, decode_result, made_now
from calibrator.experiments.table import (
    caption,
    headline,
    markdown_table,
    repetitions_text,
    result_markdown,
    result_table,
)
from calibrator.experiments.trial import FleetLaw
from calibrator.files.layout_files import vehicle_database
from calibrator.terminal.progress import one_pass
from ecu_node.documents import write_atomically

__all__ = ["CALIBRATION", "EXPERIMENTS", "Recorded", "RunOptions", "read_results", "run_experiments", "write_result"]

REPETITIONS, QUICK_REPETITIONS = 10, 2
QUICK_DURATION_S = 300.0
QUICK_TRIPS = 8
QUICK_LAW = FleetLaw(vehicles=20, training_vehicles=400)
CALIBRATION = "calibration"
DEFAULT_LAYOUT = Path("dbc/hv_powertrain.toml")
"""Of the examples that come with the source."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How experiments are run.

    Attributes
    ----------
    quick : bool
        Small fleets, short drives, few settings and two repetitions: shows that it runs, not the figures.
    seed : int
        Of the first repetition; the others follow.
    repetitions : int or None
        Trials per setting; None: 10, or 2 if quick.
    jobs : int
        Processes.
    layout : Path or None
        Layout of the recorded drives; None: that of the built-in vehicle, if the current folder is a checkout. Only
        experiments on recorded trips need one.
    drives : Path or None
        Drive store with the recorded drives; None: trips of the built-in vehicle take their place.
    drive : CommonDrive or None
        The drive that all vehicles of an experiment of the paper make; None: of the built-in vehicle.
    fleet : RecordedFleet or None
        The recorded trips; None: of ``layout`` and ``drives``.
    """

    quick: bool = False
    seed: int = 0
    repetitions: int | None = None
    jobs: int = 1
    layout: Path | None = None
    drives: Path | None = None
    drive: CommonDrive | None = None
    fleet: RecordedFleet | None = None

    @property
    def effort(self) -> Effort:
        """Repetitions, seed and processes; FleetError if there is no repetition."""
        usual = QUICK_REPETITIONS if self.quick else REPETITIONS
        count = usual if self.repetitions is None else self.repetitions
        if count < 1:
            raise FleetError(f"an experiment needs at least 1 repetition, not {count}")
        return Effort(repetitions=count, seed=self.seed, jobs=self.jobs)


@dataclass(frozen=True, kw_only=True)
class _Common:
    """An experiment on one drive of all vehicles, at the size of the paper."""

    run: Callable[..., ExperimentResult]
    vehicles: int = 1000
    duration_s: float = DURATION_S
    quick: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, options: RunOptions) -> ExperimentResult:
        drive = options.drive
        if drive is None:
            drive = builtin_common_drive(duration_s=QUICK_DURATION_S if options.quick else self.duration_s)
        law = QUICK_LAW if options.quick else FleetLaw(vehicles=self.vehicles)
        return self.run(drive=drive, law=law, effort=options.effort, **(self.quick if options.quick else {}))


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """An experiment on recorded trips.

    Attributes
    ----------
    run : callable
        The experiment.
    quick : mapping
        Its arguments that make it small.
    """

    run: Callable[..., ExperimentResult]
    quick: Mapping[str, Any]

    def __call__(self, options: RunOptions) -> ExperimentResult:
        """Run it on the fleet of the options."""
        fleet = options.fleet or _recorded_fleet(options)
        return self.run(fleet=fleet, effort=options.effort, **(self.quick if options.quick else {}))


EXPERIMENTS: Mapping[str, Callable[[RunOptions], ExperimentResult]] = {
    "classifier": _Common(run=classifier_experiment),
    "snr": _Common(run=snr_experiment, quick={"snrs_db": (0.0, 20.0)}),
    "sparsity": _Common(run=sparsity_experiment, quick={"sparsities": (60.0, 80.0)}),
    # 20 minutes: models are exact there, so a longer drive shows the same and takes three times as long.
    "statespace": _Common(
        run=statespace_experiment, vehicles=500, duration_s=1200.0, quick={"sparsities": (60.0, 80.0)}
    ),
    "asymmetry": _Common(run=asymmetry_experiment, quick={"fleet_sizes": (20,), "sign_biases": (0.0, 0.4)}),
    "real": Recorded(run=real_experiment, quick={"cases": (RecordedCase(unmeasured_a=(3.0, 1.0)),)}),
    "delay": Recorded(run=delay_experiment, quick={"delays_ms": (0.0, 300.0)}),
    "data": Recorded(run=data_experiment, quick={"minutes": (2.0, 5.0), "fleet_sizes": (10,)}),
    "phase": Recorded(run=phase_experiment, quick={"sparsities": (60.0, 80.0), "magnitudes": ((0.05, 0.25),)}),
    "attacks": Recorded(
        run=attacks_experiment, quick={"worlds": ("load 5 A in 30%", "inverted in 10%"), "branches": (2,)}
    ),
    "coverage": Recorded(run=coverage_experiment, quick={"cases": (RecordedCase(),)}),
}
"""All but ``calibration``, which pools the others."""


def run_experiments(
    names: Sequence[str], options: RunOptions, *, out: Path | None = None, console: Console | None = None
) -> list[ExperimentResult]:
    """Run experiments one after the other; recorded trips are read before any is run.

    Parameters
    ----------
    names : sequence of str
        Of :data:`EXPERIMENTS`, or ``calibration``: pools the experiments run before it and those recorded in the
        folder.
    options : RunOptions
        How.
    out : Path or None
        Folder for NAME.md, NAME.json and NAME.png, made if missing, with an index page beside it; None: nothing is
        written.
    console : rich.console.Console or None
        Where the tables go; None: nowhere.

    Returns
    -------
    list of ExperimentResult
        One per name.

    Raises
    ------
    FleetError
        If there is no such experiment, the number of repetitions is not positive, there are too few trips, or nothing
        is recorded that ``calibration`` could pool.
    UserError
        If layout or drives cannot be read, or there is no default layout.
    """
    known = (*EXPERIMENTS, CALIBRATION)
    for name in names:
        if name not in known:
            raise FleetError(f"no experiment '{name}'; choose one of {', '.join(known)}")
    if any(isinstance(EXPERIMENTS.get(name), Recorded) for name in names):
        options = replace(options, fleet=options.fleet or _recorded_fleet(options))
    done: list[ExperimentResult] = []
    for number, name in enumerate(names, start=1):
        with one_pass(number, len(names)):
            result = _calibration(done, out) if name == CALIBRATION else EXPERIMENTS[name](options)
            result = replace(result, made=made_now())
        done.append(result)
        if console is not None:
            console.print(result_table(result))
        if out is not None:
            write_result(out, result, known)
    return done


def _calibration(done: Sequence[ExperimentResult], out: Path | None) -> ExperimentResult:
    recorded = read_results(out, tuple(EXPERIMENTS)) if out is not None else []
    by_name = {result.name: result for result in (*recorded, *done)}
    if not by_name:
        raise FleetError(
            f"{'--out' if out is None else out}: no experiment is recorded that calibration could pool; first run "
            f"'calibrator experiment all --out {out or 'FOLDER'}', or some experiments by their names"
        )
    return calibration_experiment(list(by_name.values()))


def _default_layout() -> Path:
    """Layout of the built-in vehicle, which comes with the source but not with an installed package."""
    if not DEFAULT_LAYOUT.is_file():
        raise FleetError(
            f"{DEFAULT_LAYOUT}: not in this folder, which is no checkout of the source; experiments on recorded trips "
            "need a layout, also for built-in ones: name it with --layout"
        )
    return DEFAULT_LAYOUT


def _recorded_fleet(options: RunOptions) -> RecordedFleet:
    database = vehicle_database(options.layout or _default_layout())
    if options.drives is not None:
        fleet = read_fleet(options.drives, database)
        return fleet.take(QUICK_TRIPS, duration_s=QUICK_DURATION_S) if options.quick else fleet
    if options.quick:
        return builtin_fleet(database, trips=QUICK_TRIPS, duration_s=QUICK_DURATION_S)
    return builtin_fleet(database)


def write_result(folder: Path, result: ExperimentResult, order: Sequence[str]) -> None:
    """Write one result, and the index of all results of the folder.

    Parameters
    ----------
    folder : Path
        Made if missing.
    result : ExperimentResult
        Of one experiment.
    order : sequence of str
        Names of the experiments in the order of the index.

    Raises
    ------
    FleetError
        If another record of the folder is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / f"{result.name}.json", result.to_json())
    write_atomically(folder / f"{result.name}.md", result_markdown(result, picture=f"{result.name}.png").encode())
    write_picture(result, folder / f"{result.name}.png")
    write_atomically(_index_path(folder), _index(folder, read_results(folder, order)).encode())


def read_results(folder: Path, order: Sequence[str]) -> list[ExperimentResult]:
    """Read the records of a folder in the given order; those that are not there are left out."""
    paths = [folder / f"{name}.json" for name in order]
    return [decode_result(path.read_bytes(), str(path)) for path in paths if path.is_file()]


def _index_path(folder: Path) -> Path:
    """Page beside the folder: ``docs/results.md`` for ``docs/results``."""
    return folder.parent / f"{folder.name}.md"


def _index(folder: Path, results: Sequence[ExperimentResult]) -> str:
    lines = ["# Results of the experiments", "", f"Written by `calibrator experiment`. {caption(results)}", ""]
    for result in results:
        settings = result.settings
        lines += [
            f"## [{result.title}]({folder.name}/{result.name}.md)",
            "",
            f"`calibrator experiment {result.name}`: {repetitions_text(settings)}, seed {settings['seed']}, "
            f"drive {settings['drive']}{f'; {result.made}' if result.made else ''}.",
            "",
            *markdown_table(*headline(result)),
            "",
        ]
    return "\n".join(lines)
