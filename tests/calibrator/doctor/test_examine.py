"""Known truth: what was put into a log or a layout is found, of the right branch, and nothing else."""

import re
from pathlib import Path

import numpy as np
import pytest

from calibrator.doctor.findings import Severity
from ecu_node.database import VehicleDatabase
from tests.calibrator.doctor.artificial_logs import (
    examined,
    findings,
    true_drive,
    with_branch,
    write_layout,
    write_log,
)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, database: VehicleDatabase) -> Path:
    return write_log(tmp_path_factory.mktemp("log"), true_drive(), database)


def test_a_sound_log_has_no_error_and_is_ready_for_all(log: Path, tmp_path: Path) -> None:
    found = examined(write_layout(tmp_path), log)
    assert not found.has_errors
    assert findings(found, "sign", "unit", "delay", "sum", "stuck", "clipped", "gap", "gain") == []
    assert found.steps.ready == ("kirchhoff", "import", "calibrate", "ecu-node", "ecu-node --gateway")
    assert found.steps.not_ready == {}
    (mean,) = findings(found, "mean")
    assert mean.figures["mean_a"] == pytest.approx(2.5, abs=0.1)
    facts = {item.name: item for item in found.branches}
    assert facts["battery"].frames == 6000
    assert 1.0 / facts["auxiliary"].period_s == pytest.approx(20.0, rel=1e-3)
    assert [finding.subject for finding in findings(found, "not in log") if "Rear" in finding.text] == ["motor_rear"]


@pytest.mark.parametrize(("declared_a", "told"), [(2.5, False), (1.5, False), (0.5, True)])
def test_a_declared_load_is_not_told_again(declared_a: float, told: bool, log: Path, tmp_path: Path) -> None:
    layout = write_layout(tmp_path)
    with layout.open("a") as file:
        file.write(f"\n[unmeasured_load]\nmean_a = {declared_a}\nsd_a = 0.5\n")
    found = findings(examined(layout, log), "mean")
    assert bool(found) is told
    assert all("(0.5 A are declared as a load)" in finding.text for finding in found)
    assert all("look at the load declared in [unmeasured_load]" in finding.remedy for finding in found)


@pytest.mark.parametrize("branch", ["battery", "motor", "auxiliary"])
def test_an_inverted_sign_is_found_of_the_right_branch(branch: str, log: Path, tmp_path: Path) -> None:
    found = examined(write_layout(tmp_path, inverted=(branch,)), log)
    (error,) = [finding for finding in found.findings if finding.severity is Severity.ERROR]
    assert (error.kind, error.subject) == ("sign", branch)
    assert error.figures["rms_before_a"] > 4.0 * error.figures["rms_after_a"]
    assert re.search(rf'set sign = -?1 in the \[\[branch\]\] "{branch}"', error.remedy)
    assert found.steps.ready == ("kirchhoff",)


def test_all_signs_inverted_are_told_by_the_voltage(log: Path, tmp_path: Path) -> None:
    found = examined(write_layout(tmp_path, inverted=("battery", "motor", "auxiliary", "dcdc", "motor_rear")), log)
    (error,) = [finding for finding in found.findings if finding.severity is Severity.ERROR]
    assert (error.kind, error.subject) == ("sign", "all branches")


@pytest.mark.parametrize(
    ("branch", "signal", "unit", "factor"),
    [
        ("battery", "BatteryCurrent", "mA", 1000.0),
        ("motor", "MotorCurrent", "kA", 0.001),
        ("auxiliary", "AuxiliaryCurrent", "mA", 1000.0),
        ("auxiliary", "AuxiliaryCurrent", "kA", 0.001),
    ],
)
def test_a_slip_of_a_unit_is_found_with_its_factor(
    branch: str, signal: str, unit: str, factor: float, log: Path, tmp_path: Path
) -> None:
    found = examined(write_layout(tmp_path, units={signal: unit}), log)
    errors = [finding for finding in found.findings if finding.severity is Severity.ERROR]
    assert [(error.kind, error.subject, error.figures["factor"]) for error in errors] == [("unit", branch, factor)]


