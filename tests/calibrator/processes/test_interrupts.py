import signal
from collections.abc import Callable

import numpy as np
from joblib import delayed

from calibrator.drive import Array
from calibrator.processes.computing import in_processes
from calibrator.processes.interrupts import importing


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


def test_a_program_started_without_ctrl_c_stays_so() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with importing():
            assert handler() is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
