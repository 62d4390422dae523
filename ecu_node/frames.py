"""Incoming messages and what the node makes of them, frame by frame.

Here every frame is dealt with signal by signal, whatever it is. For intact frames of ordinary messages, which are
nearly all, :mod:`ecu_node.quick_frames` makes functions that do the same in a few integer operations.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ecu_node.auxiliary import Auxiliary
from ecu_node.bits import BitPlace, PlacedSignal
from ecu_node.branch import LiveBranch
from ecu_node.counters import Counters
from ecu_node.e2e import Check, Protection, Receiver
from ecu_node.past import REMEMBERED_FRAMES, Frames
from ecu_node.quick_frames import Answer, Forward, Message, quick_answer, quick_forward, quick_signals
from ecu_node.status import Quality

__all__ = ["FrameKey", "Reader", "Source", "Target", "TargetField"]

_LEAST_SILENCE_S = 1.0
"""After a silence of this long, or of a branch's timeout, a message's counter begins anew. [s]"""
_USABLE = frozenset((Check.OK, Check.LOST))
"""With these the content of a frame is new and intact."""


class FrameKey(NamedTuple):
    """Identifier of a frame; one number with 11 and with 29 bits are two identifiers."""

    identifier: int
    extended: bool


class Reader(NamedTuple):
    """Who reads a signal of an incoming message, and where it stands."""

    part: Auxiliary | LiveBranch
    signal: PlacedSignal


@dataclass(frozen=True, kw_only=True)
class TargetField:
    """Where one branch stands in a corrected message."""

    branch: LiveBranch
    place: BitPlace
    not_available: int
    """Code for "no value"."""
    quality: BitPlace | None


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
        self.key, self.fd, self.fields, self.protection = key, fd, fields, protection
        self.data = bytearray(length)
        """The message as it was made last; a new one each time."""
        if protection is not None:
            protection.before_first(self.data)

    def make(self, now_s: float) -> None:
        """Make the message anew; branches that are stale by now are not available in it."""
        payload = bytearray(self.data)
        for field in self.fields:
            branch = field.branch
            out, quality = branch.out, branch.quality
            if out is None:
                out, quality = field.not_available, branch.why_no_value()
            elif branch.is_old(now_s):
                out, quality = field.not_available, Quality.NOT_AVAILABLE
            field.place.put(payload, out)
            if field.quality is not None:
                field.quality.put(payload, quality)
        if self.protection is not None:
            self.protection.advance(payload)
        self.data = payload


class Source:
    """One incoming message, what is read from it and which messages answer it.

    Parameters
    ----------
    length : int
        Bytes of the message in the DBC.
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
    answer : callable
        Overlay: takes a frame, and makes the messages that answer it. Of the payload (bytearray; not to be changed, now
        or later) and the time when it came [s], the sequence of targets to be sent.
    forward : callable
        Gateway: takes a frame, and writes what the branches make of it in the place of what was measured. Of the same,
        the payload to send on, protected with the counter that the frame came with; None if it is held back.
    timeout_s : float
        Frames that are older when they are read are of no use; infinity for a message without branches. [s]
    """

    def __init__(
        self,
        *,
        length: int,
        protection: Protection | None,
        readers: Sequence[Reader],
        targets: Sequence[Target],
        counters: Counters,
        pass_on_invalid: bool,
    ) -> None:
        self._protection = protection
        self._receiver = Receiver(protection) if protection is not None else None
        self._targets = tuple(targets)
        self._auxiliaries = [(part, signal) for part, signal in readers if isinstance(part, Auxiliary)]
        self._branches = [(part, signal) for part, signal in readers if isinstance(part, LiveBranch)]
        self._counters, self._pass_on_invalid = counters, pass_on_invalid
        self._history: Frames = deque(maxlen=REMEMBERED_FRAMES)
        self._silence_s = max([_LEAST_SILENCE_S, *(branch.timeout_s for branch, _ in self._branches)])
        self._message = Message(length, protection, self._receiver, counters, self._history.append)
        self.timeout_s = max((branch.timeout_s for branch, _ in self._branches), default=float("inf"))
        for reader in readers:
            reader.part.follow(reader.signal, self._history)
        for branch, _ in self._branches:
            branch.when_changed.append(self._renew)
        self.answer: Answer = self._answer
        self.forward: Forward = self._forward

    def _renew(self) -> None:
        """Put together anew what is quick: a plan has changed."""
        self.answer, self.forward = self._answer, self._forward
        found = None if self._auxiliaries else quick_signals(self._branches, self._message.length)
        if found is None:
            return
        self.forward = quick_forward(found, self._message, self._forward)
        if len(self._targets) == 1:
            (target,) = self._targets
            if [field.branch for field in target.fields] == [branch for branch, _ in self._branches]:
                self.answer = quick_answer(found, self._message, target, self._answer) or self._answer

    def _answer(self, payload: bytearray, now_s: float) -> Sequence[Target]:
        counters = self._counters
        counters.frames_in += 1
        if self._checked(payload, now_s) in _USABLE:
            self._read(payload, now_s)
        elif self._pass_on_invalid:
            for branch, _ in self._branches:
                branch.spoil()
        else:
            return ()
        for target in self._targets:
            target.make(now_s)
            counters.answers += 1
        return self._targets

    def _forward(self, payload: bytearray, now_s: float) -> bytearray | None:
        counters = self._counters
        counters.frames_in += 1
        check = self._checked(payload, now_s)
        if check in _USABLE:
            self._read(payload, now_s)
        if not self._branches:
            return payload  # the node has nothing to write in it
        if check not in _USABLE and not self._pass_on_invalid:
            counters.held_back += 1
            return None
        if check is Check.CORRUPT:
            return payload
        rewritten = bytearray(payload)
        for branch, signal in self._branches:
            code = signal.code(payload)
            if code is not None:
                out = branch.out if check in _USABLE else branch.fixed(code)
                signal.place.put(rewritten, code if out is None else out)
        if rewritten == payload:
            return payload
        counters.rewritten += 1
        if self._protection is not None:
            self._protection.seal(rewritten)
        return rewritten

    def _checked(self, payload: bytearray, now_s: float) -> Check:
        """Check a frame, and count what is wrong with it; after a long silence its counter may be any."""
        receiver, counters = self._receiver, self._counters
        if receiver is None:
            return Check.OK
        if self._history and now_s - self._history[-1][0] > self._silence_s:
            receiver.expected = -1
        check = receiver.check(payload)
        counters.corrupt += check is Check.CORRUPT
        counters.repeated += check is Check.REPEATED
        counters.jumped += check is Check.JUMPED
        counters.gaps += check is Check.LOST
        return check

    def _read(self, payload: bytearray, now_s: float) -> None:
        """Dispatch the signals of a frame; auxiliary signals first, as corrections may need them."""
        self._history.append((now_s, payload))
        for auxiliary, signal in self._auxiliaries:
            code = signal.code(payload)
            if code is not None:
                auxiliary.take(code, now_s)
        for branch, signal in self._branches:
            code = signal.code(payload)
            if code is not None:
                branch.take(code)
            elif len(payload) < signal.end:
                branch.spoil()
                self._counters.short += 1
