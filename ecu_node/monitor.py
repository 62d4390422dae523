"""``ecu-node monitor``: bus, clock and terminal around :mod:`ecu_node.monitor_model`; it listens, and never sends."""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import can

from ecu_node.buses import open_bus
from ecu_node.clocks import steady_time_s
from ecu_node.counters import Counters
from ecu_node.database import node_database
from ecu_node.errors import UserError
from ecu_node.failures import say_error
from ecu_node.guard import Mode
from ecu_node.monitor_model import BusMonitor
from ecu_node.monitor_table import picture
from ecu_node.monitor_text import as_json, plain_block
from ecu_node.monitor_view import View
from ecu_node.service import Log, Requests
from ecu_node.standard_output import write_output, write_text
from ecu_node.steady_bus import SteadyBus

__all__ = ["MonitorOptions", "listen", "run_monitor"]

_WITHOUT_CURSOR = ("dumb", "unknown")
"""Terminals on which nothing can be drawn anew."""
_LIVE_PERIOD_S, _PLAIN_PERIOD_S = 0.25, 1.0
"""Between two pictures. [s]"""
_LONGEST_WAIT_S = 0.25
"""A wake-up at least this often, so that a request to stop is seen. [s]"""

_Show = Callable[[View, list[str]], None]
"""Takes what is to be shown, and further lines."""


@dataclass(frozen=True, kw_only=True)
class MonitorOptions:
    """What was asked for on the command line.

    Attributes
    ----------
    layout : Path
        Layout of the vehicle.
    interface, channel : str
        Bus, as python-can names it.
    fd : bool
        Whether to open it for CAN FD.
    once_s : float or None
        Listen this long, and tell once what was seen [s]; None: until interrupted.
    as_json : bool
        Tell it as JSON.
    """

    layout: Path
    interface: str
    channel: str
    fd: bool
    once_s: float | None
    as_json: bool


def run_monitor(options: MonitorOptions) -> int:
    """Show what is on a bus until SIGINT, SIGTERM or SIGHUP.

    Parameters
    ----------
    options : MonitorOptions
        What was asked for.

    Returns
    -------
    int
        Exit code: 0, or 1 if it was to listen once and no branch was seen.

    Raises
    ------
    UserError
        If layout, DBC or bus cannot be used, or rich is missing for a live table.
    """
    database = node_database(options.layout)
    where = f"{options.interface} {options.channel}"
    requests = Requests()
    was_hung_up = False

    def stop() -> bool:
        nonlocal was_hung_up
        was_hung_up |= requests.take_reload()  # SIGHUP: the terminal was closed
        return was_hung_up or requests.stop()

    counters = Counters()

    def opened() -> can.BusABC:
        interface, channel = options.interface, options.channel
        return open_bus(database, interface=interface, channel=channel, fd=options.fd, mode=Mode.OVERLAY)

    with _display(options, where) as (show, period_s):
        bus = SteadyBus(opened, counters, Log().say)
        try:
            monitor = BusMonitor(database, time.monotonic())
            view = None
            while view is None or (options.once_s is None and not stop()):
                listen(bus, monitor, time.monotonic() + period_s, stop)
                view = replace(monitor.look(time.monotonic()), is_bus_open=bus.is_open)
                bus.count_dropped()
                show(view, _bus_notes(counters))
        finally:
            bus.close()
    if options.once_s is not None and not view.is_any_branch_seen:
        say_error(f"ecu-node: {where}: no branch of {options.layout} was seen; see that the bus is the right one")
        return 1
    return 0


def listen(bus: SteadyBus, monitor: BusMonitor, until_s: float, stop: Callable[[], bool]) -> None:
    """Take what comes until a time of the steady clock.

    Parameters
    ----------
    bus : SteadyBus
        Bus to listen to.
    monitor : BusMonitor
        Takes the frames.
    until_s : float
        When to return. [s]
    stop : callable
        Whether to return earlier; asked at least every 0.25 s.
    """
    clock, receive, take = time.monotonic, bus.receive, monitor.take
    while (now_s := clock()) < until_s and not stop():
        ahead_s = time.time() - now_s
        turn_end_s = min(until_s, now_s + _LONGEST_WAIT_S)
        while now_s < turn_end_s and (message := receive(turn_end_s - now_s)) is not None:
            now_s = clock()
            if not message.is_remote_frame:
                time_s = steady_time_s(message.timestamp, now_s, ahead_s)
                take((message.arbitration_id, message.is_extended_id), message.data, time_s)


def _bus_notes(counters: Counters) -> list[str]:
    lines = []
    if counters.bus_errors:
        lines.append(f"error frames of the bus: {counters.bus_errors}; a wrong bit rate, or a fault in the wiring?")
    if counters.dropped:
        lines.append(f"frames that this computer was too slow to read: {counters.dropped}; they count as lost above")
    return lines


@contextmanager
def _display(options: MonitorOptions, where: str) -> Iterator[tuple[_Show, float]]:
    """How views are shown, and after how long the first and each further one. [s]"""
    if options.once_s is None and sys.stdout.isatty() and os.environ.get("TERM") not in _WITHOUT_CURSOR:
        with _live_table(where) as show:
            yield show, _LIVE_PERIOD_S
        return

    def show_plainly(view: View, more: list[str]) -> None:
        if options.as_json:
            write_output(json.dumps(as_json(view), indent=2))
        else:
            write_text(f"{plain_block(view, where, more)}{'' if options.once_s is not None else chr(10)}")

    yield show_plainly, options.once_s or _PLAIN_PERIOD_S


@contextmanager
def _live_table(where: str) -> Iterator[_Show]:
    try:
        from rich.console import Group  # noqa: PLC0415  # optional
        from rich.live import Live  # noqa: PLC0415
        from rich.text import Text  # noqa: PLC0415
    except ImportError:
        raise UserError(
            "a live table needs rich; install it with pip install 'hv-current-correction[monitor]', "
            "or give --once SECONDS"
        ) from None

    last = ""
    with Live(auto_refresh=False, screen=True) as live:

        def show(view: View, more: list[str]) -> None:
            nonlocal last
            last = plain_block(view, where, more)
            lines = picture(view, where, more, width=live.console.width, height=live.console.height)
            drawn = [Text(line.text, style=line.style, no_wrap=True, overflow="crop") for line in lines]
            live.update(Group(*drawn), refresh=True)

        yield show
    write_output(last)  # what was seen last stays on the screen
