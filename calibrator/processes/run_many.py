"""Apply one function to many items: in this process, in processes of this machine, or on a Dask cluster.

Results come in the order of the items and do not depend on where they were computed. Only a few items per worker are
in flight, so memory does not grow with the number of items. If a worker dies, its item is tried a second time; an item
that kills its process twice, or exceeds its time limit, has no result, and the others go on.

Every worker process has its own pool of one process (pebble). The processes of one pool share pipes and locks, so
killing one of them can bring down the others.
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
"""Items in flight per worker: enough that others go on while one takes long, few enough to keep results small. [1]"""
CONNECT_S, RETURN_S = 10.0, 60.0
"""Longest wait for the first answer of a scheduler; for a lost scheduler to return, or for a worker to join. [s]"""
SENT_AT_ONCE = 100
"""Items in one message to the scheduler, which should stay below 10 MB. [1]"""
COUNT_EVERY_S = 1.0
"""Interval at which workers of the cluster are counted, as they come and go. [s]"""
MEMORY_SHARE, LEAST_MEMORY_BYTES = 0.8, 1 << 30
"""Share of the machine's memory for all reading processes together; least limit of a single one. [1], [byte]"""
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
"""Modules that are slow to import; the fork server imports them once for all processes. This package is not among them,
as the fork server may find another copy of it, nor is cantools: it would make python-can import asammdf, see
:func:`.load_python_can`."""
LARGEST_GREETING = 1 << 20
"""Largest length that a scheduler announces first; a larger number comes from another kind of server. [byte]"""
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
        Number of processes on this machine; without a scheduler they do the work.
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
        What happened and what to do, in one line; it begins with :data:`.INTERNAL_ERROR` if the program is at fault.
    """

    reason: str


def run_many(
    function: Callable[[_Item], _Result], items: Iterable[_Item], workers: Workers
) -> Generator[_Result, None, None]:
    """Apply a function to each item; an exception that it raises is raised here when the result of its item is due.

    Parameters
    ----------
    function : callable
        Function of module level, or a partial of one, as it is pickled for other processes.
    items : iterable
        Items, which are consumed as they are needed.
    workers : Workers
        Where to compute; ``processes=1`` without a scheduler means in this process.

    Yields
    ------
    object
        Result of the function for each item, in the order of the items.

    Raises
    ------
    FleetError
        If an item killed its process twice, or the cluster cannot be reached or has another version of this package.
    """
    if workers.scheduler is None and workers.processes == 1:
        with threadpool_limits(1):  # as in other processes, because sums depend on the number of threads
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
    """Apply a function to each item, never in this process, as items are files that cannot be trusted.

    Parameters
    ----------
    function, items, workers
        Function, its items and where to compute, as for :func:`run_many`.
    limit_s : float
        Longest time for one item. [s]

    Yields
    ------
    item : object
        The items, in their order.
    outcome : object or Failed
        Result of the function for the item, or why there is none: an error in the data, time or memory above the
        limits, or a fault of the program. A failed item does not stop the others.
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
    """Run :func:`try_many` with a progress bar; `size` counts the bytes of all items, `size_of` those of one."""
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
    """A pickled function, longest time for an item [s] (None: items are trusted, no limits), and package version."""

    function: bytes
    limit_s: float | None
    version: str


class _Processes:
    """Worker processes that run one item each at a time, in limited memory if items are not trusted."""

    def __init__(self, memory_bytes: int) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="calibrator-", ignore_cleanup_errors=True)
        self._memory_bytes = max(memory_bytes, LEAST_MEMORY_BYTES)
        self._idle: LifoQueue[_Process] = LifoQueue()
        self._all: list[_Process] = []
        resource_tracker.ensure_running()  # otherwise ensure_running() below starts it, and unblocks SIGINT
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # fork server and its children inherit this
        try:
            forkserver.set_forkserver_preload(PRELOADED)
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)

    def run(self, job: _Job, item: Any) -> Any:
        """Run the function of a job on an item; return its result, or Failed if its process died or took too long.

        An exception of the function is raised here.
        """
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
    """One worker process, which is replaced when it dies or takes too long."""

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
                self.join()  # its pool may have been created only after stop()
                raise
            except TimeoutError:
                if job.limit_s is None:  # raised by the function itself
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
    """Process that starts without running the user's main script again."""

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
    """Set up a worker process; it must not raise, as the process would then be replaced again and again."""
    global _pickled_function  # noqa: PLW0603 (the process runs this function alone)
    _pickled_function = function
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = folder
    threading.Thread(target=_end_with_parent, daemon=True).start()
    load_python_can()  # before readers import it together with asammdf, which takes seconds
    _one_thread()
    with suppress(Exception):  # imports must not count as time of an item; errors show at the first item
        _loaded(function)
    if memory_bytes is not None:
        most = resource.getrlimit(resource.RLIMIT_DATA)[1]  # hard limit, which may be set in the user's shell
        resource.setrlimit(
            resource.RLIMIT_DATA, (memory_bytes if most == resource.RLIM_INFINITY else min(memory_bytes, most), most)
        )


