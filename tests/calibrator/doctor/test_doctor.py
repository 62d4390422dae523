"""Known truth, through the command line: what was put into a log or a layout is found, and nothing else."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pandas as pd
import pytest

from calibrator.drive import Array, Channel, Drive
from ecu_node.database import VehicleDatabase
from tests.calibrator.command_here import calibrator, succeeded
from tests.calibrator.doctor.artificial_logs import Examine, examined, true_drive, with_branch, write_layout, write_log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, database: VehicleDatabase) -> Path:
    return write_log(tmp_path_factory.mktemp("log"), true_drive(), database)


@pytest.fixture
def layout(tmp_path: Path) -> Path:
    return write_layout(tmp_path)


@pytest.fixture
def examine(tmp_path: Path, layout: Path, database: VehicleDatabase) -> Examine:
    """Examine the log of a drive."""
    return lambda drive: examined(layout, write_log(tmp_path, drive, database))


def cut(drive: Drive, seconds: float) -> Drive:
    """The beginning of a drive."""

    def first(channels: Mapping[str, Channel]) -> dict[str, Channel]:
        return {
            name: replace(item, time_s=item.time_s[keep], value=item.value[keep], good=item.good[keep])
            for name, item in channels.items()
            if (keep := item.time_s < seconds).any()
        }

    return replace(drive, branches=first(drive.branches), inputs=first(drive.inputs))


def calibrated(folder: Path, log: Path, layout: Path, *arguments: object) -> tuple[int, str]:
    done = calibrator("calibrate", log, "--layout", layout, "--out", folder / "result", *arguments)
    return done.returncode, done.stdout + done.stderr


# ---- a sound log


def test_sound_log_is_ready_for_all_commands(log: Path, layout: Path) -> None:
    doctor = examined(layout, log)
    assert doctor.errors == []
    assert doctor.findings("sign", "unit", "delay", "sum", "stuck", "clipped", "gap", "gain", "stands still") == []
    steps = ["kirchhoff", "import", "calibrate --trusted", "calibrate", "ecu-node", "ecu-node --gateway"]
    assert (doctor.report["ready"], doctor.report["not_ready"]) == (steps, {})
    (mean,) = doctor.findings("mean")
    assert mean.number == pytest.approx(2.5, abs=0.1)
    battery, auxiliary = (doctor.report["branches"][name] for name in ("battery", "auxiliary"))
    assert battery["frames"] == 6000
    assert 1.0 / auxiliary["period_s"] == pytest.approx(20.0, rel=1e-3)
    assert [item.subject for item in doctor.findings("not in log") if "Rear" in item.text] == ["motor_rear"]


def test_text_of_doctor_names_the_next_commands_and_its_tables_fit_80_columns(log: Path, layout: Path) -> None:
    lines = succeeded("doctor", "--layout", layout, "--log", log).splitlines()
    assert "ready for: kirchhoff, import, calibrate --trusted, calibrate, ecu-node, ecu-node --gateway" in lines
    assert f"calibrator calibrate {log} --layout {layout} --trusted battery --out result" in lines[-2]
    assert lines[-1].startswith("5 vehicles or more: calibrator calibrate FOLDER_OF_VEHICLES")
    assert all(len(line) <= 80 for line in lines[1:14]), lines


def test_inputs_that_are_computed_from_a_current_sensor_are_named(examine: Examine) -> None:
    drive = true_drive()
    shown = drive.branches["motor"]
    torque = replace(shown, value=np.round(-shown.value * 0.76, 1))
    others = {name: drive.inputs[name] for name in ("voltage", "speed")}
    doctor = examine(replace(drive, inputs={**others, "torque": torque}))
    (finding,) = doctor.findings("computed input")
    assert (finding.subject, finding.severity) == ("torque", "warning")
    assert finding.text.startswith("carries the noise of current sensors, as if computed from the current of motor")
    assert doctor.report["not_ready"]["calibrate"].startswith(
        "model_inputs torque (most like motor), as if computed from current sensors"
    )


def test_recording_that_is_given_in_two_formats_is_reported(log: Path, layout: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.blf"  # which rounds times in another way
    with can.CanutilsLogReader(log) as frames, can.BLFWriter(copy) as writer:
        for frame in frames:
            writer.on_message_received(frame)
    said = succeeded("doctor", "--layout", layout, "--log", log, "--log", copy)
    assert f"warning  {copy}: the same recording as {log}, counted twice; leave one of them out" in said


@pytest.mark.parametrize(("declared_a", "reported"), [(2.5, False), (1.5, False), (0.5, True)])
def test_mean_of_sum_is_reported_unless_declared(declared_a: float, reported: bool, log: Path, layout: Path) -> None:
    with layout.open("a") as file:
        file.write(f"\n[unmeasured_load]\nmean_a = {declared_a}\nsd_a = 0.5\n")
    found = examined(layout, log).findings("mean")
    assert bool(found) is reported
    assert all("(0.5 A are declared as a load)" in item.text for item in found)
    assert all("look at the load declared in [unmeasured_load]" in item.advice for item in found)


# ---- no false alarms


def at_rest(
    database: VehicleDatabase, folder: Path, *, noise_a: float, offset_a: float = 0.0, speed: float = 0.0
) -> Path:
    """Two minutes of a car that stands: noise and an offset of the battery's sensor, or only quantisation."""
    noise, drive = np.random.default_rng(4), true_drive()
    branches = {
        name: replace(item, value=noise.normal(0.0, noise_a, len(item.value)) + offset_a * (name == "battery"))
        for name, item in drive.branches.items()
    }
    moving = drive.inputs["speed"]
    inputs = {**drive.inputs, "speed": replace(moving, value=np.full(len(moving.value), speed))}
    return write_log(folder, replace(drive, branches=branches, inputs=inputs), database)


