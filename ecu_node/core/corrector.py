"""The node without its bus: frames and times go in, corrected frames and the status come out.

Overlay: a branch's frame is answered by its corrected message under an identifier of its own; nothing else is touched.
Gateway: a branch's frame goes on to the other bus with its current rewritten in place; only its own bits change, and
its counter stays, so that a receiver sees every frame that was lost or repeated. A frame whose CRC is wrong is never
given a right one. Times are those of one steady clock. [s]

A payload is read as one integer, from which each signal is taken with a shift and a mask. Both modes write in the same
way: the branches of the frame are written anew, into a copy of the target's last message (overlay) or of the frame
itself (gateway). What does not change from frame to frame is looked up once per payload length, and again whenever the
correction of a branch changes.
"""

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

from ecu_node.core.e2e import Check, E2EState, Protection, Receiver
from ecu_node.core.junction import REMEMBERED_FRAMES, Frames, HeardSignal, JunctionWatch, LiveBranch, Written
from ecu_node.core.signals import BitPlace, Codes, FrameKey, PlacedSignal, as_written
from ecu_node.core.status import Counters, Reason, State
from ecu_node.parameters import NOTHING_EXPECTED, JunctionResidual

__all__ = ["OF_ONE_DRIVE", "PARAMETER_SETS", "Corrector", "StatusFields"]

PARAMETER_SETS = 256
"""The status publishes the number of the parameter set modulo this."""

_OK, _LAST_USABLE = Check.OK, Check.LOST  # looking up members of an enumeration is slow
_INVALID, _from_bytes = E2EState.INVALID, int.from_bytes
_LEAST_SILENCE_S = 1.0
"""After a silence of this, or of its branches' timeout if that is longer, any counter of a message is accepted. [s]"""

_Rewrite = Callable[[bytearray, bytearray, float], bytearray]
"""Function of the payload of a frame, the previous outgoing payload, and the time at which the frame came [s]; returns
a new outgoing payload, with the branches written into it."""


def _signal_by_signal(
    branches: Mapping[LiveBranch, Written], inside: Collection[LiveBranch], counters: Counters
) -> _Rewrite:
    """Return a function that writes each branch by itself.

    A branch that the payload lacks gets its last value in an overlay's answer, or the code for "no value" if that value
    is too old or a frame that must not be used came since; in a gateway's frame its bits stay as they are.
    """

    def rewrite(payload: bytearray, before: bytearray, now_s: float) -> bytearray:
        made = bytearray(before)
        for branch, written in branches.items():
            code = branch.signal.code(payload) if branch in inside else None
            if code is not None:
                written.put(made, *branch.convert(code, now_s, counters))
            elif written.not_available is not None:
                written.put(made, *branch.published(now_s))
        return made

    return rewrite


def _in_one_word(
    branches: Mapping[LiveBranch, Written],
    inside: Collection[LiveBranch],
    length: int,
    made_length: int,
    otherwise: _Rewrite,
) -> _Rewrite:
    """Return a function that writes all branches at once, or `otherwise` where that cannot be done.

    It cannot if payloads of this length may lack a branch, if byte orders differ, or if a branch has no ordinary codes
    (``LiveBranch.ordinary_codes``). For a frame with a code that is not ordinary the function calls `otherwise`.
    Two's complements are handled as unsigned numbers: their sign bits are inverted, in the payload and in the outgoing
    one.
    """
    orders = {(branch.signal.place.order, written.place.order) for branch, written in branches.items()}
    if len(orders) != 1 or any(branch.signal.above or branch not in inside for branch in branches):
        return otherwise
    ((order, to),) = orders
    cells = []
    signs, taken, ready = bytearray(length), bytearray(made_length), bytearray(made_length)
    for branch, written in branches.items():
        place, plan, (first, last) = branch.signal.place, branch.plan, branch.ordinary_codes()
        if first > last:
            return otherwise
        bias = plan.bias + (1 << (plan.shift - 1)) + place.lowest * plan.gain - (written.place.lowest << plan.shift)
        at, to_at = place.shift_in(length), written.place.shift_in(made_length)
        cells.append((at, place.ones, first - place.lowest, last - place.lowest, plan.gain, bias, plan.shift, to_at))
        place.put(signs, place.lowest)
        written.place.put(ready, written.place.lowest)
        written.place.put(taken, written.place.highest)  # all but a sign bit, which is set anew
        if written.quality is not None:
            written.quality.put(ready, min(branch.quality, written.quality.highest))
            written.quality.put(taken, written.quality.highest)
    sign_bits, ready_bits = _from_bytes(signs, order), _from_bytes(ready, to)
    kept_bits = ~_from_bytes(taken, to)

    def rewrite(payload: bytearray, before: bytearray, now_s: float) -> bytearray:
        word = _from_bytes(payload, order)
        made = (word if before is payload else _from_bytes(before, to)) & kept_bits | ready_bits
        word ^= sign_bits
        for at, ones, first, last, gain, bias, down, to_at in cells:
            number = word >> at & ones
            if not first <= number <= last:
                return otherwise(payload, before, now_s)
            made ^= (number * gain + bias) >> down << to_at
        return bytearray(made.to_bytes(made_length, to))

    return rewrite


