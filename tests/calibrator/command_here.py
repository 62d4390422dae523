"""The calibrator's command line in this process: starting Python takes longer than most commands."""

import fcntl
import json
import os
import subprocess
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Any

import pytest

from calibrator.cli import run_calibrator
from tests.calibrator.conftest import LAYOUT

__all__ = ["calibrator", "made_once", "once", "refused", "reported", "succeeded"]


def calibrator(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command; test_command_line.py tests how it starts and ends as a process."""
    output, errors = TextIOWrapper(BytesIO(), encoding="utf-8"), TextIOWrapper(BytesIO(), encoding="utf-8")
    line = [*map(str, arguments)]
    with redirect_stdout(output), redirect_stderr(errors), pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["calibrator", *line])
        code = run_calibrator()
    return subprocess.CompletedProcess(line, code, said(output), said(errors))


def succeeded(*arguments: object) -> str:
    """Output of a command that ends without an error."""
    done = calibrator(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def reported(*arguments: object) -> Any:
    """What a command reports with ``--json``."""
    return json.loads(succeeded(*arguments, "--json"))


def refused(*arguments: object, code: int = 1) -> str:
    """Error line of a command that must be refused with this exit code; it may print nothing else."""
    done = calibrator(*arguments)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (code, "", 1), done.stderr
    return done.stderr


def said(stream: TextIOWrapper) -> str:
    """Everything written to a stream."""
    stream.seek(0)
    return stream.read()


def made_once(factory: pytest.TempPathFactory, name: str, *arguments: object) -> Path:
    """Folder that a command writes once for all tests."""

    def make(out: Path) -> None:
        succeeded(*arguments, "--layout", LAYOUT, "--out", out, "--workers", 1)

    return once(factory, name, make)


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Folder that the first worker of a test run makes, and all of them read."""
    base = factory.getbasetemp()
    out = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with out.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not out.exists():
            make(out)
    return out
