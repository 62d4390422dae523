"""What must come of every frame: cantools for the signals, exact integers for the correction, nothing of the node's.

Rounding: the exact value, halves up. The node may come out as if the value were greater by less than 2^-10 of a code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm
from typing import NamedTuple

from cantools.database.can import Message

from bench.node_fuzz_protection import CheckState
from bench.node_fuzz_vehicles import FuzzBranch, FuzzMessage, FuzzSignal, FuzzVehicle, zero_code
from ecu_node.bus.wiring import Mode
from ecu_node.core.status import Quality
from ecu_node.database import VehicleDatabase

__all__ = ["FuzzFrame", "Oracle"]

_FACTORS = {"mA": Fraction(1, 1000), "kW": Fraction(1000)}
_TOLERANCE = 1024
"""One over the largest error of the node's integers. [1/code]"""


class FuzzFrame(NamedTuple):
    """One frame on the bus."""

    identifier: int
    extended: bool
    data: bytes
    fd: bool = False
    bitrate_switch: bool = False
    remote: bool = False
    error: bool = False
    dlc: int = 0

    @property
    def key(self) -> tuple[int, bool]:
        """Identifier, and whether it has 29 bits."""
        return self.identifier, self.extended

    def text(self) -> str:
        """All of it, for a report."""
        kind = "error " if self.error else "remote " if self.remote else "FD " if self.fd else ""
        return f"{kind}{self.identifier:0{8 if self.extended else 3}X}#{self.data.hex().upper()} (dlc {self.dlc})"


class _Line(NamedTuple):
    """code_out = (of_code * code + of_voltage * voltage_code + constant) / common."""

    of_code: int
    of_voltage: int
    constant: int
    common: int

    def allowed(self, code: int, voltage: int, ends: tuple[int, int]) -> tuple[int, int]:
        """Least and greatest code that may come out."""
        value = self.of_code * code + self.of_voltage * voltage + self.constant
        least = (2 * value + self.common) // (2 * self.common)
        most = (_TOLERANCE * (2 * value + self.common) + 2 * self.common) // (2 * _TOLERANCE * self.common)
        lowest, highest = ends
        return min(max(least, lowest), highest), min(max(most, lowest), highest)


class _Outcome(NamedTuple):
    """Least and greatest code that may come of a branch, None for no value, and its quality."""

    allowed: tuple[int, int] | None
    quality: Quality


@dataclass(frozen=True)
class _Worth:
    """What the codes of a signal are worth in A, W, V or degC, and which of them are values."""

    scale: Fraction
    offset: Fraction
    lowest: int
    highest: int
    named: frozenset[int]

    def is_value(self, code: int) -> bool:
        return self.lowest <= code <= self.highest and code not in self.named


def _worth(signal: FuzzSignal) -> _Worth:
    factor = _FACTORS.get(signal.unit, Fraction(1))
    lowest, highest = signal.range or signal.width_range
    named = frozenset((*signal.named, *signal.unnamed))
    return _Worth(Fraction(signal.scale) * factor, Fraction(signal.offset) * factor, lowest, highest, named)


def _ends(signal: FuzzSignal) -> tuple[int, int]:
    """Ends of the values around zero, in which results are kept."""
    worth, zero = _worth(signal), zero_code(signal)
    lowest = max([worth.lowest, *(code + 1 for code in worth.named if code < zero)])
    return lowest, min([worth.highest, *(code - 1 for code in worth.named if code > zero)])


