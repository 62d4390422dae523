"""The numbers of the report: those of a result whose every number is known."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from calibrator.errors import FleetError
from calibrator.report.fleet_table import FleetTable, read_details, read_fleet_table
from calibrator.report.overview import SIGMAS, overview_of, steps_to_take, workshop_list
from calibrator.report.page import report_page
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import BranchParameters, SensorFinding
from tests.calibrator.report.results_at_hand import EVIL, sensor, six_vehicles, vehicle, write_result
from tests.calibrator.report.test_report_pages import visible


def workshop(table: FleetTable) -> list[dict[str, Any]]:
    return workshop_list(table, read_details(table, np.arange(len(table)))[0])


def steps(result: Path) -> list[str]:
    table = read_fleet_table(result)
    return steps_to_take(table, workshop(table))


def test_overview_counts_vehicles_and_sensors_and_takes_medians(result: Path) -> None:
    found = overview_of(read_fleet_table(result))
    wanted = {
        "verdicts": {"corrected": 2, "no sensor fault": 2, "cannot tell": 2},
        "corrected": 2,
        "faulty_sensors": 5,
        "applied_sensors": 3,
        "held_back": {"harm limit": 1, "beyond the limits": 1},
        "hardware_suspected": 1,
        "left_out": 1,
        "left_out_reasons": {f"cannot be read: {EVIL}": 1},
        "moved_sensors": 1,
        "unmeasured_a": 0.3,
    }
    assert found | wanted == found
    assert found["junction_measured_a"]["median"] == pytest.approx(10.5)  # of 0.4, 0.6, 8, 13, 24, 60 A
    assert found["junction_deployed_a"]["median"] == pytest.approx(0.65)  # of 0.4, 0.5, 0.6, 0.7, 8, 60 A
    assert found["duration_h"]["median"] == 0.5


def test_workshop_list_has_hardware_first_then_sensors_then_shared_causes(
    tmp_path: Path, database: VehicleDatabase
) -> None:
    vehicles = six_vehicles(database)
    load = SensorFinding(branch="battery", cause="load", probability=0.99, text="5 A without a sensor.")
    inverted = SensorFinding(branch="motor", cause="inverted", probability=0.9, text="its sign is turned.")
    vehicles[1] = replace(vehicles[1], findings=[load, inverted])
    rows = workshop(read_fleet_table(write_result(tmp_path / "r", vehicles)))
    assert [(row["vehicle"], row["branch"], row["cause"], row["probability"]) for row in rows] == [
        ("V3", "", "hardware", 0.97),
        ("V5", "motor", "beyond the limits", 0.995),
        ("V2", "motor", "inverted", 0.9),
        ("V2", "battery", "load", 0.99),
    ]
    assert rows[0]["text"] == "its currents differ from the fleet's: all −6.00 %, battery +2.00 A, motor −2.00 A"
    assert "replace the sensor" in rows[1]["text"]


def test_next_steps_name_action_and_vehicles(result: Path) -> None:
    install, window, hardware, check, left_out = steps(result)
    assert install.startswith("Install the parameters of V1, V10 on their nodes")
    assert window == "V4: a zero-current window (contactors open) would decide."
    assert hardware == "Look at the hardware of V3: their currents differ from the fleet's."
    assert check == "Check the sensors of V5 (motor): see the workshop list."
    assert left_out == f"Find out why log of {EVIL} could not be used; most often: cannot be read: {EVIL}."


def test_next_steps_combine_vehicles_that_one_measurement_decides(tmp_path: Path, database: VehicleDatabase) -> None:
    held = sensor(0.0, 8.0, held_back="harm limit")
    window = "a zero-current window (contactors open) would decide: the motor sensor then shows +{} A or +0 A"
    needs = {"V1": window.format(7), "V2": window.format(3), "V3": window.format(7)}
    items = [vehicle(database, name, held, sensor(), decides=need) for name, need in needs.items()]
    assert steps(write_result(tmp_path / "few", items)) == [f"V1, V3: {needs['V1']}.", f"V2: {needs['V2']}."]
    items += [vehicle(database, f"W{n}", held, sensor(), decides=window.format(n)) for n in (4, 5)]
    assert steps(write_result(tmp_path / "many", items)) == [
        "V1, V3, V2, W4, W5, not corrected because the correction might do harm: what would decide stands with each. "
        f"Of V1: {needs['V1']}."
    ]


def test_next_step_of_a_result_from_tables_is_to_correct_them_with_kirchhoff(result: Path) -> None:
    text = (result / "run.json").read_text()
    no_dbc = f'"dbc_sha256": "{hashlib.sha256(b"").hexdigest()}"'
    (result / "run.json").write_text(text.replace('"dbc_sha256": ""', no_dbc))
    (first, *_) = steps(result)
    assert first.startswith("Correct the tables of V1, V10: 'calibrator kirchhoff TABLE --layout LAYOUT --parameters")
    assert "A node needs a layout with the signals of a DBC." in first


def test_result_whose_rows_do_not_match_its_run_file_is_refused(result: Path) -> None:
    run = (result / "run.json").read_text()
    (result / "run.json").write_text(run.replace('"motor"\n', '"dcdc"\n', 1))
    with pytest.raises(FleetError, match=r"rows are not those of vehicles with the branches battery, dcdc of run"):
        read_fleet_table(result)


def test_damaged_results_parquet_is_refused_and_named(result: Path) -> None:
    (result / "results.parquet").write_bytes(b"PAR1")
    with pytest.raises(FleetError, match=r"results\.parquet: not a result of .*; name a folder"):
        read_fleet_table(result)


# The battery's protection margin; the limit is full scale, 400 A


DOUBT_A = SIGMAS * np.hypot(400.0 * 0.001, 0.1)
"""Margin for a sensor without error whose gain is known to 0.1 % and offset to 0.1 A (standard deviations). [A]"""


Margin = Callable[..., tuple[Any, str]]


@pytest.fixture
def margin(tmp_path: Path, database: VehicleDatabase) -> Margin:
    """Function from battery sensors to the margin of a fleet with them, and the text of its page."""

    def of(*batteries: BranchParameters, **options: Any) -> tuple[Any, str]:
        items = [vehicle(database, f"V{j}", battery, sensor()) for j, battery in enumerate(batteries, start=1)]
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        text, report = report_page(write_result(folder, items), **options)
        return report["protection"], visible(text)

    return of


def test_protection_margin_is_the_sensor_error_or_after_correction_its_uncertainty(margin: Margin) -> None:
    found, _ = margin(sensor(0.1, -4.0, apply=True), sensor(0.02, 1.0, apply=True))
    assert found["common_before_a"] == pytest.approx(44.0 + DOUBT_A)
    assert found["common_after_a"] == pytest.approx(DOUBT_A)
    assert found["common_gain_a"] == pytest.approx(44.0)
    assert found["own_gain_a"] == pytest.approx((44.0 + 9.0) / 2.0)
    assert (found["vehicles"], found["corrected"], found["largest"]) == (2, 2, [])
    half, _ = margin(sensor(0.1, -4.0, apply=True), sensor(), limit_a=200.0)
    assert half["common_gain_a"] == pytest.approx(24.0)


def test_common_margin_is_set_by_the_worst_uncorrected_sensor(margin: Margin) -> None:
    found, text = margin(sensor(0.1, 4.0, apply=True), sensor(0.02, -1.0), sensor())
    assert found["common_after_a"] == pytest.approx(9.0 + DOUBT_A)
    assert [name for name, _ in found["largest"]] == ["V2"]
    assert f"Not corrected, these keep it large: V2 ({9.0 + DOUBT_A:.1f} A)." in text


def test_sensor_of_undetermined_error_is_left_out_of_the_protection_margin_and_counted(margin: Margin) -> None:
    lost = sensor(0.3, 50.0, sd=0.2)
    found, text = margin(lost, sensor(0.1, 4.0), sensor())
    assert (found["vehicles"], found["not_known"]) == (2, 1)
    assert found["common_before_a"] == pytest.approx(44.0 + DOUBT_A)
    assert "1 of which the sensor is not known are not counted" in text
    none, text = margin(lost, lost)
    assert none is None
    assert "How wrong the battery sensor can be is not known, so no margin follows." in text


def test_saved_margin_is_given_in_kilowatts_if_the_voltage_is_known(margin: Margin) -> None:
    _, text = margin(sensor(0.1, 4.0, apply=True), sensor(), voltage_v=350.0)
    assert "44.0 A = 15.4 kW given back with one margin for all" in text
    _, text = margin(sensor(0.1, 4.0, apply=True), sensor())
    assert "With --voltage the same is given in kW." in text
    none, _ = margin(sensor(0.1, 4.0), sensor(), voltage_v=350.0)
    assert (none["common_gain_a"], none["own_gain_a"]) == (0.0, None)