class OwnMessage:
    """A message that the node sends in its own name: an answer with corrected currents, or the status.

    Parameters
    ----------
    key : FrameKey
        Its identifier.
    length : int
        Bytes of the message.
    fd : bool
        Whether it is a CAN FD message by the DBC.
    protection : Protection or None
        End-to-end protection.

    Attributes
    ----------
    key, fd, protection
        As given.
    data : bytearray
        Payload that was made last; before the first one zeros, and with protection a counter whose next value is 0.
        The next payload is a new object, so one that was handed out does not change.
    branches : dict of LiveBranch to Written
        The branches that are written into it.
    """

    def __init__(self, key: FrameKey, length: int, *, fd: bool, protection: Protection | None) -> None:
        self.key, self.fd, self.data, self.protection = key, fd, bytearray(length), protection
        self.branches: dict[LiveBranch, Written] = {}
        if protection is not None:
            protection.before_first(self.data)


class _Ways(NamedTuple):
    """What is done with payloads of one length."""

    missing: list[HeardSignal]
    """Branches and other signals that such a payload is too short for."""
    in_place: _Rewrite
    """For a gateway: makes the payload to be passed on, with corrected currents in place of the measured ones."""
    answers: list[tuple[OwnMessage, _Rewrite]]
    """For an overlay: messages that answer such a payload, each with the function that fills it."""


class _WaysByLength(dict[int, _Ways]):
    """What is done with payloads, by their length; found when the first one of a length comes."""

    def __init__(self, find: Callable[[int], _Ways]) -> None:
        self._find = find

    def __missing__(self, length: int) -> _Ways:
        found = self[length] = self._find(length)
        return found