def _call(item: Any) -> Any:
    return _loaded(_pickled_function)(item)


@lru_cache(maxsize=2)
def _loaded(function: bytes) -> Callable[[Any], Any]:
    loaded: Callable[[Any], Any] = pickle.loads(function)  # noqa: S301 (pickled by the parent process)
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
                        workers, counted_s = max(_workers_of(client), 1), time.monotonic()
                        continue  # fill up the flight for this number of workers first
                    while unsent := list(islice(flight, len(futures), len(futures) + SENT_AT_ONCE)):
                        futures.extend(client.map(partial(_on_worker, job), unsent, pure=False))
                    try:
                        error = futures[0].exception(timeout=CONNECT_S)  # waits until it is finished
                        # many at once: each request to the scheduler costs milliseconds; other items keep workers busy
                        done = list(takewhile(lambda future: future.status == "finished", islice(futures, workers)))
                        # with a timeout: if a worker ends now, gather waits for its results until another worker comes
                        fetch = partial(client.gather, done, asynchronous=True)
                        outcomes = client.sync(fetch, callback_timeout=RETURN_S)
                    except TimeoutError:
                        _wait_for_worker(client, address)
                        continue
                    if error is None and not done:
                        raise CancelledError  # the result was lost
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
        try:
            _wait_for_worker(client, address)
        except BaseException:
            client.close()
            raise
    except (OSError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        if lost:
            raise FleetError(f"{address}: the scheduler is gone; start it and its workers again{AGAIN}") from None
        raise FleetError(f"{address}: no Dask scheduler answers: {reason}; start one with 'dask scheduler'") from None
    return client


def _require_scheduler(address: str, patience_s: float) -> None:
    """Raise OSError if another kind of server listens at the address: Dask's Client would wait for it for ever."""
    from distributed.comm.addressing import get_address_host_port  # noqa: PLC0415 (an extra)

    if not address.startswith("tcp://"):
        return
    try:
        server = socket.create_connection(get_address_host_port(address), patience_s)
    except OSError:
        return  # Client waits for a scheduler to start, and says why it failed
    with server:
        first = server.recv(8)  # a scheduler sends first, beginning with a length
    if not 0 < int.from_bytes(first, "little") < LARGEST_GREETING:
        raise OSError("another kind of server listens there")


def _wait_for_worker(client: Any, address: str) -> None:
    if not _workers_of(client):
        say_error(f"calibrator: {address}: the scheduler has no worker now; waiting {RETURN_S:g} s for one")
    try:
        client.wait_for_workers(1, timeout=RETURN_S)
    except TimeoutError:
        advice = f"start some with 'dask worker' on machines with this package of this version{AGAIN}"
        raise FleetError(f"{address}: the scheduler has no worker; {advice}") from None


def _on_worker(job: _Job, item: Any) -> Any:
    """Run an item on a worker of a cluster; untrusted files are read in another process, which the worker can kill."""
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

    multiprocessing.current_process().daemon = False  # daemonic processes may not start others
    return _Processes(get_worker().memory_manager.memory_limit or _memory_bytes())


def _memory_bytes() -> int:
    return int(MEMORY_SHARE * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


@contextmanager
def _silenced() -> Iterator[None]:
    """Silence, within the block, the loggers that would print tracebacks: this module reports errors in one line."""
    names = ("distributed", "distributed.client", "tornado.application", "asyncio")
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        gc.collect()  # asyncio logs unfinished tasks when they are collected: now, while silenced
        for logger, level in levels.items():
            logger.setLevel(level)


def _workers_of(client: Any) -> int:
    """Return the number of workers; raise OSError if the client has lost its scheduler."""
    if client.scheduler is None:
        raise OSError("the scheduler is gone")
    return len(client.nthreads())
