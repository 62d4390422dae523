"""Options of ``calibrator calibrate``, and which of them belong together."""

import re
from pathlib import Path
from typing import Annotated

import typer

from calibrator.options import Classifier, Method
from calibrator.terminal.options import given_options, number_option

__all__ = [
    "ClassifierOption",
    "HarmLimitOption",
    "HoldOutOption",
    "ReadingsOption",
    "SchedulerOption",
    "SensorModelsOption",
    "SinceOption",
    "TrustedOption",
    "TruthOption",
    "UnityOption",
    "named_vehicles",
    "require_own_options",
    "require_truth_where_used",
]

OWN_OPTIONS = {
    Method.POSTERIOR: ("harm_limit", "trusted", "readings", "sensor_models", "scheduler", "since"),
    Method.PUBLISHED: ("classifier", "truth", "sparsity", "magnitude", "symmetric", "unity", "seed"),
}
"""What only one method heeds."""
SCHEDULER = re.compile(r"(tcp|tls)://([^\s/?#@:\[\]]+|\[[0-9A-Fa-f:.]+\]):(?P<port>[0-9]{1,5})")
MAX_PORT = 65_535


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


SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler", metavar="URL", callback=_scheduler, help="Dask scheduler, tcp://HOST:PORT, instead of processes."
    ),
]
SinceOption = Annotated[
    Path | None,
    typer.Option("--since", help="Earlier result: vehicles without new drives keep its parameters (posterior)."),
]
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


def named_vehicles(values: list[str] | None) -> frozenset[str]:
    """Vehicles of an option that is given several times, or once with commas; no name has a comma."""
    return frozenset(name.strip() for value in values or () for name in value.split(","))


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
