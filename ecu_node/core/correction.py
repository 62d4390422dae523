"""Integer correction plan: multiply, add and shift from the measured code to the corrected one.

A sensor shows i_m = (1 + d) i + o, positive into the junction; the true current is, by equation (25) in [1]_,

    i = (i_m - o) / (1 + d).

With the DBC's scales and the branch's sign, which both signals share, this is code_out = G * code_in + B with exact
rational G and B. A branch that is published as a power P at the voltage u is corrected as a current and written back as
a power, P_out = u * i = (P_m - o * u) / (1 + d): code_out = G * code_in + H * voltage_code + B, without a division.
The plan holds G, H and B as integers over 2^shift:

    code_out = (code_in * gain + voltage_code * voltage_gain + bias + half) >> shift,    half = 2^(shift - 1),

clamped to the codes that may be written into the target.

Rounding rule: the exact line, rounded to the nearest code, halves up. The integers approximate the exact line from
above, by less than :data:`LARGEST_ERROR` of a code: an exact half is never rounded down, but an exact result less than
that below a half is rounded up. Where 64 bits allow it, the approximation is much closer.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import math
from dataclasses import dataclass
from fractions import Fraction

from ecu_node.core.signals import Codes, as_written, writable_range

__all__ = ["AS_IT_IS", "LARGEST_ERROR", "NO_FAULT", "IntegerPlan", "SensorFault", "Signals", "correction_plan"]


@dataclass(frozen=True, kw_only=True)
class SensorFault:
    """Sensor fault that is corrected on one branch: i_m = (1 + d) i + o.

    Attributes
    ----------
    drift : float
        d, the gain error. [1]
    offset_a : float
        o, the offset, positive into the junction. [A]
    """

    drift: float = 0.0
    offset_a: float = 0.0

    @property
    def applied(self) -> bool:
        """Whether there is anything to correct."""
        return bool(self.drift or self.offset_a)

    def true_current(self, i_m: float) -> float:
        """Return the true current for a measured one, equation (25) of the paper; positive into the junction. [A]"""
        return (i_m - self.offset_a) / (1.0 + self.drift)


NO_FAULT = SensorFault()
"""A sensor without a fault: nothing is corrected."""


_ERROR_BITS = 10
LARGEST_ERROR = Fraction(1, 1 << _ERROR_BITS)
"""The integer result lies less than this above the exact line. [code]"""

_WORD_BITS = 59
"""Products and sums stay below 2^59 where the required accuracy allows it, so that C with int64_t gives the same bits
and Python's integers need only two digits."""


@dataclass(frozen=True, kw_only=True)
class Signals:
    """Signals that a branch is read from and written to.

    Attributes
    ----------
    source, target : Codes
        Measured and corrected signal; ``sign`` holds for both. [both A, or both W]
    sign : 1 or -1
        +1 if the signals are positive into the junction.
    voltage : Codes or None
        Voltage of a branch that is measured as a power; None for a current. [V]
    """

    source: Codes
    target: Codes
    sign: int
    voltage: Codes | None = None


@dataclass(frozen=True, kw_only=True)
class IntegerPlan:
    """Correction of one branch in integers.

    Attributes
    ----------
    gain, voltage_gain, bias, shift : int
        code_out = (code * gain + voltage_code * voltage_gain + bias + 2^(shift - 1)) >> shift.
    lowest, highest : int
        Ends of the codes that may be written.
    """

    gain: int
    voltage_gain: int = 0
    bias: int
    shift: int
    lowest: int
    highest: int

    @property
    def needs_voltage(self) -> bool:
        """Whether the result depends on the voltage."""
        return self.voltage_gain != 0

    def apply(self, code: int, voltage_code: int) -> int:
        """Correct one code; the result is clipped to the codes of the signal (lowest, highest), never wrapped."""
        return min(max(self.unbounded(code, voltage_code), self.lowest), self.highest)

    def unbounded(self, code: int, voltage_code: int) -> int:
        """Correct one code, without clipping the result."""
        return (code * self.gain + voltage_code * self.voltage_gain + self.bias + (1 << (self.shift - 1))) >> self.shift


_EVERYTHING = 1 << 64
AS_IT_IS = IntegerPlan(gain=2, bias=0, shift=1, lowest=-_EVERYTHING, highest=_EVERYTHING)
"""Plan that writes every value as it was measured."""


def correction_plan(signals: Signals, fault: SensorFault) -> IntegerPlan:
    """Return the plan by which one branch is corrected; built once, when parameters are put in force.

    Parameters
    ----------
    signals : Signals
        Signals that are read and written.
    fault : SensorFault
        Fault to correct; :data:`~ecu_node.core.correction.NO_FAULT` to pass through.

    Returns
    -------
    IntegerPlan
        Plan whose error is at most half a code + 2^-10 for every valid code: before rounding it is never below the
        exact line, and above it by less than :data:`LARGEST_ERROR`. Its shift is as large as 64-bit words allow, or as
        large as this accuracy needs, if that is more.

    Raises
    ------
    DatabaseError
        If the target's code of 0 has a name in the DBC's value table, so that 0 cannot be written.
    """
    source, target, voltage = signals.source, signals.target, signals.voltage
    per_unit = 1 / (1 + as_written(fault.drift)) / target.scale
    offset_a = signals.sign * as_written(fault.offset_a)
    volts_at_0 = Fraction(1) if voltage is None else voltage.offset  # a current is treated as a power at 1 V
    terms = [(source.scale * per_unit, source)]
    if voltage is not None and offset_a:
        terms.append((-offset_a * voltage.scale * per_unit, voltage))
    constant = (source.offset - offset_a * volts_at_0) * per_unit - target.offset / target.scale
    span = sum(codes.highest - codes.lowest for _, codes in terms)
    needed = _ERROR_BITS + span.bit_length()
    largest = abs(constant) + 1
    largest += sum(abs(factor) * max(abs(codes.lowest), abs(codes.highest)) for factor, codes in terms)
    shift = max(needed, _WORD_BITS - math.ceil(largest).bit_length())
    gains, deepest = [], Fraction(0)
    for factor, codes in terms:
        gain = round(factor * (1 << shift))
        missing = factor * (1 << shift) - gain
        deepest += max(missing * codes.lowest, missing * codes.highest)
        gains.append(gain)
    lowest, highest = writable_range(signals.target, f"corrected signal {signals.target.name}")
    return IntegerPlan(
        gain=gains[0],
        voltage_gain=gains[1] if len(gains) > 1 else 0,
        bias=math.ceil(constant * (1 << shift) + deepest),
        shift=shift,
        lowest=lowest,
        highest=highest,
    )
