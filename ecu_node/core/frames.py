"""Incoming messages and what the node makes of them, frame by frame.

A payload is read as one integer per byte order, in which each signal is a shift and a mask. What does not change from
frame to frame is looked up once: the places of signals per length of payload, the conversion of a branch whenever its
parameters change.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ecu_node.core.branch import REMEMBERED_FRAMES, Auxiliary, Frames, LiveBranch
from ecu_node.core.e2e import Check, E2EState, Protection, Receiver
from ecu_node.core.signals import BitPlace, Multiplexer, Order, PlacedSignal
from ecu_node.core.status import Counters, Quality

__all__ = ["FrameKey", "Reader", "Source", "Target", "TargetField"]


_OK, _LAST_USABLE, _CORRUPT = Check.OK, Check.LOST, Check.CORRUPT  # looking up members of an enumeration is slow
_INVALID = E2EState.INVALID
_LEAST_SILENCE_S = 1.0
"""After a silence of this long, or of a branch's timeout, a message's counter begins anew. [s]"""


class _Extra(NamedTuple):
    """What few branches have."""

    above: tuple[Multiplexer, ...]
    named: frozenset[int]
    """Codes amid the values that have a name."""
    voltage: Auxiliary | None
    voltage_gain: int

    def is_in(self, payload: bytearray) -> bool:
        """Whether the multiplexers say that the branch is in this frame."""
        return all(item.place.extract(payload) in item.codes for item in self.above)

    def term(self, code: int, bias: int) -> int | None:
        """The plan's bias, with the voltage's part; None if the code or the voltage is no value."""
        if code in self.named:
            return None
        if self.voltage is None:
            return bias
        return None if self.voltage.code is None else bias + self.voltage.code * self.voltage_gain


_SourceCell = tuple[LiveBranch, int, int, int, int, int, int, int, int, int, int, _Extra | None]
"""A branch; its shift, ones and sign (:class:`~ecu_node.core.signals.WordField`); its least and highest value; gain,
bias, shift, lowest and highest result (:class:`~ecu_node.core.correction.IntegerPlan`); and what few branches have."""
_TargetCell = tuple[LiveBranch, int, int, int, tuple[int, ...]]
"""A branch, its shift and ones, its code for "no value", and the bits of each quality in the payload."""


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
        self.key, self.fd = key, fd
        self.data = bytearray(length)
        """The message as it was made last; a new one each time."""
        self.branches = [field.branch for field in fields]
        if protection is not None:
            protection.before_first(self.data)
        self._length, self._advance = length, None if protection is None else protection.advance
        self._counter_byte, self._counter_bits = (
            (0, 0)
            if protection is None
            else (protection.counter_byte, protection.counter_ones << protection.counter_shift)
        )
        self._words = [(order, _placed(fields, order, length)) for order in {field.place.order for field in fields}]

    def make(self, now_s: float, *, is_fresh: bool = False) -> None:
        """Make the message anew; unless all branches were just taken from a frame, one may be stale: no value."""
        payload = b""
        for order, cells in self._words:
            word = int.from_bytes(payload, order) if payload else 0
            for branch, shift, ones, not_available, quality_bits in cells:
                out, quality = branch.out, branch.quality
                if out is None:
                    out, quality = not_available, branch.why_no_value()
                elif not is_fresh and branch.is_old(now_s):
                    out, quality = not_available, Quality.NOT_AVAILABLE
                word |= (out & ones) << shift | quality_bits[quality]
            payload = word.to_bytes(self._length, order)
        made = bytearray(payload)
        if self._advance is not None:
            made[self._counter_byte] |= self.data[self._counter_byte] & self._counter_bits
            self._advance(made)
        self.data = made


def _placed(fields: Sequence[TargetField], order: Order, length: int) -> list[_TargetCell]:
    """Where the branches of one byte order stand in payloads of some length [byte], and the bits of each quality."""
    cells = []
    for field in fields:
        if field.place.order == order:
            payloads = [bytearray(length) for _ in Quality]
            for quality, payload in zip(Quality, payloads, strict=True):
                if field.quality is not None:
                    field.quality.put(payload, min(quality, field.quality.highest))
            bits = tuple(int.from_bytes(payload, order) for payload in payloads)
            place = field.place.in_word(length)
            cells.append((field.branch, place.shift, place.ones, field.not_available, bits))
    return cells


@dataclass(frozen=True, kw_only=True)
class _Places:
    """The branches in payloads of one length."""

    words: list[tuple[Order, list[_SourceCell]]]
    """Per byte order its branches."""
    missing: list[LiveBranch]
    """Branches that such a payload is too short for."""
    targets: list[tuple[Target, bool]]
    """Messages that answer it, and whether all their branches are in each such payload."""


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
        self._auxiliaries = [(part, signal) for part, signal in readers if isinstance(part, Auxiliary)]
        self._branches = [(part, signal) for part, signal in readers if isinstance(part, LiveBranch)]
        self._counters, self._pass_on_invalid = counters, pass_on_invalid
        self._history: Frames = deque(maxlen=REMEMBERED_FRAMES)
        self._silence_s = max([_LEAST_SILENCE_S, *(branch.timeout_s for branch, _ in self._branches)])
        self._places: dict[int, _Places] = {}
        self.timeout_s = max((branch.timeout_s for branch, _ in self._branches), default=float("inf"))
        for reader in readers:
            reader.part.follow(reader.signal, self._history)
        for branch, _ in self._branches:
            branch.when_changed.append(self._places.clear)

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
        places = self._places.get(len(payload)) or self._find(len(payload))
        if self._convert(payload, now_s, places) > _LAST_USABLE:
            if not self._pass_on_invalid:
                return ()
            for branch, _ in self._branches:
                branch.spoil()
        for target, is_fresh in places.targets:
            target.make(now_s, is_fresh=is_fresh)
        self._counters.answers += len(self._targets)
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
            To be sent on, protected with the counter that the frame came with; None if it is held back.
        """
        places = self._places.get(len(payload)) or self._find(len(payload))
        rewritten = bytearray(payload)
        check = self._convert(payload, now_s, places, rewritten)
        if check > _LAST_USABLE and self._branches and not self._pass_on_invalid:
            self._counters.held_back += 1
            return None
        if check is _CORRUPT or rewritten == payload:
            return payload
        self._counters.rewritten += 1
        if self._seal is not None:
            self._seal(rewritten)
        return rewritten

    def _convert(  # noqa: PLR0912 (in one piece, as each call costs a tenth of it)
        self, payload: bytearray, now_s: float, places: _Places, rewritten: bytearray | None = None
    ) -> Check:
        """Check a frame and convert its branches: the only way of a frame through the node.

        Parameters
        ----------
        payload : bytearray
            Of the frame.
        now_s : float
            When it came. [s]
        places : _Places
            Where the branches stand in it.
        rewritten : bytearray or None
            A copy of the payload, in which results are written in the place of the codes that are values.

        Returns
        -------
        Check
            What is not usable leaves the branches as they were.
        """
        counters, history, check = self._counters, self._history, _OK
        counters.frames_in += 1
        if self._receiver is not None:
            if history and now_s - history[-1][0] > self._silence_s:
                self._receiver.restart()
            check = self._receiver.check(payload)
            if check is not _OK:
                counters.corrupt += check is Check.CORRUPT
                counters.repeated += check is Check.REPEATED
                counters.jumped += check is Check.JUMPED
                counters.gaps += check is Check.LOST
        is_usable = check <= _LAST_USABLE
        if is_usable:
            history.append((now_s, payload))
            for auxiliary, signal in self._auxiliaries:  # before the branches, which may need a voltage
                code = signal.code(payload)
                if code is not None:
                    auxiliary.take(code, now_s)
            for branch in places.missing:
                branch.spoil()
                counters.short += 1
            if rewritten is None and self.is_invalid:  # a receiver of a gateway's frames judges for itself
                for branch, _ in self._branches:
                    branch.spoil()
                return check
        elif rewritten is None or check is _CORRUPT or not self._pass_on_invalid:
            return check
        for order, cells in places.words:
            word = int.from_bytes(payload if rewritten is None else rewritten, order)
            for branch, shift, ones, sign, first, last, gain, bias, down, low, high, extra in cells:
                code = ((word >> shift & ones) ^ sign) - sign
                out: int | None = None
                term: int | None = bias
                if extra is not None:
                    if not extra.is_in(payload):
                        continue
                    term = extra.term(code, bias)
                if term is not None and first <= code <= last:
                    out = (code * gain + term) >> down
                    if not low <= out <= high:
                        out = low if out < low else high
                        counters.saturated += 1
                if rewritten is None:
                    branch.out, branch.is_spoilt = out, False
                elif out is not None:
                    word ^= ((code ^ out) & ones) << shift
            if rewritten is not None:
                rewritten[:] = word.to_bytes(len(rewritten), order)
        return check

    def _find(self, length: int) -> _Places:
        """Find the branches in payloads of some length, with what is done to each. [byte]"""
        present = [(branch, signal) for branch, signal in self._branches if signal.end <= length]
        words = [
            (order, [_cell(*item, length) for item in present if item[1].place.order == order])
            for order in {signal.place.order for _, signal in present}
        ]
        always = {branch for branch, signal in present if not signal.above}
        found = self._places[length] = _Places(
            words=words,
            missing=[branch for branch, signal in self._branches if signal.end > length],
            targets=[(target, always.issuperset(target.branches)) for target in self._targets],
        )
        return found


def _cell(branch: LiveBranch, signal: PlacedSignal, length: int) -> _SourceCell:
    plan, codes = branch.plan, branch.codes
    first, last = codes.lowest, codes.highest
    while first in codes.named:
        first += 1
    while last in codes.named:
        last -= 1
    named = frozenset(code for code in codes.named if first <= code <= last)
    voltage = branch.voltage if plan.needs_voltage else None
    extra = _Extra(signal.above, named, voltage, plan.voltage_gain) if signal.above or named or voltage else None
    word, half = signal.place.in_word(length), 1 << (plan.shift - 1)
    return branch, *word, first, last, plan.gain, plan.bias + half, plan.shift, plan.lowest, plan.highest, extra
