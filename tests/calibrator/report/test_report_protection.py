"""The battery's protection margin, through the report; the limit is full scale, 400 A."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibrator.report.overview import SIGMAS
from calibrator.report.page import report_page
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import BranchParameters
from tests.calibrator.report.results_at_hand import sensor, vehicle, write_result
from tests.calibrator.report.test_report_pages import visible

DOUBT_A = SIGMAS * np.hypot(400.0 * 0.001, 0.1)
"""Of a sensor that is known to 0.1 % and 0.1 A. [A]"""


Margin = Callable[..., tuple[Any, str]]


@pytest.fixture
def margin(tmp_path: Path, database: VehicleDatabase) -> Margin:
    """The margin of a fleet with some battery sensors, and the text of its page."""

    def of(*batteries: BranchParameters, **options: Any) -> tuple[Any, str]:
        items = [vehicle(database, f"V{j}", battery, sensor()) for j, battery in enumerate(batteries, start=1)]
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        text, report = report_page(write_result(folder, items), **options)
        return report["protection"], visible(text)

    return of


def test_sensor_needs_its_error_at_the_limit_and_corrected_its_doubt_alone(margin: Margin) -> None:
    found, _ = margin(sensor(0.1, -4.0, apply=True), sensor(0.02, 1.0, apply=True))
    assert found["common_before_a"] == pytest.approx(44.0 + DOUBT_A)
    assert found["common_after_a"] == pytest.approx(DOUBT_A)
    assert found["common_gain_a"] == pytest.approx(44.0)
    assert found["own_gain_a"] == pytest.approx((44.0 + 9.0) / 2.0)
    assert (found["vehicles"], found["corrected"], found["largest"]) == (2, 2, [])
    half, _ = margin(sensor(0.1, -4.0, apply=True), sensor(), limit_a=200.0)
    assert half["common_gain_a"] == pytest.approx(24.0)


def test_one_margin_for_all_falls_no_lower_than_the_worst_that_is_not_corrected(margin: Margin) -> None:
    found, text = margin(sensor(0.1, 4.0, apply=True), sensor(0.02, -1.0), sensor())
    assert found["common_after_a"] == pytest.approx(9.0 + DOUBT_A)
    assert [name for name, _ in found["largest"]] == ["V2"]
    assert f"Not corrected, these keep it large: V2 ({9.0 + DOUBT_A:.1f} A)." in text


def test_sensor_that_is_not_known_is_not_counted_and_that_is_said(margin: Margin) -> None:
    lost = sensor(0.3, 50.0, sd=0.2)
    found, text = margin(lost, sensor(0.1, 4.0), sensor())
    assert (found["vehicles"], found["not_known"]) == (2, 1)
    assert found["common_before_a"] == pytest.approx(44.0 + DOUBT_A)
    assert "1 of which the sensor is not known are not counted" in text
    none, text = margin(lost, lost)
    assert none is None
    assert "How wrong the battery sensor can be is not known, so no margin follows." in text


def test_gains_are_told_in_kilowatts_where_the_voltage_is_known(margin: Margin) -> None:
    _, text = margin(sensor(0.1, 4.0, apply=True), sensor(), voltage_v=350.0)
    assert "44.0 A = 15.4 kW given back with one margin for all" in text
    _, text = margin(sensor(0.1, 4.0, apply=True), sensor())
    assert "With --voltage the same is given in kW." in text
    none, _ = margin(sensor(0.1, 4.0), sensor(), voltage_v=350.0)
    assert (none["common_gain_a"], none["own_gain_a"]) == (0.0, None)


def test_of_a_large_fleet_one_in_a_thousand_may_need_more(margin: Margin) -> None:
    usual = [sensor(0.0, 5.0)] * 1000
    assert margin(*usual, sensor(0.0, 300.0))[0]["common_before_a"] == pytest.approx(5.0 + DOUBT_A)
    assert margin(*usual[:100], sensor(0.0, 300.0))[0]["common_before_a"] == pytest.approx(300.0 + DOUBT_A)
