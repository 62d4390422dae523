"""Computing in worker processes: they leave Ctrl-C to this one, as each would print a traceback."""

import signal
import warnings
from collections.abc import Iterable, Iterator
from typing import Any

from joblib import Parallel

from calibrator.errors import FleetError

__all__ = ["in_processes"]


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