def test_a_sign_and_a_unit_are_found_together(log: Path, tmp_path: Path) -> None:
    found = examined(write_layout(tmp_path, inverted=("battery",), units={"AuxiliaryCurrent": "kA"}), log)
    errors = {(finding.kind, finding.subject) for finding in found.findings if finding.severity is Severity.ERROR}
    assert errors == {("sign", "battery"), ("unit", "auxiliary")}


@pytest.mark.parametrize("delay_s", [0.06, 0.2, -0.3])
def test_a_delay_is_found_and_is_no_error(delay_s: float, tmp_path: Path, database: VehicleDatabase) -> None:
    late = {"motor": 0.4 + delay_s, "battery": 0.4, "auxiliary": 0.4, "dcdc": 0.4}
    log = write_log(tmp_path, true_drive(delay_s=late), database)
    found = examined(write_layout(tmp_path), log)
    (delay,) = findings(found, "delay")
    assert delay.subject == "motor"
    assert delay.figures["delay_s"] == pytest.approx(delay_s, abs=0.005)
    assert delay.severity is (Severity.WARNING if abs(delay_s) >= 0.1 else Severity.HINT)
    assert not found.has_errors


def test_a_gain_below_a_slip_of_units_is_told_in_percent(tmp_path: Path, database: VehicleDatabase) -> None:
    drive = true_drive()
    log = write_log(tmp_path, with_branch(drive, "motor", 1.08 * drive.branches["motor"].value), database)
    found = examined(write_layout(tmp_path), log)
    assert not found.has_errors
    (gain,) = findings(found, "gain")
    assert gain.subject in {"motor", "battery"}
    assert abs(gain.figures["percent"]) == pytest.approx(8.0, abs=1.0)


def test_a_branch_too_small_to_tell_is_said_to_be_so(log: Path, tmp_path: Path) -> None:
    """The converter's current changes too slowly to be seen in the sum: an inverted sign must not be guessed."""
    found = examined(write_layout(tmp_path, inverted=("dcdc",)), log)
    assert not found.has_errors
    assert [finding.subject for finding in findings(found, "cannot tell")] == ["dcdc"]


def test_a_stuck_branch_and_a_clipped_one_are_found(tmp_path: Path, database: VehicleDatabase) -> None:
    drive = true_drive()
    motor = drive.branches["motor"].value.copy()
    motor[1000:2500] = -37.0
    log = write_log(tmp_path, with_branch(drive, "motor", motor), database)
    (stuck,) = findings(examined(write_layout(tmp_path), log), "stuck")
    assert stuck.subject == "motor"
    assert stuck.figures["value_a"] == pytest.approx(-37.0)
    assert stuck.figures["duration_s"] == pytest.approx(30.0, abs=0.3)
    log = write_log(tmp_path, with_branch(drive, "battery", 12.0 * drive.branches["battery"].value), database)
    (clipped,) = findings(examined(write_layout(tmp_path), log), "clipped")
    assert clipped.subject == "battery"


def test_a_constant_branch_and_one_that_has_no_values_are_told(tmp_path: Path, database: VehicleDatabase) -> None:
    drive = true_drive()
    auxiliary, dcdc = np.full(2400, -5.0), np.full(1200, np.nan)
    drive = with_branch(with_branch(drive, "auxiliary", auxiliary), "dcdc", dcdc)
    found = examined(write_layout(tmp_path), write_log(tmp_path, drive, database))
    assert [finding.subject for finding in findings(found, "constant")] == ["auxiliary"]
    (bad,) = [finding for finding in findings(found, "bad frames") if finding.severity is Severity.ERROR]
    assert (bad.subject, bad.severity, bad.figures["share"]) == ("dcdc", Severity.ERROR, 1.0)
    assert "not available 1200" in bad.text


