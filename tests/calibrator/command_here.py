"""The calibrator's command line in this process: starting Python takes longer than most commands that are tried."""

import subprocess
from contextlib import redirect_stderr, redirect_stdout
from io import BytesIO, TextIOWrapper

from tests.calibrator.conftest import run_command

__all__ = ["calibrator"]


def calibrator(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command; how it starts and ends as a process is for test_command_line.py."""
    output, errors = TextIOWrapper(BytesIO(), encoding="utf-8"), TextIOWrapper(BytesIO(), encoding="utf-8")
    line = [*map(str, arguments)]
    with redirect_stdout(output), redirect_stderr(errors):
        code = run_command(line)
    return subprocess.CompletedProcess(line, code, said(output), said(errors))


def said(stream: TextIOWrapper) -> str:
    """All that was written."""
    stream.seek(0)
    return stream.read()