@pytest.mark.parametrize(("noise_a", "offset_a"), [(0.0, 0.0), (0.7, 0.0), (0.3, 2.0)])
def test_log_of_a_car_at_rest_gives_a_standstill_hint_and_no_error(
    noise_a: float, offset_a: float, tmp_path: Path, layout: Path, database: VehicleDatabase
) -> None:
    log = at_rest(database, tmp_path, noise_a=noise_a, offset_a=offset_a)
    doctor = examined(layout, log)
    assert doctor.errors == []
    (still,) = doctor.findings("stands still")
    assert still.text.startswith("the car stands still: no current varies by more than ")
    assert "and its speed is 0" in still.text
    assert doctor.findings("sign", "unit", "cannot tell", "gain", "delay", "constant", "full scale", "inputs") == []
    assert [round(item.number) for item in doctor.findings("mean")] == ([2] if offset_a else [])
    assert "calibrate --trusted" in doctor.report["ready"]
    shown = succeeded("kirchhoff", log, "--layout", layout)
    assert still.text in " ".join(shown.split())
    assert "gain error" not in shown
    assert "of the sum measured" not in shown
    assert calibrated(tmp_path, log, layout, "--trusted", "battery")[0] == 0


def test_constant_current_at_speed_is_not_a_standstill(tmp_path: Path, layout: Path, database: VehicleDatabase) -> None:
    doctor = examined(layout, at_rest(database, tmp_path, noise_a=0.02, speed=50.0))
    assert doctor.findings("stands still") == []
    assert [item.subject for item in doctor.findings("full scale")] == ["all branches"]


# ---- signs and units


@pytest.mark.parametrize("branch", ["battery", "motor", "auxiliary"])
def test_inverted_sign_is_found_in_the_right_branch(branch: str, log: Path, tmp_path: Path) -> None:
    doctor = examined(write_layout(tmp_path, inverted=(branch,)), log)
    assert doctor.errors == [("sign", branch)]
    error = doctor.findings("sign")[0]
    assert error.number > 4.0
    assert re.search(rf'set sign = -?1 in the \[\[branch\]\] "{branch}"', error.advice)
    assert doctor.report["ready"] == ["kirchhoff"]


def test_inversion_of_all_signs_is_found_by_the_voltage(log: Path, tmp_path: Path) -> None:
    layout = write_layout(tmp_path, inverted=("battery", "motor", "auxiliary", "dcdc", "motor_rear"))
    doctor = examined(layout, log)
    assert [(item.subject, item.severity) for item in doctor.findings("sign")] == [("all branches", "warning")]


