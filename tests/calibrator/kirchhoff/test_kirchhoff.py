"""Through the command line: the sum of the currents of logs and tables, before and after correction."""

import json
import re
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from calibrator.drive import Array, Channel, Drive
from calibrator.files.layout_files import vehicle_database
from calibrator.recordings.write_logs import encode_message, write_candump
from ecu_node.cli import template_text
from ecu_node.database import VehicleDatabase
from tests.calibrator.command_here import calibrator, refused, reported, succeeded
from tests.calibrator.conftest import LAYOUT
from tests.calibrator.drive_logs import drive_series

TIME_S = np.arange(0.0, 10.0, 0.05)
TABLE_S = np.arange(0.0, 120.0, 0.1)
MOTOR_A = 60.0 * np.sin(0.7 * TABLE_S) + 25.0 * np.sin(2.3 * TABLE_S + 1.0) + 20.0


def run(*arguments: object) -> str:
    return succeeded("kirchhoff", *arguments)


def figures(*arguments: object) -> Any:
    return reported("kirchhoff", *arguments)


def table(folder: Path, digits: int = 3, **columns_a: Array) -> tuple[object, ...]:
    """Write a table of measured currents, and return the arguments with which ``kirchhoff`` reads it."""
    frame = pd.DataFrame({"time [s]": TABLE_S, **columns_a}).round(digits)
    frame.to_csv(folder / "table.csv", index=False)
    return folder / "table.csv", "--branches", ",".join(f"{name}={name}" for name in columns_a)


