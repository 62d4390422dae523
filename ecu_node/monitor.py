"""``ecu-node monitor``: what a listener sees of the junction and of the node. It listens, and never sends.

The node is asked nothing: measured and corrected currents, their sums, rates, faults and the node's latency are worked
out from the frames on the bus. An answer counts at the time of the frame that it answers, so that sums are of one
instant of the junction. The calibrated delays of the branches are only in the parameter file, and not known here.
Currents are positive into the junction. Times are those of one steady clock. [s]
"""

import json
import os
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

from ecu_node.bus.adapters import acknowledgement
from ecu_node.bus.node import steady_time_s
from ecu_node.bus.service import Log, stopped_by
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.wiring import Mode, branch_signals, key_of, open_bus, received, transmitted
from ecu_node.core.e2e import Check, Protection, Receiver, protection_of
from ecu_node.core.junction import REMEMBERED_FRAMES, Frames, HeardSignal, LiveBranch, aligned_currents
from ecu_node.core.signals import AMPERE, bit_place, placed_signal, read_codes
from ecu_node.core.status import Counters, Latency, Quality, Reason, State
from ecu_node.database import VehicleDatabase, node_database
from ecu_node.layout import Branch, SignalName
from ecu_node.program import say_error, write_output

View = dict[str, Any]
"""What is shown at one instant; its keys are those of ``monitor --json``, see :meth:`BusMonitor.look`."""

_RATE_WINDOW_S = 2.0
"""Frame rates are means over about this long. [s]"""
_LONGEST_LATENCY_S = 1.0
"""A frame that was not answered within this time counts as never answered. [s]"""
_FAULTS = {Check.CORRUPT: "corrupt", Check.REPEATED: "repeated", Check.LOST: "lost", Check.JUMPED: "lost"}


class _HeardMessage:
    """A message of the DBC as it is heard: its intact frames, its faults, and its rate."""

    def __init__(self, protection: Protection | None, start_s: float) -> None:
        self._check = Receiver(protection).check if protection is not None else lambda _: Check.OK
        self._count, self._counts = 0, deque([(start_s, 0)])
        self.frames: Frames = deque(maxlen=REMEMBERED_FRAMES)
        """Times [s] and payloads of the last intact frames."""
        self.faults = dict.fromkeys(_FAULTS.values(), 0)
        self.answered_by: list[_HeardMessage] = []
        self.unanswered: deque[tuple[float, _HeardMessage]] = deque(maxlen=REMEMBERED_FRAMES)
        """Frames that this message has not answered yet: when each came [s], and its message."""

    def take(self, payload: bytearray, time_s: float) -> bool:
        """Take a frame; return whether it is used: only if it is intact, new, and its counter did not jump."""
        self._count += 1
        found = self._check(payload)
        if found in _FAULTS:
            self.faults[_FAULTS[found]] += 1
        if found > Check.LOST:
            return False
        self.frames.append((time_s, payload))
        return True

    def rate_hz(self, now_s: float) -> float:
        """Return the mean rate of its frames, intact or not, since the latest call at least two seconds ago. [1/s]"""
        counts = self._counts
        while len(counts) > 1 and counts[1][0] <= now_s - _RATE_WINDOW_S:
            counts.popleft()
        counts.append((now_s, self._count))
        since_s, before = counts[0]
        return (self._count - before) / (now_s - since_s) if now_s > since_s else 0.0


_Heard = Mapping[tuple[int, bool], _HeardMessage]
"""Messages by identifier and whether it has 29 bits."""