@pytest.mark.parametrize(
    ("branch", "unit"), [("battery", "mA"), ("motor", "kA"), ("auxiliary", "mA"), ("auxiliary", "kA")]
)
def test_wrong_unit_is_reported_with_its_factor(branch: str, unit: str, log: Path, tmp_path: Path) -> None:
    doctor = examined(write_layout(tmp_path, units={f"{branch.title()}Current": unit}), log)
    assert doctor.errors == [("unit", branch)]
    assert doctor.findings("unit")[0].number == {"mA": 1000.0, "kA": 0.001}[unit]
    assert doctor.findings("full scale") == []


def test_sign_of_a_very_small_branch_is_reported_as_unknown(log: Path, tmp_path: Path) -> None:
    """The converter's current changes too slowly to be seen in the sum."""
    doctor = examined(write_layout(tmp_path, inverted=("dcdc",)), log)
    assert doctor.errors == []
    assert [item.subject for item in doctor.findings("cannot tell")] == ["dcdc"]


RNG = np.random.default_rng(3)


def errors_of_table(folder: Path, branches: str, **columns: Array) -> list[tuple[str, str]]:
    """Errors of a table: a new set point each second, ten rows a second."""
    frame = pd.DataFrame({name: np.repeat(value, 10) for name, value in columns.items()})
    frame.index = pd.Index(0.1 * np.arange(len(frame)), name="time")
    frame.to_csv(folder / "table.csv")
    (folder / "table.toml").write_text(f'schema = 1\nname = "table"\nfull_scale_a = 150\n{branches}')
    return examined(folder / "table.toml", folder / "table.csv").errors


def branch(name: str, **keys: str) -> str:
    lines = [f'{key} = "{value}"\n' for key, value in keys.items()]
    return f'[[branch]]\nname = "{name}"\nsign = 1\n{"".join(lines)}'


def test_unrelated_currents_are_reported_as_an_error_of_the_sum(tmp_path: Path) -> None:
    battery, motor, heater = 30.0 * RNG.normal(size=(3, 300))
    branches = "".join(branch(name, signal=name) for name in ("battery", "motor", "heater"))
    assert errors_of_table(tmp_path, branches, battery=battery, motor=motor, heater=heater) == [("sum", "sum")]


@pytest.mark.parametrize(("factor", "wrong"), [(1.0, []), (1000.0, [("unit", "U [V]")]), (0.01, [("unit", "U [V]")])])
def test_wrong_voltage_unit_is_not_blamed_on_power(factor: float, wrong: list[tuple[str, str]], tmp_path: Path) -> None:
    current = 40.0 * RNG.normal(size=300)
    volts = 400.0 - 0.1 * current
    branches = branch("battery", signal="I") + branch("motor", power="P [W]", voltage="U [V]")
    columns = {"I": current + 0.1 * RNG.normal(size=300), "P [W]": -current * volts, "U [V]": factor * volts}
    assert errors_of_table(tmp_path, branches, **columns) == wrong


# ---- delays, gains


@pytest.mark.parametrize("delay_s", [0.06, 0.2, -0.3])
def test_delay_of_100_ms_or_more_is_a_warning_and_a_shorter_one_a_hint(delay_s: float, examine: Examine) -> None:
    late = {"motor": 0.4 + delay_s, "battery": 0.4, "auxiliary": 0.4, "dcdc": 0.4}
    doctor = examine(true_drive(delay_s=late))
    assert doctor.errors == []
    (delay,) = doctor.findings("delay")
    assert (delay.subject, delay.severity) == ("motor", "warning" if abs(delay_s) >= 0.1 else "hint")
    assert delay.number == pytest.approx(delay_s, abs=0.005)


def test_gain_error_is_reported_with_its_size(examine: Examine) -> None:
    drive = true_drive()
    doctor = examine(with_branch(drive, "motor", 1.08 * drive.branches["motor"].value))
    assert doctor.errors == []
    (gain,) = doctor.findings("gain")
    assert gain.subject in {"motor", "battery"}
    assert abs(gain.number) == pytest.approx(0.08, abs=0.01)


# ---- single branches


def stuck(value: Array) -> Array:
    time_s = 0.02 * np.arange(len(value))
    return np.where((time_s >= 20.0) & (time_s < 50.0), -37.0, value)


