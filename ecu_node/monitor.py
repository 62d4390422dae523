"""``ecu-node monitor``: what a listener sees of the junction and of the node. It listens, and never sends.

Nothing of the node is asked: measured and corrected currents, their sums, rates and faults are worked out from what is
on the bus. Sums are taken as the node takes them, of all branches in one instant of the junction, and both in the same
one: an answer counts at the time of the frame that it answers. The calibrated delays of the branches are in the
parameter file alone, and not known here. Currents are positive into the junction. Times are those of one steady
clock. [s]
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
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ecu_node.bus.adapters import acknowledgement, open_bus
from ecu_node.bus.guard import Mode, key_of, received, transmitted
from ecu_node.bus.in_force import branch_signals
from ecu_node.bus.node import steady_time_s
from ecu_node.bus.service import Log, Requests
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.core.branch import REMEMBERED_FRAMES, Auxiliary, Frames, LiveBranch
from ecu_node.core.e2e import Check, Protection, Receiver, protection_of
from ecu_node.core.junction import simultaneous_currents
from ecu_node.core.signals import AMPERE, Codes, PlacedSignal, bit_place, placed_signal, read_codes
from ecu_node.core.status import Counters, Quality, Reason, State
from ecu_node.database import VehicleDatabase, node_database
from ecu_node.layout import Branch, StatusMessage
from ecu_node.program import say_error, wrapped, write_output, write_text

__all__ = ["BranchView", "BusMonitor", "NodeView", "Sums", "View", "listen_until", "run_monitor", "view_lines"]


@dataclass(frozen=True, kw_only=True)
class BranchView:
    """One branch.

    Attributes
    ----------
    name : str
        As in the layout.
    is_seen : bool
        Whether an intact frame of it ever came; a vehicle may lack a branch of its layout.
    measured_a, corrected_a : float or None
        In the last intact frames [A]; None where there is none, or it is no value. A measured frame that came since
        the last corrected one is not shown before it is answered, or the other one is stale.
    correction_a : float or None
        Corrected less measured current, both as shown. [A]
    quality : str or None
        Name in :class:`~ecu_node.core.status.Quality`, of the corrected current; None where it is not known.
    rate_hz, corrected_rate_hz : float
        Frames of the measured and of the corrected message. [1/s]
    age_s : float or None
        Of the last intact measured frame. [s]
    is_stale, corrected_is_stale : bool
        Whether intact frames came, but none for longer than the branch's timeout.
    faults, corrected_faults : mapping of str to int
        Frames of the measured and of the corrected message that failed their end-to-end check since the start:
        ``corrupt`` (wrong CRC, impossible counter, or too short for their header), ``repeated`` (counter of the one
        before), ``lost`` (times that the counter showed lost frames, few or many).
    """

    name: str
    is_seen: bool
    measured_a: float | None
    corrected_a: float | None
    correction_a: float | None
    quality: str | None
    rate_hz: float
    corrected_rate_hz: float
    age_s: float | None
    is_stale: bool
    corrected_is_stale: bool
    faults: Mapping[str, int]
    corrected_faults: Mapping[str, int]


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Kirchhoff sum of all branches, measured and corrected, in one instant [A]; None where it is not known."""

    measured_a: float | None = None
    corrected_a: float | None = None


@dataclass(frozen=True, kw_only=True)
class NodeView:
    """What the node says of itself in its last intact status message.

    Attributes
    ----------
    state, reason : str, int or None
        Name in :class:`~ecu_node.core.status.State` or :class:`~ecu_node.core.status.Reason`; the code where it is
        none of them, None if the message was too short.
    parameter_set : int or None
        None if the layout leaves it out.
    sums : Sums
        As the node publishes them.
    age_s : float
        Of the message. [s]
    is_silent : bool
        Whether the message is so old that the node must be gone.
    faults : mapping of str to int
        Of the status message, as in :class:`BranchView`.
    """

    state: str | int | None
    reason: str | int | None
    parameter_set: int | None
    sums: Sums
    age_s: float
    is_silent: bool
    faults: Mapping[str, int]


