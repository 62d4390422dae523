"""One function over many items, in processes of this machine or on a Dask cluster; results come in order.

No result depends on where it was computed, so a run gives the same bytes with any number of workers. Processes leave
Ctrl-C to this one, as each would print a traceback.
"""

import logging
import signal
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import islice
from typing import Any, TypeVar

from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from calibrator.errors import FleetError

__all__ = ["Workers", "in_processes"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

AHEAD_PER_WORKER = 3
"""Items that are given to a cluster before it is the turn of their results: enough that no worker waits. [1]"""
TIMEOUT_S = 10.0
"""Within which a scheduler must answer. [s]"""
AGAIN = "; the same command, run again, goes on where it stopped"
TALKATIVE = ("distributed", "distributed.client", "tornado.application", "asyncio")
"""Loggers that print tracebacks of what is told in one line here."""


def in_processes(tasks: Iterable[Any], *, workers: int) -> Iterator[Any]:
    """Results of tasks in their order, from worker processes that leave Ctrl-C to this one.

    Parameters
    ----------
    tasks : iterable
        Of ``joblib.delayed`` calls.
    workers : int
        Number of processes; 1 is this process.

    Yields
    ------
    object
        What the calls return.

    Raises
    ------
    FleetError
        If a process died.
    """
    # A worker that has waited for long ends itself and is replaced: nothing that a user should read of. Where warnings
    # are errors, the thread that replaces it would end instead, and the results never come.
    warnings.filterwarnings("ignore", message="A worker stopped while some jobs", category=UserWarning)
    # Not through shared files (max_nbytes), which would outlive a process that is killed.
    parallel = Parallel(n_jobs=workers, return_as="generator", max_nbytes=None)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        results: Iterator[Any] = parallel(tasks)  # starts the workers, which inherit that SIGINT is ignored
    finally:
        signal.signal(signal.SIGINT, before)
    return _of_living_workers(results)


def _of_living_workers(results: Iterator[Any]) -> Iterator[Any]:
    """Results; a worker that died is told in words."""
    from joblib.externals.loky.process_executor import TerminatedWorkerError  # noqa: PLC0415 (slow to import)

    try:
        yield from results
    except TerminatedWorkerError:
        raise FleetError(
            "a worker process was killed, as by a lack of memory; run the same command again, with fewer --workers if "
            "it was memory"
        ) from None


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Where a run computes.

    Attributes
    ----------
    processes : int
        Number of processes on this machine.
    scheduler : str or None
        Address of a Dask scheduler, ``tcp://host:port``, whose workers are used instead. FleetError if Dask is missing.
    """

    processes: int
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.scheduler is not None and find_spec("distributed") is None:
            raise FleetError("--scheduler needs Dask: pip install 'hv-current-correction[cluster]'")

    def map(self, function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
        """Apply a function to each item, taken as they are needed; results come in the order of the items.

        The function goes to other processes: one of module level, or a partial of such a function. FleetError if a
        process died, or the cluster cannot be reached.
        """
        if self.scheduler is not None:
            return _on_cluster(self.scheduler, function, items)
        return in_processes((delayed(_alone)(function, item) for item in items), workers=self.processes)


def _alone(function: Callable[[Any], Any], item: Any) -> Any:
    """One thread: the processes share the cores, and sums do not depend on how many there are."""
    _one_thread()
    return function(item)


@cache
def _one_thread() -> threadpool_limits:
    """Limit this process for good: the limit is the process's, and other threads of it may compute as well."""
    return threadpool_limits(1)


def _on_cluster(scheduler: str, function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    from distributed import CancelledError, Client, KilledWorker  # noqa: PLC0415 (an extra)
    from distributed.comm.core import CommClosedError  # noqa: PLC0415

    with _silenced(TALKATIVE):
        try:
            client = Client(scheduler, timeout=TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = str(error).partition("\n")[0]
            raise FleetError(
                f"{scheduler}: no Dask scheduler answers: {reason}; start one with 'dask scheduler'"
            ) from None
        with client:
            try:
                client.wait_for_workers(1, timeout=TIMEOUT_S)
            except TimeoutError:
                raise FleetError(f"{scheduler}: the scheduler has no worker; start some with 'dask worker'") from None
            try:
                yield from _in_turn(client, function, items)
            except KilledWorker:
                why = f"workers of the cluster died again and again, as by a lack of memory; look at their logs{AGAIN}"
                raise FleetError(f"{scheduler}: {why}") from None
            except (CancelledError, CommClosedError):
                why = f"the scheduler is gone; start it and its workers again{AGAIN}"
                raise FleetError(f"{scheduler}: {why}") from None


@contextmanager
def _silenced(names: Iterable[str]) -> Iterator[None]:
    """While the block runs, some loggers say nothing."""
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _in_turn(client: Any, function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """Results in the order of the items; as many are given out ahead as the workers there are now need."""
    waiting, futures = iter(items), deque[Any]()
    while True:
        ahead = AHEAD_PER_WORKER * max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)
        more = islice(waiting, max(ahead - len(futures), 0))
        futures.extend(client.submit(_alone, function, item, pure=False) for item in more)
        if not futures:
            return
        result: _Result = futures.popleft().result()
        yield result
