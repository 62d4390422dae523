"""Reading of foreign files in worker processes: a file that hangs or kills its reader costs that file and no more.

Every worker has a pipe of its own and shares nothing with the others. So one that dies at any moment, even while it
hands over what it has read, takes nothing else with it. A worker whose file takes too long is killed, with all that it
started; another takes its place. Workers leave Ctrl-C to the parent, and end when the parent does, whatever ended it.
"""

import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext
from typing import Any, Generic, TypeVar

from ecu_node.python_can import load_python_can

__all__ = ["TIME_LIMIT_S", "Unread", "read_in_processes"]

TIME_LIMIT_S = 600.0
"""A day's log is read in seconds; what takes so long never ends, or would hold up a fleet. [s]"""
START_S = 120.0
"""Time for a worker to start on a busy machine, which does not count as reading. [s]"""
LOOK_UP_S = 1.0
"""Time after which a Ctrl-C is heeded that a library has swallowed as it was interrupted. [s]"""
AHEAD_PER_WORKER = 4
"""Files read before it is the turn of their results: others go on while one takes long, and few wait in memory."""
PRELOADED = ["numba", "numpy", "pyarrow.parquet", "threadpoolctl"]
"""Slow to import, so imported once, for all workers. Not this package: the fork server may find another copy of it."""

_REMEDY = "remove the file if it is damaged, cut it if it is long"

_Source = TypeVar("_Source")
_Content = TypeVar("_Content")


@dataclass(frozen=True, kw_only=True)
class Unread:
    """A file that could not be read to its end.

    Attributes
    ----------
    reason : str
        What happened, and what to do; without the file's name.
    """

    reason: str


def read_in_processes(
    read: Callable[[_Source], _Content],
    sources: Iterable[_Source],
    *,
    workers: int,
    limit_s: float = TIME_LIMIT_S,
) -> "Generator[_Content | Unread, None, None]":
    """Read files in worker processes, never in this one.

    Parameters
    ----------
    read : callable
        Reads one source; of module level, or a partial of such a function, as it goes to other processes.
    sources : iterable
        What to read. No more of them are taken than :data:`AHEAD_PER_WORKER` says, and as many results kept.
    workers : int
        Number of processes.
    limit_s : float
        Longest time for one source. [s]

    Yields
    ------
    object or Unread
        What `read` returns, in the order of the sources, or why it did not return. What it raises is raised here, when
        it is the turn of its source.
    """
    with (
        _noticed_interrupts() as noticed,
        tempfile.TemporaryDirectory(prefix="calibrator-") as folder,
        _crew(read, folder, workers, limit_s) as crew,
    ):
        waiting = enumerate(sources)
        done: dict[int, _Content | Unread | _Raised] = {}
        turn = taken = 0
        while True:
            while taken - turn < AHEAD_PER_WORKER * workers and crew.has_room():
                number, source = next(waiting, (None, None))
                if number is None:
                    break
                crew.hand_out(number, source)
                taken = number + 1
            if turn == taken:
                return
            if turn in done:
                yield _result(done.pop(turn))
                turn += 1
            else:
                done |= crew.collect()
                if noticed():
                    raise KeyboardInterrupt


@dataclass(kw_only=True)
class _Crew(Generic[_Source, _Content]):
    """The workers of one call of :func:`read_in_processes`."""

    read: Callable[[_Source], _Content]
    folder: str
    size: int
    limit_s: float
    idle: "list[_Worker]" = field(default_factory=list)
    busy: "dict[Connection, _Worker]" = field(default_factory=dict)

    def has_room(self) -> bool:
        """Whether one more source can be worked on."""
        return len(self.busy) < self.size

    def hand_out(self, number: int, source: Any) -> None:
        """Give a source to a worker that is free, or to a new one."""
        while self.idle and not self.idle[-1].process.is_alive():
            self.idle.pop().end()
        worker = self.idle.pop() if self.idle else _Worker.start(self.read, self.folder)
        self.busy[worker.pipe] = worker
        worker.number, worker.deadline_s = number, time.monotonic() + START_S + self.limit_s
        with suppress(OSError):  # it died just now, which the pipe's end tells
            worker.pipe.send(source)

    def collect(self) -> "dict[int, _Content | Unread | _Raised]":
        """Wait for what happens next; results by the number of their source, none if one was begun."""
        patience_s = min(worker.deadline_s for worker in self.busy.values()) - time.monotonic()
        heard = set(wait(list(self.busy), min(max(patience_s, 0.0), LOOK_UP_S)))
        now_s = time.monotonic()
        late = [w for pipe, w in self.busy.items() if pipe not in heard and w.deadline_s <= now_s]
        results = self._messages([worker for pipe, worker in self.busy.items() if pipe in heard])
        return results | dict([self._end(worker, _too_long(self.limit_s)) for worker in late])

    def _messages(self, workers: "list[_Worker]") -> "dict[int, _Content | Unread | _Raised]":
        results: dict[int, _Content | Unread | _Raised] = {}
        for worker in workers:
            try:
                message = worker.pipe.recv()
            except (EOFError, OSError):
                worker.process.join()
                results |= [self._end(worker, _died(worker.process.exitcode))]
                continue
            if isinstance(message, _Begun):
                worker.deadline_s = time.monotonic() + self.limit_s
            else:
                self.idle.append(self.busy.pop(worker.pipe))
                results[worker.number] = message
        return results

    def _end(self, worker: "_Worker", reason: str) -> tuple[int, Unread]:
        del self.busy[worker.pipe]
        worker.end()
        return worker.number, Unread(reason=reason)