@dataclass(frozen=True, kw_only=True)
class View:
    """Everything that is shown of one instant.

    Attributes
    ----------
    branches : tuple of BranchView
        All of the layout, in its order.
    sums : Sums
        Worked out from the branches' frames.
    node : NodeView or None
        None if no status message ever came.
    has_status : bool
        Whether the layout has a status message at all.
    publishes_corrected : bool
        Whether a corrected message ever came; there is none on the buses of a gateway.
    is_bus_open : bool
        Whether the bus can be listened to; if not, all this was heard before.
    """

    branches: tuple[BranchView, ...]
    sums: Sums
    node: NodeView | None
    has_status: bool
    publishes_corrected: bool
    is_bus_open: bool = True

    @property
    def is_any_branch_seen(self) -> bool:
        """Whether anything of the junction was seen."""
        return any(branch.is_seen for branch in self.branches)


_RATE_WINDOW_S = 2.0
"""Frame rates are means over about this long. [s]"""
_FAULTS = {Check.CORRUPT: "corrupt", Check.REPEATED: "repeated", Check.LOST: "lost", Check.JUMPED: "lost"}


class _HeardMessage:
    """A message of the DBC: its frames, whether they are intact, and how many come.

    Attributes
    ----------
    frames : deque
        Times [s] and payloads of the last intact frames.
    faults : dict of str to int
        Frames that were not intact, as in :class:`BranchView`.
    answers_to : list of _HeardMessage
        Of a corrected message: what it answers.
    """

    def __init__(self, protection: Protection | None, start_s: float) -> None:
        self._check = Receiver(protection).check if protection is not None else lambda _: Check.OK
        self._count = 0
        self._counts = deque([(start_s, 0)])
        self.frames: Frames = deque(maxlen=REMEMBERED_FRAMES)
        self.faults = dict.fromkeys(_FAULTS.values(), 0)
        self.answers_to: list[_HeardMessage] = []

    def take(self, payload: bytearray, time_s: float) -> None:
        """Take a frame; like the node, use it only if it is intact, new, and not after a jump of its counter."""
        self._count += 1
        found = self._check(payload)
        if found in _FAULTS:
            self.faults[_FAULTS[found]] += 1
        if found in (Check.OK, Check.LOST):
            self.frames.append((time_s, payload))

    def rate_hz(self, now_s: float) -> float:
        """Rate of its frames, intact or not, since it was asked for the last time two seconds ago or more. [1/s]"""
        counts = self._counts
        while len(counts) > 1 and counts[1][0] <= now_s - _RATE_WINDOW_S:
            counts.popleft()
        counts.append((now_s, self._count))
        since_s, before = counts[0]
        return (self._count - before) / (now_s - since_s) if now_s > since_s else 0.0


_Heard = Mapping[tuple[int, bool], _HeardMessage]
"""Messages by identifier, and whether that has 29 bits."""


