"""Integer plans as expressions of C, exact: the bounds of every product and sum are checked before a line is written.

A plan whose sums stay below 2^63 for every value of its signals is written in int64_t. One that needs more, as those of
currents with 32 bits do, is written with products of 128 bits made of halves. What does not fit into these either is
refused; so are plans by temperature that do not fit into int64_t, as their table is made of such numbers.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from calibrator.errors import ExportError
from calibrator.export.c_bits import literal
from calibrator.export.c_model import CBranch, SignRule
from ecu_node.codes import Codes
from ecu_node.correction import IntegerPlan

__all__ = ["Arithmetic", "arithmetic_of", "is_no_value", "outcome", "rule_test"]

_WORD, _WIDE = 64, 128
_LIMIT, _WIDE_LIMIT = 1 << (_WORD - 1), 1 << (_WIDE - 1)
"""Magnitudes stay below these."""


@dataclass(frozen=True, kw_only=True)
class Arithmetic:
    """How the plans of one branch are computed.

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
    """Find out what the plans of a branch need.

    Parameters
    ----------
    branch : CBranch
        A branch with plans.

    Returns
    -------
    Arithmetic
        What is exact for every value of its signals.

    Raises
    ------
    ExportError
        If nothing is, naming the signal.
    """
    plans = [plan for plan in branch.plans if plan is not None]
    numbers = [branch.codes.lowest, branch.codes.highest, *(number for plan in plans for number in _factors(plan))]
    bound = max((_bound(branch, plan) for plan in plans), default=0)
    result = max((_bound(branch, plan) >> plan.shift for plan in plans), default=0)
    wide = bound >= _LIMIT
    fits = bound < _WIDE_LIMIT and result < _LIMIT - 1 and all(-_LIMIT <= number < _LIMIT for number in numbers)
    by_temperature = isinstance(branch.rule, int)
    if not fits or (wide and by_temperature):
        raise ExportError(
            f"branch {branch.name}: signal {branch.signal} has {branch.codes.place.length} bits, and its correction "
            f"needs more than the {_WORD if by_temperature else _WIDE} bits that C computes it with; give the signal "
            f"its true range in the DBC"
        )
    _require_exact_rule(branch)
    ends = {(plan.lowest, plan.highest) for plan in plans} or {(0, 0)}
    lowest, highest = ends.pop()
    return Arithmetic(wide=wide, lowest=lowest, highest=highest)


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


def rule_test(rule: SignRule) -> str:
    """Condition for the first of two plans."""
    if rule.of_voltage == 0:
        comparison = ">=" if rule.of_code > 0 else "<="
        return f"code {comparison} {literal(-rule.of_code * rule.constant)}"
    return f"code * {literal(rule.of_code)} + voltage_code * {literal(rule.of_voltage)} >= {literal(-rule.constant)}"


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


def _factors(plan: IntegerPlan) -> Iterator[int]:
    yield from (plan.gain, plan.voltage_gain, plan.lowest, plan.highest)


def _bound(branch: CBranch, plan: IntegerPlan) -> int:
    """Magnitude that no partial sum of a plan exceeds, for any values."""
    total = abs(plan.gain) * _largest(branch.codes) + abs(plan.bias) + (1 << (plan.shift - 1))
    if plan.voltage_gain and branch.voltage is not None:
        total += abs(plan.voltage_gain) * _largest(branch.voltage.codes)
    return total


def _largest(codes: Codes) -> int:
    return max(abs(codes.lowest), abs(codes.highest))


def _require_exact_rule(branch: CBranch) -> None:
    rule = branch.rule
    if not isinstance(rule, SignRule) or rule.of_voltage == 0 or branch.voltage is None:
        return
    parts: Iterable[int] = (
        abs(rule.of_code) * _largest(branch.codes),
        abs(rule.of_voltage) * _largest(branch.voltage.codes),
        abs(rule.constant),
    )
    if sum(parts) >= _LIMIT:
        raise ExportError(
            f"branch {branch.name}: the sign of its current, a power over a voltage, takes more than {_WORD} bits to "
            f"tell; write its offset with fewer digits in the parameter file"
        )
