"""``calibrator kirchhoff``: the sum of the branch currents, from a log or a live bus."""

from pathlib import Path
from typing import Annotated

import typer

from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import DbcOption, JsonOption, LayoutOption, number_option
from ecu_node.standard_output import write_output

__all__ = ["kirchhoff"]


def kirchhoff(
    *,
    layout: LayoutOption,
    log: Annotated[Path | None, typer.Argument(metavar="LOG", help="Log: .log .asc .blf .trc .mf4, also .gz.")] = None,
    dbc: DbcOption = None,
    interface: Annotated[str | None, typer.Option(help="Listen to a bus of this python-can interface.")] = None,
    channel: Annotated[str | None, typer.Option(help="Channel of the bus, such as vcan0.")] = None,
    duration: Annotated[
        float, number_option("--duration", 0.1, 86400.0, "How long to listen, or until Ctrl-C [s]")
    ] = 30.0,
    plot: Annotated[Path | None, typer.Option(help="Draw the currents into this picture (.png, .pdf, .svg).")] = None,
    json: JsonOption = False,
) -> None:
    """Print RMSE, maximum, mean and spread of every branch current and of their sum, before and after correction."""
    if (log is None) == (interface is None):
        raise typer.BadParameter("give either a LOG, or --interface and --channel of a live bus")
    with importing():
        from calibrator.kirchhoff.sums import compare_kirchhoff
        from calibrator.kirchhoff.view import kirchhoff_json, kirchhoff_text, plot_kirchhoff
        from calibrator.recordings.frames import read_frames
        from calibrator.recordings.live import listen
        from calibrator.recordings.readers import drive_from_frames

    database = vehicle_database(layout, dbc)
    where = str(log) if log is not None else f"{interface}:{channel}"
    frames = read_frames(log) if log is not None else listen(str(interface), channel, duration)
    name = log.name.partition(".")[0] if log is not None else "live"
    recording = drive_from_frames(frames, database, vehicle=database.layout.name, name=name, where=where)
    comparison = compare_kirchhoff(recording, database.layout)
    if plot is not None:
        plot_kirchhoff(comparison, plot, title=f"Branch currents, positive into the junction: {Path(where).name}")
    notices = recording.report.log_notices() + comparison.notices()
    write_output(kirchhoff_json(comparison, notices) if json else kirchhoff_text(comparison, notices))
