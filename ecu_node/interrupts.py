"""Signals that come while nothing is open yet.

Libraries swallow KeyboardInterrupt in their own imports, or print it; so until the node is at work, SIGINT ends the
process at once. SIGHUP asks for parameters that are about to be read anyway. What the node does at work is for
:mod:`ecu_node.cli` to say.
"""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["INTERRUPTED", "ending_at_interrupt", "ignoring_hangups"]

INTERRUPTED = 130
"""Exit code that shells give to a program ended by SIGINT."""


@contextmanager
def ending_at_interrupt(message: str) -> Iterator[None]:
    """Within the block SIGINT ends the process with one line and :data:`INTERRUPTED`, unless it is ignored."""

    def end(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        os.write(sys.stderr.fileno(), f"{message}\n".encode())
        os._exit(INTERRUPTED)

    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def ignoring_hangups() -> Iterator[None]:
    """Within the block SIGHUP, which would end the process, does nothing until somebody else handles it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)
