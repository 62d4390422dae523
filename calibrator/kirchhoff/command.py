"""``calibrator kirchhoff``: the sum of the branch currents, from a log or a table."""

from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from calibrator.files.folders import require_possible_file
from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import JsonOption
from calibrator.terminal.text import dumps
from ecu_node.program import say_error, write_output

if TYPE_CHECKING:
    from ecu_node.database import VehicleDatabase

__all__ = ["kirchhoff"]

PAGES, TABLES = (".html",), (".csv", ".parquet")
"""File name endings of pages and tables that can be written."""
USUAL_SCALE_A = 500.0
"""Greatest plausible current where no layout states the full scale. [A]"""


def kirchhoff(
    *,
    log: Annotated[Path, typer.Argument(help="Log of frames, or table of currents (.csv, .parquet ...).")],
    layout: Annotated[Path | None, typer.Option(help="Layout (TOML) that says what the signals mean.")] = None,
    branches: Annotated[
        str | None,
        typer.Option(
            help="Without a layout: columns of the table, NAME=COLUMN with commas, a minus before a column that is "
            "positive out of the junction: battery=Ibat,-motor=Imot."
        ),
    ] = None,
    parameters: Annotated[
        Path | None, typer.Option(help="Parameter file of this vehicle: correct with it, instead of corrected frames.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw the currents, as a page to zoom in (.html).")] = None,
    table: Annotated[Path | None, typer.Option(help=f"Write the currents ({' '.join(TABLES)}).")] = None,
    json: JsonOption = False,
) -> None:
    """Print the branch currents and their sum, before and after correction, and what is expected of right sensors."""
    if (layout is None) == (branches is None):
        raise typer.BadParameter(
            "give either --layout, which 'calibrator layout init' makes, or --branches with the columns of a table"
        )
    if parameters is not None and layout is None:
        raise typer.BadParameter("--parameters belong to a layout; give --layout, not --branches")
    with importing():
        from calibrator.kirchhoff.findings import sum_findings
        from calibrator.kirchhoff.junction import look_at_junction
        from calibrator.kirchhoff.sums import compare_kirchhoff, with_voltages
        from calibrator.kirchhoff.view import draw_kirchhoff, kirchhoff_text, save_table
        from calibrator.recordings.log_formats import is_log, is_table, logs_in
        from calibrator.recordings.readers import TableSource, open_recording
        from calibrator.recordings.tables import layout_from_branches, read_table
        from ecu_node.parameters import check_fit, read_parameters

    read = {path.resolve() for path in filter(None, (log, *logs_in(log), layout, parameters))}
    for path, ends in ((plot, PAGES), (table, TABLES)):
        if path is not None and path.suffix.lower() not in ends:
            raise typer.BadParameter(f"{path}: expected a file name that ends with {', '.join(ends)}")
        if path is not None and path.resolve() in read:
            raise typer.BadParameter(f"{path}: is read here and would be overwritten; choose another name")
        if path is not None:
            require_possible_file(path)
    if layout is not None:
        database = with_voltages(vehicle_database(layout))
    elif is_table(log) or not log.exists() or not (is_log(log) or logs_in(log)):
        database = layout_from_branches(str(branches), table=read_table(log))
    else:
        raise typer.BadParameter(
            "--branches names columns of a table; a log of frames needs --layout, which 'calibrator layout init "
            "DATABASE --log LOG --out my_car.toml' makes"
        )
    found = None if parameters is None else read_parameters(parameters)
    if found is not None:
        check_fit(found, database, None)
    source = open_recording(log, database)
    if isinstance(source, TableSource):
        for column in source.branch_columns():
            if not source.table.no_numbers(column):  # a name that the table does not have is an error, not a gap
                source.table.column(column)
    recording = source.recording(database.layout.name, log.name.partition(".")[0])
    comparison = compare_kirchhoff(recording.drive, database, recording.corrected, found)
    if plot is not None:
        draw_kirchhoff(comparison, plot, title=f"Branch currents, positive into the junction: {log.name}")
    if table is not None:
        save_table(comparison, table)
    scale_a = USUAL_SCALE_A if branches is not None else database.layout.full_scale_a
    junction = look_at_junction([recording.drive], database, full_scale_a=scale_a)
    if junction.is_short or junction.stands_still:
        comparison = replace(comparison, residual=dict.fromkeys(comparison.residual))
    findings, notices = sum_findings(junction), [*map(str, recording.report.log_notices()), *comparison.notices()]
    if json:
        write_output(dumps(comparison.as_json() | {"notices": notices, "findings": findings}))
        return
    write_output(kirchhoff_text(comparison, [*notices, *(finding.line for finding in findings)]))
    if "after" not in comparison.stages and (step := _next_step(log, layout, branches, database)):
        say_error(f"next: calibrator {step}")


def _next_step(log: Path, layout: Path | None, branches: str | None, database: "VehicleDatabase") -> str:
    """Return the command that leads to a correction of this log; empty if no single one does, as with formulas."""
    if layout is not None:
        return f"calibrate {quote(str(log))} --layout {quote(str(layout))} --trusted BRANCH --out result"
    if any(branch.computed for branch in database.layout.branch):
        return ""
    return f"layout init {quote(str(log))} --branches {quote(str(branches))} --out my_car.toml"
