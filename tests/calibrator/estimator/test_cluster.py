"""The same run on a Dask cluster: a real scheduler and two real workers, one of which is killed in the middle."""

import signal
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from calibrator.summaries.store import SummaryStore
from ecu_node.database import VehicleDatabase
from tests.calibrator.estimator.test_run import ENVIRONMENT, LAYOUT, calibrate, command, contents
from tests.calibrator.processes.dask_cluster import DaskCluster
from tests.calibrator.summaries.small_stores import random_faults, small_store

pytest.importorskip("distributed")
VEHICLES = 300


@pytest.fixture(scope="module")
def store(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> SummaryStore:
    return small_store(tmp_path_factory.mktemp("fleet") / "store", database, random_faults(VEHICLES))


@pytest.mark.long
def test_cluster_that_loses_a_worker_gives_the_same_result(store: SummaryStore, tmp_path: Path) -> None:
    here = calibrate(store.url, tmp_path / "here", "--workers", 2)
    assert here.returncode == 0, here.stderr
    chunks = tmp_path / ".there.unfinished" / "result" / "parameters"
    with ExitStack() as stack:
        cluster = stack.enter_context(DaskCluster(tmp_path, ENVIRONMENT))
        there = ("--out", tmp_path / "there", "--scheduler", cluster.address)
        line = command("calibrate", store.url, "--layout", LAYOUT, *there)
        run = stack.enter_context(
            subprocess.Popen(line, stderr=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT)
        )
        until = time.monotonic() + 300.0
        while len(list(chunks.glob("[0-9]*.parquet"))) < 2 and run.poll() is None and time.monotonic() < until:
            time.sleep(0.005)
        left = len(store.buckets()) - len(list(chunks.glob("[0-9]*.parquet")))
        cluster.workers[0].send_signal(signal.SIGKILL)
        _, errors = run.communicate(timeout=300)
    assert left > 0, "the worker was to be killed in the middle"
    assert run.returncode == 0, errors.decode()
    assert contents(tmp_path / "there") == contents(tmp_path / "here")
