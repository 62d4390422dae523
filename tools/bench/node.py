"""The node: time per frame, start and memory of its process, beside its peers in the same run.

Work per frame is measured without a bus. ``ecu-node run`` runs in a process of its own on the virtual bus, beside a
thread that sends to it, see :mod:`bench.node_child`. Rates and latencies on SocketCAN: :mod:`bench.node_socketcan`.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from bench.node_vehicle import IDENTIFIER, BenchVehicle, make_vehicle, plain_job
from bench.row import Row
from ecu_node.bus.wiring import Mode

__all__ = ["core_rows", "process_rows", "rows"]

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}", "PYTHONDONTWRITEBYTECODE": ""}
"""Bytecode is cached, as where the node is installed: without it a start takes twice as long."""
NO_KERNEL = 2
"""Exit code of tools/with_vcan where there is no SocketCAN."""
ONE_CODE_A = 0.1
"""Difference allowed between node and cantools: the latter rounds halves to even codes, the node upwards. [A]"""
PATIENCE_S = 60.0
STARTS = 5
"""Number of starts, of which the median counts."""
SHORT, ROUND = 15, 150
"""Number of frames sent where only the start is measured; number of different frames sent, after which they repeat."""


def rows(*, quick: bool) -> list[Row]:
    """Measure all figures; those of SocketCAN are left out where there is none, with a line on standard error."""
    found = core_rows(20 if quick else 100) + process_rows(100_000 if quick else 10_000_000)
    words = ("-m", "bench.node_socketcan", "--frames", "1000" if quick else "10000", "--as-json")
    command: list[str | Path] = [ROOT / "tools" / "with_vcan", sys.executable, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, env=ENVIRONMENT)
    if done.returncode == NO_KERNEL:
        print(f"bench: no rows of SocketCAN: {done.stderr.strip()}", file=sys.stderr, flush=True)
        return found
    if done.returncode:
        raise RuntimeError(f"the rows of SocketCAN failed: {done.stdout}{done.stderr}")
    return found + [Row(**row) for row in json.loads(done.stdout)]


def core_rows(repeats: int) -> list[Row]:
    """Measure what the node computes for one frame of a branch, in both modes, beside the same work with cantools.

    Parameters
    ----------
    repeats : int
        Rounds of frames, of which the quickest counts; the node and its peer take turns.

    Returns
    -------
    list of Row
        Time per frame.
    """
    found = []
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        vehicle = make_vehicle(Path(folder))
    for mode in Mode:
        _require_equal(vehicle, mode)
        sources, job = vehicle.corrector(mode).sources, plain_job(vehicle, mode)
        times: list[tuple[float, float]] = []
        for _ in range(repeats):
            start_s = time.perf_counter()
            for payload in vehicle.frames:  # as the loop over a bus hands them to the core
                source = sources.get((IDENTIFIER, False))
                if source is not None:
                    if mode is Mode.OVERLAY:
                        source.answer(payload, 0.0)
                    else:
                        source.forward(payload, 0.0)
            middle_s = time.perf_counter()
            for payload in vehicle.frames:
                job(payload)
            times.append((middle_s - start_s, time.perf_counter() - middle_s))
        ours_us, peer_us = (1e6 * min(some) / len(vehicle.frames) for some in zip(*times, strict=True))
        name = f"branch frame, {mode.name.lower()}, two currents and P01, no bus"
        peer = f"cantools decode and encode, {peer_us:.1f} us"
        found.append(Row(name=name, value=ours_us, unit="us", peer=peer, ratio=peer_us / ours_us))
    return found


def _require_equal(vehicle: BenchVehicle, mode: Mode) -> None:
    """Raise RuntimeError if the node and its peer make different payloads of the frames."""
    message = vehicle.database.message("Pair" if mode is Mode.GATEWAY else "PairOut")
    others = [bytes(payload) for payload in map(plain_job(vehicle, mode), vehicle.frames) if payload is not None]
    for ours, other in zip(vehicle.corrected(mode), others, strict=True):
        a, b = message.decode_simple(ours), message.decode_simple(other)
        for name in a.keys() - {"Crc"}:  # which follows from the others
            difference = abs(float(a[name]) - float(b[name]))  # type: ignore[arg-type]
            if difference > (1.01 * ONE_CODE_A if name in {"Battery", "Motor"} else 0.0):
                raise RuntimeError(f"{name} of {ours.hex()} differs from that of {other.hex()} by {difference}")


def process_rows(frames: int) -> list[Row]:
    """Measure the time until a real ``ecu-node run`` is ready, and its memory after so many frames."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        vehicle = make_vehicle(Path(folder))
        ready_s = median(_run_node(vehicle, SHORT)[0] for _ in range(STARTS))
        _, first_mib, last_mib = _run_node(vehicle, frames)
    label = "ecu-node run, gateway on the virtual bus"  # listens for 0.15 s before it is ready: 1.5 status periods
    return [
        Row(name=f"{label}: process to ready", value=ready_s, unit="s"),
        Row(name=f"{label}: memory after {frames:,} frames", value=last_mib, unit="MiB"),
        Row(name=f"{label}: growth from the first frame to the last", value=last_mib - first_mib, unit="MiB"),
    ]


def _run_node(vehicle: BenchVehicle, frames: int) -> tuple[float, float, float]:
    """Start a node in a process of its own, let it correct frames, and end it.

    Returns
    -------
    tuple of float
        Time until it is ready [s], memory after the first and after the last frame [MiB].
    """
    channels = ["node in", "node out"]
    job = {
        "arguments": vehicle.command("--interface", "virtual", "--channel", channels[0], "--gateway", channels[1]),
        "channels": channels,
        "identifier": IDENTIFIER,
        "frames": [frame.hex() for frame in vehicle.frames[:ROUND]],
        "expected": [frame.hex() for frame in vehicle.corrected(Mode.GATEWAY)[:ROUND]],
        "count": frames,
    }
    command, address = [sys.executable, "-m", "bench.node_child", json.dumps(job)], f"bench-node-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"\0{address}")
        manager.settimeout(PATIENCE_S)
        environment, pipe, start_s = {**ENVIRONMENT, "NOTIFY_SOCKET": f"@{address}"}, subprocess.PIPE, time.monotonic()
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment) as process:
            while not manager.recv(4096).startswith(b"READY=1"):
                pass
            ready_s = time.monotonic() - start_s
            printed, said = process.communicate("ready\n")
    if process.returncode:
        raise RuntimeError(f"the node did not run: {said}")
    first_mib, last_mib = json.loads(printed)
    return ready_s, first_mib, last_mib