class BusMonitor:
    """Pure core of ``ecu-node monitor``: it takes frames and times, and returns a view.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC; corrected messages and the status may be missing in the layout.
    start_s : float
        Now; rates count from here. [s]

    Raises
    ------
    LayoutError, DatabaseError
        If a signal cannot be read, or a message cannot carry its protection.
    """

    def __init__(self, database: VehicleDatabase, start_s: float) -> None:
        messages = received(database) | transmitted(database, Mode.OVERLAY)
        self._heard: _Heard = {
            key: _HeardMessage(protection_of(database, message), start_s) for key, message in messages.items()
        }
        self._branches = [_BranchOnBus(database, branch, self._heard) for branch in database.layout.branch]
        self._database, self._latency = database, Latency()

    def take(self, key: tuple[int, bool], payload: bytearray, time_s: float) -> None:
        """Take a frame.

        Parameters
        ----------
        key : tuple of int and bool
            Its identifier, and whether that has 29 bits; frames that the layout does not name are ignored.
        payload : bytearray
            Its data; it is kept, and must not be changed later.
        time_s : float
            When it came. [s]
        """
        message = self._heard.get(key)
        if message is None or not message.take(payload, time_s):
            return
        for answering in message.answered_by:
            answering.unanswered.append((time_s, message))
        waiting = message.unanswered
        while waiting and time_s - waiting[0][0] > _LONGEST_LATENCY_S:
            waiting.popleft()
        asked_s, asking = waiting.popleft() if waiting else (time_s, None)
        if asking is not None:
            self._latency.add(time_s - asked_s)
        for branch in self._branches:
            if branch.answering is message and asking in {None, branch.asking}:
                branch.answers.append((asked_s, payload))

    def look(self, now_s: float) -> View:
        """Work out what is to be shown now [s], and note the frame counts for the next rates.

        Returns
        -------
        dict
            ``branches`` : per branch its ``name``; ``is_seen`` (a vehicle may lack it); ``measured_a`` and
            ``corrected_a`` of one instant, and ``correction_a``, their difference; ``quality`` of the corrected
            current; ``rate_hz`` and ``age_s`` of the measured frames; ``corrected_rate_hz``; ``is_stale`` and
            ``corrected_is_stale`` (frames came, but none for longer than the timeout); ``faults`` and
            ``corrected_faults``: frames ``corrupt``, ``repeated``, and times that frames were ``lost``.
            ``sums`` : ``measured_a`` and ``corrected_a`` of one instant.
            ``node`` : what its last intact status says, or None: ``state`` and ``reason`` (codes that have no name stay
            numbers), ``parameter_set``, ``sums``, ``age_s``, ``is_silent`` (it must be gone), ``faults``.
            ``latency_us`` : time from a frame to its answer, as seen on the bus: ``p50``, ``p99.9``, ``max``; None if
            none was answered.
            ``has_status``, ``publishes_corrected``, ``is_bus_open`` [bool].
            What is not known is None.
        """
        publishes = any(branch.corrected.seen for branch in self._branches)
        return {
            "branches": [branch.view(now_s) for branch in self._branches],
            "sums": _sums([branch for branch in self._branches if branch.measured.seen], now_s, publishes=publishes),
            "node": _status_view(self._database, self._heard, now_s),
            "latency_us": self._latency.microseconds() if any(self._latency.counts) else None,
            "has_status": self._database.layout.status is not None,
            "publishes_corrected": publishes,
            "is_bus_open": True,
        }


class _BranchOnBus:
    """One branch: its measured current, and the corrected one, without frames if the layout has no signal for it."""

    def __init__(self, database: VehicleDatabase, branch: Branch, heard: _Heard) -> None:

        def follow(part: HeardSignal, name: SignalName, answers: Frames | None = None) -> _HeardMessage:
            message, signal = database.signal(name)
            found = heard[key_of(message)]
            part.follow(placed_signal(message, signal), found.frames if answers is None else answers)
            return found

        signals, voltage = branch_signals(database, branch, Mode.OVERLAY), None
        if branch.voltage is not None and signals.voltage is not None:
            voltage = HeardSignal(signals.voltage, branch.timeout_s)
            follow(voltage, branch.voltage)
        make = partial(LiveBranch, name=branch.name, sign=branch.sign, timeout_s=branch.timeout_s, voltage=voltage)
        self.measured, self.corrected = make(codes=signals.source), make(codes=signals.target)
        self.answers: Frames = deque(maxlen=REMEMBERED_FRAMES)
        """Intact corrected frames, with the times of the frames that they answer."""
        self.asking = follow(self.measured, branch.source)
        self.answering = follow(self.corrected, branch.corrected, self.answers) if branch.corrected else None
        if self.answering is not None and self.answering not in self.asking.answered_by:
            self.asking.answered_by.append(self.answering)
        self._quality = bit_place(database.signal(branch.quality)[1]) if branch.quality is not None else None

    @property
    def shown(self) -> LiveBranch:
        """The current that counts in the corrected sum: the measured one if the layout publishes no corrected one."""
        return self.corrected if self.answering is not None else self.measured

    def view(self, now_s: float) -> View:
        """Return what is to be shown; while answers come, the measured current is that of the last answered frame."""
        measured, corrected, answering = self.measured, self.corrected, self.answering
        measured_a = _current_at(measured, measured.time_s if corrected.is_old(now_s) else corrected.time_s)
        corrected_a = _current_at(corrected, corrected.time_s)
        quality = None
        if self._quality is not None and self.answers:
            quality = _name(Quality, self._quality.extract(self.answers[-1][1]))
        return {
            "name": measured.name,
            "is_seen": measured.seen,
            "measured_a": measured_a,
            "corrected_a": corrected_a,
            "correction_a": _difference(corrected_a, measured_a),
            "quality": quality if isinstance(quality, str) else None,
            "rate_hz": self.asking.rate_hz(now_s),
            "corrected_rate_hz": answering.rate_hz(now_s) if answering is not None else 0.0,
            "age_s": max(now_s - measured.time_s, 0.0) if measured.seen else None,
            "is_stale": measured.is_stale(now_s),
            "corrected_is_stale": corrected.is_stale(now_s),
            "faults": dict(self.asking.faults),
            "corrected_faults": dict(answering.faults) if answering is not None else {},
        }


