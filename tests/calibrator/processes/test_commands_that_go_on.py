"""Commands that read logs, as users type them: harmful logs, kills, lost workers, a restarted scheduler."""

import gzip
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.fleets import make_store
from calibrator.artificial.simulate import FleetPlan, simulate_fleet
from calibrator.artificial.trips import BuiltinTrips
from ecu_node.database import VehicleDatabase
from tests.calibrator.conftest import LAYOUT
from tests.calibrator.processes.dask_cluster import DaskCluster

ENVIRONMENT = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}
HUGE_BYTES = 100 * 10**9
KILLS = int(os.environ.get("HV_KILLS", "4"))
"""Runs of each command that are killed."""


def started(
    command: str, given: Path, out: Path, *options: object, process_group: int | None = None
) -> "subprocess.Popen[str]":
    line = [sys.executable, "-m", "calibrator", command, given, "--layout", LAYOUT, "--out", out, *options]
    return subprocess.Popen(
        list(map(str, line)),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        process_group=process_group,
    )


def contents(folder: Path) -> dict[str, bytes]:
    """Contents of files except hidden ones, which a killed worker may leave until the next import."""
    files = [path for path in folder.rglob("[!.]*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def fleet_of(vehicles: int, folder: Path, database: VehicleDatabase) -> Path:
    plan = FleetPlan(vehicles=vehicles, currents=2, sparsity=80.0, magnitude=(0.05, 0.25))
    simulate_fleet(plan, BuiltinTrips(seed=0, duration_s=200.0, unseen_s=20.0), database, folder / "fleet", workers=1)
    return folder / "fleet" / "logs"


@pytest.mark.long
def test_log_exceeding_time_or_memory_limits_is_left_out_with_reason(tmp_path: Path, database: VehicleDatabase) -> None:
    logs = fleet_of(1, tmp_path, database)
    lines = b"(1.000000) can0 123#\n" * 900_000
    bombs = {"blank lines": b"\n" * (1 << 24), "one line": b"0" * (1 << 24), "frames": lines}
    for name, text in bombs.items():
        (logs / name).mkdir()
        (logs / name / "bomb.log.gz").write_bytes(gzip.compress(text) * 4000)
    for suffix in (".log", ".blf", ".csv", ".mf4"):
        (logs / f"huge {suffix[1:]}").mkdir()
        with (logs / f"huge {suffix[1:]}" / f"huge{suffix}").open("wb") as file:
            file.truncate(HUGE_BYTES)
    start_s = time.monotonic()
    with started("import", logs, tmp_path / "out", "--json", "--time-limit", 20) as run:
        report = json.loads(run.communicate()[0])
    assert time.monotonic() - start_s < 600.0, "seven limits of 20 s in two processes, on a machine that does much else"
    assert (run.returncode, len(report["drives"]), len(report["left_out"])) == (0, 1, 7)
    for reason in report["left_out"].values():
        assert reason.count("\n") == 0
        assert "internal error" not in reason


@pytest.mark.long
@pytest.mark.parametrize("command", ["import", "summarise", "calibrate"])
def test_rerun_after_a_kill_gives_the_identical_result(tmp_path: Path, database: VehicleDatabase, command: str) -> None:
    if command == "calibrate":
        given = tmp_path / "summaries"
        make_store(given, vehicles=500)
    else:
        given = fleet_of(4, tmp_path, database)

    def run(out: Path, limit_s: float | None = None) -> None:
        """Run to the end, or kill it with all its processes after so long. [s]"""
        with started(command, given, out, "--workers", 2, process_group=0) as process:
            try:
                said = process.communicate(timeout=limit_s)[1]
                assert process.returncode == 0, said
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    start_s = time.monotonic()
    run(whole)
    whole_s, chance = time.monotonic() - start_s, random.Random(0)
    for _ in range(KILLS):
        run(killed, chance.uniform(0.0, whole_s))
        if command != "calibrate" or not killed.exists():  # calibrate refuses a folder with a result
            run(killed)
        assert contents(killed) == contents(whole)
        shutil.rmtree(killed)


@pytest.mark.long
@pytest.mark.parametrize("command", ["import", "summarise"])
def test_results_are_identical_after_loss_of_scheduler(tmp_path: Path, database: VehicleDatabase, command: str) -> None:
    logs = fleet_of(24, tmp_path, database)
    with started(command, logs, tmp_path / "here", "--workers", 1) as here:
        here.communicate()
    with (
        DaskCluster(tmp_path) as cluster,
        started(command, logs, tmp_path / "there", "--scheduler", cluster.address) as there,
    ):
        for files, lost in ((2, cluster.workers[:1]), (8, [cluster.scheduler, *cluster.workers])):
            while len(contents(tmp_path / "there")) < files:
                assert there.poll() is None, there.communicate()[1]
                time.sleep(0.02)
            for process in lost:
                process.send_signal(signal.SIGKILL)
                process.wait()
        cluster.start()
        said = there.communicate()[1]
    assert (here.returncode, there.returncode) == (0, 0), said
    assert contents(tmp_path / "there") == contents(tmp_path / "here")
