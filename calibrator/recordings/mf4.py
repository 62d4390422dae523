"""MDF 4 logs, read in a process of their own that a time limit ends.

The format is a graph of binary blocks that point at each other; a damaged one can keep its reader busy for ever.
Needs the extra ``mf4`` (asammdf).
"""

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import Frames

__all__ = ["main", "read_mf4"]

START_S = 60.0
"""Time for the process to start on a slow machine; asammdf imports much. [s]"""
BYTES_PER_S = 20_000.0
"""Slowest reading that is still waited for, a tenth of what a slow machine does."""


def read_mf4(path: Path) -> Frames:
    """Read an MDF 4 log.

    Parameters
    ----------
    path : Path
        The uncompressed file.

    Returns
    -------
    Frames
        Its frames, in the order of their time stamps.

    Raises
    ------
    LogError
        If asammdf is not installed, the file is damaged, or reading takes too long.
    """
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{path}: reading MF4 needs asammdf; pip install 'hv-current-correction[mf4]'")
    limit_s = START_S + path.stat().st_size / BYTES_PER_S
    with tempfile.TemporaryDirectory(prefix="mf4-") as folder:
        result = Path(folder) / "frames.npz"
        command = [sys.executable, "-W", "ignore", "-m", "calibrator.recordings.mf4", str(path), str(result)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=limit_s, check=False, text=True)  # noqa: S603
        except subprocess.TimeoutExpired:
            raise LogError(
                f"{path}: reading took more than {limit_s:.0f} s and was ended; the file is damaged, "
                f"convert it to .blf with the tool that recorded it"
            ) from None
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["the reader ended without a word"])[-1]
            raise LogError(f"{path}: not a readable MF4 log: {reason[:200]}; copy the file again")
        return _load(result)


def main(path: str, result: str) -> None:
    """Read `path` through python-can and write its arrays to `result`: what the process does."""
    import can  # noqa: PLC0415 (only here: the parent needs neither)

    from calibrator.recordings.frame_arrays import FrameCollector  # noqa: PLC0415

    collector = FrameCollector()
    with can.MF4Reader(path) as reader:
        for message in reader:
            collector.add(message)
    frames = collector.frames()
    np.savez(result, **{**vars(frames), "channels": np.array(frames.channels, dtype=np.str_)})


def _load(path: Path) -> Frames:
    with np.load(path, allow_pickle=False) as arrays:
        return Frames(
            time_ns=arrays["time_ns"],
            key=arrays["key"],
            channel=arrays["channel"],
            length=arrays["length"],
            data=arrays["data"],
            channels=tuple(str(name) for name in arrays["channels"]),
            error_frames=int(arrays["error_frames"]),
            remote_frames=int(arrays["remote_frames"]),
            damaged=int(arrays["damaged"]),
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