class BusMonitor:
    """Listens; the pure core of ``ecu-node monitor``: frames and times in, a view out.

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
        status = database.layout.status
        self._status = _Status(database, status, self._heard) if status is not None else None

    def take(self, key: tuple[int, bool], payload: bytearray, time_s: float) -> None:
        """Take a frame.

        Parameters
        ----------
        key : tuple of int and bool
            Its identifier, and whether that has 29 bits; others than those of the layout are left alone.
        payload : bytearray
            Its data; not changed, now or later.
        time_s : float
            When it came. [s]
        """
        if key in self._heard:
            self._heard[key].take(payload, time_s)

    def look(self, now_s: float) -> View:
        """Work out what is to be shown now [s], and begin a new step of the frame rates."""
        publishes = any(branch.corrected.seen for branch in self._branches)
        return View(
            branches=tuple(branch.view(now_s) for branch in self._branches),
            sums=_sums([branch for branch in self._branches if branch.measured.seen], now_s, publishes=publishes),
            node=self._status.view(now_s) if self._status is not None else None,
            has_status=self._status is not None,
            publishes_corrected=publishes,
        )


class _BranchOnBus:
    """One branch: the measured current, and the corrected one, of which nothing comes if the layout has none."""

    def __init__(self, database: VehicleDatabase, branch: Branch, heard: _Heard) -> None:
        def followed(name: str) -> tuple[PlacedSignal, _HeardMessage]:
            message, signal = database.signal(name)
            return placed_signal(message, signal), heard[key_of(message)]

        signals = branch_signals(database, branch, Mode.OVERLAY)
        self._branch, self._voltage = branch, None
        if branch.voltage is not None and signals.voltage is not None:
            voltage, message = followed(branch.voltage)
            self._voltage = Auxiliary(signals.voltage, branch.timeout_s)
            self._voltage.follow(voltage, message.frames)
        self._source, self._asked = followed(branch.source)
        self._target, self._answers = self._source, _HeardMessage(None, 0.0)
        if branch.corrected is not None:
            self._target, self._answers = followed(branch.corrected)
            self._answers.answers_to.append(self._asked)
        self._target_codes = signals.target
        self.measured = self._live(signals.source, self._source, self._asked.frames)
        self.corrected = self._live(signals.target, self._target, self._answers.frames)
        self._quality = bit_place(database.signal(branch.quality)[1]) if branch.quality is not None else None

    def _live(self, codes: Codes, signal: PlacedSignal, frames: Frames) -> LiveBranch:
        branch = self._branch
        live = LiveBranch(
            name=branch.name, codes=codes, sign=branch.sign, timeout_s=branch.timeout_s, voltage=self._voltage
        )
        live.follow(signal, frames)
        return live

    def answered(self) -> LiveBranch:
        """What counts in the corrected sum: the measured current where the layout publishes no corrected one.

        Each answer stands at the time of the newest frame before it that no later answer has: a node that was held up
        answers several frames at once. Answers to frames without the current repeat what was said before, and are left
        out.
        """
        if self._branch.corrected is None:
            return self.measured
        asked = [
            (time_s, heard is self._asked and self._source.code(payload) is not None)
            for heard in dict.fromkeys(self._answers.answers_to)
            for time_s, payload in heard.frames
        ]
        newest_first = iter(sorted(asked, reverse=True))
        answers: Frames = deque()
        for answer_s, answer in reversed(self._answers.frames):
            asked_s, has_current = next((frame for frame in newest_first if frame[0] <= answer_s), (0.0, False))
            if has_current:
                answers.appendleft((asked_s, answer))
        return self._live(self._target_codes, self._target, answers)

    def view(self, now_s: float) -> BranchView:
        """What is to be shown: the measured current that the corrected one was made of, while answers come."""
        measured, corrected, answered_s = self.measured, self.corrected, self.answered().time_s
        is_answered = now_s - answered_s <= self._branch.timeout_s
        measured_a = _current_at(measured, answered_s if is_answered else measured.time_s)
        corrected_a = _current_at(corrected, corrected.time_s)
        quality = None
        if self._quality is not None and self._answers.frames:
            quality = _name(Quality, self._quality.extract(self._answers.frames[-1][1]))
        return BranchView(
            name=self._branch.name,
            is_seen=measured.seen,
            measured_a=measured_a,
            corrected_a=corrected_a,
            correction_a=_difference(corrected_a, measured_a),
            quality=quality if isinstance(quality, str) else None,
            rate_hz=self._asked.rate_hz(now_s),
            corrected_rate_hz=self._answers.rate_hz(now_s),
            age_s=max(now_s - measured.time_s, 0.0) if measured.seen else None,
            is_stale=measured.is_stale(now_s),
            corrected_is_stale=corrected.is_stale(now_s),
            faults=dict(self._asked.faults),
            corrected_faults=dict(self._answers.faults),
        )


def _current_at(branch: LiveBranch, time_s: float) -> float | None:
    """Current at a time [A]; None if no value is known of then."""
    currents = branch.currents_at(time_s)
    return currents[0] if currents is not None else None


def _difference(later_a: float | None, earlier_a: float | None) -> float | None:
    return later_a - earlier_a if later_a is not None and earlier_a is not None else None


def _name(names: type[Quality | Reason | State], code: int | None) -> str | int | None:
    return names(code).name if code in set(names) else code


def _sums(branches: Sequence[_BranchOnBus], now_s: float, *, publishes: bool) -> Sums:
    """Sums in the newest instant that all have reached; None while a branch is stale or has no value. [A]"""
    measured = [branch.measured for branch in branches]
    after = simultaneous_currents([branch.answered() for branch in branches], {}, now_s) if publishes else None
    found = after or simultaneous_currents(measured, {}, now_s)
    if found is None:
        return Sums()
    currents = [_current_at(branch, found[0]) for branch in measured]
    known = [current_a for current_a in currents if current_a is not None]
    return Sums(
        measured_a=sum(known) if len(known) == len(currents) else None,
        corrected_a=sum(current_a for current_a, _ in after[1].values()) if after is not None else None,
    )


_SILENT_PERIODS, _LEAST_SILENCE_S = 5.0, 1.0
"""Without a status for so many of its periods, and at least so long [s], the node is taken for gone."""


class _Status:
    """The node's status message."""

    def __init__(self, database: VehicleDatabase, status: StatusMessage, heard: _Heard) -> None:
        self._heard = heard[key_of(database.message(status.message))]
        self._silent_s = max(_SILENT_PERIODS * status.period_s, _LEAST_SILENCE_S)
        names = {"state": status.state, "reason": status.reason, "parameter_set": status.parameter_set}
        names |= {"measured_a": status.sum_measured, "corrected_a": status.sum_corrected}
        signals = {field: database.signal(f"{status.message}.{name}")[1] for field, name in names.items() if name}
        self._places = {field: bit_place(signal) for field, signal in signals.items()}
        where = f"{database.layout.path}: status"
        self._sums = {field: read_codes(signals[field], AMPERE, where) for field in signals if field.endswith("_a")}

    def view(self, now_s: float) -> NodeView | None:
        """What is to be shown."""
        if not self._heard.frames:
            return None
        time_s, payload = self._heard.frames[-1]
        codes = {field: place.extract(payload) for field, place in self._places.items()}
        sums_a = {
            field: float(known.worth(code))
            for field, known in self._sums.items()
            if (code := codes[field]) is not None and known.is_value(code)
        }
        age_s = max(now_s - time_s, 0.0)
        return NodeView(
            state=_name(State, codes["state"]),
            reason=_name(Reason, codes["reason"]),
            parameter_set=codes.get("parameter_set"),
            sums=Sums(**sums_a),
            age_s=age_s,
            is_silent=age_s > self._silent_s,
            faults=dict(self._heard.faults),
        )


