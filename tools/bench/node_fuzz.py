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
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from math import floor
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from cantools.database.can import Message, Signal
from cantools.database.utils import start_bit
from e2e import p01
from fastcrc import crc8

from bench.c_core import frames as random_frames
from bench.fuzz_vehicles import PROFILES, Codes, FuzzVehicle, draw_vehicle, mask_of
from calibrator.terminal.progress import shown
from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.core.status import Quality
from ecu_node.parameters import BranchParameters

__all__ = ["Oracle", "WrongFrameError", "fuzz"]

FRAMES_PER_VEHICLE = 20_000
_TOLERANCE = Fraction(1, 1024)
"""Of a code."""
_MODES = {
    "both": p01.E2E_P01_DATAID_BOTH,
    "alternating": p01.E2E_P01_DATAID_ALT,
    "low": p01.E2E_P01_DATAID_LOW,
    "nibble": p01.E2E_P01_DATAID_NIBBLE,
}


class WrongFrameError(Exception):
    """The node made something else of a frame than it must."""


class _Outcome(NamedTuple):
    """Least and greatest code that may come of a branch, None for no value, and its quality."""

    allowed: tuple[int, int] | None
    quality: Quality


def _end(message: Message, signal: Signal) -> int:
    """Bytes that a frame needs to have a signal, and the selector that tells whether it is there."""
    selectors = [item for item in message.signals if item.is_multiplexer and signal.multiplexer_ids]
    return max((mask_of(item).bit_length() + 7) // 8 for item in (signal, *selectors))


class _Branch:
    """One branch in one mode: what must come of its last frame."""

    def __init__(self, vehicle: FuzzVehicle, entry: dict[str, Any], mode: Mode) -> None:
        self.sign, self.is_power = entry["sign"], "power" in entry
        self.message, self.source = vehicle.signal(entry.get("power") or entry["signal"])
        self.codes = Codes(self.source, entry["no_value"])
        self.target = vehicle.signal(entry["corrected"]) if "corrected" in entry else None
        self.quality = vehicle.signal(entry["quality"])[1] if "quality" in entry else None
        self._published_as = self.codes
        if mode is Mode.OVERLAY and self.target is not None:
            self._published_as = Codes(self.target[1])
        fault = vehicle.faults.get(entry["name"], BranchParameters(drift=0.0, offset_a=0.0, apply=False))
        self._drift, self._offset_a = (Fraction(str(number)) for number in (fault.drift, fault.offset_a))
        self.corrects = fault.apply and bool(self._drift or self._offset_a)
        self.outcome, self._seen = _Outcome(None, Quality.NOT_AVAILABLE), False

    def spoil(self) -> None:
        """A frame came that must not be used."""
        if self._seen:
            self.outcome = _Outcome(None, Quality.INVALID)

    def take(self, code: int, volts: Fraction | None) -> None:
        """Take the code of an intact frame, at a voltage, if it is known."""
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
        """Of a current, in the sensor's own sign, i = (i_m - o) / (1 + d); of a power the same times the voltage."""
        if self.corrects:
            u = (volts or Fraction(0)) if self.is_power else Fraction(1)
            measured = (measured - self.sign * self._offset_a * u) / (1 + self._drift)
        exact = self._published_as.exact_code(measured) + Fraction(1, 2)
        lowest, highest = self._published_as.ends
        least, most = (min(max(floor(value), lowest), highest) for value in (exact, exact + _TOLERANCE))
        return _Outcome((least, most), Quality.CORRECTED if self.corrects else Quality.PASSED_THROUGH)


class _Protection:
    """How the frames of one message are protected, by its entry in the layout."""

    def __init__(self, message: Message, entry: dict[str, Any]) -> None:
        self.max_step = entry["max_delta_counter"]
        self.windows = [entry[state] for state in ("init", "valid", "invalid")]
        self.seal: Callable[[bytearray], None]
        """Writes all but the counter into a payload."""
        if entry["profile"] == "counter CRC8":
            self._by_signals(message, entry)
        else:
            self._by_profile(message, entry)
        self.least = (self.mask.bit_length() + 7) // 8

    def _by_signals(self, message: Message, entry: dict[str, Any]) -> None:
        crc, counter = message.get_signal_by_name("Crc"), message.get_signal_by_name("Counter")
        at, place, self.modulus = crc.start // 8, start_bit(counter), entry["counter_modulus"]
        self.mask = mask_of(crc) | mask_of(counter)
        self._place = (place // 8, 1, place % 8, 4)
        digest, identity = getattr(crc8, entry["algorithm"]), message.frame_id & 0xFFFF
        first = identity.to_bytes(2, "little")[: entry["data_id_bytes"]]
        before, after = (first, b"") if entry["data_id_at"] == "before" else (b"", first)

        def seal(payload: bytearray) -> None:
            payload[at] = digest(before + bytes(payload[:at] + payload[at + 1 :]) + after)

        self.seal = seal

    def _by_profile(self, message: Message, entry: dict[str, Any]) -> None:
        name, mode, offset = entry["profile"], entry.get("data_id_mode"), entry.get("offset", 0)
        protect, bits, counter_byte, counter_bits, self.modulus = PROFILES[name]
        self.mask = (1 << bits + 4 * (mode == "nibble")) - 1 << 8 * offset
        self._place = (offset + counter_byte, (counter_bits + 7) // 8, 0, counter_bits)
        options = {} if name == "P02" else {"offset": offset}
        options |= {"data_id_mode": _MODES[mode]} if mode else {}
        own = message.frame_id & (0xFFFFFFFF if name in {"P04", "P07"} else 0xFFFF)
        identity = entry.get("data_id", {}).get(message.name, own)
        if name == "P02":
            identity = bytes(entry["data_id_list"][message.name])

        def seal(payload: bytearray) -> None:
            protect(payload, identity, increment_counter=False, **options)

        self.seal = seal

    def counter(self, payload: bytes) -> int:
        """The counter of a payload."""
        byte, count, shift, bits = self._place
        return int.from_bytes(payload[byte : byte + count], "big") >> shift & (1 << bits) - 1

    def is_sound(self, payload: bytes) -> bool:
        """Whether all but the counter is right."""
        sealed = bytearray(payload)
        self.seal(sealed)
        return sealed == payload


class _E2E:
    """What a receiver remembers of one message: AUTOSAR's counter check and state machine."""

    def __init__(self, protection: _Protection | None) -> None:
        self.protection, self._last, self._state = protection, -1, 0
        self._past: list[str] = []

    @property
    def is_invalid(self) -> bool:
        """Whether the message as a whole cannot be relied on; the states are INIT, VALID, INVALID."""
        return self._state == 2

    def take(self, payload: bytes) -> str:
        """Look at a frame: "usable", "corrupt", or intact but "out of order"."""
        protection = self.protection
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
        state = protection.windows[self._state]
        seen = self._past[-state["window"] :]
        if seen.count("corrupt") > state["max_error"]:
            self._state = 2
        elif seen.count("usable") >= state["min_ok"]:
            self._state = 1
        elif self._state == 1:
            self._state = 2
        return found


class Oracle:
    """Follows the frames of a vehicle in one mode."""

    def __init__(self, vehicle: FuzzVehicle, mode: Mode) -> None:
        self._gateway, self._passes_invalid = mode is Mode.GATEWAY, vehicle.layout["on_bad_frame"] == "invalid"
        self._messages = {m.frame_id | m.is_extended_frame << 31: m for m in vehicle.messages.values()}
        self._branches = [_Branch(vehicle, entry, mode) for entry in vehicle.layout["branch"]]
        protections = {
            entry["messages"][0]: _Protection(vehicle.messages[entry["messages"][0]], entry)
            for entry in vehicle.layout["e2e"]
        }
        self._e2e = {name: _E2E(protections.get(name)) for name in vehicle.messages}
        self._counters = dict.fromkeys(vehicle.messages, -1)
        powers = [entry["voltage"] for entry in vehicle.layout["branch"] if "voltage" in entry]
        self._voltage = vehicle.signal(powers[0]) if powers else None
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
        message = self._messages[identifier]
        own, e2e = [item for item in self._branches if item.message is message], self._e2e[message.name]
        found, codes = e2e.take(data), _codes(message, data)
        if found == "usable" and self._voltage is not None and self._voltage[0] is message:
            net = self._voltage[1]  # it comes before the branches of the same frame
            if net.name in codes:
                is_value = Codes(net).is_value(codes[net.name])
                self._volts = Codes(net).worth(codes[net.name]) if is_value else None
        used = found == "usable" or (self._gateway and self._passes_invalid and found == "out of order")
        for item in own if used else ():
            if len(data) < _end(message, item.source):  # bits are beyond the end
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
        wanted = {item.target[0].name for item in own if item.target is not None}
        answered = [self._messages[number].name for number, _ in sent]
        if sorted(answered) != sorted(wanted):
            return f"frames {answered} were sent, must be {sorted(wanted)}"
        problems = (self._wrong_answer(self._messages[number], answer) for number, answer in sent)
        return next((text for text in problems if text is not None), None)

    def _rewritten(
        self,
        message: Message,
        codes: dict[str, int],
        own: Sequence[_Branch],
        data: bytes,
        sent: Sequence[tuple[int, bytes]],
    ) -> str | None:
        if len(sent) != 1 or self._messages.get(sent[0][0]) is not message or len(sent[0][1]) != len(data):
            return "another frame was sent"
        made = sent[0][1]
        there, mask, protection = _codes(message, made), 0, self._e2e[message.name].protection
        for item in own:
            if (name := item.source.name) in codes:
                lowest, highest = item.outcome.allowed or (codes[name], codes[name])
                if not lowest <= there[name] <= highest:
                    return f"{name} is {there[name]}, must be {lowest} to {highest}, was {codes[name]}"
                mask |= mask_of(item.source)
        if made != data and protection is not None:
            mask |= protection.mask
            if not protection.is_sound(made) or protection.counter(made) != protection.counter(data):
                return "the rewritten frame has a wrong CRC, or another counter"
        changed = (int.from_bytes(data, "little") ^ int.from_bytes(made, "little")) & ~mask
        return f"bits {changed:X} changed, which are nobody's business" if changed else None

    def _wrong_answer(self, message: Message, data: bytes) -> str | None:
        codes, protection, mask = _codes(message, data), self._e2e[message.name].protection, 0
        for item in self._branches:
            if item.target is None or item.target[0] is not message:
                continue
            target, quality = item.target[1], item.quality
            missing = next(code for code, text in (target.choices or {}).items() if text == "SNA")
            lowest, highest = item.outcome.allowed or (missing, missing)
            told = codes[quality.name] if quality is not None else item.outcome.quality
            if not lowest <= codes[target.name] <= highest or told != item.outcome.quality:
                return f"{target.name} is {codes[target.name]} of quality {told}, must be {item.outcome}"
            mask |= mask_of(target) | (mask_of(quality) if quality is not None else 0)
        if protection is not None:
            mask |= protection.mask
            self._counters[message.name] = (self._counters[message.name] + 1) % protection.modulus
            if not protection.is_sound(data) or protection.counter(data) != self._counters[message.name]:
                return f"{message.name}: wrong CRC or counter"
        return f"{message.name}: a bit that is nobody's is set" if int.from_bytes(data, "little") & ~mask else None


def _codes(message: Message, data: bytes) -> dict[str, int]:
    """Codes of the signals that are whole in a payload, by cantools."""
    whole = data.ljust(message.length, b"\0")
    found: Any = message.decode(whole, decode_choices=False, scaling=False)
    return {
        signal.name: found[signal.name]
        for signal in message.signals
        if signal.name in found and _end(message, signal) <= len(data)
    }


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
        rng, count = Random(f"{seed} {done}"), min(frames_per_vehicle, frames - done)
        vehicle = draw_vehicle(rng)
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            database, parameters = vehicle.load(Path(folder))
        drawn = list(random_frames(database, rng, count))
        for mode in Mode:
            oracle, corrector = Oracle(vehicle, mode), wire(database, InForce(parameters=parameters), 0.0, mode=mode)
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
