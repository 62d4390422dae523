"""Frames of ordinary messages, quickly: functions made for one message, with all that they need bound to them.

Ordinary is a message of the length that the DBC says, whose branches need no voltage, are in every frame, and have one
byte order. Its payload is one integer. With the sign bits of two's complements turned over, a
code is an unsigned number less the weight of its sign bit, and ``word += (out - code) << shift`` writes one code in the
place of another. What is not ordinary the functions hand over to those of :mod:`ecu_node.frames`, before they change
anything.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from ecu_node.bits import Order, PlacedSignal
from ecu_node.branch import LiveBranch
from ecu_node.counters import Counters
from ecu_node.e2e import Protection, Receiver

if TYPE_CHECKING:
    from ecu_node.frames import Target

__all__ = ["Answer", "Forward", "Message", "QuickSignals", "quick_answer", "quick_forward", "quick_signals"]

Forward = Callable[[bytearray, float], bytearray | None]
Answer = Callable[[bytearray, float], Sequence["Target"]]


class _Field(NamedTuple):
    """One signal in the payload, and its plan."""

    shift: int
    ones: int
    sign: int
    lowest_in: int
    highest_in: int
    gain: int
    bias: int
    down: int
    lowest: int
    highest: int


class QuickSignals(NamedTuple):
    """All branches of a message."""

    order: Order
    signs: int
    """Their sign bits in the payload."""
    fields: tuple[_Field, ...]


def quick_signals(branches: Sequence[tuple[LiveBranch, PlacedSignal]], length: int) -> QuickSignals | None:
    """Put together what the functions need of the branches.

    Parameters
    ----------
    branches : sequence
        Each branch of the message, and where it stands.
    length : int
        Bytes of the message.

    Returns
    -------
    QuickSignals or None
        None if the message is not an ordinary one.
    """
    fields = [_field(branch, signal, length) for branch, signal in branches]
    orders = {signal.place.order for _, signal in branches}
    found = tuple(field for field in fields if field is not None)
    if len(found) < len(fields) or len(orders) != 1:
        return None
    return QuickSignals(orders.pop(), sum(field.sign << field.shift for field in found), found)


def _field(branch: LiveBranch, signal: PlacedSignal, length: int) -> _Field | None:
    word, codes, plan = signal.place.in_word(length), branch.codes, branch.plan
    if plan.voltage_gain or word is None or signal.above:
        return None
    lowest, highest = codes.lowest, codes.highest
    while lowest in codes.named:
        lowest += 1
    while highest in codes.named:
        highest -= 1
    if any(lowest <= code <= highest for code in codes.named):
        return None
    return _Field(
        shift=word.shift,
        ones=word.ones,
        sign=word.sign,
        lowest_in=lowest,
        highest_in=highest,
        gain=plan.gain,
        bias=plan.bias + (1 << (plan.shift - 1)),
        down=plan.shift,
        lowest=plan.lowest,
        highest=plan.highest,
    )


class Message(NamedTuple):
    """What a message's functions need beside its signals.

    Attributes
    ----------
    length : int
        Bytes.
    protection, receiver : Protection and Receiver, or None
        End-to-end protection.
    counters : Counters
        Where it is counted what happened.
    remember : callable
        Takes time and payload of every intact frame.
    """

    length: int
    protection: Protection | None
    receiver: Receiver | None
    counters: Counters
    remember: Callable[[tuple[float, bytearray]], None]


def quick_forward(signals: QuickSignals, message: Message, otherwise: Forward) -> Forward:
    """Make a gateway's function for one message.

    Parameters
    ----------
    signals : QuickSignals
        Its branches.
    message : Message
        What else is known of it.
    otherwise : callable
        Does the same for frames of any kind.

    Returns
    -------
    callable
        See :attr:`ecu_node.frames.Source.forward`.
    """
    order, signs, fields = signals
    length, _, _, counters, remember = message
    is_next, from_bytes = _in_order(message), int.from_bytes
    seal = message.protection.seal if message.protection is not None else None

    def forward(payload: bytearray, now_s: float) -> bytearray | None:
        if len(payload) != length or not is_next(payload):
            return otherwise(payload, now_s)
        counters.frames_in += 1
        remember((now_s, payload))
        word = from_bytes(payload, order) ^ signs
        for shift, ones, sign, lowest_in, highest_in, gain, bias, down, lowest, highest in fields:
            code = (word >> shift & ones) - sign
            if lowest_in <= code <= highest_in:
                out = (code * gain + bias) >> down
                if not lowest <= out <= highest:
                    out = lowest if out < lowest else highest
                    counters.saturated += 1
                word += (out - code) << shift
        rewritten = bytearray((word ^ signs).to_bytes(length, order))
        if rewritten == payload:
            return payload
        counters.rewritten += 1
        if seal is not None:
            seal(rewritten)
        return rewritten

    return forward


def quick_answer(signals: QuickSignals, message: Message, target: "Target", otherwise: Answer) -> Answer | None:
    """Make an overlay node's function for one message that one message answers.

    Parameters
    ----------
    signals, message, otherwise :
        As for :func:`quick_forward`.
    target : Target
        The message that answers it, with the same branches in the same order.

    Returns
    -------
    callable or None
        See :attr:`ecu_node.frames.Source.answer`; None if the target is not an ordinary one.
    """
    cells = _cells(target)
    if cells is None:
        return None
    target_order, good, places = cells
    order, signs, fields = signals
    pairs = tuple((*field, *place) for field, place in zip(fields, places, strict=True))
    length, _, _, counters, remember = message
    target_length, targets, from_bytes = len(target.data), (target,), int.from_bytes
    is_next, protection = _in_order(message), target.protection
    advance, counter_byte = (protection.advance, protection.counter_byte) if protection is not None else (None, 0)
    counter_bits = protection.counter_ones << protection.counter_shift if protection is not None else 0

    def answer(payload: bytearray, now_s: float) -> Sequence["Target"]:
        if len(payload) != length:
            return otherwise(payload, now_s)
        word, new, saturated = from_bytes(payload, order) ^ signs, good, 0
        for shift, ones, sign, lowest_in, highest_in, gain, bias, down, lowest, highest, to, width in pairs:
            code = (word >> shift & ones) - sign
            if not lowest_in <= code <= highest_in:
                return otherwise(payload, now_s)
            out = (code * gain + bias) >> down
            if not lowest <= out <= highest:
                out = lowest if out < lowest else highest
                saturated += 1
            new |= (out & width) << to
        if not is_next(payload):
            return otherwise(payload, now_s)
        counters.frames_in += 1
        counters.answers += 1
        counters.saturated += saturated
        remember((now_s, payload))
        made = bytearray(new.to_bytes(target_length, target_order))
        if advance is not None:
            made[counter_byte] |= target.data[counter_byte] & counter_bits
            advance(made)
        target.data = made
        return targets

    return answer


def _cells(target: "Target") -> tuple[Order, int, list[tuple[int, int]]] | None:
    """Byte order of a target, its payload with the quality of values and no value, and shift and ones of each value."""
    length, orders = len(target.data), {field.place.order for field in target.fields}
    words = [word for field in target.fields if (word := field.place.in_word(length)) is not None]
    if len(words) < len(target.fields) or len(orders) != 1:
        return None
    payload, order = bytearray(length), orders.pop()
    for field in target.fields:
        if field.quality is not None:
            field.quality.put(payload, field.branch.quality)
    return order, int.from_bytes(payload, order), [(word.shift, word.ones) for word in words]


def _in_order(message: Message) -> Callable[[bytearray], bool]:
    """Make a function that tells whether a frame is intact and the next one, and if so remembers it."""
    protection, receiver = message.protection, message.receiver
    if protection is None or receiver is None:
        return lambda _: True
    is_sound, modulus = protection.is_sound, protection.modulus
    byte, shift, ones = protection.counter_byte, protection.counter_shift, protection.counter_ones

    def is_next(payload: bytearray) -> bool:
        counter = payload[byte] >> shift & ones
        if counter != receiver.expected or not is_sound(payload):
            return False
        counter += 1
        receiver.expected = counter if counter < modulus else 0
        return True

    return is_next
