"""The node without its bus: frames and times go in, corrected frames and the status come out.

Overlay: a branch's frame is answered by its corrected message under an identifier of its own; nothing else is touched.
Gateway: a branch's frame goes on to the other bus with its current rewritten in place; only its own bits change, and
its counter stays, so that a receiver sees every frame that was lost or repeated. A frame that fails its check is never
given a valid CRC. Times are those of one steady clock. [s]

A payload is read as one integer per byte order, in which each signal is a shift and a mask. An answer is the target's
last message with the branches of the frame written anew; a gateway's frame is the frame itself with its branches
written anew: one way for both. What does not change from frame to frame is looked up once per length of payload, and
again whenever a branch is corrected otherwise.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ecu_node.core.e2e import Check, E2EState, Protection, Receiver
from ecu_node.core.junction import REMEMBERED_FRAMES, Auxiliary, ExpectedSum, Frames, JunctionWatch, LiveBranch
from ecu_node.core.signals import BitPlace, Codes, FrameKey, Order, PlacedSignal, as_written
from ecu_node.core.status import Counters, Quality, Reason, State

__all__ = ["OF_ONE_DRIVE", "Corrector", "StatusFields"]

_OK, _LAST_USABLE, _CORRUPT = Check.OK, Check.LOST, Check.CORRUPT  # looking up members of an enumeration is slow
_INVALID, _from_bytes = E2EState.INVALID, int.from_bytes
_BITS_PER_BYTE = 8
_LEAST_SILENCE_S = 1.0
"""After a silence of this long, or of a branch's timeout, a message's counter begins anew. [s]"""


class Reader(NamedTuple):
    """Who reads a signal of an incoming message, and where it stands."""

    part: Auxiliary | LiveBranch
    signal: PlacedSignal


class TargetField(NamedTuple):
    """Where one branch stands in a corrected message."""

    branch: LiveBranch
    place: BitPlace
    not_available: int
    """Code for "no value"."""
    quality: BitPlace | None


class _Written:
    """One branch in outgoing payloads of one length, each read as one integer of the branch's byte order."""

    def __init__(self, field: TargetField, length: int) -> None:
        self.branch, self.order, self._not_available = field.branch, field.place.order, field.not_available
        self.word = field.place.in_word(length)
        payloads = [bytearray(length) for _ in Quality]
        for quality, payload in zip(Quality, payloads, strict=True):
            if field.quality is not None:
                field.quality.put(payload, min(quality, field.quality.highest))
        self.quality_bits = [int.from_bytes(payload, self.order) for payload in payloads]
        self.mask = self.word.ones << self.word.shift
        if field.quality is not None:
            self.mask |= int.from_bytes(field.quality.mask.to_bytes(length, "little"), self.order)

    def write(self, word: int, out: int | None, quality: Quality) -> int:
        """The payload with a code, or "no value", and its quality."""
        code = self._not_available if out is None else out
        shift, ones, _ = self.word
        return word & ~self.mask | (code & ones) << shift | self.quality_bits[quality]

    def write_known(self, word: int, now_s: float) -> int:
        """The payload with what is known of the branch now."""
        return self.write(word, *self.branch.published(now_s))


class _Unusual(NamedTuple):
    """What is done with a branch where the result is no ordinary one."""

    branch: LiveBranch
    signal: PlacedSignal
    written: _Written | None
    """None where the branch is rewritten in its own place."""
    counters: Counters

    def write(self, word: int, payload: bytearray, now_s: float) -> int:
        """The outgoing payload with what becomes of the branch in a frame."""
        code = self.signal.code(payload)
        if self.written is not None:
            if code is None:
                return self.written.write_known(word, now_s)
            return self.written.write(word, *self.branch.convert(code, now_s, self.counters))
        if code is None:
            return word
        out, _ = self.branch.convert(code, now_s, self.counters)
        shift, ones, _ = self.signal.place.in_word(len(payload))
        return word & ~(ones << shift) | ((code if out is None else out) & ones) << shift


_Cell = tuple[int, int, int, int, int, int, int, int, _Unusual]
"""One branch of a frame, in unsigned numbers: the sign bits of two's complements are turned over. Shift and ones; least
and greatest number with an ordinary result; gain, bias and shift from number to result; the result's shift in the
outgoing payload; and what is done with other numbers."""