class _Branch:
    """One branch in one mode: its last code, and what must come of it."""

    def __init__(self, branch: FuzzBranch, mode: Mode) -> None:
        self.branch, self._mode = branch, mode
        self.worth = _worth(branch.source)
        selector = branch.message.multiplexer if branch.source.above is not None else None
        self.least_size = max(branch.source.end, selector.end if selector is not None else 0)
        overlay = mode is Mode.OVERLAY and branch.target is not None
        self._target = branch.target[1] if overlay and branch.target is not None else branch.source
        self._out, self._ends = _worth(self._target), _ends(self._target)
        self._volts = _worth(branch.voltage[1]) if branch.voltage is not None else None
        self._corrects = branch.known and branch.apply and (branch.drift, branch.offset_a) != (0.0, 0.0)
        fault = (branch.drift, branch.offset_a) if self._corrects else (0.0, 0.0)
        self._line = self._exact_line(*(Fraction(str(number)) for number in fault))
        self._seen = False
        self._outcomes = [_Outcome(None, Quality.NOT_AVAILABLE)]

    @property
    def allowed(self) -> tuple[int, int] | None:
        """Least and greatest code of its last frame; None if there is no value."""
        return self._outcomes[0].allowed

    def is_right(self, code: int, quality: int | None, missing: int) -> bool:
        """Whether code and quality, where there is one, fit each other and the branch; `missing` says "no value"."""
        for outcome in self._outcomes if self._seen else (_Outcome(None, Quality.NOT_AVAILABLE),):
            lowest, highest = outcome.allowed or (missing, missing)
            if lowest <= code <= highest and quality in {None, outcome.quality}:
                return True
        return False

    def expected(self) -> str:
        """What must come of it, in words."""
        return " or ".join(f"{allowed or 'no value'} {quality.name}" for allowed, quality in self._outcomes)

    def spoil(self) -> None:
        """A frame came that must not be used."""
        self._outcomes = [_Outcome(None, Quality.INVALID)]

    def take(self, code: int, voltage: int | None) -> None:
        """Take the code of an intact frame."""
        self._seen, self._outcomes = True, [self._outcome(code, voltage)]

    def _outcome(self, code: int, voltage: int | None) -> _Outcome:
        if not self.worth.is_value(code):
            return _Outcome(None, Quality.NOT_AVAILABLE if code in self.worth.named else Quality.INVALID)
        if self._corrects and self._volts is not None and self.branch.offset_a != 0.0 and voltage is None:
            return _Outcome(None, Quality.NOT_AVAILABLE)
        if not self._corrects and self._target is self.branch.source:
            return _Outcome((code, code), Quality.PASSED_THROUGH)
        quality = Quality.CORRECTED if self._corrects else Quality.PASSED_THROUGH
        return _Outcome(self._line.allowed(code, voltage or 0, self._ends), quality)

    def _exact_line(self, drift: Fraction, offset_a: Fraction) -> _Line:
        gain = 1 / (1 + drift) / self._out.scale
        own = self.branch.sign * offset_a
        of_voltage, at_zero = (Fraction(0), own)
        if self._volts is not None:
            of_voltage, at_zero = -own * self._volts.scale * gain, own * self._volts.offset
        constant = (self.worth.offset - at_zero) * gain - self._out.offset / self._out.scale
        of_code = self.worth.scale * gain
        common = lcm(of_code.denominator, of_voltage.denominator, constant.denominator)
        return _Line(int(of_code * common), int(of_voltage * common), int(constant * common), common)


class _Source:
    """One incoming message."""

    def __init__(self, message: FuzzMessage, definition: Message) -> None:
        self.message, self.definition = message, definition
        self.state = CheckState(message.protection)

    def codes(self, data: bytes) -> dict[str, int]:
        """Codes of the signals that a payload has, by cantools."""
        message = self.message
        if len(data) >= message.size:
            return self.definition.decode(data, decode_choices=False, scaling=False)  # type: ignore[return-value]
        # cut off: bit by bit, as cantools needs all of the multiplexers
        selector = message.multiplexer
        chosen = selector.code(data) if selector is not None and selector.end <= len(data) else None
        return {
            signal.name: signal.code(data)
            for signal in message.signals
            if signal.end <= len(data) and (signal.above is None or chosen in signal.above)
        }


