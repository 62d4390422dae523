"""Integer plans as expressions of C, exact: the bounds of every product and sum are checked before a line is written.

A plan whose sums stay below 2^63 for every value of its signals is written in int64_t. One that needs more, as those of
currents with 32 bits do, is written with products of 128 bits made of halves. What does not fit into these either is
refused.
"""

from dataclasses import dataclass

from calibrator.errors import ExportError
from calibrator.export.c_bits import literal
from calibrator.export.c_model import CBranch
from ecu_node.core.correction import IntegerPlan
from ecu_node.core.signals import Codes

__all__ = ["Arithmetic", "arithmetic_of", "is_no_value", "outcome"]

_WORD, _WIDE = 64, 128
_LIMIT, _WIDE_LIMIT = 1 << (_WORD - 1), 1 << (_WIDE - 1)
"""Magnitudes stay below these."""


@dataclass(frozen=True, kw_only=True)
class Arithmetic:
    """How the plan of one branch is computed.

    Attributes
    ----------
    wide : bool
        With 128 bits.
    lowest, highest : int
        Ends of the results.
    """

    wide: bool
    lowest: int
    highest: int


def arithmetic_of(branch: CBranch) -> Arithmetic:
    """Find out what the plan of a branch needs.

    Parameters
    ----------
    branch : CBranch
        A branch with a plan.

    Returns
    -------
    Arithmetic
        What is exact for every value of its signals.

    Raises
    ------
    ExportError
        If nothing is, naming the signal.
    """
    plan, codes = branch.plan, branch.codes
    assert plan is not None
    numbers = (codes.lowest, codes.highest, plan.gain, plan.voltage_gain, plan.lowest, plan.highest)
    bound = _bound(branch, plan)
    result = bound >> plan.shift
    if not (bound < _WIDE_LIMIT and result < _LIMIT - 1 and all(-_LIMIT <= number < _LIMIT for number in numbers)):
        raise ExportError(
            f"branch {branch.name}: signal {branch.signal} has {codes.place.length} bits, and its correction "
            f"needs more than the {_WIDE} bits that C computes it with; give the signal its true range in the DBC"
        )
    return Arithmetic(wide=bound >= _LIMIT, lowest=plan.lowest, highest=plan.highest)


def outcome(plan: IntegerPlan, *, wide: bool, with_voltage: bool) -> str:
    """The corrected code before it is clamped, as an expression of ``code`` and ``voltage_code``."""
    bias = plan.bias + (1 << (plan.shift - 1))
    factors = [("code", plan.gain)]
    if with_voltage and plan.voltage_gain:
        factors.append(("voltage_code", plan.voltage_gain))
    if not wide:
        terms = [f"{name} * {literal(gain)}" for name, gain in factors]
        return f"floor_shift({' + '.join([*terms, literal(bias)])}, {plan.shift}U)"
    low, high = bias & ((1 << _WORD) - 1), bias >> _WORD & ((1 << _WORD) - 1)
    text = f"wide_of(UINT64_C(0x{high:016X}), UINT64_C(0x{low:016X}))"
    for name, gain in factors:
        text = f"wide_sum(wide_product({name}, {literal(gain)}), {text})"
    return f"wide_floor_shift({text}, {plan.shift}U)"


def is_no_value(name: str, codes: Codes) -> str:
    """Condition for a code to be no value: outside the range, or with a name of its own.

    Parameters
    ----------
    name : str
        Of the variable.
    codes : Codes
        Of its signal.
    """
    lowest, highest = codes.lowest, codes.highest
    while lowest in codes.named:
        lowest += 1
    while highest in codes.named:
        highest -= 1
    inside = sorted(code for code in codes.named if lowest < code < highest)
    tests = [f"{name} < {literal(lowest)}", f"{name} > {literal(highest)}"]
    return " || ".join([*tests, *(f"{name} == {literal(code)}" for code in inside)])


def _bound(branch: CBranch, plan: IntegerPlan) -> int:
    """Magnitude that no partial sum of a plan exceeds, for any values."""
    total = abs(plan.gain) * _largest(branch.codes) + abs(plan.bias) + (1 << (plan.shift - 1))
    if plan.voltage_gain and branch.voltage is not None:
        total += abs(plan.voltage_gain) * _largest(branch.voltage.codes)
    return total


def _largest(codes: Codes) -> int:
    return max(abs(codes.lowest), abs(codes.highest))
