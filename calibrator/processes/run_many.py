"""Apply one function to many items: in this process, in processes of this machine, or on a Dask cluster.

Results come in the order of the items and do not depend on where they were computed. A few items per worker are in
flight, so memory does not grow with the number of items. An item whose worker dies gets a second attempt. An item that
kills its process twice, or exceeds its time limit, is lost, and the others go on.

Every worker process is a pebble pool of one process: processes of one pool share pipes and locks, so killing one can
break the others.
"""

import gc
import logging
import math
import multiprocessing
import os
import pickle
import resource
import signal
import socket
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.util import find_spec
from itertools import islice, takewhile
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext, ForkServerProcess
from queue import Empty, LifoQueue
from types import ModuleType
from typing import Any, TypeVar

from pebble import ProcessExpired, ProcessPool
from threadpoolctl import threadpool_limits

from calibrator.errors import FleetError, internal_error
from calibrator.terminal.options import TIME_LIMIT_S
from calibrator.terminal.progress import progress_bar
from ecu_node import __version__
from ecu_node.errors import UserError
from ecu_node.program import load_python_can, say_error

__all__ = ["Failed", "Workers", "run_many", "try_many", "try_many_shown"]

AHEAD_PER_WORKER = 4
"""Items in flight per worker: enough to go on while one takes long, few enough results to keep in memory. [1]"""
CONNECT_S, RETURN_S = 10.0, 60.0
"""Time for the scheduler's first answer; time for it and a worker to come back after they were lost. [s]"""
SENT_AT_ONCE = 100
"""Items per message to the scheduler; a message should stay below 10 MB. [1]"""
COUNT_EVERY_S = 1.0
"""Time between two requests for the number of workers, which may come and go. [s]"""
MEMORY_SHARE, LEAST_MEMORY_BYTES = 0.8, 1 << 30
"""Share of the machine's memory for all reading processes together; least memory limit of each. [1], [byte]"""
PRELOADED = [
    "numba",
    "numpy",
    "pandas",
    "pyarrow.parquet",
    "rich",
    "scipy.ndimage",
    "threadpoolctl",
    "typer",
]
"""Modules that are slow to import, so the fork server imports them once for all processes. This package is not among
them, as the fork server may find another copy of it; nor is cantools, as its import would make python-can import
asammdf, see :func:`.load_python_can`."""
LARGEST_GREETING = 1 << 20
"""Largest first message of a Dask scheduler. [byte]"""
MEGABYTE = 1_000_000
AGAIN = ", and run the same command again"
REMEDY = "remove the file if it is damaged, cut it if it is long"

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Where the work is done: on processes of this machine, or on a Dask cluster.

    Attributes
    ----------
    processes : int
        Number of processes on this machine.
    scheduler : str or None
        Address of a Dask scheduler, ``tcp://host:port``, whose workers are used instead. FleetError is raised if Dask
        is missing.
    """

    processes: int = 1
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.scheduler is not None and find_spec("distributed") is None:
            raise FleetError("--scheduler needs Dask: pip install 'hv-current-correction[cluster]'")


@dataclass(frozen=True, kw_only=True)
class Failed:
    """An item without a result.

    Attributes
    ----------
    reason : str
        One line that says what happened and what to do; for a fault of the program it begins with
        :data:`.INTERNAL_ERROR`.
    """

    reason: str


def run_many(
    function: Callable[[_Item], _Result], items: Iterable[_Item], workers: Workers
) -> Generator[_Result, None, None]:
    """Apply a function to each item; its exceptions are raised here, when the result of the item is due.

    Parameters
    ----------
    function : callable
        A function at module level, or a partial of one, because it is sent to other processes.
    items : iterable
        The arguments, taken as they are needed.
    workers : Workers
        Where to compute; a single process on this machine means the current process.

    Yields
    ------
    object
        Result of the function for each item, in the order of the items.

    Raises
    ------
    FleetError
        If an item killed its process twice, or the cluster cannot be reached.
    """
    if workers.scheduler is None and workers.processes == 1:
        with threadpool_limits(1):  # as in worker processes, because sums depend on the number of threads
            yield from map(function, items)
        return
    with closing(_outcomes(function, items, workers, limit_s=None)) as outcomes:
        for _, outcome in outcomes:
            if isinstance(outcome, Failed):
                raise FleetError(f"{outcome.reason}; run the same command again")
            yield outcome


def try_many(
    function: Callable[[_Item], _Result], items: Iterable[_Item], workers: Workers, *, limit_s: float = TIME_LIMIT_S
) -> "Generator[tuple[_Item, _Result | Failed], None, None]":
    """Apply a function to each item, always in other processes, because the items are files that cannot be trusted.

    Parameters
    ----------
    function, items, workers : callable, iterable, Workers
        What to apply to what, and where, as for :func:`run_many`.
    limit_s : float
        Longest time for one item. [s]

    Yields
    ------
    item : object
        The items in their order.
    outcome : object or Failed
        Result of the function, or why there is none: an error of the data, time or memory above the limits, or a fault
        of the program. The other items go on.
    """
    yield from _outcomes(partial(_attempt, function), items, workers, limit_s=limit_s)


def try_many_shown(
    function: Callable[[_Item], _Result],
    items: Iterable[_Item],
    workers: Workers,
    *,
    limit_s: float,
    label: str,
    size: int,
    size_of: Callable[[_Item], int],
) -> "Generator[tuple[_Item, _Result | Failed], None, None]":
    """Apply a function to each item as :func:`try_many`, with a progress bar; `size` is that of all items. [byte]"""
    done, total = 0, size // MEGABYTE + 1
    with (
        progress_bar(label, total, "MB") as progress,
        closing(try_many(function, items, workers, limit_s=limit_s)) as outcomes,
    ):
        for item, outcome in outcomes:
            yield item, outcome
            done += size_of(item)
            progress(done / MEGABYTE)
        progress(total)


def _attempt(function: Callable[[_Item], _Result], item: _Item) -> "_Result | Failed":
    try:
        return function(item)
    except UserError as error:
        return Failed(reason=str(error))
    except MemoryError:
        return Failed(reason=f"not enough memory to read it; {REMEDY}, or use fewer --workers")
    except Exception as error:  # noqa: BLE001 (a fault of the program is reported with its item, and the others go on)
        return Failed(reason=internal_error(error))


def _outcomes(
    function: Callable[[Any], Any], items: Iterable[Any], workers: Workers, *, limit_s: float | None
) -> Generator[tuple[Any, Any], None, None]:
    job = _Job(function=pickle.dumps(function), limit_s=limit_s, version=__version__)
    if workers.scheduler is not None:
        yield from _on_cluster(workers.scheduler, job, items)
        return
    processes = _Processes(_memory_bytes() // workers.processes)
    waiting, futures = iter(items), deque[tuple[Any, Future[Any]]]()
    with ThreadPoolExecutor(workers.processes) as threads:
        try:
            while True:
                more = islice(waiting, AHEAD_PER_WORKER * workers.processes - len(futures))
                futures.extend((item, threads.submit(processes.run, job, item)) for item in more)
                if not futures:
                    return
                item, future = futures.popleft()
                yield item, future.result()
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
            processes.end()


@dataclass(frozen=True, kw_only=True)
class _Job:
    """A pickled function, and the longest time for one item [s]; None: no limit, as the data can be trusted."""

    function: bytes
    limit_s: float | None
    version: str


class _Processes:
    """A growing set of processes, each running one item at a time within a memory limit of its own."""

    def __init__(self, memory_bytes: int) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="calibrator-", ignore_cleanup_errors=True)
        self._memory_bytes = max(memory_bytes, LEAST_MEMORY_BYTES)
        self._idle: LifoQueue[_Process] = LifoQueue()
        self._all: list[_Process] = []
        resource_tracker.ensure_running()  # else the fork server starts it, and that would unblock SIGINT
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # all forked processes inherit the mask
        try:
            forkserver.set_forkserver_preload(PRELOADED)
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)

    def run(self, job: _Job, item: Any) -> Any:
        """Run the function on one item, in an idle or a new process; return its result, or why the item was lost."""
        try:
            process = self._idle.get_nowait()
        except Empty:
            process = _Process(self._folder.name, self._memory_bytes)
            self._all.append(process)
        try:
            return process.run(job, item)
        finally:
            self._idle.put(process)

    def end(self) -> None:
        """Kill all processes, and remove their temporary files."""
        for process in self._all:
            process.stop()
        for process in self._all:
            process.join()
        self._folder.cleanup()


class _Process:
    """One process, replaced when it dies or takes too long."""

    def __init__(self, folder: str, memory_bytes: int) -> None:
        self._folder, self._memory_bytes = folder, memory_bytes
        self._pool: Any = None
        self._job: _Job | None = None
        self._future: Any = None
        self._stopped = False

    def run(self, job: _Job, item: Any) -> Any:
        how = ""
        for _ in range(2):
            pool = self._pool_for(job)
            try:
                self._future = pool.schedule(_call, (item,), timeout=job.limit_s)
                if self._stopped:
                    self._future.cancel()
                return self._future.result()
            except CancelledError:
                self.join()  # the pool may have been started only after stop() was called
                raise
            except TimeoutError:
                if job.limit_s is None:  # without a limit, the function itself raised it
                    raise
                self.join()
                why = f"reading took more than {job.limit_s:g} s and was ended; {REMEDY}, or allow more with"
                return Failed(reason=f"{why} --time-limit")
            except (ProcessExpired, BrokenProcessPool) as error:
                code = getattr(error, "exitcode", 0)  # the exit code is not always known
                how = f"was killed by {signal.Signals(-code).name}" if code < 0 else "ended, or was killed"
            self.join()
        if job.limit_s is None:
            return Failed(reason=f"a worker process {how}, and another one again, as by a lack of memory")
        return Failed(reason=f"the process that read it {how}; {REMEDY}, or use fewer --workers if memory ran out")

    def _pool_for(self, job: _Job) -> Any:
        if self._stopped:
            raise CancelledError
        if self._pool is None or not self._pool.active or self._job != job:
            self.join()
            memory_bytes = None if job.limit_s is None else self._memory_bytes
            arguments = (dict(os.environ), self._folder, memory_bytes, job.function)
            self._pool = ProcessPool(max_workers=1, initializer=_begin, initargs=arguments, context=_Context())
            self._job = job
        return self._pool

    def stop(self) -> None:
        """Run no more items; a thread that waits for a result gets CancelledError."""
        self._stopped = True
        if self._future is not None:
            self._future.cancel()
        if self._pool is not None:
            self._pool.stop()

    def join(self) -> None:
        """Kill the process, and wait until it has ended."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.stop()
            pool.join()


