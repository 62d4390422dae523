"""The numbers of the report are those of results.parquet, counted here in another way."""

from pathlib import Path

import duckdb
import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.report.fleet_table import read_fleet_table
from calibrator.report.lists import changes_since, largest_faults, left_out_rows, workshop_list
from calibrator.report.overview import overview_of
from ecu_node.database import VehicleDatabase
from tests.calibrator.report.results_at_hand import EVIL, sensor, six_vehicles, vehicle, write_result


def query(result: Path, sql: str) -> list[tuple[object, ...]]:
    found = duckdb.sql(sql.replace("RESULT", f"'{result / 'results.parquet'}'"))
    assert found is not None
    return found.fetchall()


def test_counts_are_those_of_the_result(result: Path) -> None:
    found = overview_of(read_fleet_table(result))
    counted = query(result, "select verdict, count(distinct vehicle) from RESULT where branch is not null group by 1")
    assert set(found.verdicts.items()) == set(counted)
    assert found.verdicts == {"corrected": 2, "no sensor fault": 2, "cannot tell": 2}
    faults = "from RESULT where (drift <> 0 or offset_a <> 0)"
    assert [(found.corrected,)] == query(result, f"select count(distinct vehicle) {faults} and applied")
    assert [(found.faulty_sensors,)] == query(result, f"select count(*) {faults}")
    assert [(found.applied_sensors,)] == query(result, f"select count(*) {faults} and applied")
    assert found.held_back == {"harm limit": 1, "beyond the limits": 1}
    assert found.hardware_suspected == 1
    assert found.left_out == 1
    assert found.moved_sensors == 1


def test_sums_are_those_of_the_result(result: Path) -> None:
    found = overview_of(read_fleet_table(result))
    first = "from RESULT where branch = 'battery'"
    ((measured, deployed),) = query(
        result, f"select median(junction_rms_measured_a), median(junction_rms_corrected_a) {first}"
    )
    assert found.junction_measured_a.median == measured
    assert found.junction_deployed_a.median == deployed
    assert found.unmeasured_a == 0.3
    assert found.duration_h.median == 0.5


def test_an_uncorrected_vehicle_keeps_its_measured_sum(tmp_path: Path, database: VehicleDatabase) -> None:
    item = vehicle(database, "V1", sensor(0.1), sensor(), verdict="cannot tell", sums_a=(9.0, 2.0))
    table = read_fleet_table(write_result(tmp_path / "r", [item]))
    assert table.deployed_a.tolist() == [9.0]


def test_largest_faults_come_first_with_what_is_done_about_them(result: Path) -> None:
    rows = largest_faults(read_fleet_table(result))
    assert [(row.vehicle, row.branch, row.error_a) for row in rows[:3]] == [
        ("V5", "motor", 180.0),
        ("V1", "battery", 44.0),
        ("V10", "battery", 20.0),
    ]
    assert [row.state for row in rows[:2]] == ["beyond the limits", "corrected"]
    assert rows[1].drift == "+10.00 ± 0.10 %"
    assert rows[1].offset == "+4.00 ± 0.10 A"


def test_the_workshop_gets_hardware_faults_and_sensors_that_parameters_do_not_mend(result: Path) -> None:
    found = workshop_list(read_fleet_table(result))
    (row,) = found.hardware
    assert (row.vehicle, row.probability, row.drift, list(row.offset_a)) == ("V3", 0.97, -0.06, [2.0, -2.0])
    assert [(row.vehicle, row.branch) for row in found.sensors] == [("V5", "motor")]


def test_vehicles_left_out_are_told_by_reason(result: Path) -> None:
    table = read_fleet_table(result)
    (row,) = left_out_rows(table, overview_of(table))
    assert (row.count, row.reason, row.names) == (1, f"cannot be read: {EVIL}", f"log of {EVIL}")


def test_changes_since_an_earlier_result_are_of_the_sensors_that_changed(
    result: Path, tmp_path: Path, database: VehicleDatabase
) -> None:
    before = six_vehicles(database)
    before[0] = vehicle(database, "V1", sensor(0.08, 5.0, apply=True), sensor())
    table, earlier = read_fleet_table(result), read_fleet_table(write_result(tmp_path / "before", before))
    found = changes_since(table, earlier)
    np.testing.assert_allclose(found["battery"], [0.02 * 400.0 - 1.0])
    assert len(found["motor"]) == 0
    assert changes_since(table, table) == changes_since(table, None) == {}


def test_a_result_whose_rows_are_not_those_of_its_run_is_refused(result: Path) -> None:
    run = (result / "run.json").read_text()
    (result / "run.json").write_text(run.replace('"motor"\n', '"dcdc"\n', 1))
    with pytest.raises(
        FleetError, match=r"rows are not those of vehicles with the branches battery, dcdc of run\.json"
    ):
        read_fleet_table(result)


def test_a_damaged_result_is_named(result: Path) -> None:
    (result / "results.parquet").write_bytes(b"PAR1")
    with pytest.raises(FleetError, match=r"results\.parquet: cannot be read: .*; give a folder"):
        read_fleet_table(result)
