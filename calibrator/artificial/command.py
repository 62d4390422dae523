"""``calibrator simulate``: an artificial fleet with known faults."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibrator.artificial.options import (
    BalancedOption,
    CommonDriveOption,
    CurrentsOption,
    DelayOption,
    DrivesOption,
    MinutesOption,
    NoiseOption,
    UnmeasuredOption,
    UnseenMinutesOption,
    VehiclesOption,
)
from calibrator.files.folders import require_new_folder
from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import (
    JsonOption,
    LayoutOption,
    MagnitudeOption,
    SeedOption,
    SparsityOption,
    SymmetricOption,
    WorkersOption,
)
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import dumps
from ecu_node.program import write_output

if TYPE_CHECKING:
    from calibrator.fleet_truth import FleetTruth

__all__ = ["simulate"]


def simulate(
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Folder of the fleet, new or empty.")],
    vehicles: VehiclesOption,
    drives: DrivesOption = "builtin",
    currents: CurrentsOption = 2,
    sparsity: SparsityOption = 80.0,
    magnitude: MagnitudeOption = (0.05, 0.25),
    common_drive: CommonDriveOption = False,
    symmetric: SymmetricOption = False,
    balanced: BalancedOption = False,
    noise: NoiseOption = 0.001,
    delay: DelayOption = 0.0,
    unmeasured: UnmeasuredOption = (0.0, 0.0),
    minutes: MinutesOption = 10.0,
    unseen_minutes: UnseenMinutesOption = 3.0,
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
    with progress_bar("simulate", vehicles, "vehicles") as progress:
        truth = simulate_fleet(plan, trips, database, out, workers=workers, progress=progress)
    _print_fleet(truth, out, trips.notices, json=json)


def _print_fleet(truth: "FleetTruth", out: Path, notices: Sequence[str], *, json: bool) -> None:
    figures = {"vehicles": len(truth.vehicles), "branches": truth.branches, "out": str(out), "notices": notices}
    lines = [f"{out}: {len(truth.vehicles)} vehicles with branches {', '.join(truth.branches)}"]
    if json:
        write_output(dumps(figures))
    else:
        write_output("\n".join([*lines, *(f"notice: {notice}" for notice in notices)]))
