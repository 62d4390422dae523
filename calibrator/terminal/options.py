"""Options that several commands share, and what they accept: a wrong value ends a command before it does anything.

Upper bounds are far beyond what a vehicle has; they catch slips of units before these fill memory or disk.
"""

import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

__all__ = [
    "TIME_LIMIT_S",
    "BankOption",
    "BranchesOption",
    "FleetArgument",
    "FleetOrSummariesArgument",
    "JsonOption",
    "LayoutOption",
    "MagnitudeOption",
    "SchedulerOption",
    "SeedOption",
    "SparsityOption",
    "StoreOption",
    "SymmetricOption",
    "TimeLimitOption",
    "WorkersOption",
    "given_options",
    "number_option",
    "whole_option",
]

MAX_VEHICLES = 100_000
MAX_CURRENTS = 16
MAX_SEED = 2**32 - 1
MAX_WORKERS = 256
FAR = 1e9
"""The help leaves out upper bounds from here on: they are of no use to a reader."""
TIME_LIMIT_S = 600.0
"""Default of ``--time-limit``: a day's log is read in seconds; one that takes longer than this may never end. [s]"""
SCHEDULER = re.compile(r"(tcp|tls)://([^\s/?#@:\[\]]+|\[[0-9A-Fa-f:.]+\]):(?P<port>[0-9]{1,5})")
MAX_PORT = 65_535
MAX_TIME_LIMIT_S = 86_400.0
"""Largest ``--time-limit``: a day. [s]"""


def _bounded(kind: type[float], name: str, low: float, high: float, meaning: str) -> Any:
    """Make an option that takes a finite number between bounds; other input is refused, with these bounds.

    Parameters
    ----------
    kind : type
        ``float``, or ``int`` for whole numbers.
    name : str
        Name of the option, with its dashes.
    low, high : float
        Smallest and largest number.
    meaning : str
        Meaning and unit of the number, for the help; the bounds are added.

    Returns
    -------
    typer's option
        For ``Annotated[float, ...]`` or ``Annotated[int, ...]``.
    """

    def parse(given: str | float) -> float:
        try:
            value = kind(given)
        except ValueError:
            value = math.nan
        if not low <= value <= high:  # nor is not-a-number
            what = "number" if kind is float else "whole number"
            raise typer.BadParameter(f"{given}: expected a {what} from {low:.16g} to {high:.16g}")
        return value

    bounds = f"{low:g} to {high:.12g}" if high < FAR else f"{low:g} or more"
    return typer.Option(name, parser=parse, metavar="NUMBER", help=f"{meaning}, {bounds}.")


number_option, whole_option = partial(_bounded, float), partial(_bounded, int)


def _branches(value: str | None) -> str | None:
    if value is None:
        return None
    names = [name.strip() for name in value.split(",")]
    if "" in names:
        raise typer.BadParameter(f"{value!r}: expected names of branches with commas between them")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise typer.BadParameter(f"{', '.join(twice)} is named twice; name each branch once")
    return ",".join(names)


def _magnitude(value: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= value[0] <= value[1] < 1:
        raise typer.BadParameter(f"{value[0]:g} {value[1]:g}: expected 0 <= LO <= HI < 1")
    return value


def _scheduler(value: str | None) -> str | None:
    found = SCHEDULER.fullmatch(value or "tcp://none:1")
    if found is None or not 1 <= int(found["port"]) <= MAX_PORT:
        where = f"tcp://HOST:PORT or tls://HOST:PORT, port 1 to {MAX_PORT}"
        raise typer.BadParameter(f"{value!r}: expected the address of a Dask scheduler, {where}")
    return value


FleetArgument = Annotated[
    str, typer.Argument(help="Drive store, or folder with a folder of logs per vehicle; path or URL.")
]
FleetOrSummariesArgument = Annotated[
    str,
    typer.Argument(
        help="Log, table, or folder of them, of one vehicle; folder with a folder of logs per vehicle; drive store; or "
        "summaries (path or URL).",
    ),
]
StoreOption = Annotated[str, typer.Option("--out", help="Store of summaries, path or URL; drives are added to one.")]
LayoutOption = Annotated[Path, typer.Option("--layout", help="Layout (TOML) that says what the signals mean.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
WorkersOption = Annotated[int, whole_option("--workers", 1, MAX_WORKERS, "Number of processes")]
TimeLimitOption = Annotated[
    float,
    number_option("--time-limit", 1, MAX_TIME_LIMIT_S, "Longest time to read one log, or one vehicle of a fleet [s]"),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        callback=_scheduler,
        help="Dask scheduler, tcp://HOST:PORT, instead of processes.",
    ),
]
SeedOption = Annotated[int, whole_option("--seed", 0, MAX_SEED, "Seed of everything random")]
BranchesOption = Annotated[
    str | None, typer.Option("--branches", callback=_branches, help="Branches to use, with commas.")
]
BankOption = Annotated[
    Path | None, typer.Option("--bank", help="Filter bank to use, a file that 'identify --out' wrote.")
]
SymmetricOption = Annotated[bool, typer.Option("--symmetric", help="The fleet's mean is the ideal vehicle (22).")]
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


def given_options(context: typer.Context, names: Sequence[str]) -> list[str]:
    """Return those of the named parameters that were given on the command line, as options (``--name``)."""
    sources = {name: context.get_parameter_source(name) for name in names}
    given = [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]
    return [f"--{name.replace('_', '-')}" for name in given]
