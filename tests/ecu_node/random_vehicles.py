"""Random vehicles: DBC, layout and parameters with all that the node knows, drawn from a seed.

Signals of 1 to 64 bits in both byte orders and on any bit, multiplexed or not, with negative factors, ranges and named
codes; powers with their voltage; every profile of protection; messages of 1 to 64 bytes with 11 and 29 bits of
identifier. cantools says where there is room for a signal, and writes the DBC.
"""

import json
from collections import OrderedDict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import ceil, floor
from pathlib import Path
from random import Random
from typing import Any

from cantools.database.can import Database, Message, Signal
from cantools.database.can.node import Node
from cantools.database.conversion import BaseConversion
from cantools.database.errors import Error as DatabaseError
from cantools.database.utils import start_bit

from bench.true_parameters import true_parameters
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, VehicleParameters

_SCALES = ("0.1", "-0.05", "1", "0.02", "0.001", "-0.25", "3", "0.0078125", "100", "-1")
_OFFSETS = ("0", "0", "-400", "12.5", "-0.3")
_LENGTHS = (1, 2, 3, 5, 8, 10, 12, 13, 15, 16, 17, 20, 24, 31, 32, 33, 47, 63, 64)
_SIZES = (1, 2, 3, 4, 6, 7, 8, 8, 8, 8, 8, 12, 16, 24, 32, 48, 64)
_FACTORS = {"mA": Fraction(1, 1000), "kW": Fraction(1000)}
_TRIES = 50
_LONGEST_WITH_RANGE = 24
"""Longest signal that gets a range: ends of longer ones have more digits than a floating-point number. [bit]"""
# every vehicle reaches this full scale, wherever its signals have names
_SETTINGS: dict[str, Any] = {"schema": 1, "name": "fuzz", "dbc": "fuzz.dbc", "full_scale_a": 1e-9, "max_age_s": 1e6}
_SETTINGS |= {"watch": {"window_s": 3600.0, "margin_a": 1e6}, "limits": {"drift": 0.4, "offset_a": 160.0}}


HEADER_BITS = {"P01": 12, "P02": 12, "P04": 96, "P05": 24, "P06": 40, "P07": 160, "P11": 12, "counter CRC8": 16}
"""Bits of the header of each profile."""


class Codes:
    """Codes of a signal in the DBC's range: which of them are no values, and what those that are values are worth."""

    def __init__(self, signal: Signal, no_value: Sequence[int] = ()) -> None:
        factor, n = _FACTORS.get(signal.unit or "", Fraction(1)), signal.length
        self._scale, self._offset = (Fraction(str(number)) * factor for number in (signal.scale, signal.offset))
        self.width = (-(1 << (n - 1)), (1 << (n - 1)) - 1) if signal.is_signed else (0, (1 << n) - 1)
        self.gaps = {*(signal.choices or ()), *no_value}
        self.span = self.width
        if signal.minimum is not None and signal.maximum is not None:
            ends = [self.exact_code(Fraction(str(end)) * factor) for end in (signal.minimum, signal.maximum)]
            self.span = max(self.width[0], ceil(min(ends))), min(self.width[1], floor(max(ends)))

    @property
    def zero(self) -> int:
        """Code nearest to zero, halves up, inside the range."""
        return min(max(floor(self.exact_code(Fraction(0)) + Fraction(1, 2)), self.span[0]), self.span[1])

    @property
    def ends(self) -> tuple[int, int]:
        """Ends of the values around zero, in which results are kept."""
        lowest = max([self.span[0], *(code + 1 for code in self.gaps if code < self.zero)])
        return lowest, min([self.span[1], *(code - 1 for code in self.gaps if code > self.zero)])

    def is_value(self, code: int) -> bool:
        """Whether a code is a number."""
        return self.span[0] <= code <= self.span[1] and code not in self.gaps

    def worth(self, code: int) -> Fraction:
        """Value of a code, in A, W or V."""
        return self._scale * code + self._offset

    def exact_code(self, value: Fraction) -> Fraction:
        """The code of a value in A, W or V, before it is rounded."""
        return (value - self._offset) / self._scale


