"""Options of the command line, with what each accepts: a wrong value ends a command before it has done anything.

Upper bounds are far beyond what a vehicle has; they catch slips of units before these fill memory or disk.
"""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from calibrator.options import Classifier, ExperimentName, Method

__all__ = [
    "BalancedOption",
    "BankOption",
    "BranchesOption",
    "ClassifierOption",
    "CommonDriveOption",
    "CurrentsOption",
    "DbcOption",
    "DelayOption",
    "DrivesOption",
    "ExperimentDrivesOption",
    "ExperimentLayoutOption",
    "FleetArgument",
    "FleetOrSummariesArgument",
    "HarmLimitOption",
    "HoldOutOption",
    "JsonOption",
    "LayoutOption",
    "MagnitudeOption",
    "MinutesOption",
    "NoiseOption",
    "PartOption",
    "PolesOption",
    "QuickOption",
    "ReadingsOption",
    "RepetitionsOption",
    "ResultsFolderOption",
    "SchedulerOption",
    "SeedOption",
    "SensorModelsOption",
    "SinceOption",
    "SparsityOption",
    "StoreOption",
    "SymmetricOption",
    "TimeLimitOption",
    "TrustedOption",
    "TruthOption",
    "UnityOption",
    "UnmeasuredOption",
    "UnseenMinutesOption",
    "VehiclesOption",
    "WorkersOption",
    "given_options",
    "named_vehicles",
    "number_option",
    "numbered_part",
    "require_heeded_options",
    "require_one_bank",
    "require_own_options",
    "require_truth_where_used",
    "whole_option",
]

OWN_OPTIONS = {
    Method.POSTERIOR: ("harm_limit", "trusted", "readings", "sensor_models", "scheduler", "since"),
    Method.PUBLISHED: ("classifier", "truth", "sparsity", "magnitude", "symmetric", "unity", "seed"),
}
"""What only one method heeds."""
RECORDED_EXPERIMENTS = (ExperimentName.REAL, ExperimentName.DELAY, ExperimentName.DATA, ExperimentName.PHASE)
"""Those on recorded trips; the others take the built-in vehicle."""
RECORDED_OPTIONS = ("drives", "layout")
"""What only experiments on recorded trips heed."""
RUN_OPTIONS = (*RECORDED_OPTIONS, "quick", "repetitions", "seed", "workers")
"""What only experiments that run something heed."""
SCHEDULER = re.compile(r"(tcp|tls)://([^\s/?#@:\[\]]+|\[[0-9A-Fa-f:.]+\]):(?P<port>[0-9]{1,5})")
MAX_PORT = 65_535
MAX_REPETITIONS = 1000
MAX_VEHICLES = 100_000
MAX_CURRENTS = 16
MAX_SEED = 2**32 - 1
MAX_WORKERS = 256
MAX_PARTS = 1024
MAX_TIME_LIMIT_S = 86_400.0
"""A day. [s]"""
MAX_MINUTES = 240.0
"""A trip's log is made in memory, at some 250 frames per second. [min]"""
MAX_DELAY_MS = 1000.0
"""The branch signals of a real car lag each other by tens to hundreds of milliseconds. [ms]"""
SHORTEST_POLE_S, LONGEST_POLE_S = 0.01, 600.0
"""Time constants of low-passes: from below the time base of any layout to ten minutes. [s]"""
MAX_UNMEASURED_A = 1000.0
"""More than the full scale of any car's junction. [A]"""


def number_option(name: str, low: float, high: float, meaning: str) -> Any:
    """Make an option that is a finite number between bounds; whatever else is given is named with what is expected.

    Parameters
    ----------
    name : str
        Of the option, with its dashes.
    low, high : float
        Smallest and largest number.
    meaning : str
        What it is, with its unit, for the help; the bounds are added.

    Returns
    -------
    typer's option
        For ``Annotated[float, ...]``.
    """

    def parse(given: str | float) -> float:
        try:
            value = float(given)
        except ValueError:
            value = math.nan
        if not low <= value <= high:  # nor is not-a-number
            raise typer.BadParameter(f"{given}: expected a number from {low:g} to {high:g}")
        return value

    return typer.Option(name, parser=parse, metavar="NUMBER", help=f"{meaning}, {low:g} to {high:g}.")


