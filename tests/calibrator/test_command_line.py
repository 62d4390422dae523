"""Wrong options, Ctrl-C and closed pipes."""

import gzip
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from calibrator.cli import app
from calibrator.processes.interrupts import TERMINATED, interrupted_message, terminated_message
from ecu_node.program import INTERRUPTED
from tests.calibrator.command_here import calibrator

ROOT = Path(__file__).parents[2]
LAYOUT = ROOT / "dbc" / "hv_powertrain.toml"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--noise", "inf"], "inf: expected a number from 0 to 1"),
        (["--noise", "-0.1"], "-0.1: expected a number from 0 to 1"),
        (["--delay", "inf"], "inf: expected a number from 0 to 1000"),
        (["--minutes", "1e9"], "1e9: expected a number from 0.1 to 240"),
        (["--unseen-minutes", "inf"], "inf: expected a number from 0.1 to 240"),
        (["--sparsity", "few"], "few: expected a number from 0 to 100"),
        (["--unmeasured", "nan", "1"], "expected mean and standard deviation from 0 to 1000 A"),
        (["--unmeasured", "1", "-1"], "expected mean and standard deviation from 0 to 1000 A"),
        (["--magnitude", "0.2", "0.1"], "expected 0 <= LO <= HI < 1"),
        (["--vehicles", "1000000000"], ""),
        (["--seed", "1" + 30 * "0"], ""),
        (["--workers", "100000"], ""),
    ],
)
def test_simulate_refuses_what_no_fleet_has_before_it_does_anything(
    options: list[str], message: str, tmp_path: Path
) -> None:
    # The layout is missing too, and is not complained of: nothing has been looked at yet.
    vehicles = [] if "--vehicles" in options else ["--vehicles", "2"]
    files = ["--layout", str(tmp_path / "none.toml"), "--out", str(tmp_path / "x")]
    run = CliRunner().invoke(app, ["simulate", *vehicles, *options, *files])
    assert run.exit_code == 2
    (error,) = [line for line in run.stderr.splitlines() if line.startswith("Error")]
    assert f"Invalid value for '{options[0]}'" in error
    assert message in error
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--branches", "battery,battery"], "battery is named twice"),
        (["--branches", "battery,"], "expected names of branches with commas between them"),
        (["--magnitude", "nan", "nan"], "nan nan: expected 0 <= LO <= HI < 1"),
        (["--harm-limit", "nan"], "nan: expected a number from 0 to 1"),
        (["--sparsity", "inf"], "inf: expected a number from 0 to 100"),
        (["--symmetric"], "belongs to --method published, not posterior; leave it out or change the method"),
    ],
)
def test_calibrate_refuses_wrong_options(options: list[str], message: str, tmp_path: Path) -> None:
    files = ["--layout", str(LAYOUT), "--out", str(tmp_path / "x")]
    run = CliRunner().invoke(app, ["calibrate", str(tmp_path), *options, *files])
    assert run.exit_code == 2
    assert message in run.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--truth", "t.json", "--method", "published"],
            "--truth: used by the perfect classifier alone, not by tree; add --classifier perfect, or leave it out",
        ),
        (
            ["--truth", "t.json", "--classifier", "threshold"],
            "--truth: used by the perfect classifier alone, not by threshold; "
            "add --method published --classifier perfect, or leave it out",
        ),
        (
            ["--classifier", "perfect", "--method", "published"],
            "--classifier: perfect is told the truth; add --truth FILE, the truth.json of this artificial fleet",
        ),
        (
            ["--classifier", "perfect"],
            "--classifier: perfect is told the truth; "
            "add --method published --truth FILE, the truth.json of this artificial fleet",
        ),
    ],
)
def test_truth_and_perfect_classifier_each_say_what_is_missing(
    options: list[str], message: str, tmp_path: Path
) -> None:
    files = ["--layout", str(LAYOUT), "--out", str(tmp_path / "x")]
    run = CliRunner().invoke(app, ["calibrate", str(tmp_path), *options, *files])
    assert run.exit_code == 2
    assert run.stderr.splitlines()[-1] == f"Error: Invalid value for {message}"


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", "--vehicles", "2"],
        ["calibrate", "nowhere"],
        ["import", "nowhere.log"],
        ["experiment", "snr"],
    ],
)
def test_output_that_cannot_be_made_is_refused_before_the_work(command: list[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    layout = [] if command[0] == "experiment" else ["--layout", str(LAYOUT)]
    run = calibrator(*command, *layout, "--out", tmp_path / "file" / "x")
    assert run.returncode == 1
    assert run.stderr == (
        f"calibrator: {tmp_path / 'file' / 'x'}: cannot be made: {tmp_path / 'file'} is a file; choose another folder\n"
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sparsity", "--drives", "store"], "--drives: sparsity takes the built-in vehicle; this is only for real,"),
        (["snr", "--layout", "none.toml"], "--layout: snr takes the built-in vehicle; this is only for real, delay"),
        (["calibration", "--quick"], "--quick: calibration runs nothing, it pools what is recorded in --out"),
        (["calibration", "--repetitions", "3"], "--repetitions: calibration runs nothing"),
        (["calibration", "--json"], "--out: calibration pools what is recorded there; first run 'calibrator "),
    ],
)
def test_experiment_refuses_what_it_does_not_heed(arguments: list[str], message: str, tmp_path: Path) -> None:
    out = [] if "--json" in arguments else ["--out", str(tmp_path / "x")]
    run = CliRunner().invoke(app, ["experiment", *arguments, *out])
    assert run.exit_code == 2
    (error,) = [line for line in run.stderr.splitlines() if line.startswith("Error")]
    assert message in error
    assert not (tmp_path / "x").exists()


def test_ctrl_c_during_start_up_ends_it_in_one_line() -> None:
    # The import of the command line sends SIGINT to itself and swallows what comes of it, as libraries do.
    code = (
        "import os, signal, sys, types\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'typer':\n"
        "            try: os.kill(os.getpid(), signal.SIGINT)\n"
        "            except BaseException: pass\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from calibrator.__main__ import main\n"
        "sys.argv = ['calibrator', '--version']\n"
        "main()\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (run.returncode, run.stdout, run.stderr) == (INTERRUPTED, "", f"{interrupted_message([])}\n")


def test_ctrl_c_at_work_ends_workers_too_in_one_line_and_keeps_nothing(tmp_path: Path) -> None:
    command = [
        *(sys.executable, "-m", "calibrator", "simulate", "--vehicles", "200", "--minutes", "2"),
        *("--layout", str(LAYOUT), "--out", str(tmp_path / "x")),
    ]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        while not [path for path in tmp_path.iterdir() if not path.name.startswith(".trial")]:
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(0.4)  # the hidden folder is there: the workers are about to start
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (INTERRUPTED, f"{interrupted_message(command[3:])}\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("delay_s", [0.0, 2.0])
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_while_logs_are_read_end_readers_too_in_one_line(
    how: signal.Signals, delay_s: float, tmp_path: Path, short_folder: Path
) -> None:
    log, temporary = tmp_path / "V1" / "endless.log.gz", short_folder
    log.parent.mkdir()
    log.write_bytes(gzip.compress(b"\n" * (1 << 24)) * 2000)
    command = [
        *(sys.executable, "-m", "calibrator", "import", str(log.parent), "--workers", "1"),
        *("--layout", str(LAYOUT), "--out", str(tmp_path / "store")),
    ]
    environment = {**os.environ, "TMPDIR": str(temporary)}
    options: dict[str, Any] = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True, "env": environment}
    with subprocess.Popen(command, **options) as process:
        while not list(temporary.iterdir()):  # the folder of the readers: they are about to start
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(delay_s)
        process.send_signal(how) if how is signal.SIGTERM else os.killpg(process.pid, how)
        _, errors = process.communicate(timeout=60)  # also waits for all that have its stderr
    if how is signal.SIGTERM:
        assert (process.returncode, errors) == (TERMINATED, f"{terminated_message(command[3:])}\n")
        return
    assert (process.returncode, errors) == (INTERRUPTED, f"{interrupted_message(command[3:])}\n")
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["simulate", "--help"]])
def test_closed_pipe_gives_no_traceback(arguments: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "calibrator", *arguments]
    run = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False, timeout=60)
    os.close(writer)
    assert (run.returncode, run.stderr) == (1, "")