class Source:
    """One incoming message, what is read from it and which messages answer it.

    Parameters
    ----------
    protection : Protection or None
        End-to-end protection.
    readers : sequence of tuple
        Pairs of a reader (branch, voltage or input of the watch) and the signal that it reads.
    targets : sequence of OwnMessage
        Messages that answer it.
    counters : Counters
        Counters to add to.

    Attributes
    ----------
    targets : tuple of OwnMessage
        As given.
    branches : list of LiveBranch
        Branches that are read from it.
    timeout_s : float
        Frames that are older than this when they are read are not used: the least time-out of its branches, infinity if
        it has none. [s]
    failed_s : float
        When the last frame came that failed its end-to-end check; -infinity if none did. [s]
    """

    def __init__(
        self,
        *,
        protection: Protection | None,
        readers: Sequence[tuple[HeardSignal, PlacedSignal]],
        targets: Sequence[OwnMessage],
        counters: Counters,
    ) -> None:
        self._receiver = Receiver(protection) if protection is not None else None
        self._seal = protection.seal if protection is not None else None
        self._counters, self.targets = counters, tuple(targets)
        self.branches = [part for part, _ in readers if isinstance(part, LiveBranch)]
        self._others = [part for part, _ in readers if not isinstance(part, LiveBranch)]
        self.timeout_s = min((branch.timeout_s for branch in self.branches), default=math.inf)
        self.failed_s = -math.inf
        self._silence_s = max([_LEAST_SILENCE_S, *(branch.timeout_s for branch in self.branches)])
        self._silent_from_s = math.inf
        self._frames: Frames = deque(maxlen=REMEMBERED_FRAMES)
        self.ways = _WaysByLength(self._find)
        """What is done with payloads; must be cleared when the correction of a branch changes."""
        for part, signal in readers:
            part.follow(signal, self._frames)

    @property
    def is_invalid(self) -> bool:
        """Whether so many of its frames fail their check that the message cannot be relied on."""
        return self._receiver is not None and self._receiver.state is _INVALID

    def answer(self, payload: bytearray, now_s: float) -> Sequence[OwnMessage]:
        """Overlay: take a frame, and make the messages that answer it.

        Parameters
        ----------
        payload : bytearray
            Data of the frame; it is kept, and must not be changed later.
        now_s : float
            When it came. [s]

        Returns
        -------
        sequence of OwnMessage
            Messages to be sent; none if the frame is corrupt, repeated, or its counter jumped.
        """
        ways = self.ways[len(payload)]
        if self._take(payload, now_s, ways) > _LAST_USABLE:
            return ()
        if self.is_invalid:
            for branch in self.branches:
                branch.spoil(now_s)
            ways = self.ways[0]  # as for an empty payload: nothing is read from it
        for target, rewrite in ways.answers:
            made = rewrite(payload, target.data, now_s)
            if target.protection is not None:
                target.protection.advance(made)
            target.data = made
        self._counters.answers += len(self.targets)
        return self.targets

    def forward(self, payload: bytearray, now_s: float) -> bytearray | None:
        """Gateway: take a frame, and write the corrected currents in place of the measured ones.

        Parameters
        ----------
        payload : bytearray
            Data of the frame; it is kept, and must not be changed later.
        now_s : float
            When it came. [s]

        Returns
        -------
        bytearray or None
            Payload to be sent on, protected with the counter that the frame came with; None if the frame carries a
            branch and is corrupt, repeated, or its counter jumped: then it is not passed on. Intact frames are
            passed on even if too many others of the message fail their check: its receivers judge that themselves.
        """
        ways = self.ways[len(payload)]
        if self._take(payload, now_s, ways) > _LAST_USABLE:
            if not self.branches:
                return payload
            self._counters.not_passed_on += 1
            return None
        made = ways.in_place(payload, payload, now_s)
        if made == payload:
            return payload
        self._counters.rewritten += 1
        if self._seal is not None:
            self._seal(made)
        return made

    def _take(self, payload: bytearray, now_s: float, ways: _Ways) -> Check:
        """Check a frame, remember it if it is usable, and return the outcome of the check."""
        counters, check = self._counters, _OK
        counters.frames_in += 1
        if self._receiver is not None:
            if now_s > self._silent_from_s:
                self._receiver.restart()
            self._silent_from_s = now_s + self._silence_s  # also for frames that fail, or a frozen counter would pass
            check = self._receiver.check(payload)
            if self._receiver.state is _INVALID:  # other messages are corrected with these; their receivers cannot know
                for part in self._others:
                    part.spoil(now_s)
            if check is not _OK:
                counters.corrupt += check is Check.CORRUPT
                counters.repeated += check is Check.REPEATED
                counters.jumped += check is Check.JUMPED
                counters.gaps += check is Check.LOST
                if check > _LAST_USABLE:
                    self.failed_s = now_s
                    return check
        self._frames.append((now_s, payload))
        for part in ways.missing:
            part.spoil(now_s)
            counters.short += 1
        return check

    def _find(self, length: int) -> _Ways:
        """Prepare what is done with payloads of this length. [byte]"""
        inside = {item: Written(item.signal.place) for item in self.branches if item.signal.end <= length}

        def way(branches: Mapping[LiveBranch, Written], made_length: int) -> _Rewrite:
            plain = _signal_by_signal(branches, inside, self._counters)
            return _in_one_word(branches, inside, length, made_length, plain)

        return _Ways(
            missing=[part for part in (*self.branches, *self._others) if part.signal.end > length],
            in_place=way(inside, length),
            answers=[(target, way(target.branches, len(target.data))) for target in self.targets],
        )


