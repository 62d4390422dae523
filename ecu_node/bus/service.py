"""The node as a service: stop signals, the service manager, a log that does not flood, real-time priority."""

import ctypes
import os
import resource
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from ecu_node.errors import printable

_WHILE_S, _SAME_LINE_TIMES = 10.0, 3
"""The same line is written at most this often within this time [s]: enough to see it come and go, without a flood."""
_REMEMBERED_LINES = 100
_LONGEST_LINE = 900
"""Most characters of a line, so that with what is written around it, it fits into PIPE_BUF in UTF-8."""
_LONGEST_NOTIFY_S = 0.1
"""Longest wait for a service manager that does not read: it must not hold up the bus. [s]"""


def stopped_by(*numbers: signal.Signals) -> Callable[[], bool]:
    """Handle these signals from now on; return a function that says whether one of them has come."""
    stopped = threading.Event()
    for number in numbers:
        signal.signal(number, lambda _, __: stopped.set())
    return stopped.is_set


class Log:
    """Log on standard error; a line that repeats is written a few times, and later with how often it came in between.

    A reader that does not read must not hold up the bus: lines that standard error does not take at once are lost, and
    the next one that it takes says how many. Threads may write at the same time.
    """

    def __init__(self) -> None:
        self._lock, self._lost = threading.Lock(), 0
        self._said: dict[str, tuple[float, int]] = {}

    def say(self, text: str) -> None:
        """Write a line, unless it repeats too often."""
        with self._lock:
            self._say(text)

    def _say(self, text: str) -> None:
        now_s = time.monotonic()
        since_s, times = self._said.pop(text, (now_s, 0))
        unsaid = 0
        if now_s - since_s >= _WHILE_S:
            since_s, times, unsaid = now_s, 0, max(times - _SAME_LINE_TIMES, 0)
        if len(self._said) >= _REMEMBERED_LINES:
            self._said.clear()
        self._said[text] = since_s, times + 1
        if times >= _SAME_LINE_TIMES:
            return
        again = f" (and {unsaid} times before)" if unsaid else ""
        if not _takes_a_line():
            self._lost += 1
            return
        if self._lost:
            again, self._lost = f"{again} ({self._lost} lines before were lost: nobody read them)", 0
        # A log that is closed or gone, as when the journal is started anew, must not end the node.
        with suppress(AttributeError, OSError, ValueError):
            sys.stderr.write(f"ecu-node: {printable(text)[:_LONGEST_LINE]}{again}\n")
            sys.stderr.flush()


def _takes_a_line() -> bool:
    """Check whether standard error takes a line without waiting; a pipe that says so has room for PIPE_BUF bytes."""
    try:
        number = sys.stderr.fileno()
    except (AttributeError, OSError, ValueError):  # closed, or no file at all
        return True
    waiting = select.poll()
    waiting.register(number, select.POLLOUT)
    return bool(waiting.poll(0))


class ServiceManager:
    """Tells systemd, if it started the node, that the node is ready, alive, and what it does; see sd_notify(3)."""

    def __init__(self) -> None:
        address = os.environ.get("NOTIFY_SOCKET")
        self._address = address.replace("@", "\0", 1) if address and address.startswith("@") else address or None
        period_us = os.environ.get("WATCHDOG_USEC", "")
        is_for_us = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())  # see sd_watchdog_enabled(3)
        self._period_s = int(period_us) / 2e6 if period_us.isdecimal() and is_for_us else None
        self._due_s = 0.0

    def ready(self, text: str) -> None:
        """Tell systemd that the node is at work."""
        self._notify(f"READY=1\nSTATUS={text}")

    def alive(self, now_s: float) -> None:
        """Tell systemd that the node has just done its work, at intervals of half the time that the watchdog allows."""
        if self._period_s is not None and now_s >= self._due_s:
            self._due_s = now_s + self._period_s
            self._notify("WATCHDOG=1")

    def status(self, text: str) -> None:
        """Tell systemd what the node does now."""
        self._notify(f"STATUS={text}")

    def stopping(self) -> None:
        """Tell systemd that the node ends."""
        self._notify("STOPPING=1")

    def _notify(self, text: str) -> None:
        if self._address is None:
            return
        # A service manager that is gone must not end the node.
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.settimeout(_LONGEST_NOTIFY_S)
            notify.sendto(text.encode(), self._address)


_FIFO_PRIORITY = 50
"""Priority of the kernel's interrupt threads, which bring the frames; see sched(7)."""
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
"""Flags of mlockall(2): lock present and future memory, each page once it is used."""


def be_real_time() -> str:
    """Run with real-time priority, ahead of ordinary processes, on one processor, with memory that stays in RAM.

    Call it before other threads are started: they inherit it.

    Returns
    -------
    str
        One line for the log, which names what was not allowed.
    """
    steps: dict[str, Callable[[], None]] = {
        "SCHED_FIFO": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY)),
        "memory lock": _lock_memory,
        "one processor": lambda: os.sched_setaffinity(0, {max(os.sched_getaffinity(0))}),
    }
    refused = []
    for name, step in steps.items():
        try:
            step()
        except (OSError, ValueError) as error:  # ValueError: of setrlimit
            refused.append(f"{name} ({error})")
    return f"real time, but not allowed: {', '.join(refused)}" if refused else f"real time: {', '.join(steps)}"


def _lock_memory() -> None:
    # Unless this limit is lifted, later requests for memory would fail.
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
