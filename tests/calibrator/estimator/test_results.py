"""Result folders: written results are read back, and other folders are refused."""

import errno
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from calibrator.errors import FleetError
from calibrator.estimator import results
from calibrator.report.fleet_table import read_fleet_table
from calibrator.report.overview import overview_of
from calibrator.summaries.identity import bucket_of
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters, read_parameters
from tests.calibrator.command_here import refused, succeeded
from tests.calibrator.report.results_at_hand import RUN as AT_HAND
from tests.calibrator.report.results_at_hand import six_vehicle_result
from tests.ecu_node.vehicles import parameters_for

BUCKETS = 16
RUN = replace(AT_HAND, buckets=BUCKETS)


def vehicle(database: VehicleDatabase, name: str) -> VehicleParameters:
    return replace(parameters_for(database, battery=(0.1, 0.0), motor=(0.0, 1.0)), vehicle=name)


@pytest.fixture(params=[2, results.MOST_FILES + 1], ids=["one file per vehicle", "buckets of vehicles"])
def result(request: pytest.FixtureRequest, tmp_path: Path, database: VehicleDatabase) -> Path:
    """A result of two vehicles, written as one of few or of many."""
    folder = tmp_path / "result"
    (folder / results.PARTS).mkdir(parents=True)
    for name in ("v1", "v2"):
        found = {name: results.Calibrated(vehicle(database, name))}
        results.part_file(folder, bucket_of(name, BUCKETS)).write_bytes(results.encode_chunk(found))
    results.join_rows(folder, {})
    where = results.write_parameter_files(folder, vehicles=request.param)
    assert where == ("params" if request.param == 2 else results.PARTS)
    assert (folder / "params").exists() == (where == "params")
    results.write_run(folder, RUN)
    return folder


@pytest.mark.parametrize("name", ["v3", "../params/v1", ""])
def test_error_for_a_vehicle_that_the_result_lacks_gives_its_name(result: Path, name: str) -> None:
    with pytest.raises(FleetError, match=rf"no vehicle '{name}' in it; results\.parquet names all that are"):
        results.written_of(result, name)


def test_params_command_writes_the_files_of_all_named_vehicles_or_none(result: Path, tmp_path: Path) -> None:
    written = succeeded("params", result, "v1", "v2", "--out", tmp_path / "out")
    assert written.splitlines() == [str(tmp_path / "out" / f"{name}.json") for name in ("v1", "v2")]
    second = read_parameters(tmp_path / "out" / "v2.json")
    assert (second.vehicle, second.branches["motor"].offset_a) == ("v2", 1.0)
    assert "no vehicle 'v9' in it" in refused("params", result, "v1", "v9", "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_params_command_names_the_file_that_a_full_disk_cannot_take(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("ecu_node.documents.os.fsync", full)
    line = refused("params", result, "v1", "--out", tmp_path / "out")
    assert f"{tmp_path}/out/v1.json: cannot be written: No space left on device; " in line


def test_vehicle_with_invalid_parameters_is_left_out(tmp_path: Path, database: VehicleDatabase) -> None:
    good = vehicle(database, "v1")
    bad = replace(good, vehicle="v2", branches={"battery": replace(good.branches["battery"], offset_a=float("nan"))})
    (tmp_path / results.PARTS).mkdir()
    found = {item.vehicle: results.Calibrated(item) for item in (bad, good)}
    results.part_file(tmp_path, 0).write_bytes(results.encode_chunk(found))
    assert results.join_rows(tmp_path, {}) == 1
    (reason,) = results.left_out_of(tmp_path).values()
    assert reason.endswith("; look at its recordings")


def test_folder_that_is_not_a_result_is_refused_and_named(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match=r"run\.json: not a result of 'calibrator calibrate': No such file"):
        results.read_run(tmp_path)
    with pytest.raises(FleetError, match=r"results\.parquet: not a result of 'calibrator calibrate'"):
        results.read_results(tmp_path)
    (tmp_path / "run.json").write_text('{"tool": 1}')
    with pytest.raises(FleetError, match=r"run\.json: not a run of 'calibrator calibrate': .*; calibrate again"):
        results.read_run(tmp_path)


def test_counts_printed_by_calibrate_equal_those_of_the_report(tmp_path: Path, database: VehicleDatabase) -> None:
    folder = six_vehicle_result(tmp_path / "result", database)
    report = results.report_of(folder, results.read_run(folder), parameters="p", shown=folder)
    page = overview_of(read_fleet_table(folder))
    assert report.verdicts == {"corrected": 2, "no sensor fault": 2, "cannot tell": 2}
    assert report.held_back == {"harm limit": 1, "beyond the limits": 1}
    assert (report.verdicts, report.held_back) == (page["verdicts"], page["held_back"])
    assert report.hardware_count == page["hardware_suspected"] == report.moved_count == 1
    assert set(report.corrected) == {"V1", "V10"}
    assert np.isfinite(report.junction_rms_deployed_a)
