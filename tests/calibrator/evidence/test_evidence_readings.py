"""Direct readings of single sensors as rows of the evidence."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.evidence.readings import Readings, no_readings, trusted_readings, with_readings
from calibrator.evidence.rows import UNKNOWN_VARIANCE
from calibrator.posterior.states import enumerate_states
from tests.calibrator.posterior.simulated_rows import FULL_SCALE_A, faults_of, no_spread, prior_of, rows_of

AMBIGUOUS = faults_of(np.zeros((1, 3)), np.array([[0.15, 0.0, 0.1]]))
"""A hardware offset of 60 A and an offset of 40 A of the second sensor: two other pairs explain the same."""


def offset_reading(offset_a: tuple[float, float]) -> Readings:
    nothing = no_readings(1, 2)
    return Readings(
        drift=nothing.drift,
        drift_sd=nothing.drift_sd,
        offset_a=np.array([offset_a]),
        offset_sd_a=np.array([[0.1, 0.1]]),
    )


def test_a_zero_current_window_decides_between_explanations() -> None:
    rows = rows_of(AMBIGUOUS, noise=0.0)
    before = enumerate_states(rows, prior_of(2), no_spread(2))
    read = with_readings(rows, offset_reading((0.0, 40.0)), full_scale_a=FULL_SCALE_A)
    after = enumerate_states(read, prior_of(2), no_spread(2))
    right = np.abs(after.offset[0] - [0.0, 0.1]).max(axis=1) < 0.002
    assert before.weight[0, 0] < 0.9
    assert after.weight[0][right].sum() > 0.99


def test_no_reading_changes_nothing() -> None:
    rows = rows_of(AMBIGUOUS)
    same = with_readings(rows, no_readings(1, 2), full_scale_a=FULL_SCALE_A)
    np.testing.assert_array_equal(same.relative, rows.relative)
    np.testing.assert_array_equal(same.constant, rows.constant)
    np.testing.assert_array_equal(same.covariance, rows.covariance)


def test_trusted_vehicles_read_zero_and_the_others_nothing() -> None:
    readings = trusted_readings(np.array([True, False]), 2, FULL_SCALE_A)
    assert readings.drift[0].tolist() == [0.0, 0.0]
    assert np.isnan(readings.drift[1]).all()
    assert np.isnan(readings.offset_sd_a[1]).all()


def test_a_sensor_that_is_read_twice_counts_with_the_precision_of_each_reading() -> None:
    first, second = offset_reading((1.0, 2.0)), offset_reading((5.0, np.nan))
    sharp = replace(second, offset_sd_a=np.array([[0.05, 0.05]]))
    merged = first.merged(sharp)
    assert merged.offset_a[0] == pytest.approx([(1.0 + 4.0 * 5.0) / 5.0, 2.0])
    assert merged.offset_sd_a[0] == pytest.approx([0.1 / np.sqrt(5.0), 0.1])
    assert np.isnan(merged.drift).all()
    assert np.isnan(merged.drift_sd).all()


def test_the_deviation_of_a_gain_reading_is_that_of_the_logarithm() -> None:
    nothing = no_readings(1, 2)
    read = replace(nothing, drift=np.array([[0.25, np.nan]]), drift_sd=np.array([[0.01, np.nan]]))
    rows = with_readings(rows_of(AMBIGUOUS), read, full_scale_a=FULL_SCALE_A)
    assert rows.relative[0, 3] == pytest.approx(np.log(1.25))
    assert rows.covariance[0, 3, 3] == pytest.approx((0.01 / 1.25) ** 2)


def test_readings_follow_their_branches() -> None:
    assert offset_reading((1.0, 2.0)).take_branches([1, 0]).offset_a.tolist() == [[2.0, 1.0]]


def test_an_unread_row_says_nothing() -> None:
    rows = with_readings(rows_of(AMBIGUOUS), offset_reading((np.nan, 40.0)), full_scale_a=FULL_SCALE_A)
    assert rows.covariance[0, 8, 8] == UNKNOWN_VARIANCE
    assert rows.covariance[0, 9, 9] < 1e-6
