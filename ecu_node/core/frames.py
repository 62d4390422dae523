"""Incoming messages and what the node makes of them, frame by frame.

A payload is read as one integer per byte order, in which each signal is a shift and a mask. An answer is the target's
last message with the branches of the frame written anew; a gateway's frame is the frame itself with its branches
written anew: one way for both. What does not change from frame to frame is looked up once per length of payload, and
again whenever a branch is corrected otherwise.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ecu_node.core.branch import REMEMBERED_FRAMES, Auxiliary, Frames, LiveBranch
from ecu_node.core.e2e import Check, E2EState, Protection, Receiver
from ecu_node.core.signals import BitPlace, FrameKey, Order, PlacedSignal
from ecu_node.core.status import Counters, Quality

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
        self._targets = tuple(targets)
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
            answers = [(target, [], list(target.written.values())) for target in self._targets]
        for target, passes, others in answers:
            made = self._rewritten(payload, target.data, passes, now_s)
            for written in others:
                word = written.write_known(int.from_bytes(made, written.order), now_s)
                made = bytearray(word.to_bytes(len(made), written.order))
            if target.advance is not None:
                target.advance(made)
            target.data = made
        self._counters.answers += len(answers)
        return self._targets

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
        for target in self._targets:
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