OF_ONE_DRIVE = frozenset((Reason.BRANCH_STALE, Reason.BRANCH_STUCK))
"""Reasons that no longer count once the bus has slept: the node then tries to correct again."""
_FOREIGN_S = 10.0
"""The status reports FOREIGN_FRAMES for this long after the last such frame. [s]"""


class StatusFields(NamedTuple):
    """The status message, and where its fields stand; only those that the layout names."""

    message: OwnMessage
    places: Mapping[str, BitPlace]
    """Places of the integer fields, by their keys in the layout."""
    sums: Mapping[str, tuple[Codes, int]]
    """Signals of ``sum_measured`` and ``sum_corrected``, each with its code for "no value"."""


class Corrector:
    """The pure core of the node; built by :func:`ecu_node.bus.wiring.wire`, and ready after the first :meth:`begin`.

    Parameters
    ----------
    sources : mapping of FrameKey to Source
        Incoming messages by identifier; no other frame is looked at.
    branches : sequence of LiveBranch
        All branches of the layout.
    status_fields : StatusFields or None
        Status message, if the layout has one.
    watch : JunctionWatch
        Watch of these branches.
    counters : Counters
        Counters, the same object that the sources count in.
    shadow : bool
        Compute and report, change nothing.
    sleep_s : float
        Silence of all branches after which a branch that was latched as silent or stuck is tried again. [s]
    """

    def __init__(
        self,
        *,
        sources: Mapping[FrameKey, Source],
        branches: Sequence[LiveBranch],
        status_fields: StatusFields | None,
        watch: JunctionWatch,
        counters: Counters,
        shadow: bool,
        sleep_s: float,
    ) -> None:
        self.branches, self.shadow, self.watch, self._sleep_s = branches, shadow, watch, sleep_s
        self.counters = counters
        self.reason: Reason
        """Why the parameters cannot be applied and measured values are passed through; NONE if they can."""
        self.latched: Reason
        """Why the node has fallen back to passing through; NONE if it has not. Lasts until parameters are put in force,
        until :meth:`release`, or, if a branch was silent or stuck, until the bus has slept."""
        self.latched_branches: tuple[str, ...]
        self.parameter_set: int
        self.sources: dict[tuple[int, bool], Source] = dict(sources.items())
        """Which source takes which frames, by identifier and whether it has 29 bits."""
        self.branch_keys = {key for key, source in self.sources.items() if source.branches}
        """Identifiers of the messages that carry branches, which a gateway rewrites."""
        self.own_keys = {target.key for source in self.sources.values() for target in source.targets}
        """Identifiers of the messages that it makes itself: answers and status."""
        self._looked_s = self._foreign_until_s = -math.inf
        self._silent, self._silent_since_s, self._was_awake = True, math.inf, False
        self._foreign, self._alive = counters.foreign, 0
        self._status_fields = status_fields
        if status_fields is not None:
            self.own_keys.add(status_fields.message.key)

    def begin(self, *, reason: Reason, parameter_set: int, expected: JunctionResidual = NOTHING_EXPECTED) -> None:
        """Work from now on with the parameters that the branches took over last, and release what is latched.

        Parameters
        ----------
        reason : Reason
            Why there are no parameters that fit; NONE if there are.
        parameter_set : int
            Number of the parameter set; 0 if there is none.
        expected : JunctionResidual, optional
            What the parameters say about the junction's sum.
        """
        self.reason, self.parameter_set = reason, parameter_set
        self.watch.restart(expected)
        self.latch(Reason.NONE)

    def look(self, now_s: float) -> None:
        """Judge the whole junction; latch passing through if a branch is stale or stuck, or the sums are wrong.

        That all branches are silent is no fault: the vehicle sleeps. Must be called every 20 ms, so that a jump of the
        corrected sum is seen within 0.1 s.
        """
        self._looked_s = now_s
        if self.counters.foreign != self._foreign:
            self._foreign, self._foreign_until_s = self.counters.foreign, now_s + _FOREIGN_S
        self._see_whether_asleep(now_s)
        self.watch.look(now_s)
        if not (self.reason or self.latched or self._silent):
            if stale := [branch.name for branch in self.branches if self._is_missed(branch, now_s)]:
                self.latch(Reason.BRANCH_STALE, stale)
            elif self.watch.verdict:
                self.latch(*self.watch.verdict)

    @property
    def is_asleep(self) -> bool:
        """Whether all branches are silent, though some were heard before."""
        return self._silent and self._was_awake

    def state(self) -> tuple[State, Reason]:
        """Return what the node does, and why."""
        if reason := self.reason or self.latched:
            return State.PASSING_THROUGH, reason
        if self.is_asleep:
            return State.ASLEEP, Reason.NONE
        beside = Reason.FOREIGN_FRAMES if self._looked_s < self._foreign_until_s else Reason.NONE
        applied = [branch for branch in self.branches if branch.fault.applied]
        if self.shadow or not applied:
            return State.SHADOW if applied else State.PASSING_THROUGH, beside
        if any(branch.is_fitted and not branch.seen for branch in self.branches):
            return State.STARTING, Reason.NONE
        is_invalid = any(source.is_invalid for source in self.sources.values())
        lacks_input = any(branch.lacks_input(self._looked_s) for branch in applied)
        if is_invalid or lacks_input or self.watch.is_blind(self._looked_s):
            return State.PARTLY_CORRECTING, Reason.E2E_INVALID if is_invalid else Reason.INPUT_MISSING
        return State.CORRECTING, beside

    def status(self) -> OwnMessage | None:
        """Make the status message, with the sums of the last look; None if the layout has no status message."""
        fields = self._status_fields
        if fields is None:
            return None
        payload = bytearray(fields.message.data)
        state, reason = self.state()
        number = self.parameter_set % PARAMETER_SETS
        values = {"state": state, "reason": reason, "parameter_set": number, "alive_counter": self._alive}
        for key, place in fields.places.items():
            place.put(payload, values[key] % (place.highest + 1))
        self._alive += 1
        sums = self.watch.sums
        for key, (codes, missing) in fields.sums.items():
            total_a = None if sums is None else getattr(sums, f"{key.removeprefix('sum_')}_a")
            codes.place.put(payload, missing if total_a is None else codes.nearest(as_written(total_a)))
        if fields.message.protection is not None:
            fields.message.protection.advance(payload)
        fields.message.data = payload
        return fields.message

    def _see_whether_asleep(self, now_s: float) -> None:
        """Note whether all branches are silent: then the vehicle goes to sleep, which is not a fault.

        It does not while frames come that fail their check.
        Once it sleeps, a branch that was latched as silent or stuck is tried again; what the sums showed stays latched.
        """
        silent = all(branch.is_old(now_s) for branch in self.branches)
        silent &= all(now_s - source.failed_s > source.timeout_s for source in self.sources.values() if source.branches)
        if not silent:
            self._silent_since_s = math.inf
        elif self._silent_since_s == math.inf:
            self.watch.forget()
            self._silent_since_s = now_s
        if self.latched in OF_ONE_DRIVE and now_s - self._silent_since_s >= self._sleep_s:
            self.release()
        if self._silent and not silent:
            self._was_awake = True
            for branch in self.branches:
                if branch.is_old(now_s):
                    branch.expect(now_s)
        self._silent = silent

    def release(self) -> None:
        """Release what was latched, and try to correct again."""
        self.watch.forget()
        self.latch(Reason.NONE)

    def _is_missed(self, branch: LiveBranch, now_s: float) -> bool:
        """Whether a branch is stale though another sent after this one's deadline; else the vehicle goes to sleep.

        A frame that fails its check was sent, too.
        """
        sent_s = [other.time_s for other in self.branches]
        sent_s += [source.failed_s for source in self.sources.values() if source.branches]
        return branch.is_stale(now_s) and max(sent_s) > branch.deadline_s

    def latch(self, reason: Reason, branches: Sequence[str] = ()) -> None:
        """Pass measured values through for this reason, caused by these branches; NONE: do as the parameters say."""
        self.latched, self.latched_branches = reason, tuple(branches)
        active = not (self.reason or reason or self.shadow)
        for branch in self.branches:
            branch.activate(active=active, doubted=reason is Reason.SUM_IMPLAUSIBLE and branch.name in branches)
        for source in self.sources.values():
            source.ways.clear()