def test_gaps_rates_and_failed_checks_are_counted(log: Path, tmp_path: Path) -> None:
    lines = log.read_text().splitlines(keepends=True)
    kept = [line for line in lines if not ("can0 110#" in line and 40.0 < float(line[1:].partition(")")[0]) < 45.0)]
    spoilt = [line.replace("can0 120#", "can0 120#FF", 1)[: len(line) - 1] + "\n" for line in kept[:3000]]
    for k, line in enumerate(spoilt):
        if "can0 120#" in line:
            spoilt[k] = line.rstrip("\n")[:33].ljust(33, "0") + "\n"
    (tmp_path / "drive.log").write_text("".join([*spoilt, *kept[3000:]]))
    found = examined(write_layout(tmp_path), tmp_path / "drive.log")
    (gap,) = [finding for finding in findings(found, "gap") if finding.subject == "battery"]
    assert gap.figures["longest_s"] == pytest.approx(5.0, abs=0.05)
    (bad,) = [finding for finding in findings(found, "bad frames") if finding.subject == "motor"]
    assert "E2E check failed" in bad.text


def test_a_time_out_shorter_than_the_period_is_an_error(log: Path, tmp_path: Path) -> None:
    layout = write_layout(tmp_path)
    layout.write_text(layout.read_text().replace("timeout_s = 0.25", "timeout_s = 0.03"))
    found = examined(layout, log)
    assert [(item.subject, item.severity) for item in findings(found, "rate")] == [("auxiliary", Severity.ERROR)]
    assert "kirchhoff" in found.steps.not_ready


def test_a_full_scale_that_is_exceeded_or_never_approached_is_told(log: Path, tmp_path: Path) -> None:
    assert {
        item.subject for item in findings(examined(write_layout(tmp_path, full_scale_a=50.0), log), "full scale")
    } == {
        "battery",
        "motor",
    }
    (far,) = findings(examined(write_layout(tmp_path, full_scale_a=20000.0), log), "full scale")
    assert far.subject == "all branches"


def test_signals_that_the_dbc_lacks_are_findings_and_the_rest_is_examined(log: Path, tmp_path: Path) -> None:
    layout = write_layout(tmp_path)
    text = layout.read_text().replace("HV_Dcdc.DcdcCurrent", "HV_Dcdc.Nothing").replace("TM_Demand.Heater", "TM_X.H")
    layout.write_text(text)
    found = examined(layout, log)
    assert {(item.subject, item.severity) for item in findings(found, "not in DBC")} == {
        ("dcdc", Severity.ERROR),
        ("heater_demand", Severity.WARNING),
    }
    assert [item.name for item in found.branches if item.good] == ["battery", "motor", "auxiliary"]


def test_a_log_of_another_vehicle_is_an_error_that_names_what_it_has(tmp_path: Path) -> None:
    (tmp_path / "other.log").write_text("(1.000000) can0 7FF#00\n(1.100000) can0 7FF#01\n")
    found = examined(write_layout(tmp_path), tmp_path / "other.log")
    (error,) = findings(found, "no branch")
    assert error.severity is Severity.ERROR
    assert "0x7FF" in error.text
    assert found.steps.ready == ()


def test_one_branch_alone_is_no_sum(tmp_path: Path, database: VehicleDatabase) -> None:
    drive = true_drive()
    alone = type(drive)(vehicle="V1", name="d", branches={"battery": drive.branches["battery"]}, inputs={})
    found = examined(write_layout(tmp_path), write_log(tmp_path, alone, database))
    assert [item.severity for item in findings(found, "too few branches")] == [Severity.ERROR]
    assert "needs two branches" in found.steps.not_ready["kirchhoff"]


def test_two_copies_of_a_log_change_no_verdict(log: Path, tmp_path: Path) -> None:
    layout = write_layout(tmp_path, inverted=("auxiliary",))
    one, two = examined(layout, log), examined(layout, log, log)
    assert [(f.kind, f.subject) for f in one.findings] == [(f.kind, f.subject) for f in two.findings]
    assert two.branches[0].frames == 2 * one.branches[0].frames