_Pass = tuple[Order, Order, int, int, int, list[_Cell]]
"""Branches that are read in one byte order and written in one: both orders; sign bits in the frame; bits of the
outgoing payload that stay; qualities where all results are ordinary, and the sign bits, which these turn over; the
branches. A plain tuple, as naming its parts would cost a twentieth of a frame's time."""


class Target:
    """One corrected message that the node sends in its own name.

    Parameters
    ----------
    key : FrameKey
        Its identifier.
    length : int
        Bytes of the message.
    fd : bool
        Whether the DBC sends it as CAN FD.
    fields : sequence of TargetField
        The branches written into it.
    protection : Protection or None
        End-to-end protection.
    """

    def __init__(
        self, *, key: FrameKey, length: int, fd: bool, fields: Sequence[TargetField], protection: Protection | None
    ) -> None:
        self.key, self.fd = key, fd
        self.data = bytearray(length)
        """The message as it was made last; a new one each time."""
        if protection is not None:
            protection.before_first(self.data)
        self.advance = protection.advance if protection is not None else None
        self.written = {field.branch: _Written(field, length) for field in fields}


@dataclass(frozen=True, kw_only=True)
class _Ways:
    """What is done with payloads of one length."""

    missing: list[LiveBranch]
    """Branches that such a payload is too short for."""
    in_place: list[_Pass]
    targets: list[tuple[Target, list[_Pass], list[_Written]]]
    """Messages that answer it, each with what is done for it, and its branches that are not in these payloads."""


