"""How many workers of a cluster the process that the user starts and the Dask scheduler can keep busy.

The workers are those of Dask, all in one process, and only wait: each item brings back a record of the usual size.
Measured is the time on a core that the user's process and the scheduler take per item: the slower one limits a fleet,
and both have a core of their own in a real cluster.
"""

import asyncio
import logging
import multiprocessing
import os
import socket
import time
from functools import partial

import dask
import psutil
from distributed import Client, Scheduler, Worker

from bench.row import Row
from calibrator.processes.run_many import Workers, run_many

__all__ = ["rows"]

WORKERS, QUICK_WORKERS, ITEMS_PER_WORKER = 1000, 20, 5
READING_S = 10.0
"""Time for one item; a vehicle with ten hours of driving takes 2.5 s, but here one process holds all workers. [s]"""
TASK_BYTES, RECORD_BYTES = 4_000, 16_000
"""Size of what goes to a worker (names and versions of a vehicle's drives), and of what comes back. [byte]"""
IDLE = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "1h",
    "distributed.admin.tick.interval": "1h",
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
}
"""Settings by which a thousand workers in one process do not spend its time on watching themselves."""


def read(_: bytes, seconds: float) -> bytes:
    """Wait as long as reading a vehicle's drives is taken to last, and return as many bytes as its record has."""
    time.sleep(seconds)
    return bytes(RECORD_BYTES)


def rows(*, quick: bool) -> list[Row]:
    """Measure the time on a core per item of both processes, and the rate that the slower one allows."""
    workers = QUICK_WORKERS if quick else WORKERS
    own_s, scheduler_s = core_seconds(workers)
    return [
        Row(name=f"{workers} workers, process that was started", value=1e3 * own_s, unit="ms per item"),
        Row(name=f"{workers} workers, scheduler", value=1e3 * scheduler_s, unit="ms per item"),
        Row(name="so one scheduler hands out at most", value=1.0 / max(own_s, scheduler_s), unit="vehicles/s"),
    ]


def core_seconds(workers: int) -> tuple[float, float]:
    """Return the time on a core, per item, of the user's process and of the scheduler. [s]"""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    context, address = multiprocessing.get_context("spawn"), f"tcp://127.0.0.1:{port}"
    processes = [context.Process(target=_serve, args=(count, port), daemon=True) for count in (None, workers)]
    try:
        for process in processes:
            process.start()
        with Client(address, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=600)
        tasks = (os.urandom(TASK_BYTES) for _ in range(workers * ITEMS_PER_WORKER))
        watched = (psutil.Process(), psutil.Process(processes[0].pid))
        before_s = [sum(process.cpu_times()[:2]) for process in watched]
        found = sum(1 for _ in run_many(partial(read, seconds=READING_S), tasks, Workers(scheduler=address)))
        after_s = [sum(process.cpu_times()[:2]) for process in watched]
        own_s, scheduler_s = ((after - before) / found for before, after in zip(before_s, after_s, strict=True))
        return own_s, scheduler_s
    finally:
        for process in processes:
            process.kill()


def _serve(workers: int | None, port: int) -> None:
    """Run so many Dask workers in this process; None: the scheduler, on this port."""

    async def serve() -> None:
        if workers is None:
            await Scheduler(port=port, host="127.0.0.1", dashboard_address=":0")
        else:
            address = f"tcp://127.0.0.1:{port}"
            for first in range(0, workers, 50):
                await asyncio.gather(*(Worker(address, nthreads=1) for _ in range(first, min(first + 50, workers))))
        await asyncio.Event().wait()

    logging.getLogger("distributed").setLevel(logging.WARNING)
    with dask.config.set(IDLE):
        asyncio.run(serve())
