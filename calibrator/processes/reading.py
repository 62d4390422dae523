"""Reading of foreign files in worker processes: a file that hangs or kills its reader costs that file and no more.

Workers leave Ctrl-C to the parent, and end when the parent does, whatever ended it.
"""

import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from calibrator.processes.crew import crew_of
from calibrator.processes.held_interrupts import interrupts_held, noticed_interrupts
from calibrator.processes.messages import Raised, Unread

__all__ = ["TIME_LIMIT_S", "read_in_processes"]

TIME_LIMIT_S = 600.0
"""A day's log is read in seconds; what takes so long never ends, or would hold up a fleet. [s]"""
AHEAD_PER_WORKER = 4
"""Files read before it is the turn of their results: others go on while one takes long, and few wait in memory."""

_Source = TypeVar("_Source")
_Content = TypeVar("_Content")


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
        noticed_interrupts() as noticed,
        _own_folder() as folder,
        crew_of(read, folder, workers, limit_s) as crew,
    ):
        waiting = enumerate(sources)
        done: dict[int, _Content | Unread | Raised] = {}
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


@contextmanager
def _own_folder() -> Iterator[str]:
    """A folder that is gone after the block. Ctrl-C waits while it is made and removed, so that nothing is left."""
    with interrupts_held():
        folder = tempfile.TemporaryDirectory(prefix="calibrator-")
    try:
        yield folder.name
    finally:
        with interrupts_held():
            folder.cleanup()


def _result(outcome: "_Content | Unread | Raised") -> "_Content | Unread":
    if isinstance(outcome, Raised):
        raise outcome.error
    return outcome
