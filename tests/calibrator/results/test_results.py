from pathlib import Path

import pytest
from msgspec.structs import replace

from calibrator.errors import FleetError
from calibrator.results.chunk import encode_chunk
from calibrator.results.parameter_parts import MOST_FILES, PARTS, write_parameter_files
from calibrator.results.rows import join_rows, read_results
from calibrator.results.run_record import RunRecord, read_run, write_run
from calibrator.results.vehicle import parameters_of
from calibrator.summaries.buckets import bucket_of
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import read_parameters
from tests.calibrator.conftest import run_command
from tests.ecu_node.vehicles import parameters_for

BUCKETS = 16


def test_a_folder_that_is_no_result_is_named(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match=r"run\.json: not a result of 'calibrator calibrate': No such file"):
        read_run(tmp_path)
    with pytest.raises(FleetError, match=r"results\.parquet: not a result of 'calibrator calibrate'"):
        read_results(tmp_path)


def test_a_damaged_run_is_named(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"tool": 1}')
    with pytest.raises(FleetError, match=r"run\.json: not a run of 'calibrator calibrate': .*; calibrate again"):
        read_run(tmp_path)


RUN = RunRecord(
    tool="test",
    method="posterior",
    fleet="f",
    layout="hv_powertrain",
    branches=["battery", "motor"],
    model_inputs=[],
    settings={},
    created="2026-01-01T00:00:00Z",
    details={},
    vehicles=2,
    left_out={},
    notices=[],
)


@pytest.fixture(params=[2, MOST_FILES + 1], ids=["a file each", "in parts"])
def result(request: pytest.FixtureRequest, tmp_path: Path, database: VehicleDatabase) -> Path:
    """A result of two vehicles, written as one of few or of many."""
    parts = {}
    for name in ("v1", "v2"):
        parameters = replace(parameters_for(database, battery=(0.1, 0.0), motor=(0.0, 1.0)), vehicle=name)
        number = bucket_of(name, BUCKETS)
        parts[number] = tmp_path / f"{number}.parquet"
        parts[number].write_bytes(encode_chunk([parameters], {}).parameters)
    folder = tmp_path / "result"
    folder.mkdir()
    where = write_parameter_files(folder, parts, vehicles=request.param)
    assert where == ("params" if request.param == 2 else PARTS)
    assert (folder / "params").exists() == (where == "params")
    write_run(folder, replace(RUN, buckets=BUCKETS))
    return folder


def test_the_parameter_file_of_a_vehicle_is_found_however_many_there_are(result: Path, tmp_path: Path) -> None:
    for name in ("v1", "v2"):
        (tmp_path / "p.json").write_bytes(parameters_of(result, name))
        assert read_parameters(tmp_path / "p.json").vehicle == name


@pytest.mark.parametrize("name", ["v3", "../params/v1", ""])
def test_a_vehicle_that_has_no_parameters_is_named(result: Path, name: str) -> None:
    with pytest.raises(FleetError, match=rf"no vehicle '{name}' in it; results\.parquet names all that are"):
        parameters_of(result, name)


def test_a_vehicle_that_was_left_out_is_told_with_its_reason(result: Path, tmp_path: Path) -> None:
    (tmp_path / "part").write_bytes(encode_chunk([], {"v3": "too short"}).rows)
    join_rows(result, [tmp_path / "part"], {})
    with pytest.raises(FleetError, match=r"no parameters of vehicle 'v3', it was left out: too short"):
        parameters_of(result, "v3")


def test_parameter_files_are_written_by_the_command(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["params", str(result), "v1", "v2", "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "out" / f"{name}.json") for name in ("v1", "v2")]
    assert read_parameters(tmp_path / "out" / "v2.json").branches["motor"].offset_a == 1.0
    assert run_command(["params", str(result), "v1", "v9", "--out", str(tmp_path / "none")]) == 1
    assert "no vehicle 'v9' in it" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