_AMPERES = {"measured": "[A]", "corrected": "[A]", "correction": "[A]"}
_COLUMNS = {"branch": "", **_AMPERES, "quality": "", "rate": "[1/s]", "answers": "[1/s]", "age": "[s]", "faults": ""}
"""Names and units: "rate" of the measured frames, "answers" of the corrected ones; words stand at the left."""
_BOLD, _DIM, _YELLOW = "1", "2", "33"
"""Styles as in the terminal's control sequence "select graphic rendition"."""


class ShownLine(NamedTuple):
    """One line for people."""

    text: str
    style: str = ""
    """How a terminal shows it: a parameter of "select graphic rendition"."""


def view_lines(view: View, where: str, more: Sequence[str] = ()) -> list[ShownLine]:
    """Say what is seen: node, a table with a row per branch and the sums, and what else a reader should know.

    Parameters
    ----------
    view : View
        What is to be shown.
    where : str
        Name of the bus.
    more : sequence of str
        Further lines.

    Returns
    -------
    list of ShownLine
        A number that is not known is "-". Yellow: a fault that lasts; dim: a branch that was never seen.
    """
    units = [unit or name for name, unit in _COLUMNS.items()]
    table = [([name if unit else "" for name, unit in _COLUMNS.items()], ""), (units, "")]
    table += [*map(_branch_row, view.branches), (_sum_cells("sum", view.sums), "")]
    if view.node is not None and not view.node.is_silent:
        table.append((_sum_cells("node's sum", view.node.sums), ""))
    widths = [max(map(len, column)) for column in zip(*(cells for cells, _ in table), strict=True)]
    lines = [ShownLine(f"{where}: {_node_text(view)}", _BOLD)]
    for cells, style in table:
        columns = zip(_COLUMNS.values(), cells, widths, strict=True)
        padded = [cell.rjust(width) if unit else cell.ljust(width) for unit, cell, width in columns]
        lines.append(ShownLine(" ".join(padded).rstrip(), style))
    return [*lines, *map(ShownLine, [*_notes(view), *more])]