def lost(share: float) -> Callable[[Array], Array]:
    """Make a share of the values unusable, as a wrong byte order in the DBC does: the others are no current either."""
    return lambda value: np.where(np.random.default_rng(0).random(len(value)) < share, np.nan, value)


@pytest.mark.parametrize(("branch", "change", "code", "severity", "text"), [
    ("motor", stuck, "stuck", "warning", r"it stands at -37 A for 30 s from 20 s on, .* others' sum varies by \d+ A"),
    ("battery", lambda value: 12.0 * value, "clipped", "warning", "frames stand at the end of what HV_Battery.Battery"),
    ("auxiliary", lambda value: 0.0 * value - 5.0, "constant", "warning", "it never changes: -5 A in all of 2,400 fr"),
    ("dcdc", lost(1.0), "bad frames", "error", r"1,200 of 1,200 frames \(100 %\) .*: not available 1,200"),
    ("dcdc", lost(0.7), "bad frames", "error", "of 1,200 frames"),
    ("dcdc", lost(0.2), "bad frames", "warning", "of 1,200 frames"),
])  # fmt: skip
def test_stuck_clipped_constant_or_unusable_values_of_a_branch_are_reported(
    branch: str, change: Callable[[Array], Array], code: str, severity: str, text: str, examine: Examine
) -> None:
    drive = true_drive()
    doctor = examine(with_branch(drive, branch, change(drive.branches[branch].value)))
    (found,) = [item for item in doctor.findings(code) if item.severity != "hint"]
    assert (found.subject, found.severity) == (branch, severity)
    assert re.search(text, found.text)


def test_longest_gap_and_frames_that_fail_the_e2e_check_are_reported(log: Path, tmp_path: Path, layout: Path) -> None:
    lines = log.read_text().splitlines(keepends=True)
    kept = [line for line in lines if not ("can0 110#" in line and 40.0 < float(line[1:].partition(")")[0]) < 45.0)]
    for k, line in enumerate(kept[:3000]):
        if "can0 120#" in line:
            kept[k] = line.replace("can0 120#", "can0 120#FF").rstrip("\n")[:33].ljust(33, "0") + "\n"
    (tmp_path / "drive.log").write_text("".join(kept))
    doctor = examined(layout, tmp_path / "drive.log")
    (gap,) = (item for item in doctor.findings("gap") if item.subject == "battery")
    assert gap.number == pytest.approx(5.0, abs=0.05)
    (bad,) = (item for item in doctor.findings("bad frames") if item.subject == "motor")
    assert "E2E check failed" in bad.text


def test_timeout_shorter_than_the_frame_period_is_an_error(log: Path, layout: Path) -> None:
    layout.write_text(layout.read_text().replace("timeout_s = 0.25", "timeout_s = 0.03"))
    doctor = examined(layout, log)
    assert doctor.errors == [("rate", "auxiliary")]
    assert "calibrate --trusted" in doctor.report["not_ready"]


def test_full_scale_that_is_exceeded_or_never_approached_is_reported(log: Path, tmp_path: Path) -> None:
    beyond = examined(write_layout(tmp_path, full_scale_a=50.0), log).findings("full scale")
    assert {item.subject for item in beyond} == {"battery", "motor"}
    assert all(re.search(r"[0-9,]+ of [0-9]+,000 values are beyond full_scale_a = 50 A", item.text) for item in beyond)
    (far,) = examined(write_layout(tmp_path, full_scale_a=20000.0), log).findings("full scale")
    assert far.subject == "all branches"
    assert "full_scale_a is 20,000 A" in far.text


# ---- layout and logs that do not fit


def test_log_without_any_branch_gives_an_error_that_names_the_identifiers_in_it(tmp_path: Path, layout: Path) -> None:
    (tmp_path / "other.log").write_text("(1.000000) can0 7FF#00\n(1.100000) can0 7FF#01\n")
    doctor = examined(layout, tmp_path / "other.log")
    (error,) = doctor.findings("no branch")
    assert error.severity == "error"
    assert "0x7FF" in error.text
    assert doctor.report["ready"] == []


