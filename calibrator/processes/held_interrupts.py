"""Ctrl-C while worker processes run: it is noticed, and never reaches a process that is just started."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any

__all__ = ["interrupts_held", "noticed_interrupts"]


@contextmanager
def noticed_interrupts() -> Iterator[Callable[[], bool]]:
    """Tell whether SIGINT came within the block, also if its KeyboardInterrupt never got here."""
    before, came = signal.getsignal(signal.SIGINT), threading.Event()
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield came.is_set
        return

    def notice(number: int, frame: Any) -> Any:
        came.set()
        return before(number, frame)

    signal.signal(signal.SIGINT, notice)
    try:
        yield came.is_set
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Within the block SIGINT waits; processes that are started in it never get one."""
    resource_tracker.ensure_running()  # its start, else within the block, would let SIGINT through
    before, came = signal.getsignal(signal.SIGINT), threading.Event()
    # The mask, which children inherit, is this thread's: a thread of a library may still take the signal, and Python
    # would then run the handler here.
    holds = threading.current_thread() is threading.main_thread() and callable(before)
    if holds:
        signal.signal(signal.SIGINT, lambda _number, _frame: came.set())
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if holds:
            signal.signal(signal.SIGINT, before)
        if came.is_set() and callable(before):
            before(signal.SIGINT, None)
