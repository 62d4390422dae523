"""Random frames through the node's core in both modes, each compared with what must come of it; ends at a wrong bit.

    python -m bench.node_fuzz --frames 10000000

Frames are those of :mod:`bench.c_core`; every few thousand of them another random vehicle takes its turn
(:mod:`bench.fuzz_vehicles`). What is drawn depends on the seed alone.

What must come is told by cantools (signals), autosar-e2e (protection) and fractions (correction). The exact code is
rounded, halves up; the node may come out as if the value were greater by less than 2^-10 of a code.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from bench.c_core import frames as random_frames
from bench.fuzz_vehicles import FuzzBranch, FuzzMessage, FuzzVehicle, draw_vehicle
from calibrator.terminal.progress import shown
from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.core.status import Quality
from ecu_node.database import VehicleDatabase

__all__ = ["Oracle", "WrongFrameError", "fuzz"]

FRAMES_PER_VEHICLE = 20_000
_HALF, _TOLERANCE = Fraction(1, 2), Fraction(1, 1024)
"""Of a code."""


class WrongFrameError(Exception):
    """The node made something else of a frame than it must."""


class _Outcome(NamedTuple):
    """Least and greatest code that may come of a branch, None for no value, and its quality."""

    allowed: tuple[int, int] | None
    quality: Quality


class _Branch:
    """One branch in one mode: what must come of its last frame."""

    def __init__(self, branch: FuzzBranch, mode: Mode) -> None:
        self.branch, self.source = branch, branch.source
        self.out = branch.target if mode is Mode.OVERLAY and branch.target is not None else branch.source
        self.corrects = branch.known and branch.apply and (branch.drift, branch.offset_a) != (0.0, 0.0)
        self.outcome, self._seen = _Outcome(None, Quality.NOT_AVAILABLE), False
        selector = branch.source.message.selector if branch.source.above is not None else None
        self.least_size = max(branch.source.end, selector.end if selector is not None else 0)

    def spoil(self) -> None:
        """A frame came that must not be used."""
        if self._seen:
            self.outcome = _Outcome(None, Quality.INVALID)

    def take(self, code: int, volts: Fraction | None) -> None:
        """Take the code of an intact frame, at a voltage, if it is known."""
        branch, self._seen = self.branch, True
        if not self.source.is_value(code):
            named = code in self.source.named or code in self.source.unnamed
            self.outcome = _Outcome(None, Quality.NOT_AVAILABLE if named else Quality.INVALID)
        elif self.corrects and branch.voltage is not None and branch.offset_a and volts is None:
            self.outcome = _Outcome(None, Quality.NOT_AVAILABLE)
        elif not self.corrects and self.out is self.source:
            self.outcome = _Outcome((code, code), Quality.PASSED_THROUGH)
        else:
            self.outcome = self._published(self.source.worth(code), volts)

    def _published(self, measured: Fraction, volts: Fraction | None) -> _Outcome:
        """Of a current, in the sensor's own sign, i = (i_m - o) / (1 + d); of a power the same times the voltage."""
        if self.corrects:
            u = Fraction(1) if self.branch.voltage is None else volts or Fraction(0)
            offset = self.branch.sign * Fraction(str(self.branch.offset_a)) * u
            measured = (measured - offset) / (1 + Fraction(str(self.branch.drift)))
        exact = self.out.exact_code(measured) + _HALF
        lowest, highest = self.out.ends
        least, most = (min(max(value.__floor__(), lowest), highest) for value in (exact, exact + _TOLERANCE))
        return _Outcome((least, most), Quality.CORRECTED if self.corrects else Quality.PASSED_THROUGH)


