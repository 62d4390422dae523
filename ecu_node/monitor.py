"""``ecu-node monitor``: what a listener sees of the junction and of the node. It listens, and never sends.

The node is asked nothing: measured and corrected currents, their sums, rates, faults and the node's latency are worked
out from the frames on the bus. An answer counts at the time of the frame that it answers, so that sums are of one
instant of the junction. The calibrated delays of the branches are only in the parameter file, and not known here.
Currents are positive into the junction. Times are those of one steady clock. [s]
"""

import json
import math
import os
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import takewhile
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
"""Frame rates are means over this long. [s]"""
_LONGEST_LATENCY_S = 1.0
"""A frame that was not answered within this time counts as never answered. [s]"""
_FAULTS = {Check.CORRUPT: "corrupt", Check.REPEATED: "repeated", Check.LOST: "lost", Check.JUMPED: "lost"}


class _HeardMessage:
    """A message of the DBC as it is heard: its last usable frames, and its faults."""

    def __init__(self, protection: Protection | None) -> None:
        self._check = Receiver(protection).check if protection is not None else lambda _: Check.OK
        self.frames: Frames = deque(maxlen=REMEMBERED_FRAMES)
        self.faults = dict.fromkeys(_FAULTS.values(), 0)

    def take(self, payload: bytearray, time_s: float) -> bool:
        """Take a frame; return whether it is used: only if it is intact, new, and its counter did not jump."""
        found = self._check(payload)
        if found in _FAULTS:
            self.faults[_FAULTS[found]] += 1
        if found > Check.LOST:
            return False
        self.frames.append((time_s, payload))
        return True


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
        self._heard: _Heard = {key: _HeardMessage(protection_of(database, item)) for key, item in messages.items()}
        self._branches = [_BranchOnBus(database, branch, self._heard) for branch in database.layout.branch]
        self._database, self._start_s, self._latency = database, start_s, Latency()

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
        if message is not None and message.take(payload, time_s):
            for branch in self._branches:
                if branch.answering is message:
                    branch.answer(payload, time_s, self._latency)

    def look(self, now_s: float) -> View:
        """Work out what is to be shown now. [s]

        Returns
        -------
        dict
            ``branches`` : per branch its ``name``; ``is_seen`` (a vehicle may lack it); ``measured_a``, while answers
            come that of the last answered frame; ``corrected_a`` and its ``quality``; ``rate_hz`` of its usable
            frames, and ``age_s`` of the last one; ``is_stale`` (frames came, but none for longer than the timeout);
            ``faults``: frames ``corrupt``, ``repeated``, and times that frames were ``lost``.
            ``sums`` : ``measured_a`` and ``corrected_a``, each at the newest instant that all branches have reached.
            ``node`` : what its last intact status says, or None: ``state`` and ``reason`` (codes that have no name stay
            numbers), ``parameter_set``, ``sums``, ``age_s``, ``is_silent`` (it must be gone), ``faults``.
            ``latency_us`` : time from a frame to its answer, as seen on the bus: ``p50``, ``p99.9``, ``max``; None if
            none was answered.
            ``has_status``, ``publishes_corrected``, ``is_bus_open`` [bool].
            What is not known is None.
        """
        seen = [branch for branch in self._branches if branch.measured.seen]
        publishes = any(branch.corrected.seen for branch in self._branches)
        window_s = min(_RATE_WINDOW_S, now_s - self._start_s)
        return {
            "branches": [branch.view(now_s, window_s) for branch in self._branches],
            "sums": {
                "measured_a": _sum_a([branch.measured for branch in seen], now_s),
                "corrected_a": _sum_a([branch.shown for branch in seen], now_s) if publishes else None,
            },
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
        self._answers: Frames = deque(maxlen=REMEMBERED_FRAMES)
        """Usable corrected frames, with the times of the frames that they answer."""
        self._asked_s = -math.inf
        """Time of the last frame that was answered. [s]"""
        self._source = follow(self.measured, branch.source)
        self.answering = follow(self.corrected, branch.corrected, self._answers) if branch.corrected else None
        self._quality = bit_place(database.signal(branch.quality)[1]) if branch.quality is not None else None

    @property
    def shown(self) -> LiveBranch:
        """The current that counts in the corrected sum: the measured one if the layout publishes no corrected one."""
        return self.corrected if self.answering is not None else self.measured

    def answer(self, payload: bytearray, time_s: float, latency: Latency) -> None:
        """Take a corrected frame that came at a time [s], as the answer to the first measured one that waits for it."""
        earliest_s = max(self._asked_s, time_s - _LONGEST_LATENCY_S)
        waiting_s = [asked_s for asked_s, _ in self._source.frames if asked_s > earliest_s]
        if waiting_s:
            latency.add(time_s - waiting_s[0])
        self._asked_s = waiting_s[0] if waiting_s else time_s
        self._answers.append((self._asked_s, payload))

    def view(self, now_s: float, window_s: float) -> View:
        """Return what is to be shown of the branch; its rate is that of the last `window_s`. [s]"""
        measured, is_answered = self.measured, not self.corrected.is_old(now_s)
        code = self._quality.extract(self._answers[-1][1]) if self._quality is not None and is_answered else None
        recent = takewhile(lambda frame: frame[0] > now_s - window_s, reversed(self._source.frames))
        return {
            "name": measured.name,
            "is_seen": measured.seen,
            "measured_a": _current_a(measured, self.corrected.time_s if is_answered else measured.time_s),
            "corrected_a": _current_a(self.corrected, self.corrected.time_s) if is_answered else None,
            "quality": Quality(code).name if code in set(Quality) else None,
            "rate_hz": sum(1 for _ in recent) / window_s if window_s > 0.0 else 0.0,
            "age_s": max(now_s - measured.time_s, 0.0) if measured.seen else None,
            "is_stale": measured.is_stale(now_s),
            "faults": dict(self._source.faults),
        }


def _current_a(branch: LiveBranch, time_s: float) -> float | None:
    """Return the current that a signal shows at a time [A]; None if it is not known for that time."""
    return (branch.currents_at(time_s) or (None,))[0]


def _sum_a(branches: Sequence[LiveBranch], now_s: float) -> float | None:
    """Return the sum of currents at the newest instant that all have reached [A]; None if one is stale or unknown."""
    found = aligned_currents(branches, {}, now_s) if all(branch.seen for branch in branches) else None
    return sum(current_a for current_a, _ in found[1].values()) if found is not None else None


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
    age_s, state, reason = max(now_s - time_s, 0.0), codes["state"], codes["reason"]
    return {
        "state": State(state).name if state in set(State) else state,
        "reason": Reason(reason).name if reason in set(Reason) else reason,
        "parameter_set": codes.get("parameter_set"),
        "sums": sums,
        "age_s": age_s,
        "is_silent": age_s > max(_SILENT_PERIODS * status.period_s, _LEAST_SILENCE_S),
        "faults": dict(message.faults),
    }


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
    node = view["node"] if view["node"] is not None and not view["node"]["is_silent"] else None
    lines = [f"{where}: {_node_text(view)}"]
    if node is not None and node["reason"] not in (None, "NONE"):
        lines.append(f"because {_words(Reason, node['reason'])}")  # in a line of its own: terminals are narrow
    width = max(map(len, ["node's sum", *(branch["name"] for branch in view["branches"])]))
    lines.append(_row(width, "branch", "measured", "corrected", "quality", "rate", "age", "faults"))
    lines.append(_row(width, "", "[A]", "[A]", "", "[1/s]", "[s]"))
    for branch in view["branches"]:
        name, currents = branch["name"], [_number(branch["measured_a"]), _number(branch["corrected_a"])]
        quality = (branch["quality"] or "-").lower().replace("_", " ")
        notes = ["stale"] * branch["is_stale"] + ["not fitted?"] * (not branch["is_seen"])
        notes += [text] if (text := _fault_text(branch["faults"])) else []
        times = [f"{branch['rate_hz']:.1f}", f"{branch['age_s']:.2f}"] if branch["is_seen"] else ["-", "-"]
        lines.append(_row(width, name, *currents, quality, *times, ", ".join(notes)))
    for name, sums in (("sum", view["sums"]), ("node's sum", node and node["sums"])):
        if sums is not None:
            lines.append(_row(width, name, _number(sums["measured_a"]), _number(sums["corrected_a"])))
    if not any(branch["is_seen"] for branch in view["branches"]):
        lines += ["no frame of any branch: is the bus awake, and its bit rate the right one?"] * view["is_bus_open"]
    elif not view["publishes_corrected"]:
        lines.append("no corrected messages on this bus: the currents are shown as they are on it")
    if node is not None and node["state"] in ("PASSING_THROUGH", "SHADOW"):
        lines.append("node's sum, corrected: what its parameters would make of it; it publishes what was measured")
    if view["latency_us"] is not None:
        found = ", ".join(f"{name} {latency_us}" for name, latency_us in view["latency_us"].items())
        lines.append(f"from a frame to its answer [us]: {found}")
    if counters.bus_errors:
        lines.append(f"error frames of the bus: {counters.bus_errors}; a wrong bit rate, or a fault in the wiring?")
    if counters.dropped:
        lines.append(f"frames that this computer was too slow to read: {counters.dropped}; they count as lost above")
    return lines


def _row(width: int, name: str, measured: str, corrected: str, *others: str) -> str:
    """Return a row of the table; `others` are quality, rate, age and faults, as far as the row has them."""
    quality, rate, age, faults = [*others, "", "", "", ""][:4]
    row = f"{name:<{width}} {measured:>9} {corrected:>9} {quality:<14} {rate:>6} {age:>6} {faults}"
    return row.rstrip()


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
    faults = f"; {text}" if (text := _fault_text(node["faults"])) else ""
    return f"node: {_words(State, node['state'])}{which}; status {node['age_s']:.1f} s ago{faults}"


def _words(names: type[Reason | State], shown: str | int | None) -> str:
    """Return the description of a named code, or say that the code is not known."""
    known = names.__members__.get(str(shown))
    return known.words if known is not None else f"{names.__name__.lower()} {shown}, which this version does not know"


def _fault_text(faults: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in faults.items() if count)


def _number(value_a: float | None) -> str:
    return f"{value_a:+.2f}" if value_a is not None else "-"


_LIVE_PERIOD_S, _PLAIN_PERIOD_S = 0.25, 1.0
"""Time between two views, live in a terminal and as plain text. [s]"""
_LONGEST_WAIT_S = 0.25
"""The monitor wakes up at least this often, so that a request to stop is seen. [s]"""
_HOME, _CLEAR_LINE, _CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"


def run_monitor(layout: Path, bus: Mapping[str, Any], *, once_s: float | None, as_json: bool) -> int:
    """Show what is on a bus until SIGINT, SIGTERM or SIGHUP: a live table in a terminal, else a block per second.

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
    with closing(SteadyBus(partial(open_bus, database, mode=Mode.OVERLAY, **bus), counters, say)) as steady:
        monitor, view = BusMonitor(database, time.monotonic()), None
        while view is None or (once_s is None and not stop()):
            _listen(steady, monitor, time.monotonic() + period_s, stop)
            view = monitor.look(time.monotonic()) | {"is_bus_open": steady.state != "gone"}
            steady.count_dropped()
            lines = view_lines(view, where, counters)
            if is_live:
                width, height = shutil.get_terminal_size()
                # clear each line before writing it: after a full line the cursor stays on its last character
                shown = [f"{_CLEAR_LINE}{line[:width]}\n" for line in lines[: height - 1]]
                write_output("".join([_HOME, *shown, _CLEAR_BELOW]), end="")
            elif as_json:
                write_output(json.dumps(view, indent=2))
            else:
                write_output("\n".join(lines), end="\n" if once_s else "\n\n")
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
