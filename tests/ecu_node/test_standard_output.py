"""Results that cannot be written: one line and exit code 1, in the node's commands and in the calibrator's."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ecu_node.vehicles import LAYOUT

FULL = "import resource, runpy, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)); "
"""No file that is written may have a single byte, as on a full disk."""
MONITOR = ["monitor", "--layout", str(LAYOUT), "--interface", "virtual", "--channel", "full", "--once", "0.1"]
LINE = ": standard output: cannot write the result: File too large; give it somewhere else to go\n"


def without_coverage() -> dict[str, str]:
    """The environment, less what makes coverage write a file at exit: where none can be written it says so, too."""
    return {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}


def written_nowhere(
    tmp_path: Path, program: str, *arguments: str, unbuffered: str = ""
) -> subprocess.CompletedProcess[str]:
    code = f"{FULL} sys.argv = [{program!r}, *{arguments!r}]; runpy.run_module({program!r}, run_name='__main__')"
    with (tmp_path / "full").open("w") as full:
        return subprocess.run(
            [sys.executable, "-c", code],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
            env={**without_coverage(), "PYTHONUNBUFFERED": unbuffered},
        )


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    "arguments", [["check", "--params", "p", "--layout", str(LAYOUT)], ["schema"], ["--help"], ["--version"], MONITOR]
)
def test_a_result_that_cannot_be_written_is_one_line_and_1(
    tmp_path: Path, arguments: list[str], unbuffered: str
) -> None:
    done = written_nowhere(tmp_path, "ecu_node", *arguments, unbuffered=unbuffered)
    assert (done.returncode, done.stderr) == (1, f"ecu-node{LINE}")


def test_wrong_use_ends_in_2_though_nobody_can_be_told() -> None:
    with Path("/dev/full").open("w") as full:
        assert subprocess.run([sys.executable, "-m", "ecu_node", "run"], stderr=full, check=False).returncode == 2


def test_names_that_the_terminal_cannot_show_are_escaped() -> None:
    command = [sys.executable, "-m", "ecu_node", "check", "--params", "\N{SUN}.json", "--layout", str(LAYOUT)]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("NOT FIT (NO_PARAMETERS): \\u2609.json: no such parameter file")