class _ForkedProcess(ForkServerProcess):
    """A process that starts without running the user's script once more."""

    starting = threading.Lock()

    def start(self) -> None:
        with self.starting:
            main = sys.modules["__main__"]
            sys.modules["__main__"] = ModuleType("__main__")
            try:
                super().start()
            finally:
                sys.modules["__main__"] = main


class _Context(ForkServerContext):
    Process = _ForkedProcess


_pickled_function = b""


def _begin(environment: dict[str, str], folder: str, memory_bytes: int | None, function: bytes) -> None:
    """Set up a worker process. It must not raise: the process would be replaced again and again."""
    global _pickled_function  # noqa: PLW0603 (the process runs this function alone)
    _pickled_function = function
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = folder
    threading.Thread(target=_end_with_parent, daemon=True).start()
    load_python_can()  # first, as the readers' own import of python-can would take seconds
    _one_thread()
    with suppress(Exception):  # its imports shall not count as an item's time; an error comes again with the first item
        _loaded(function)
    if memory_bytes is not None:
        most = resource.getrlimit(resource.RLIMIT_DATA)[1]  # the limit of the user's shell
        resource.setrlimit(
            resource.RLIMIT_DATA, (memory_bytes if most == resource.RLIM_INFINITY else min(memory_bytes, most), most)
        )