@dataclass(kw_only=True)
class _Worker:
    """One process, the parent's end of its pipe, and which source it works on until when."""

    process: multiprocessing.process.BaseProcess
    pipe: Connection
    number: int = -1
    deadline_s: float = 0.0

    @staticmethod
    def start(read: Callable[[Any], Any], folder: str) -> "_Worker":
        """Start a process. Ctrl-C waits until it is there, and never reaches it."""
        context = _context()
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, pickle.dumps(read), folder), daemon=True)
        with _interrupts_held():
            process.start()
        theirs.close()
        return _Worker(process=process, pipe=ours)

    def end(self) -> None:
        """Kill the process and all that it started."""
        if self.process.pid is not None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.join()
        self.pipe.close()


@dataclass(frozen=True, kw_only=True)
class _Begun:
    """A worker has begun to read: from now on its time counts."""


@dataclass(frozen=True, kw_only=True)
class _Raised:
    """What a reader raised."""

    error: BaseException


def _result(outcome: "_Content | Unread | _Raised") -> "_Content | Unread":
    if isinstance(outcome, _Raised):
        raise outcome.error
    return outcome


@contextmanager
def _crew(read: Callable[[Any], Any], folder: str, size: int, limit_s: float) -> "Iterator[_Crew[Any, Any]]":
    crew: _Crew[Any, Any] = _Crew(read=read, folder=folder, size=size, limit_s=limit_s)
    try:
        yield crew
    finally:
        for worker in [*crew.idle, *crew.busy.values()]:
            worker.end()


@contextmanager
def _noticed_interrupts() -> Iterator[Callable[[], bool]]:
    """Tell whether SIGINT came within the block, also if its KeyboardInterrupt never got here."""
    before, came = signal.getsignal(signal.SIGINT), threading.Event()
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield came.is_set
        return

    def notice(number: int, frame: Any) -> Any:
        came.set()
        return before(number, frame)

    signal.signal(signal.SIGINT, notice)
    try:
        yield came.is_set
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Within the block SIGINT waits; processes that are started in it never get one."""
    resource_tracker.ensure_running()  # its start, else within the block, would let SIGINT through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _context() -> ForkServerContext:
    """Processes that are forked from a clean one: threads of this process are no danger, and a start takes little."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context


def _work(pipe: Connection, pickled_read: bytes, folder: str) -> None:
    """What a worker does until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.setsid()  # a group of its own, so that it can be killed with what it starts
    tempfile.tempdir = folder
    threading.Thread(target=_end_with_parent, daemon=True).start()
    load_python_can()  # before the reader's modules are imported, with which they would take seconds
    read = pickle.loads(pickled_read)  # noqa: S301 (of the parent)
    with suppress(EOFError, ConnectionError):  # the parent is gone, or wants no more
        while True:
            source = pipe.recv()
            pipe.send(_Begun())
            _send(pipe, _outcome(read, source))


def _outcome(read: Callable[[Any], Any], source: Any) -> object:
    try:
        return read(source)
    except MemoryError:
        return Unread(reason=f"not enough memory to read it; {_REMEDY}, or use fewer --workers")
    except Exception as error:  # noqa: BLE001 (the parent raises it)
        error.add_note("".join(traceback.format_exception(error)))
        return _Raised(error=error)


def _send(pipe: Connection, outcome: object) -> None:
    """Hand over a result; one that cannot be is an error of the reader."""
    try:
        pipe.send(outcome)
    except (AttributeError, TypeError, pickle.PicklingError) as error:
        pipe.send(_Raised(error=RuntimeError(f"cannot hand over {outcome!r:.200}: {error}")))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.killpg(0, signal.SIGKILL)


def _too_long(limit_s: float) -> str:
    return f"reading took more than {limit_s:g} s and was ended; {_REMEDY}, or allow more with --time-limit"


def _died(code: int | None) -> str:
    """What to say of a worker that died, by its exit code."""
    how = f"ended with code {code}"
    if code is not None and code < 0:
        how = f"was killed by {signal.Signals(-code).name}"
    return f"the process that read it {how}; {_REMEDY}, or use fewer --workers if memory ran out"
