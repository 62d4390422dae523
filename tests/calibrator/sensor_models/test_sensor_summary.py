"""Summaries with the columns of sensors that are not linear, against the samples they are made of."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.errors import DriveError
from calibrator.sensor_models.choice import SensorModelChoice
from calibrator.sensor_models.families import FAMILIES
from calibrator.sensor_models.linear_part import linear_summary
from calibrator.sensor_models.summary import summarise_sensors
from calibrator.summaries.summariser import summarise
from tests.calibrator.sensor_models.sensor_fleets import PERIOD_S, TEMPERATURE, make_fleet

DRIVE = make_fleet(vehicles=1, branches=3, minutes=3.0, seed=5).samples[0]
ZERO_A = np.array([3.0, -2.0, 0.5])


def test_the_products_are_those_of_all_columns() -> None:
    vehicle = summarise_sensors([DRIVE], zero_a=ZERO_A, period_s=PERIOD_S, temperature=TEMPERATURE)
    inputs, temperature_c = DRIVE.inputs[:, :-1], DRIVE.inputs[:, -1]
    x = np.column_stack([DRIVE.currents_a - ZERO_A, inputs])
    extra = [family.column(x, temperature_c) for family in FAMILIES]
    columns = np.column_stack([inputs, DRIVE.currents_a, np.ones(len(x)), *extra])
    assert vehicle.products.sum(axis=0) == pytest.approx(columns.T @ columns, rel=1e-9)
    for family, of_family in zip(FAMILIES, extra, strict=True):
        places = [*vehicle.current_columns(family), *vehicle.input_columns(family)]
        assert columns[:, places] == pytest.approx(of_family)


def test_the_moments_stay_what_they_are_without_extra_columns() -> None:
    vehicle = summarise_sensors([DRIVE], zero_a=ZERO_A, period_s=PERIOD_S, temperature=TEMPERATURE)
    bare = replace(DRIVE, input_names=DRIVE.input_names[:-1], inputs=DRIVE.inputs[:, :-1])
    assert np.array_equal(vehicle.summary.moments, summarise([bare], period_s=PERIOD_S).moments)
    assert vehicle.summary.take_branches([1, 0]).extra is None


def test_samples_that_are_not_valid_take_no_part() -> None:
    gap = slice(300, 400)
    valid = DRIVE.valid.copy()
    valid[gap] = False
    currents_a, inputs = DRIVE.currents_a.copy(), DRIVE.inputs.copy()
    currents_a[gap], inputs[gap] = np.nan, np.nan
    holed = replace(DRIVE, valid=valid, currents_a=currents_a, inputs=inputs)
    found = summarise_sensors([holed], zero_a=ZERO_A, period_s=PERIOD_S, temperature=TEMPERATURE)
    assert np.all(np.isfinite(found.products))
    assert found.summary.duration_s == pytest.approx(170.0)


def test_without_a_temperature_only_the_sign_is_looked_at() -> None:
    bare = replace(DRIVE, input_names=DRIVE.input_names[:-1], inputs=DRIVE.inputs[:, :-1])
    found = summarise_sensors([bare], zero_a=ZERO_A, period_s=PERIOD_S)
    assert [family.name for family in found.families] == ["gain by sign"]


def test_a_drive_without_the_temperature_is_refused_in_one_line() -> None:
    with pytest.raises(DriveError, match=r"no input 'oil' among driving, .*; align the drive with it"):
        summarise_sensors([DRIVE], zero_a=ZERO_A, period_s=PERIOD_S, temperature="oil")


def test_the_linear_summary_is_that_of_the_linear_parts() -> None:
    vehicle = summarise_sensors([DRIVE], zero_a=ZERO_A, period_s=PERIOD_S, temperature=TEMPERATURE)
    choices = [
        SensorModelChoice(model="gain by sign", excess=0.1, log_bayes_factor=20.0),
        SensorModelChoice(log_bayes_factor=-5.0),
        SensorModelChoice(model="temperature", excess=0.002, reference=7.0, log_bayes_factor=20.0),
    ]
    currents_a, temperature_c = DRIVE.currents_a.copy(), DRIVE.inputs[:, -1]
    currents_a[:, 0] -= 0.1 * np.maximum(currents_a[:, 0] - 3.0, 0.0)
    currents_a[:, 2] -= 0.002 * (currents_a[:, 2] - 0.5) * (temperature_c - 25.0 - 7.0)
    straight = replace(DRIVE, currents_a=currents_a, input_names=DRIVE.input_names[:-1], inputs=DRIVE.inputs[:, :-1])
    expected = summarise([straight], period_s=PERIOD_S).moments
    assert linear_summary(vehicle, choices).moments == pytest.approx(expected, rel=1e-9, abs=1e-6)


def test_the_linear_summary_of_linear_sensors_is_the_summary() -> None:
    vehicle = summarise_sensors([DRIVE], zero_a=ZERO_A, period_s=PERIOD_S, temperature=TEMPERATURE)
    linear = [SensorModelChoice(log_bayes_factor=-5.0)] * 3
    assert linear_summary(vehicle, linear).moments == pytest.approx(vehicle.summary.moments, rel=1e-12)
