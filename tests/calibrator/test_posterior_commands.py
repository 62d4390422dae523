"""The default method as a user types it: a fleet with delays and a load that no sensor measures."""

import json
from pathlib import Path

import pytest

from calibrator.estimator.results import read_results, read_run
from calibrator.fleet_truth import read_truth
from ecu_node.database import read_database
from ecu_node.layout import file_digest, read_layout
from ecu_node.parameters import VehicleParameters, check_fit, read_parameters
from tests.calibrator.command_here import calibrator, made_once

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
DELAY_TOLERANCE_S = 0.005


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = ("--vehicles", 20, "--currents", 2, "--sparsity", 80, "--delay", 150, "--unmeasured", 3, 1)
    length = ("--minutes", 5, "--unseen-minutes", 0.1, "--seed", 5)
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


def test_asymmetric_fleet_with_delays_and_an_unmeasured_load_is_recovered_and_nobody_is_harmed(
    fleet: Path, result: Path
) -> None:
    run = calibrator("score", result, "--truth", fleet / "truth.json", "--json")
    figures = json.loads(run.stdout)
    assert figures["recovery_rate"] >= 0.9
    assert figures["harmed_rate"] == 0.0


def test_delay_of_the_motor_is_found_and_stands_in_the_parameter_file(
    fleet: Path, parameters: list[VehicleParameters]
) -> None:
    truth = read_truth(fleet / "truth.json").vehicles
    for item in parameters:
        delays = {name: branch.delay_s for name, branch in item.branches.items()}
        assert all(delay is not None for delay in delays.values())
        found = (delays["motor"] or 0.0) - (delays["battery"] or 0.0)
        actual = truth[item.vehicle].delay_s["motor"] - truth[item.vehicle].delay_s["battery"]
        assert abs(found - actual) < DELAY_TOLERANCE_S


def test_every_file_fits_its_vehicle_and_applies_only_what_hardly_harms(parameters: list[VehicleParameters]) -> None:
    database = read_database(read_layout(LAYOUT))
    for item in parameters:
        check_fit(item, database, item.vehicle)
        for branch in item.branches.values():
            assert branch.harm_probability is not None
            assert not branch.apply or branch.harm_probability < 0.001


def test_unmeasured_load_is_estimated_from_the_fleet_and_named(fleet: Path, result: Path) -> None:
    run = read_run(result)
    truth = [vehicle.unmeasured_a for vehicle in read_truth(fleet / "truth.json").vehicles.values()]
    assert run.details["reference"]["unmeasured_a"] == pytest.approx(sum(truth) / len(truth), abs=1.0)
    assert any("load without a sensor" in notice for notice in run.notices)


