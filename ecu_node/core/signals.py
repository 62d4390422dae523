"""A signal of the DBC: its raw integer in a frame, and the values of its codes.

The bytes that a signal touches are one integer of its own byte order; the signal is ``length`` bits of it, ``shift``
bits above the least significant one. No other bit is ever touched. A multiplexed signal is in a frame only if each
multiplexer above it has one of the codes with which the signal is sent. value = scale * code + offset, with scale and
offset as the decimals that stand in the DBC, held exactly. A code is a value if it lies in the DBC's [minimum|maximum]
and has no name in the DBC's value table: a named code of a current ("SNA", "Error") is a message, not a number of
amperes.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Literal, NamedTuple

from cantools.database.can import Message, Signal
from cantools.database.utils import start_bit

from ecu_node.errors import DatabaseError

AMPERE: Mapping[str, float] = {"A": 1.0, "mA": 1e-3, "kA": 1e3}
VOLT: Mapping[str, float] = {"V": 1.0, "mV": 1e-3, "kV": 1e3}
WATT: Mapping[str, float] = {"W": 1.0, "kW": 1e3, "mW": 1e-3, "MW": 1e6}

_SPELLED = re.compile(
    r"(?:unit_|\w+:)?(milli|kilo|mega|[mk])?(a|v|w|(?:amp|amper|ampere|volt|watt)s?)([ _]?(ac|dc|rms))?", re.IGNORECASE
)
"""Spellings of units in the databases of several makers, such as ``Unit_Amper`` or ``current:A``."""
_PER_BIT = re.compile(r"(\d*\.?\d+) ?(\w+)/bit\??", re.IGNORECASE)
_PREFIX = {"": "", "milli": "m", "m": "m", "kilo": "k", "k": "k", "mega": "M"}


def usual_unit(text: str) -> str:
    """Spell a unit as this program does: ``A`` for ``Amps``, ``[A]`` or ``A_DC``, ``kW`` for ``KW`` or ``kilowatt``.

    Any text that is no spelling of A, V or W is returned without the blanks and brackets around it.
    """
    bare = text.strip().strip("[](){}<>").strip()
    found = _SPELLED.fullmatch(bare)
    if bare in WATT or found is None:  # mW and MW differ by their case alone
        return bare
    return _PREFIX[(found[1] or "").lower()] + found[2][0].upper()


def unit_factor(signal: Signal, known: Mapping[str, float], where: str) -> float:
    """Return the factor that turns the values of a signal into the base unit, such as 1000 for kW into W.

    Parameters
    ----------
    signal : Signal
        A signal of the DBC. A signal without unit counts as being in the base unit.
    known : mapping of str to float
        One of :data:`AMPERE`, :data:`VOLT`, :data:`WATT`.
    where : str
        What the signal is for, for the message of the error.

    Returns
    -------
    float
        The factor. [base unit / unit of the signal]

    Raises
    ------
    DatabaseError
        If the unit is of another quantity.
    """
    unit, step = signal.unit or "", 1.0
    if per_bit := _PER_BIT.fullmatch(unit):  # "50W/bit" repeats the scale, or replaces one of 1
        unit, step = per_bit[2], float(per_bit[1]) if signal.scale == 1 else 1.0
    return step * factor_of(unit, known, f"{where}: signal {signal.name}")


def factor_of(unit: str, known: Mapping[str, float], what: str) -> float:
    """Return the factor from a unit to the base unit, 1 for an empty text.

    Raises DatabaseError if the unit is not known: "`what` is in 'V'; expected A, mA, kA".
    """
    if not unit:
        return 1.0
    try:
        return known[usual_unit(unit)]
    except KeyError:
        raise DatabaseError(f"{what} is in {unit!r}; expected {', '.join(known)}") from None


_BITS_PER_BYTE = 8
_LONGEST = 64
"""Longest integer signal on CAN. [bit]"""


Order = Literal["little", "big"]
"""Byte order."""


class FrameKey(NamedTuple):
    """Identifier of a frame; the same number with 11 and with 29 bits is two different identifiers."""

    identifier: int
    extended: bool


@dataclass(frozen=True, kw_only=True)
class BitPlace:
    """Where the raw integer of one signal stands.

    Attributes
    ----------
    first, end : int
        The signal touches the bytes ``first`` to ``end - 1`` of the payload.
    order : "little" or "big"
        Byte order.
    shift : int
        Bits below the signal in the integer made of these bytes.
    length : int
        Width of the signal, 1 to 64. [bit]
    signed : bool
        Whether the raw integer is a two's complement.
    """

    first: int
    end: int
    order: Order
    shift: int
    length: int
    signed: bool

    @cached_property
    def lowest(self) -> int:
        """Least raw integer that the width can hold."""
        return -(1 << (self.length - 1)) if self.signed else 0

    @cached_property
    def highest(self) -> int:
        """Greatest raw integer that the width can hold."""
        return (1 << (self.length - self.signed)) - 1

    @cached_property
    def ones(self) -> int:
        """All bits of the width."""
        return (1 << self.length) - 1

    @cached_property
    def mask(self) -> int:
        """The signal's bits in the payload read as one little-endian integer."""
        field = self.ones << self.shift
        placed = bytes(self.first) + field.to_bytes(self.end - self.first, self.order)
        return int.from_bytes(placed, "little")

    def shift_in(self, payload_bytes: int) -> int:
        """Count the bits below the signal in a payload of this length [byte], read as one integer of its byte order."""
        return self.shift + _BITS_PER_BYTE * (self.first if self.order == "little" else payload_bytes - self.end)

    def extract(self, payload: bytes | bytearray) -> int | None:
        """Read the raw integer.

        Parameters
        ----------
        payload : bytes
            Data of a frame, 0 to 64 bytes.

        Returns
        -------
        int or None
            The raw integer; None if the frame is too short to hold the signal.
        """
        if len(payload) < self.end:
            return None
        field = int.from_bytes(payload[self.first : self.end], self.order) >> self.shift
        raw = field & self.ones
        return raw - (1 << self.length) if raw > self.highest else raw

    def put(self, payload: bytearray, raw: int) -> None:
        """Write the raw integer in place; all other bits stay as they are.

        Parameters
        ----------
        payload : bytearray
            Data of a frame that holds the signal, changed in place.
        raw : int
            Between :attr:`lowest` and :attr:`highest`.

        Raises
        ------
        ValueError
            If the raw integer does not fit the width: the caller must saturate, as nothing wraps.
        """
        if not self.lowest <= raw <= self.highest:
            raise ValueError(f"raw code {raw} does not fit into {self.length} bits")
        field = int.from_bytes(payload[self.first : self.end], self.order)
        field = field & ~(self.ones << self.shift) | (raw & self.ones) << self.shift
        payload[self.first : self.end] = field.to_bytes(self.end - self.first, self.order)


