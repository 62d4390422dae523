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

from calibrator.artificial.command import MAX_MINUTES, CurrentsOption, UnmeasuredOption
from calibrator.artificial.simulate import FleetPlan
from calibrator.artificial.trips import choose_trips
from calibrator.terminal.command_line import command_app, run_tool
from calibrator.terminal.options import (
    MAX_VEHICLES,
    SeedOption,
    SparsityOption,
    WorkersOption,
    number_option,
    whole_option,
)
from calibrator.terminal.text import print_report
from chain.fleet import draw_fleet
from chain.whole import drive_chain
from ecu_node.database import read_database
from ecu_node.errors import UserError
from ecu_node.layout import read_layout

app = command_app()


@app.command()
def main(
    *,
    layout: Annotated[Path, typer.Option(help="Layout of the vehicles.")] = Path("dbc/hv_powertrain.toml"),
    drives: Annotated[str, typer.Option(help="Drive store with the trips to drive, or 'builtin'.")] = "builtin",
    vehicles: Annotated[int, whole_option("--vehicles", 8, MAX_VEHICLES, "Vehicles of the fleet")] = 500,
    currents: CurrentsOption = 3,
    sparsity: SparsityOption = 80,
    unmeasured: UnmeasuredOption = (0.0, 0.0),
    minutes: Annotated[
        float, number_option("--minutes", 2, MAX_MINUTES, "Least length of each trip to learn from [min]")
    ] = 10.0,
    unseen_minutes: Annotated[
        float, number_option("--unseen-minutes", 2, MAX_MINUTES, "Length of each unseen trip, with trial [min]")
    ] = 10.0,
    seed: SeedOption = 0,
    workers: WorkersOption = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Drive a fleet through the whole chain, and count what became of its vehicles."""
    database = read_database(read_layout(layout))
    trial_s = database.layout.activation.trial_s
    if 60.0 * unseen_minutes <= trial_s:
        raise UserError(
            f"--unseen-minutes {unseen_minutes:g}: the trial of {layout} alone takes {trial_s:g} s; give more"
        )
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
