"""The node as a process on SocketCAN, beside other ways from vcan0 to vcan1: run with ``tools/with_vcan``.

    PYTHONPATH=tools tools/with_vcan python -m bench.node_socketcan --frames 20000

Compared are ``ecu-node run --gateway``, a program in C that does the same, a python-can loop that only receives and
sends, and the plain version with Notifier and cantools. One raw socket sends, another one receives and compares each
frame, both many frames at a time, so that the time measured is spent between them. On user-mode-linux a system call
costs ten times more than on a bare machine, and all share one processor: there the ratios count, not the rates.
"""

import json
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import median, quantiles

import can
import typer

from bench.c_core import CORE
from bench.node_vehicle import IDENTIFIER, BenchVehicle, make_vehicle, plain_job
from bench.row import Row, show
from calibrator.export.core import Checked, c_text
from ecu_node.bus.steady_bus import SocketCanLink
from ecu_node.bus.wiring import Mode

__all__ = ["rows"]

IN, OUT = "vcan0", "vcan1"
ROUNDS = 3
"""Number of rounds, in which all ways take turns; the best one counts."""
WINDOW = 64
"""Most frames that are on their way at once: a socket's buffer holds some hundreds."""
PATIENCE_S = 60.0
FIGURES = {"rate": "frames/s", "latency, median": "us", "latency, 99.9 %": "us"}
"""Figures of each way, with their units."""
QUIET_S = 0.5
"""If no frame comes for this long, none is on its way. [s]"""
LATENCY_SHARE = 10
"""For every so many frames that measure the rate, one frame, sent alone, measures the latency."""


