"""Options that say what an artificial fleet is like."""

from typing import Annotated

import typer

from calibrator.terminal.options import MAX_CURRENTS, MAX_VEHICLES, number_option, whole_option

__all__ = [
    "BalancedOption",
    "CommonDriveOption",
    "CurrentsOption",
    "DelayOption",
    "DrivesOption",
    "MinutesOption",
    "NoiseOption",
    "UnmeasuredOption",
    "UnseenMinutesOption",
    "VehiclesOption",
]

MAX_MINUTES = 240.0
"""A trip's log is made in memory, at some 250 frames per second. [min]"""
MAX_DELAY_MS = 1000.0
"""The branch signals of a real car lag each other by tens to hundreds of milliseconds. [ms]"""
MAX_UNMEASURED_A = 1000.0
"""More than the full scale of any car's junction. [A]"""


def _unmeasured(value: tuple[float, float]) -> tuple[float, float]:
    if not all(0 <= number <= MAX_UNMEASURED_A for number in value):
        raise typer.BadParameter(
            f"{value[0]:g} {value[1]:g}: expected mean and standard deviation from 0 to {MAX_UNMEASURED_A:g} A"
        )
    return value


VehiclesOption = Annotated[int, whole_option("--vehicles", 1, MAX_VEHICLES, "Number of vehicles N")]
CurrentsOption = Annotated[int, whole_option("--currents", 2, MAX_CURRENTS, "Number of branches K")]
DrivesOption = Annotated[str, typer.Option("--drives", help="Drive store with the trips to drive, or 'builtin'.")]
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
