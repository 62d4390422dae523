"""What a service needs of its surroundings: signals, the service manager, and a log that does not flood."""

import os
import signal
import socket
import sys
import time
from contextlib import suppress
from types import FrameType

from ecu_node.errors import printable

__all__ = ["Log", "Requests", "ServiceManager"]

_WHILE_S, _SAME_LINE_TIMES = 10.0, 3
"""The same line is written so many times in so long [s]: enough to see it come and go, and no flood."""
_REMEMBERED_LINES = 100
_LONGEST_NOTIFY_S = 0.1
"""A service manager that does not read must not hold up the bus. [s]"""


class Requests:
    """Signals that came: SIGTERM and SIGINT ask to stop, SIGHUP to read the parameters again."""

    def __init__(self) -> None:
        self._stop = self._reload = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_stop)
        signal.signal(signal.SIGHUP, self._on_reload)

    def stop(self) -> bool:
        """Whether the node is to stop."""
        return self._stop

    def take_reload(self) -> bool:
        """Whether the parameters are to be read again; asked once per signal."""
        asked, self._reload = self._reload, False
        return asked

    def _on_stop(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        self._stop = True

    def _on_reload(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        self._reload = True


class Log:
    """Lines on standard error; the same line a few times in a while, and then with how often it came in between."""

    def __init__(self) -> None:
        self._said: dict[str, tuple[float, int]] = {}

    def say(self, text: str) -> None:
        """Write a line."""
        now_s = time.monotonic()
        since_s, times = self._said.get(text, (now_s, 0))
        is_over = now_s - since_s >= _WHILE_S
        if times >= _SAME_LINE_TIMES and not is_over:
            self._said[text] = since_s, times + 1
            return
        if len(self._said) >= _REMEMBERED_LINES:
            self._said.clear()
        held_back = times - _SAME_LINE_TIMES if is_over else 0
        self._said[text] = (now_s, 1) if is_over else (since_s, times + 1)
        again = f" (and {held_back} times before)" if held_back > 0 else ""
        with suppress(OSError):  # a log that is gone, as when the journal is started anew, must not end the node
            print(f"ecu-node: {printable(text)}{again}", file=sys.stderr, flush=True)


class ServiceManager:
    """systemd, if it started the node: told that the node is ready, alive, and what it does; see sd_notify(3)."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET")
        period_us = os.environ.get("WATCHDOG_USEC", "")
        is_for_us = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())  # see sd_watchdog_enabled(3)
        self._period_s = int(period_us) / 2e6 if period_us.isdecimal() and is_for_us else None
        self._due_s = 0.0

    def ready(self, text: str) -> None:
        """The node is at work."""
        self._notify(f"READY=1\nSTATUS={text}")

    def alive(self, now_s: float) -> None:
        """The node has just done its work; told at half the time that the watchdog allows."""
        if self._period_s is not None and now_s >= self._due_s:
            self._due_s = now_s + self._period_s
            self._notify("WATCHDOG=1")

    def status(self, text: str) -> None:
        """What the node does now."""
        self._notify(f"STATUS={text}")

    def stopping(self) -> None:
        """The node ends."""
        self._notify("STOPPING=1")

    def _notify(self, text: str) -> None:
        if not self._address:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
                notify.settimeout(_LONGEST_NOTIFY_S)
                notify.sendto(text.encode(), address)
        except OSError:
            pass  # a service manager that is gone must not end the node
