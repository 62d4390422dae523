"""The table of promises: judged from records as the steps leave them; a figure that is missing is a row not met."""

import json
from pathlib import Path

import pytest

from acceptance.estimation import estimation_promises
from acceptance.row import MissingFigureError, at_least, at_most
from acceptance.speed import million_promises, speed_promises
from acceptance.tried import chain_promises, coverage_promises, fuzz_promises, promises_of_tests

RECORDED = Path(__file__).parents[2] / "docs" / "results"


def test_a_bar_that_is_just_reached_is_met_and_one_that_is_missed_is_not() -> None:
    assert at_least("rate", (0.9, 0.5), (0.9, 0.6)).met
    assert not at_least("rate", (0.9, 0.5), (0.95, 0.49)).met
    promise = at_most("time", (3.0,), (3.01,), unit="s")
    assert (promise.met, promise.bar, promise.figure) == (False, "at most 3 s", "3.01 s")


def test_records_of_the_experiments_are_judged() -> None:
    found = {promise.what: promise for promise in estimation_promises(RECORDED)}
    promise = found["paper's set-up, published method, S = 60: tree / perfect classifier"]
    row = json.loads((RECORDED / "classifier.json").read_text())["rows"][1]
    assert promise.figure.startswith(f"{row['figures']['recovery_rate']['mean']:.4g} / ")
    assert promise.met
    assert len([name for name in found if name.startswith("honesty")]) == 11


def test_a_record_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFigureError, match=r"classifier\.json: not there"):
        list(estimation_promises(tmp_path))


def test_printed_figures_are_judged(tmp_path: Path) -> None:
    frames, files, million = (tmp_path / name for name in ("frames.txt", "files.txt", "million.txt"))
    frames.write_text("5000000 frames right in both modes, 3000 frames/s\n")
    files.write_text("999999 changed files refused, each in one line, 3000 files/s\n")
    million.write_text("1000000 vehicles: 840 s, 2048 MiB\n")
    assert [promise.met for promise in fuzz_promises([frames, frames], files)] == [True, False]
    assert [promise.figure for promise in million_promises(million)] == ["14 min", "2 GiB"]
    million.write_text("killed\n")
    with pytest.raises(MissingFigureError, match="no figure of 1000000 vehicles"):
        list(million_promises(million))


def test_rows_of_benchmarks_are_judged_wherever_they_stand(tmp_path: Path) -> None:
    measured = {"times": ("identify a vehicle", (1200, 29)), "errors": ("slope error at SNR 20", (2, 3))}
    for name, (what, ratios) in measured.items():
        peers = zip(("nfoursid 1", "sippy 1"), ratios, strict=True)
        rows = [{"name": what, "value": 1.0, "unit": "", "peer": peer, "ratio": ratio} for peer, ratio in peers]
        (tmp_path / name).write_text(json.dumps(rows))
    judged = speed_promises(tmp_path / "times", tmp_path / "errors")
    assert [next(judged).met, next(judged).met] == [False, True]
    with pytest.raises(MissingFigureError, match="0 rows of identify a vehicle, nfoursid; one is expected"):
        next(speed_promises(tmp_path / "errors"))


def test_coverage_is_judged_by_lines_and_branches_of_each_package(tmp_path: Path) -> None:
    path = tmp_path / "coverage.json"
    names = ("covered_lines", "num_statements", "covered_branches", "num_branches")
    counts = {"ecu_node/a.py": (10, 10, 3, 4), "calibrator/a.py": (40, 40, 0, 0), "calibrator/b.py": (55, 58, 0, 2)}
    files = {name: {"summary": dict(zip(names, each, strict=True))} for name, each in counts.items()}
    path.write_text(json.dumps({"files": files}))
    found = list(coverage_promises(path))
    assert [promise.figure for promise in found] == ["92.86 %", "95 %"]
    assert [promise.met for promise in found] == [False, True]
    path.write_text(json.dumps({"files": {"calibrator/a.py": files["calibrator/a.py"]}}))
    with pytest.raises(MissingFigureError, match="nothing of ecu_node"):
        list(coverage_promises(path))


def test_the_chain_is_judged_by_vehicles_made_worse_and_sets_in_force(tmp_path: Path) -> None:
    counts = {"vehicles": 500, "with_corrections": 400, "deployed": 359, "made_worse": 1}
    path = tmp_path / "chain.json"
    path.write_text(json.dumps(counts))
    assert [promise.met for promise in chain_promises(path)] == [False, False]
    path.write_text(json.dumps({**counts, "deployed": 360, "made_worse": 0}))
    assert [promise.met for promise in chain_promises(path)] == [True, True]


@pytest.mark.parametrize(("inside", "met"), [("", True), ("<failure/>", False), ("<skipped/>", False)])
def test_a_promise_is_met_if_all_its_tests_passed(inside: str, met: bool, tmp_path: Path) -> None:
    names = (
        *("vcan.test_a", "vcan.test_faults_on_vcan", "real.test_tesla_model3", "real.test_i3_import"),
        *("real.test_delays_i3", "real.test_first_minutes", "test_user_mistakes"),
        *("calibrator.test_fleet_commands", "ecu_node.test_fault_table", "update.test_a", "calibrator.export.test_a"),
        *("calibrator.report.test_a", "browser.test_a", "docs.test_a", "tools.test_architecture"),
    )
    cases = "".join(f'<testcase classname="tests.{name}" name="test_x"/>' for name in names)
    report = tmp_path / "tests.xml"
    report.write_text(f'<r>{cases}<testcase classname="tests.update.test_b" name="test_y">{inside}</testcase></r>')
    found = {promise.what: promise.met for promise in promises_of_tests(report)}
    assert found["all tests"] is met
    assert found["parameter files that were tampered with, expired, replayed, of others: refused"] is met
    assert found["documents: links, references, words"]
    report.write_text("<r/>")
    with pytest.raises(MissingFigureError, match="no test of vcan ran"):
        list(promises_of_tests(report))
