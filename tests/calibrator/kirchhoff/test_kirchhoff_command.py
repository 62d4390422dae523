import json
import signal
import subprocess
import threading
import time
from pathlib import Path

import can
import numpy as np
import pytest
from can.interfaces.virtual import channels

from calibrator.drive import Channel, Drive
from calibrator.kirchhoff.command import kirchhoff
from calibrator.recordings.canlog import encode_message, write_candump
from calibrator.recordings.drive_log import drive_series
from ecu_node.database import VehicleDatabase
from tests.calibrator.command_here import calibrator

ROOT = Path(__file__).parents[3]
LAYOUT = ROOT / "dbc" / "hv_powertrain.toml"
TIME_S = np.arange(0.0, 10.0, 0.05)


def run(*arguments: object) -> "subprocess.CompletedProcess[str]":
    return calibrator("kirchhoff", *arguments)


@pytest.fixture(scope="module")
def log(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Battery offset of 12 A; the corrected frames, 1 ms later, are right."""
    true = 100.0 * np.sin(TIME_S)
    drive = Drive(
        vehicle="V1",
        name="d",
        branches={
            "battery": Channel(time_s=TIME_S, value=true + 12.0, good=np.ones(len(TIME_S), np.bool_)),
            "motor": Channel(time_s=TIME_S, value=-true, good=np.ones(len(TIME_S), np.bool_)),
        },
        inputs={},
    )
    series = drive_series(drive, database)
    for message, corrected in (
        ("HV_BatteryCorrected", "BatteryCurrentCorrected"),
        ("HV_MotorCorrected", "MotorCurrentCorrected"),
    ):
        series.append(encode_message(database, message, TIME_S, {corrected: true}))
    path = tmp_path_factory.mktemp("log") / "drive.log.gz"
    write_candump(path, series)
    return path


def test_json_has_the_figures_before_and_after(log: Path) -> None:
    done = run(log, "--layout", LAYOUT, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    figures = json.loads(done.stdout)
    assert figures["before"]["sum"]["rmse_a"] == pytest.approx(12.0, abs=0.02)
    assert figures["before"]["sum"]["rmse_percent"] == pytest.approx(3.0, abs=0.005)
    assert figures["after"]["sum"]["max_a"] < 0.03
    assert figures["change"]["battery"]["mean_a"] == pytest.approx(-12.0, abs=0.02)
    assert figures["left_out"] == ["auxiliary", "dcdc", "motor_rear"]


def test_the_table_is_plain_text_of_80_columns_and_the_picture_is_written(log: Path, tmp_path: Path) -> None:
    done = run(log, "--layout", LAYOUT, "--plot", tmp_path / "out.png")
    assert done.returncode == 0
    assert "\x1b" not in done.stdout
    lines = done.stdout.splitlines()
    assert all(len(line) <= 80 for line in lines)
    assert lines[-1].startswith("RMSE of the sum: 12.00 A before, 0.0")
    assert "no usable frames of auxiliary, dcdc, motor_rear: left out of the sum" in lines
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")


def test_a_user_error_is_one_line_on_stderr_and_exit_code_1(tmp_path: Path) -> None:
    (tmp_path / "empty.log").touch()
    done = run(tmp_path / "empty.log", "--layout", LAYOUT)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.splitlines() == [
        f"calibrator: {tmp_path / 'empty.log'}: the log is empty: no data frames (0 error frames, "
        "0 remote frames, 0 damaged lines); record it again"
    ]


def test_wrong_use_is_exit_code_2(log: Path) -> None:
    assert run(log, "--layout", LAYOUT, "--interface", "virtual").returncode == 2
    assert run(log).returncode == 2


def test_help_has_a_short_form() -> None:
    short, long = run("-h"), run("--help")
    assert short.returncode == long.returncode == 0
    assert short.stdout == long.stdout
    assert "Usage: calibrator kirchhoff [OPTIONS] [LOG]" in short.stdout


def test_a_missing_dbc_is_the_options_and_not_the_layouts(log: Path) -> None:
    done = run(log, "--layout", LAYOUT, "--dbc", "missing.dbc")
    assert (done.returncode, done.stderr) == (1, "calibrator: missing.dbc: no such DBC; check --dbc\n")


@pytest.mark.parametrize("duration", ["nan", "inf", "0", "long"])
def test_a_duration_that_is_none_is_named_with_what_is_expected(duration: str) -> None:
    done = run("--interface", "virtual", "--channel", "x", "--duration", duration, "--layout", LAYOUT)
    assert done.returncode == 2
    assert f"'--duration': {duration}: expected a number from 0.1 to 86400" in done.stderr


def test_a_silent_bus_and_an_unknown_interface_are_named() -> None:
    silent = run("--interface", "virtual", "--channel", "x", "--duration", 0.2, "--layout", LAYOUT)
    assert (silent.returncode, silent.stdout) == (1, "")
    assert "virtual:x: no frame in 0.2 s" in silent.stderr
    unknown = run("--interface", "nonsense", "--channel", "x", "--layout", LAYOUT)
    assert unknown.returncode == 1
    assert len(unknown.stderr.splitlines()) == 1
    assert "cannot listen to the bus" in unknown.stderr


@pytest.mark.parametrize("interrupted", [False, True])
def test_a_live_bus_gives_the_figures_of_its_log(
    interrupted: bool, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def send() -> None:
        while not channels.get("live"):  # until the command listens
            time.sleep(0.01)
        with can.Bus(interface="virtual", channel="live", preserve_timestamps=True) as bus:
            for message in can.LogReader(log):
                bus.send(message)
        if interrupted:
            time.sleep(1.0)
            signal.raise_signal(signal.SIGINT)

    sender = threading.Thread(target=send)
    sender.start()
    kirchhoff(layout=LAYOUT, interface="virtual", channel="live", duration=600.0 if interrupted else 1.5, json=True)
    sender.join()
    figures = json.loads(capsys.readouterr().out)
    assert figures["before"]["sum"]["mean_a"] == pytest.approx(12.0, abs=0.02)
    assert figures["after"]["sum"]["max_a"] < 0.03