def rows(frames: int) -> list[Row]:
    """Measure rate and latencies of each way, with the given number of frames in each round."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        vehicle, python = make_vehicle(Path(folder)), [sys.executable, "-m"]
        corrected = vehicle.corrected(Mode.GATEWAY)
        plain = [bytes(found) for found in map(plain_job(vehicle, Mode.GATEWAY), vehicle.frames) if found is not None]
        node = vehicle.command("--interface", "socketcan", "--channel", IN, "--gateway", OUT)
        ways = {
            "bare loop": ([*python, "bench.node_socketcan", "--peer", "bare"], [bytes(x) for x in vehicle.frames]),
            "plain": ([*python, "bench.node_socketcan", "--peer", "plain"], plain),
            "C": ([str(_compiled_gateway(vehicle, Path(folder))), IN, OUT], corrected),
            "ecu-node": ([*python, "ecu_node", *node], corrected),
        }
        rounds = [{name: _measured(*way, vehicle, frames) for name, way in ways.items()} for _ in range(ROUNDS)]
    found = []
    for name, (what, unit) in product(ways, FIGURES.items()):
        best = max if what == "rate" else min
        value, ours = (best(figures[way][what] for figures in rounds) for way in (name, "ecu-node"))
        row = Row(name=f"SocketCAN, {name}: {what}", value=value, unit=unit)
        if name != "ecu-node":
            ratio = value / ours if what == "rate" else ours / value
            row = replace(row, peer=f"as the peer of ecu-node, {ours:.3g} {unit}", ratio=ratio)
        found.append(row)
    return found


def _measured(command: list[str], expected: list[bytes], vehicle: BenchVehicle, frames: int) -> dict[str, float]:
    """Return :data:`FIGURES` of a process between the two buses; all frames must arrive, and in order."""
    kind, quiet = (socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW), subprocess.DEVNULL
    with socket.socket(*kind) as near, socket.socket(*kind) as far:
        near.bind((IN,))
        far.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", IDENTIFIER, socket.CAN_SFF_MASK))
        far.bind((OUT,))
        line = _Line(near, far, vehicle, expected)
        with subprocess.Popen(command, stdout=quiet, stderr=quiet) as process:
            try:
                line.wait_for_first(lambda: process.poll() is None)
                return line.measured(frames)
            finally:
                process.terminate()


class _Line:
    """Both ends: frames go in at one and are compared at the other."""

    def __init__(self, near: socket.socket, far: socket.socket, vehicle: BenchVehicle, expected: list[bytes]) -> None:
        self._near, self._far = SocketCanLink(near), SocketCanLink(far)
        self._frames = [
            can.Message(arbitration_id=IDENTIFIER, is_extended_id=False, data=payload) for payload in vehicle.frames
        ]
        self._expected = {payload[6:8]: payload for payload in expected}
        self._sent = 0

    def send(self, count: int = 1) -> None:
        """Send the next frames."""
        numbers = range(self._sent, self._sent + count)
        some = [self._frames[number % len(self._frames)] for number in numbers]
        done = 0
        while done < count:
            done += self._near.send(some, done)
        self._sent += count

    def receive(self, timeout_s: float) -> int | None:
        """Receive and compare the next frame, and return its number; None if none arrives in time."""
        message = self._far.receive(timeout_s)
        if message is None:
            return None
        data = bytes(message.data)
        if data != self._expected[data[6:8]]:
            raise RuntimeError(f"{data.hex()} arrived, must be {self._expected[data[6:8]].hex()}")
        return int.from_bytes(data[6:8], "little")

    def wait_for_first(self, lives: Callable[[], bool]) -> None:
        """Send now and then until the first one arrives."""
        give_up_s = time.monotonic() + PATIENCE_S
        while True:
            self.send()
            if self.receive(0.01) is not None:
                while self.receive(QUIET_S) is not None:  # what is still on its way
                    pass
                return
            if not lives() or time.monotonic() > give_up_s:
                raise RuntimeError("nothing passes the frames on")

    def measured(self, frames: int) -> dict[str, float]:
        """Return :data:`FIGURES`; all frames must arrive, and in order."""
        received = first = self._sent
        start_s, latencies_s = time.monotonic(), []
        while received < first + frames:
            if self._sent - received <= WINDOW // 2 and self._sent < first + frames:
                self.send(min(received + WINDOW, first + frames) - self._sent)
            self._require(received)
            received += 1
        per_frame_s = (time.monotonic() - start_s) / frames
        for _ in range(frames // LATENCY_SHARE):
            time.sleep(0.001)
            start_s = time.monotonic()
            self.send()
            self._require(self._sent - 1)
            latencies_s.append(time.monotonic() - start_s)
        slow_us = 1e6 * quantiles(latencies_s, n=1000, method="inclusive")[998]
        return dict(zip(FIGURES, (1.0 / per_frame_s, 1e6 * median(latencies_s), slow_us), strict=True))

    def _require(self, number: int) -> None:
        """Receive the next frame; raise RuntimeError if it is not the frame of this number."""
        found = self.receive(PATIENCE_S)
        if found != number % len(self._frames):
            raise RuntimeError(f"frame {found} arrived, expected {number % len(self._frames)}")


def _compiled_gateway(vehicle: BenchVehicle, folder: Path) -> Path:
    """Compile the program in C, ``gateway CHANNEL_IN CHANNEL_OUT``: the C core with the vehicle's calibration."""
    checked = Checked(name="params", digest="0" * 64, parameters=vehicle.parameters, database=vehicle.database)
    (folder / "hv_calibration.c").write_text(c_text(checked))
    sources = [Path(__file__).with_name("node_gateway.c"), folder / "hv_calibration.c", CORE / "hv_correction.c"]
    subprocess.run([shutil.which("gcc") or "gcc", "-O2", f"-I{CORE}", *sources, "-o", folder / "gateway"], check=True)
    return folder / "gateway"


def _pass_on(kind: str) -> None:
    """Run the bare loop, which only receives and sends, or the plain version."""
    with (
        can.Bus(IN, "socketcan", ignore_config=True) as receiving,
        can.Bus(OUT, "socketcan", ignore_config=True) as sending,
        tempfile.TemporaryDirectory(prefix="bench-") as folder,
    ):
        while kind == "bare":
            message = receiving.recv()
            if message is not None:
                sending.send(message)
        job = plain_job(make_vehicle(Path(folder)), Mode.GATEWAY)

        def on_message(message: can.Message) -> None:
            data = job(message.data) if message.arbitration_id == IDENTIFIER else message.data
            if data is not None:
                message.data = data
                sending.send(message)

        with can.Notifier(receiving, [on_message]):
            signal.pause()


def main(*, frames: int = 20_000, as_json: bool = False, peer: str = "") -> None:
    """Measure and print one line per row, or JSON; with --peer act as one of the other ways, until ended."""
    if peer:
        _pass_on(peer)
    found = rows(frames)
    if as_json:
        print(json.dumps([vars(row) for row in found]))
    else:
        show(found)


if __name__ == "__main__":
    typer.run(main)
