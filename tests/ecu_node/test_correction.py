"""The integer plan of a branch, compared with exact fractions; units, ranges and named codes of signals."""

import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import pytest
from cantools.database.can import Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given
from hypothesis import strategies as st

from ecu_node.core.correction import LARGEST_ERROR, IntegerPlan, SensorFault, Signals, correction_plan
from ecu_node.core.signals import (
    AMPERE,
    VOLT,
    WATT,
    Codes,
    factor_of,
    impossible_values,
    not_available_code,
    read_codes,
    require_reach,
    writable_range,
)
from ecu_node.errors import DatabaseError

HALF = Fraction(1, 2)


def current(
    scale: float = 0.02, offset: float = 0.0, *, limits: Any = (None, None), names: Any = None, **more: Any
) -> Codes:
    low, high = limits
    conversion = BaseConversion.factory(scale=scale, offset=offset, choices=names)
    options: dict[str, Any] = {"length": 16, "is_signed": True, "unit": "A"} | more
    return read_codes(Signal("I", 0, conversion=conversion, minimum=low, maximum=high, **options), AMPERE, "test")


def integer_plan(source: Codes, target: Codes, *, sign: int, drift: float, offset_a: float) -> IntegerPlan:
    signals = Signals(source=source, target=target, sign=sign)
    return correction_plan(signals, SensorFault(drift=drift, offset_a=offset_a))


def exact(source: Codes, target: Codes, code: int, *, sign: int, drift: str, offset_a: str) -> Fraction:
    """Corrected code without rounding, straight from equation (25) of the paper."""
    i_m = sign * (source.scale * code + source.offset)
    i = (i_m - Fraction(offset_a)) / (1 + Fraction(drift))
    return (sign * i - target.offset) / target.scale


def exact_line(source: Codes, target: Codes, *, sign: int, drift: str, offset_a: str) -> tuple[int, int, int]:
    """The same as (gain * code + bias) / common in integers: fractions of 65536 codes would take seconds."""
    start = exact(source, target, 0, sign=sign, drift=drift, offset_a=offset_a)
    slope = exact(source, target, 1, sign=sign, drift=drift, offset_a=offset_a) - start
    common = math.lcm(slope.denominator, start.denominator)
    return int(slope * common), int(start * common), common


def whole_range(codes: Codes) -> range:
    return range(codes.lowest, codes.highest + 1)


CASES = [
    pytest.param(current(), current(), 1, "0.25", "0.0025", id="exact halves"),
    pytest.param(current(), current(), -1, "-0.173", "12.34", id="consumer"),
    pytest.param(current(names={-32768: "SNA"}), current(names={-32768: "SNA"}), 1, "0.4", "-150", id="saturating"),
    pytest.param(current(-0.05), current(0.1, -1600.0, is_signed=False), -1, "0.0123", "-3.3", id="negative scale"),
    pytest.param(current(limits=(-650, 650)), current(limits=(-650, 650)), -1, "0", "0", id="passing through"),
    pytest.param(current(20.0, unit="mA"), current(0.02), 1, "-0.4", "0.1", id="milliampere"),
]


