"""Ctrl-C while libraries are imported, when KeyboardInterrupt does not do, and SIGTERM.

Libraries swallow exceptions of their own imports, or turn them into others. SIGTERM ends the program at once, as a kill
does, with a line.
"""

import os
import signal
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import FrameType

from ecu_node.program import ending_at_interrupt

__all__ = ["ENDED", "TERMINATED", "ending_at_sigterm", "importing", "interrupted_message"]

TERMINATED = 143
"""Exit code that shells give to a program ended by SIGTERM."""
ENDED = "ended by SIGTERM"
SHOW_CURSOR = "\x1b[?25h"
"""A bar hides the cursor of a terminal."""
GO_ON = ("import", "summarise")
"""Commands that go on where they were."""


def interrupted_message(arguments: Sequence[str], how: str = "interrupted") -> str:
    """What is said of Ctrl-C, or of another way to end a command, which is the first of the arguments."""
    command = next((argument for argument in arguments if not argument.startswith("-")), "")
    kept = "; it goes on with what it had read" if command in GO_ON else ""
    return f"calibrator: {how}; run the same command again{kept}"


def ending_at_sigterm() -> None:
    """From now on SIGTERM ends the program with one line and :data:`TERMINATED`, unless that is handled already."""

    def end(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        shown = f"{SHOW_CURSOR}\n" if os.isatty(sys.stderr.fileno()) else ""
        os.write(sys.stderr.fileno(), f"{shown}{interrupted_message(sys.argv[1:], ENDED)}\n".encode())
        for process in _descendants():
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)  # a worker that lost its parent would wait, or print a traceback
        os._exit(TERMINATED)

    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, end)


def _descendants(process: str = "self") -> list[int]:
    """Processes that a process has started, and those that these have, as far as the system tells."""
    found: list[int] = []
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        with suppress(OSError):
            for child in task.read_text().split():
                found += [int(child), *_descendants(child)]
    return found


def importing() -> AbstractContextManager[None]:
    """While the block imports what a command needs, Ctrl-C ends the program at once; nothing is open yet."""
    return ending_at_interrupt(interrupted_message(sys.argv[1:]))
