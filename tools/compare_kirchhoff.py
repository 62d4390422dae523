#!/usr/bin/env python3
"""Kirchhoff's law before and after correction, from a log or a live bus with measured and corrected frames."""

import json
import sys
import time
from pathlib import Path
from typing import Annotated, NoReturn

import can
import msgspec
import typer
from rich.console import Console

from calibrator.command_options import number_option
from calibrator.recordings.frames import FrameCollector, Frames, read_frames
from calibrator.recordings.readers import drive_from_frames
from calibrator.report.kirchhoff import compare_kirchhoff
from calibrator.report.kirchhoff_view import kirchhoff_table, plot_kirchhoff
from ecu_node.database import read_database
from ecu_node.errors import DatabaseError, UserError
from ecu_node.layout import read_layout

_POLL_S = 0.1
"""How often the end of a live recording is checked. [s]"""

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command(epilog="Exit codes: 0 done, 1 failed, 2 wrong use, 130 interrupted.")
def main(
    *,
    layout: Annotated[Path, typer.Option(help="Layout of the vehicle (TOML).")],
    log: Annotated[Path | None, typer.Argument(help="Log: .log .asc .blf .trc .mf4, also .gz.")] = None,
    dbc: Annotated[Path | None, typer.Option(help="DBC to use instead of the one the layout names.")] = None,
    interface: Annotated[str | None, typer.Option(help="Listen to a bus of this python-can interface.")] = None,
    channel: Annotated[str | None, typer.Option(help="Channel of the bus, such as vcan0.")] = None,
    duration: Annotated[float, number_option("--duration", 0.1, 86400.0, "How long to listen [s]")] = 30.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print figures as JSON.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Draw the currents into this picture (.png, .pdf, .svg).")] = None,
) -> None:
    """Print RMSE, maximum, mean and spread of every branch current and of their sum, before and after correction."""
    if (log is None) == (interface is None):
        raise typer.BadParameter("give either a LOG, or --interface and --channel of a live bus")
    try:
        settings = read_layout(layout)
        if dbc is not None:
            if not dbc.is_file():
                raise DatabaseError(f"{dbc}: no such DBC; check --dbc")
            settings = msgspec.structs.replace(settings, dbc=str(dbc.absolute()))
        database = read_database(settings)
        where = str(log) if log is not None else f"{interface}:{channel}"
        frames = read_frames(log) if log is not None else _listen(str(interface), channel, duration)
        name = log.name.partition(".")[0] if log is not None else "live"
        recording = drive_from_frames(frames, database, vehicle=settings.name, name=name, where=where)
        comparison = compare_kirchhoff(recording, settings)
        if plot is not None:
            plot_kirchhoff(comparison, plot, title=f"Branch currents, positive into the junction: {Path(where).name}")
    except UserError as error:
        _fail(str(error))
    notices = recording.report.log_notices() + comparison.notices()
    if as_json:
        typer.echo(json.dumps(comparison.as_json() | {"notices": notices}, indent=2))
        return
    Console().print(kirchhoff_table(comparison))
    for notice in notices:
        typer.echo(notice)
    after = comparison.after
    if after is not None:
        before_a, after_a = comparison.before["sum"].rmse_a, after["sum"].rmse_a
        ratio = f", {before_a / after_a:.1f} times less" if 0.0 < after_a < before_a else ""
        typer.echo(f"RMSE of the sum: {before_a:.2f} A before, {after_a:.2f} A after{ratio}")


def _listen(interface: str, channel: str | None, duration_s: float) -> Frames:
    """Take everything that comes over a bus for some time."""
    collector = FrameCollector()
    try:
        with can.Bus(interface=interface, channel=channel) as bus:
            end_s = time.monotonic() + duration_s
            while (left_s := end_s - time.monotonic()) > 0.0:
                message = bus.recv(timeout=min(left_s, _POLL_S))
                if message is not None:
                    collector.add(message)
    except (can.CanError, OSError, ValueError, TypeError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        _fail(f"{interface}:{channel}: cannot listen to the bus: {reason}; check --interface and --channel")
    if not len(collector):
        _fail(f"{interface}:{channel}: no frame in {duration_s:g} s; check that something is sent, or listen longer")
    return collector.frames()


def _fail(text: str) -> NoReturn:
    print(f"compare_kirchhoff: {text}", file=sys.stderr)
    raise typer.Exit(1)


if __name__ == "__main__":
    app()
