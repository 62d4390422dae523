"""``calibrator report``: the page of a result."""

from pathlib import Path
from typing import Annotated

import typer

from calibrator.files.folders import require_possible_file, write_files
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import JsonOption, number_option
from calibrator.terminal.text import dumps
from ecu_node.program import write_output

__all__ = ["report"]

MAX_LIMIT_A, MAX_VOLTAGE_V = 10_000.0, 2000.0
"""Largest values that are accepted, beyond any battery of a road vehicle. [A], [V]"""


def report(
    result: Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")],
    out: Annotated[
        Path | None, typer.Option(help="HTML file to write; without it report.html, or VEHICLE.html, in the result.")
    ] = None,
    vehicle: Annotated[str | None, typer.Option(help="The page of this vehicle alone.")] = None,
    battery: Annotated[
        str | None, typer.Option(help="Branch of the battery, for its protection margin; default: by its name.")
    ] = None,
    limit: Annotated[
        float | None,
        number_option("--limit", 0.1, MAX_LIMIT_A, "Current limit of the battery [A]; full scale without it"),
    ] = None,
    voltage: Annotated[
        float | None,
        number_option("--voltage", 1, MAX_VOLTAGE_V, "Voltage of the battery, to have its margin in kW [V]"),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Show a result as one HTML page, of the fleet or of one vehicle; it needs no network."""
    with importing():
        from calibrator.estimator.results import read_run
        from calibrator.report.page import report_page

    read_run(result)  # if it is no result, this says so, and not that nothing can be written there
    target = out if out is not None else result / f"{vehicle or 'report'}.html"
    if target.suffix.lower() != ".html":
        raise typer.BadParameter(f"{target}: expected a file name that ends with .html", param_hint="--out")
    require_possible_file(target)
    text, about = report_page(result, vehicle, battery=battery, limit_a=limit, voltage_v=voltage)
    content = text.encode()
    write_files({target: content})
    said = f"{target}: {len(content) / 1e6:.2f} MB; open it in a browser"
    write_output(dumps({"page": str(target), "bytes": len(content), **about}) if json else said)