def mask_of(signal: Signal) -> int:
    """Bits of a signal in the payload read as a little-endian integer."""
    places = range(start_bit(signal), start_bit(signal) + signal.length)
    if signal.byte_order == "little_endian":
        return sum(1 << place for place in places)
    return sum(1 << (place - place % 8 + 7 - place % 8) for place in places)


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = {_toml(item)}' for key, item in value.items()) + "}"
    return "[" + ", ".join(map(_toml, value)) + "]" if isinstance(value, list) else json.dumps(value)


@dataclass(kw_only=True)
class _Draft:
    """A message that is being drawn: its signals, and its entry of protection in the layout, if it has one."""

    name: str
    frame_id: int
    extended: bool
    size: int
    signals: list[Signal] = field(default_factory=list)
    header: list[Signal] = field(default_factory=list)
    """Signals that keep the place of an AUTOSAR header free, which is no signal of the DBC."""
    e2e: dict[str, Any] = field(default_factory=dict)

    def message(self, *more: Signal) -> Message:
        """Return the message of cantools, with some more signals; cantools raises an error if signals overlap."""
        senders, signals = ["Sensor" if self.name.startswith("In") else "Corrector"], [*self.signals, *more]
        extended = self.extended
        return Message(self.frame_id, self.name, self.size, signals, is_extended_frame=extended, senders=senders)

    def place(self, rng: Random, signal: Signal, *, multiplexed: bool = False, little: bool = False) -> str | None:
        """Put a signal where no other one is; return its name in the layout, or None if there is no room."""
        selector = next((item for item in self.signals if item.is_multiplexer), None)
        if multiplexed and selector is not None:
            codes = range(1 << selector.length)
            signal.multiplexer_ids = sorted(rng.sample(codes, rng.randint(1, max(1, len(codes) // 2))))
            signal.multiplexer_signal = selector.name
        for _ in range(_TRIES if signal.length <= 8 * self.size else 0):
            place = rng.randint(0, 8 * self.size - signal.length)
            signal.byte_order, signal.start = "little_endian", place
            if not little and rng.random() < 0.5:
                signal.byte_order, signal.start = "big_endian", place - place % 8 + 7 - place % 8
            try:
                self.message(signal, *self.header)
            except DatabaseError:
                continue
            self.signals.append(signal)
            return f"{self.name}.{signal.name}"
        return None


def draw_vehicle(
    rng: Random, folder: Path, kinds: Collection[str] = HEADER_BITS.keys()
) -> tuple[VehicleDatabase, VehicleParameters]:
    """Draw a vehicle with at least two branches, one of which an overlay node publishes.

    Parameters
    ----------
    rng : Random
        Of all that is drawn.
    folder : Path
        For layout and DBC, which are read as the node does.
    kinds : collection of str
        Kinds of protection that its messages may have.

    Returns
    -------
    tuple of VehicleDatabase and VehicleParameters
        Layout and DBC, and parameters that fit them.
    """
    layout, messages, faults = _draw(rng, kinds)
    while len(layout["branch"]) < 2 or not any("corrected" in branch for branch in layout["branch"]):
        layout, messages, faults = _draw(rng, kinds)
    dbc = Database(messages, nodes=[Node("Sensor"), Node("Corrector")]).as_dbc_string()
    (folder / "fuzz.dbc").write_text(dbc)
    (folder / "fuzz.toml").write_text("".join(f"{key} = {_toml(value)}\n" for key, value in layout.items()))
    database = read_database(read_layout(folder / "fuzz.toml"))
    return database, true_parameters(database, faults)


def _draw(rng: Random, kinds: Collection[str]) -> tuple[dict[str, Any], list[Message], dict[str, BranchParameters]]:
    """Layout as it stands in its file, messages of the DBC, and faults by branch."""
    sources = [_draw_message(rng, f"In{k}", k, kinds) for k in range(rng.randint(1, 4))]
    targets = [_draw_message(rng, f"Out{k}", 4 + k, kinds, least_size=8) for k in range(rng.randint(1, 3))]
    net, branches, faults = None, list[dict[str, Any]](), dict[str, BranchParameters]()
    if rng.random() < 0.5:
        voltage = _draw_signal(rng, "Net", rng.choice((6, 8, 12)), ["V"], scales=("0.01", "0.5", "-0.1"))
        net = rng.choice(sources).place(rng, voltage, multiplexed=rng.random() < 0.5)
    for number in range(rng.randint(2, 6)):
        with_voltage = net if rng.random() < 0.5 else None
        units = ["W", "kW"] if with_voltage else ["A", "mA", ""]
        signal = _draw_signal(rng, f"Current{number}", rng.choice(_LENGTHS), units)
        source = rng.choice(sources).place(rng, signal, multiplexed=rng.random() < 0.7)
        if source is None:
            continue
        name, codes = f"b{number}", Codes(signal)
        branch: dict[str, Any] = {"name": name, "sign": rng.choice((1, -1)), "timeout_s": 1e6}
        branch |= {"power": source, "voltage": with_voltage} if with_voltage else {"signal": source}
        code = rng.randint(*codes.width)
        is_spared = signal.length < 3 or abs(code - codes.zero) <= 1
        branch["no_value"] = [] if is_spared or rng.random() < 0.7 else [code]
        if rng.random() < 0.9:
            units = [unit for unit in units if unit or signal.unit != "mA"]  # none beside mA is refused
            branch |= _draw_target(rng, name, rng.choice(targets), units)
        branches.append(branch)
        if rng.random() < 0.95:
            drift = rng.choice((0.0, 0.02, round(rng.uniform(-0.4, 0.4), 4)))
            offset_a = rng.choice((0.0, 3.0, round(rng.uniform(-50.0, 50.0), 3)))
            faults[name] = BranchParameters(drift=drift, offset_a=offset_a, apply=rng.random() < 0.9)
    for draft in sources:  # and signals that the layout does not use
        draft.place(rng, Signal("Other", 0, rng.choice((1, 4, 8))))
    keys = ("signal", "power", "voltage", "corrected")
    named = {branch[key].split(".")[0] for branch in branches for key in keys if key in branch}
    used = [draft for draft in (*sources, *targets) if draft.name in named]
    layout = {**_SETTINGS, "branch": branches, "e2e": [draft.e2e for draft in used if draft.e2e]}
    return layout, [draft.message() for draft in used], faults


def _draw_target(rng: Random, name: str, draft: _Draft, units: Sequence[str]) -> dict[str, str]:
    """Where an overlay node publishes a branch: signal with a code for no value, and that of its quality."""
    signal = _draw_signal(rng, f"Out{name}", rng.choice([n for n in _LENGTHS if n >= 3]), units, named=False)
    (lowest, highest), zero = Codes(signal).width, Codes(signal).zero
    missing = lowest if zero != lowest else highest
    error, names = highest - rng.randint(0, 2), {missing: "SNA"}
    if abs(error - zero) > 1:
        names.setdefault(error, "Error")
    _set_codes(signal, names)
    found = {"corrected": draft.place(rng, signal)}
    if found["corrected"]:
        found["quality"] = draft.place(rng, Signal(f"Quality{name}", 0, rng.randint(2, 4)))
    return {key: signal_name for key, signal_name in found.items() if signal_name is not None}


def _draw_message(rng: Random, name: str, low: int, kinds: Collection[str], least_size: int = 1) -> _Draft:
    """Draw a message whose identifier ends in the three bits `low`."""
    extended = rng.random() < 0.3
    frame_id = rng.getrandbits(26 if extended else 8) << 3 | low
    size = rng.choice([size for size in _SIZES if size >= least_size])
    draft = _Draft(name=name, frame_id=frame_id, extended=extended, size=size)
    if rng.random() < 0.7:
        _draw_protection(rng, draft, kinds)
    if least_size == 1 and rng.random() < 0.35:
        before, selector = [*draft.signals], Signal("Selector", 0, rng.randint(1, 3), is_multiplexer=True)
        filler = Signal("Filler", 0, 1, multiplexer_ids=[*range(1 << selector.length)], multiplexer_signal="Selector")
        is_placed = draft.place(rng, selector, little=True) and draft.place(rng, filler, little=True)
        if not is_placed or selector.start % 8 + selector.length > 8:  # cantools wants a signal with every code
            draft.signals = before
    return draft


def _draw_signal(
    rng: Random, name: str, length: int, units: Sequence[str], *, scales: Sequence[str] = _SCALES, named: bool = True
) -> Signal:
    """A signal that has no place yet, and can be 0; names for some codes, but not that of zero or beside it."""
    signal = Signal(name, 0, length, is_signed=rng.random() < 0.6, unit=rng.choice(units))
    scale, offset = rng.choice(scales), rng.choice(_OFFSETS if scales is _SCALES else ("0",))
    signal.conversion = BaseConversion.factory(scale=float(scale), offset=float(offset))
    lowest, highest = Codes(signal).width
    quarter = (highest - lowest) // 4
    if scales is _SCALES and length <= _LONGEST_WITH_RANGE and rng.random() < 0.6 and quarter:
        ends = lowest + rng.randint(0, quarter), highest - rng.randint(0, quarter)
        low, high = sorted(Fraction(scale) * code + Fraction(offset) for code in ends)
        signal.minimum, signal.maximum = float(low), float(high)
    names, codes, zero = dict[int, str](), Codes(signal), Codes(signal).zero
    if abs(codes.worth(zero)) > abs(codes.worth(1) - codes.worth(0)) / 2:
        return _draw_signal(rng, name, length, units, scales=scales, named=named)  # it cannot be 0
    for number in range(rng.randint(0, 3) if named and length >= 3 else 0):
        code = rng.choice((lowest, highest, rng.randint(lowest, highest), highest - rng.randint(0, 3)))
        if abs(code - zero) > 1:
            names.setdefault(code, f"Name{number}")
    _set_codes(signal, names)
    return signal


def _set_codes(signal: Signal, names: dict[int, str]) -> None:
    choices = OrderedDict[int, Any](names) or None
    signal.conversion = BaseConversion.factory(scale=signal.scale, offset=signal.offset, choices=choices)


def _draw_protection(rng: Random, draft: _Draft, kinds: Collection[str]) -> None:
    """Draw a protection that fits a message and leaves room in it, if there is one."""
    fitting = [name for name in kinds if HEADER_BITS[name] <= 8 * (draft.size - 1)]
    fitting += [name for name in fitting if name in {"P04", "P07"}]  # they fit few messages
    if not fitting:
        return
    draft.e2e = {"messages": [draft.name], "profile": rng.choice(fitting), "max_delta_counter": rng.randint(1, 4)}
    each_by_itself = rng.random() < 0.5
    for state in ("init", "valid", "invalid"):
        size = rng.randint(1, 12)
        windows = {"window": size, "min_ok": rng.randint(0, (size + 1) // 2), "max_error": rng.randint(0, size // 2)}
        draft.e2e[state] = {"window": 1, "min_ok": 0, "max_error": 1} if each_by_itself else windows
    draft.e2e |= _counter_crc8(rng, draft) if draft.e2e["profile"] == "counter CRC8" else _autosar(rng, draft)


def _counter_crc8(rng: Random, draft: _Draft) -> dict[str, Any]:
    byte, counter_byte = rng.sample(range(min(draft.size, 4)), 2)
    draft.signals += [Signal("Crc", 8 * byte, 8), Signal("Counter", 8 * counter_byte + rng.choice((0, 3, 4)), 4)]
    return {
        "counter": "Counter",
        "crc": "Crc",
        "algorithm": rng.choice(("sae_j1850", "autosar")),
        "counter_modulus": rng.choice((15, 16)),
        "data_id_bytes": rng.choice((0, 1, 2)),
        "data_id_at": rng.choice(("before", "after")),
    }


def _autosar(rng: Random, draft: _Draft) -> dict[str, Any]:
    profile, bits, entry = draft.e2e["profile"], HEADER_BITS[draft.e2e["profile"]], dict[str, Any]()
    if profile == "P02":
        entry["data_id_list"] = {draft.name: [*rng.randbytes(16)]}
    else:
        entry["offset"] = rng.choice((0, 0, 0, rng.randrange(min(draft.size - (bits + 7) // 8, 61))))
        if profile in {"P01", "P11"}:
            modes = "both", "both", "nibble", *(("alternating", "low") * (profile == "P01"))
            entry["data_id_mode"] = rng.choice(modes)
        is_nibble = entry.get("data_id_mode") == "nibble"
        bits += 4 * is_nibble
        if rng.random() < 0.5:
            entry["data_id"] = {
                draft.name: rng.getrandbits(32 if profile in {"P04", "P07"} else 12 if is_nibble else 16)
            }
    draft.header = [Signal("Header", 8 * entry.get("offset", 0), bits)]
    return entry
