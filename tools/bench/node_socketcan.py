"""The node as a process on SocketCAN, beside other ways from vcan0 to vcan1: run with ``tools/with_vcan``.

    PYTHONPATH=tools tools/with_vcan python -m bench.node_socketcan --frames 20000
    python -m bench.node_socketcan --peer bare|plain CHANNEL_IN CHANNEL_OUT    one of the other ways, until it is ended

Compared are ``ecu-node run --gateway``, a program in C that does the same, a python-can loop that only receives and
sends, the plain version with Notifier and cantools, and the kernel's own gateway (cangw), which changes nothing. One
raw socket sends, another one receives and compares each frame, both many frames at a time, so that what is measured is
what is between them. Where this runs on user-mode-linux a system call costs ten times more than on a bare machine, and
all share one processor: the ratios count there, not the rates.
"""

import argparse
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median, quantiles

import can

from bench.c_core import CORE
from bench.node import MEBIBYTE, command_line
from bench.node_vehicle import IDENTIFIER, BenchVehicle, make_vehicle, plain_job
from bench.row import Row
from calibrator.export.core import Checked, c_text
from ecu_node.bus.steady_bus import SocketCanLink
from ecu_node.bus.wiring import Mode
from ecu_node.parameters import write_parameters

__all__ = ["rows"]

IN, OUT = "vcan0", "vcan1"
ROUNDS = 3
"""In which all take their turns; the best counts."""
WINDOW = 64
"""Frames that are on their way at most: a socket's buffer holds some hundreds."""
PATIENCE_S = 60.0
QUIET_S = 0.5
"""When no frame comes for this long none is on its way. [s]"""
LATENCY_SHARE = 10
"""Every so many-th frame is sent alone, for its latency."""


def rows(frames: int) -> list[Row]:
    """Measure.

    Parameters
    ----------
    frames : int
        Sent through each of the ways, in each of the rounds.

    Returns
    -------
    list of Row
        Rate, latency, processor time, start and memory of each.
    """
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        vehicle = make_vehicle(Path(folder), numbered=True)
        write_parameters(vehicle.parameters, Path(folder) / "params.json")
        same = [bytes(payload) for payload in vehicle.frames]
        plain = [bytes(found) for found in map(plain_job(vehicle, Mode.GATEWAY), vehicle.frames) if found is not None]
        node = command_line(vehicle, "--interface", "socketcan", "--channel", IN, "--gateway", OUT)
        python = [sys.executable, "-m"]
        peer = [*python, "bench.node_socketcan", "--peer"]
        in_c = [str(_compiled_gateway(vehicle, Path(folder))), IN, OUT]
        ways: dict[str, Callable[[], dict[str, float]]] = {
            "cangw": lambda: _kernel(vehicle, same, frames),
            "bare loop": lambda: _process([*peer, "bare", IN, OUT], vehicle, same, frames),
            "plain": lambda: _process([*peer, "plain", IN, OUT], vehicle, plain, frames),
            "C": lambda: _process(in_c, vehicle, vehicle.corrected(Mode.GATEWAY), frames),
            "ecu-node": lambda: _process(
                [*python, "ecu_node", *node], vehicle, vehicle.corrected(Mode.GATEWAY), frames
            ),
        }
        rounds = [{name: way() for name, way in ways.items()} for _ in range(ROUNDS)]
    seen = {name: _best([found[name] for found in rounds]) for name in ways}
    return [row for name, figures in seen.items() for row in _rows(name, figures, seen["ecu-node"])]


def _best(figures: list[dict[str, float]]) -> dict[str, float]:
    """The best of each figure: the highest rate, the least of all others."""
    return {what: (max if what.startswith("rate") else min)(found[what] for found in figures) for what in figures[0]}


def _rows(name: str, figures: dict[str, float], node: dict[str, float]) -> Iterator[Row]:
    for what, value in figures.items():
        label, _, unit = what.rpartition(", ")
        peer = ratio = None
        if name != "ecu-node" and label != "memory" and what in node:
            ours = node[what]
            peer = f"as the peer of ecu-node, {ours:.3g} {unit}"
            ratio = value / ours if label == "rate" else ours / value
        yield Row(name=f"SocketCAN, {name}: {label}", value=value, unit=unit, peer=peer, ratio=ratio)


def _kernel(vehicle: BenchVehicle, expected: list[bytes], frames: int) -> dict[str, float]:
    subprocess.run(["cangw", "-A", "-s", IN, "-d", OUT, "-e"], check=True)
    try:
        with _line(vehicle, expected) as line:
            return line.measured(frames)
    finally:
        subprocess.run(["cangw", "-F"], check=True)


