import ctypes
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

from calibrator.processes.messages import Unread
from calibrator.processes.reading import AHEAD_PER_WORKER, read_in_processes

LIMIT_S = 2.0
TIME_LIMIT = (
    "reading took more than 2 s and was ended; remove the file if it is damaged, cut it if it is long, or allow"
)


@pytest.fixture
def endless(tmp_path: Path) -> Path:
    """A file that opens, never has a byte and never ends."""
    path = tmp_path / "endless"
    os.mkfifo(path)
    return path


def text_of(path: Path) -> str:
    return path.read_text()


def doubled(number: int) -> int:
    return 2 * number


def slower_when_first(number: int) -> int:
    time.sleep(0.2 if number == 0 else 0.0)
    return number


def killed(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 2:
        ctypes.string_at(0)
    if number == 3:
        os._exit(7)
    return number


def refused(number: int) -> int:
    if number > 1:
        raise ValueError(f"number {number}")
    return number


def readers() -> list[multiprocessing.process.BaseProcess]:
    """Processes that read; those that another test has left to compute wait for more to do."""
    return [child for child in multiprocessing.active_children() if isinstance(child, ForkServerProcess)]


def not_to_be_sent(number: int) -> Callable[[], int]:
    return lambda: number


def too_large(number: int) -> int:
    return len(bytearray(1 << 60)) if number else 0


def many_bytes(number: int, marker: Path) -> bytes:
    if number == 1:
        marker.touch()
        return bytes(1 << 28)
    return bytes(number)


def interrupted(number: int) -> int:
    os.kill(os.getpid(), signal.SIGINT)
    return number


def started_and_left(endless: Path, note: Path) -> str:
    """Leave a process and a temporary file behind."""
    process = subprocess.Popen(["sleep", "1000"])
    handle, name = tempfile.mkstemp()
    os.close(handle)
    (note.parent / "note.new").write_text(f"{process.pid} {name}")
    (note.parent / "note.new").rename(note)
    return endless.read_text()


def is_running(pid: int) -> bool:
    """Whether there is such a process that has not ended; one that has may wait to be asked how."""
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


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_sources(workers: int) -> None:
    assert list(read_in_processes(slower_when_first, range(12), workers=workers)) == list(range(12))


def test_of_no_sources_there_are_no_results() -> None:
    assert list(read_in_processes(doubled, [], workers=2)) == []


@pytest.mark.parametrize("workers", [1, 2])
def test_no_more_sources_are_taken_than_are_worked_on_soon(workers: int) -> None:
    taken: list[int] = []

    def sources() -> Iterator[int]:
        for number in range(1000):
            taken.append(number)
            yield number

    with closing(read_in_processes(doubled, sources(), workers=workers)) as results:
        for number in range(20):
            assert next(results) == 2 * number
            assert len(taken) <= number + 1 + AHEAD_PER_WORKER * workers


@pytest.mark.parametrize("workers", [1, 2])
def test_a_file_that_never_ends_costs_itself_only(endless: Path, tmp_path: Path, workers: int) -> None:
    good = tmp_path / "good"
    good.write_text("good")
    first, second, third = read_in_processes(text_of, [good, endless, good], workers=workers, limit_s=LIMIT_S)
    assert (first, third) == ("good", "good")
    assert isinstance(second, Unread)
    assert TIME_LIMIT in second.reason


@pytest.mark.parametrize("workers", [1, 2])
def test_a_process_that_dies_costs_its_file_only(workers: int) -> None:
    results = list(read_in_processes(killed, range(6), workers=workers))
    assert results[::4] + results[5:] == [0, 4, 5]
    causes = ["was killed by SIGKILL; ", "was killed by SIGSEGV; ", "ended with code 7; "]
    for result, cause in zip(results[1:4], causes, strict=True):
        assert isinstance(result, Unread)
        assert f"the process that read it {cause}" in result.reason


def test_processes_killed_at_rest_or_while_they_hand_over_cost_one_file(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    with closing(read_in_processes(partial(many_bytes, marker=marker), range(8), workers=2)) as results:
        assert next(results) == b""
        wait_until(marker.exists)
        for process in readers():
            os.kill(process.pid or 0, signal.SIGKILL)
            process.join()
        rest = list(results)
    assert isinstance(rest[0], Unread)
    assert rest[-2:] == [bytes(6), bytes(7)]


def test_want_of_memory_costs_the_file_only() -> None:
    small, large = read_in_processes(too_large, [0, 1], workers=1)
    assert small == 0
    assert isinstance(large, Unread)
    assert "not enough memory to read it; " in large.reason


def test_an_error_of_the_reader_is_raised_here_at_its_turn() -> None:
    with closing(read_in_processes(refused, range(5), workers=2)) as results:
        assert [next(results) for _ in range(2)] == [0, 1]
        with pytest.raises(ValueError, match="number 2") as caught:
            next(results)
    assert "in refused" in caught.value.__notes__[0]
    assert not readers()


def test_what_cannot_be_handed_over_is_an_error_too() -> None:
    with pytest.raises(RuntimeError, match="cannot hand over <function not_to_be_sent"):
        list(read_in_processes(not_to_be_sent, [0], workers=1))


def test_workers_leave_ctrl_c_to_the_parent_which_handles_it_as_before() -> None:
    before, mask = signal.getsignal(signal.SIGINT), signal.pthread_sigmask(signal.SIG_BLOCK, [])
    assert list(read_in_processes(interrupted, range(4), workers=2)) == [0, 1, 2, 3]
    assert (signal.getsignal(signal.SIGINT), signal.pthread_sigmask(signal.SIG_BLOCK, [])) == (before, mask)


def test_no_process_stays_when_nobody_wants_more_results(endless: Path, tmp_path: Path) -> None:
    good = tmp_path / "good"
    good.write_text("good")
    with closing(read_in_processes(text_of, [good, endless, endless], workers=2)) as results:
        assert next(results) == "good"
        assert readers()
    assert not readers()


def test_what_a_killed_reader_started_and_left_goes_with_it(endless: Path, tmp_path: Path) -> None:
    note = tmp_path / "note"
    (result,) = read_in_processes(partial(started_and_left, note=note), [endless], workers=1, limit_s=LIMIT_S)
    assert isinstance(result, Unread)
    pid, name = note.read_text().split()
    assert not Path(name).exists()
    wait_until(lambda: not is_running(int(pid)))


PARENT = """
import sys
from functools import partial
from pathlib import Path
from calibrator.processes.reading import read_in_processes
from tests.calibrator.processes.test_reading_processes import started_and_left

if __name__ == "__main__":
    list(read_in_processes(partial(started_and_left, note=Path(sys.argv[2])), [Path(sys.argv[1])], workers=1))
"""


def test_a_reader_ends_with_a_parent_that_is_killed(endless: Path, tmp_path: Path) -> None:
    script, note = tmp_path / "parent.py", tmp_path / "note"
    script.write_text(PARENT)
    path = os.pathsep.join([str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(script), str(endless), str(note)]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}) as parent:
        wait_until(note.exists)
        parent.kill()
    pid, _ = note.read_text().split()
    wait_until(lambda: not is_running(int(pid)))
