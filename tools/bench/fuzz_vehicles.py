"""Random vehicles for fuzz tests: DBC, layout and parameters with all that the node knows, drawn from a seed.

Signals of 1 to 64 bits in both byte orders and on any bit, multiplexed or not, with negative factors, ranges and named
codes; powers with their voltage; every profile of protection; messages of 1 to 64 bytes with 11 and 29 bits of
identifier.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from e2e import p01, p02, p04, p05, p06, p07, p11
from fastcrc import crc8

from bench.true_parameters import true_parameters
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, VehicleParameters

__all__ = ["FuzzBranch", "FuzzMessage", "FuzzSignal", "FuzzVehicle", "Protection", "Window", "draw_vehicle"]

_SCALES = ("0.1", "-0.05", "1", "0.02", "0.001", "-0.25", "3", "0.0078125", "100", "-1")
_OFFSETS = ("0", "0", "-400", "12.5", "-0.3")
_LENGTHS = (1, 2, 3, 5, 8, 10, 12, 13, 15, 16, 17, 20, 24, 31, 32, 33, 47, 63, 64)
_SIZES = (1, 2, 3, 4, 6, 7, 8, 8, 8, 8, 8, 12, 16, 24, 32, 48, 64)
_FACTORS = {"mA": Fraction(1, 1000), "kW": Fraction(1000)}
_TRIES = 50
_LONGEST_WITH_RANGE = 24
"""Longer ranges have more digits than a floating-point number. [bit]"""
_SETTINGS = """schema = 1
name = "fuzz"
dbc = "fuzz.dbc"
full_scale_a = 1e-9  # every vehicle reaches it, wherever its signals have names
max_age_s = 1e6
watch = { window_s = 3600.0, margin_a = 1e6 }
limits = { drift = 0.4, offset_a = 160.0 }
"""


class Window(NamedTuple):
    """What makes a message valid in one state of it."""

    window: int
    min_ok: int
    max_error: int


@dataclass(frozen=True, kw_only=True)
class Protection:
    """How the frames of one message are protected.

    Attributes
    ----------
    mask : int
        Bits of the header in the payload read as a little-endian integer.
    place : tuple of int
        Byte, bytes, bits below and bits of the counter, the most significant byte first.
    modulus, max_step : int
        Codes of the counter, and its largest step that is used.
    seal : callable
        Writes all but the counter into a payload.
    toml, dbc : str
        Its part of the layout, in which "%" is the message's name, and of the DBC.
    windows : tuple of Window
        In the states INIT, VALID and INVALID.
    """

    mask: int
    place: tuple[int, int, int, int]
    modulus: int
    max_step: int
    seal: Callable[[bytearray], None]
    toml: str
    dbc: str = ""
    windows: tuple[Window, ...]

    @property
    def least(self) -> int:
        """Bytes that a frame needs."""
        return (self.mask.bit_length() + 7) // 8

    def counter(self, payload: bytes) -> int:
        """The counter of a payload."""
        byte, count, shift, bits = self.place
        return int.from_bytes(payload[byte : byte + count], "big") >> shift & (1 << bits) - 1

    def is_sound(self, payload: bytes) -> bool:
        """Whether all but the counter is right."""
        sealed = bytearray(payload)
        self.seal(sealed)
        return sealed == payload


@dataclass(kw_only=True, eq=False)
class FuzzSignal:
    """One signal of the DBC, and what its codes are worth.

    Attributes
    ----------
    message : FuzzMessage
        Where it is.
    bits : tuple of int
        Its bits from the most significant one, numbered as in a little-endian integer.
    range : tuple of int or None
        Least and greatest code in the DBC's range.
    named, unnamed : dict of int to str, list of int
        Codes with names in the DBC; codes that the layout says are no values.
    above : frozenset of int or None
        Codes of the message's selector with which it is there.
    """

    message: "FuzzMessage"
    name: str
    bits: tuple[int, ...]
    big: bool
    signed: bool = False
    scale: Decimal = Decimal(1)
    offset: Decimal = Decimal(0)
    unit: str = ""
    range: tuple[int, int] | None = None
    named: dict[int, str] = field(default_factory=dict)
    unnamed: list[int] = field(default_factory=list)
    above: frozenset[int] | None = None

    @property
    def mask(self) -> int:
        """Its bits in a little-endian integer."""
        return sum(1 << bit for bit in self.bits)

    @property
    def end(self) -> int:
        """Bytes that a frame needs to have it."""
        return max(self.bits) // 8 + 1

    @property
    def width(self) -> tuple[int, int]:
        """Codes that the width can hold."""
        n = len(self.bits)
        return (-(1 << (n - 1)), (1 << (n - 1)) - 1) if self.signed else (0, (1 << n) - 1)

    @property
    def span(self) -> tuple[int, int]:
        """Codes of the DBC's range, or of the width."""
        return self.range or self.width

    @property
    def zero(self) -> int:
        """Code nearest to zero, halves up, inside the span."""
        lowest, highest = self.span
        return min(max((self.exact_code(Fraction(0)) + Fraction(1, 2)).__floor__(), lowest), highest)

    @property
    def ends(self) -> tuple[int, int]:
        """Ends of the values around zero, in which results are kept."""
        (lowest, highest), codes = self.span, (*self.named, *self.unnamed)
        lowest = max([lowest, *(code + 1 for code in codes if code < self.zero)])
        return lowest, min([highest, *(code - 1 for code in codes if code > self.zero)])

    def is_value(self, code: int) -> bool:
        """Whether a code is a number."""
        return self.span[0] <= code <= self.span[1] and code not in self.named and code not in self.unnamed

    def worth(self, code: int) -> Fraction:
        """What a code says, in A, W or V."""
        return (Fraction(self.scale) * code + Fraction(self.offset)) * _FACTORS.get(self.unit, 1)

    def exact_code(self, value: Fraction) -> Fraction:
        """The code of a value in A, W or V, before it is rounded."""
        return (value / _FACTORS.get(self.unit, 1) - Fraction(self.offset)) / Fraction(self.scale)

    def text(self) -> str:
        """Its line of the DBC."""
        low, high = sorted(self.scale * code + self.offset for code in self.range or ()) or (Decimal(0), Decimal(0))
        kind = " M" if self is self.message.selector else "" if self.above is None else f" m{min(self.above)}"
        start = self.bits[0] if self.big else self.bits[-1]
        place = f"{start}|{len(self.bits)}@{int(not self.big)}{'-' if self.signed else '+'}"
        return f' SG_ {self.name}{kind} : {place} ({self.scale},{self.offset}) [{low:f}|{high:f}] "{self.unit}" X'