class Source:
    """One incoming message, what is read from it and which messages answer it.

    Parameters
    ----------
    protection : Protection or None
        End-to-end protection.
    readers : sequence of Reader
        Who reads what.
    targets : sequence of Target
        Messages that answer it.
    counters : Counters
        Where it is counted what happened.
    pass_on_invalid : bool
        A frame that fails its check is answered, or passed on, so that it is seen to be invalid; else it is held back.

    Attributes
    ----------
    targets : tuple of Target
        As given.
    timeout_s : float
        Frames that are older when they are read are of no use; infinity for a message without branches. [s]
    """

    def __init__(
        self,
        *,
        protection: Protection | None,
        readers: Sequence[Reader],
        targets: Sequence[Target],
        counters: Counters,
        pass_on_invalid: bool,
    ) -> None:
        self._receiver = Receiver(protection) if protection is not None else None
        self._seal = protection.seal if protection is not None else None
        self.targets = tuple(targets)
        self._branches = [(part, signal) for part, signal in readers if isinstance(part, LiveBranch)]
        self._counters, self._pass_on_invalid = counters, pass_on_invalid
        self._history: Frames = deque(maxlen=REMEMBERED_FRAMES)
        self._silence_s = max([_LEAST_SILENCE_S, *(branch.timeout_s for branch, _ in self._branches)])
        self._silent_from_s = float("inf")
        self._ways: dict[int, _Ways] = {}
        self.timeout_s = max((branch.timeout_s for branch, _ in self._branches), default=float("inf"))
        for reader in readers:
            reader.part.follow(reader.signal, self._history)
        for branch, _ in self._branches:
            branch.when_changed.append(self._ways.clear)

    @property
    def carries_branches(self) -> bool:
        """Whether a branch is read from it."""
        return bool(self._branches)

    @property
    def is_invalid(self) -> bool:
        """Whether so many of its frames fail their check that the message cannot be relied on."""
        return self._receiver is not None and self._receiver.state is _INVALID

    def answer(self, payload: bytearray, now_s: float) -> Sequence[Target]:
        """Overlay: take a frame, and make the messages that answer it.

        Parameters
        ----------
        payload : bytearray
            Not to be changed, now or later.
        now_s : float
            When it came. [s]

        Returns
        -------
        sequence of Target
            To be sent.
        """
        ways = self._ways.get(len(payload)) or self._find(len(payload))
        is_usable = self._take(payload, now_s, ways) <= _LAST_USABLE
        if not (is_usable or self._pass_on_invalid):
            return ()
        answers = ways.targets
        if not is_usable or (self._receiver is not None and self._receiver.state is _INVALID):
            for branch, _ in self._branches:
                branch.spoil(now_s)
            answers = [(target, [], list(target.written.values())) for target in self.targets]
        for target, passes, others in answers:
            made = self._rewritten(payload, target.data, passes, now_s)
            for written in others:
                word = written.write_known(int.from_bytes(made, written.order), now_s)
                made = bytearray(word.to_bytes(len(made), written.order))
            if target.advance is not None:
                target.advance(made)
            target.data = made
        self._counters.answers += len(answers)
        return self.targets

    def forward(self, payload: bytearray, now_s: float) -> bytearray | None:
        """Gateway: take a frame, and write what the branches make of it in the place of what was measured.

        Parameters
        ----------
        payload : bytearray
            Not to be changed, now or later.
        now_s : float
            When it came. [s]

        Returns
        -------
        bytearray or None
            To be sent on, protected with the counter that the frame came with; None if it is held back. A receiver of
            it judges for itself whether so many frames fail their check that it cannot rely on the message.
        """
        ways = self._ways.get(len(payload)) or self._find(len(payload))
        check = self._take(payload, now_s, ways)
        if check > _LAST_USABLE and self._branches and not self._pass_on_invalid:
            self._counters.held_back += 1
            return None
        if check is _CORRUPT:
            return payload
        made = self._rewritten(payload, payload, ways.in_place, now_s)
        if made == payload:
            return payload
        self._counters.rewritten += 1
        if self._seal is not None:
            self._seal(made)
        return made

    def _take(self, payload: bytearray, now_s: float, ways: _Ways) -> Check:
        """Check a frame, and remember it if it is usable."""
        counters, check = self._counters, _OK
        counters.frames_in += 1
        if self._receiver is not None:
            if now_s > self._silent_from_s:
                self._receiver.restart()
            check = self._receiver.check(payload)
            if check is not _OK:
                counters.corrupt += check is Check.CORRUPT
                counters.repeated += check is Check.REPEATED
                counters.jumped += check is Check.JUMPED
                counters.gaps += check is Check.LOST
                if check > _LAST_USABLE:
                    return check
            self._silent_from_s = now_s + self._silence_s
        self._history.append((now_s, payload))
        for branch in ways.missing:
            branch.spoil(now_s)
            counters.short += 1
        return check

    def _rewritten(self, payload: bytearray, made: bytearray, passes: Sequence[_Pass], now_s: float) -> bytearray:
        """The outgoing payload with the branches of a frame; never the same object, but where there are none."""
        for order, to, signs, keep, good, cells in passes:
            word = _from_bytes(payload, order)
            new = (word if made is payload else _from_bytes(made, to)) & keep | good
            word ^= signs
            for shift, ones, first, last, gain, bias, down, place, unusual in cells:
                number = word >> shift & ones
                if first <= number <= last:
                    new ^= (number * gain + bias) >> down << place
                else:
                    new = unusual.write(new, payload, now_s)
            made = bytearray(new.to_bytes(len(made), to))
        return made

    def _find(self, length: int) -> _Ways:
        """Find out what is done with payloads of some length. [byte]"""
        present = [(branch, signal) for branch, signal in self._branches if signal.end <= length]
        answers = []
        for target in self.targets:
            inside = [(*item, target.written[item[0]]) for item in present if item[0] in target.written]
            others = [target.written[branch] for branch in target.written.keys() - {item[0] for item in inside}]
            answers.append((target, self._passes(inside, length, len(target.data)), others))
        found = self._ways[length] = _Ways(
            missing=[branch for branch, signal in self._branches if signal.end > length],
            in_place=self._passes([(*item, None) for item in present], length, length),
            targets=answers,
        )
        return found

    def _passes(
        self, branches: Sequence[tuple[LiveBranch, PlacedSignal, _Written | None]], length: int, made_length: int
    ) -> list[_Pass]:
        """What is done with these branches, per pair of byte orders."""
        passes: dict[tuple[Order, Order], _Pass] = {}
        for branch, signal, written in branches:
            source, plan, order = signal.place.in_word(length), branch.plan, signal.place.order
            to, place = (order, source) if written is None else (written.order, written.word)
            first, last = (1, 0) if signal.above else branch.ordinary_codes()
            _, _, signs, keep, good, cells = passes.get((order, to)) or (
                order, to, 0, (1 << _BITS_PER_BYTE * made_length) - 1, 0, []
            )  # fmt: skip
            cells.append(
                (
                    source.shift,
                    source.ones,
                    first + source.sign,
                    last + source.sign,
                    plan.gain,
                    plan.bias + (1 << (plan.shift - 1)) - source.sign * plan.gain + (place.sign << plan.shift),
                    plan.shift,
                    place.shift,
                    _Unusual(branch, signal, written, self._counters),
                )
            )
            if first <= last:  # else no number lies between them, and none is ordinary
                signs |= source.sign << source.shift
                keep &= ~(place.ones << place.shift if written is None else written.mask)
                good |= place.sign << place.shift
                good |= 0 if written is None else written.quality_bits[branch.quality]
            passes[order, to] = order, to, signs, keep, good, cells
        return list(passes.values())