@pytest.fixture(scope="session")
def strict(summaries: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nothing may do harm, so nothing is corrected and faulty vehicles stay undecided."""
    return made_once(tmp_path_factory, "strict_result", "calibrate", summaries, "--harm-limit", 0)


def test_a_stricter_harm_limit_corrects_no_more_branches(result: Path, strict: Path) -> None:
    assert not any(row["applied"] for row in read_results(strict))
    assert any(row["applied"] for row in read_results(result))


def test_what_was_chosen_and_why_faults_are_held_back_is_told_of_each_branch(result: Path, strict: Path) -> None:
    chosen = read_run(strict).settings
    assert (chosen["harm_limit"], chosen["trusted"], chosen["hold_out"]) == (0.0, [], [])
    rows = read_results(strict)
    found = [row for row in rows if row["drift"] or row["offset_a"]]
    assert {row["held_back"] for row in found} == {"harm limit"}
    assert all(row["held_back"] is None for row in rows if row not in found)
    assert not any(row["held_back"] for row in read_results(result) if row["applied"])
    for row in rows:
        assert 0.0 <= row["fault_probability"] <= 1.0
        assert row["drift_sd"] >= 0.0
        assert row["offset_sd_a"] >= 0.0


def test_a_vehicle_of_which_nothing_can_be_told_names_its_explanations(strict: Path) -> None:
    parameters = [read_parameters(path) for path in sorted((strict / "params").iterdir())]
    untold = [item for item in parameters if item.verdict == "cannot tell"]
    assert untold
    for item in untold:
        assert item.explanations
        assert item.deciding_evidence
        assert not any(branch.apply for branch in item.branches.values())


@pytest.mark.long
def test_trusted_vehicles_are_taken_for_faultless(fleet: Path, tmp_path: Path) -> None:
    truth = read_truth(fleet / "truth.json").vehicles
    sound = [name for name, vehicle in truth.items() if not any([*vehicle.drift.values(), *vehicle.offset_a.values()])]
    assert len(sound) >= 3
    trusted = ["--trusted", ",".join(sound[:2]), *(part for name in sound[2:] for part in ("--trusted", name))]
    run = calibrator("calibrate", fleet, "--layout", LAYOUT, "--out", tmp_path / "result", *trusted)
    assert run.returncode == 0, run.stderr
    rows = [row for row in read_results(tmp_path / "result") if row["vehicle"] in sound]
    assert len(rows) == 2 * len(sound)
    assert all(row["drift"] == 0.0 and row["offset_a"] == 0.0 for row in rows)


@pytest.mark.long
def test_a_bench_reading_of_a_sensor_is_heeded_and_recorded(fleet: Path, tmp_path: Path) -> None:
    vehicle, truth = next(
        (name, vehicle)
        for name, vehicle in read_truth(fleet / "truth.json").vehicles.items()
        if any(vehicle.offset_a.values())
    )
    table = tmp_path / "bench.csv"
    cells = "".join(f"{vehicle},{name},{truth.offset_a[name]},0.02\n" for name in ("battery", "motor"))
    table.write_text(f"vehicle,branch,offset_a,offset_sd_a\n{cells}")
    out = tmp_path / "result"
    run = calibrator("calibrate", fleet, "--layout", LAYOUT, "--out", out, "--readings", table)
    assert run.returncode == 0, run.stderr
    assert read_run(out).settings["readings"] == ["bench.csv", file_digest(table)]
    after = {row["branch"]: row for row in read_results(out) if row["vehicle"] == vehicle}
    for name in ("battery", "motor"):
        assert after[name]["offset_a"] == pytest.approx(truth.offset_a[name], abs=0.1)
        assert after[name]["offset_sd_a"] <= 0.03


def test_a_slip_in_the_bench_readings_ends_the_run_before_any_drive_is_read(fleet: Path, tmp_path: Path) -> None:
    table = tmp_path / "bench.csv"
    table.write_text("vehicle,branch,offset_a,offset_sd_a\nV001,battery,1 A,0.02\n")
    out = tmp_path / "result"
    run = calibrator("calibrate", fleet, "--layout", LAYOUT, "--out", out, "--readings", table)
    assert run.returncode == 1
    assert "bench.csv: line 2: offset_a is '1 A'; expected a number" in run.stderr
    assert not out.exists()


def test_a_vehicle_cannot_be_trusted_and_held_out(fleet: Path, tmp_path: Path) -> None:
    both = ("--trusted", "V001", "--hold-out", "V001")
    run = calibrator("calibrate", fleet, "--layout", LAYOUT, "--out", tmp_path / "result", *both)
    assert run.returncode == 2
    assert "vehicle V001 is both held out and trusted" in run.stderr


def test_a_vehicle_that_is_not_there_cannot_be_trusted(fleet: Path, tmp_path: Path) -> None:
    run = calibrator("calibrate", fleet, "--layout", LAYOUT, "--out", tmp_path / "result", "--trusted", "V999")
    assert run.returncode == 1
    assert "no usable vehicle V999 to trust" in run.stderr
    assert not (tmp_path / "result").exists()