def whole_option(name: str, low: int, high: int, meaning: str) -> Any:
    """Make an option that is a whole number between bounds; parameters and result as for :func:`number_option`."""

    def parse(given: str | int) -> int:
        if not re.fullmatch(r"[+-]?[0-9]{1,20}", str(given)) or not low <= int(given) <= high:
            raise typer.BadParameter(f"{given}: expected a whole number from {low} to {high}")
        return int(given)

    return typer.Option(name, parser=parse, metavar="NUMBER", help=f"{meaning}, {low} to {high}.")


def _magnitude(value: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= value[0] <= value[1] < 1:
        raise typer.BadParameter(f"{value[0]:g} {value[1]:g}: expected 0 <= LO <= HI < 1")
    return value


def _unmeasured(value: tuple[float, float]) -> tuple[float, float]:
    if not all(0 <= number <= MAX_UNMEASURED_A for number in value):
        raise typer.BadParameter(
            f"{value[0]:g} {value[1]:g}: expected mean and standard deviation from 0 to {MAX_UNMEASURED_A:g} A"
        )
    return value


def _time_constants(value: str | None) -> str | None:
    try:
        numbers = [] if value is None else [float(number) for number in value.split(",")]
    except ValueError:
        numbers = [math.nan]
    if not all(SHORTEST_POLE_S <= number <= LONGEST_POLE_S for number in numbers):  # nor is not-a-number
        raise typer.BadParameter(
            f"{value}: expected time constants with commas, each from {SHORTEST_POLE_S:g} to {LONGEST_POLE_S:g} s"
        )
    return value


def _branches(value: str | None) -> str | None:
    names = [] if value is None else [name.strip() for name in value.split(",")]
    if "" in names:
        raise typer.BadParameter(f"{value!r}: expected names of branches with commas between them")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise typer.BadParameter(f"{', '.join(twice)} is named twice; name each branch once")
    return None if value is None else ",".join(names)


def _scheduler(value: str | None) -> str | None:
    if value is None:
        return None
    found = SCHEDULER.fullmatch(value)
    if found is None or not 1 <= int(found["port"]) <= MAX_PORT:
        raise typer.BadParameter(
            f"{value!r}: expected the address of a Dask scheduler, tcp://HOST:PORT or tls://HOST:PORT, port 1 to "
            f"{MAX_PORT}"
        )
    return value


def _named(value: str) -> str:
    if not value.strip():
        raise typer.BadParameter("an empty name; give the path of a folder, '.' for this one")
    return value


def _named_path(value: str) -> Path:
    return Path(_named(value))


def _part(value: str) -> str:
    number, slash, count = value.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count) <= MAX_PARTS):
        raise typer.BadParameter(f"{value}: expected I/N with 1 <= I <= N <= {MAX_PARTS}, such as 3/8")
    return value