OF_ONE_DRIVE = frozenset((Reason.BRANCH_STALE, Reason.BRANCH_STUCK))
"""What is tried anew after the bus has slept."""
_FOREIGN_S = 10.0
"""For so long after the last frame the status says that another node sends what only a gateway may. [s]"""
_IN_4_BITS = {
    Reason.SUM_IMPLAUSIBLE: Reason.CORRECTION_WORSE,
    Reason.FOREIGN_FRAMES: Reason.NONE,
    Reason.E2E_INVALID: Reason.INPUT_MISSING,
}


@dataclass(frozen=True, kw_only=True)
class StatusFields:
    """The status message, with the fields that the layout has."""

    key: FrameKey
    length: int
    fd: bool
    protection: Protection | None
    places: Mapping[str, BitPlace]
    """By their keys in the layout."""
    sums: Mapping[str, tuple[Codes, int]]
    """Signals of ``sum_measured`` and ``sum_corrected``, each with its code for "no value"."""


class Corrector:
    """The pure core of the node; built by :func:`ecu_node.bus.wiring.wire`.

    Parameters
    ----------
    sources : mapping of FrameKey to Source
        What is received; no other frame is looked at.
    branches : sequence of LiveBranch
        All branches of the layout.
    status_fields : StatusFields or None
        Status message, if the layout has one.
    watch : JunctionWatch
        Of these branches.
    counters : Counters
        The same that the sources count in.
    shadow : bool
        Compute and report, change nothing.
    sleep_s : float
        The bus sleeps once all branches have been silent for so long. [s]
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
        self.reason = Reason.NO_PARAMETERS
        """Why measured values are passed through, of the parameters; NONE where they fit."""
        self.latched = Reason.NONE
        """Why the node has fallen back to passing through, until parameters are put in force or :meth:`release`; what a
        branch did, or did not, also until the bus has slept."""
        self.latched_branches: tuple[str, ...] = ()
        self.told = (State.STARTING, Reason.NONE)
        """State and reason as of the last look; for other threads."""
        self.parameter_set = 0
        self.sources: dict[tuple[int, bool], Source] = dict(sources.items())
        """Who takes which frames, by identifier and whether it has 29 bits; no other frame is looked at."""
        self._looked_s = float("-inf")
        self._status_fields = status_fields
        self._silent, self._silent_since_s = True, float("inf")
        self._was_awake = False
        self._foreign, self._foreign_until_s = counters.foreign, float("-inf")
        self._beside = Reason.NONE
        """What is told beside a state that has no reason."""
        self._alive = 0
        self._payload = bytearray(status_fields.length if status_fields is not None else 0)
        if status_fields is not None and status_fields.protection is not None:
            status_fields.protection.before_first(self._payload)

    @property
    def own_keys(self) -> set[tuple[int, bool]]:
        """Identifiers of the messages that it makes itself: answers and status."""
        keys: set[tuple[int, bool]] = {target.key for source in self.sources.values() for target in source.targets}
        return keys if self._status_fields is None else {*keys, self._status_fields.key}

    @property
    def branch_keys(self) -> set[tuple[int, bool]]:
        """Identifiers of the messages that carry branches, which a gateway rewrites."""
        return {key for key, source in self.sources.items() if source.carries_branches}

    def put_in_force(self, *, reason: Reason, parameter_set: int, expected: ExpectedSum | None = None) -> None:
        """Begin with what the branches were just given; what was latched is released.

        Parameters
        ----------
        reason : Reason
            NONE if there are parameters that fit.
        parameter_set : int
            Its number as it is published; 0 where there is none.
        expected : ExpectedSum, optional
            What they say of the junction's sum.
        """
        self.reason, self.parameter_set = reason, parameter_set
        self.watch.restart(expected or ExpectedSum())
        self.latch(Reason.NONE)
        self.told = self.state()

    def look(self, now_s: float) -> None:
        """Look at the whole junction; to be called at least every 0.1 s."""
        if self.counters.foreign != self._foreign:
            self._foreign, self._foreign_until_s = self.counters.foreign, now_s + _FOREIGN_S
        self._beside = Reason.FOREIGN_FRAMES if now_s < self._foreign_until_s else Reason.NONE
        self._look(now_s)
        self.told = self.state()

    def _look(self, now_s: float) -> None:
        self._looked_s = now_s
        self._see_whether_asleep(now_s)
        self.watch.look(now_s)
        if self.reason is not Reason.NONE or self.latched is not Reason.NONE or self._silent:
            return
        if stale := [branch.name for branch in self.branches if self._is_missed(branch, now_s)]:
            self.latch(Reason.BRANCH_STALE, stale)
        elif verdict := self.watch.verdict():
            self.latch(*verdict)

    @property
    def is_asleep(self) -> bool:
        """Whether all branches are silent that were heard before."""
        return self._silent and self._was_awake

    def state(self) -> tuple[State, Reason]:
        """What the node does, and why."""
        reason = self.reason if self.reason is not Reason.NONE else self.latched
        if reason is not Reason.NONE:
            return State.PASSING_THROUGH, reason
        if self.is_asleep:
            return State.ASLEEP, Reason.NONE
        applied = [branch for branch in self.branches if branch.fault.applied]
        if self.shadow or not applied:
            return State.SHADOW if applied else State.PASSING_THROUGH, self._beside
        if any(branch.is_fitted and not branch.seen for branch in self.branches):
            return State.STARTING, Reason.NONE
        is_invalid = any(source.is_invalid for source in self.sources.values())
        if is_invalid or any(branch.lacks_input(self._looked_s) for branch in applied):
            return State.PARTLY_CORRECTING, Reason.E2E_INVALID if is_invalid else Reason.INPUT_MISSING
        return State.CORRECTING, self._beside

    def status(self) -> tuple[StatusFields, bytes] | None:
        """Make the status message from the last look; None if the layout has none."""
        fields = self._status_fields
        if fields is None:
            return None
        payload = self._payload
        state, reason = self.state()
        if reason > fields.places["reason"].highest:
            reason = _IN_4_BITS[reason]
        values = {"state": state, "reason": reason, "parameter_set": self.parameter_set, "alive_counter": self._alive}
        for key, place in fields.places.items():
            place.put(payload, values[key] % (place.highest + 1))
        self._alive += 1
        sums = self.watch.sums
        for key, (codes, missing) in fields.sums.items():
            total_a = None if sums is None else sums.measured_a if key == "sum_measured" else sums.corrected_a
            codes.place.put(payload, missing if total_a is None else codes.nearest(as_written(total_a)))
        if fields.protection is not None:
            fields.protection.advance(payload)
        return fields, bytes(payload)

    def _see_whether_asleep(self, now_s: float) -> None:
        """All branches silent: the vehicle goes to sleep, which is no fault.

        Once it sleeps, a branch that was silent or stuck is tried anew; what the sums said of the set in force stays.
        """
        silent = all(branch.is_old(now_s) for branch in self.branches)
        if not silent:
            self._silent_since_s = float("inf")
        elif self._silent_since_s == float("inf"):
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
        """Try again what was latched."""
        self.watch.forget()
        self.latch(Reason.NONE)

    def _is_missed(self, branch: LiveBranch, now_s: float) -> bool:
        """Whether a branch is stale while others are not: where all fall silent in turn, the vehicle goes to sleep."""
        return branch.is_stale(now_s) and any(other.time_s > branch.deadline_s for other in self.branches)

    def latch(self, reason: Reason, branches: Sequence[str] = ()) -> None:
        """Pass measured values through for this reason, which these branches explain; NONE: as the parameters say."""
        self.latched, self.latched_branches = reason, tuple(branches)
        active = self.reason is Reason.NONE and reason is Reason.NONE and not self.shadow
        for branch in self.branches:
            branch.activate(active=active, doubted=reason is Reason.SUM_IMPLAUSIBLE and branch.name in branches)