def bit_place(signal: Signal, what: str = "") -> BitPlace:
    """Return the place of a signal of the DBC.

    Parameters
    ----------
    signal : Signal
        An integer signal; where it is multiplexed, see :func:`placed_signal`.
    what : str
        Its use and name, for messages of errors; ``signal NAME`` if not given.

    Returns
    -------
    BitPlace
        Its place.

    Raises
    ------
    DatabaseError
        If the signal is a floating-point number or wider than 64 bits.
    """
    what = what or f"signal {signal.name}"
    if signal.is_float:
        raise DatabaseError(
            f"{what} is a floating-point number in the DBC; the node reads and writes integers only: name an integer "
            f"signal in its place, or leave out what needs it"
        )
    low = start_bit(signal)  # for a big-endian signal the most significant bit, numbered from the top of its byte
    if low < 0 or not 1 <= signal.length <= _LONGEST:
        raise DatabaseError(
            f"{what} has {signal.length} bits from bit {signal.start} on; 1 to {_LONGEST} bits from 0 on are expected"
        )
    high = low + signal.length - 1
    is_little = signal.byte_order == "little_endian"
    return BitPlace(
        first=low // _BITS_PER_BYTE,
        end=high // _BITS_PER_BYTE + 1,
        order="little" if is_little else "big",
        shift=low % _BITS_PER_BYTE if is_little else _BITS_PER_BYTE - 1 - high % _BITS_PER_BYTE,
        length=signal.length,
        signed=signal.is_signed,
    )