def _node_text(view: View) -> str:
    """What the node does, and why; or that the bus cannot be listened to."""
    node = view.node
    if not view.is_bus_open:
        return "this computer's interface failed or is down; trying to open it again; what is shown was heard before"
    if not view.has_status:
        return "the layout has no status message: nothing is known of a node"
    if node is None:
        return "no node on this bus"
    if node.is_silent:
        return f"no node on this bus any more: its last status came {node.age_s:.1f} s ago"
    words = _words(State, node.state)
    if node.reason not in (None, "NONE"):
        words += f", because {_words(Reason, node.reason)}"
    which = f"; parameter set {node.parameter_set}" if node.parameter_set else ""
    faults = ", ".join(_fault_texts(node.faults))
    return f"node: {words}{which}; status {node.age_s:.1f} s ago{'; ' if faults else ''}{faults}"


def _words(names: type[Reason | State], shown: str | int | None) -> str:
    known = names.__members__.get(str(shown))
    return known.words if known is not None else f"{names.__name__.lower()} {shown}, which this version does not know"


def _notes(view: View) -> list[str]:
    """What else a reader should know."""
    if not view.is_any_branch_seen and view.is_bus_open:
        return ["no frame of any branch: is the bus awake, and its bit rate the right one?"]
    notes = []
    if not view.publishes_corrected:
        notes.append("no corrected messages on this bus: the currents are shown as they are on it")
    node = view.node
    is_passing = node is not None and not node.is_silent and node.state in ("PASSING_THROUGH", "SHADOW")
    if node is not None and is_passing and node.sums.corrected_a != node.sums.measured_a:
        notes.append("node's sum, corrected: what its parameters would make of it; it publishes what was measured")
    return notes


def _branch_row(branch: BranchView) -> tuple[list[str], str]:
    """Cells and style of a branch."""
    if not branch.is_seen:
        faults = ", ".join(["not fitted?", *_fault_texts(branch.faults)])
        return [branch.name, *["-"] * (len(_COLUMNS) - 2), faults], _DIM
    lasting = []
    if branch.is_stale:
        lasting.append("stale")
    elif branch.measured_a is None:
        lasting.append("not available")
    if branch.corrected_is_stale and not branch.is_stale:
        lasting.append("corrected: stale")
    corrected_faults = [f"corrected: {text}" for text in _fault_texts(branch.corrected_faults)]
    is_answered = branch.corrected_rate_hz or branch.corrected_a is not None
    cells = [
        branch.name,
        *map(_number, (branch.measured_a, branch.corrected_a, branch.correction_a)),
        branch.quality.lower().replace("_", " ") if branch.quality is not None else "-",
        f"{branch.rate_hz:.1f}",
        f"{branch.corrected_rate_hz:.1f}" if is_answered else "-",
        f"{branch.age_s:.2f}",
        ", ".join([*lasting, *_fault_texts(branch.faults), *corrected_faults]),
    ]
    return cells, _YELLOW if lasting else ""


def _sum_cells(name: str, sums: Sums) -> list[str]:
    correction_a = _difference(sums.corrected_a, sums.measured_a)
    cells = [name, *map(_number, (sums.measured_a, sums.corrected_a, correction_a))]
    return cells + [""] * (len(_COLUMNS) - len(cells))


def _fault_texts(faults: Mapping[str, int]) -> list[str]:
    return [f"{name} {count}" for name, count in faults.items() if count]


def _number(value_a: float | None) -> str:
    return f"{value_a:+.2f}" if value_a is not None else "-"


_WITHOUT_CURSOR = ("dumb", "unknown")
"""Terminals on which nothing can be drawn anew."""
_LIVE_PERIOD_S, _PLAIN_PERIOD_S = 0.25, 1.0
"""Between two pictures. [s]"""
_LONGEST_WAIT_S = 0.25
"""A wake-up at least this often, so that a request to stop is seen. [s]"""
_ENTER_SCREEN, _LEAVE_SCREEN = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""A screen of its own, without a cursor; and the one before back."""
_HOME, _CLEAR_LINE, _CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"


def _draw(lines: Sequence[ShownLine]) -> None:
    """Show lines in place of those before, broken at words; but for the terminal's last line, which would scroll."""
    width, height = shutil.get_terminal_size()
    shown = [ShownLine(part[:width], line.style) for line in lines for part in wrapped(line.text, width).split("\n")]
    if (missing := len(shown) - (height - 2)) > 1:
        shown = [*shown[:-missing], ShownLine(f"{missing} more lines do not fit"[:width], _YELLOW)]
    write_output(_HOME + "\n".join(f"\x1b[{style}m{text}\x1b[m{_CLEAR_LINE}" for text, style in shown) + _CLEAR_BELOW)


