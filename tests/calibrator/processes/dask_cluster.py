"""A Dask cluster for tests: a scheduler and two workers, processes of this machine that talk over TCP."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

ROOT = Path(__file__).parents[3]


class DaskCluster:
    """Start the cluster; a context manager that kills it.

    ``environment`` is added to that of the processes.
    """

    def __init__(self, folder: Path, environment: Mapping[str, str] | None = None) -> None:
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        self._environment = {**os.environ, "OMP_NUM_THREADS": "1", **(environment or {}), "PYTHONPATH": path}
        self._folder, self._stack = folder, ExitStack()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"

    def __enter__(self) -> "DaskCluster":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def start(self) -> None:
        """Start scheduler and workers, the first time or once more on the same port, and wait for both to join.

        A worker that joins later takes items from the other one, and may put the one that a test waits for behind one
        that waits for the test.
        """
        options = ["--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard", "--no-jupyter"]
        self.scheduler = self._run("scheduler", *options)
        before = self._joined()
        options = [self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        self.workers = [self._run("worker", *options) for _ in range(2)]
        until = time.monotonic() + 60.0
        while self._joined() < before + 2 and time.monotonic() < until:
            time.sleep(0.05)

    def _joined(self) -> int:
        log = self._folder / "worker.log"
        return log.read_text().count("Registered to") if log.exists() else 0

    def _run(self, *arguments: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", f"distributed.cli.dask_{arguments[0]}", *arguments[1:]]
        log = self._stack.enter_context((self._folder / f"{arguments[0]}.log").open("ab"))
        process = subprocess.Popen(command, stdout=log, stderr=log, env=self._environment, cwd=self._folder)
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process


def gated(number: int, folder: Path) -> int:
    """Return the number; from the third item on wait until the file ``go`` is there."""
    while number >= 2 and not (folder / "go").exists():
        time.sleep(0.02)
    return number


def of_no_disk(number: int) -> int:
    """Fail at the second item."""
    if number == 1:
        raise OSError("no disk")
    return number