@dataclass(frozen=True, kw_only=True)
class Multiplexer:
    """A multiplexer signal: its code decides whether another signal is in a frame.

    Attributes
    ----------
    place : BitPlace
        Place of the multiplexer.
    codes : frozenset of int
        Its raw codes with which the other signal is in the frame.
    """

    place: BitPlace
    codes: frozenset[int]


@dataclass(frozen=True, kw_only=True)
class PlacedSignal:
    """A signal, and the multiplexers that decide whether it is in a frame."""

    place: BitPlace
    above: tuple[Multiplexer, ...] = ()

    @property
    def end(self) -> int:
        """Bytes that a payload must have for the signal and its multiplexers to be in it."""
        return max(self.place.end, *(item.place.end for item in self.above), 0)

    def code(self, payload: bytes | bytearray) -> int | None:
        """Return the raw code of the signal in a payload; None if it is not there."""
        if all(item.place.extract(payload) in item.codes for item in self.above):
            return self.place.extract(payload)
        return None


def placed_signal(message: Message, signal: Signal) -> PlacedSignal:
    """Return where a signal of the DBC stands, and in which frames.

    Parameters
    ----------
    message : Message
        The signal's message.
    signal : Signal
        Any of its signals.

    Returns
    -------
    PlacedSignal
        The signal with all its multiplexers, the nearest one first; none for a signal that is in every frame.

    Raises
    ------
    DatabaseError
        If the signal or one of its multiplexers is a floating-point number or wider than 64 bits, if the message lacks
        one of the multiplexers, or if they multiplex each other in a circle.
    """
    return PlacedSignal(place=bit_place(signal), above=_multiplexers(message, signal))


def _multiplexers(message: Message, signal: Signal) -> tuple[Multiplexer, ...]:
    """Return the multiplexers above a signal, the nearest one first; errors are those of :func:`placed_signal`."""
    found, inner = list[Multiplexer](), signal
    while inner.multiplexer_ids is not None and inner.multiplexer_signal is not None:
        above = next((item for item in message.signals if item.name == inner.multiplexer_signal), None)
        if above is None or len(found) == len(message.signals):
            has = "has no signal" if above is None else "multiplexes in a circle by"
            raise DatabaseError(
                f"message {message.name} {has} {inner.multiplexer_signal!r}, the multiplexer of its signal "
                f"{inner.name}; correct the DBC"
            )
        found.append(Multiplexer(place=bit_place(above), codes=frozenset(inner.multiplexer_ids)))
        inner = above
    return tuple(found)


def _bits(signal: Signal) -> set[int]:
    """Return the bits of any signal, also of a floating-point number, each as 8 * byte + bit of the byte."""
    low = start_bit(signal)
    from_top = 0 if signal.byte_order == "little_endian" else _BITS_PER_BYTE - 1
    return {bit ^ from_top for bit in range(low, low + signal.length)}


def overlapping(message: Message, signal: Signal) -> list[str]:
    """Return the names of the other signals of a message that share bits with a signal in one frame.

    Signals that never come in one frame, as a multiplexer chooses between them, may share bits. Errors are those of
    :func:`placed_signal`.
    """
    bits, above = _bits(signal), _multiplexers(message, signal)
    return [
        other.name
        for other in message.signals
        if other is not signal
        and bits & _bits(other)
        and all(
            one.codes & two.codes for one in above for two in _multiplexers(message, other) if one.place == two.place
        )
    ]


_NOT_AVAILABLE_NAMES = ("sna", "notavailable", "signalnotavailable", "na", "invalid", "error")
"""Names of the code for "no value", letters only, the best one first."""


