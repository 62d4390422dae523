import numpy as np
import pytest

from calibrator.report.protection import SIGMAS, Margins, margins, protection_of

ONES = np.ones(4)
DRIFT, OFFSET_A = np.array([0.1, -0.1, 0.0, 0.02]), np.array([4.0, 4.0, 0.0, -1.0])


def of(applied: list[bool], *, sd: float = 0.0, limit_a: float = 400.0, scale: float = 1.0) -> Margins:
    return margins(scale * DRIFT, scale * OFFSET_A, sd * ONES, 100.0 * sd * ONES, np.array(applied), limit_a=limit_a)


def test_a_vehicle_needs_what_its_sensor_is_off_by_at_the_limit() -> None:
    found = of([False] * 4)
    np.testing.assert_allclose(found.before_a, [44.0, 44.0, 0.0, 9.0])
    np.testing.assert_array_equal(found.after_a, found.before_a)
    np.testing.assert_array_equal(found.own_gain_a, 0.0)


def test_a_corrected_sensor_needs_its_uncertainty_alone() -> None:
    found = of([True] * 4, sd=0.001)
    expected = SIGMAS * np.hypot(0.4, 0.1)
    np.testing.assert_allclose(found.after_a, expected)
    np.testing.assert_allclose(found.before_a, [44.0, 44.0, 0.0, 9.0])


def test_doubt_gives_nothing_back() -> None:
    found = of([False] * 4, sd=0.01)
    doubt_a = SIGMAS * np.hypot(4.0, 1.0)
    np.testing.assert_allclose(found.after_a, [44.0, 44.0, doubt_a, 9.0 + doubt_a])
    assert found.common_before_a - found.common_after_a == 0.0


def test_no_vehicle_needs_more_than_what_is_set_for_the_worst() -> None:
    np.testing.assert_allclose(of([True, False, True, False], sd=0.5).after_a, 44.0)


def test_one_margin_for_all_falls_no_lower_than_the_worst_that_is_not_corrected() -> None:
    found = of([True, True, True, False])
    assert found.common_before_a == pytest.approx(44.0)
    assert found.common_after_a == pytest.approx(9.0)


def test_without_correction_nothing_is_given_back() -> None:
    none_applied = np.zeros(4, bool)
    found = protection_of(of([False] * 4, sd=0.01), none_applied, branch="battery", voltage_v=350.0)
    assert (found.common_gain_a, found.common_gain_kw, found.corrected) == (0.0, 0.0, 0)
    assert (found.own_gain_a, found.own_gain_kw) == (None, None)
    np.testing.assert_array_equal(of([False] * 4, sd=0.01).own_gain_a, 0.0)


def test_with_a_margin_per_vehicle_a_correction_gives_back_what_it_takes_away() -> None:
    applied = [True, False, False, True]
    found = of(applied, sd=0.001)
    doubt_a = SIGMAS * np.hypot(0.4, 0.1)
    np.testing.assert_allclose(found.own_gain_a, [44.0 - doubt_a, 0.0, 0.0, 9.0])
    told = protection_of(found, np.array(applied), branch="battery", voltage_v=350.0)
    assert told.own_gain_a == pytest.approx((44.0 - doubt_a + 9.0) / 2.0)
    assert told.corrected == 2


def test_gains_are_told_in_kilowatts_where_the_voltage_is_known() -> None:
    every = np.ones(4, bool)
    found = protection_of(of([True] * 4), every, branch="battery", voltage_v=350.0)
    assert found.common_gain_kw == pytest.approx(44.0 * 0.35)
    assert found.own_gain_kw == pytest.approx(26.5 * 0.35)
    assert protection_of(of([True] * 4), every, branch="battery", voltage_v=None).own_gain_kw is None


def test_twice_the_faults_take_twice_the_margin() -> None:
    np.testing.assert_allclose(of([False] * 4, scale=2.0).before_a, 2.0 * of([False] * 4).before_a)


def test_of_a_large_fleet_one_in_a_thousand_may_need_more() -> None:
    needed_a, nothing = np.concatenate([np.full(9995, 5.0), np.full(5, 500.0)]), np.zeros(10_000)
    found = margins(nothing, needed_a, nothing, nothing, np.zeros(10_000, bool), limit_a=400.0)
    assert found.common_before_a == pytest.approx(5.0)