class _E2E:
    """What a receiver remembers of one message: AUTOSAR's counter check and state machine."""

    def __init__(self, message: FuzzMessage) -> None:
        self._protection, self._last, self._state = message.protection, -1, 0
        self._past: list[str] = []

    @property
    def is_invalid(self) -> bool:
        """Whether the message as a whole cannot be relied on; the states are INIT, VALID, INVALID."""
        return self._state == 2

    def take(self, payload: bytes) -> str:
        """Look at a frame: "usable", "corrupt", or intact but "out of order"."""
        protection = self._protection
        if protection is None:
            return "usable"
        found, counter = "corrupt", protection.counter(payload)
        if len(payload) >= protection.least and protection.is_sound(payload) and counter < protection.modulus:
            step = (counter - self._last) % protection.modulus
            found = "usable" if self._last < 0 or 1 <= step <= protection.max_step else "out of order"
            self._last = counter
        if found == "corrupt" and not self._past and not self._state:
            return found  # nothing was received yet
        self._past.append(found)
        window, min_ok, max_error = protection.windows[self._state]
        seen = self._past[-window:]
        if seen.count("corrupt") > max_error:
            self._state = 2
        elif seen.count("usable") >= min_ok:
            self._state = 1
        elif self._state == 1:
            self._state = 2
        return found


