"""Start, memory and processor time of a real ``ecu-node run`` on the virtual bus; see :mod:`bench.node_child`."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import cast

from bench.node_child import Seen
from bench.node_vehicle import IDENTIFIER, BenchVehicle, make_vehicle
from bench.row import Row
from ecu_node.bus.wiring import Mode
from ecu_node.parameters import write_parameters

__all__ = ["command_line", "rows", "watched"]

STARTS = 5
"""Of which the median counts."""
SHORT = 15
"""Frames that are enough to see the start."""
MEBIBYTE = 1024.0**2


def rows(frames: int) -> list[Row]:
    """Measure.

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
        starts = [watched(vehicle, SHORT) for _ in range(STARTS)]
        long = watched(vehicle, frames)
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
        Row(name=f"{label}: CPU per 10^6 frames", value=1e6 * long["cpu_s"] / frames, unit="s"),
    ]


def command_line(vehicle: BenchVehicle, *options: str) -> list[str]:
    """Arguments of ``ecu-node`` for a vehicle whose parameters stand beside its layout."""
    layout = vehicle.database.layout.path
    return ["run", "--unsigned", "--params", str(layout.parent / "params.json"), "--layout", str(layout), *options]


def watched(vehicle: BenchVehicle, frames: int) -> Seen:
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
    tools = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (tools, tools.parent)))}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode or "frames" not in done.stdout:
        raise RuntimeError(f"the node did not run: {done.stdout}{done.stderr}")
    return cast("Seen", json.loads(done.stdout))
