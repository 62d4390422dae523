"""Programs under strace: which system calls they make on a folder; they can be killed at one, or have it fail."""

import os
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
WRITING = ("openat", "write", "fsync", "rename", "unlink", "fchown")
"""System calls with which the state of a vehicle is changed."""
LONGEST_RUN_S = 60.0
_LINE = re.compile(r"\d+ +(?P<name>\w+)\((?P<arguments>.*)\) += (?P<result>-?\d+)")
_PATH = re.compile(r'(?:<|")(/[^">]*)(?:>|")')


class Call(NamedTuple):
    """One system call of a program."""

    name: str
    number: int
    """Which call of that name in the program, counted from 1."""
    path: Path
    """File or folder concerned; of two, the last."""
    changes: bool
    """Whether it could change what is on the disk, or make it last."""


def calls_of(command: Sequence[str], folder: Path, files: Sequence[str], log: Path) -> list[Call]:
    """Run a program that must succeed; its system calls on files of a folder, in their order."""
    result = traced(command, folder, files, log, [])
    assert result.returncode == 0, result.stderr
    numbers = Counter[str]()
    calls = []
    for line in log.read_text().splitlines():
        found = _LINE.match(line)
        assert found is not None, f"strace says what this test does not understand: {line}"
        numbers[found["name"]] += 1
        changes = found["name"] != "openat" or "O_CREAT" in found["arguments"]
        paths = _PATH.findall(found["arguments"])
        calls.append(Call(found["name"], numbers[found["name"]], Path(paths[-1]), changes))
    return calls


def traced(
    command: Sequence[str], folder: Path, files: Sequence[str], log: Path, options: Sequence[str]
) -> subprocess.CompletedProcess[str]:
    """Run a program under strace, which looks only at calls on files of a folder, and on the folder itself."""
    strace = shutil.which("strace")
    if strace is None:
        pytest.skip("no strace here (apt-get install strace)")
    paths = [item for path in (folder, *(folder / name for name in files)) for item in ("-P", str(path))]
    what = ["-f", "-qq", "-y", "-s", "0", "-o", str(log), "-e", f"trace={','.join(WRITING)}", *paths, *options]
    environment, line = (
        {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
        [strace, *what, *command],
    )
    return subprocess.run(
        line, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=LONGEST_RUN_S, check=False
    )


def killed_before(call: Call) -> list[str]:
    """Option of strace that kills a program as it enters a call; the call is not made."""
    return ["-e", f"inject={call.name}:signal=SIGKILL:when={call.number}"]


def failing(call: Call, error: str, *, from_then_on: bool) -> list[str]:
    """Option of strace that lets a call fail, and all later ones of its name if that is asked for."""
    return ["-e", f"inject={call.name}:error={error}:when={call.number}{'+' if from_then_on else ''}"]


def not_synced(calls: Sequence[Call]) -> list[Path]:
    """Files of which a power cut after these calls may leave any beginning: written, and not synced since."""
    synced = {call.path: place for place, call in enumerate(calls) if call.name == "fsync"}
    return [call.path for place, call in enumerate(calls) if call.name == "write" and synced.get(call.path, -1) < place]
