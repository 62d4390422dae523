"""Telemetry of the node, apart from the bus: a line of JSON per second, to a file or by UDP."""

import errno
import os
import queue
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.core.corrector import Corrector
from ecu_node.core.junction import LiveBranch
from ecu_node.core.status import Latency, Quality
from ecu_node.layout import Layout

_WITHOUT_VALUE = frozenset({Quality.NOT_AVAILABLE, Quality.INVALID})
_PERIOD_S = 1.0


@dataclass
class Telemetry:
    """Writes a line per second, in a thread of its own, so that neither a disk nor a network holds up the bus.

    Parameters
    ----------
    target : Path or tuple of str and int
        File to which lines are added, or host and UDP port.
    corrector : Corrector
        Core whose state is reported.
    layout : Layout
        Names of the branches.
    latency : Latency
        Latency of the answers.
    buses : sequence of SteadyBus
        Buses whose states are reported.
    say : callable
        Takes one line for the log: when lines begin to get lost, and when they are written again.
    """

    target: Path | tuple[str, int]
    corrector: Corrector
    layout: Layout
    latency: Latency
    buses: Sequence[SteadyBus]
    say: Callable[[str], None]

    def __post_init__(self) -> None:
        self._names = {branch.name: branch.vss or branch.name for branch in self.layout.branch}
        self._due_s = time.monotonic()
        self._lines: queue.Queue[bytes] = queue.Queue(maxsize=1)
        threading.Thread(target=self._write_lines, name="telemetry", daemon=True).start()

    def look(self, now_s: float) -> None:
        """Hand over a line if one is due; if the last one is still waiting, the new one is lost, and counted."""
        if now_s < self._due_s:
            return
        self._due_s = max(self._due_s + _PERIOD_S, now_s)
        try:
            self._lines.put_nowait(msgspec.json.encode(self._record(now_s)) + b"\n")
        except queue.Full:
            self.corrector.counters.telemetry_lost += 1

    def _record(self, now_s: float) -> dict[str, Any]:
        """Return the content of one line."""
        corrector, sums = self.corrector, self.corrector.watch.sums
        state, reason = corrector.state()
        return {
            "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "state": state.name,
            "reason": reason.name,
            "parameter_set": corrector.parameter_set,
            "branches": {self._names[branch.name]: _branch(branch, now_s) for branch in corrector.branches},
            "sum_measured_a": None if sums is None else round(sums.measured_a, 3),
            "sum_corrected_a": None if sums is None else round(sums.corrected_a, 3),
            "latency_us": self.latency.microseconds(),
            "latency_counts": self.latency.counts,
            "buses": {bus.channel: bus.state for bus in self.buses},
            "counters": corrector.counters,
        }

    def _write_lines(self) -> None:
        is_lost = False
        while True:
            line, was_lost = self._lines.get(), is_lost
            try:
                if isinstance(self.target, Path):
                    _append(self.target, line)
                else:
                    _send(*self.target, line)
                is_lost, news = False, "lines are written again"
            except (OSError, UnicodeError) as error:  # UnicodeError: a host name that cannot exist
                why = error.strerror if isinstance(error, OSError) else error
                is_lost, news = True, f"{why}; lines are lost until that has changed"
                self.corrector.counters.telemetry_lost += 1
            if is_lost != was_lost:
                self.say(f"--telemetry: {news}")


def _branch(branch: LiveBranch, now_s: float) -> dict[str, Any]:
    """Return the measured and the published current of a branch, positive into the junction [A], and their quality."""
    quality = branch.published(now_s)[1]
    currents_a = None if quality in _WITHOUT_VALUE else branch.currents_at(branch.time_s)
    if currents_a is None:
        return {"measured_a": None, "corrected_a": None, "quality": quality.name}
    published_a = currents_a[quality is Quality.CORRECTED]
    return {"measured_a": round(currents_a[0], 3), "corrected_a": round(published_a, 3), "quality": quality.name}


def _append(path: Path, line: bytes) -> None:
    """Add a line to a file, whole or not at all; a pipe that nobody reads is an error."""
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK, 0o644)
    try:
        written = os.write(file, line)
        if written < len(line):
            os.ftruncate(file, os.fstat(file).st_size - written)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    finally:
        os.close(file)


def _send(host: str, port: int, line: bytes) -> None:
    family, kind, protocol, _, found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    with socket.socket(family, kind, protocol) as out:
        out.sendto(line, found)
