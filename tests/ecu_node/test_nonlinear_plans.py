"""Plans of sensors that are not linear and of powers: against fractions, over all codes of 16 bits where it can be."""

from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ecu_node.codes import Codes
from ecu_node.correction import LARGEST_ERROR, IntegerPlan, Signals, SignPlan, TemperaturePlans, correction_plan
from ecu_node.sensor_fault import NO_FAULT, SensorFault
from ecu_node.sensor_models import GainBySign, TemperatureDrift
from tests.ecu_node.test_correction import current, whole_range

HALF = Fraction(1, 2)
VOLTAGE = current(0.02, length=16, signed=False, limits=(0, 1000))
POWER = current(2.0, length=16, limits=(-60000, 60000))
TEMPERATURE = current(1.0, -40.0, length=8, signed=False)


def value(codes: Codes, code: int) -> Fraction:
    return codes.scale * code + codes.offset


def true_value(
    signals: Signals, fault: SensorFault, code: int, voltage_code: int = 0, celsius: Fraction = Fraction(0)
) -> Fraction:
    """Corrected current or power, (25) with the sensor's own model, without rounding and without the node's algebra."""
    volts = Fraction(1) if signals.voltage is None else value(signals.voltage, voltage_code)
    measured = signals.sign * value(signals.source, code) - Fraction(repr(fault.offset_a)) * volts
    match fault.model:
        case GainBySign(drift_positive=positive, drift_negative=negative):
            drift = Fraction(repr(positive if measured >= 0 else negative))
        case TemperatureDrift(drift_per_k=per_k, reference_c=reference):
            drift = Fraction(repr(fault.drift)) + Fraction(repr(per_k)) * (celsius - Fraction(repr(reference)))
        case _:
            drift = Fraction(repr(fault.drift))
    return signals.sign * measured / (1 + drift)


def error_codes(signals: Signals, wanted: Fraction, got: int, plan: IntegerPlan) -> Fraction:
    exact = (wanted - signals.target.offset) / signals.target.scale
    return abs(got - min(max(exact, Fraction(plan.lowest)), Fraction(plan.highest)))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("scale", [0.02, -0.02])
def test_gain_by_sign_over_all_codes(sign: int, scale: float) -> None:
    signals = Signals(source=current(scale), target=current(0.02), sign=sign)
    fault = SensorFault(offset_a=3.31, model=GainBySign(drift_positive=0.13, drift_negative=-0.07))
    plan = correction_plan(signals, fault)
    assert isinstance(plan, SignPlan)
    worst = Fraction(0)
    for code in range(-32768, 32768):
        chosen = plan.plan(code)
        got = chosen.apply(code)
        if code % 16 == 0 or abs(code * 0.02 - 3.31) < 1.0:
            worst = max(worst, error_codes(signals, true_value(signals, fault, code), got, chosen))
        measured = sign * value(signals.source, code) - Fraction("3.31")
        assert chosen is (plan.positive if measured >= 0 else plan.negative)
    assert worst <= HALF + LARGEST_ERROR


def test_the_plan_by_sign_is_chosen_by_the_written_rule() -> None:
    into, out = (IntegerPlan(gain=gain, bias=0, shift=1, lowest=-9, highest=9) for gain in (2, 3))
    plan = SignPlan(positive=into, negative=out, weights=(2, 5, -6))
    assert [plan.plan(code) is into for code in (0, 2, 3)] == [False, False, True]
    assert [plan.plan(0, volts) is into for volts in (1, 2)] == [False, True]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("target", [current(0.05), current(-0.05), current(0.02, -500.0), current(-0.1, 70.0)])
def test_which_plan_holds_does_not_depend_on_how_the_target_counts(sign: int, target: Codes) -> None:
    fault = SensorFault(offset_a=-3.3, model=GainBySign(drift_positive=0.13, drift_negative=-0.07))
    signals = Signals(source=current(), target=target, sign=sign)
    plan = correction_plan(signals, fault)
    assert isinstance(plan, SignPlan)
    codes = range(-170, -160) if sign == 1 else range(160, 170)
    assert [plan.plan(code) is plan.positive for code in codes] == [2 * sign * code >= -330 for code in codes]
    assert not plan.needs_voltage


