"""``calibrator simulate``: an artificial fleet with known faults."""

from pathlib import Path
from typing import Annotated, Any

import typer

from calibrator.files.folders import require_new_folder
from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import (
    MAX_CURRENTS,
    MAX_VEHICLES,
    JsonOption,
    LayoutOption,
    MagnitudeOption,
    SeedOption,
    SparsityOption,
    SymmetricOption,
    WorkersOption,
    number_option,
    whole_option,
)
from calibrator.terminal.text import dumps
from ecu_node.program import write_output

__all__ = ["MAX_MINUTES", "UnmeasuredOption", "simulate"]

MAX_MINUTES = 240.0
"""Longest trip, as its log is made in memory, at some 250 frames per second. [min]"""
MAX_DELAY_MS = 1000.0
"""Largest delay: the branch signals of real cars lag each other by tens to hundreds of milliseconds. [ms]"""
MAX_UNMEASURED_A = 1000.0
"""Largest load without a sensor: more than the full scale of any car's junction. [A]"""


def _unmeasured(value: tuple[float, float]) -> tuple[float, float]:
    if not all(0 <= number <= MAX_UNMEASURED_A for number in value):
        raise typer.BadParameter(
            f"{value[0]:g} {value[1]:g}: expected mean and standard deviation from 0 to {MAX_UNMEASURED_A:g} A"
        )
    return value


UnmeasuredOption = Annotated[
    tuple[float, float],
    typer.Option(
        "--unmeasured",
        metavar="MEAN SD",
        callback=_unmeasured,
        help=f"Load without a sensor: mean and sd over vehicles, each 0 to {MAX_UNMEASURED_A:g} [A].",
    ),
]


def _minutes(name: str, what: str) -> Any:
    return number_option(name, 0.1, MAX_MINUTES, f"Least length of each {what} trip [min]")


def simulate(
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Folder of the fleet, new or empty.")],
    vehicles: Annotated[int, whole_option("--vehicles", 1, MAX_VEHICLES, "Number of vehicles N")],
    drives: Annotated[
        str, typer.Option("--drives", help="Drive store with the trips to drive, or 'builtin'.")
    ] = "builtin",
    currents: Annotated[int, whole_option("--currents", 2, MAX_CURRENTS, "Number of branches K")] = 2,
    sparsity: SparsityOption = 80.0,
    magnitude: MagnitudeOption = (0.05, 0.25),
    common_drive: Annotated[bool, typer.Option("--common-drive", help="One trip for all vehicles.")] = False,
    symmetric: SymmetricOption = False,
    balanced: Annotated[bool, typer.Option("--balanced", help="No hardware faults in half of the vehicles.")] = False,
    noise: Annotated[float, number_option("--noise", 0, 1, "Sensor noise (sd), fraction of full scale")] = 0.001,
    delay: Annotated[float, number_option("--delay", 0, MAX_DELAY_MS, "Largest delay of a branch [ms]")] = 0.0,
    unmeasured: UnmeasuredOption = (0.0, 0.0),
    minutes: Annotated[float, _minutes("--minutes", "built-in")] = 10.0,
    unseen_minutes: Annotated[float, _minutes("--unseen-minutes", "unseen")] = 3.0,
    seed: SeedOption = 0,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Write an artificial fleet: CAN logs of vehicles with known faults, and truth.json."""
    with importing():
        from calibrator.artificial.simulate import FleetPlan, simulate_fleet
        from calibrator.artificial.trips import choose_trips

    require_new_folder(out)
    database = vehicle_database(layout)
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
    truth = simulate_fleet(plan, trips, database, out, workers=workers)
    if json:
        found = {"vehicles": len(truth.vehicles), "branches": truth.branches, "out": str(out), "notices": trips.notices}
        write_output(dumps(found))
    else:
        line = f"{out}: {len(truth.vehicles)} vehicles with branches {', '.join(truth.branches)}"
        write_output("\n".join([line, *(f"notice: {notice}" for notice in trips.notices)]))
