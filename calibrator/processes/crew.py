"""Worker processes as their parent has them.

Every worker has a pipe of its own and shares nothing with the others. So one that dies at any moment, even while it
hands over what it has read, takes nothing else with it. A worker whose file takes too long is killed, with all that it
started; another takes its place.
"""

import multiprocessing
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext
from types import ModuleType
from typing import Any, Generic, TypeVar

from calibrator.processes.held_interrupts import interrupts_held
from calibrator.processes.messages import Begun, Raised, Unread, died, too_long
from calibrator.processes.worker import work

__all__ = ["crew_of"]

START_S = 120.0
"""Time for a worker to start on a busy machine, which does not count as reading. [s]"""
LOOK_UP_S = 1.0
"""Time after which a Ctrl-C is heeded that a library has swallowed as it was interrupted. [s]"""
PRELOADED = ["numba", "numpy", "pyarrow.parquet", "threadpoolctl"]
"""Slow to import, so imported once, for all workers. Not this package: the fork server may find another copy of it."""

_Source = TypeVar("_Source")
_Content = TypeVar("_Content")


@dataclass(kw_only=True)
class Crew(Generic[_Source, _Content]):
    """Workers that read sources, some idle and some busy."""

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

    def collect(self) -> "dict[int, _Content | Unread | Raised]":
        """Wait for what happens next; results by the number of their source, none if one was begun."""
        patience_s = min(worker.deadline_s for worker in self.busy.values()) - time.monotonic()
        heard = set(wait(list(self.busy), min(max(patience_s, 0.0), LOOK_UP_S)))
        now_s = time.monotonic()
        late = [w for pipe, w in self.busy.items() if pipe not in heard and w.deadline_s <= now_s]
        results = self._messages([worker for pipe, worker in self.busy.items() if pipe in heard])
        return results | dict([self._end(worker, too_long(self.limit_s)) for worker in late])

    def _messages(self, workers: "list[_Worker]") -> "dict[int, _Content | Unread | Raised]":
        results: dict[int, _Content | Unread | Raised] = {}
        for worker in workers:
            try:
                message = worker.pipe.recv()
            except (EOFError, OSError):
                worker.process.join()
                results |= [self._end(worker, died(worker.process.exitcode))]
                continue
            if isinstance(message, Begun):
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
        process = context.Process(target=work, args=(theirs, pickle.dumps(read), folder), daemon=True)
        main = sys.modules["__main__"]
        with interrupts_held():
            sys.modules["__main__"] = ModuleType("__main__")  # or the worker would run the user's script once more
            try:
                process.start()
            finally:
                sys.modules["__main__"] = main
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


@contextmanager
def crew_of(read: Callable[[Any], Any], folder: str, size: int, limit_s: float) -> "Iterator[Crew[Any, Any]]":
    """Workers as they are needed, so many at most; all are gone after the block."""
    crew: Crew[Any, Any] = Crew(read=read, folder=folder, size=size, limit_s=limit_s)
    try:
        yield crew
    finally:
        for worker in [*crew.idle, *crew.busy.values()]:
            worker.end()


def _context() -> ForkServerContext:
    """Processes that are forked from a clean one: threads of this process are no danger, and a start takes little."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context