@settings(deadline=None)
@given(
    code=st.integers(-30000, 30000),
    volts=st.integers(0, 50000),
    drift=st.floats(-0.4, 0.4),
    offset=st.floats(-150, 150),
    sign=st.sampled_from([1, -1]),
    by_sign=st.booleans(),
)
def test_a_power_is_corrected_as_a_current_and_written_back_as_a_power(
    code: int, volts: int, drift: float, offset: float, sign: int, by_sign: bool
) -> None:
    signals = Signals(source=POWER, target=POWER, sign=sign, voltage=VOLTAGE)
    model = GainBySign(drift_positive=drift, drift_negative=-drift / 2) if by_sign else None
    fault = SensorFault(drift=drift, offset_a=offset, model=model)
    plan = correction_plan(signals, fault)
    assert isinstance(plan, SignPlan if by_sign else IntegerPlan)
    chosen = plan.plan(code, volts) if isinstance(plan, SignPlan) else plan
    assert isinstance(chosen, IntegerPlan)
    got = chosen.apply(code, volts)
    assert error_codes(signals, true_value(signals, fault, code, volts), got, chosen) <= HALF + LARGEST_ERROR


def test_each_temperature_has_its_own_plan() -> None:
    signals = Signals(source=current(), target=current(), sign=1)
    fault = SensorFault(
        drift=0.05, offset_a=-2.5, model=TemperatureDrift(drift_per_k=0.0013, reference_c=25.0), largest_drift=0.4
    )
    plans = correction_plan(signals, fault, temperature=TEMPERATURE)
    assert isinstance(plans, TemperaturePlans)
    for temperature in (0, 40, 65, 66, 140, 250):
        plan = plans.at(temperature)
        assert plan is not None
        celsius = value(TEMPERATURE, temperature)
        for code in range(-32768, 32768, 97):
            wanted = true_value(signals, fault, code, celsius=celsius)
            assert error_codes(signals, wanted, plan.apply(code), plan) <= HALF + LARGEST_ERROR


def test_a_temperature_at_which_the_drift_is_beyond_the_limit_has_no_plan() -> None:
    signals = Signals(source=current(), target=current(), sign=1)
    fault = SensorFault(model=TemperatureDrift(drift_per_k=0.01, reference_c=20.0), largest_drift=0.4)
    plans = correction_plan(signals, fault, temperature=TEMPERATURE)
    assert isinstance(plans, TemperaturePlans)
    assert [plans.at(code) is None for code in (40 + 60, 40 + 61, 40 - 20, 40 - 21)] == [False, True, False, True]


@pytest.mark.parametrize(
    ("fault", "current_a", "temperature_c", "measured"),
    [
        (SensorFault(drift=0.25, offset_a=5.0), 80.0, None, 105.0),
        (SensorFault(offset_a=1.0, model=GainBySign(drift_positive=0.1, drift_negative=-0.1)), 50.0, None, 56.0),
        (SensorFault(offset_a=1.0, model=GainBySign(drift_positive=0.1, drift_negative=-0.1)), -50.0, None, -44.0),
        (SensorFault(offset_a=5.0, model=GainBySign(drift_positive=0.1, drift_negative=-0.1)), -2.0, None, 3.2),
        (SensorFault(drift=0.1, model=TemperatureDrift(drift_per_k=0.01, reference_c=20.0)), 10.0, 30.0, 12.0),
    ],
)
def test_true_currents_undo_the_sensor_model(
    fault: SensorFault, current_a: float, temperature_c: float | None, measured: float
) -> None:
    assert fault.true_current(measured, temperature_c) == pytest.approx(current_a)


def test_a_current_of_nothing_counts_as_into_the_junction() -> None:
    fault = SensorFault(offset_a=1.0, model=GainBySign(drift_positive=0.1, drift_negative=-0.1))
    assert [fault.drift_at(current_a, None) for current_a in (-1e-9, 0.0, 0.5)] == [-0.1, 0.1, 0.1]


@pytest.mark.parametrize(("drift", "per_k"), [(0.25, 0.03125), (-0.25, -0.03125)])
def test_where_the_drift_is_beyond_the_limit_no_true_current_is_known(drift: float, per_k: float) -> None:
    model = TemperatureDrift(drift_per_k=per_k, reference_c=20.0)
    fault = SensorFault(drift=drift, model=model, largest_drift=0.5)
    assert fault.true_current(30.0, 28.0) == 30.0 / (1.0 + 2.0 * drift)
    assert fault.true_current(30.0, 28.5) is None


def test_without_its_temperature_nothing_is_known() -> None:
    fault = SensorFault(model=TemperatureDrift(drift_per_k=0.01, reference_c=20.0))
    assert fault.true_current(10.0, None) is None


def test_no_fault_changes_no_power() -> None:
    signals = Signals(source=POWER, target=POWER, sign=-1, voltage=VOLTAGE)
    plan = correction_plan(signals, NO_FAULT)
    assert isinstance(plan, IntegerPlan)
    assert [plan.apply(code, 20000) for code in whole_range(POWER)] == list(whole_range(POWER))
