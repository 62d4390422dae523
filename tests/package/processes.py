"""Programs of clean environments that run beside a test."""

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from tests.package.clean_venv import CleanVenv

__all__ = ["started", "until"]

PATIENCE_S = 60.0
_Found = TypeVar("_Found")


@contextmanager
def started(venv: CleanVenv, name: str, *arguments: object, folder: Path) -> "Iterator[subprocess.Popen[bytes]]":
    """A program that is killed at the end if it still runs; what it says goes to NAME.log of the folder."""
    command = [venv.program(name), *map(str, arguments)]
    with (folder / f"{name}.log").open("ab") as log:
        process = subprocess.Popen(command, cwd=folder, env=venv.environment, stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def until(look: Callable[[], _Found | None], what: str) -> _Found:
    """Look again and again until there is something."""
    give_up_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up_s:
        found = look()
        if found is not None:
            return found
        time.sleep(0.05)
    raise AssertionError(f"{what}: not in {PATIENCE_S:g} s")
