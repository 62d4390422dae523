"""Results that cannot be written: one line and exit code 1, in the node's commands and in the calibrator's."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ecu_node.vehicles import LAYOUT

MONITOR = ["monitor", "--layout", str(LAYOUT), "--interface", "virtual", "--channel", "full", "--once", "0.1"]
LINE = ": standard output: cannot write the result: No space left on device; give it somewhere else to go\n"


@pytest.mark.parametrize(
    ("arguments", "unbuffered"),
    [(["check", "--params", "p", "--layout", str(LAYOUT)], ""), (["--help"], ""), (["--version"], "1"), (MONITOR, "1")],
)
def test_unwritable_output_prints_one_line_and_exits_with_1(arguments: list[str], unbuffered: str) -> None:
    command = [sys.executable, "-m", "ecu_node", *arguments]
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False, env=environment
        )
    assert (done.returncode, done.stderr) == (1, f"ecu-node{LINE}")


def test_wrong_use_exits_with_2_even_if_stderr_cannot_be_written() -> None:
    with Path("/dev/full").open("w") as full:
        assert subprocess.run([sys.executable, "-m", "ecu_node", "run"], stderr=full, check=False).returncode == 2


def test_names_that_the_terminal_cannot_show_are_escaped() -> None:
    command = [sys.executable, "-m", "ecu_node", "check", "--params", "\N{SUN}.json", "--layout", str(LAYOUT)]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("NOT FIT (NO_PARAMETERS): \\u2609.json: no such parameter file")
