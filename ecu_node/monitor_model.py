"""What a listener sees of the junction and of the node, from the frames of one bus: frames and times in, a view out.

Nothing of the node is asked: measured and corrected currents, their sums, rates and faults are worked out from what is
on the bus. Sums are taken as the node takes them, of all branches in one instant of the junction; the calibrated delays
of the branches are in the parameter file alone, and not known here. Currents are positive into the junction. Times are
those of one steady clock. [s]
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from cantools.database.can import Message, Signal

from ecu_node.auxiliary import Auxiliary
from ecu_node.bits import PlacedSignal, bit_place, placed_signal
from ecu_node.branch import LiveBranch
from ecu_node.branch_plans import branch_signals
from ecu_node.codes import Codes, read_codes
from ecu_node.database import VehicleDatabase
from ecu_node.e2e import Check, Receiver
from ecu_node.e2e_profiles import protection_of
from ecu_node.frames import FrameKey
from ecu_node.guard import Mode, key_of, received, transmitted
from ecu_node.layout import Branch, SignalName, StatusMessage
from ecu_node.past import Frames, Past
from ecu_node.status import Quality
from ecu_node.units import AMPERE

__all__ = ["BranchView", "BusMonitor", "FrameFaults", "NodeView", "Sums", "View"]

_REMEMBERED = 1024
"""Frames of a message that are remembered."""
_RATE_WINDOW_S = 2.0
"""Frame rates are means over about this long. [s]"""
_SILENT_PERIODS, _LEAST_SILENCE_S = 5.0, 1.0
"""Without a status for so many of its periods, and at least so long [s], the node is taken for gone."""


@dataclass(frozen=True, kw_only=True)
class FrameFaults:
    """Frames of one message that failed their end-to-end check since the monitor was started.

    Attributes
    ----------
    corrupt : int
        Wrong CRC, impossible counter, or too short for their header.
    repeated : int
        Counter of the one before.
    lost : int
        Times that the counter showed lost frames, few or many.
    """

    corrupt: int = 0
    repeated: int = 0
    lost: int = 0


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
    quality : Quality or None
        Of the corrected current; None where it is not told.
    rate_hz, corrected_rate_hz : float
        Frames of the measured and of the corrected message. [1/s]
    age_s : float or None
        Of the last intact measured frame. [s]
    is_stale, corrected_is_stale : bool
        Whether intact frames came, but none for longer than the branch's timeout.
    faults, corrected_faults : FrameFaults
        Of the measured and of the corrected message.
    """

    name: str
    is_seen: bool
    measured_a: float | None
    corrected_a: float | None
    correction_a: float | None
    quality: Quality | None
    rate_hz: float
    corrected_rate_hz: float
    age_s: float | None
    is_stale: bool
    corrected_is_stale: bool
    faults: FrameFaults
    corrected_faults: FrameFaults


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Kirchhoff sum of all branches, measured and corrected [A]; None where it is not known."""

    measured_a: float | None = None
    corrected_a: float | None = None


@dataclass(frozen=True, kw_only=True)
class NodeView:
    """What the node says of itself in its last intact status message.

    Attributes
    ----------
    state, reason : int or None
        See :class:`~ecu_node.status.State` and :class:`~ecu_node.status.Reason`; None if the message was too short.
    parameter_set : int or None
        None if the layout leaves it out.
    sums : Sums
        As the node publishes them.
    age_s : float
        Of the message. [s]
    is_silent : bool
        Whether the message is so old that the node must be gone.
    faults : FrameFaults
        Of the status message.
    """

    state: int | None
    reason: int | None
    parameter_set: int | None
    sums: Sums
    age_s: float
    is_silent: bool
    faults: FrameFaults


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
    """

    branches: tuple[BranchView, ...]
    sums: Sums
    node: NodeView | None
    has_status: bool
    publishes_corrected: bool

    @property
    def is_any_branch_seen(self) -> bool:
        """Whether anything of the junction was seen."""
        return any(branch.is_seen for branch in self.branches)


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
        self._heard = {key: _Heard(database, message, start_s) for key, message in messages.items()}
        self._by_key: dict[tuple[int, bool], _Heard] = dict(self._heard.items())
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
        after = [pair.shown for pair in pairs if pair.measured.is_fitted]
        return View(
            branches=tuple(pair.view(now_s) for pair in pairs),
            sums=Sums(
                measured_a=_sum([pair.measured for pair in pairs if pair.measured.is_fitted], now_s),
                corrected_a=_sum(after, now_s) if publishes else None,
            ),
            node=self._status.view(now_s) if self._status is not None else None,
            has_status=self._status is not None,
            publishes_corrected=publishes,
        )


