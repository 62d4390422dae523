"""Random vehicles for the node's fuzz test: DBC, layout and parameters with all that the node knows, drawn from a seed.

Signals of 1 to 64 bits in both byte orders and on any bit, multiplexed or not, with negative factors, ranges and named
codes; powers with their voltage; every profile of protection; messages of 1 to 64 bytes with 11 and 29 bits of
identifier.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from random import Random

from bench.node_fuzz_protection import FuzzProtection, draw_protection
from bench.true_parameters import true_parameters
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, VehicleParameters

__all__ = ["FuzzBranch", "FuzzMessage", "FuzzSignal", "FuzzVehicle", "draw_vehicle"]

_SCALES = ("0.1", "-0.05", "1", "0.02", "0.001", "-0.25", "3", "0.0078125", "100", "-1")
_OFFSETS = ("0", "0", "-400", "12.5", "-0.3")
_LENGTHS = (1, 2, 3, 5, 8, 10, 12, 13, 15, 16, 17, 20, 24, 31, 32, 33, 47, 63, 64)
_SIZES = (1, 2, 3, 4, 6, 7, 8, 8, 8, 8, 8, 12, 16, 24, 32, 48, 64)
_TRIES = 50
_LONGEST_WITH_RANGE = 24
"""Longer ranges have more digits than a floating-point number. [bit]"""
_FULL_SCALE_A = 1e-9
"""So small that every vehicle reaches it, wherever its signals have names. [A]"""
_OFFSET_LIMIT_A = 160.0
_FOREVER_S = 1e6


@dataclass(kw_only=True)
class FuzzSignal:
    """One signal of the DBC, and what its codes are worth.

    Attributes
    ----------
    name : str
        In its message.
    bits : tuple of int
        Its bits from the most significant one, numbered as in a little-endian integer.
    big, signed : bool
        Byte order, and whether it is a two's complement.
    scale, offset : str
        As they stand in the DBC.
    unit : str
        "A", "mA", "W", "kW", "V", "degC" or none.
    range : tuple of int or None
        Least and greatest code in the DBC's range.
    named : dict of int to str
        Codes with names.
    unnamed : list of int
        Codes that the layout says are no values.
    above : frozenset of int or None
        Codes of the message's multiplexer with which it is there.
    """

    name: str
    bits: tuple[int, ...]
    big: bool
    signed: bool = False
    scale: str = "1"
    offset: str = "0"
    unit: str = ""
    range: tuple[int, int] | None = None
    named: dict[int, str] = field(default_factory=dict)
    unnamed: list[int] = field(default_factory=list)
    above: frozenset[int] | None = None
    is_multiplexer: bool = False

    @property
    def mask(self) -> int:
        """Its bits in a little-endian integer."""
        return sum(1 << bit for bit in self.bits)

    @property
    def end(self) -> int:
        """Bytes that a frame needs to have it."""
        return max(self.bits) // 8 + 1

    @property
    def width_range(self) -> tuple[int, int]:
        """Codes that the width can hold."""
        n = len(self.bits)
        return (-(1 << (n - 1)), (1 << (n - 1)) - 1) if self.signed else (0, (1 << n) - 1)

    def code(self, payload: bytes) -> int:
        """Its code in a payload, bit by bit."""
        raw = 0
        for bit in self.bits:
            raw = raw << 1 | payload[bit // 8] >> bit % 8 & 1
        return raw - (1 << len(self.bits)) if self.signed and raw >> (len(self.bits) - 1) else raw

    def put(self, payload: bytearray, code: int) -> None:
        """Write a code, bit by bit."""
        for bit in reversed(self.bits):
            payload[bit // 8] = payload[bit // 8] & ~(1 << bit % 8) | (code & 1) << bit % 8
            code >>= 1

    def text(self) -> str:
        """Its line of the DBC."""
        lowest, highest = "0", "0"
        if self.range is not None:
            ends = sorted(Fraction(self.scale) * code + Fraction(self.offset) for code in self.range)
            lowest, highest = (_decimal(value) for value in ends)
        multiplexing = " M" if self.is_multiplexer else "" if self.above is None else f" m{min(self.above)}"
        start = self.bits[0] if self.big else self.bits[-1]
        place = f"{start}|{len(self.bits)}@{0 if self.big else 1}{'-' if self.signed else '+'}"
        worth = f'({self.scale},{self.offset}) [{lowest}|{highest}] "{self.unit}"'
        return f" SG_ {self.name}{multiplexing} : {place} {worth} X"


def _decimal(value: Fraction) -> str:
    """Exact decimal of a fraction that has one."""
    digits = 0
    while (value * 10**digits).denominator != 1:
        digits += 1
    whole = int(value * 10**digits)
    text = f"{abs(whole):0{digits + 1}d}"
    return f"{'-' if whole < 0 else ''}{text[: len(text) - digits]}{'.' if digits else ''}{text[len(text) - digits :]}"


@dataclass(kw_only=True)
class FuzzMessage:
    """One message of the DBC."""

    name: str
    identifier: int
    extended: bool
    size: int
    protection: FuzzProtection | None
    signals: list[FuzzSignal] = field(default_factory=list)
    multiplexer: FuzzSignal | None = None

    @property
    def key(self) -> tuple[int, bool]:
        """Identifier, and whether it has 29 bits."""
        return self.identifier, self.extended

    def draw_signal(self, rng: Random, name: str, length: int, *, multiplexed: bool = False) -> FuzzSignal | None:
        """Place a signal of some length where no other one is; None if there is no room."""
        above = None
        if multiplexed and self.multiplexer is not None:
            codes = range(1 << len(self.multiplexer.bits))
            above = frozenset(rng.sample(codes, rng.randint(1, max(1, len(codes) // 2))))
        taken = self.protection.mask if self.protection is not None else 0
        for other in self.signals:
            if other.above is None or above is None or other.above & above:
                taken |= other.mask
        if length > 8 * self.size:
            return None
        for _ in range(_TRIES):
            big = rng.random() < 0.5
            signal = FuzzSignal(name=name, bits=_place(rng, length, self.size, big=big), big=big, above=above)
            if not signal.mask & taken:
                self.signals.append(signal)
                return signal
        return None

    def draw_multiplexer(self, rng: Random) -> None:
        """Try to make it a multiplexed message; every code has at least one signal, as cantools wants it."""
        length = rng.randint(1, 3)
        for _ in range(_TRIES):
            bits = _place(rng, length, self.size, big=False)
            found = FuzzSignal(name="Selector", bits=bits, big=False, is_multiplexer=True)
            taken = self.protection.mask if self.protection is not None else 0
            if bits[0] // 8 == bits[-1] // 8 and not found.mask & taken:
                break
        else:
            return
        free = [bit for bit in range(8 * self.size) if not (taken | found.mask) >> bit & 1]
        if not free:
            return
        self.multiplexer = found
        self.signals.append(found)
        bit = rng.choice(free)
        for code in range(1 << length):
            filler = FuzzSignal(name=f"Filler{code}", bits=(bit,), big=False, above=frozenset({code}))
            self.signals.append(filler)

    def dbc_lines(self, sender: str) -> list[str]:
        """Its part of the DBC."""
        number = self.identifier | (1 << 31 if self.extended else 0)
        extra = self.protection.dbc_lines if self.protection is not None else ()
        return [
            f"BO_ {number} {self.name}: {self.size} {sender}",
            *extra,
            *(signal.text() for signal in self.signals),
        ]

    def tables(self) -> list[str]:
        """Value tables, and signals with several codes of the multiplexer."""
        number = self.identifier | (1 << 31 if self.extended else 0)
        lines = []
        for signal in self.signals:
            if signal.named:
                names = " ".join(f'{code} "{name}"' for code, name in signal.named.items())
                lines.append(f"VAL_ {number} {signal.name} {names};")
            if signal.above is not None and len(signal.above) > 1:
                codes = ", ".join(f"{code}-{code}" for code in sorted(signal.above))
                lines.append(f"SG_MUL_VAL_ {number} {signal.name} Selector {codes};")
        return lines


def _place(rng: Random, length: int, size: int, *, big: bool) -> tuple[int, ...]:
    """Bits of a signal somewhere in a message, the most significant one first."""
    start = rng.randint(0, 8 * size - length)
    if big:
        return tuple(n - n % 8 + 7 - n % 8 for n in range(start, start + length))
    return tuple(reversed(range(start, start + length)))


@dataclass(kw_only=True)
class FuzzBranch:
    """One branch of the layout, and the fault of its sensor."""

    name: str
    sign: int
    message: FuzzMessage
    source: FuzzSignal
    voltage: tuple[FuzzMessage, FuzzSignal] | None = None
    target: tuple[FuzzMessage, FuzzSignal, FuzzSignal | None] | None = None
    known: bool = True
    apply: bool = True
    drift: float = 0.0
    offset_a: float = 0.0


@dataclass(kw_only=True)
class FuzzVehicle:
    """All of it."""

    sources: list[FuzzMessage]
    targets: list[FuzzMessage]
    branches: list[FuzzBranch]
    on_bad_frame: str
    drift_limit: float = 0.4

    def load(self, folder: Path) -> tuple[VehicleDatabase, VehicleParameters]:
        """Write layout and DBC, and read them as the node does."""
        (folder / "fuzz.dbc").write_text(self._dbc())
        (folder / "fuzz.toml").write_text(self._layout())
        database = read_database(read_layout(folder / "fuzz.toml"))
        return database, self._parameters(database)

    def _dbc(self) -> str:
        messages = [(message, "Sensor") for message in self.sources] + [(item, "Corrector") for item in self.targets]
        lines = ['VERSION ""', "BU_: Sensor Corrector X"]
        for message, sender in messages:
            lines += message.dbc_lines(sender)
        for message, _ in messages:
            lines += message.tables()
        return "\n".join(lines) + "\n"

    def _layout(self) -> str:
        lines = [
            f'schema = 1\nname = "fuzz"\ndbc = "fuzz.dbc"\nfull_scale_a = {_FULL_SCALE_A}',
            f'max_age_s = {_FOREVER_S}\non_bad_frame = "{self.on_bad_frame}"',
        ]
        lines.append(f"watch = {{ window_s = 3600.0, margin_a = {_FOREVER_S} }}")
        lines.append(f"limits = {{ drift = {self.drift_limit}, offset_a = {_OFFSET_LIMIT_A} }}")
        for branch in self.branches:
            kind = "signal" if branch.voltage is None else "power"
            lines.append(f'[[branch]]\nname = "{branch.name}"\nsign = {branch.sign}\ntimeout_s = {_FOREVER_S}')
            lines.append(f'{kind} = "{branch.message.name}.{branch.source.name}"\nno_value = {branch.source.unnamed}')
            if branch.voltage is not None:
                lines.append(f'voltage = "{branch.voltage[0].name}.{branch.voltage[1].name}"')
            if branch.target is not None:
                message, signal, quality = branch.target
                lines.append(f'corrected = "{message.name}.{signal.name}"')
                if quality is not None:
                    lines.append(f'quality = "{message.name}.{quality.name}"')
        lines += [
            f'[[e2e]]\nmessages = ["{message.name}"]\n{message.protection.toml}'.replace("%", message.name)
            for message in (*self.sources, *self.targets)
            if message.protection is not None
        ]
        return "\n".join(lines) + "\n"

    def _parameters(self, database: VehicleDatabase) -> VehicleParameters:
        known = [item for item in self.branches if item.known]
        return true_parameters(
            database,
            {item.name: BranchParameters(drift=item.drift, offset_a=item.offset_a, apply=item.apply) for item in known},
        )


def draw_vehicle(rng: Random) -> FuzzVehicle:
    """Draw a vehicle with at least two branches."""
    while True:
        found = _draw(rng)
        if len(found.branches) >= 2:
            return found


def _draw(rng: Random) -> FuzzVehicle:
    keys: set[tuple[int, bool]] = set()
    sources = [_draw_message(rng, f"In{k}", keys) for k in range(rng.randint(1, 4))]
    vehicle = FuzzVehicle(
        sources=sources,
        targets=[_draw_message(rng, f"Out{k}", keys, least_size=8) for k in range(rng.randint(1, 3))],
        branches=[],
        on_bad_frame=rng.choice(("hold", "invalid")),
    )
    net = _draw_voltage(rng, sources) if rng.random() < 0.5 else None
    for number in range(rng.randint(2, 6)):
        message = rng.choice(sources)
        length = rng.choice(_LENGTHS)
        source = message.draw_signal(rng, f"Current{number}", length, multiplexed=rng.random() < 0.7)
        if source is None:
            continue
        branch = FuzzBranch(name=f"b{number}", sign=rng.choice((1, -1)), message=message, source=source)
        if net is not None and rng.random() < 0.5:
            branch.voltage = net
        _draw_codes(rng, source, ("W", "kW") if branch.voltage is not None else ("A", "mA", ""))
        _draw_names(rng, source)
        _draw_fault(rng, branch)
        branch.target = _draw_target(rng, branch, vehicle.targets) if rng.random() < 0.9 else None
        vehicle.branches.append(branch)
    if all(branch.target is None for branch in vehicle.branches):
        vehicle.branches.clear()  # an overlay node would have nothing to publish
    for message in sources:  # and signals that are nobody's business
        message.draw_signal(rng, "Other", rng.choice((1, 4, 8)))
    used = {item.name for item in _used(vehicle)}
    vehicle.sources = [message for message in vehicle.sources if message.name in used]
    vehicle.targets = [message for message in vehicle.targets if message.name in used]
    return vehicle


def _used(vehicle: FuzzVehicle) -> list[FuzzMessage]:
    found = [branch.message for branch in vehicle.branches]
    found += [branch.voltage[0] for branch in vehicle.branches if branch.voltage is not None]
    return found + [branch.target[0] for branch in vehicle.branches if branch.target is not None]


def _draw_message(rng: Random, name: str, keys: set[tuple[int, bool]], least_size: int = 1) -> FuzzMessage:
    extended = rng.random() < 0.3
    while True:
        key = rng.getrandbits(29 if extended else 11), extended
        if key not in keys:
            break
    keys.add(key)
    size = rng.choice([size for size in _SIZES if size >= least_size])
    message = FuzzMessage(
        name=name,
        identifier=key[0],
        extended=extended,
        size=size,
        protection=draw_protection(rng, key[0], size) if rng.random() < 0.7 else None,
    )
    if least_size == 1 and rng.random() < 0.35:
        message.draw_multiplexer(rng)
    return message


def _draw_voltage(rng: Random, sources: Sequence[FuzzMessage]) -> tuple[FuzzMessage, FuzzSignal] | None:
    message = rng.choice(sources)
    signal = message.draw_signal(rng, "Net", rng.choice((6, 8, 12)), multiplexed=rng.random() < 0.5)
    if signal is None:
        return None
    signal.unit, signal.scale, signal.signed = "V", rng.choice(("0.01", "0.5", "-0.1")), rng.random() < 0.3
    _draw_names(rng, signal)
    signal.unnamed = []  # that is for branches
    return message, signal


def _draw_codes(rng: Random, signal: FuzzSignal, units: Sequence[str]) -> None:
    signal.signed = rng.random() < 0.6
    signal.scale, signal.offset, signal.unit = rng.choice(_SCALES), rng.choice(_OFFSETS), rng.choice(units)
    lowest, highest = signal.width_range
    quarter = (highest - lowest) // 4
    if len(signal.bits) <= _LONGEST_WITH_RANGE and rng.random() < 0.6 and quarter:
        signal.range = lowest + rng.randint(0, quarter), highest - rng.randint(0, quarter)


def _draw_names(rng: Random, signal: FuzzSignal) -> None:
    """Name some codes, but not that of zero or beside it, and none where too few would be left."""
    zero = zero_code(signal)
    spared = range(zero - 1, zero + 2)
    lowest, highest = signal.width_range
    if len(signal.bits) < 3:
        return
    for number in range(rng.randint(0, 3)):
        code = rng.choice((lowest, highest, rng.randint(lowest, highest), highest - rng.randint(0, 3)))
        if code not in spared and code not in signal.named:
            signal.named[code] = f"Name{number}"
    if rng.random() < 0.3:
        code = rng.randint(lowest, highest)
        if code not in spared:
            signal.unnamed.append(code)


def zero_code(signal: FuzzSignal) -> int:
    """Code nearest to zero, halves up, inside width and range."""
    lowest, highest = signal.range or signal.width_range
    code = -Fraction(signal.offset) / Fraction(signal.scale) + Fraction(1, 2)
    return min(max(code.numerator // code.denominator, lowest), highest)


def _draw_fault(rng: Random, branch: FuzzBranch) -> None:
    branch.known, branch.apply = rng.random() < 0.95, rng.random() < 0.9
    branch.drift = rng.choice((0.0, 0.02, round(rng.uniform(-0.4, 0.4), 4)))
    branch.offset_a = rng.choice((0.0, 3.0, round(rng.uniform(-50.0, 50.0), 3)))


def _draw_target(
    rng: Random, branch: FuzzBranch, targets: Sequence[FuzzMessage]
) -> tuple[FuzzMessage, FuzzSignal, FuzzSignal | None] | None:
    message = rng.choice(targets)
    signal = message.draw_signal(rng, f"Out{branch.name}", rng.choice([n for n in _LENGTHS if n >= 3]))
    if signal is None:
        return None
    _draw_codes(rng, signal, ("W", "kW") if branch.voltage is not None else ("A", "mA", ""))
    lowest, highest = signal.width_range
    zero = zero_code(signal)
    signal.named[lowest if zero != lowest else highest] = "SNA"
    code = highest - rng.randint(0, 2)
    if code not in {zero - 1, zero, zero + 1, *signal.named}:
        signal.named[code] = "Error"
    return message, signal, message.draw_signal(rng, f"Quality{branch.name}", rng.randint(2, 4))
