"""Wrong options, Ctrl-C and closed pipes."""

import gzip
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from calibrator.processes.interrupts import ENDED, TERMINATED, importing, interrupted_message
from ecu_node.program import INTERRUPTED

ROOT = Path(__file__).parents[3]
LAYOUT = ROOT / "dbc" / "hv_powertrain.toml"


START = "import os, signal, sys; from calibrator.__main__ import calibrator_program as run; sys.argv[1:] = ['{}']; "
# The import of the command line sends SIGINT to itself and swallows the exception, as libraries do.
SWALLOWED = """
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == 'typer':
            try: os.kill(os.getpid(), signal.SIGINT)
            except BaseException: pass
sys.meta_path.insert(0, Finder())
run()
"""
IMPORTING = "from calibrator.processes.interrupts import *\nwith importing(): os.kill(os.getpid(), signal.SIGINT)"


@pytest.mark.parametrize(("code", "exit_code", "said"), [
    (START.format("--version") + "sys.modules['typer'] = None; run()", 1,
     "calibrator: typer is not installed; pip install 'hv-current-correction[calibrator]'\n"),
    (START.format("--version") + SWALLOWED, INTERRUPTED, f"{interrupted_message([])}\n"),
    (START.format("summarise") + IMPORTING, INTERRUPTED, f"{interrupted_message(['summarise'])}\n"),
], ids=["base install", "Ctrl-C during start-up", "Ctrl-C during imports"])  # fmt: skip
def test_missing_package_or_ctrl_c_at_start_ends_with_one_line(code: str, exit_code: int, said: str) -> None:
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (run.returncode, run.stdout, run.stderr) == (exit_code, "", said)


@pytest.mark.parametrize(("epoch", "said"), [
    ("abc", "SOURCE_DATE_EPOCH is 'abc'; expected seconds since 1970, or leave it unset"),
    ("99999999999999", "SOURCE_DATE_EPOCH is '99999999999999'; expected seconds since 1970, or leave it unset"),
    ("", "none: no such folder, store of drives or store of summaries"),
])  # fmt: skip
def test_wrong_source_date_epoch_ends_in_one_line_and_empty_is_ignored(tmp_path: Path, epoch: str, said: str) -> None:
    command = [sys.executable, "-m", "calibrator", "calibrate", "none", "--layout", str(LAYOUT), "--out", "x"]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": epoch, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (1, f"calibrator: {said}\n")


@pytest.mark.parametrize("delay_s", [0.0, 2.0])
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_end_readers(
    how: signal.Signals, delay_s: float, tmp_path: Path, short_folder: Path
) -> None:
    log, temporary = tmp_path / "V1" / "endless.log.gz", short_folder
    log.parent.mkdir()
    log.write_bytes(gzip.compress(b"\n" * (1 << 24)) * 2000)
    command = [sys.executable, "-m", "calibrator", "import", str(log.parent), "--workers", "1"]
    command += ["--layout", str(LAYOUT), "--out", str(tmp_path / "store")]
    environment = {**os.environ, "TMPDIR": str(temporary)}
    environment.pop("COVERAGE_PROCESS_CONFIG", None)  # tracing holds up the end until threads miss their workers
    options: dict[str, Any] = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True, "env": environment}
    with subprocess.Popen(command, **options) as process:
        while not list(temporary.iterdir()):  # the folder of the readers: they are about to start
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(delay_s)
        process.send_signal(how) if how is signal.SIGTERM else os.killpg(process.pid, how)
        _, errors = process.communicate(timeout=60)  # also waits for all that have its stderr
    if how is signal.SIGTERM:
        assert (process.returncode, errors) == (TERMINATED, f"{interrupted_message(command[3:], ENDED)}\n")
        return
    assert (process.returncode, errors) == (INTERRUPTED, f"{interrupted_message(command[3:])}\n")
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["simulate", "--help"]])
def test_closed_output_pipe_of_calibrator_changes_no_exit_code(arguments: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "calibrator", *arguments]
    run = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False, timeout=60)
    os.close(writer)
    assert (run.returncode, run.stderr) == (0, "")


def handler() -> "Callable[..., object] | int | None":
    return signal.getsignal(signal.SIGINT)


@pytest.mark.parametrize("before", [signal.default_int_handler, signal.SIG_IGN])
def test_previous_handler_of_ctrl_c_is_restored_after_imports(before: "Callable[..., object] | int") -> None:
    of_pytest = signal.signal(signal.SIGINT, before)
    try:
        with importing():
            assert (handler() is before) == (before is signal.SIG_IGN)
        assert handler() is before
    finally:
        signal.signal(signal.SIGINT, of_pytest)


def test_message_on_interruption_tells_whether_the_command_can_resume() -> None:
    goes_on = "; it goes on with what it had read"
    for arguments, kept in ((["--debug", "import", "x"], goes_on), (["simulate", "--out", "import"], ""), ([], "")):
        assert interrupted_message(arguments) == f"calibrator: interrupted; run the same command again{kept}"
    assert interrupted_message([], ENDED) == "calibrator: ended by SIGTERM; run the same command again"