@dataclass(kw_only=True, eq=False)
class FuzzMessage:
    """One message of the DBC; its selector, if it has one, tells which of its other signals a frame has."""

    name: str
    number: int
    """Identifier; bit 31: it has 29 bits."""
    size: int
    protection: Protection | None
    signals: list[FuzzSignal] = field(default_factory=list)
    selector: FuzzSignal | None = None

    def draw_signal(
        self, rng: Random, name: str, length: int, *, multiplexed: bool = False, little: bool = False
    ) -> FuzzSignal | None:
        """Place a signal of some length where no other one is; None if there is no room."""
        above = None
        if multiplexed and self.selector is not None:
            codes = range(1 << len(self.selector.bits))
            above = frozenset(rng.sample(codes, rng.randint(1, max(1, len(codes) // 2))))
        taken = self.protection.mask if self.protection is not None else 0
        for other in self.signals:
            if other.above is None or above is None or other.above & above:
                taken |= other.mask
        for _ in range(_TRIES if length <= 8 * self.size else 0):
            big, start = not little and rng.random() < 0.5, rng.randint(0, 8 * self.size - length)
            places = range(start, start + length)
            bits = tuple(n - n % 8 + 7 - n % 8 for n in places) if big else tuple(reversed(places))
            signal = FuzzSignal(message=self, name=name, bits=bits, big=big, above=above)
            if not signal.mask & taken:
                self.signals.append(signal)
                return signal
        return None

    def draw_selector(self, rng: Random) -> None:
        """Try to make it a multiplexed message; one bit is there with every code, as cantools wants it."""
        selector = self.draw_signal(rng, "Selector", rng.randint(1, 3), little=True)
        filler = self.draw_signal(rng, "Filler", 1, little=True) if selector is not None else None
        if selector is None or filler is None or selector.bits[0] // 8 != selector.bits[-1] // 8:
            self.signals.clear()
            return
        self.selector, filler.above = selector, frozenset(range(1 << len(selector.bits)))

    def dbc(self, sender: str) -> tuple[list[str], list[str]]:
        """Its lines of the DBC: signals, and value tables and codes of the selector."""
        number, lines = (
            self.number,
            [f"BO_ {self.number} {self.name}: {self.size} {sender}", *(signal.text() for signal in self.signals)],
        )
        lines += [self.protection.dbc] if self.protection is not None and self.protection.dbc else []
        tables = []
        for signal in self.signals:
            if signal.named:
                names = " ".join(f'{code} "{name}"' for code, name in signal.named.items())
                tables.append(f"VAL_ {number} {signal.name} {names};")
            if signal.above is not None and len(signal.above) > 1:
                codes = ", ".join(f"{code}-{code}" for code in sorted(signal.above))
                tables.append(f"SG_MUL_VAL_ {number} {signal.name} Selector {codes};")
        return lines, tables


@dataclass(kw_only=True)
class FuzzBranch:
    """One branch of the layout, and the fault of its sensor."""

    name: str
    sign: int
    source: FuzzSignal
    voltage: FuzzSignal | None = None
    target: FuzzSignal | None = None
    quality: FuzzSignal | None = None
    known: bool = True
    apply: bool = True
    drift: float = 0.0
    offset_a: float = 0.0

    def toml(self) -> str:
        """Its part of the layout."""
        used = {
            "signal" if self.voltage is None else "power": self.source,
            "voltage": self.voltage,
            "corrected": self.target,
            "quality": self.quality,
        }
        lines = [f'{key} = "{signal.message.name}.{signal.name}"' for key, signal in used.items() if signal is not None]
        lines += [f'name = "{self.name}"', f"sign = {self.sign}", "timeout_s = 1e6"]
        return "\n".join(["[[branch]]", *lines, f"no_value = {self.source.unnamed}"])


@dataclass(kw_only=True)
class FuzzVehicle:
    """All of it."""

    sources: list[FuzzMessage]
    targets: list[FuzzMessage]
    branches: list[FuzzBranch]
    on_bad_frame: str

    def load(self, folder: Path) -> tuple[VehicleDatabase, VehicleParameters]:
        """Write layout and DBC, and read them as the node does."""
        messages = [*((item, "Sensor") for item in self.sources), *((item, "Corrector") for item in self.targets)]
        parts = [message.dbc(sender) for message, sender in messages]
        lines = ['VERSION ""', "BU_: Sensor Corrector X"]
        lines += [line for kind in zip(*parts, strict=True) for some in kind for line in some]
        (folder / "fuzz.dbc").write_text("\n".join(lines) + "\n")
        protections = [
            f'[[e2e]]\nmessages = ["{message.name}"]\n{message.protection.toml}'.replace("%", message.name)
            for message, _ in messages
            if message.protection is not None
        ]
        texts = [f'on_bad_frame = "{self.on_bad_frame}"', *(branch.toml() for branch in self.branches), *protections]
        (folder / "fuzz.toml").write_text(_SETTINGS + "\n".join(texts) + "\n")
        database = read_database(read_layout(folder / "fuzz.toml"))
        faults = {
            item.name: BranchParameters(drift=item.drift, offset_a=item.offset_a, apply=item.apply)
            for item in self.branches
            if item.known
        }
        return database, true_parameters(database, faults)


def draw_vehicle(rng: Random) -> FuzzVehicle:
    """Draw a vehicle with at least two branches, one of which an overlay node publishes."""
    while True:
        found = _draw(rng)
        if len(found.branches) >= 2 and any(branch.target is not None for branch in found.branches):
            return found


def _draw(rng: Random) -> FuzzVehicle:
    sources = [_draw_message(rng, f"In{k}", k) for k in range(rng.randint(1, 4))]
    targets = [_draw_message(rng, f"Out{k}", 4 + k, least_size=8) for k in range(rng.randint(1, 3))]
    on_bad_frame, net, branches = rng.choice(("hold", "invalid")), None, []
    if rng.random() < 0.5:
        net = rng.choice(sources).draw_signal(rng, "Net", rng.choice((6, 8, 12)), multiplexed=rng.random() < 0.5)
    if net is not None:
        net.unit, net.scale, net.signed = "V", Decimal(rng.choice(("0.01", "0.5", "-0.1"))), rng.random() < 0.3
        _name_codes(rng, net)
        net.unnamed = []  # that is for branches
    for number in range(rng.randint(2, 6)):
        length, multiplexed = rng.choice(_LENGTHS), rng.random() < 0.7
        source = rng.choice(sources).draw_signal(rng, f"Current{number}", length, multiplexed=multiplexed)
        if source is not None:
            branches.append(_draw_branch(rng, f"b{number}", source, net, targets))
    for message in sources:  # and signals that are nobody's business
        message.draw_signal(rng, "Other", rng.choice((1, 4, 8)))
    used = {
        signal.message.name
        for branch in branches
        for signal in (branch.source, branch.voltage, branch.target)
        if signal is not None
    }
    return FuzzVehicle(
        sources=[message for message in sources if message.name in used],
        targets=[message for message in targets if message.name in used],
        branches=branches,
        on_bad_frame=on_bad_frame,
    )


def _draw_branch(
    rng: Random, name: str, source: FuzzSignal, net: FuzzSignal | None, targets: Sequence[FuzzMessage]
) -> FuzzBranch:
    branch = FuzzBranch(name=name, sign=rng.choice((1, -1)), source=source)
    branch.voltage = net if rng.random() < 0.5 else None
    units = ("W", "kW") if branch.voltage is not None else ("A", "mA", "")
    _draw_codes(rng, source, units)
    _name_codes(rng, source)
    branch.known, branch.apply = rng.random() < 0.95, rng.random() < 0.9
    branch.drift = rng.choice((0.0, 0.02, round(rng.uniform(-0.4, 0.4), 4)))
    branch.offset_a = rng.choice((0.0, 3.0, round(rng.uniform(-50.0, 50.0), 3)))
    if rng.random() < 0.9:
        message, length = rng.choice(targets), rng.choice([n for n in _LENGTHS if n >= 3])
        branch.target = target = message.draw_signal(rng, f"Out{name}", length)
        if target is not None:
            _draw_codes(rng, target, units)
            (lowest, highest), zero = target.width, target.zero
            target.named[lowest if zero != lowest else highest] = "SNA"
            code = highest - rng.randint(0, 2)
            if code not in {zero - 1, zero, zero + 1, *target.named}:
                target.named[code] = "Error"
            branch.quality = message.draw_signal(rng, f"Quality{name}", rng.randint(2, 4))
    return branch


def _draw_message(rng: Random, name: str, low: int, least_size: int = 1) -> FuzzMessage:
    """A message whose identifier ends in these three bits."""
    number = rng.getrandbits(26) << 3 | low | 1 << 31 if rng.random() < 0.3 else rng.getrandbits(8) << 3 | low
    size = rng.choice([size for size in _SIZES if size >= least_size])
    protection = _draw_protection(rng, number & 0x1FFFFFFF, size) if rng.random() < 0.7 else None
    message = FuzzMessage(name=name, number=number, size=size, protection=protection)
    if least_size == 1 and rng.random() < 0.35:
        message.draw_selector(rng)
    return message


def _draw_codes(rng: Random, signal: FuzzSignal, units: Sequence[str]) -> None:
    signal.signed, signal.unit = rng.random() < 0.6, rng.choice(units)
    signal.scale, signal.offset = Decimal(rng.choice(_SCALES)), Decimal(rng.choice(_OFFSETS))
    lowest, highest = signal.width
    quarter = (highest - lowest) // 4
    if len(signal.bits) <= _LONGEST_WITH_RANGE and rng.random() < 0.6 and quarter:
        signal.range = lowest + rng.randint(0, quarter), highest - rng.randint(0, quarter)


def _name_codes(rng: Random, signal: FuzzSignal) -> None:
    """Name some codes, but not that of zero or beside it, and none where too few would be left."""
    spared, (lowest, highest) = range(signal.zero - 1, signal.zero + 2), signal.width
    if len(signal.bits) < 3:
        return
    for number in range(rng.randint(0, 3)):
        code = rng.choice((lowest, highest, rng.randint(lowest, highest), highest - rng.randint(0, 3)))
        if code not in spared and code not in signal.named:
            signal.named[code] = f"Name{number}"
    code = rng.randint(lowest, highest)
    if rng.random() < 0.3 and code not in spared:
        signal.unnamed.append(code)


_PROFILES: dict[str, tuple[Callable[..., None], int, int, int, int]] = {
    "P01": (p01.e2e_p01_protect, 12, 1, 4, 15),
    "P02": (p02.e2e_p02_protect, 12, 1, 4, 16),
    "P04": (p04.e2e_p04_protect, 96, 2, 16, 1 << 16),
    "P05": (p05.e2e_p05_protect, 24, 2, 8, 256),
    "P06": (p06.e2e_p06_protect, 40, 4, 8, 256),
    "P07": (p07.e2e_p07_protect, 160, 12, 32, 1 << 32),
    "P11": (p11.e2e_p11_protect, 12, 1, 4, 15),
}
"""Function of autosar-e2e, bits of the header, byte and bits of the counter, and its codes."""
_MODES = {
    "both": p01.E2E_P01_DATAID_BOTH,
    "alternating": p01.E2E_P01_DATAID_ALT,
    "low": p01.E2E_P01_DATAID_LOW,
    "nibble": p01.E2E_P01_DATAID_NIBBLE,
}


def _draw_protection(rng: Random, identifier: int, size: int) -> Protection | None:
    """Draw a profile that fits a message and leaves room in it; None if there is none."""
    fitting = [name for name, (_, bits, *_) in _PROFILES.items() if bits <= 8 * (size - 1)]
    seldom = [name for name in fitting if name in {"P04", "P07"}]  # they fit few messages
    name, step = rng.choice([*fitting, *seldom, "P01", "CRC8"]), rng.randint(1, 4)
    windows: tuple[Window, ...] = (Window(1, 0, 1),) * 3  # each frame counts by itself
    if rng.random() < 0.5:
        sizes = [rng.randint(1, 12) for _ in range(3)]
        windows = tuple(Window(n, rng.randint(0, (n + 1) // 2), rng.randint(0, n // 2)) for n in sizes)
    states = zip(("init", "valid", "invalid"), windows, strict=True)
    toml = "".join(f"{state} = {{ window = {w}, min_ok = {ok}, max_error = {e} }}\n" for state, (w, ok, e) in states)
    common: dict[str, Any] = {"max_step": step, "windows": windows, "toml": f"max_delta_counter = {step}\n{toml}"}
    if name == "CRC8":
        return _counter_crc8(rng, identifier & 0xFFFF, size, **common) if size >= 3 else None
    return _autosar(rng, name, identifier, size, **common) if name in fitting else None


def _autosar(rng: Random, name: str, identifier: int, size: int, *, toml: str, **common: Any) -> Protection:
    protect, header_bits, counter_byte, counter_bits, modulus = _PROFILES[name]
    toml += f'profile = "{name}"\n'
    if name == "P02":
        numbers = rng.randbytes(16)
        identity: int | bytes = numbers
        offset, mode, options = 0, "", dict[str, int]()
        toml += f'data_id_list = {{ "%" = {[*numbers]} }}\n'
    else:
        offset = rng.choice((0, 0, 0, rng.randrange(size - (header_bits + 7) // 8)))
        mode = rng.choice({"P01": ("both", *_MODES), "P11": ("both", "nibble")}.get(name, ("",)))
        options = {"offset": offset, **({"data_id_mode": _MODES[mode]} if mode else {})}
        longest = 0xFFFFFFFF if name in {"P04", "P07"} else 0xFFFF
        identity, given = identifier & longest, rng.random() < 0.5
        if given:
            identity = rng.randrange(longest + 1)
            toml += f'data_id = {{ "%" = {identity} }}\n'
        toml += f"offset = {offset}\n" + (f'data_id_mode = "{mode}"\n' if mode else "")

    def seal(payload: bytearray) -> None:
        protect(payload, identity, increment_counter=False, **options)

    return Protection(
        mask=(1 << header_bits + 4 * (mode == "nibble")) - 1 << 8 * offset,
        place=(offset + counter_byte, (counter_bits + 7) // 8, 0, counter_bits),
        modulus=modulus,
        seal=seal,
        toml=toml,
        **common,
    )


def _counter_crc8(rng: Random, data_id: int, size: int, *, toml: str, **common: Any) -> Protection:
    """A counter and a CRC-8 over all other bytes, both signals of the DBC."""
    byte, counter_byte = rng.sample(range(min(size, 4)), 2)
    shift, bytes_of_id, place = rng.choice((0, 3, 4)), rng.choice((0, 1, 2)), rng.choice(("before", "after"))
    modulus, algorithm = rng.choice((15, 16)), rng.choice(("sae_j1850", "autosar"))
    crc, identity = getattr(crc8, algorithm), data_id.to_bytes(2, "little")[:bytes_of_id]

    def seal(payload: bytearray) -> None:
        rest = bytes(payload[:byte] + payload[byte + 1 :])
        payload[byte] = crc(identity + rest if place == "before" else rest + identity)

    toml += f'profile = "counter CRC8"\ncounter = "Counter"\ncrc = "Crc"\nalgorithm = "{algorithm}"\n'
    toml += f'counter_modulus = {modulus}\ndata_id_bytes = {bytes_of_id}\ndata_id_at = "{place}"\n'
    return Protection(
        mask=0xFF << 8 * byte | 0xF << (8 * counter_byte + shift),
        place=(counter_byte, 1, shift, 4),
        modulus=modulus,
        seal=seal,
        toml=toml,
        dbc=f' SG_ Crc : {8 * byte}|8@1+ (1,0) [0|0] "" X\n'
        f' SG_ Counter : {8 * counter_byte + shift}|4@1+ (1,0) [0|0] "" X',
        **common,
    )
