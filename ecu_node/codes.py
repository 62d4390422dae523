"""Raw codes of one signal: which of them are values, what they are worth, and which one says "not available".

value = scale * code + offset, with scale and offset as the decimals that stand in the DBC, held exactly. A code is a
value if it lies in the DBC's [minimum|maximum] and has no name in the DBC's value table: a named code of a current
("SNA", "Error") is a message, not a number of amperes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from cantools.database.can import Signal

from ecu_node.bits import BitPlace, bit_place
from ecu_node.errors import DatabaseError
from ecu_node.units import unit_factor

__all__ = [
    "Codes",
    "as_written",
    "impossible_values",
    "not_available_code",
    "read_codes",
    "require_reach",
    "writable_range",
]

_NOT_AVAILABLE_NAMES = ("sna", "notavailable", "signalnotavailable", "na", "invalid", "error")
"""Names of the code for "no value", letters only, the best one first."""


@dataclass(frozen=True, kw_only=True)
class Codes:
    """Raw codes of one signal and their worth.

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
        """Whether a code stands for a number, rather than for a name or outside the DBC's range."""
        return self.lowest <= code <= self.highest and code not in self.named

    def worth(self, code: int) -> Fraction:
        """Value of a code, whether it has a name or not."""
        return self.scale * code + self.offset

    def nearest(self, value: Fraction) -> int:
        """Code nearest to a value, halves up, inside the width and the DBC's range."""
        code = math.floor((value - self.offset) / self.scale + Fraction(1, 2))
        return min(max(code, self.lowest), self.highest)


def as_written(number: float) -> Fraction:
    """Exact value of the shortest decimal that reads as this float: 1/50 for 0.02, as it stands in a DBC or JSON."""
    return Fraction(repr(number))


def read_codes(signal: Signal, units: Mapping[str, float], where: str) -> Codes:
    """Collect what the DBC says of a signal's codes.

    Parameters
    ----------
    signal : Signal
        An integer signal of the DBC.
    units : mapping of str to float
        One of the tables of :mod:`ecu_node.units`; values come out in its base unit.
    where : str
        What the signal is for, for messages of errors.

    Returns
    -------
    Codes
        Codes and their worth.

    Raises
    ------
    DatabaseError
        If the unit is wrong, the scale is zero, or the signal cannot be read bit by bit.
    """
    place = bit_place(signal)
    if signal.scale == 0:
        raise DatabaseError(f"{where}: signal {signal.name} has scale 0 in the DBC; a number other than 0 is expected")
    lowest, highest = place.lowest, place.highest
    if signal.minimum is not None and signal.maximum is not None and signal.minimum < signal.maximum:
        scale, offset = as_written(signal.scale), as_written(signal.offset)
        ends = sorted((as_written(limit) - offset) / scale for limit in (signal.minimum, signal.maximum))
        lowest, highest = max(lowest, math.ceil(ends[0])), min(highest, math.floor(ends[1]))
    if lowest > highest:
        raise DatabaseError(f"{where}: no code of signal {signal.name} lies in its range in the DBC")
    factor = as_written(unit_factor(signal, units, where))
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
    """Ends of the unbroken run of values around 0, into which results are clamped so that no named code is hit.

    Parameters
    ----------
    codes : Codes
        Of the signal to write.
    where : str
        What the signal is for, for the message of the error.

    Returns
    -------
    lowest, highest : int
        Every code between them is a value.

    Raises
    ------
    DatabaseError
        If 0 itself has a name: no run is around it.
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
"""A range that reaches this share of what it could is whole, but for codes beside those with names. [1]"""


def require_reach(codes: Codes, largest: Fraction, where: str) -> None:
    """Refuse a signal to write if a name amid its values keeps results of full scale out.

    Parameters
    ----------
    codes : Codes
        Of the signal to write.
    largest : Fraction
        Largest magnitude that must be written, as far as the signal reaches at all. [unit of the codes]
    where : str
        What the signal is for, for the message of the error.

    Raises
    ------
    DatabaseError
        If results would be clamped to less, though the signal has values beyond.
    """
    ends = writable_range(codes, where)
    for end, extreme, inwards in zip(ends, (codes.lowest, codes.highest), (1, -1), strict=True):
        outermost = extreme
        while outermost in codes.named:  # names at the ends of the range keep no value out
            outermost += inwards
        if abs(codes.worth(end)) >= min(largest, _NEARLY * abs(codes.worth(outermost))):
            continue
        named = end - inwards
        raise DatabaseError(
            f"{where}: code {named} of signal {codes.name} means {codes.named[named]!r}, so that no result beyond "
            f"{float(codes.worth(end)):g} could be written, and full scale is {float(largest):g}; names are for codes "
            f"that are no values"
        )


def impossible_values(signal: Signal, values: Sequence[float]) -> list[float]:
    """Those of some values that a signal of the DBC can never have; none of a floating-point number's.

    Parameters
    ----------
    signal : Signal
        A signal of the DBC.
    values : sequence of float
        In the unit of the DBC.
    """
    if signal.is_float or signal.scale == 0:
        return []
    place, scale, offset = bit_place(signal), as_written(signal.scale), as_written(signal.offset)
    codes = [(as_written(float(value)) - offset) / scale for value in values]
    return [
        value
        for value, code in zip(values, codes, strict=True)
        if code.denominator != 1 or not place.lowest <= code <= place.highest
    ]


def not_available_code(codes: Codes, where: str) -> int:
    """Code by which a signal says that it has no value.

    Parameters
    ----------
    codes : Codes
        Of the signal to write.
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
