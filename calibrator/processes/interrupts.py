"""End the program at Ctrl-C while libraries are imported, and at SIGTERM.

During an import KeyboardInterrupt is of no use, as libraries swallow it or turn it into another exception; Ctrl-C then
ends the process directly. SIGTERM ends the program at once, as a kill would, but prints one line.
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
"""Escape sequence that shows the cursor of the terminal again, which a progress bar hides."""
GO_ON = ("import", "summarise")
"""Commands that continue where they stopped when they are run again."""


def interrupted_message(arguments: Sequence[str], how: str = "interrupted") -> str:
    """Return the message after a command was ended; `arguments` start with the command, `how` says what ended it."""
    command = next((argument for argument in arguments if not argument.startswith("-")), "")
    kept = "; it goes on with what it had read" if command in GO_ON else ""
    return f"calibrator: {how}; run the same command again{kept}"


def ending_at_sigterm() -> None:
    """Make SIGTERM end the program with one line and exit code :data:`TERMINATED`, unless it has a handler already."""

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
    """Return the ids of all processes that a process has started, directly or not, as far as /proc shows them."""
    found: list[int] = []
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        with suppress(OSError):
            for child in task.read_text().split():
                found += [int(child), *_descendants(child)]
    return found


def importing() -> AbstractContextManager[None]:
    """Let Ctrl-C end the process with one line and without cleanup while the block, which opens no file, imports."""
    return ending_at_interrupt(interrupted_message(sys.argv[1:]))
