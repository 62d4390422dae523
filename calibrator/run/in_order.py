"""One function over many items: results in the order of the items, from processes here or from a Dask cluster.

Nothing of a result depends on where or beside what it was computed; so it is the same for any number of workers.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

from joblib import delayed
from threadpoolctl import threadpool_limits

from calibrator.errors import FleetError
from calibrator.interrupts import in_processes

__all__ = ["Workers"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

AHEAD_PER_WORKER = 3
"""Items that are given to a cluster before it is the turn of their results: enough that no worker waits. [1]"""
TIMEOUT_S = 30.0
"""Within which a scheduler must answer. [s]"""


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Where a run computes.

    Attributes
    ----------
    processes : int
        Number of processes on this machine.
    scheduler : str or None
        Address of a Dask scheduler, ``tcp://host:port``, whose workers are used instead.
    """

    processes: int
    scheduler: str | None = None

    def map(self, function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
        """Apply a function to each item.

        Parameters
        ----------
        function : callable
            Of module level, or a partial of such a function, as it goes to other processes.
        items : iterable
            Taken as they are needed.

        Yields
        ------
        object
            Results, in the order of the items.

        Raises
        ------
        FleetError
            If a process died, or the cluster cannot be reached.
        """
        if self.scheduler is not None:
            yield from _on_cluster(self.scheduler, function, items)
            return
        from joblib.externals.loky.process_executor import TerminatedWorkerError  # noqa: PLC0415 (slow to import)

        try:
            yield from in_processes((delayed(_alone)(function, item) for item in items), workers=self.processes)
        except TerminatedWorkerError:
            raise FleetError(
                "a worker process was killed, as by a lack of memory; run the same command again to go on, "
                "with fewer --workers if it was memory"
            ) from None


def _alone(function: Callable[[Any], Any], item: Any) -> Any:
    """One thread: the processes share the cores, and sums do not depend on how many there are."""
    with threadpool_limits(1):
        return function(item)


def _on_cluster(scheduler: str, function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    try:
        from distributed import Client  # noqa: PLC0415 (an extra)
    except ImportError:
        raise FleetError("--scheduler needs Dask: pip install 'hv-current-correction[cluster]'") from None
    try:
        client = Client(scheduler, timeout=TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise FleetError(f"{scheduler}: no Dask scheduler answers: {error}; start one with 'dask scheduler'") from None
    with client:
        shared = client.scatter(function, broadcast=False, hash=False)
        ahead = AHEAD_PER_WORKER * max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)
        waiting = iter(items)
        futures = deque(client.submit(_alone, shared, item, pure=False) for item in islice(waiting, ahead))
        while futures:
            result = futures.popleft().result()
            futures.extend(client.submit(_alone, shared, item, pure=False) for item in islice(waiting, 1))
            yield result
