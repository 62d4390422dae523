"""The expected output of the node for each frame, by cantools (signals) and fractions (correction), in both modes.

The exact code is rounded, halves up; that of the node may be of a value greater by less than 2^-10 of a code.
Which frames are intact and in order is taken from the node's receiver, which test_e2e.py compares with AUTOSAR.
"""

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from math import floor
from typing import Any, NamedTuple

from cantools.database.can import Message, Signal
from cantools.database.errors import DecodeError

from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.core.e2e import Check, E2EState, Receiver, protection_of
from ecu_node.core.status import Quality
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Branch
from ecu_node.parameters import BranchParameters, VehicleParameters
from tests.ecu_node.random_vehicles import Codes, mask_of

_TOLERANCE = Fraction(1, 1024)
"""Share of a code by which the value that the node rounds may exceed the exact one."""


class _Outcome(NamedTuple):
    """Least and greatest code expected of a branch, None for no value, and its quality."""

    allowed: tuple[int, int] | None
    quality: Quality


def _end(message: Message, signal: Signal) -> int:
    """Bytes that a frame needs to have a signal, and the selector that tells whether it is there."""
    selectors = [item for item in message.signals if item.is_multiplexer and signal.multiplexer_ids]
    return max((mask_of(item).bit_length() + 7) // 8 for item in (signal, *selectors))


def _codes(message: Message, data: bytes) -> dict[str, int]:
    """Codes of the signals that are whole in a payload, by cantools."""
    whole = data.ljust(message.length, b"\0")
    found: Any
    try:
        found = message.decode(whole, decode_choices=False, scaling=False)
    except DecodeError:  # a page that the DBC does not have
        others = [signal for signal in message.signals if not signal.multiplexer_ids and not signal.is_multiplexer]
        plain = Message(message.frame_id, message.name, message.length, others)
        found = plain.decode(whole, decode_choices=False, scaling=False)
    names = [item.name for item in message.signals if item.name in found and _end(message, item) <= len(data)]
    return {name: found[name] for name in names}


class _Branch:
    """One branch in one mode, with the output expected for its last frame."""

    def __init__(self, database: VehicleDatabase, branch: Branch, fault: BranchParameters, mode: Mode) -> None:
        self.sign, self.is_power = branch.sign, branch.power is not None
        self.message, self.source = database.signal(branch.source)
        self.codes = Codes(self.source, branch.no_value)
        self.target = database.signal(branch.corrected) if branch.corrected else None
        self.quality = database.signal(branch.quality)[1] if branch.quality else None
        self._published_as = self.codes
        if mode is Mode.OVERLAY and self.target is not None:
            self._published_as = Codes(self.target[1])
        self._drift, self._offset_a = (Fraction(str(number)) for number in (fault.drift, fault.offset_a))
        self.corrects = fault.apply and bool(self._drift or self._offset_a)
        self.outcome, self._seen = _Outcome(None, Quality.NOT_AVAILABLE), False

    def spoil(self) -> None:
        """Note that a frame came that must not be used."""
        if self._seen:
            self.outcome = _Outcome(None, Quality.INVALID)

    def lose_voltage(self) -> None:
        """Note that the voltage came in a message that must not be used."""
        if self.corrects and self.is_power and self._offset_a and self.outcome.allowed is not None:
            self.outcome = _Outcome(None, Quality.NOT_AVAILABLE)

    def take(self, code: int, volts: Fraction | None) -> None:
        """Take the code of an intact frame, and the voltage at its time; None if no voltage is known."""
        self._seen = True
        if not self.codes.is_value(code):
            is_named = code in self.codes.gaps
            self.outcome = _Outcome(None, Quality.NOT_AVAILABLE if is_named else Quality.INVALID)
        elif self.corrects and self.is_power and self._offset_a and volts is None:
            self.outcome = _Outcome(None, Quality.NOT_AVAILABLE)
        elif not self.corrects and self._published_as is self.codes:
            self.outcome = _Outcome((code, code), Quality.PASSED_THROUGH)
        else:
            self.outcome = self._published(self.codes.worth(code), volts)

    def _published(self, measured: Fraction, volts: Fraction | None) -> _Outcome:
        """Return the outcome for a value: i = (i_m - o) / (1 + d) in the sensor's own sign; a power, times volts."""
        if self.corrects:
            u = (volts or Fraction(0)) if self.is_power else Fraction(1)
            measured = (measured - self.sign * self._offset_a * u) / (1 + self._drift)
        exact = self._published_as.exact_code(measured) + Fraction(1, 2)
        lowest, highest = self._published_as.ends
        least, most = (min(max(floor(value), lowest), highest) for value in (exact, exact + _TOLERANCE))
        return _Outcome((least, most), Quality.CORRECTED if self.corrects else Quality.PASSED_THROUGH)


class Oracle:
    """Follows the frames of a vehicle in one mode.

    Parameters
    ----------
    database, parameters, mode : VehicleDatabase, VehicleParameters, Mode
        As the node has them.
    """

    def __init__(self, database: VehicleDatabase, parameters: VehicleParameters, mode: Mode) -> None:
        layout, no_fault = database.layout, BranchParameters(drift=0.0, offset_a=0.0, apply=False)
        self._is_gateway = mode is Mode.GATEWAY
        self._branches = [
            _Branch(database, branch, parameters.branches.get(branch.name, no_fault), mode) for branch in layout.branch
        ]
        names = {item.message.name for item in self._branches}
        names |= {item.target[0].name for item in self._branches if item.target is not None}
        voltages = [branch.voltage for branch in layout.branch if branch.voltage is not None]
        self._voltage = database.signal(voltages[0]) if voltages else None
        self._volts: Fraction | None = None
        if self._voltage is not None:
            names.add(self._voltage[0].name)
        messages = [database.message(name) for name in names]
        self._messages = {item.frame_id | item.is_extended_frame << 31: item for item in messages}
        found = {item.name: protection_of(database, item) for item in messages}
        self._protections = {name: protection for name, protection in found.items() if protection is not None}
        self._receivers = {name: Receiver(found) for name, found in self._protections.items()}
        self._counters = dict.fromkeys(names, -1)

    def problem(self, identifier: int, data: bytes, sent: Sequence[tuple[int, bytes]]) -> str | None:
        """Take a frame and what the node sent for it.

        Parameters
        ----------
        identifier : int
            Of the frame; bit 31 is set if it has 29 bits.
        data : bytes
            Its payload.
        sent : sequence of (int, bytes)
            Identifiers and payloads of what was sent.

        Returns
        -------
        str or None
            What is wrong; None if all is well.
        """
        message = self._messages[identifier]
        own, receiver = [item for item in self._branches if item.message is message], self._receivers.get(message.name)
        check = receiver.check(bytearray(data)) if receiver is not None else Check.OK
        codes, is_new = _codes(message, data), check <= Check.LOST
        is_invalid = receiver is not None and receiver.state is E2EState.INVALID
        if self._voltage is not None and self._voltage[0] is message:
            net = self._voltage[1]  # it comes before the branches of the same frame
            if is_invalid or (is_new and len(data) < _end(message, net)):
                self._volts = None
                for item in self._branches:
                    item.lose_voltage()
            elif is_new and net.name in codes:
                is_value = Codes(net).is_value(codes[net.name])
                self._volts = Codes(net).worth(codes[net.name]) if is_value else None
        for item in own if is_new else ():
            if len(data) < _end(message, item.source):  # bits are beyond the end
                item.spoil()
            elif item.source.name in codes:
                item.take(codes[item.source.name], self._volts)
        if self._is_gateway:
            if is_new:
                return self._rewritten(message, own, data, sent)
            expected = [] if own else [(identifier, data)]
            return None if sent == expected else f"a frame that is {check.name} was not stopped or left alone"
        if not is_new:
            return f"a frame that is {check.name} was answered" if sent else None
        for item in own if is_invalid else ():
            item.spoil()
        wanted = {item.target[0].name for item in own if item.target is not None}
        answered = [self._messages[number].name for number, _ in sent]
        if sorted(answered) != sorted(wanted):
            return f"frames {answered} were sent, must be {sorted(wanted)}"
        problems = (self._wrong_answer(self._messages[number], answer) for number, answer in sent)
        return next((text for text in problems if text is not None), None)

    def _rewritten(
        self, message: Message, own: Sequence[_Branch], data: bytes, sent: Sequence[tuple[int, bytes]]
    ) -> str | None:
        """Say what is wrong with a frame that a gateway passes on; None if nothing is."""
        if len(sent) != 1 or self._messages.get(sent[0][0]) is not message or len(sent[0][1]) != len(data):
            return "another frame was sent"
        before, protection = _codes(message, data), self._protections.get(message.name)
        sources = {item.source.name: item for item in own if item.source.name in before}
        allowed = {item.source: item.outcome.allowed or (before[name], before[name]) for name, item in sources.items()}
        return self._wrong_frame(message, data, sent[0][1], allowed, protection.counter_of(data) if protection else 0)

    def _wrong_answer(self, message: Message, data: bytes) -> str | None:
        """Say what is wrong with a frame that an overlay node sends; None if nothing is."""
        allowed, protection = dict[Signal, tuple[int, int]](), self._protections.get(message.name)
        for item in self._branches:
            if item.target is not None and item.target[0] is message:
                target, quality = item.target[1], item.outcome.quality
                missing = next(code for code, text in (target.choices or {}).items() if text == "SNA")
                allowed[target] = item.outcome.allowed or (missing, missing)
                if item.quality is not None:
                    allowed[item.quality] = quality, quality
        if protection is not None:
            self._counters[message.name] = (self._counters[message.name] + 1) % protection.modulus
        return self._wrong_frame(message, bytes(len(data)), data, allowed, self._counters[message.name])

    def _wrong_frame(
        self, message: Message, before: bytes, made: bytes, allowed: Mapping[Signal, tuple[int, int]], counter: int
    ) -> str | None:
        """What is wrong with the signals, the protection, or the other bits of a frame that the node made."""
        codes, mask, protection = _codes(message, made), 0, self._protections.get(message.name)
        for signal, (lowest, highest) in allowed.items():
            if not lowest <= codes[signal.name] <= highest:
                return f"{signal.name} is {codes[signal.name]}, must be {lowest} to {highest}"
            mask |= mask_of(signal)
        if made != before and protection is not None:
            mask |= protection.header_mask
            if not protection.is_sound(bytearray(made)) or protection.counter_of(made) != counter:
                return f"{message.name}: wrong CRC or counter"
        changed = (int.from_bytes(before, "little") ^ int.from_bytes(made, "little")) & ~mask
        return f"bits {changed:X} changed, which are nobody's business" if changed else None


def require_right(
    database: VehicleDatabase, parameters: VehicleParameters, mode: Mode, frames: Iterable[tuple[int, bytes]]
) -> None:
    """Send frames, a millisecond apart, through the node's core, and compare the output for each with the oracle."""
    oracle = Oracle(database, parameters, mode)
    corrector = wire(database, InForce(parameters=parameters), 0.0, mode=mode)
    sources = {key[0] | key[1] << 31: source for key, source in corrector.sources.items()}
    for number, (identifier, data) in enumerate(frames):
        source, payload = sources[identifier], bytearray(data)
        if mode is Mode.GATEWAY:
            made = source.forward(payload, 1e-3 * number)
            sent = [] if made is None else [(identifier, bytes(made))]
        else:
            answers = source.answer(payload, 1e-3 * number)
            sent = [(item.key[0] | item.key[1] << 31, bytes(item.data)) for item in answers]
        shown = " ".join(f"{key:X}#{answer.hex()}" for key, answer in sent) or "nothing"
        place, problem = f"{mode.name.lower()}, frame {number}", oracle.problem(identifier, data, sent)
        assert problem is None, f"{place}: {identifier:X}#{data.hex()} -> {shown}: {problem}"
        assert payload == data, "what came in is not changed"
