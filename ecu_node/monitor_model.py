"""What a listener sees of the junction and of the node, from the frames of one bus: frames and times in, a view out.

Nothing of the node is asked: measured and corrected currents, their sums, rates and faults are worked out from what is
on the bus. Sums are taken as the node takes them, of all branches in one instant of the junction, and both in the same
one: an answer counts at the time of the frame that it answers. The calibrated delays of the branches are in the
parameter file alone, and not known here. Currents are positive into the junction. Times are
those of one steady clock. [s]
"""

from collections import deque
from collections.abc import Sequence

from cantools.database.can import Signal

from ecu_node.auxiliary import Auxiliary
from ecu_node.bits import PlacedSignal, bit_place, placed_signal
from ecu_node.branch import LiveBranch
from ecu_node.branch_plans import branch_signals
from ecu_node.codes import Codes, read_codes
from ecu_node.database import VehicleDatabase
from ecu_node.frames import FrameKey
from ecu_node.guard import Mode, key_of, received, transmitted
from ecu_node.junction_watch import simultaneous_currents
from ecu_node.layout import Branch, SignalName, StatusMessage, split_signal
from ecu_node.monitor_message import HeardMessage, answers_when_asked
from ecu_node.monitor_view import BranchView, FrameFaults, NodeView, Sums, View
from ecu_node.past import Frames, Past
from ecu_node.status import Quality
from ecu_node.units import AMPERE

__all__ = ["BusMonitor"]

_SILENT_PERIODS, _LEAST_SILENCE_S = 5.0, 1.0
"""Without a status for so many of its periods, and at least so long [s], the node is taken for gone."""

_HeardMessages = dict[FrameKey, HeardMessage]


class BusMonitor:
    """Listens; the pure core of ``ecu-node monitor``.

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
        messages = {**received(database), **transmitted(database, Mode.OVERLAY)}
        self._heard = {key: HeardMessage(database, message, start_s) for key, message in messages.items()}
        self._by_key: dict[tuple[int, bool], HeardMessage] = dict(self._heard.items())
        self._branches = [_Pair(database, branch, self._heard) for branch in database.layout.branch]
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
        heard = self._by_key.get(key)
        if heard is not None:
            heard.take(payload, time_s)

    def look(self, now_s: float) -> View:
        """Work out what is to be shown, and begin a new step of the frame rates.

        Parameters
        ----------
        now_s : float
            Now. [s]
        """
        for heard in self._heard.values():
            heard.count_rate(now_s)
        pairs = self._branches
        publishes = any(pair.corrected is not None and pair.corrected.is_fitted for pair in pairs)
        return View(
            branches=tuple(pair.view(now_s) for pair in pairs),
            sums=_sums([pair for pair in pairs if pair.measured.is_fitted], now_s, publishes=publishes),
            node=self._status.view(now_s) if self._status is not None else None,
            has_status=self._status is not None,
            publishes_corrected=publishes,
        )


class _Pair:
    """One branch: the measured current, and the corrected one if the layout gives it a signal."""

    def __init__(self, database: VehicleDatabase, branch: Branch, heard: _HeardMessages) -> None:
        signals = branch_signals(database, branch, Mode.OVERLAY)
        self._timeout_s = branch.timeout_s
        voltage = None
        if branch.voltage is not None and signals.voltage is not None:
            voltage = Auxiliary(signals.voltage, branch.timeout_s)
            voltage.follow(*_followed(database, branch.voltage, heard))

        def current(name: SignalName, codes: Codes) -> LiveBranch:
            made = LiveBranch(
                name=branch.name, codes=codes, sign=branch.sign, timeout_s=branch.timeout_s, voltage=voltage
            )
            made.follow(*_followed(database, name, heard))
            return made

        self.measured = current(branch.source, signals.source)
        self._heard = _heard_of(database, branch.source, heard)
        self._source = _followed(database, branch.source, heard)
        self.corrected: LiveBranch | None = None
        self._answered: LiveBranch | None = None
        self._answers: Frames = deque()
        self._corrected_heard: HeardMessage | None = None
        if branch.corrected is not None:
            self.corrected = current(branch.corrected, signals.target)
            self._answered = current(branch.corrected, signals.target)
            self._answered.follow(_followed(database, branch.corrected, heard)[0], self._answers)
            self._corrected_heard = _heard_of(database, branch.corrected, heard)
        same = [
            other.source
            for other in database.layout.branch
            if branch.corrected is not None
            and other.corrected is not None
            and split_signal(other.corrected)[0] == split_signal(branch.corrected)[0]
        ]
        asked = {id(frames): frames for frames in (_heard_of(database, name, heard).frames for name in same)}
        self._others = [frames for frames in asked.values() if frames is not self._source[1]]
        self._past = Past(*self._source)
        self._quality = bit_place(database.signal(branch.quality)[1]) if branch.quality is not None else None

    def answered(self) -> LiveBranch:
        """What counts in the corrected sum: the measured current where the layout publishes no corrected one."""
        if self._answered is None or self._corrected_heard is None:
            return self.measured
        signal, frames = self._source
        self._answers.clear()
        self._answers.extend(answers_when_asked(frames, self._others, signal, self._corrected_heard.frames))
        return self._answered

    def view(self, now_s: float) -> BranchView:
        """What is to be shown."""
        measured, corrected, answers = self.measured, self.corrected, self._corrected_heard
        is_seen = measured.is_fitted
        measured_a, corrected_a = self._currents(now_s)
        known = measured_a is not None and corrected_a is not None
        return BranchView(
            name=measured.name,
            is_seen=is_seen,
            measured_a=measured_a,
            corrected_a=corrected_a,
            correction_a=corrected_a - measured_a if known else None,  # type: ignore[operator]
            quality=self._told_quality(),
            rate_hz=self._heard.rate_hz,
            corrected_rate_hz=answers.rate_hz if answers is not None else 0.0,
            age_s=max(now_s - measured.time_s, 0.0) if is_seen else None,
            is_stale=measured.is_stale(now_s),
            corrected_is_stale=corrected is not None and corrected.is_stale(now_s),
            faults=self._heard.faults,
            corrected_faults=answers.faults if answers is not None else FrameFaults(),
        )

    def _currents(self, now_s: float) -> tuple[float | None, float | None]:
        """Measured and corrected current, the one made of the other where it goes on being corrected. [A]"""
        corrected = self.corrected
        if corrected is None or not corrected.is_fitted:
            return _newest(self.measured), None
        answer_s = corrected.time_s
        made_of_s = next((seen_s for seen_s, _ in self._past.newest_first() if seen_s <= answer_s), None)
        if made_of_s is None or now_s - made_of_s > self._timeout_s:
            return _newest(self.measured), _newest(corrected)
        before = self.measured.currents_at(made_of_s)
        return before[0] if before is not None else None, _newest(corrected)

    def _told_quality(self) -> Quality | None:
        if self._quality is None or self._corrected_heard is None or not self._corrected_heard.frames:
            return None
        _, payload = self._corrected_heard.frames[-1]
        code = self._quality.extract(payload)
        return Quality(code) if code in set(Quality) else None


class _Status:
    """The node's status message."""

    def __init__(self, database: VehicleDatabase, status: StatusMessage, heard: _HeardMessages) -> None:
        message = database.message(status.message)
        where = f"{database.layout.path}: status"
        self._heard = heard[key_of(message)]
        self._silent_s = max(_SILENT_PERIODS * status.period_s, _LEAST_SILENCE_S)

        def signal(name: str) -> Signal:
            return database.signal(f"{message.name}.{name}")[1]

        self._state, self._reason = bit_place(signal(status.state)), bit_place(signal(status.reason))
        self._parameter_set = bit_place(signal(status.parameter_set)) if status.parameter_set is not None else None
        self._sums = [
            read_codes(signal(name), AMPERE, where) if name is not None else None
            for name in (status.sum_measured, status.sum_corrected)
        ]

    def view(self, now_s: float) -> NodeView | None:
        if not self._heard.frames:
            return None
        time_s, payload = self._heard.frames[-1]
        measured_a, corrected_a = (_value(codes, payload) for codes in self._sums)
        age_s = max(now_s - time_s, 0.0)
        return NodeView(
            state=self._state.extract(payload),
            reason=self._reason.extract(payload),
            parameter_set=self._parameter_set.extract(payload) if self._parameter_set is not None else None,
            sums=Sums(measured_a=measured_a, corrected_a=corrected_a),
            age_s=age_s,
            is_silent=age_s > self._silent_s,
            faults=self._heard.faults,
        )


