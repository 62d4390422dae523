"""Counts of a result: taken of vehicles a few at a time, or all at once, by the calibration and by the pages."""

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from calibrator.calibration.report import report_of
from calibrator.report.fleet_table import read_fleet_table
from calibrator.report.overview import overview_of
from calibrator.results.counts import Counts, count_rows
from calibrator.results.run_record import read_run
from ecu_node.database import VehicleDatabase
from tests.calibrator.report.results_at_hand import BRANCHES, six_vehicle_result


@pytest.fixture
def result(tmp_path: Path, database: VehicleDatabase) -> Path:
    return six_vehicle_result(tmp_path / "result", database)


@pytest.fixture
def rows(result: Path) -> pa.Table:
    table = pq.ParquetFile(result / "results.parquet").read(use_threads=False)
    return table.filter(pc.field("branch").is_valid())


def test_vehicles_and_branches_are_counted(rows: pa.Table) -> None:
    found = count_rows(rows, BRANCHES)
    assert found.verdicts == {"corrected": 2, "no sensor fault": 2, "cannot tell": 2}
    assert found.held_back == {"harm limit": 1, "beyond the limits": 1}
    assert (found.hardware_suspected, found.moved_vehicles, found.moved_sensors) == (1, 1, 1)


@pytest.mark.parametrize("vehicles", [1, 2, 5])
def test_counts_of_parts_add_up_to_those_of_the_whole(rows: pa.Table, vehicles: int) -> None:
    length = vehicles * len(BRANCHES)
    parts = [count_rows(rows.slice(start, length), BRANCHES) for start in range(0, rows.num_rows, length)]
    whole = count_rows(rows, BRANCHES)
    assert sum(parts, Counts()) == whole
    assert list(sum(parts, Counts()).verdicts) == list(whole.verdicts)


def test_the_calibration_and_the_page_tell_the_same(result: Path) -> None:
    told = report_of(result, read_run(result), parameters="params", shown=result)
    page = overview_of(read_fleet_table(result))
    assert (told.verdicts, told.held_back) == (page.verdicts, page.held_back)
    assert told.hardware_count == page.hardware_suspected