def _current_at(branch: LiveBranch, time_s: float) -> float | None:
    """Return the current that a signal shows at a time [A]; None if it is not known for that time."""
    return (branch.currents_at(time_s) or (None,))[0]


def _difference(later_a: float | None, earlier_a: float | None) -> float | None:
    return later_a - earlier_a if later_a is not None and earlier_a is not None else None


def _name(names: type[Quality | Reason | State], code: int | None) -> str | int | None:
    """Return the name of a code; the code itself if it has no name."""
    return names(code).name if code in set(names) else code


def _sums(branches: Sequence[_BranchOnBus], now_s: float, *, publishes: bool) -> View:
    """Return ``measured_a`` and ``corrected_a``: the sums at the newest instant that all branches have reached. [A]

    They are None while a branch is stale or has no value.
    """
    measured, shown = [branch.measured for branch in branches], [branch.shown for branch in branches]
    is_published = publishes and all(branch.seen for branch in shown)
    after = aligned_currents(shown, {}, now_s) if is_published else None
    found = after or aligned_currents(measured, {}, now_s)
    known = [] if found is None else [_current_at(branch, found[0]) for branch in measured]
    return {
        "measured_a": sum(x for x in known if x is not None) if known and None not in known else None,
        "corrected_a": sum(current_a for current_a, _ in after[1].values()) if after is not None else None,
    }


_SILENT_PERIODS, _LEAST_SILENCE_S = 5.0, 1.0
"""After this many status periods, and at least this long [s], without a status message the node counts as gone."""


def _status_view(database: VehicleDatabase, heard: _Heard, now_s: float) -> View | None:
    """Return what the node's last intact status message says; None if none ever came."""
    status = database.layout.status
    message = heard[key_of(database.message(status.message))] if status is not None else None
    if status is None or message is None or not message.frames:
        return None
    time_s, payload = message.frames[-1]
    codes, sums = dict[str, int | None](), View(measured_a=None, corrected_a=None)
    for key, name in status.signals.items():
        signal = database.signal(name)[1]
        code = codes[key] = bit_place(signal).extract(payload)
        if key.startswith("sum_") and code is not None:
            known = read_codes(signal, AMPERE, f"{database.layout.path}: status")
            sums[f"{key.removeprefix('sum_')}_a"] = float(known.worth(code)) if known.is_value(code) else None
    age_s = max(now_s - time_s, 0.0)
    return {
        "state": _name(State, codes["state"]),
        "reason": _name(Reason, codes["reason"]),
        "parameter_set": codes.get("parameter_set"),
        "sums": sums,
        "age_s": age_s,
        "is_silent": age_s > max(_SILENT_PERIODS * status.period_s, _LEAST_SILENCE_S),
        "faults": dict(message.faults),
    }


_COLUMNS = {
    "branch": "",
    "measured": "[A]",
    "corrected": "[A]",
    "change": "[A]",
    "quality": "",
    "rate": "[1/s]",
    "answers": "[1/s]",
    "age": "[s]",
    "faults": "",
}
"""Columns of the table and their units; one without a unit holds words, set to the left. "rate" is that of measured
frames, "answers" that of corrected ones."""


