#!/usr/bin/env python3
"""From a fleet to corrected vehicles: drives are calibrated, signed, activated and tried, and what comes out is judged.

Vehicles with known faults drive; the calibrator learns from their drives, two people sign what it found, each vehicle's
node takes its signed file, tries it, and corrects a drive that nobody has seen. Beside each right set two wrong ones
are on trial: with signs turned, and of another vehicle.
"""

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from calibrator.artificial.simulate import FleetPlan
from calibrator.artificial.trips import choose_trips
from calibrator.commands import command_app, run_tool
from calibrator.report.text import print_report
from chain.fleet import draw_fleet
from chain.whole import drive_chain
from ecu_node.database import read_database
from ecu_node.layout import read_layout

app = command_app()


@app.command()
def main(
    *,
    layout: Annotated[Path, typer.Option(help="Layout of the vehicles.")] = Path("dbc/hv_powertrain.toml"),
    drives: Annotated[str, typer.Option(help="Drive store with the trips to drive, or 'builtin'.")] = "builtin",
    vehicles: Annotated[int, typer.Option(min=8, help="Vehicles of the fleet.")] = 500,
    currents: Annotated[int, typer.Option(min=2, max=16, help="Branches of each.")] = 3,
    sparsity: Annotated[float, typer.Option(min=0.0, max=100.0, help="Share of parameters without a fault [%].")] = 80,
    unmeasured: Annotated[
        tuple[float, float], typer.Option(help="Load without a sensor: mean and sd over vehicles [A].")
    ] = (0.0, 0.0),
    minutes: Annotated[float, typer.Option(min=2.0, help="Least length of each trip to learn from [min].")] = 10.0,
    unseen_minutes: Annotated[
        float, typer.Option(min=2.0, help="Length of each unseen trip, with trial [min].")
    ] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    workers: Annotated[int, typer.Option(min=1, help="Number of processes.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Drive a fleet through the whole chain, and count what became of its vehicles."""
    database = read_database(read_layout(layout))
    trips = choose_trips(
        drives,
        database.layout,
        vehicles=vehicles,
        seed=seed,
        duration_s=60.0 * minutes,
        unseen_s=60.0 * unseen_minutes,
        common=False,
    )
    plan = FleetPlan(
        vehicles=vehicles,
        currents=currents,
        sparsity=sparsity,
        magnitude=(0.02, 0.1),
        delay_max_s=0.1,
        unmeasured_a=unmeasured,
        seed=seed,
    )
    fleet = draw_fleet(plan, trips, database, unseen_s=60.0 * unseen_minutes)
    with tempfile.TemporaryDirectory(prefix="chain-") as folder:
        score = drive_chain(fleet, Path(folder), workers=workers)
    print_report(score, json=as_json)


if __name__ == "__main__":
    run_tool(app, "trust_chain")