FleetArgument = Annotated[
    Path,
    typer.Argument(parser=_named_path, help="Drive store, or folder with a folder of logs per vehicle."),
]
FleetOrSummariesArgument = Annotated[
    str,
    typer.Argument(
        callback=_named,
        help="Drive store, folder with a folder of logs per vehicle, or summaries (path or URL).",
    ),
]
StoreOption = Annotated[
    str,
    typer.Option("--out", callback=_named, help="Store of summaries, path or URL; drives are added to one."),
]
LayoutOption = Annotated[Path, typer.Option("--layout", help="Layout (TOML) that says what the signals mean.")]
DbcOption = Annotated[Path | None, typer.Option("--dbc", help="DBC to use instead of the one the layout names.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
WorkersOption = Annotated[int, whole_option("--workers", 1, MAX_WORKERS, "Number of processes")]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler", metavar="URL", callback=_scheduler, help="Dask scheduler, tcp://HOST:PORT, instead of processes."
    ),
]
TimeLimitOption = Annotated[
    float,
    number_option("--time-limit", 1, MAX_TIME_LIMIT_S, "Longest time to read one log, or one vehicle of a fleet [s]"),
]
SeedOption = Annotated[int, whole_option("--seed", 0, MAX_SEED, "Seed of everything random")]
VehiclesOption = Annotated[int, whole_option("--vehicles", 1, MAX_VEHICLES, "Number of vehicles N")]
CurrentsOption = Annotated[int, whole_option("--currents", 2, MAX_CURRENTS, "Number of branches K")]
BranchesOption = Annotated[
    str | None, typer.Option("--branches", callback=_branches, help="Branches to use, with commas.")
]
DrivesOption = Annotated[str, typer.Option("--drives", help="Drive store with the trips to drive, or 'builtin'.")]
SymmetricOption = Annotated[bool, typer.Option("--symmetric", help="The fleet's mean is the ideal vehicle (22).")]
PartOption = Annotated[
    str,
    typer.Option(
        "--part", metavar="I/N", callback=_part, help="Part I of N of the vehicles, where N machines share the work."
    ),
]
SinceOption = Annotated[
    Path | None,
    typer.Option("--since", help="Earlier result: vehicles without new drives keep its parameters (posterior)."),
]
SparsityOption = Annotated[
    float, number_option("--sparsity", 0, 100, "Share of zero fault parameters of an artificial fleet [%]")
]
MagnitudeOption = Annotated[
    tuple[float, float],
    typer.Option(
        "--magnitude",
        metavar="LO HI",
        callback=_magnitude,
        help="Range of its fault magnitudes, 0 <= LO <= HI < 1: drifts, and offsets as fractions of full scale.",
    ),
]
NoiseOption = Annotated[float, number_option("--noise", 0, 1, "Sensor noise (sd), fraction of full scale")]
DelayOption = Annotated[float, number_option("--delay", 0, MAX_DELAY_MS, "Largest delay of a branch [ms]")]
UnmeasuredOption = Annotated[
    tuple[float, float],
    typer.Option(
        "--unmeasured",
        metavar="MEAN SD",
        callback=_unmeasured,
        help=f"Load without a sensor: mean and sd over vehicles, each 0 to {MAX_UNMEASURED_A:g} [A].",
    ),
]
MinutesOption = Annotated[
    float, number_option("--minutes", 0.1, MAX_MINUTES, "Least length of each built-in trip [min]")
]
UnseenMinutesOption = Annotated[
    float, number_option("--unseen-minutes", 0.1, MAX_MINUTES, "Least length of each unseen trip [min]")
]
CommonDriveOption = Annotated[bool, typer.Option("--common-drive", help="One trip for all vehicles.")]
BalancedOption = Annotated[bool, typer.Option("--balanced", help="No hardware faults in half of the vehicles.")]
HarmLimitOption = Annotated[
    float, number_option("--harm-limit", 0, 1, "Correct a branch if harm is less probable (posterior)")
]
TrustedOption = Annotated[
    list[str] | None,
    typer.Option("--trusted", help="Vehicles with bench-checked sensors; three carry the reference (posterior)."),
]
ReadingsOption = Annotated[
    Path | None,
    typer.Option(
        "--readings",
        help="Bench readings: CSV with columns vehicle, branch, drift, drift_sd, offset_a, offset_sd_a (posterior).",
    ),
]
SensorModelsOption = Annotated[
    bool, typer.Option("--sensor-models", help="Look for sensors that are not linear as well (posterior).")
]
ClassifierOption = Annotated[Classifier, typer.Option("--classifier", help="Tells hardware faults (published).")]
TruthOption = Annotated[Path | None, typer.Option("--truth", help="truth.json, for the perfect classifier.")]
HoldOutOption = Annotated[
    list[str] | None,
    typer.Option("--hold-out", help="Vehicles to calibrate, but to learn nothing from for others."),
]
UnityOption = Annotated[
    str | None, typer.Option("--unity", help="Vehicle whose held-out data is the unity drive (published).")
]
BankOption = Annotated[
    Path | None, typer.Option("--bank", help="Filter bank to use, a file that 'identify --out' wrote.")
]
PolesOption = Annotated[
    str | None,
    typer.Option(
        "--poles",
        callback=_time_constants,
        help=f"Low-passes to use: time constants with commas, each {SHORTEST_POLE_S:g} to {LONGEST_POLE_S:g} [s].",
    ),
]
QuickOption = Annotated[bool, typer.Option("--quick", help="Small and fast: shows that it runs, not the figures.")]
RepetitionsOption = Annotated[
    int | None,
    whole_option("--repetitions", 1, MAX_REPETITIONS, "Trials per setting (without it 10, with --quick 2)"),
]
ExperimentDrivesOption = Annotated[
    Path | None,
    typer.Option(
        "--drives", help=f"Drive store for {', '.join(RECORDED_EXPERIMENTS)}; without it the built-in vehicle."
    ),
]
ExperimentLayoutOption = Annotated[
    Path | None,
    typer.Option("--layout", help="Layout of these drives; without it dbc/hv_powertrain.toml of a checkout."),
]
ResultsFolderOption = Annotated[
    Path | None,
    typer.Option("--out", help="Folder for NAME.md, NAME.json and NAME.png; FOLDER.md beside it lists all."),
]


