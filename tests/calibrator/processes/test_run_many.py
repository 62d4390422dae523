"""One function over many items, wherever it runs: order, bounded memory, limits, lost workers, Ctrl-C."""

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import pytest

from calibrator.errors import DriveError, FleetError
from calibrator.processes.run_many import AHEAD_PER_WORKER, Failed, Workers, run_many, try_many

ONE, TWO = Workers(), Workers(processes=2)
LIMIT_S = 4.0


def doubled(number: int) -> int:
    return 2 * number


def hostile(number: int, endless: Path) -> int:
    if number == 1:
        endless.read_text()
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 3:
        os._exit(7)
    if number == 4:
        return len(bytearray(1 << 60))
    if number == 5:
        raise DriveError("too short")
    if number == 6:
        return 1 // 0
    os.kill(os.getpid(), signal.SIGINT)  # of no effect: Ctrl-C is the parent's
    return number


CAUSES = [
    "reading took more than 4 s and was ended; remove the file if it is damaged, cut it",
    "the process that read it was killed by SIGKILL; remove the file if it is damaged",
    "the process that read it ended, or was killed; ",
    "not enough memory to read it; ",
    "too short",
    "internal error: ZeroDivisionError: ",
]
"""Why the items 1 to 6 are lost."""


def refused(number: int) -> int:
    if number > 1:
        raise ValueError(f"number {number}")
    return number


def dying_once(number: int, folder: Path) -> int:
    mark = folder / str(number)
    if number == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def waiting(number: int, folder: Path) -> int:
    tempfile.mkstemp()
    (folder / "new").write_text(str(os.getpid()))
    (folder / "new").rename(folder / "note")
    time.sleep(1000 if number else 0)
    return number


def children() -> list[multiprocessing.process.BaseProcess]:
    return [child for child in multiprocessing.active_children() if isinstance(child, ForkServerProcess)]


def is_running(pid: int) -> bool:
    """Whether this process still runs; one that has ended but was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(condition: Callable[[], bool]) -> None:
    for _ in range(1000):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("it did not come about")


@pytest.mark.parametrize("workers", [ONE, TWO])
def test_results_come_in_the_order_of_the_items(workers: Workers) -> None:
    assert list(run_many(abs, range(12), workers)) == list(range(12))
    assert list(try_many(doubled, range(12), workers)) == [(number, 2 * number) for number in range(12)]
    assert list(try_many(doubled, [], workers)) == []


def test_number_of_items_taken_in_advance_is_bounded() -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for number in range(1000):
            taken.append(number)
            yield number

    with closing(try_many(doubled, items(), TWO)) as results:
        for number in range(20):
            assert next(results) == (number, 2 * number)
            assert len(taken) <= number + 1 + AHEAD_PER_WORKER * 2
        assert children()
    assert not children()


def require_failing_items_affect_no_others(workers: Workers, folder: Path, knows_signals: bool = True) -> None:
    os.mkfifo(folder / "endless")
    read = partial(hostile, endless=folder / "endless")
    first, *failed, last = (outcome for _, outcome in try_many(read, range(8), workers, limit_s=LIMIT_S))
    assert (first, last) == (0, 7)
    for outcome, cause in zip(failed, CAUSES, strict=True):
        assert isinstance(outcome, Failed)
        assert outcome.reason.startswith(cause if knows_signals else cause.partition(" by ")[0])


def test_failing_or_crashing_items_do_not_affect_others(tmp_path: Path) -> None:
    handler, mask = signal.getsignal(signal.SIGINT), signal.pthread_sigmask(signal.SIG_BLOCK, [])
    require_failing_items_affect_no_others(TWO, tmp_path)
    assert (signal.getsignal(signal.SIGINT), signal.pthread_sigmask(signal.SIG_BLOCK, [])) == (handler, mask)


def test_item_is_tried_again_after_its_worker_was_killed_once(tmp_path: Path) -> None:
    assert list(run_many(partial(dying_once, folder=tmp_path), range(5), TWO)) == list(range(5))


def test_idle_workers_that_are_killed_are_replaced() -> None:
    with closing(run_many(doubled, iter(range(40)), TWO)) as results:
        assert next(results) == 0
        time.sleep(0.5)
        for child in children():
            os.kill(child.pid or 0, signal.SIGKILL)
        assert list(results) == [2 * number for number in range(1, 40)]


def killing_itself(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_item_that_kills_its_worker_twice_ends_the_run_with_a_reason() -> None:
    how = "was killed by SIGKILL|ended, or was killed"  # the latter where multiprocessing does not know
    with pytest.raises(FleetError, match=rf"a worker process ({how}), and another one again"):
        list(run_many(killing_itself, range(2), TWO))


@pytest.mark.parametrize("workers", [ONE, TWO])
def test_error_of_an_item_is_raised_when_its_result_is_due(workers: Workers) -> None:
    with closing(run_many(refused, range(5), workers)) as results:
        assert [next(results) for _ in range(2)] == [0, 1]
        with pytest.raises(ValueError, match="number 2"):
            next(results)
    assert not children()


LIMITED = """
from calibrator.processes.run_many import Workers, try_many
print(list(try_many(abs, [-1, -2], Workers())))
"""


def test_try_many_works_under_a_memory_limit_of_the_shell() -> None:
    command = ["bash", "-c", 'ulimit -d 3000000 && exec "$@"', "-", sys.executable, "-c", LIMITED]
    assert subprocess.run(command, capture_output=True, check=True, text=True).stdout == "[(-1, 1), (-2, 2)]\n"


PARENT = """
import sys, tempfile
from functools import partial
from pathlib import Path
tempfile.tempdir = sys.argv[2]
from calibrator.processes.run_many import Workers, try_many
from tests.calibrator.processes.test_run_many import waiting
print(list(try_many(partial(waiting, folder=Path(sys.argv[1])), range(9), Workers(processes=2))))
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_when_their_parent_process_ends(tmp_path: Path, short_folder: Path, how: signal.Signals) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)  # it has no __main__ guard: workers must not run it again
    path = os.pathsep.join([str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(script), str(tmp_path), str(short_folder)]
    environment = {**os.environ, "PYTHONPATH": path}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, start_new_session=True) as parent:
        wait_until((tmp_path / "note").exists)
        time.sleep(0.5)
        os.killpg(parent.pid, how)
        assert parent.stderr is not None
        errors = parent.stderr.read().decode()
    wait_until(lambda: not is_running(int((tmp_path / "note").read_text())))
    if how is signal.SIGINT:
        assert errors.count("Traceback") == errors.count("KeyboardInterrupt") == 1
        assert list(short_folder.iterdir()) == []