@dataclass(frozen=True, kw_only=True)
class Codes:
    """Raw codes of one signal, and the values that they stand for.

    Attributes
    ----------
    name : str
        The signal.
    place : BitPlace
        Where it stands in the frame.
    scale, offset : Fraction
        value = scale * code + offset. [A, V or W]
    lowest, highest : int
        Ends of the codes that the width and the DBC's range allow.
    named : mapping of int to str
        Codes with a name; they are no values.
    """

    name: str
    place: BitPlace
    scale: Fraction
    offset: Fraction
    lowest: int
    highest: int
    named: Mapping[int, str]

    def is_value(self, code: int) -> bool:
        """Check whether a code stands for a number, rather than for a name or outside the DBC's range."""
        return self.lowest <= code <= self.highest and code not in self.named

    def worth(self, code: int) -> Fraction:
        """Return the value of a code, whether it has a name or not."""
        return self.scale * code + self.offset

    def nearest(self, value: Fraction) -> int:
        """Return the code nearest to a value, halves up, inside the width and the DBC's range."""
        code = math.floor((value - self.offset) / self.scale + Fraction(1, 2))
        return min(max(code, self.lowest), self.highest)


_ENDLESS = 1e300
"""Limits are cut to this: some tools write the largest double, rounded up so far that it is read as infinite."""


def as_written(number: float) -> Fraction:
    """Return the exact value of the shortest decimal that reads as this float: 1/50 for 0.02 of a DBC or JSON."""
    return Fraction(repr(number))


def read_codes(signal: Signal, units: Mapping[str, float] | None, where: str) -> Codes:
    """Return the codes of a signal and their values, as the DBC defines them.

    Parameters
    ----------
    signal : Signal
        An integer signal of the DBC.
    units : mapping of str to float, or None
        :data:`AMPERE`, :data:`VOLT` or :data:`WATT`, for values in A, V or W; None: for values in the signal's unit.
    where : str
        What the signal is for, for messages of errors.

    Returns
    -------
    Codes
        Codes and the values that they stand for.

    Raises
    ------
    DatabaseError
        If the unit is of another quantity, the scale is 0 or not finite, no code lies in the DBC's range, or the signal
        is a floating-point number or wider than 64 bits.
    """
    place = bit_place(signal, f"{where}: signal {signal.name}")
    if signal.scale == 0 or not math.isfinite(signal.scale + signal.offset):
        raise DatabaseError(
            f"{where}: signal {signal.name} has scale {signal.scale:g} and offset {signal.offset:g} in the DBC; finite "
            f"numbers are expected, and a scale other than 0"
        )
    lowest, highest = place.lowest, place.highest
    if signal.minimum is not None and signal.maximum is not None and signal.minimum < signal.maximum:
        scale, offset = as_written(signal.scale), as_written(signal.offset)
        limits = (min(max(limit, -_ENDLESS), _ENDLESS) for limit in (signal.minimum, signal.maximum))
        ends = sorted((as_written(limit) - offset) / scale for limit in limits)
        lowest, highest = max(lowest, math.ceil(ends[0])), min(highest, math.floor(ends[1]))
    if lowest > highest:
        raise DatabaseError(f"{where}: no code of signal {signal.name} lies in its range in the DBC")
    factor = as_written(1.0 if units is None else unit_factor(signal, units, where))
    return Codes(
        name=signal.name,
        place=place,
        scale=as_written(signal.scale) * factor,
        offset=as_written(signal.offset) * factor,
        lowest=lowest,
        highest=highest,
        named={int(code): str(name) for code, name in (signal.choices or {}).items()},
    )