class _Heard:
    """One message: its frames, whether they are intact, and how many come."""

    def __init__(self, database: VehicleDatabase, message: Message, start_s: float) -> None:
        protection = protection_of(database, message)
        self._check = Receiver(protection).check if protection is not None else None
        self._found = dict.fromkeys(Check, 0)
        self._count = 0
        self._counts: deque[tuple[float, int]] = deque([(start_s, 0)])
        self.rate_hz = 0.0
        self.frames: Frames = deque(maxlen=_REMEMBERED)
        """Times [s] and payloads of the last intact frames."""

    def take(self, payload: bytearray, time_s: float) -> None:
        """Take a frame; like the node, use it only if it is intact, new, and not after a jump of its counter."""
        self._count += 1
        if self._check is not None and (found := self._check(payload)) is not Check.OK:
            self._found[found] += 1
            if found is not Check.LOST:
                return
        self.frames.append((time_s, payload))

    def count_rate(self, now_s: float) -> None:
        """Work out the frame rate."""
        counts = self._counts
        while len(counts) > 1 and counts[1][0] <= now_s - _RATE_WINDOW_S:
            counts.popleft()
        since_s, before = counts[0]
        self.rate_hz = (self._count - before) / (now_s - since_s) if now_s > since_s else 0.0
        counts.append((now_s, self._count))

    @property
    def faults(self) -> FrameFaults:
        """Frames that failed their check."""
        found = self._found
        return FrameFaults(
            corrupt=found[Check.CORRUPT],
            repeated=found[Check.REPEATED],
            lost=found[Check.LOST] + found[Check.JUMPED],
        )


_NotedFrames = dict[FrameKey, _Heard]


class _Pair:
    """One branch: the measured current, and the corrected one if the layout gives it a signal."""

    def __init__(self, database: VehicleDatabase, branch: Branch, heard: _NotedFrames) -> None:
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
        self._past = Past(*_followed(database, branch.source, heard))
        self._heard = _heard_of(database, branch.source, heard)
        self.corrected: LiveBranch | None = None
        self._corrected_heard: _Heard | None = None
        if branch.corrected is not None:
            self.corrected = current(branch.corrected, signals.target)
            self._corrected_heard = _heard_of(database, branch.corrected, heard)
        self._quality = bit_place(database.signal(branch.quality)[1]) if branch.quality is not None else None

    @property
    def shown(self) -> LiveBranch:
        """What counts in the corrected sum: the measured current where the layout publishes no corrected one."""
        return self.measured if self.corrected is None else self.corrected

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

    def __init__(self, database: VehicleDatabase, status: StatusMessage, heard: _NotedFrames) -> None:
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


def _heard_of(database: VehicleDatabase, name: SignalName, heard: _NotedFrames) -> _Heard:
    return heard[key_of(database.signal(name)[0])]


def _followed(database: VehicleDatabase, name: SignalName, heard: _NotedFrames) -> tuple[PlacedSignal, Frames]:
    message, signal = database.signal(name)
    return placed_signal(message, signal), heard[key_of(message)].frames


def _newest(branch: LiveBranch) -> float | None:
    """Current in the last frame [A]; None if that is no value."""
    found = branch.latest()
    currents = branch.currents_at(found[0]) if found is not None else None
    return currents[0] if currents is not None else None


def _sum(branches: Sequence[LiveBranch], now_s: float) -> float | None:
    """Sum in the newest instant that all branches have reached [A]; None while one is stale or has no value."""
    latest = [found for branch in branches if not branch.is_stale(now_s) and (found := branch.latest()) is not None]
    if not branches or len(latest) < len(branches):
        return None
    instant_s = min(seen_s for seen_s, _ in latest)
    known = [currents[0] for branch in branches if (currents := branch.currents_at(instant_s)) is not None]
    return sum(known) if len(known) == len(branches) else None


def _value(codes: Codes | None, payload: bytearray) -> float | None:
    code = codes.place.extract(payload) if codes is not None else None
    if codes is None or code is None or not codes.is_value(code):
        return None
    return float(codes.scale * code + codes.offset)
