"""``calibrator replay``: play a CAN log onto a bus."""

import logging
import time
from pathlib import Path
from typing import Annotated

import typer

from calibrator.errors import LogError
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import JsonOption, number_option
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import dumps
from ecu_node.program import say_error, write_output

__all__ = ["replay"]

_FASTEST = 1e6
"""Largest ``--speed``: an hour in 4 ms is faster than any bus. [1]"""


def replay(
    *,
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="Log of CAN frames, of any format that is read; also .gz.")
    ],
    channel: Annotated[str, typer.Option(help="Channel of the bus, such as vcan0.")],
    interface: Annotated[str, typer.Option(help="Interface of python-can.")] = "socketcan",
    speed: Annotated[
        float,
        number_option("--speed", 0.0, _FASTEST, "1: as recorded, 2: twice as fast, 0: as fast as the bus takes it"),
    ] = 1.0,
    fd: Annotated[bool, typer.Option("--fd", help="Open the bus for CAN FD.")] = False,
    json: JsonOption = False,
) -> None:
    """Play a CAN log onto a bus.

    The log is read whole before the first frame is sent. Error and remote frames are left out.
    """
    with importing():
        from calibrator.recordings.live import play_frames
        from calibrator.recordings.log_formats import LOG_SUFFIXES, read_frames
        from ecu_node.bus.adapters import connect

    logging.getLogger("can").addHandler(logging.NullHandler())
    if log.is_dir():
        raise LogError(f"{log}: a folder; give one log file ({' '.join(LOG_SUFFIXES)}, each also .gz)")
    frames, sent = read_frames(log), 0
    try:
        with (
            progress_bar("replay", len(frames), "frames") as progress,
            connect(interface, channel, fd=fd) as bus,
        ):
            begin_s = time.monotonic()
            for sent, _ in enumerate(play_frames(frames.messages(), bus, speed=speed), start=1):
                progress(sent)
            duration_s = time.monotonic() - begin_s
    except KeyboardInterrupt:
        say_error(f"calibrator replay: {sent} of {len(frames)} frames were sent")
        raise
    facts = {"frames": sent, "duration_s": duration_s}
    write_output(dumps(facts) if json else f"{sent} frames in {duration_s:.1f} s")
