"""The node: time per frame, start, memory and load of its process, beside its peers in the same run.

Work per frame is measured without a bus. ``ecu-node run`` runs in a process of its own on the virtual bus, whose thread
beside it is :mod:`bench.node_child`. Rates and latencies on SocketCAN: :mod:`bench.node_socketcan`.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import cast

from bench.node_child import Seen
from bench.node_vehicle import IDENTIFIER, BenchVehicle, make_vehicle, plain_job
from bench.row import Row
from ecu_node.bus.wiring import Mode
from ecu_node.parameters import write_parameters

__all__ = ["command_line", "core_rows", "process_rows", "rows"]

ROOT = Path(__file__).parents[2]
TOOLS_ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}"}
NO_KERNEL = 2
"""Exit code of tools/with_vcan where there is no SocketCAN."""
ONE_CODE_A = 0.1
"""cantools rounds halves to even codes, the node upwards. [A]"""
FULL_BUS_HZ = 24_316.0
"""Frames of 8 bytes on a full CAN FD bus of 1 and 8 Mbit/s."""
STARTS = 5
"""Of which the median counts."""
SHORT = 15
"""Frames that are enough to see the start."""
MEBIBYTE = 1024.0**2


def rows(*, quick: bool) -> list[Row]:
    """Measure.

    Parameters
    ----------
    quick : bool
        Whether few frames are enough.

    Returns
    -------
    list of Row
        All figures of the node; without those of SocketCAN where there is none, which is said on standard error.
    """
    found = core_rows(20 if quick else 100) + process_rows(100_000 if quick else 10_000_000)
    command = [sys.executable, "-m", "bench.node_socketcan", "--frames", "1000" if quick else "10000", "--json"]
    done = subprocess.run(
        [ROOT / "tools" / "with_vcan", *command],
        capture_output=True, text=True, check=False, cwd=ROOT, env=TOOLS_ENVIRONMENT,
    )  # fmt: skip
    if done.returncode == NO_KERNEL:
        print(f"bench: no rows of SocketCAN: {done.stderr.strip()}", file=sys.stderr, flush=True)
        return found
    if done.returncode:
        raise RuntimeError(f"the rows of SocketCAN failed: {done.stdout}{done.stderr}")
    return found + [Row(**row) for row in json.loads(done.stdout)]


def core_rows(repeats: int) -> list[Row]:
    """What the node computes for one frame of a branch, in both modes, beside the same work with cantools.

    Parameters
    ----------
    repeats : int
        Rounds of frames, of which the quickest counts; the node and its peer take turns.

    Returns
    -------
    list of Row
        Time per frame.
    """
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        vehicle = make_vehicle(Path(folder), numbered=False)
        return [_core_row(vehicle, mode, repeats) for mode in Mode]


def _core_row(vehicle: BenchVehicle, mode: Mode, repeats: int) -> Row:
    _require_equal(vehicle, mode)
    sources, job, frames = vehicle.corrector(mode).sources, plain_job(vehicle, mode), vehicle.frames

    def node() -> None:  # as the loop over a bus hands them to the core
        find, key, overlay = sources.get, (IDENTIFIER, False), mode is Mode.OVERLAY
        for payload in frames:
            source = find(key)
            if source is not None:
                if overlay:
                    source.answer(payload, 0.0)
                else:
                    source.forward(payload, 0.0)

    def plain() -> None:
        for payload in frames:
            job(payload)

    both = [(_timed_s(node), _timed_s(plain)) for _ in range(repeats)]
    per_frame_s, peer_s = (min(times) / len(frames) for times in zip(*both, strict=True))
    return Row(
        name=f"branch frame, {mode.name.lower()}, two currents and P01, no bus",
        value=1e6 * per_frame_s,
        unit="us",
        peer=f"cantools decode and encode, {1e6 * peer_s:.1f} us",
        ratio=peer_s / per_frame_s,
    )


def _timed_s(run: Callable[[], None]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def _require_equal(vehicle: BenchVehicle, mode: Mode) -> None:
    """Refuse to compare ways that give different results."""
    message = vehicle.database.message("Pair" if mode is Mode.GATEWAY else "PairOut")
    job = plain_job(vehicle, mode)
    others = [bytes(payload) for payload in map(job, vehicle.frames) if payload is not None]
    for ours, other in zip(vehicle.corrected(mode), others, strict=True):
        a, b = message.decode_simple(ours), message.decode_simple(other)
        for name in a.keys() - {"Crc"}:  # which follows from the others
            difference = abs(float(a[name]) - float(b[name]))  # type: ignore[arg-type]
            if difference > (1.01 * ONE_CODE_A if name in {"Battery", "Motor"} else 0.0):
                raise RuntimeError(f"{name} of {ours.hex()} differs from that of {other.hex()} by {difference}")


def process_rows(frames: int) -> list[Row]:
    """Start, memory and processor time of a real ``ecu-node run``.

    Parameters
    ----------
    frames : int
        After how many the memory is read.

    Returns
    -------
    list of Row
        Time to the first corrected frame, memory at the start and at the end, processor time.
    """
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        vehicle = make_vehicle(Path(folder), numbered=True)
        write_parameters(vehicle.parameters, Path(folder) / "params.json")
        starts = [_watched(vehicle, SHORT) for _ in range(STARTS)]
        long = _watched(vehicle, frames)
    if long["wrong"] or long["frames"] != frames or long["modules"]:
        raise RuntimeError(f"the node's process is not what it should be: {long}")
    label = "ecu-node run, gateway on the virtual bus"
    after = f"{label}: memory after {frames:,} frames"
    extras = f"{long['extras_bytes'] / MEBIBYTE:.1f} MiB of which belong to the thread, bus and frames beside it"
    return [
        Row(name=f"{label}: process to first corrected frame", value=median(s["start_s"] for s in starts), unit="s"),
        Row(name=f"{label}: process to ready", value=median(s["ready_s"] for s in starts), unit="s"),
        Row(name=f"{label}: memory when ready", value=long["ready_bytes"] / MEBIBYTE, unit="MiB"),
        Row(name=f"{after}, {extras}", value=long["end_bytes"] / MEBIBYTE, unit="MiB"),
        Row(name=f"{label}: peak memory, the same included", value=long["peak_bytes"] / MEBIBYTE, unit="MiB"),
        Row(
            name=f"{label}: growth from the first frame to the last",
            value=(long["end_bytes"] - long["ready_bytes"] - long["extras_bytes"]) / MEBIBYTE,
            unit="MiB",
        ),
        Row(
            name=f"{label}: share of a core at {FULL_BUS_HZ:.0f} frames/s, a full CAN FD bus",
            value=100.0 * FULL_BUS_HZ * long["cpu_s"] / frames,
            unit="%",
        ),
    ]


def command_line(vehicle: BenchVehicle, *options: str) -> list[str]:
    """Arguments of ``ecu-node`` for a vehicle whose parameters stand beside its layout."""
    layout = vehicle.database.layout.path
    return ["run", "--unsigned", "--params", str(layout.parent / "params.json"), "--layout", str(layout), *options]


def _watched(vehicle: BenchVehicle, frames: int) -> Seen:
    """Start a node in a process of its own, let it correct frames, and end it.

    Parameters
    ----------
    vehicle : BenchVehicle
        Whose frames are sent; ``params.json`` stands beside its layout.
    frames : int
        How many are sent.

    Returns
    -------
    Seen
        What the thread beside the node saw.

    Raises
    ------
    RuntimeError
        If the node did not do its work.
    """
    channels = ["node in", "node out"]
    job = {
        "arguments": command_line(
            vehicle, "--interface", "virtual", "--channel", channels[0], "--gateway", channels[1]
        ),
        "channels": channels,
        "identifier": IDENTIFIER,
        "frames": [frame.hex() for frame in vehicle.frames[:150]],
        "expected": [frame.hex() for frame in vehicle.corrected(Mode.GATEWAY)[:150]],
        "count": frames,
        "created_s": time.monotonic(),
    }
    command = [sys.executable, "-m", "bench.node_child", json.dumps(job)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=TOOLS_ENVIRONMENT)
    if done.returncode or "frames" not in done.stdout:
        raise RuntimeError(f"the node did not run: {done.stdout}{done.stderr}")
    return cast("Seen", json.loads(done.stdout))
