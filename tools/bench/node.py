"""The node: time per frame, load, latency, start and memory, beside the plain version and a loop that does nothing.

Each part stands in a module of its own and says there what its figures are: :mod:`bench.node_core` (no bus),
:mod:`bench.node_virtual` (whole node, one process), :mod:`bench.node_process` (``ecu-node run``) and
:mod:`bench.node_socketcan` (processes on a SocketCAN kernel).
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from bench import node_core, node_process, node_virtual
from bench.row import Row

__all__ = ["FULL", "QUICK", "Sizes", "measure", "rows"]

_ROOT = Path(__file__).parents[2]
_NO_KERNEL = 2
"""Exit code of tools/with_vcan where there is no SocketCAN."""


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How much is measured.

    Attributes
    ----------
    repeats : int
        Rounds of the work without bus.
    frames, latency_frames : int
        On the virtual bus: as fast as they go, and one by one.
    load_frames : int
        At the rate of a full bus.
    process_frames : int
        Through ``ecu-node run``.
    socketcan_frames : int
        Through each way between two SocketCAN interfaces, three times; 0: none.
    """

    repeats: int
    frames: int
    latency_frames: int
    load_frames: int
    process_frames: int
    socketcan_frames: int


FULL = Sizes(
    repeats=100,
    frames=100_000,
    latency_frames=10_000,
    load_frames=10_000_000,
    process_frames=10_000_000,
    socketcan_frames=10_000,
)
QUICK = Sizes(
    repeats=20,
    frames=20_000,
    latency_frames=1_000,
    load_frames=100_000,
    process_frames=100_000,
    socketcan_frames=1_000,
)


def rows(*, quick: bool) -> list[Row]:
    """Measure.

    Parameters
    ----------
    quick : bool
        Whether few frames are enough.

    Returns
    -------
    list of Row
        All figures of the node.
    """
    return measure(QUICK if quick else FULL)


def measure(sizes: Sizes) -> list[Row]:
    """Measure so much.

    Parameters
    ----------
    sizes : Sizes
        How many frames of what.

    Returns
    -------
    list of Row
        All figures of the node; without those of SocketCAN where there is none, which is said on standard error.
    """
    return [
        *node_core.rows(sizes.repeats),
        *node_virtual.rows(sizes.frames, sizes.latency_frames),
        *node_virtual.load_rows(sizes.load_frames),
        *node_process.rows(sizes.process_frames),
        *(_socketcan_rows(sizes.socketcan_frames) if sizes.socketcan_frames else ()),
    ]


def _socketcan_rows(frames: int) -> list[Row]:
    """Rows measured on a kernel that has SocketCAN."""
    measured = [sys.executable, "-m", "bench.node_socketcan", "--frames", str(frames), "--json"]
    done = subprocess.run(
        [str(_ROOT / "tools" / "with_vcan"), *measured],
        capture_output=True,
        text=True,
        check=False,
        cwd=_ROOT,
        env={**os.environ, "PYTHONPATH": f"{_ROOT}{os.pathsep}{_ROOT / 'tools'}"},
    )
    if done.returncode == _NO_KERNEL:
        print(f"bench: no rows of SocketCAN: {done.stderr.strip()}", file=sys.stderr, flush=True)
        return []
    if done.returncode:
        raise RuntimeError(f"the rows of SocketCAN failed: {done.stdout}{done.stderr}")
    return [Row(**row) for row in json.loads(done.stdout)]