def view_lines(view: View, where: str, counters: Counters) -> list[str]:
    """Return the lines to show: the node, a table with a row per branch and the sums, and what else one should know.

    Parameters
    ----------
    view : dict
        View of :meth:`BusMonitor.look`.
    where : str
        Name of the bus.
    counters : Counters
        Counters of error frames, and of frames that were not read in time.

    Returns
    -------
    list of str
        Lines; a number that is not known is "-".
    """
    node = view["node"]
    table = [[name if unit else "" for name, unit in _COLUMNS.items()]]
    table.append([unit or name for name, unit in _COLUMNS.items()])
    table += [*map(_branch_row, view["branches"]), _sum_cells("sum", view["sums"])]
    if node is not None and not node["is_silent"]:
        table.append(_sum_cells("node's sum", node["sums"]))
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [f"{where}: {_node_text(view)}"]
    if node is not None and not node["is_silent"] and node["reason"] not in (None, "NONE"):
        lines.append(f"because {_words(Reason, node['reason'])}")  # in a line of its own: terminals are narrow
    for cells in table:
        columns = zip(_COLUMNS.values(), cells, widths, strict=True)
        padded = [cell.rjust(width) if unit else cell.ljust(width) for unit, cell, width in columns]
        lines.append(" ".join(padded).rstrip())
    if not any(branch["is_seen"] for branch in view["branches"]):
        lines += ["no frame of any branch: is the bus awake, and its bit rate the right one?"] * view["is_bus_open"]
    elif not view["publishes_corrected"]:
        lines.append("no corrected messages on this bus: the currents are shown as they are on it")
    if node is not None and not node["is_silent"] and node["state"] in ("PASSING_THROUGH", "SHADOW"):
        lines.append("node's sum, corrected: what its parameters would make of it; it publishes what was measured")
    if view["latency_us"] is not None:
        found = ", ".join(f"{name} {latency_us}" for name, latency_us in view["latency_us"].items())
        lines.append(f"from a frame to its answer [us]: {found}")
    if counters.bus_errors:
        lines.append(f"error frames of the bus: {counters.bus_errors}; a wrong bit rate, or a fault in the wiring?")
    if counters.dropped:
        lines.append(f"frames that this computer was too slow to read: {counters.dropped}; they count as lost above")
    return lines


def _node_text(view: View) -> str:
    """Say what the node does, and why; or that the bus cannot be listened to."""
    node = view["node"]
    if not view["is_bus_open"]:
        return "this computer's interface failed or is down; trying to open it again; what is shown was heard before"
    if not view["has_status"]:
        return "the layout has no status message: nothing is known of a node"
    if node is None:
        return "no node on this bus"
    if node["is_silent"]:
        return f"no node on this bus any more: its last status came {node['age_s']:.1f} s ago"
    which = f"; parameter set {node['parameter_set']}" if node["parameter_set"] else ""
    words = f"node: {_words(State, node['state'])}{which}; status {node['age_s']:.1f} s ago"
    return "; ".join([words, *_fault_texts(node["faults"])])


def _words(names: type[Reason | State], shown: str | int | None) -> str:
    """Return the description of a named code, or say that the code is not known."""
    known = names.__members__.get(str(shown))
    return known.words if known is not None else f"{names.__name__.lower()} {shown}, which this version does not know"


def _branch_row(branch: View) -> list[str]:
    faults = _fault_texts(branch["faults"])
    if not branch["is_seen"]:
        return [branch["name"], *["-"] * (len(_COLUMNS) - 2), ", ".join(["not fitted?", *faults])]
    lasting = []
    if branch["is_stale"]:
        lasting.append("stale")
    else:
        lasting += ["not available"] * (branch["measured_a"] is None)
        lasting += ["corrected: stale"] * branch["corrected_is_stale"]
    is_answered = branch["corrected_rate_hz"] or branch["corrected_a"] is not None
    return [
        branch["name"],
        *(_number(branch[key]) for key in ("measured_a", "corrected_a", "correction_a")),
        (branch["quality"] or "-").lower().replace("_", " "),
        f"{branch['rate_hz']:.1f}",
        f"{branch['corrected_rate_hz']:.1f}" if is_answered else "-",
        f"{branch['age_s']:.2f}",
        ", ".join([*lasting, *faults, *(f"corrected: {text}" for text in _fault_texts(branch["corrected_faults"]))]),
    ]


