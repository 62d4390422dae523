import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from joblib import delayed

from calibrator.drive import Array
from calibrator.processes.computing import in_processes
from calibrator.processes.held_interrupts import interrupts_held
from calibrator.processes.interrupts import importing, interrupted_message, terminated_message


def seen_by_worker(values: Array) -> tuple[float, bool, bool]:
    return float(values.sum()), isinstance(values, np.memmap), signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_results_come_in_the_order_of_the_tasks() -> None:
    tasks = (delayed(divmod)(k, 3) for k in range(10))
    assert list(in_processes(tasks, workers=2)) == [divmod(k, 3) for k in range(10)]


def test_workers_leave_ctrl_c_to_the_parent_and_large_arrays_leave_no_files() -> None:
    values = np.ones(500_000)  # 4 MB: joblib would share it through a file
    results = list(in_processes((delayed(seen_by_worker)(values) for _ in range(2)), workers=2))
    assert results == [(500_000.0, False, True)] * 2


def handler() -> "Callable[..., object] | int | None":
    return signal.getsignal(signal.SIGINT)


def test_ctrl_c_is_handled_as_before_afterwards() -> None:
    before = handler()
    with importing():
        assert handler() is not before
    list(in_processes((delayed(abs)(1) for _ in range(2)), workers=2))
    assert handler() is before


def test_ctrl_c_waits_for_the_end_of_the_block_even_where_another_thread_takes_it() -> None:
    over, reached, interrupted = threading.Event(), False, False
    threading.Thread(target=over.wait, daemon=True).start()
    before = handler()
    try:
        with interrupts_held():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)
            reached = True
    except KeyboardInterrupt:
        interrupted = True
    finally:
        over.set()
    assert (reached, interrupted) == (True, True)
    assert handler() is before


def test_a_program_started_without_ctrl_c_stays_so() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with importing():
            assert handler() is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("name", ["import", "summarise", "calibrate"])
def test_commands_that_go_on_are_to_be_run_again(name: str) -> None:
    said = "run the same command again; it goes on with what it had read or computed"
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
