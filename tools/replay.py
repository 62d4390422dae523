#!/usr/bin/env python3
"""Play a CAN log onto a bus, with the timing of the recording or as fast as the bus takes it.

Formats are those of the calibrator (.log of candump, .asc, .blf, .trc, .mf4), each also gzipped, and a log is read as
there: whole, before the first frame is sent, so that a damaged one sends nothing. Data frames are played; error and
remote frames are left out. A frame goes out as CAN FD where its payload is longer than 8 bytes.
"""

import argparse
import json
import logging
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import can

from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import CLASSIC_BYTES, EXTENDED_BIT, Frames
from calibrator.recordings.frames import LOG_SUFFIXES, read_frames
from calibrator.terminal.progress import progress_bar
from ecu_node.buses import connect
from ecu_node.command_parser import CommandParser
from ecu_node.errors import BusError
from ecu_node.failures import DEBUG, DEBUG_HELP, end_of, split_debug
from ecu_node.standard_output import write_output

__all__ = ["main", "read_log", "replay"]

_INTERRUPTED = 130
"""Exit code that shells give to a program ended by SIGINT."""
_EXIT_CODES = "Exit codes: 0 done, 1 failed, 2 wrong use, 70 internal error, 130 interrupted."
_SEND_LIMIT_S = 1.0
"""A bus that takes nothing for this long has nobody listening, or is off. [s]"""
_SEND_PAUSE_S = 0.0005


def read_log(path: Path) -> Iterator[can.Message]:
    """Read a log.

    Parameters
    ----------
    path : Path
        The log; its suffix says the format.

    Returns
    -------
    iterator of can.Message
        Its data frames in the order of the file; the whole log is read before the first one.

    Raises
    ------
    LogError
        If the file is missing, a folder, of an unknown format, damaged or empty.
    """
    return _messages(_frames(path))


def _frames(path: Path) -> Frames:
    if path.is_dir():
        raise LogError(f"{path}: a folder; give one log file ({' '.join(LOG_SUFFIXES)}, each also .gz)")
    return read_frames(path)


def _messages(frames: Frames) -> Iterator[can.Message]:
    for time_ns, key, length, data in zip(frames.time_ns, frames.key, frames.length, frames.data, strict=True):
        yield can.Message(
            timestamp=int(time_ns) * 1e-9,
            arbitration_id=int(key) & ~EXTENDED_BIT,
            is_extended_id=bool(int(key) & EXTENDED_BIT),
            is_fd=int(length) > CLASSIC_BYTES,
            data=data[: int(length)].tobytes(),
            is_rx=False,
        )


def replay(
    messages: Iterable[can.Message],
    bus: can.BusABC,
    *,
    speed: float = 1.0,
    progress: Callable[[int, float], None] | None = None,
) -> int:
    """Send messages in their order, at their instants.

    Parameters
    ----------
    messages : iterable of can.Message
        Frames with timestamps [s]; error frames are left out, a bus makes its own.
    bus : can.BusABC
        Where to.
    speed : float
        1 keeps the timing, 2 halves the time, 0 goes as fast as the bus takes frames. [1]
    progress : callable, optional
        Called after each frame with the number of frames sent and the time since the first one in the log [s].

    Returns
    -------
    int
        Number of frames sent.

    Raises
    ------
    BusError
        If the bus takes no frame for a second.
    """
    sent = 0
    begin_s = time.monotonic()
    first_s: float | None = None
    for message in messages:
        if message.is_error_frame:
            continue
        first_s = message.timestamp if first_s is None else first_s
        age_s = message.timestamp - first_s
        if speed > 0.0 and (wait_s := begin_s + age_s / speed - time.monotonic()) > 0.0:
            time.sleep(wait_s)
        _send(bus, message)
        sent += 1
        if progress is not None:
            progress(sent, age_s)
    return sent


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code: 0 done, 1 failed, 130 interrupted. Wrong use ends in SystemExit(2)."""
    arguments, debug = split_debug(sys.argv[1:] if argv is None else argv)
    options = _parser().parse_args(arguments)
    logging.getLogger("can").addHandler(logging.NullHandler())
    sent = 0

    def count(so_far: int, _: float) -> None:
        nonlocal sent
        sent = so_far
        progress(so_far)

    try:
        frames = _frames(options.log)
        with (
            progress_bar("replay", len(frames.time_ns), "frames") as progress,
            connect(options.interface, options.channel, fd=options.fd) as bus,
        ):
            begin_s = time.monotonic()
            replay(_messages(frames), bus, speed=options.speed, progress=count)
            duration_s = time.monotonic() - begin_s
        facts = {"frames": sent, "duration_s": duration_s}
        write_output(json.dumps(facts, indent=2) if options.json else f"{sent} frames in {duration_s:.1f} s")
    except Exception as error:  # noqa: BLE001 (each is told, and ends the program)
        return end_of("replay", error, debug=debug)
    except KeyboardInterrupt:
        print(f"replay: interrupted after {sent} frames", file=sys.stderr)
        return _INTERRUPTED
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="replay.py", description="Plays a CAN log onto a bus.", epilog=_EXIT_CODES)
    parser.add_argument("log", type=Path, metavar="LOG", help=f"log file: {' '.join(LOG_SUFFIXES)}, each also .gz")
    parser.add_argument("--interface", default="socketcan", help="python-can interface (default: %(default)s)")
    parser.add_argument("--channel", required=True, help="channel of the interface, such as vcan0")
    parser.add_argument("--speed", type=_speed, default=1.0, help="1: as recorded (default), 0: as fast as it goes")
    parser.add_argument("--fd", action="store_true", help="open the bus for CAN FD")
    parser.add_argument("--json", action="store_true", help="print the account as JSON")
    parser.add_argument(DEBUG, action="store_true", help=DEBUG_HELP)
    return parser


def _speed(text: str) -> float:
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not (math.isfinite(speed) and speed >= 0.0):
        raise argparse.ArgumentTypeError(f"{text}: a number of at least 0 is expected")
    return speed


def _send(bus: can.BusABC, message: can.Message) -> None:
    give_up_s = time.monotonic() + _SEND_LIMIT_S
    while True:
        try:
            bus.send(message)
        except can.CanError as error:
            if time.monotonic() > give_up_s:
                raise BusError(f"{bus.channel_info}: the bus takes no frame: {error}") from None
            time.sleep(_SEND_PAUSE_S)
        else:
            return


if __name__ == "__main__":
    sys.exit(main())