def _sum_cells(name: str, sums: View) -> list[str]:
    measured_a, corrected_a = sums["measured_a"], sums["corrected_a"]
    cells = [name, *map(_number, (measured_a, corrected_a, _difference(corrected_a, measured_a)))]
    return cells + [""] * (len(_COLUMNS) - len(cells))


def _fault_texts(faults: Mapping[str, int]) -> list[str]:
    return [f"{name} {count}" for name, count in faults.items() if count]


def _number(value_a: float | None) -> str:
    return f"{value_a:+.2f}" if value_a is not None else "-"


_LIVE_PERIOD_S, _PLAIN_PERIOD_S = 0.25, 1.0
"""Time between two views, live in a terminal and as plain text. [s]"""
_LONGEST_WAIT_S = 0.25
"""The monitor wakes up at least this often, so that a request to stop is seen. [s]"""
_CLEAR_SCREEN, _HOME, _CLEAR_LINE, _CLEAR_BELOW = "\x1b[2J", "\x1b[H", "\x1b[K", "\x1b[J"


def run_monitor(layout: Path, bus: Mapping[str, Any], *, once_s: float | None, as_json: bool) -> int:
    """Show what is on a bus until SIGINT, SIGTERM or SIGHUP: a live table in a terminal, else a block per second.

    It also ends when nobody reads it any more.

    Parameters
    ----------
    layout : Path
        Layout of the vehicle.
    bus : mapping
        The bus, as the arguments of :func:`ecu_node.bus.adapters.bus_config`.
    once_s : float or None
        Listen for this long [s], and print once what was seen; None: until interrupted.
    as_json : bool
        Print it as JSON.

    Returns
    -------
    int
        Exit code: 0, or 1 if `once_s` was given and no branch was seen.

    Raises
    ------
    UserError
        If layout, DBC or bus cannot be used.
    """
    database = node_database(layout)
    stop = stopped_by(signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # SIGHUP: the terminal was closed
    counters, say, where = Counters(), Log().say, f"{bus['interface']} {bus['channel']}"
    if bus["listen_only"]:
        say(acknowledgement(bus["interface"], bus["channel"]))
    is_terminal = sys.stdout is not None and sys.stdout.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
    is_live = once_s is None and is_terminal
    period_s = once_s or (_LIVE_PERIOD_S if is_live else _PLAIN_PERIOD_S)
    opened = partial(open_bus, database, mode=Mode.OVERLAY, **bus)
    with ExitStack() as left_at_end:
        steady = left_at_end.enter_context(closing(SteadyBus(opened, counters, say)))
        is_read = write_output(_CLEAR_SCREEN if is_live else "", end="")
        monitor, view = BusMonitor(database, time.monotonic()), None
        while view is None or (once_s is None and is_read and not stop()):
            _listen(steady, monitor, time.monotonic() + period_s, stop)
            view = monitor.look(time.monotonic()) | {"is_bus_open": steady.state != "gone"}
            steady.count_dropped()
            lines = view_lines(view, where, counters)
            if is_live:
                width, height = shutil.get_terminal_size()
                # clear each line before writing it: after a full line the cursor stays on its last character
                shown = [f"{_CLEAR_LINE}{line[:width]}\n" for line in lines[: height - 1]]
                is_read = write_output("".join([_HOME, *shown, _CLEAR_BELOW]), end="")
            elif as_json:
                is_read = write_output(json.dumps(view, indent=2))
            else:
                is_read = write_output("\n".join(lines) if once_s else "\n".join([*lines, ""]))
    if once_s is not None and not any(branch["is_seen"] for branch in view["branches"]):
        say_error(f"ecu-node: {where}: no branch of {layout} was seen; see that the bus is the right one")
        return 1
    return 0


def _listen(bus: SteadyBus, monitor: BusMonitor, until_s: float, stop: Callable[[], bool]) -> None:
    """Take frames until a time of the steady clock [s], or until `stop` returns True."""
    while (now_s := time.monotonic()) < until_s and not stop():
        ahead_s = time.time() - now_s
        turn_end_s = min(until_s, now_s + _LONGEST_WAIT_S)
        while now_s < turn_end_s and (message := bus.receive(turn_end_s - now_s)) is not None:
            now_s = time.monotonic()
            if not message.is_remote_frame:
                time_s = steady_time_s(message.timestamp, now_s, ahead_s)
                monitor.take((message.arbitration_id, message.is_extended_id), message.data, time_s)
