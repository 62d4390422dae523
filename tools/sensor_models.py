#!/usr/bin/env python3
"""How well sensors that are not linear are corrected: a fleet is drawn, calibrated, and judged on unseen drives."""

from pathlib import Path
from typing import Annotated

import typer

from calibrator.experiments.recorded_fleet import builtin_fleet, read_fleet
from calibrator.experiments.sensor_fleet import SensorCase, calibrate_sensors, draw_sensors
from calibrator.experiments.sensor_score import score_sensors
from calibrator.terminal.command_line import command_app, run_tool
from calibrator.terminal.options import MAX_CURRENTS, MAX_VEHICLES, SeedOption, number_option, whole_option
from calibrator.terminal.text import print_report
from ecu_node.database import read_database
from ecu_node.layout import read_layout

app = command_app()


@app.command()
def main(
    *,
    layout: Annotated[Path, typer.Option(help="Layout that names a temperature.")] = Path("dbc/hv_powertrain.toml"),
    drives: Annotated[Path | None, typer.Option(help="Drive store; none: built-in trips.")] = None,
    vehicles: Annotated[
        int, whole_option("--vehicles", 8, MAX_VEHICLES, "Vehicles of the fleet")
    ] = SensorCase().vehicles,
    branches: Annotated[int, whole_option("--branches", 2, MAX_CURRENTS, "Branches of each")] = SensorCase().branches,
    share: Annotated[float, number_option("--share", 0, 1, "Share with a bent sensor")] = SensorCase().share,
    sparsity: Annotated[float, number_option("--sparsity", 0, 100, "Of the other faults [%]")] = SensorCase().sparsity,
    seed: SeedOption = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the counts as JSON.")] = False,
) -> None:
    """Draw a fleet with sensors that are not linear, calibrate it, and count what became of them."""
    database = read_database(read_layout(layout))
    recorded = builtin_fleet(database) if drives is None else read_fleet(drives, database)
    case = SensorCase(vehicles=vehicles, branches=branches, share=share, sparsity=sparsity)
    fleet = draw_sensors(recorded, case, seed)
    score = score_sensors(fleet, *calibrate_sensors(fleet, database), database)
    print_report(score, json=as_json)


if __name__ == "__main__":
    run_tool(app, "sensor_models")
