"""Benchmarks run at small size and give all their figures; how large the figures are is mostly not tested."""

import os
import subprocess
import sys
from importlib import reload

import can.io.mf4
import pytest

from bench import ingest
from bench.fleet_run import resident_bytes
from bench.node import core_rows, process_rows


def test_measured_memory_includes_child_processes() -> None:
    alone = resident_bytes(os.getpid())
    code = "import sys; ballast = b'x' * 200_000_000; print(flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        together = resident_bytes(os.getpid())
        child.kill()
    assert together > alone + 100_000_000  # this process may have given back some of its own meanwhile


def test_benchmark_compares_both_modes_of_the_node_with_cantools() -> None:
    found = core_rows(2)  # which compares what the two make of each frame
    assert [row.name.split(", ")[1] for row in found] == ["overlay", "gateway"]
    assert all(row.ratio is not None and "cantools" in (row.peer or "") for row in found)


def test_benchmark_measures_start_time_and_memory_of_a_running_node() -> None:
    found = process_rows(3000)
    assert [row.unit for row in found] == ["s", "MiB", "MiB"]
    start_s, memory_mib, growth_mib = (row.value for row in found)
    assert start_s > 0.0
    assert memory_mib > 0.0
    assert growth_mib < 1.0, "a node that runs does not accumulate objects"


@pytest.mark.long
def test_benchmark_compares_reading_of_logs_with_python_can_and_cantools() -> None:
    reload(can.io.mf4)  # with its writer: tests/conftest.py imports it without asammdf
    found = {row.name: row for row in ingest.rows(quick=True)}  # compares the channels of both ways
    assert [row.unit for row in found.values()] == ["frames/s"] * 4 + ["h/s"] * 2
    assert all((found[f"{name} log to drive"].ratio or 0.0) > 1.0 for name in ("BLF", "candump", "ASC"))