def _heard_of(database: VehicleDatabase, name: SignalName, heard: _HeardMessages) -> HeardMessage:
    return heard[key_of(database.signal(name)[0])]


def _followed(database: VehicleDatabase, name: SignalName, heard: _HeardMessages) -> tuple[PlacedSignal, Frames]:
    message, signal = database.signal(name)
    return placed_signal(message, signal), heard[key_of(message)].frames


def _newest(branch: LiveBranch) -> float | None:
    """Current in the last frame [A]; None if that is no value."""
    found = branch.latest()
    currents = branch.currents_at(found[0]) if found is not None else None
    return currents[0] if currents is not None else None


def _sums(pairs: Sequence[_Pair], now_s: float, *, publishes: bool) -> Sums:
    """Sums in the newest instant that all have reached; None while a branch is stale or has no value. [A]"""
    measured = [pair.measured for pair in pairs]
    after = simultaneous_currents([pair.answered() for pair in pairs], {}, now_s) if publishes else None
    if after is None:
        before = simultaneous_currents(measured, {}, now_s)
        return Sums(measured_a=_total([*before[1].values()]) if before is not None else None)
    instant_s, corrected = after
    return Sums(
        measured_a=_total([branch.currents_at(instant_s) for branch in measured]),
        corrected_a=_total([*corrected.values()]),
    )


def _total(currents: Sequence[tuple[float, float] | None]) -> float | None:
    """Sum of the first of each [A]; None if one is not known."""
    known = [pair[0] for pair in currents if pair is not None]
    return sum(known) if len(known) == len(currents) else None


def _value(codes: Codes | None, payload: bytearray) -> float | None:
    code = codes.place.extract(payload) if codes is not None else None
    if codes is None or code is None or not codes.is_value(code):
        return None
    return float(codes.scale * code + codes.offset)
