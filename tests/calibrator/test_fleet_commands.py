"""The commands of the calibrator as a user types them, on one small artificial fleet."""

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from calibrator.estimator.results import read_results
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import check_fit, read_parameters
from tests.calibrator.command_here import calibrator, made_once

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve vehicles on a common trip with few faults: three groups of four."""
    options = ("--vehicles", 12, "--currents", 2, "--sparsity", 80, "--common-drive", "--symmetric", "--balanced")
    length = ("--minutes", 3, "--unseen-minutes", 1, "--seed", 3)
    return made_once(tmp_path_factory, "symmetric_fleet", "simulate", *options, *length)


@pytest.fixture(scope="session")
def result(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "symmetric_result", "calibrate", fleet)


def test_symmetric_fleet_is_recovered(fleet: Path, result: Path) -> None:
    run = calibrator("score", result, "--truth", fleet / "truth.json", "--json")
    figures = json.loads(run.stdout)
    assert figures["vehicles"] == 12
    assert figures["recovery_rate"] == figures["recovery_rate_25"] == figures["hardware_f2"] == 1.0
    assert figures["deployed_rate"] > 0.0
    corrected = [row for row in read_results(result) if row["verdict"] == "corrected"]
    assert len(corrected) >= 8
    assert all(row["junction_rms_corrected_a"] < 0.5 * row["junction_rms_measured_a"] for row in corrected)


def test_parameter_files_fit_their_vehicle_and_equal_the_results_table(result: Path) -> None:
    database, table = read_database(read_layout(LAYOUT)), pq.read_table(result / "results.parquet")
    assert table.num_rows == 24
    assert table.schema.field("offset_a").metadata == {b"unit": b"A"}
    for row in table.to_pylist():
        parameters = read_parameters(result / "params" / f"{row['vehicle']}.json")
        check_fit(parameters, database, row["vehicle"])
        branch = parameters.branches[row["branch"]]
        assert (branch.drift, branch.offset_a) == (row["drift"], row["offset_a"])


@pytest.mark.long
def test_nothing_is_learnt_from_a_held_out_vehicle(fleet: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(fleet / "logs", other)
    lines = calibrator_lines(fleet)
    (other / "V001" / "drive.log.gz").write_bytes(gzip.compress(b"".join(lines[: 3 * len(lines) // 4])))
    found = []
    for k, logs in enumerate((fleet / "logs", other)):
        out = tmp_path / f"result{k}"
        run = calibrator("calibrate", logs, "--layout", LAYOUT, "--out", out, "--hold-out", "V001", "--workers", 1)
        assert run.returncode == 0, run.stderr
        found.append({(row["vehicle"], row["branch"]): row for row in read_results(out)})
    assert found[0]["V001", "battery"] != found[1]["V001", "battery"]
    assert all(found[0][key] == found[1][key] for key in found[0] if key[0] != "V001")


@pytest.fixture
def broken_fleet(fleet: Path, tmp_path: Path) -> Path:
    """Six good vehicles, five with one fault each, and a copy of one."""
    copy = tmp_path / "broken"
    for folder in sorted((fleet / "logs").iterdir())[:6]:
        shutil.copytree(folder, copy / folder.name)
    lines = calibrator_lines(fleet)
    logs = {
        "short": b"".join(line for line in lines if float(line.split(b")")[0][1:]) < 3.0),
        "empty": b"",
        "no_branch": b"".join(line for line in lines if b" 200#" in line),
        "no_motor": b"".join(line for line in lines if b" 120#" not in line),
        "twin": b"",
    }
    for name, content in logs.items():
        (copy / name).mkdir()
        (copy / name / "drive.log").write_bytes(content)
    (copy / "blf").mkdir()
    (copy / "blf" / "drive.blf").write_bytes(b"LOGG" + bytes(300))
    shutil.copytree(copy / "V001", copy / "elsewhere" / "V001")
    shutil.copytree(copy / "V002", copy / "other")
    (copy / "comma").mkdir()
    shutil.copy(copy / "V002" / "drive.log.gz", copy / "comma" / "my,drive.log.gz")
    return copy


def calibrator_lines(fleet: Path) -> list[bytes]:
    return gzip.decompress((fleet / "logs" / "V001" / "drive.log.gz").read_bytes()).splitlines(keepends=True)


def test_unusable_vehicles_are_left_out_and_named(broken_fleet: Path, tmp_path: Path) -> None:
    out = tmp_path / "result"
    run = calibrator("calibrate", broken_fleet, "--layout", LAYOUT, "--out", out, "--json", "--workers", 1)
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr
    left_out = json.loads(run.stdout)["run"]["left_out"]
    for vehicle, reason in {
        "short": "at least 120 s are needed",
        "empty": "drive.log: the log is empty",
        "no_branch": "expected HV_Battery (0x110)",
        "no_motor": "no branch motor; it has battery",
        "blf": "drive.blf: truncated or damaged BLF",
        "other": "same recording as V002; it cannot be told whose it is",
        "V002": "same recording as other; it cannot be told whose it is",
    }.items():
        assert reason in left_out[vehicle]
    assert any("V001" in reason and "elsewhere" in reason for reason in left_out.values()), left_out
    assert any("my,drive" in reason for reason in left_out.values()), left_out
    assert sorted(path.stem for path in (out / "params").iterdir()) == ["V003", "V004", "V005", "V006"]
    assert {row["vehicle"] for row in read_results(out) if row["branch"] is None} == set(left_out)


def test_option_since_recalibrates_a_single_vehicle_with_new_drives(fleet: Path, tmp_path: Path) -> None:
    layout, store, one = ("--layout", LAYOUT), tmp_path / "store", ("--workers", 1)
    assert calibrator("summarise", fleet / "logs", *layout, "--out", store, *one).returncode == 0
    first = calibrator("calibrate", store, *layout, "--out", tmp_path / "first", *one)
    assert first.returncode == 0, first.stderr
    new = sorted((fleet / "unseen").iterdir())[0]
    shutil.copytree(new, tmp_path / "new" / new.name)
    second = ("--out", tmp_path / "second", "--since", tmp_path / "first", *one)
    run = calibrator("calibrate", tmp_path / "new", *layout, *second)
    assert run.returncode == 1
    assert "drives, and --since goes on with summaries; add the new drives to the store" in run.stderr
    assert calibrator("summarise", tmp_path / "new", *layout, "--out", store, *one).returncode == 0
    run = calibrator("calibrate", store, *layout, *second)
    assert run.returncode == 0, run.stderr
    assert {row["vehicle"] for row in read_results(tmp_path / "second")} == {
        row["vehicle"] for row in read_results(tmp_path / "first")
    }


def test_single_vehicle_or_copies_of_one_are_not_a_fleet(fleet: Path, tmp_path: Path) -> None:
    files = ["--layout", LAYOUT, "--out", tmp_path / "x", "--workers", 1]
    shutil.copytree(fleet / "logs" / "V001", tmp_path / "logs" / "one")
    run = calibrator("calibrate", tmp_path / "logs", "--method", "published", *files)
    assert run.returncode == 1
    (line,) = [line for line in run.stderr.splitlines() if line.startswith("calibrator:")]
    assert "1 usable vehicle to learn from; a fleet that is compared with itself needs 5 or more" in line
    assert not (tmp_path / "x").exists()
    shutil.copytree(fleet / "logs" / "V001", tmp_path / "logs" / "other")
    run = calibrator("calibrate", tmp_path / "logs", *files, "--trusted", "other")
    assert run.returncode == 1
    assert "vehicle other to trust; other: same recording as one; it cannot be told whose it is" in run.stderr


@pytest.mark.parametrize(("key", "change", "message"), [
    ("vehicles", lambda found: {f"X{name}": each for name, each in found.items()}, "truth of another fleet"),
    ("branches", lambda _: ["battery", "dcdc"], "with branches battery, motor, the truth of layout hv_powertrain"),
])  # fmt: skip
def test_score_refuses_the_truth_of_other_vehicles_or_branches(
    fleet: Path, result: Path, tmp_path: Path, key: str, change: Callable[[Any], Any], message: str
) -> None:
    truth = json.loads((fleet / "truth.json").read_text())
    (tmp_path / "truth.json").write_text(json.dumps({**truth, key: change(truth[key])}))
    run = calibrator("score", result, "--truth", tmp_path / "truth.json")
    assert (run.returncode, message in run.stderr) == (1, True), run.stderr
