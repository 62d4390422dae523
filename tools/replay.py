#!/usr/bin/env python3
"""Play a CAN log onto a bus, with the timing of the recording or as fast as the bus takes it.

Formats are those of the calibrator (.log of candump, .asc, .blf, .trc, .mf4), each also gzipped, and a log is read as
there: whole, before the first frame is sent, so that a damaged one sends nothing. Data frames are played; error and
remote frames are left out. A frame goes out as CAN FD where its payload is longer than 8 bytes.
"""

import argparse
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
from ecu_node.buses import connect
from ecu_node.command_parser import CommandParser
from ecu_node.errors import BusError
from ecu_node.failures import DEBUG, DEBUG_HELP, end_of, split_debug

__all__ = ["main", "read_log", "replay"]

_INTERRUPTED = 130
"""Exit code that shells give to a program ended by SIGINT."""
_EXIT_CODES = "Exit codes: 0 done, 1 failed, 2 wrong use, 70 internal error, 130 interrupted."
_SEND_LIMIT_S = 1.0
"""A bus that takes nothing for this long has nobody listening, or is off. [s]"""
_SEND_PAUSE_S = 0.0005
_PROGRESS_PERIOD_S = {True: 0.5, False: 10.0}
"""Time between lines of progress, on a terminal and elsewhere. [s]"""


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
    if path.is_dir():
        raise LogError(f"{path}: a folder; give one log file ({' '.join(LOG_SUFFIXES)}, each also .gz)")
    return _messages(read_frames(path))


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
    show = _Progress()
    try:
        messages = read_log(options.log)
        show.start()
        with connect(options.interface, options.channel, fd=options.fd) as bus:
            sent = replay(messages, bus, speed=options.speed, progress=show)
    except Exception as error:  # noqa: BLE001 (each is told, and ends the program)
        show.close()
        return end_of("replay", error, debug=debug)
    except KeyboardInterrupt:
        show.close()
        print(f"replay: interrupted after {show.sent} frames", file=sys.stderr)
        return _INTERRUPTED
    show.close()
    print(f"{sent} frames in {time.monotonic() - show.begin_s:.1f} s")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="replay.py", description="Plays a CAN log onto a bus.", epilog=_EXIT_CODES)
    parser.add_argument("log", type=Path, metavar="LOG", help=f"log file: {' '.join(LOG_SUFFIXES)}, each also .gz")
    parser.add_argument("--interface", default="socketcan", help="python-can interface (default: %(default)s)")
    parser.add_argument("--channel", required=True, help="channel of the interface, such as vcan0")
    parser.add_argument("--speed", type=_speed, default=1.0, help="1: as recorded (default), 0: as fast as it goes")
    parser.add_argument("--fd", action="store_true", help="open the bus for CAN FD")
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


class _Progress:
    """Shows on standard error how far it is: one line kept up to date on a terminal, a line now and then elsewhere."""

    def __init__(self) -> None:
        self.sent = 0
        self._terminal = sys.stderr.isatty()
        self._line_open = False
        self.start()

    def start(self) -> None:
        """Count the time from here."""
        self.begin_s = time.monotonic()
        self._due_s = self.begin_s + _PROGRESS_PERIOD_S[self._terminal]

    def __call__(self, sent: int, age_s: float) -> None:
        self.sent = sent
        now_s = time.monotonic()
        if now_s >= self._due_s:
            self._due_s = now_s + _PROGRESS_PERIOD_S[self._terminal]
            begin, end = ("\r", "") if self._terminal else ("", "\n")
            print(f"{begin}replay: {sent} frames, {age_s:.0f} s of the log", end=end, file=sys.stderr, flush=True)
            self._line_open = self._terminal

    def close(self) -> None:
        """End the line on a terminal, before anything else is said."""
        if self._line_open:
            print(file=sys.stderr)
            self._line_open = False


if __name__ == "__main__":
    sys.exit(main())
