"""What the node tells beside the bus: how long its answers take, and a line of JSON per second."""

import errno
import json
import os
import queue
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import accumulate
from pathlib import Path
from typing import Any

from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.core.branch import LiveBranch
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Quality
from ecu_node.layout import Layout

__all__ = ["Latency", "Telemetry"]


class Latency:
    """Histogram of the time from when a branch's frame came until its answer was sent.

    Answers that are sent with one call count as the one that waited longest: a fifth of the cost, and never too little.

    Attributes
    ----------
    counts : list of int
        Frames whose latency in whole microseconds has so many bits: number n counts those below 2^n us.
    largest_s : float
        Largest one. [s]
    came : callable
        Takes when a frame came, on the steady clock [s]; its answer is sent next.
    """

    def __init__(self) -> None:
        self.counts = [0] * 48
        self.largest_s = 0.0
        self._waiting: list[float] = []
        self.came = self._waiting.append

    def sent(self, not_sent: int) -> None:
        """Count the frames that came since the last time, unless the bus did not take some of their answers."""
        waiting = self._waiting
        if not waiting:
            return
        if not not_sent:
            latency_s = time.monotonic() - waiting[0]
            self.counts[int(latency_s * 1e6).bit_length()] += len(waiting)
            self.largest_s = max(self.largest_s, latency_s)
        waiting.clear()

    def at_most_s(self, share: float) -> float:
        """Latency that this share of the frames does not exceed, up to a factor of 2 more than it is. [s]"""
        wanted = share * sum(self.counts)
        bits = next(n for n, below in enumerate(accumulate(self.counts)) if below >= wanted)
        return min(1e-6 * 2.0**bits, self.largest_s)


_PERIOD_S = 1.0


class Telemetry:
    """Writes a line per second, in a thread of its own: neither a disk nor a network holds up the bus.

    Parameters
    ----------
    target : Path or tuple of str and int
        File to which lines are added, or host and UDP port.
    corrector : Corrector
        What is told of.
    layout : Layout
        Names of the branches.
    latency : Latency
        Of the answers.
    buses : sequence of SteadyBus
        Buses of the node.
    say : callable
        Takes one line for the log, when lines begin to get lost and when they do no more.
    """

    def __init__(
        self,
        target: Path | tuple[str, int],
        corrector: Corrector,
        *,
        layout: Layout,
        latency: Latency,
        buses: Sequence[SteadyBus],
        say: Callable[[str], None],
    ) -> None:
        self._target, self._corrector, self._latency, self._buses, self._say = target, corrector, latency, buses, say
        self._names = {branch.name: branch.vss or branch.name for branch in layout.branch}
        self._due_s = time.monotonic()
        self._lines: queue.Queue[bytes] = queue.Queue(maxsize=1)
        threading.Thread(target=self._write_lines, name="telemetry", daemon=True).start()

    def look(self, now_s: float) -> None:
        """Hand over a line if it is time to; one that finds the last one still waiting is lost, and counted."""
        if now_s < self._due_s:
            return
        self._due_s = max(self._due_s + _PERIOD_S, now_s)
        line = json.dumps(self._record(now_s), separators=(",", ":"))
        try:
            self._lines.put_nowait(f"{line}\n".encode())
        except queue.Full:
            self._corrector.counters.telemetry_lost += 1

    def _record(self, now_s: float) -> dict[str, Any]:
        corrector, latency, sums = self._corrector, self._latency, self._corrector.watch.sums
        state, reason = corrector.told
        return {
            "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "state": state.name,
            "reason": reason.name,
            "parameter_set": corrector.parameter_set,
            "branches": {self._names[branch.name]: _branch(branch, now_s) for branch in corrector.branches},
            "sum_measured_a": None if sums is None else round(sums.measured_a, 3),
            "sum_corrected_a": None if sums is None else round(sums.corrected_a, 3),
            "latency_us": {
                "p50": round(1e6 * latency.at_most_s(0.5)),
                "p99.9": round(1e6 * latency.at_most_s(0.999)),
                "max": round(1e6 * latency.largest_s),
            },
            "buses": {bus.channel: bus.state for bus in self._buses},
            "counters": asdict(corrector.counters),
        }

    def _write_lines(self) -> None:
        failed = False
        while True:
            line = self._lines.get()
            try:
                if isinstance(self._target, Path):
                    _append(self._target, line)
                else:
                    _send(self._target, line)
            except OSError as error:
                self._corrector.counters.telemetry_lost += 1
                if not failed:
                    self._say(f"--telemetry: {error.strerror}; lines are lost until that has changed")
                failed = True
            else:
                if failed:
                    self._say("--telemetry: lines are written again")
                failed = False


def _branch(branch: LiveBranch, now_s: float) -> dict[str, Any]:
    """Measured current and what is published of it, positive into the junction. [A]"""
    is_old = branch.is_old(now_s)
    currents_a = None if is_old else branch.currents_at(branch.time_s)
    if currents_a is None:
        _, quality = branch.published(now_s)
        return {"measured_a": None, "corrected_a": None, "quality": quality.name}
    published_a = currents_a[branch.quality is Quality.CORRECTED]
    return {
        "measured_a": round(currents_a[0], 3),
        "corrected_a": round(published_a, 3),
        "quality": branch.quality.name,
    }


def _append(path: Path, line: bytes) -> None:
    """Add a line, whole or not at all; a pipe that nobody reads takes none."""
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK, 0o644)
    try:
        written = os.write(file, line)
        if written < len(line):
            os.ftruncate(file, os.fstat(file).st_size - written)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    finally:
        os.close(file)


def _send(address: tuple[str, int], line: bytes) -> None:
    host, port = address
    family, kind, protocol, _, found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    with socket.socket(family, kind, protocol) as out:
        out.sendto(line, found)
