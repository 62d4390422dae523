"""The default method as a user types it: a fleet with delays and a load that no sensor measures."""

import json
from pathlib import Path

import pytest

from calibrator.estimator.results import read_results, read_run
from calibrator.fleet_truth import read_truth
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import VehicleParameters, check_fit, read_parameters
from tests.calibrator.command_here import calibrator, made_once

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
DELAY_TOLERANCE_S = 0.005


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = ("--vehicles", 12, "--currents", 2, "--sparsity", 80, "--delay", 150, "--unmeasured", 3, 1)
    length = ("--minutes", 3, "--unseen-minutes", 0.1, "--seed", 5)
    return made_once(tmp_path_factory, "asymmetric_fleet", "simulate", *options, *length)


@pytest.fixture(scope="session")
def summaries(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "asymmetric_summaries", "summarise", fleet)


@pytest.fixture(scope="session")
def result(summaries: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "asymmetric_result", "calibrate", summaries)


@pytest.fixture(scope="module")
def parameters(result: Path) -> list[VehicleParameters]:
    return [read_parameters(path) for path in sorted((result / "params").iterdir())]


def test_asymmetric_fleet_with_delays_and_load_is_recovered_without_harm(fleet: Path, result: Path) -> None:
    run = calibrator("score", result, "--truth", fleet / "truth.json", "--json")
    figures = json.loads(run.stdout)
    assert figures["recovery_rate"] >= 0.9
    assert figures["harmed_rate"] == 0.0


def test_delay_of_the_motor_is_in_the_parameter_file(fleet: Path, parameters: list[VehicleParameters]) -> None:
    truth = read_truth(fleet / "truth.json").vehicles
    for item in parameters:
        delays = {name: branch.delay_s for name, branch in item.branches.items()}
        assert all(delay is not None for delay in delays.values())
        found = (delays["motor"] or 0.0) - (delays["battery"] or 0.0)
        actual = truth[item.vehicle].delay_s["motor"] - truth[item.vehicle].delay_s["battery"]
        assert abs(found - actual) < DELAY_TOLERANCE_S


def test_parameter_files_apply_only_corrections_below_the_harm_limit(parameters: list[VehicleParameters]) -> None:
    database = read_database(read_layout(LAYOUT))
    for item in parameters:
        check_fit(item, database, item.vehicle)
        for branch in item.branches.values():
            assert branch.harm_probability is not None
            assert not branch.apply or branch.harm_probability < 0.001


def test_unmeasured_load_is_estimated_from_the_fleet_and_reported(fleet: Path, result: Path) -> None:
    run = read_run(result)
    truth = [vehicle.unmeasured_a for vehicle in read_truth(fleet / "truth.json").vehicles.values()]
    assert run.details["reference"]["unmeasured_a"] == pytest.approx(sum(truth) / len(truth), abs=1.0)
    assert any("load without a sensor" in notice for notice in run.notices)


@pytest.fixture(scope="session")
def strict(summaries: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Result with a harm limit of zero: nothing is corrected, and faulty vehicles stay undecided."""
    return made_once(tmp_path_factory, "strict_result", "calibrate", summaries, "--harm-limit", 0)


def test_harm_limit_of_zero_corrects_nothing_and_reasons_are_given(result: Path, strict: Path) -> None:
    chosen, rows, usual = read_run(strict).settings, read_results(strict), read_results(result)
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


def test_mistake_in_bench_readings_is_reported_before_drives_are_read(fleet: Path, tmp_path: Path) -> None:
    table, out = tmp_path / "bench.csv", tmp_path / "result"
    table.write_text("vehicle,branch,offset_a,offset_sd_a\nV001,battery,1 A,0.02\n")
    run = calibrator("calibrate", fleet, "--layout", LAYOUT, "--out", out, "--readings", table)
    assert run.returncode == 1
    assert "bench.csv: line 2: offset_a is '1 A'; expected a number" in run.stderr
    assert not out.exists()