def run_monitor(layout: Path, bus: Mapping[str, Any], *, once_s: float | None, as_json: bool) -> int:
    """Show what is on a bus until SIGINT, SIGTERM or SIGHUP: a live table in a terminal, else a block per second.

    Parameters
    ----------
    layout : Path
        Layout of the vehicle.
    bus : mapping
        The bus, as the arguments of :func:`ecu_node.bus.adapters.bus_config`.
    once_s : float or None
        Listen this long, and print once what was seen [s]; None: until interrupted.
    as_json : bool
        Print it as JSON.

    Returns
    -------
    int
        Exit code: 0, or 1 if it was to listen once and no branch was seen.

    Raises
    ------
    UserError
        If layout, DBC or bus cannot be used.
    """
    database = node_database(layout)
    stop = Requests().stop
    signal.signal(signal.SIGHUP, signal.getsignal(signal.SIGTERM))  # the terminal was closed
    counters, say = Counters(), Log().say
    where = f"{bus['interface']} {bus['channel']}"
    if bus["listen_only"]:
        say(acknowledgement(bus["interface"], bus["channel"]))
    is_terminal = sys.stdout is not None and sys.stdout.isatty() and os.environ.get("TERM") not in _WITHOUT_CURSOR
    is_live = once_s is None and is_terminal
    period_s = once_s or (_LIVE_PERIOD_S if is_live else _PLAIN_PERIOD_S)
    opened = partial(open_bus, database, mode=Mode.OVERLAY, **bus)
    with ExitStack() as left_at_end:
        if is_live:
            write_output(_ENTER_SCREEN, end="")
            left_at_end.callback(write_output, _LEAVE_SCREEN, end="")
        steady = left_at_end.enter_context(closing(SteadyBus(opened, counters, say)))
        monitor = BusMonitor(database, time.monotonic())
        view = None
        while view is None or (once_s is None and not stop()):
            listen_until(steady, monitor, time.monotonic() + period_s, stop)
            view = replace(monitor.look(time.monotonic()), is_bus_open=steady.is_open)
            steady.count_dropped()
            lines = view_lines(view, where, _bus_notes(counters))
            text = "\n".join(line.text for line in lines)
            if is_live:
                _draw(lines)
            elif as_json:
                write_output(json.dumps(asdict(view), indent=2))
            else:
                write_text(text if once_s else f"{text}\n")
    if is_live:
        write_text(text)  # what was seen last stays on the screen
    if once_s is not None and not view.is_any_branch_seen:
        say_error(f"ecu-node: {where}: no branch of {layout} was seen; see that the bus is the right one")
        return 1
    return 0


def listen_until(bus: SteadyBus, monitor: BusMonitor, until_s: float, stop: Callable[[], bool]) -> None:
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
    while (now_s := time.monotonic()) < until_s and not stop():
        ahead_s = time.time() - now_s
        turn_end_s = min(until_s, now_s + _LONGEST_WAIT_S)
        while now_s < turn_end_s and (message := bus.receive(turn_end_s - now_s)) is not None:
            now_s = time.monotonic()
            if not message.is_remote_frame:
                time_s = steady_time_s(message.timestamp, now_s, ahead_s)
                monitor.take((message.arbitration_id, message.is_extended_id), message.data, time_s)


def _bus_notes(counters: Counters) -> list[str]:
    notes = {
        "error frames of the bus: {}; a wrong bit rate, or a fault in the wiring?": counters.bus_errors,
        "frames that this computer was too slow to read: {}; they count as lost above": counters.dropped,
    }
    return [text.format(count) for text, count in notes.items() if count]
