"""From a choice to the parameter file; what the file says is the sensor."""

import pytest

from calibrator.sensor_models.choice import SensorModelChoice
from calibrator.sensor_models.families import GainBySign, TemperatureDrift
from calibrator.sensor_models.linear_part import chosen_sensor, sensor_parameters
from ecu_node.sensor_models import GainBySign as GainBySignParameters
from ecu_node.sensor_models import TemperatureDrift as TemperatureDriftParameters

SIGN = SensorModelChoice(model="gain by sign", excess=0.1, excess_sd=0.01, log_bayes_factor=30.0)
TEMPERATURE = SensorModelChoice(
    model="temperature", excess=0.002, excess_sd=1e-4, reference=12.0, log_bayes_factor=30.0
)
LINEAR = SensorModelChoice(log_bayes_factor=-3.0)


def test_a_gain_by_sign_is_said_with_both_drifts() -> None:
    said = sensor_parameters(SIGN, -0.1)
    assert said is not None
    drift, found = said
    assert isinstance(found, GainBySignParameters)
    assert (found.drift_positive, found.drift_negative) == pytest.approx((0.0, -0.1))
    assert drift == pytest.approx(-0.05)
    assert found.difference_sd == pytest.approx(0.01)
    assert chosen_sensor(SIGN, -0.1) == GainBySign(
        drift_positive=found.drift_positive, drift_negative=found.drift_negative
    )


def test_a_temperature_drift_is_said_at_its_reference() -> None:
    said = sensor_parameters(TEMPERATURE, 0.05)
    assert said is not None
    drift, found = said
    assert isinstance(found, TemperatureDriftParameters)
    assert (drift, found.reference_c) == (0.05, 37.0)
    assert found.drift_per_k == pytest.approx(0.0021)
    assert found.drift_per_k_sd == pytest.approx(1.05e-4)
    assert chosen_sensor(TEMPERATURE, 0.05) == TemperatureDrift(
        drift=0.05, drift_per_k=found.drift_per_k, reference_c=37.0
    )


def test_a_linear_sensor_has_no_sensor_model() -> None:
    assert sensor_parameters(LINEAR, 0.07) == (0.07, None)
    assert chosen_sensor(LINEAR, 0.07) is None


def test_what_a_parameter_file_cannot_say_is_not_said() -> None:
    assert sensor_parameters(SIGN, 0.9) is None