class Oracle:
    """Follows a bus in one mode, frame by frame.

    Parameters
    ----------
    vehicle : FuzzVehicle
        Whose frames they are.
    database : VehicleDatabase
        The same for cantools.
    mode : Mode
        What the node does.
    """

    def __init__(self, vehicle: FuzzVehicle, database: VehicleDatabase, mode: Mode) -> None:
        self._vehicle, self._gateway = vehicle, mode is Mode.GATEWAY
        self._passes_invalid = vehicle.on_bad_frame == "invalid"
        self._branches = [_Branch(branch, mode) for branch in vehicle.branches]
        read = [branch.message.name for branch in vehicle.branches]
        auxiliaries = [branch.voltage for branch in vehicle.branches if branch.voltage is not None]
        self._voltage = auxiliaries[0] if auxiliaries else None
        read += [] if self._voltage is None else [self._voltage[0].name]
        self._sources = {
            message.key: _Source(message, database.message(message.name))
            for message in vehicle.sources
            if message.name in read
        }
        self._targets = {message.name: (message, database.message(message.name)) for message in vehicle.targets}
        self._counters = dict.fromkeys(self._targets, -1)
        self._voltage_code: int | None = None

    def problem(self, frame: FuzzFrame, sent: Sequence[FuzzFrame]) -> str | None:
        """Take a frame and what the node sent for it.

        Parameters
        ----------
        frame : FuzzFrame
            What came.
        sent : sequence of FuzzFrame
            What the node sent.

        Returns
        -------
        str or None
            What is wrong; None if all is well.
        """
        source = self._sources.get(frame.key)
        if frame.error:
            return "an error frame was answered" if sent else None
        if source is None or frame.remote:
            expected = [frame] if self._gateway else []
            return None if list(sent) == expected else "a frame that is nobody's business was not left alone"
        found = source.state.take(frame.data)
        codes = source.codes(frame.data)
        if found == "usable":
            self._take_voltage(source, codes)
        if found == "usable" or (self._gateway and self._passes_invalid and found == "out of order"):
            self._take_branches(source, codes, len(frame.data))
            if not self._gateway and source.state.is_invalid:
                for branch in self._own(source):
                    branch.spoil()
            return self._rewritten(source, codes, frame, sent) if self._gateway else self._answered(source, sent)
        if self._gateway:
            expected = [frame] if self._passes_invalid or not self._own(source) else []
            return None if list(sent) == expected else f"a frame that is {found} was not held back or left alone"
        if not self._passes_invalid:
            return f"a frame that is {found} was answered" if sent else None
        for branch in self._own(source):
            branch.spoil()
        return self._answered(source, sent)

    def _own(self, source: _Source) -> list[_Branch]:
        return [branch for branch in self._branches if branch.branch.message is source.message]

    def _take_voltage(self, source: _Source, codes: dict[str, int]) -> None:
        """Take the voltage; it comes before the branches of the same frame."""
        if self._voltage is not None and self._voltage[0] is source.message and self._voltage[1].name in codes:
            code = codes[self._voltage[1].name]
            self._voltage_code = code if _worth(self._voltage[1]).is_value(code) else None

    def _take_branches(self, source: _Source, codes: dict[str, int], size: int) -> None:
        """Take the branches; one whose bits are beyond the end has no value."""
        for branch in self._own(source):
            if size < branch.least_size:
                branch.spoil()
            elif branch.branch.source.name in codes:
                branch.take(codes[branch.branch.source.name], self._voltage_code)

    def _rewritten(
        self, source: _Source, codes: dict[str, int], frame: FuzzFrame, sent: Sequence[FuzzFrame]
    ) -> str | None:
        if len(sent) != 1:
            return f"{len(sent)} frames were sent for one"
        (out,) = sent
        if out == frame:
            after = codes
        elif out._replace(data=frame.data) != frame or len(out.data) != len(frame.data):
            return "more than the payload was changed"
        else:
            after = source.codes(out.data)
        mask = 0
        for branch in self._own(source):
            signal = branch.branch.source
            if signal.name not in codes:
                continue
            allowed = branch.allowed or (codes[signal.name],) * 2
            if not allowed[0] <= after[signal.name] <= allowed[1]:
                return f"{signal.name} is {after[signal.name]}, must be {allowed}, was {codes[signal.name]}"
            mask |= signal.mask
        protection = source.message.protection
        if out.data != frame.data and protection is not None:
            mask |= protection.mask
            if not protection.sound(bytearray(out.data)) or protection.counter(out.data) != protection.counter(
                frame.data
            ):
                return "the rewritten frame has a wrong CRC, or another counter"
        changed = int.from_bytes(out.data, "little") ^ int.from_bytes(frame.data, "little")
        return f"bits {changed & ~mask:X} changed, which are nobody's business" if changed & ~mask else None

    def _answered(self, source: _Source, sent: Sequence[FuzzFrame]) -> str | None:
        in_layout, own = (
            dict.fromkeys(branch.branch.target[0].name for branch in branches if branch.branch.target is not None)
            for branches in (self._branches, self._own(source))
        )
        names = [name for name in in_layout if name in own]
        if len(sent) != len(names):
            return f"{len(sent)} frames were sent, must be {len(names)}"
        for name, out in zip(names, sent, strict=True):
            found = self._wrong_answer(name, out)
            if found is not None:
                return f"{name}: {out.text()}: {found}"
        return None

    def _wrong_answer(self, name: str, out: FuzzFrame) -> str | None:
        message, definition = self._targets[name]
        if out.key != message.key or len(out.data) != message.size:
            return "wrong identifier or length"
        codes: dict[str, int] = definition.decode(out.data, decode_choices=False, scaling=False)  # type: ignore[assignment]
        mask = 0
        for branch in self._branches:
            target = branch.branch.target
            if target is None or target[0] is not message:
                continue
            _, signal, quality = target
            missing = next(code for code, text in signal.named.items() if text == "SNA")
            told = codes[quality.name] if quality is not None else None
            if not branch.is_right(codes[signal.name], told, missing):
                return f"{signal.name} is {codes[signal.name]} of quality {told}, must be {branch.expected()}"
            mask |= signal.mask | (quality.mask if quality is not None else 0)
        protection = message.protection
        if protection is not None:
            mask |= protection.mask
            self._counters[name] = (self._counters[name] + 1) % protection.modulus
            if not protection.sound(bytearray(out.data)) or protection.counter(out.data) != self._counters[name]:
                return "wrong CRC or counter"
        return "a bit that is nobody's is set" if int.from_bytes(out.data, "little") & ~mask else None
