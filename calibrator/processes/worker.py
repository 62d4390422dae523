"""What a worker process does: it reads what it is given until its parent is gone or wants no more."""

import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from calibrator.processes.messages import REMEDY, Begun, Raised, Unread
from ecu_node.program import load_python_can

__all__ = ["work"]


def work(pipe: Connection, pickled_read: bytes, folder: str) -> None:
    """What a worker does until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.setsid()  # a group of its own, so that it can be killed with what it starts
    tempfile.tempdir = folder
    threading.Thread(target=_end_with_parent, daemon=True).start()
    load_python_can()  # before the reader's modules are imported, with which they would take seconds
    read = pickle.loads(pickled_read)  # noqa: S301 (of the parent)
    with suppress(EOFError, ConnectionError):  # the parent is gone, or wants no more
        while True:
            source = pipe.recv()
            pipe.send(Begun())
            _send(pipe, _outcome(read, source))


def _outcome(read: Callable[[Any], Any], source: Any) -> object:
    try:
        return read(source)
    except MemoryError:
        return Unread(reason=f"not enough memory to read it; {REMEDY}, or use fewer --workers")
    except Exception as error:  # noqa: BLE001 (the parent raises it)
        error.add_note("".join(traceback.format_exception(error)))
        return Raised(error=error)


def _send(pipe: Connection, outcome: object) -> None:
    """Hand over a result; one that cannot be is an error of the reader."""
    try:
        pipe.send(outcome)
    except (AttributeError, TypeError, pickle.PicklingError) as error:
        pipe.send(Raised(error=RuntimeError(f"cannot hand over {outcome!r:.200}: {error}")))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.killpg(0, signal.SIGKILL)
