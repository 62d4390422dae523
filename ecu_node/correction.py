"""Integer correction plan: one multiply, one add, one shift from the measured code to the corrected one.

A sensor shows i_m = (1 + d) i + o, positive into the junction; its true current is, (25) in [1]_,

    i = (i_m - o) / (1 + d).

With the DBC's scales and the branch's sign, which both signals share, this is code_out = G * code_in + B with exact
rational G and B. The plan holds G and B as integers over 2^shift:

    code_out = (code_in * gain + bias + half) >> shift,    half = 2^(shift - 1), clamped into the values of the target.

Rounding rule: the exact G * code_in + B, rounded to the nearest code, halves up. The integers approach the exact line
from above, by less than :data:`LARGEST_ERROR` of a code, so that an exact half is never rounded down; an exact result
that lies less than that below a half is rounded up. Where 64 bits allow it, the approach is closer by far.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import math
from dataclasses import dataclass
from fractions import Fraction

from ecu_node.codes import Codes, as_written, writable_range

__all__ = ["LARGEST_ERROR", "IntegerPlan", "corrected_current", "integer_plan"]

_ERROR_BITS = 10
LARGEST_ERROR = Fraction(1, 1 << _ERROR_BITS)
"""The integers lie less than this above the exact line. [code]"""

_WORD_BITS = 62
"""Products and sums stay below 2^62 where the wanted error allows it, so that C with int64_t gives the same bits."""


@dataclass(frozen=True, kw_only=True)
class IntegerPlan:
    """Correction of one branch in integers.

    Attributes
    ----------
    gain, bias, shift : int
        code_out = (code_in * gain + bias + 2^(shift - 1)) >> shift.
    lowest, highest : int
        Ends of the codes that may be written.
    """

    gain: int
    bias: int
    shift: int
    lowest: int
    highest: int

    def apply(self, code: int) -> int:
        """Correct one code; the result saturates at the ends and never wraps."""
        return min(max(self._unbounded(code), self.lowest), self.highest)

    def saturates(self, code: int) -> bool:
        """Whether the result for a code lies beyond the ends, so that :meth:`apply` returns an end instead."""
        return not self.lowest <= self._unbounded(code) <= self.highest

    def _unbounded(self, code: int) -> int:
        return (code * self.gain + self.bias + (1 << (self.shift - 1))) >> self.shift


def integer_plan(source: Codes, target: Codes, *, sign: int, drift: float, offset_a: float) -> IntegerPlan:
    """Build the plan of one branch, once at start.

    Parameters
    ----------
    source, target : Codes
        Measured and corrected signal, both counting in the branch's own direction. [A]
    sign : 1 or -1
        +1 if the signals are positive into the junction.
    drift, offset_a : float
        Sensor fault, (13): d [1] and o, positive into the junction [A]; both 0 to pass through.

    Returns
    -------
    IntegerPlan
        The plan; for every valid source code its error is at most half a code + 2^-10.

    Raises
    ------
    DatabaseError
        If the target's value table leaves no values around 0.
    """
    slope = 1 / (1 + as_written(drift))
    gain = source.scale * slope / target.scale
    bias = ((source.offset - sign * as_written(offset_a)) * slope - target.offset) / target.scale
    shift = _shift(source, gain, bias)
    whole_gain = round(gain * (1 << shift))
    missing = gain * (1 << shift) - whole_gain
    deepest = max(missing * source.lowest, missing * source.highest)
    lowest, highest = writable_range(target, f"corrected signal {target.name}")
    return IntegerPlan(
        gain=whole_gain,
        bias=math.ceil(bias * (1 << shift) + deepest),
        shift=shift,
        lowest=lowest,
        highest=highest,
    )


def corrected_current(i_m: float, *, drift: float, offset_a: float) -> float:
    """Invert the sensor model for one current, (25) in [1]_.

    Parameters
    ----------
    i_m : float
        Measured current, positive into the junction. [A]
    drift, offset_a : float
        Sensor fault: d [1] and o, positive into the junction [A].

    Returns
    -------
    float
        Corrected current. [A]
    """
    return (i_m - offset_a) / (1.0 + drift)


def _shift(source: Codes, gain: Fraction, bias: Fraction) -> int:
    """Shift that keeps the error below LARGEST_ERROR, and beyond that as large as 64-bit words allow."""
    span = source.highest - source.lowest
    needed = _ERROR_BITS + (span // 2 + 1).bit_length()
    largest = abs(gain) * max(abs(source.lowest), abs(source.highest)) + abs(bias) + 1
    return max(needed, _WORD_BITS - math.ceil(largest).bit_length())
