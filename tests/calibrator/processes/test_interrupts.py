import signal
import subprocess
import sys
from collections.abc import Callable

import pytest

from calibrator.processes.interrupts import importing, interrupted_message, terminated_message


def handler() -> "Callable[..., object] | int | None":
    return signal.getsignal(signal.SIGINT)


def test_ctrl_c_is_handled_as_before_afterwards() -> None:
    before = handler()
    with importing():
        assert handler() is not before
    assert handler() is before


def test_a_program_started_without_ctrl_c_stays_so() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with importing():
            assert handler() is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("name", ["import", "summarise"])
def test_commands_that_go_on_are_to_be_run_again(name: str) -> None:
    said = "run the same command again; it goes on with what it had read"
    assert interrupted_message(["--debug", name, "x"]) == f"calibrator: interrupted; {said}"
    assert terminated_message([name]) == f"calibrator: ended by SIGTERM; {said}"


@pytest.mark.parametrize("name", ["experiment", "replay", "kirchhoff"])
def test_commands_that_keep_nothing_say_so_and_name_no_other_command(name: str) -> None:
    assert interrupted_message([name, "calibrate"]) == "calibrator: interrupted; nothing is kept of what was under way"


def test_other_commands_are_to_be_run_again_and_promise_nothing() -> None:
    for arguments in (["simulate", "--out", "import"], ["--version"], []):
        assert interrupted_message(arguments) == "calibrator: interrupted; run the same command again"


def test_ctrl_c_while_an_experiment_is_imported_says_that_nothing_is_kept() -> None:
    code = (
        "import os, signal, sys\n"
        "from calibrator.processes.interrupts import importing\n"
        "sys.argv = ['calibrator', 'experiment', 'snr']\n"
        "with importing(): os.kill(os.getpid(), signal.SIGINT)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (run.returncode, run.stderr) == (130, "calibrator: interrupted; nothing is kept of what was under way\n")
