"""Signals that come while the node starts: at the very moment when it opens its layout, or begins to import a library.

At this moment, found by Python's audit events, the process sends the signal to itself; nothing else is changed.
"""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ecu_node.processes import running
from tests.ecu_node.vehicles import LAYOUT

AT = """
import signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whatever the tests were started with
def hook(event, arguments):
    if event == {event!r} and str(arguments[0]) == {what!r}:
        signal.raise_signal({number})
sys.addaudithook(hook)
from ecu_node.__main__ import ecu_node_program
sys.argv[1:] = {arguments!r}
sys.exit(ecu_node_program())
"""
MOMENTS = [("import", "can"), ("open", str(LAYOUT))]


def program(event: str, what: str, number: int, arguments: list[str]) -> list[str]:
    return [sys.executable, "-c", AT.format(event=event, what=what, number=int(number), arguments=arguments)]


def files(tmp_path: Path) -> list[str]:
    return ["--params", str(tmp_path / "none.json"), "--layout", str(LAYOUT)]


@pytest.mark.parametrize(("event", "what"), [("import", "ecu_node.cli"), *MOMENTS])
def test_ctrl_c_during_startup_prints_one_line_and_exits_with_130(tmp_path: Path, event: str, what: str) -> None:
    command = program(event, what, signal.SIGINT, ["check", *files(tmp_path)])
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "ecu-node: interrupted\n")
    for nobody in ("2>&-", "2>/dev/full"):
        done = subprocess.run(
            ["sh", "-c", f'"$@" {nobody}', "sh", *command], stdout=subprocess.PIPE, text=True, check=False
        )
        assert (done.returncode, done.stdout) == (130, "")


@pytest.mark.parametrize(("event", "what"), MOMENTS)
def test_sighup_during_startup_does_not_end_a_node(tmp_path: Path, event: str, what: str) -> None:
    bus = ["--interface", "virtual", "--channel", "hangup"]
    _, *program_text = program(event, what, signal.SIGHUP, ["run", "--unsigned", *files(tmp_path), *bus])
    with running(program=program_text) as log:
        assert "running on virtual hangup" in log[-1]


def test_sighup_ends_commands_other_than_run(tmp_path: Path) -> None:
    command = program("open", str(LAYOUT), signal.SIGHUP, ["check", *files(tmp_path)])
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == -signal.SIGHUP