def _process(command: list[str], vehicle: BenchVehicle, expected: list[bytes], frames: int) -> dict[str, float]:
    with _line(vehicle, expected) as line:
        start_s = time.monotonic()
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                line.wait_for_first(lambda: process.poll() is None)
                begin_s = time.monotonic() - start_s
                line.let_run_dry()
                before_s = _cpu_s(process.pid)
                figures = line.measured(frames)
                all_frames = frames + frames // LATENCY_SHARE
                figures["CPU per 10^6 frames, s"] = 1e6 * (_cpu_s(process.pid) - before_s) / all_frames
                figures["start to first frame, s"] = begin_s
                figures["memory, MiB"] = _resident_bytes(process.pid) / MEBIBYTE
            finally:
                process.terminate()
    return figures


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
        """The next frames."""
        numbers = range(self._sent, self._sent + count)
        some = [self._frames[number % len(self._frames)] for number in numbers]
        done = 0
        while done < count:
            done += self._near.send(some, done)
        self._sent += count

    def receive(self, timeout_s: float) -> int | None:
        """Number of the frame that arrives next, once it is compared; None if none does in time."""
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
                return
            if not lives() or time.monotonic() > give_up_s:
                raise RuntimeError("nothing passes the frames on")

    def let_run_dry(self) -> None:
        """Receive what is still on its way."""
        while self.receive(QUIET_S) is not None:
            pass

    def measured(self, frames: int) -> dict[str, float]:
        """Rate and latencies; frames must arrive in order and all."""
        received = first = self._sent
        start_s = time.monotonic()
        while received < first + frames:
            if self._sent - received <= WINDOW // 2 and self._sent < first + frames:
                self.send(min(received + WINDOW, first + frames) - self._sent)
            self._require(received)
            received += 1
        per_frame_s = (time.monotonic() - start_s) / frames
        latencies_s = []
        for _ in range(frames // LATENCY_SHARE):
            time.sleep(0.001)
            start_s = time.monotonic()
            self.send()
            self._require(self._sent - 1)
            latencies_s.append(time.monotonic() - start_s)
        return {
            "rate, frames/s": 1.0 / per_frame_s,
            "latency, median, us": 1e6 * median(latencies_s),
            "latency, 99 %, us": 1e6 * quantiles(latencies_s, n=100, method="inclusive")[98],
            "latency, 99.9 %, us": 1e6 * quantiles(latencies_s, n=1000, method="inclusive")[998],
        }

    def _require(self, number: int) -> None:
        found = self.receive(PATIENCE_S)
        if found != number % len(self._frames):
            raise RuntimeError(f"frame {found} arrived, expected {number % len(self._frames)}")


@contextmanager
def _line(vehicle: BenchVehicle, expected: list[bytes]) -> Iterator[_Line]:
    kind = socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW
    with socket.socket(*kind) as near, socket.socket(*kind) as far:
        near.bind((IN,))
        far.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", IDENTIFIER, socket.CAN_SFF_MASK))
        far.bind((OUT,))
        yield _Line(near, far, vehicle, expected)


def _compiled_gateway(vehicle: BenchVehicle, folder: Path) -> Path:
    """The program in C, ``gateway CHANNEL_IN CHANNEL_OUT``: the C core with the vehicle's calibration."""
    checked = Checked(name="params", digest="0" * 64, parameters=vehicle.parameters, database=vehicle.database)
    (folder / "hv_calibration.c").write_text(c_text(checked))
    sources = [Path(__file__).with_name("node_gateway.c"), folder / "hv_calibration.c", CORE / "hv_correction.c"]
    subprocess.run([shutil.which("gcc") or "gcc", "-O2", f"-I{CORE}", *sources, "-o", folder / "gateway"], check=True)
    return folder / "gateway"


def _pass_on(kind: str, source: str, target: str) -> None:
    """The loop that receives and sends, or the plain version."""
    with (
        can.Bus(source, "socketcan", ignore_config=True) as receiving,
        can.Bus(target, "socketcan", ignore_config=True) as sending,
        tempfile.TemporaryDirectory(prefix="bench-") as folder,
    ):
        while kind == "bare":
            message = receiving.recv()
            if message is not None:
                sending.send(message)
        job = plain_job(make_vehicle(Path(folder), numbered=True), Mode.GATEWAY)

        def on_message(message: can.Message) -> None:
            data = job(message.data) if message.arbitration_id == IDENTIFIER else message.data
            if data is not None:
                message.data = data
                sending.send(message)

        with can.Notifier(receiving, [on_message]):
            signal.pause()


def _cpu_s(process: int) -> float:
    """Processor time of a process so far. [s]"""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


def _resident_bytes(process: int) -> float:
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * float(os.sysconf("SC_PAGE_SIZE"))


def main() -> None:
    """Measure and print one line per row, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--peer", nargs=3, metavar=("KIND", "CHANNEL_IN", "CHANNEL_OUT"), help="bare or plain")
    arguments = parser.parse_args()
    if arguments.peer:
        _pass_on(*arguments.peer)
    if shutil.which("cangw") is None:
        parser.exit(2, "cangw is not installed: apt-get install can-utils\n")
    found = rows(arguments.frames)
    if arguments.json:
        print(json.dumps([vars(row) for row in found]))
    else:
        for row in found:
            print(f"{row.name}: {row.value:.4g} {row.unit}")


if __name__ == "__main__":
    main()