@pytest.fixture(scope="module")
def log(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with a battery offset of 12 A; the corrected frames in it, 1 ms later, have the true currents."""
    true, good = 100.0 * np.sin(TIME_S), np.ones(len(TIME_S), np.bool_)
    measured = {"battery": true + 12.0, "motor": -true}
    branches = {name: Channel(time_s=TIME_S, value=value, good=good) for name, value in measured.items()}
    series = drive_series(Drive(vehicle="V1", name="d", branches=branches, inputs={}), database)
    for name in ("Battery", "Motor"):
        series.append(encode_message(database, f"HV_{name}Corrected", TIME_S, {f"{name}CurrentCorrected": true}))
    path = tmp_path_factory.mktemp("log") / "drive.log.gz"
    write_candump(path, series)
    return path


# ---- figures


def test_sum_shows_the_offset_before_and_not_after_correction(log: Path) -> None:
    found = figures(log, "--layout", LAYOUT)
    assert found["before"]["sum"]["rmse_a"] == pytest.approx(12.0, abs=0.02)
    assert found["before"]["sum"]["rmse_percent"] == pytest.approx(3.0, abs=0.005)
    assert found["before"]["battery"]["mean_a"] == pytest.approx(12.0 + 100.0 * np.sin(TIME_S).mean(), abs=0.5)
    assert found["after"]["sum"]["max_a"] < 0.03
    assert found["change"]["battery"]["mean_a"] == pytest.approx(-12.0, abs=0.02)
    assert found["change"]["motor"]["max_a"] < 0.03
    assert found["left_out"] == ["auxiliary", "dcdc", "motor_rear"]


def test_rows_with_missing_numbers_are_counted_and_not_used(tmp_path: Path) -> None:
    battery = MOTOR_A + 12.0
    battery[100:110] = np.nan
    found = figures(*table(tmp_path, battery=battery, motor=-MOTOR_A))
    assert found["before"]["sum"]["rmse_a"] == pytest.approx(12.0, abs=1e-3)
    assert (found["instants"], found["valid"], found["masked"]["stale"]) == (1200, 1190, 10)
    assert "10 of 1,200 instants not used: 10 stale" in found["notices"]


# ---- the band, and what the sum is made of


@pytest.mark.parametrize("digits", [0, 1, 2])
def test_sum_due_to_quantisation_alone_lies_in_the_expected_band(digits: int, tmp_path: Path) -> None:
    currents_a = {"battery": MOTOR_A, "motor": -0.4 * MOTOR_A, "heater": -0.6 * MOTOR_A}
    expected = figures(*table(tmp_path, digits, **currents_a))["expected"]
    assert expected["parts_a"]["quantisation"] == pytest.approx(10.0**-digits / 2.0)
    assert expected["in_band"]["before"] > 0.97


@pytest.mark.parametrize("noise_a", [0.3, 1.0])
def test_expected_band_covers_sensor_noise_but_not_ten_times_as_much(noise_a: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    battery, motor = MOTOR_A + noise_a * rng.normal(size=1200), -MOTOR_A
    expected = figures(*table(tmp_path, battery=battery, motor=motor))["expected"]
    assert expected["parts_a"]["noise"] == pytest.approx(noise_a, rel=0.15)
    far = figures(*table(tmp_path, battery=battery + 4.0 * noise_a, motor=motor))["expected"]
    assert expected["in_band"]["before"] > 0.9
    assert far["in_band"]["before"] < 0.5


def shares(found: Any) -> dict[str, float]:
    return {name: found["residual"]["before"][name] for name in ("constant", "gains", "delays", "rest")}


def test_gain_error_constant_and_delay_are_told_apart_in_the_sum(tmp_path: Path) -> None:
    noise = 0.05 * np.random.default_rng(5).normal(size=1200)
    late = 60.0 * np.sin(0.7 * (TABLE_S - 0.08)) + 25.0 * np.sin(2.3 * (TABLE_S - 0.08) + 1.0) + 20.0
    for wrong, name in ((1.03 * MOTOR_A - 0.6, "gains"), (MOTOR_A + 2.0, "constant"), (late, "delays")):
        found = figures(*table(tmp_path, battery=wrong + noise, motor=-MOTOR_A))
        assert shares(found)[name] > 0.95
        assert sum(shares(found).values()) == pytest.approx(1.0)
        if name == "gains":
            battery = found["residual"]["before"]["alone"]["battery"]
            assert battery["gain_error"] == pytest.approx(0.03, abs=0.001)
            assert battery["gain_share"] > 0.99
    said = run(*table(tmp_path, battery=late + noise, motor=-MOTOR_A))
    ((late_ms, digits, sd_ms),) = re.findall(r"battery: its frames are (\d+)(\.\d+)? \+- (\S+) ms late", said)
    assert int(late_ms) in {79, 80}
    assert len(digits or "") == len(sd_ms.lstrip("0123456789")), "as many digits as the deviation has"


@pytest.mark.parametrize(("factor", "text", "advice", "column", "sign", "times"), [
    (-1.0, "its sign is inverted", "write a minus before motor in --branches", "motor [A]", "-", 1.0),
    (1e3, "its current is 1000 times too large", "of column motor [A]: 'motor [mA]'", "motor [mA]", "", 1.0),
    (1e-3, "its current is 1000 times too small", "of column motor [A]: 'motor [kA]'", "motor [kA]", "", 1.0),
    (10.0, "its current is 10 times too large", "multiply motor [A] by 0.1, in the table or in --branches",
     "motor", "", 0.1),
])  # fmt: skip
def test_advice_on_a_wrong_sign_or_unit_removes_the_error(
    factor: float, text: str, advice: str, column: str, sign: str, times: float, tmp_path: Path
) -> None:
    heater = 5.0 * np.sin(2.0 * TABLE_S)

    def errors(column: str, sign: str, motor_a: Array) -> list[str]:
        path, *_ = table(tmp_path, 6, battery=MOTOR_A + heater, heater=-heater, **{column: motor_a})
        lines = run(path, "--branches", f"battery=battery,heater=heater,{sign}motor={column}").splitlines()
        return [line for line in lines if line.startswith("error")]  # not the hint that full scale is unknown

    (line,) = errors("motor [A]", "", -factor * MOTOR_A)
    assert line.startswith(f"error    motor: {text}: ")
    assert line.endswith(advice)
    assert errors(column, sign, -factor * times * MOTOR_A) == []
    assert errors("motor", "", -1.2 * MOTOR_A) == []


def test_layout_init_is_suggested_only_for_branches_without_a_formula(tmp_path: Path) -> None:
    path, *_ = table(tmp_path, battery=MOTOR_A, motor=-MOTOR_A)
    for column, is_told in (("motor", True), ("motor*1", False)):  # no layout is made from formulas
        done = calibrator("kirchhoff", path, "--branches", f"battery=battery,motor={column}")
        assert ("next: calibrator layout init" in done.stderr) is is_told


# ---- parameters


def parameters(folder: Path, **values: object) -> Path:
    """A file that corrects the battery's sensor."""
    document = json.loads(template_text(vehicle_database(LAYOUT), "V1", datetime(2026, 6, 1, tzinfo=UTC)))
    document["branches"] = {"battery": document["branches"]["battery"] | values}
    (folder / "V1.json").write_text(json.dumps(document))
    return folder / "V1.json"


def test_parameter_file_corrects_a_branch_only_if_it_is_marked_to_apply(log: Path, tmp_path: Path) -> None:
    file = parameters(tmp_path, offset_a=12.0, apply=True)
    found = figures(log, "--layout", LAYOUT, "--parameters", file)
    assert found["after"]["sum"]["max_a"] < 0.05
    assert found["uncorrected"] == ["motor"]
    assert "corrected with the parameters of V1" in found["notices"]
    passing = figures(log, "--layout", LAYOUT, "--parameters", parameters(tmp_path, offset_a=12.0, apply=False))
    assert passing["after"] == passing["before"]
    assert passing["uncorrected"] == ["battery", "motor"]


def test_parameters_of_another_layout_are_refused(log: Path, tmp_path: Path) -> None:
    file = parameters(tmp_path, offset_a=12.0, apply=True)
    (tmp_path / "other.toml").write_text(LAYOUT.read_text() + "# other\n")
    shutil.copy(LAYOUT.with_suffix(".dbc"), tmp_path)
    said = refused("kirchhoff", log, "--layout", tmp_path / "other.toml", "--parameters", file)
    assert "parameters were made with layout hv_powertrain" in said


# ---- text, pictures and tables


def test_tables_fit_80_columns_and_the_last_line_gives_the_rmse_of_the_sum(log: Path) -> None:
    lines = run(log, "--layout", LAYOUT).splitlines()
    assert all(len(line) <= 80 for line in lines[:6]), lines
    assert "\x1b" not in "".join(lines)
    assert "no usable frames of auxiliary, dcdc, motor_rear: left out of the sum" in lines
    assert lines[-1].startswith("RMSE of the sum: 12.00 A measured, 0.0")


def test_plot_page_needs_no_other_file(log: Path, tmp_path: Path) -> None:
    run(log, "--layout", LAYOUT, "--plot", tmp_path / "out.html")
    page = (tmp_path / "out.html").read_text()
    assert "<title>Branch currents, positive into the junction: drive.log.gz</title>" in page
    assert "sum corrected" in page
    assert float(re.findall(r'"legend":\{[^}]*"y":([-0-9.]+)', page)[-1]) > 0.9  # in sight at once
    assert "<script src=" not in page
    assert "<link" not in page.partition("<body>")[0]


def test_long_recording_is_thinned_out_in_the_plot(tmp_path: Path) -> None:
    times, motor = np.arange(0.0, 6000.0, 0.1), np.tile(MOTOR_A, 50)
    frame = pd.DataFrame({"time [s]": times, "battery": motor + 1.0, "motor": -motor}).round(2)
    frame.to_parquet(tmp_path / "long.parquet", index=False)
    arguments = (tmp_path / "long.parquet", "--branches", "battery=battery,motor=motor", "--plot", tmp_path / "x.html")
    assert figures(*arguments)["before"]["sum"]["mean_a"] == pytest.approx(1.0)
    page = (tmp_path / "x.html").read_text()
    assert "long.parquet (1 instant of 2)" in page
    assert len(page) < 10e6


def test_currents_and_their_sum_are_written_as_csv_or_parquet(log: Path, tmp_path: Path) -> None:
    for name, read in (("out.csv", pd.read_csv), ("out.parquet", pd.read_parquet)):
        run(log, "--layout", LAYOUT, "--table", tmp_path / name)
        frame = read(tmp_path / name)
        assert list(frame) == [
            "time_s", "battery_a", "motor_a", "sum_a", "battery_corrected_a", "motor_corrected_a", "sum_corrected_a",
            "expected_sd_a",
        ]  # fmt: skip
        np.testing.assert_allclose(frame["sum_a"].mean(), 12.0, atol=0.02)


@pytest.mark.parametrize(("option", "name"), [("--plot", "out.html"), ("--table", "out.csv")])
def test_symbolic_link_is_not_overwritten_by_plot_or_table(option: str, name: str, log: Path, tmp_path: Path) -> None:
    (tmp_path / name).symlink_to(tmp_path / "elsewhere")
    said = refused("kirchhoff", log, "--layout", LAYOUT, option, tmp_path / name)
    assert f"{name}: is a link, so it cannot be replaced" in said
    assert (tmp_path / name).is_symlink()