@pytest.mark.parametrize(("source", "target", "sign", "drift", "offset"), CASES)
def test_16_bit_codes_are_corrected_exactly(source: Codes, target: Codes, sign: int, drift: str, offset: str) -> None:
    plan = integer_plan(source, target, sign=sign, drift=float(drift), offset_a=float(offset))
    gain, bias, common = exact_line(source, target, sign=sign, drift=drift, offset_a=offset)
    low, high = writable_range(target, "test")
    got = [plan.apply(code, 0) for code in whole_range(source)]
    wanted = [(2 * (gain * code + bias) + common) // (2 * common) for code in whole_range(source)]
    assert got == [min(max(code, low), high) for code in wanted]


def require_bound(plan: IntegerPlan, wanted: Fraction, code: int, voltage_code: int = 0) -> None:
    """Before rounding the plan is not below the exact line, and above it by less than the largest error."""
    line = Fraction(code * plan.gain + voltage_code * plan.voltage_gain + plan.bias, 1 << plan.shift)
    assert 0 <= line - wanted < LARGEST_ERROR
    assert plan.apply(code, voltage_code) == min(max(math.floor(line + HALF), plan.lowest), plan.highest)


OFFSETS_A = st.floats(-150.0, 150.0)


@given(length=st.integers(2, 64), signed=st.booleans(), drift=st.floats(-0.4, 0.4), offset=OFFSETS_A, data=st.data())
def test_correction_error_stays_within_its_bound_at_any_signal_width(
    length: int, signed: bool, drift: float, offset: float, data: st.DataObject
) -> None:
    source = current(0.02, -7.0, length=length, is_signed=signed)
    plan = integer_plan(source, source, sign=1, drift=drift, offset_a=offset)
    code = data.draw(st.integers(source.lowest, source.highest))
    require_bound(plan, exact(source, source, code, sign=1, drift=repr(drift), offset_a=repr(offset)), code)


@given(
    code=st.integers(-30000, 30000),
    volts=st.integers(0, 50000),
    drift=st.floats(-0.4, 0.4),
    offset=OFFSETS_A,
    sign=st.sampled_from([1, -1]),
)
def test_power_offset_scales_with_the_voltage(code: int, volts: int, drift: float, offset: float, sign: int) -> None:
    power, voltage = current(2.0, limits=(-60000, 60000)), current(0.02, is_signed=False, limits=(0, 1000))
    signals = Signals(source=power, target=power, sign=sign, voltage=voltage)
    plan = correction_plan(signals, SensorFault(drift=drift, offset_a=offset))
    offset_w = sign * Fraction(repr(offset)) * voltage.scale * volts
    wanted = (power.scale * code - offset_w) / (1 + Fraction(repr(drift))) / power.scale
    require_bound(plan, wanted, code, volts)


LARGE = [
    (current(), 0.0, 0.0),
    (current(is_signed=False, limits=(0.0, 65534 * 0.02)), 0.0, 0.0),
    (current(offset=1000.0), 0.0, 0.0),
    (current(), -0.3, 100.0),
]


@pytest.mark.parametrize(
    ("source", "drift", "offset_a"), LARGE, ids=["signed", "unsigned", "offset in the DBC", "with a fault"]
)
def test_largest_sum_of_the_integer_plan_has_59_bits(source: Codes, drift: float, offset_a: float) -> None:
    plan = integer_plan(source, current(), sign=1, drift=drift, offset_a=offset_a)
    largest = max(abs(source.lowest), abs(source.highest)) * plan.gain + abs(plan.bias) + (1 << (plan.shift - 1))
    assert 1 << 58 <= largest < 1 << 59


UNITS = [
    ("", AMPERE, 1.0),
    (" [A] ", AMPERE, 1.0),
    ("Unit_Amper", AMPERE, 1.0),
    ("A_DC", AMPERE, 1.0),
    ("milliamps", AMPERE, 1e-3),
    ("kilovolt", VOLT, 1e3),
    ("KW", WATT, 1e3),
    ("mW", WATT, 1e-3),
    ("MW", WATT, 1e6),
]


@pytest.mark.parametrize(("unit", "known", "factor"), UNITS)
def test_unit_is_known_in_the_spellings_of_several_makers(unit: str, known: Mapping[str, float], factor: float) -> None:
    assert factor_of(unit, known, "test") == factor


@pytest.mark.parametrize("scale", [1.0, 50.0])
def test_scale_given_both_in_the_unit_and_as_factor_is_applied_once(scale: float) -> None:
    assert current(scale, unit="50A/bit").scale == 50


@pytest.mark.parametrize("names", [{5: "SNA"}, {3: "Error", 5: "Signal not available"}, {5: "invalid", 9: "x"}])
def test_code_for_not_available_is_found_by_its_name(names: dict[int, str]) -> None:
    assert not_available_code(current(names=names), "test") == 5


def test_named_code_that_stands_for_0_a_is_refused() -> None:
    with pytest.raises(DatabaseError, match="the code of 0 of signal I is named 'Off'"):
        writable_range(current(names={0: "Off"}), "test")


@pytest.mark.parametrize("scale", [0.02, -0.02])
@pytest.mark.parametrize("code", [1, 19999, -1, -20000])
def test_named_code_within_the_measuring_range_is_refused(scale: float, code: int) -> None:
    codes = current(scale, names={-32768: "SNA", code: "Odd"})
    with pytest.raises(DatabaseError, match=f"test: code {code} of signal I means 'Odd', .* and full scale is 400"):
        require_reach(codes, Fraction(400), "test")


@pytest.mark.parametrize("limits", [(100.0, 200.0), (-200.0, -100.0), (0.02, 200.0)])
def test_range_without_0_a_is_refused(limits: tuple[float, float]) -> None:
    words = "test: signal I holds {:g} to {:g}, but the node must be able to write 0; correct its range"
    with pytest.raises(DatabaseError, match=words.format(*limits)):
        require_reach(current(limits=limits), Fraction(400), "test")


def test_named_codes_at_an_end_of_the_range_are_accepted_and_never_written() -> None:
    codes = current(length=8, names=dict.fromkeys([-128, *range(120, 128)], "Reserved"))
    require_reach(codes, Fraction(400), "test")
    assert writable_range(codes, "test") == (-127, 119)


TEMPERATURE = Signal("T", start=0, length=8, unit="degC", conversion=BaseConversion.factory(scale=0.5, offset=-40.0))


def test_codes_are_read_in_the_unit_of_the_dbc_if_no_conversion_is_asked_for() -> None:
    codes = read_codes(TEMPERATURE, None, "test")
    assert (codes.scale, codes.offset) == (HALF, Fraction(-40))


def test_values_that_a_scaled_signal_cannot_have_are_found() -> None:
    assert impossible_values(TEMPERATURE, [-40.0, 0.5, 87.5, -40.5, 0.25, 88.0]) == [-40.5, 0.25, 88.0]


NO_CURRENTS = [
    ({"scale": 0.0}, "signal I has scale 0 and offset 0 in the DBC"),
    ({"offset": math.inf}, "signal I has scale 0.02 and offset inf in the DBC"),
    ({"limits": (1000.0, 2000.0)}, "no code of signal I lies in its range in the DBC"),
    ({"unit": "W"}, "signal I is in 'W'; expected A, mA, kA"),
]


@pytest.mark.parametrize(("wrong", "words"), NO_CURRENTS)
def test_signal_that_cannot_be_a_current_is_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(DatabaseError, match=f"test: .*{words}"):
        current(**wrong)


LARGEST = float("1.79769313486232E+308")
"""The largest double, as tools write it in 15 digits."""


LIMITS = [
    ((-LARGEST, LARGEST), whole_range(current())),
    ((2.0, 2.0), whole_range(current())),
    ((2.0, -2.0), whole_range(current())),
    ((1.99, 2.01), range(100, 101)),
]


@pytest.mark.parametrize(
    ("limits", "codes"), LIMITS, ids=["all doubles", "minimum = maximum", "minimum above maximum", "from 1.99 to 2.01"]
)
def test_dbc_limits_restrict_codes_only_if_minimum_is_below_maximum(limits: tuple[float, float], codes: range) -> None:
    assert whole_range(current(limits=limits)) == codes