def named_vehicles(values: list[str] | None) -> frozenset[str]:
    """Vehicles of an option that is given several times, or once with commas; no name has a comma."""
    return frozenset(name.strip() for value in values or () for name in value.split(","))


def require_one_bank(bank: Path | None, poles: str | None) -> None:
    """Refuse a bank file together with poles: only one of them can be used.

    Raises
    ------
    typer.BadParameter
        If both are given.
    """
    if bank is not None and poles is not None:
        raise typer.BadParameter("a bank has its own poles; give --bank or --poles", param_hint="--poles")


def numbered_part(value: str) -> tuple[int, int]:
    """Number and count of ``I/N``."""
    number, _, count = value.partition("/")
    return int(number), int(count)


def require_own_options(context: typer.Context, method: Method) -> None:
    """Refuse options that were given for another method: without a word, they would be ignored.

    Parameters
    ----------
    context : typer.Context
        Of the command.
    method : Method
        That is used.

    Raises
    ------
    typer.BadParameter
        Naming the first such option.
    """
    for other, names in OWN_OPTIONS.items():
        given = given_options(context, names)
        if other is not method and given:
            raise typer.BadParameter(
                f"belongs to --method {other.value}, not {method.value}; leave it out or change the method",
                param_hint=given[0],
            )


def require_truth_where_used(classifier: Classifier, truth: Path | None, method: Method) -> None:
    """Refuse a truth that nothing uses, and the perfect classifier without one.

    Parameters
    ----------
    classifier : Classifier
        That is used.
    truth : Path or None
        The truth, if it was given.
    method : Method
        That is used; the other one has no classifier.

    Raises
    ------
    typer.BadParameter
        Naming the option that was given, and what to add.
    """
    if (classifier is Classifier.PERFECT) == (truth is not None):
        return
    with_method = "" if method is Method.PUBLISHED else "--method published "
    if truth is not None:
        raise typer.BadParameter(
            f"used by the perfect classifier alone, not by {classifier.value}; "
            f"add {with_method}--classifier perfect, or leave it out",
            param_hint="--truth",
        )
    raise typer.BadParameter(
        f"perfect is told the truth; add {with_method}--truth FILE, the truth.json of this artificial fleet",
        param_hint="--classifier",
    )


def require_heeded_options(context: typer.Context, name: ExperimentName) -> None:
    """Refuse options that an experiment does not heed, and ``calibration`` without the folder that it pools.

    Parameters
    ----------
    context : typer.Context
        Of the command.
    name : ExperimentName
        The experiment; all together heed every option.

    Raises
    ------
    typer.BadParameter
        Naming the first such option.
    """
    unheeded: tuple[str, ...] = ()
    reason = ""
    if name is ExperimentName.CALIBRATION:
        unheeded, reason = RUN_OPTIONS, "calibration runs nothing, it pools what is recorded in --out"
    elif name not in (*RECORDED_EXPERIMENTS, ExperimentName.ALL):
        unheeded = RECORDED_OPTIONS
        reason = f"{name.value} takes the built-in vehicle; this is only for {', '.join(RECORDED_EXPERIMENTS)}"
    given = given_options(context, unheeded)
    if given:
        raise typer.BadParameter(reason, param_hint=given[0])
    if name is ExperimentName.CALIBRATION and context.params["out"] is None:
        raise typer.BadParameter(
            "calibration pools what is recorded there; first run 'calibrator experiment all --out FOLDER', or some "
            "experiments by their names",
            param_hint="--out",
        )


def given_options(context: typer.Context, names: Sequence[str]) -> list[str]:
    """Those of some parameters that stand on the command line, as they are written there."""
    sources = {name: context.get_parameter_source(name) for name in names}
    given = [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]
    return [f"--{name.replace('_', '-')}" for name in given]
