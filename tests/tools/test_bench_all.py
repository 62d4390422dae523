"""The table of the benchmarks, and what is watched of a run."""

import json
import os
import subprocess
import sys
from pathlib import Path

from bench.all import GROUPS, table_of, write
from bench.fleet_run import resident_bytes
from bench.row import Row

ROWS = [
    Row(name="posterior", value=0.024, unit="ms", peer="Clarabel", ratio=92.0),
    Row(name="memory", value=1359.0, unit="MiB"),
]


def test_rows_stand_in_the_table_and_in_the_file(tmp_path: Path) -> None:
    table = table_of(ROWS)
    assert [list(column.cells) for column in table.columns] == [
        ["posterior", "memory"],
        ["0.024", "1359"],
        ["ms", "MiB"],
        ["Clarabel", ""],
        ["92", ""],
    ]
    write(ROWS, tmp_path / "build" / "bench.json")
    assert json.loads((tmp_path / "build" / "bench.json").read_text())[1] == {
        "name": "memory",
        "value": 1359.0,
        "unit": "MiB",
        "peer": None,
        "ratio": None,
    }


def test_every_step_has_its_group() -> None:
    assert list(GROUPS) == ["identification", "posterior", "ingest", "fleet run", "node", "fleet report"]


def test_memory_is_that_of_the_process_and_its_children() -> None:
    alone = resident_bytes(os.getpid())
    code = "import sys; ballast = b'x' * 200_000_000; print(flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        together = resident_bytes(os.getpid())
        child.kill()
    assert together > alone + 200_000_000