def test_branch_missing_in_some_logs_gives_a_warning(log: Path, layout: Path, tmp_path: Path) -> None:
    without = [line for line in log.read_text().splitlines() if "can0 120#" not in line]
    (tmp_path / "other.log").write_text("\n".join(without))
    found = examined(layout, log, tmp_path / "other.log").findings("not in log")
    (lacks,) = [item for item in found if item.subject == "motor"]
    assert (lacks.severity, lacks.number) == ("warning", 1)
    assert lacks.text.startswith("1 of 2 logs have it; the others are not in the sum")


def test_branch_from_another_j1939_source_address_is_named(log: Path, layout: Path, tmp_path: Path) -> None:
    dbc = layout.with_name("hv_powertrain.dbc")
    dbc.write_text(dbc.read_text().replace(f" {0x120} ", f" {0x98FF51FE} "))
    (tmp_path / "j1939.log").write_text(log.read_text().replace(" 120#", " 18FF5127#"))
    (lacks,) = [
        item for item in examined(layout, tmp_path / "j1939.log").findings("not in log") if item.subject == "motor"
    ]
    assert lacks.advice.startswith("the log has 0x18FF5127: if that is ")


# ---- doctor, kirchhoff and calibrate say the same


@pytest.mark.parametrize("seconds", [3.0, 12.0, 40.0])
def test_short_log_is_reported_alike_by_doctor_kirchhoff_and_calibrate(
    seconds: float, tmp_path: Path, layout: Path, database: VehicleDatabase
) -> None:
    log = write_log(tmp_path, cut(true_drive(), seconds), database)
    doctor = examined(layout, log)
    assert doctor.errors == []
    assert doctor.findings("stands still") == []
    (short,) = doctor.findings("too short")
    assert (short.severity, short.number) == ("hint" if seconds == 40.0 else "warning", pytest.approx(seconds, abs=0.5))
    shown = succeeded("kirchhoff", log, "--layout", layout)
    assert short.text in " ".join(shown.split())
    assert ("of the sum measured" in shown) is (seconds == 40.0)
    code, said = calibrated(tmp_path, log, layout, "--trusted", "battery")
    assert (code == 0) is ("calibrate --trusted" in doctor.report["ready"]) is (seconds > 5.0)
    waits = doctor.report["not_ready"]
    if seconds == 3.0:
        assert waits["calibrate --trusted"].startswith("3.0 s in which all branches have usable samples; at least 5 s")
        assert waits["calibrate --trusted"] in said
    else:
        assert f"need 120 s together, and these have {seconds:.1f} s" in waits["calibrate"]


def exchange(layout: Path, one: str, other: str) -> None:
    """Have two branches read each other's signal."""
    layout.write_text(layout.read_text().replace(one, "@").replace(other, one).replace("@", other))


@pytest.mark.parametrize("sender", ["HV", "BMS"])  # a BMS may also send what it does not measure
def test_branches_of_opposite_sign_with_exchanged_signals_are_an_error(
    sender: str, log: Path, layout: Path, tmp_path: Path
) -> None:
    for file in (layout, tmp_path / "hv_powertrain.dbc"):
        file.write_text(file.read_text().replace("HV_", f"{sender}_"))
    exchange(layout, f"{sender}_Battery.BatteryCurrent", f"{sender}_Motor.MotorCurrent")
    doctor = examined(layout, log)
    assert doctor.errors == [("exchanged", "battery")]
    (error,) = doctor.findings("exchanged")
    assert f"reads {sender}_Motor.MotorCurrent, and motor reads {sender}_Battery.BatteryCurrent" in error.text
    assert error.number > 4.0
    assert 'exchange what [[branch]] "battery" and "motor" read' in error.advice
    code, said = calibrated(tmp_path, log, layout, "--trusted", "battery")
    assert code == 1
    assert "check sign and unit of branch" in said


def test_wrong_sign_is_found_though_two_other_branches_are_exchanged(log: Path, tmp_path: Path) -> None:
    layout = write_layout(tmp_path, inverted=("motor",))
    exchange(layout, "HV_Auxiliary.AuxiliaryCurrent", "HV_Dcdc.DcdcCurrent")
    doctor = examined(layout, log)
    assert doctor.errors == [("sign", "motor")]
    assert [(item.severity, item.subject) for item in doctor.findings("exchanged")] == [("warning", "auxiliary")]
