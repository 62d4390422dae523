"""``calibrator report``: the pages of a result."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibrator.files.folders import require_possible_file
from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import JsonOption, given_options, number_option
from calibrator.terminal.text import dumps
from ecu_node.standard_output import write_output
from ecu_node.user_files import write_atomically

if TYPE_CHECKING:
    from calibrator.report.write import FleetReport, VehicleReport

__all__ = ["report"]

OF_FLEET = ("beside", "earlier", "battery", "limit", "voltage")
OF_VEHICLE = ("drives", "layout")
"""Options that only one of the pages heeds."""
MAX_LIMIT_A, MAX_VOLTAGE_V = 10_000.0, 2000.0
"""Beyond any battery of a road vehicle. [A], [V]"""

ResultArgument = Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")]
PageOption = Annotated[
    Path | None, typer.Option("--out", help="HTML file to write; report.html, or VEHICLE.html, without it.")
]
VehicleOption = Annotated[str | None, typer.Option("--vehicle", help="A page of this vehicle alone, to be printed.")]
BesideOption = Annotated[
    Path | None, typer.Option("--beside", help="Result of the same fleet by another method, laid beside.")
]
EarlierOption = Annotated[
    Path | None, typer.Option("--earlier", help="Earlier result of the same fleet, to see how sensors age.")
]
BatteryOption = Annotated[
    str | None, typer.Option("--battery", help="Branch whose protection margin is told; without it 'battery'.")
]
LimitOption = Annotated[
    float | None,
    number_option("--limit", 0.1, MAX_LIMIT_A, "Current limit of the battery [A]; full scale without it"),
]
VoltageOption = Annotated[
    float | None,
    number_option("--voltage", 1, MAX_VOLTAGE_V, "Voltage that makes A to kW [V]; that of the unity window without it"),
]
DrivesOption = Annotated[
    Path | None, typer.Option("--drives", help="With --vehicle: its drives, of which a minute is shown.")
]
DrivesLayoutOption = Annotated[Path | None, typer.Option("--layout", help="Layout (TOML) of these drives.")]


def report(
    context: typer.Context,
    result: ResultArgument,
    out: PageOption = None,
    vehicle: VehicleOption = None,
    beside: BesideOption = None,
    earlier: EarlierOption = None,
    battery: BatteryOption = None,
    limit: LimitOption = None,
    voltage: VoltageOption = None,
    drives: DrivesOption = None,
    layout: DrivesLayoutOption = None,
    json: JsonOption = False,
) -> None:
    """Show a result: one HTML page of the fleet, or of one vehicle, that needs nothing else and fetches nothing."""
    with importing():
        from calibrator.report.write import ReportOptions, fleet_report, vehicle_report

    _require_own_options(context, vehicle)
    target = out if out is not None else Path(f"{vehicle or 'report'}.html")
    require_possible_file(target)
    options = ReportOptions(beside=beside, earlier=earlier, battery=battery, limit_a=limit, voltage_v=voltage)
    text: str
    found: FleetReport | VehicleReport
    if vehicle is None:
        text, found = fleet_report(result, options)
    else:
        database = None if layout is None else vehicle_database(layout)
        text, found = vehicle_report(result, vehicle, drives=drives, database=database)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(target, text.encode())
    size = len(text.encode())
    about = {"page": str(target), "bytes": size, **vars(found)}
    write_output(dumps(about) if json else f"{target}: {size / 1e6:.2f} MB; open it in a browser")


def _require_own_options(context: typer.Context, vehicle: str | None) -> None:
    """Refuse options that the page asked for does not heed."""
    if vehicle is None:
        given, instead = given_options(context, OF_VEHICLE), "the page of one vehicle; name it with --vehicle"
    else:
        given, instead = given_options(context, OF_FLEET), "the page of the fleet; leave it out, or leave --vehicle out"
    if given:
        raise typer.BadParameter(f"belongs to {instead}", param_hint=given[0])
    drives, layout = (context.params[name] is not None for name in OF_VEHICLE)
    if drives != layout:
        what = "drives need the layout that says what their signals mean"
        raise typer.BadParameter(f"{what}; give both", param_hint="--drives and --layout")