def _call(item: Any) -> Any:
    return _loaded(_pickled_function)(item)


@lru_cache(maxsize=2)
def _loaded(function: bytes) -> Callable[[Any], Any]:
    loaded: Callable[[Any], Any] = pickle.loads(function)  # noqa: S301 (of the parent)
    return loaded


@lru_cache
def _one_thread() -> threadpool_limits:
    """Limit this process to one thread for good: processes share the cores, and sums depend on the thread count."""
    return threadpool_limits(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGKILL)


def _on_cluster(address: str, job: _Job, items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
    from distributed import KilledWorker  # noqa: PLC0415 (an extra)

    waiting, flight, futures = iter(items), deque[Any](), deque[Any]()  # futures: of the first items in flight
    workers, counted_s = 1, -math.inf
    with _silenced():
        client = _connect(address, CONNECT_S)
        try:
            while True:
                flight.extend(islice(waiting, max(AHEAD_PER_WORKER * workers - len(flight), 0)))
                if not flight:
                    return
                try:
                    if time.monotonic() - counted_s > COUNT_EVERY_S:
                        workers, counted_s = max(len(client.nthreads()), 1), time.monotonic()
                        continue  # take as many items as the workers need
                    while unsent := list(islice(flight, len(futures), len(futures) + SENT_AT_ONCE)):
                        futures.extend(client.map(partial(_on_worker, job), unsent, pure=False))
                    try:
                        error = futures[0].exception(timeout=CONNECT_S)  # waits for it
                        # many at a time, as each request to the scheduler costs milliseconds; others keep workers busy
                        done = list(takewhile(lambda future: future.status == "finished", islice(futures, workers)))
                        # with a time-out, as gather waits for a new worker if one ends before it hands its result over
                        fetch = partial(client.gather, done, asynchronous=True)
                        outcomes = client.sync(fetch, callback_timeout=RETURN_S)
                    except TimeoutError:
                        _wait_for_worker(client, address)
                        continue
                    if error is None and not done:
                        raise CancelledError  # the future was lost with its worker or scheduler
                except (CancelledError, OSError):
                    client.close(timeout=1)
                    client = _connect(address, RETURN_S, lost=True)
                    futures.clear()
                    continue
                if isinstance(error, KilledWorker):
                    why = "out of memory, or without this package"
                    outcomes = [Failed(reason=f"{address}: its workers ended one after the other, {why}")]
                elif error is not None:
                    futures[0].result()  # raises the error
                for outcome in outcomes:
                    futures.popleft()
                    yield flight.popleft(), outcome
        finally:
            client.close(timeout=1)


def _connect(address: str, patience_s: float, *, lost: bool = False) -> Any:
    from distributed import Client  # noqa: PLC0415 (an extra)

    try:
        _require_scheduler(address, patience_s)
        client = Client(address, timeout=patience_s, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        if lost:
            raise FleetError(f"{address}: the scheduler is gone; start it and its workers again{AGAIN}") from None
        raise FleetError(f"{address}: no Dask scheduler answers: {reason}; start one with 'dask scheduler'") from None
    try:
        _wait_for_worker(client, address)
    except FleetError:
        client.close()
        raise
    return client


def _require_scheduler(address: str, patience_s: float) -> None:
    """Raise OSError if another kind of server listens at the address, as Client would wait for ever for its answer."""
    from distributed.comm.addressing import get_address_host_port  # noqa: PLC0415 (an extra)

    if not address.startswith("tcp://"):
        return
    try:
        server = socket.create_connection(get_address_host_port(address), patience_s)
    except OSError:
        return  # Client waits for a scheduler to start, and says why none did
    with server:
        first = server.recv(8)  # a scheduler sends the first message, which begins with its length
    if not 0 < int.from_bytes(first, "little") < LARGEST_GREETING:
        raise OSError("another kind of server listens there")


def _wait_for_worker(client: Any, address: str) -> None:
    if not client.nthreads():
        say_error(f"calibrator: {address}: the scheduler has no worker now; waiting {RETURN_S:g} s for one")
    try:
        client.wait_for_workers(1, timeout=RETURN_S)
    except TimeoutError:
        advice = f"start some with 'dask worker' on machines with this package of this version{AGAIN}"
        raise FleetError(f"{address}: the scheduler has no worker; {advice}") from None


def _on_worker(job: _Job, item: Any) -> Any:
    """Run one item on a worker of a cluster; untrusted files are read in a process of its own, which it can kill."""
    if job.version != __version__:
        advice = f"install version {job.version} there"
        raise FleetError(f"a worker of the cluster has version {__version__} of hv-current-correction; {advice}")
    if job.limit_s is not None:
        return _own_processes().run(job, item)
    _one_thread()
    return _loaded(job.function)(item)


@lru_cache
def _own_processes() -> _Processes:
    from distributed import get_worker  # noqa: PLC0415

    multiprocessing.current_process().daemon = False  # a daemon could not start processes
    return _Processes(get_worker().memory_manager.memory_limit or _memory_bytes())


def _memory_bytes() -> int:
    return int(MEMORY_SHARE * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


@contextmanager
def _silenced() -> Iterator[None]:
    """Silence the loggers of Dask and asyncio in the block; they print tracebacks of errors reported here in a line."""
    names = ("distributed", "distributed.client", "tornado.application", "asyncio")
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        gc.collect()  # asyncio logs unfinished tasks when they are collected, so collect them while it is silent
        for logger, level in levels.items():
            logger.setLevel(level)
