"""``calibrator kirchhoff``: the sum of the branch currents, from a log, a table or a live bus."""

import shlex
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import DbcOption, JsonOption, number_option
from calibrator.terminal.text import dumps
from ecu_node.program import say_error, write_output

__all__ = ["kirchhoff"]

TOLD = ("too short", "stands still", "delay")
"""Hints that are told: what the figures cannot tell, and what no figure shows."""
USUAL_SCALE_A = 500.0
"""Currents are plausible up to it where nothing tells full scale but the currents themselves. [A]"""


def _option(help_text: str, *suffixes: str) -> Any:
    """Option with a file to be written, whose name has one of these suffixes."""

    def check(path: Path | None) -> Path | None:
        if path is not None and path.suffix.lower() not in suffixes:
            raise typer.BadParameter(f"{path}: expected a file name that ends with {', '.join(suffixes)}")
        return path

    return typer.Option(help=f"{help_text} ({' '.join(suffixes)}).", callback=check)


def _require_others(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """See that no file to be written is one that is read."""
    read = {path.resolve() for path in inputs}
    for path in outputs:
        if path.resolve() in read:
            raise typer.BadParameter(f"{path}: is read here and would be overwritten; choose another name")


def kirchhoff(
    *,
    log: Annotated[
        Path | None, typer.Argument(metavar="LOG", help="Log of frames, or table of currents (.csv, .parquet ...).")
    ] = None,
    layout: Annotated[Path | None, typer.Option(help="Layout (TOML) that says what the signals mean.")] = None,
    dbc: DbcOption = None,
    branches: Annotated[
        str | None,
        typer.Option(
            help="Without a layout: columns of the table, NAME=COLUMN with commas, a minus before a column that is "
            "positive out of the junction: battery=Ibat,-motor=Imot."
        ),
    ] = None,
    full_scale: Annotated[
        float | None,
        number_option("--full-scale", 0.001, 1e5, "Nominal maximum of the junction, with --branches [A]"),
    ] = None,
    parameters: Annotated[
        Path | None, typer.Option(help="Parameter file of this vehicle: correct with it, instead of corrected frames.")
    ] = None,
    interface: Annotated[str | None, typer.Option(help="Listen to a bus of this python-can interface.")] = None,
    channel: Annotated[str | None, typer.Option(help="Channel of the bus, such as vcan0.")] = None,
    duration: Annotated[
        float, number_option("--duration", 0.1, 86400.0, "How long to listen, or until Ctrl-C [s]")
    ] = 30.0,
    plot: Annotated[
        Path | None, _option("Draw the currents into this picture", ".png", ".pdf", ".svg", ".html")
    ] = None,
    table: Annotated[Path | None, _option("Write the currents for a spreadsheet", ".csv", ".parquet")] = None,
    json: JsonOption = False,
) -> None:
    """Print the branch currents and their sum, before and after correction, and what is expected of right sensors."""
    for wrong, what in (
        ((log is None) == (interface is None), "give either a LOG, or --interface and --channel of a live bus"),
        (
            (layout is None) == (branches is None),
            "give either --layout, which 'calibrator layout init' makes, or --branches with the columns of a table",
        ),
        (full_scale is not None and branches is None, "--full-scale goes with --branches; a layout has full_scale_a"),
        (parameters is not None and layout is None, "--parameters belong to a layout; give --layout, not --branches"),
    ):
        if wrong:
            raise typer.BadParameter(what)
    with importing():
        from calibrator.kirchhoff.findings import look_at_junction, sum_findings
        from calibrator.kirchhoff.sums import compare_kirchhoff, with_voltages
        from calibrator.kirchhoff.view import draw_kirchhoff, kirchhoff_text, save_table
        from calibrator.recordings.frames import is_log
        from calibrator.recordings.live import record_bus
        from calibrator.recordings.log_files import files_in
        from calibrator.recordings.readers import drive_from_frames, read_recording
        from calibrator.recordings.tables import is_table, layout_from_branches, read_table
        from ecu_node.parameters import check_fit, read_parameters

    logs = [] if log is None else [log, *filter(is_log, files_in(log))]
    _require_others(filter(None, (plot, table)), filter(None, (*logs, layout, dbc, parameters)))
    if layout is not None:
        database = with_voltages(vehicle_database(layout, dbc))
    elif log is not None and (is_table(log) or not log.exists()):
        database = layout_from_branches(str(branches), full_scale_a=full_scale, table=read_table(log))
    else:
        raise typer.BadParameter(
            "--branches names columns of a table; a log of frames and a bus need --layout, which 'calibrator layout "
            "init DATABASE --log LOG --out my_car.toml' makes"
        )
    found = None
    if parameters is not None:
        check_fit(found := read_parameters(parameters), database, None)
    vehicle, where = database.layout.name, f"{interface}:{channel}" if log is None else log.name
    if log is not None:
        recording = read_recording(log, database, vehicle=vehicle, name=where.partition(".")[0])
    else:
        frames = record_bus(str(interface), channel, duration)
        recording = drive_from_frames(frames, database, vehicle=vehicle, name="live", where=where)
    comparison = compare_kirchhoff(recording.drive, database, recording.corrected, found)
    if plot is not None:
        draw_kirchhoff(comparison, plot, title=f"Branch currents, positive into the junction: {where}")
    if table is not None:
        save_table(comparison, table)
    scale_a = USUAL_SCALE_A if branches is not None and full_scale is None else None
    junction = look_at_junction([recording.drive], database, full_scale_a=scale_a)
    findings = [each for each in sum_findings(junction) if each.severity != "hint" or each.code in TOLD]
    if junction.is_short or junction.stands_still:
        comparison = replace(comparison, residual=dict.fromkeys(comparison.residual))
    notices = [*map(str, recording.report.log_notices()), *comparison.notices()]
    if json:
        write_output(dumps(comparison.as_json() | {"notices": notices, "findings": findings}))
        return
    said = [
        each.text if each.subject == "sum" and each.code in TOLD else f"{each.severity}: {each.line}"
        for each in findings
    ]
    write_output(kirchhoff_text(comparison, [*notices, *said]))
    _say_next(log if "after" not in comparison.currents_a else None, layout, branches)


def _say_next(log: Path | None, layout: Path | None, branches: str | None) -> None:
    """Say how to have a correction of a log that has none."""
    if log is None:
        return
    steps: dict[str, object] = {"calibrate": log, "--layout": layout, "--trusted": "BRANCH", "--out": "result"}
    if layout is None:
        steps = {"layout init": log, "--branches": branches, "--out": "my_car.toml"}
    say_error(" ".join(["next: calibrator", *(f"{word} {shlex.quote(str(each))}" for word, each in steps.items())]))