def writable_range(codes: Codes, where: str) -> tuple[int, int]:
    """Return the ends of the unbroken run of values around 0; results are clamped to it, so as to hit no named code.

    Parameters
    ----------
    codes : Codes
        Codes of the signal to write.
    where : str
        What the signal is for, for the message of the error.

    Returns
    -------
    lowest, highest : int
        Every code between them is a value.

    Raises
    ------
    DatabaseError
        If the code of 0 itself has a name, so that there is no such run.
    """
    zero = codes.nearest(Fraction(0))
    if zero in codes.named:
        raise DatabaseError(
            f"{where}: the code of 0 of signal {codes.name} is named {codes.named[zero]!r} in the DBC; "
            f"names are for codes that are no values"
        )
    lowest = max([codes.lowest, *(code + 1 for code in codes.named if code < zero)])
    highest = min([codes.highest, *(code - 1 for code in codes.named if code > zero)])
    return lowest, highest


_NEARLY = Fraction(98, 100)
"""Results must reach this share of the signal's outermost value: named codes may take a few codes away. [1]"""


def require_reach(codes: Codes, largest: Fraction, where: str) -> None:
    """Check that no named code cuts off values that the node may have to write.

    Results are limited to the run of codes around 0 that have no name. It must reach up to `largest`, or to 98 % of the
    outermost value of the signal if that is less.

    Parameters
    ----------
    codes : Codes
        Codes of the signal to write.
    largest : Fraction
        Largest magnitude to be written. [unit of the codes]
    where : str
        What the signal is for, for the message of the error.

    Raises
    ------
    DatabaseError
        If a named code ends that run earlier, or is the code of 0, or if the signal cannot be 0.
    """
    ends = writable_range(codes, where)
    if abs(codes.worth(codes.nearest(Fraction(0)))) > abs(codes.scale) / 2:
        low, high = sorted(float(codes.worth(code)) for code in (codes.lowest, codes.highest))
        raise DatabaseError(
            f"{where}: signal {codes.name} holds {low:g} to {high:g}, but the node must be able to write 0; correct "
            f"its range or offset in the DBC"
        )
    for end, extreme, inwards in zip(ends, (codes.lowest, codes.highest), (1, -1), strict=True):
        outermost = extreme
        while outermost in codes.named:  # named codes at the ends of the range exclude no value
            outermost += inwards
        if abs(codes.worth(end)) >= min(largest, _NEARLY * abs(codes.worth(outermost))):
            continue
        named = end - inwards
        raise DatabaseError(
            f"{where}: code {named} of signal {codes.name} means {codes.named[named]!r}, so that no result beyond "
            f"{float(codes.worth(end)):g} could be written, and full scale is {float(largest):g}; names are for codes "
            f"that are no values"
        )


def exact_code(signal: Signal, value: float) -> Fraction:
    """Return the code that stands for a value in the unit of the DBC; a fraction if no code stands for it."""
    return (as_written(float(value)) - as_written(signal.offset)) / as_written(signal.scale)


def impossible_values(signal: Signal, values: Sequence[float]) -> list[float]:
    """Return which of these values a signal of the DBC can never have; none for a floating-point signal.

    Parameters
    ----------
    signal : Signal
        A signal of the DBC.
    values : sequence of float
        In the unit of the DBC.
    """
    if signal.is_float or signal.scale == 0:
        return []
    possible = bit_place(signal)
    codes = {value: exact_code(signal, value) for value in values}
    return [
        value
        for value, code in codes.items()
        if code.denominator != 1 or not possible.lowest <= code <= possible.highest
    ]


def not_available_code(codes: Codes, where: str) -> int:
    """Return the code by which a signal says that it has no value.

    Parameters
    ----------
    codes : Codes
        Codes of the signal to write.
    where : str
        What the signal is for, for the message of the error.

    Returns
    -------
    int
        The code named SNA, "not available" or alike.

    Raises
    ------
    DatabaseError
        If no code has such a name, or it does not fit the signal's width.
    """
    letters = {
        "".join(filter(str.isalpha, name)).casefold(): code
        for code, name in codes.named.items()
        if codes.place.lowest <= code <= codes.place.highest
    }
    for name in _NOT_AVAILABLE_NAMES:
        if name in letters:
            return letters[name]
    raise DatabaseError(f"{where}: signal {codes.name} needs a code named SNA in the DBC (VAL_) that says 'no value'")
