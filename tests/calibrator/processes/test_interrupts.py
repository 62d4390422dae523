import signal
import subprocess
import sys
from collections.abc import Callable

import pytest

from calibrator.processes.interrupts import ENDED, importing, interrupted_message


def handler() -> "Callable[..., object] | int | None":
    return signal.getsignal(signal.SIGINT)


@pytest.mark.parametrize("before", [signal.default_int_handler, signal.SIG_IGN])
def test_ctrl_c_is_handled_as_before_afterwards_and_stays_ignored(before: "Callable[..., object] | int") -> None:
    of_pytest = signal.signal(signal.SIGINT, before)
    try:
        with importing():
            assert (handler() is before) == (before is signal.SIG_IGN)
        assert handler() is before
    finally:
        signal.signal(signal.SIGINT, of_pytest)


def test_message_says_whether_a_command_goes_on_where_it_was() -> None:
    goes_on = "; it goes on with what it had read"
    for arguments, kept in ((["--debug", "import", "x"], goes_on), (["simulate", "--out", "import"], ""), ([], "")):
        assert interrupted_message(arguments) == f"calibrator: interrupted; run the same command again{kept}"
    assert interrupted_message([], ENDED) == "calibrator: ended by SIGTERM; run the same command again"


def test_ctrl_c_while_libraries_are_imported_ends_the_program_with_one_line() -> None:
    code = (
        "import os, signal, sys\n"
        "from calibrator.processes.interrupts import importing\n"
        "sys.argv = ['calibrator', 'summarise']\n"
        "with importing(): os.kill(os.getpid(), signal.SIGINT)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    line = "calibrator: interrupted; run the same command again; it goes on with what it had read\n"
    assert (run.returncode, run.stderr) == (130, line)
