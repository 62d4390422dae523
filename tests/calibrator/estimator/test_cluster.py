"""The same run on a Dask cluster: a real scheduler and two real workers, one of which is killed in the middle."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from calibrator.summaries.store import SummaryStore
from ecu_node.database import VehicleDatabase
from tests.calibrator.estimator.test_run import ENVIRONMENT, LAYOUT, calibrate, command, contents
from tests.calibrator.summaries.small_stores import random_faults, small_store

pytest.importorskip("distributed")
VEHICLES = 300
ROOT = Path(__file__).parents[3]


def dask(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]]


@pytest.fixture(scope="module")
def store(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> SummaryStore:
    return small_store(tmp_path_factory.mktemp("fleet") / "store", database, random_faults(VEHICLES))


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list["subprocess.Popen[bytes]"]]]:
    """Address of a scheduler; its two workers, and itself."""
    file = tmp_path / "scheduler.json"
    environment = {**ENVIRONMENT, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    common = ["--scheduler-file", str(file)]
    with ExitStack() as stack:

        def start(*arguments: str) -> "subprocess.Popen[bytes]":
            log = stack.enter_context((tmp_path / f"{arguments[0]}.log").open("ab"))
            process = subprocess.Popen(dask(*arguments), stdout=log, stderr=log, env=environment, cwd=tmp_path)
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        scheduler = start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-jupyter", *common)
        until = time.monotonic() + 60.0
        while not file.exists() and time.monotonic() < until:
            time.sleep(0.05)
        workers = [start("worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", *common) for _ in range(2)]
        address = next(line for line in file.read_text().split('"') if line.startswith("tcp://"))
        yield address, [*workers, scheduler]


def test_killed_scheduler_is_one_line(
    store: SummaryStore, cluster: tuple[str, list["subprocess.Popen[bytes]"]], tmp_path: Path
) -> None:
    address, (_, _, scheduler) = cluster
    line = command("calibrate", store.url, "--layout", LAYOUT, "--out", tmp_path / "out", "--scheduler", address)
    chunks = tmp_path / ".out.unfinished" / "chunks"
    with subprocess.Popen(line, stderr=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT) as run:
        until = time.monotonic() + 300.0
        while not list(chunks.glob("*.rows.parquet")) and run.poll() is None and time.monotonic() < until:
            time.sleep(0.005)
        scheduler.send_signal(signal.SIGKILL)
        _, errors = run.communicate(timeout=300)
    *progress, last = errors.decode().replace("\r", "\n").splitlines()
    assert run.returncode == 1
    assert last == (
        f"calibrator: {address}: the scheduler is gone; start it and its workers again; the same command, run again, "
        f"goes on where it stopped"
    )
    known = ("chunks", "vehicles", "learn the fleet", "compiling the estimator")
    assert all(any(words in text for words in known) or not text.strip() for text in progress)
    assert list(chunks.glob("*.rows.parquet"))


def test_cluster_that_loses_a_worker_gives_the_same_result(
    store: SummaryStore, cluster: tuple[str, list["subprocess.Popen[bytes]"]], tmp_path: Path
) -> None:
    here = calibrate(store.url, tmp_path / "here", "--workers", 2)
    assert here.returncode == 0, here.stderr
    address, (*workers, _) = cluster
    line = command("calibrate", store.url, "--layout", LAYOUT, "--out", tmp_path / "there", "--scheduler", address)
    chunks = tmp_path / ".there.unfinished" / "chunks"
    with subprocess.Popen(line, stderr=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT) as run:
        until = time.monotonic() + 300.0
        while len(list(chunks.glob("*.rows.parquet"))) < 2 and run.poll() is None and time.monotonic() < until:
            time.sleep(0.005)
        left = len(store.buckets()) - len(list(chunks.glob("*.rows.parquet")))
        workers[0].send_signal(signal.SIGKILL)
        _, errors = run.communicate(timeout=300)
    assert left > 0, "the worker was to be killed in the middle"
    assert run.returncode == 0, errors.decode()
    assert contents(tmp_path / "there") == contents(tmp_path / "here")
