"""Families of sensor models: their linear part is linear, and the inverse gives the true current back."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.sensor_models.families import (
    FAMILIES,
    GainBySign,
    GainBySignFamily,
    SensorModel,
    TemperatureDrift,
    TemperatureFamily,
)

I_A = np.linspace(-120.0, 250.0, 400)
TEMPERATURE_C = np.linspace(-10.0, 60.0, 400)[::-1]
SENSORS = (
    GainBySign(drift_positive=0.08, drift_negative=-0.05),
    TemperatureDrift(drift=0.1, drift_per_k=0.002, reference_c=20.0),
)


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_inverse_gives_the_true_current_back(sensor: SensorModel) -> None:
    assert sensor.inverse(sensor.measured(I_A, TEMPERATURE_C), TEMPERATURE_C) == pytest.approx(I_A, abs=1e-9)


def test_a_sensor_without_excess_is_linear() -> None:
    for family in FAMILIES:
        sensor = family.fitted(0.0, 0.0, 0.07)
        assert sensor.measured(I_A, TEMPERATURE_C) == pytest.approx(1.07 * I_A)


def _linear_part(i_m: Array, column: Array, excess: float, reference: float, zero_a: float) -> Array:
    return np.asarray(i_m - excess * (column - reference * (i_m - zero_a)))


def test_the_linear_part_of_a_gain_by_sign_is_the_sensor_for_negative_currents() -> None:
    family, offset_a = GainBySignFamily(), 12.0
    sensor = family.fitted(0.15, 0.0, -0.05)
    i_m = sensor.measured(I_A, TEMPERATURE_C) + offset_a
    column = family.column((i_m - offset_a)[:, None], TEMPERATURE_C)[:, 0]
    assert _linear_part(i_m, column, 0.15, 0.0, offset_a) == pytest.approx(0.95 * I_A + offset_a)


def test_the_linear_part_of_a_temperature_drift_is_exact_to_second_order() -> None:
    family, offset_a, reference_k = TemperatureFamily(), -8.0, 5.0
    sensor = family.fitted(0.001, reference_k, 0.1)
    i_m = sensor.measured(I_A, TEMPERATURE_C) + offset_a
    column = family.column((i_m - offset_a)[:, None], TEMPERATURE_C)[:, 0]
    left_a = _linear_part(i_m, column, 0.001, reference_k, offset_a) - (1.1 * I_A + offset_a)
    largest_change = 0.001 * np.abs(TEMPERATURE_C - 30.0)
    assert np.all(np.abs(left_a) <= 1.1 * np.abs(I_A) * largest_change**2 + 1e-9)