class Oracle:
    """Follows the frames of a vehicle in one mode.

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
        self._gateway, self._passes_invalid = mode is Mode.GATEWAY, vehicle.on_bad_frame == "invalid"
        self._database, self._branches = database, [_Branch(branch, mode) for branch in vehicle.branches]
        self._voltage = next((branch.voltage for branch in vehicle.branches if branch.voltage is not None), None)
        self._sources = {message.number: (message, _E2E(message)) for message in vehicle.sources}
        self._targets = {
            branch.target.message.number: branch.target.message
            for branch in vehicle.branches
            if branch.target is not None
        }
        self._counters = dict.fromkeys(self._targets, -1)
        self._volts: Fraction | None = None

    def problem(self, identifier: int, data: bytes, sent: Sequence[tuple[int, bytes]]) -> str | None:
        """Take a frame and what the node sent for it.

        Parameters
        ----------
        identifier : int
            Of the frame; bit 31: of 29 bits.
        data : bytes
            Its payload.
        sent : sequence of (int, bytes)
            Identifiers and payloads of what was sent.

        Returns
        -------
        str or None
            What is wrong; None if all is well.
        """
        message, e2e = self._sources[identifier]
        own = [item for item in self._branches if item.source.message is message]
        found, codes = e2e.take(data), self._codes(message, data)
        voltage = self._voltage
        if found == "usable" and voltage is not None and voltage.message is message and voltage.name in codes:
            code = codes[voltage.name]  # it comes before the branches of the same frame
            self._volts = voltage.worth(code) if voltage.is_value(code) else None
        used = found == "usable" or (self._gateway and self._passes_invalid and found == "out of order")
        for item in own if used else ():
            if len(data) < item.least_size:  # bits are beyond the end
                item.spoil()
            elif item.source.name in codes:
                item.take(codes[item.source.name], self._volts)
        if self._gateway:
            if used:
                return self._rewritten(message, codes, own, data, sent)
            expected = [(identifier, data)] if self._passes_invalid or not own else []
            return None if sent == expected else f"a frame that is {found} was not held back or left alone"
        if not used and not self._passes_invalid:
            return f"a frame that is {found} was answered" if sent else None
        if not used or e2e.is_invalid:
            for item in own:
                item.spoil()
        wanted = {item.branch.target.message.number for item in own if item.branch.target is not None}
        if sorted(number for number, _ in sent) != sorted(wanted):
            return f"frames {[f'{number:X}' for number, _ in sent]} were sent, must be {sorted(map(hex, wanted))}"
        answers = (self._wrong_answer(self._targets[number], answer) for number, answer in sent)
        return next((text for text in answers if text is not None), None)

    def _codes(self, message: FuzzMessage, data: bytes) -> dict[str, int]:
        """Codes of the signals that are whole in a payload, by cantools."""
        definition, selector = self._database.message(message.name), message.selector
        whole = data.ljust(message.size, b"\0")
        found: Any = definition.decode(whole, decode_choices=False, scaling=False)
        selected = selector is not None and selector.end <= len(data)
        return {
            signal.name: found[signal.name]
            for signal in message.signals
            if signal.name in found and signal.end <= len(data) and (selected or signal.above is None)
        }

    def _rewritten(
        self,
        message: FuzzMessage,
        codes: dict[str, int],
        own: Sequence[_Branch],
        data: bytes,
        sent: Sequence[tuple[int, bytes]],
    ) -> str | None:
        if len(sent) != 1 or sent[0][0] != message.number or len(sent[0][1]) != len(data):
            return "another frame was sent"
        made = sent[0][1]
        there, mask, protection = self._codes(message, made), 0, message.protection
        for item in own:
            if (name := item.source.name) in codes:
                lowest, highest = item.outcome.allowed or (codes[name], codes[name])
                if not lowest <= there[name] <= highest:
                    return f"{name} is {there[name]}, must be {lowest} to {highest}, was {codes[name]}"
                mask |= item.source.mask
        if made != data and protection is not None:
            mask |= protection.mask
            if not protection.is_sound(made) or protection.counter(made) != protection.counter(data):
                return "the rewritten frame has a wrong CRC, or another counter"
        changed = (int.from_bytes(data, "little") ^ int.from_bytes(made, "little")) & ~mask
        return f"bits {changed:X} changed, which are nobody's business" if changed else None

    def _wrong_answer(self, message: FuzzMessage, data: bytes) -> str | None:
        codes, protection, mask = self._codes(message, data), message.protection, 0
        for item in self._branches:
            target, quality = item.branch.target, item.branch.quality
            if target is None or target.message is not message:
                continue
            missing = next(code for code, text in target.named.items() if text == "SNA")
            lowest, highest = item.outcome.allowed or (missing, missing)
            told = codes[quality.name] if quality is not None else item.outcome.quality
            if not lowest <= codes[target.name] <= highest or told != item.outcome.quality:
                return f"{target.name} is {codes[target.name]} of quality {told}, must be {item.outcome}"
            mask |= target.mask | (quality.mask if quality is not None else 0)
        if protection is not None:
            mask |= protection.mask
            self._counters[message.number] = (self._counters[message.number] + 1) % protection.modulus
            if not protection.is_sound(data) or protection.counter(data) != self._counters[message.number]:
                return f"{message.name}: wrong CRC or counter"
        return f"{message.name}: a bit that is nobody's is set" if int.from_bytes(data, "little") & ~mask else None


def fuzz(frames: int, seed: int = 0, frames_per_vehicle: int = FRAMES_PER_VEHICLE) -> Iterator[int]:
    """Send random frames through an overlay node and a gateway.

    Parameters
    ----------
    frames : int
        How many in all.
    seed : int
        Of all that is drawn.
    frames_per_vehicle : int
        After so many another vehicle is drawn.

    Yields
    ------
    int
        How many frames were right so far.

    Raises
    ------
    WrongFrameError
        At the first frame of which something else came than must.
    """
    for done in range(0, frames, frames_per_vehicle):
        rng, count = Random(f"{seed} {done}"), min(frames_per_vehicle, frames - done)  # noqa: S311 (no secrets)
        vehicle = draw_vehicle(rng)
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            database, parameters = vehicle.load(Path(folder))
        drawn = list(random_frames(database, rng, count))
        for mode in Mode:
            oracle, corrector = (
                Oracle(vehicle, database, mode),
                wire(database, InForce(parameters=parameters), 0.0, mode=mode),
            )
            sources = {key[0] | key[1] << 31: source for key, source in corrector.sources.items()}
            for number, (identifier, data) in enumerate(drawn):
                if data is None:  # a silence, after which the node forgets
                    continue
                if mode is Mode.GATEWAY:
                    made = sources[identifier].forward(bytearray(data), 1e-3 * number)
                    sent = [] if made is None else [(identifier, bytes(made))]
                else:
                    answers = sources[identifier].answer(bytearray(data), 1e-3 * number)
                    sent = [(item.key[0] | item.key[1] << 31, bytes(item.data)) for item in answers]
                if (problem := oracle.problem(identifier, data, sent)) is not None:
                    place = f"seed {seed}, vehicle of frame {done}, {mode.name.lower()}, frame {number}"
                    shown = " ".join(f"{key:X}#{answer.hex()}" for key, answer in sent) or "nothing"
                    raise WrongFrameError(f"{place}: {identifier:X}#{data.hex()} -> {shown}: {problem}")
        yield done + count


def main() -> None:
    """Try as many frames as asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    vehicles = arguments.frames // FRAMES_PER_VEHICLE
    try:
        done = max(shown(fuzz(arguments.frames, arguments.seed), "fuzz", vehicles, "vehicles"), default=0)
    except WrongFrameError as error:
        sys.exit(f"{error}")
    print(f"{done} frames right in both modes")


if __name__ == "__main__":
    main()
