"""The commands of the calibrator as a user types them, on two small artificial fleets."""

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from calibrator.estimator.results import read_results, read_run
from calibrator.fleet_truth import read_truth
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters, check_fit, read_parameters
from tests.calibrator.command_here import calibrator, made_once, refused, reported, succeeded
from tests.calibrator.conftest import LAYOUT


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
    figures = reported("score", result, "--truth", fleet / "truth.json")
    assert figures["vehicles"] == 12
    assert figures["recovery_rate"] == figures["recovery_rate_25"] == figures["hardware_f2"] == 1.0
    assert figures["deployed_rate"] > 0.0
    corrected = [row for row in read_results(result) if row["verdict"] == "corrected"]
    assert len(corrected) >= 8
    assert all(row["junction_rms_corrected_a"] < 0.5 * row["junction_rms_measured_a"] for row in corrected)


def test_parameter_files_fit_their_vehicle_and_equal_the_results_table(result: Path, database: VehicleDatabase) -> None:
    table = pq.read_table(result / "results.parquet")
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
        succeeded("calibrate", logs, "--layout", LAYOUT, "--out", out, "--hold-out", "V001", "--workers", 1)
        found.append({(row["vehicle"], row["branch"]): row for row in read_results(out)})
    assert found[0]["V001", "battery"] != found[1]["V001", "battery"]
    assert all(found[0][key] == found[1][key] for key in found[0] if key[0] != "V001")


@pytest.fixture
def broken_fleet(fleet: Path, tmp_path: Path) -> Path:
    """Six good vehicles, copies of two of them, and vehicles whose logs have one flaw each."""
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
    (copy / "V003" / "empty.log").touch()  # costs the vehicle this log alone
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
    report = reported("calibrate", broken_fleet, "--layout", LAYOUT, "--out", out, "--workers", 1)
    left_out = report["run"]["left_out"]
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
    (notice,) = (text for text in report["run"]["notices"] if "left out" in text)
    assert "V003/empty: " in notice
    assert any("my,drive" in reason for reason in left_out.values()), left_out
    assert sorted(path.stem for path in (out / "params").iterdir()) == ["V003", "V004", "V005", "V006"]
    assert {row["vehicle"] for row in read_results(out) if row["branch"] is None} == set(left_out)


def test_option_since_is_refused_for_drives_as_it_needs_summaries(fleet: Path, result: Path, tmp_path: Path) -> None:
    line = ("calibrate", fleet, "--layout", LAYOUT, "--out", tmp_path / "x", "--since", result)
    assert "drives, and --since goes on with summaries; add the new drives to the store" in refused(*line)


def test_single_vehicle_or_copies_of_one_are_refused_as_a_fleet(fleet: Path, tmp_path: Path) -> None:
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
    assert message in refused("score", result, "--truth", tmp_path / "truth.json")


# A fleet with delays, and a load that no sensor measures


@pytest.fixture(scope="session")
def delayed_fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = ("--vehicles", 12, "--currents", 2, "--sparsity", 80, "--delay", 150, "--unmeasured", 3, 1)
    length = ("--minutes", 3, "--unseen-minutes", 0.1, "--seed", 5)
    return made_once(tmp_path_factory, "asymmetric_fleet", "simulate", *options, *length)


@pytest.fixture(scope="session")
def summaries(delayed_fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "asymmetric_summaries", "summarise", delayed_fleet)


@pytest.fixture(scope="session")
def delayed_result(summaries: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "asymmetric_result", "calibrate", summaries)


@pytest.fixture(scope="module")
def parameters(delayed_result: Path) -> list[VehicleParameters]:
    return [read_parameters(path) for path in sorted((delayed_result / "params").iterdir())]


def test_asymmetric_fleet_with_delays_and_load_is_recovered_without_harm(
    delayed_fleet: Path, delayed_result: Path
) -> None:
    figures = reported("score", delayed_result, "--truth", delayed_fleet / "truth.json")
    assert figures["recovery_rate"] >= 0.9
    assert figures["harmed_rate"] == 0.0


def test_delay_of_the_motor_is_stated_within_5_ms(delayed_fleet: Path, parameters: list[VehicleParameters]) -> None:
    truth = read_truth(delayed_fleet / "truth.json").vehicles
    for item in parameters:
        delays = {name: branch.delay_s for name, branch in item.branches.items()}
        assert all(delay is not None for delay in delays.values())
        found = (delays["motor"] or 0.0) - (delays["battery"] or 0.0)
        actual = truth[item.vehicle].delay_s["motor"] - truth[item.vehicle].delay_s["battery"]
        assert abs(found - actual) < 0.005


def test_unmeasured_load_is_estimated_from_the_fleet_and_reported(delayed_fleet: Path, delayed_result: Path) -> None:
    run = read_run(delayed_result)
    truth = [vehicle.unmeasured_a for vehicle in read_truth(delayed_fleet / "truth.json").vehicles.values()]
    assert run.details["reference"]["unmeasured_a"] == pytest.approx(sum(truth) / len(truth), abs=1.0)
    assert any("load without a sensor" in notice for notice in run.notices)


@pytest.fixture(scope="session")
def strict(summaries: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Result with a harm limit of zero: nothing is corrected, and faulty vehicles stay undecided."""
    return made_once(tmp_path_factory, "strict_result", "calibrate", summaries, "--harm-limit", 0)


def test_harm_limit_of_zero_corrects_nothing_and_reasons_are_given(delayed_result: Path, strict: Path) -> None:
    chosen, rows, usual = read_run(strict).settings, read_results(strict), read_results(delayed_result)
    assert (chosen["harm_limit"], chosen["trusted"], chosen["hold_out"]) == (0.0, [], [])
    assert not any(row["applied"] for row in rows)
    assert {row["held_back"] for row in usual if row["applied"]} == {None}
    for row in rows:
        assert row["held_back"] == ("harm limit" if row["drift"] or row["offset_a"] else None)
        assert 0.0 <= row["fault_probability"] <= 1.0
        assert min(row["drift_sd"], row["offset_sd_a"]) >= 0.0
    parameters = [read_parameters(path) for path in sorted((strict / "params").iterdir())]
    unknown = [item for item in parameters if item.verdict == "cannot tell"]
    assert unknown
    assert all(item.explanations and item.deciding_evidence for item in unknown)
