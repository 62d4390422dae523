"""MDF 4 files, read in another process that a time limit ends: frames of a bus, or decoded channels.

The format is a graph of binary blocks that point at each other; a damaged one can keep its reader busy for ever.
Needs the extra ``mf4`` (asammdf).
"""

import atexit
import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import (
    CLASSIC_BYTES,
    DAMAGED,
    DATA,
    EXTENDED_BIT,
    FD_BYTES,
    LARGEST_IDENTIFIER,
    LATEST_TIME_STAMP_NS,
    FrameColumns,
    Frames,
    concatenate_frames,
)

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["convert", "read_mf4", "read_mf4_table"]

START_S = 60.0
"""Time for the process to start on a slow machine; asammdf imports much. [s]"""
BYTES_PER_S = 20_000.0
"""Slowest reading that is still waited for, a tenth of what a slow machine does."""
_DONE = "done"


def read_mf4(path: Path) -> Frames:
    """Read the frames of an MDF 4 log.

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
    with _converted(path, "frames.npz") as result, np.load(result, allow_pickle=False) as arrays:
        columns: dict[str, Any] = {name: value if value.ndim else int(value) for name, value in arrays.items()}
    return Frames(**{**columns, "channels": tuple(map(str, columns["channels"]))})


def read_mf4_table(path: Path) -> "tuple[pd.DataFrame, dict[str, str]]":
    """Read the decoded channels of an MDF 4 file; raises as :func:`read_mf4`.

    Parameters
    ----------
    path : Path
        The uncompressed file.

    Returns
    -------
    frame : DataFrame
        A row per instant [s] of any channel, in the index; NaN where a channel has none then.
    units : dict of str to str
        By channel.
    """
    import pandas as pd  # noqa: PLC0415 (the process that reads frames does without)

    with _converted(path, "channels.parquet") as result:
        frame = pd.read_parquet(result)
    return frame, frame.attrs["units"]


@contextmanager
def _converted(path: Path, name: str) -> Iterator[Path]:
    """File of this name that another process made of an MDF 4 file."""
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{path}: reading MF4 needs asammdf; pip install 'hv-current-correction[mf4]'")
    with tempfile.TemporaryDirectory(prefix="mf4-") as folder:
        result = Path(folder) / name
        limit_s = START_S + path.stat().st_size / BYTES_PER_S
        if _process(os.getpid()).poll() is not None:  # somebody ended it, as for the memory that it took
            _process.cache_clear()
        process = _process(os.getpid())
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps([str(path), str(result), limit_s]) + "\n")
        process.stdin.flush()
        answer = process.stdout.readline().strip()
        if not answer:  # it has ended
            _process.cache_clear()
            if process.wait() == -signal.SIGALRM:
                raise LogError(
                    f"{path}: reading took more than {limit_s:.0f} s and was ended; the file is damaged, "
                    f"convert it to .blf with the tool that recorded it"
                )
            answer = "the reader ended without a word"
        if answer != _DONE:
            raise LogError(f"{path}: not a readable MF4 file: {answer[:200]}; copy the file again")
        yield result


@cache
def _process(_pid: int) -> "subprocess.Popen[str]":
    """The process that reads files for this one, one after the other: to start it takes longer than most of them."""
    command = [sys.executable, "-W", "ignore", "-m", "calibrator.recordings.mf4"]
    process = subprocess.Popen(  # noqa: S603
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    atexit.register(_end, process)
    return process


def _end(process: "subprocess.Popen[str]") -> None:
    process.kill()
    process.communicate()


def main() -> None:
    """What the process does: read a line with path, result and time limit, convert, answer with a line."""
    answers, sys.stdout = sys.stdout, sys.stderr  # what libraries print is no answer
    for line in sys.stdin:
        path, result, limit_s = json.loads(line)
        signal.setitimer(signal.ITIMER_REAL, limit_s)  # ends the process, whatever it is busy with
        try:
            convert(path, result)
            answer = _DONE
        except Exception as error:  # noqa: BLE001 (asammdf raises anything for a damaged file)
            answer = " ".join(f"{type(error).__name__}: {error}".split())
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        print(answer, file=answers, flush=True)


def convert(path: str, result: str) -> None:
    """Write frames (.npz) or decoded channels (.parquet) of `path` to `result`."""
    from asammdf import MDF  # noqa: PLC0415 (only here: the parent needs neither)

    with MDF(path) as mdf:
        if result.endswith(".parquet"):
            _decoded_channels(mdf).to_parquet(result)
        else:
            frames = _frames(mdf)
            np.savez(result, **{**vars(frames), "channels": np.array(frames.channels, dtype=np.str_)})


def _decoded_channels(mdf: Any) -> "pd.DataFrame":
    frame: pd.DataFrame = mdf.to_dataframe(use_display_names=True, time_as_date=False, reduce_memory_usage=False)
    units = {
        name: channel.unit
        for group in mdf.groups
        for channel in group.channels
        for name in (channel.name, *channel.display_names)
        if channel.unit
    }
    frame = frame.rename_axis("time [s]")
    frame.attrs["units"] = {name: unit for name in frame if (unit := units.get(name))}
    return frame


def _frames(mdf: Any) -> Frames:
    """Frames of all groups of a bus log, as the standard of ASAM names their channels."""
    parts, counts = [], dict.fromkeys(("CAN_ErrorFrame", "CAN_RemoteFrame"), 0)
    for number, group in enumerate(mdf.groups):
        names = {channel.name for channel in group.channels}
        for name in names & counts.keys():
            counts[name] += int(group.channel_group.cycles_nr)
        if "CAN_DataFrame" in names and group.channel_group.cycles_nr:
            parts.append(_frames_of_group(mdf.get("CAN_DataFrame", group=number, raw=True), mdf.header.start_time))
    frames = concatenate_frames(parts)
    if len(parts) > 1:
        frames = frames.take(np.argsort(frames.time_ns, kind="stable"))
    errors, remote = counts.values()
    return replace(frames, error_frames=errors, remote_frames=remote)


def _frames_of_group(signal: Any, start: Any) -> Frames:
    """Data frames of one group; those of impossible length or time are damaged."""
    known = {name.removeprefix("CAN_DataFrame.") for name in signal.samples.dtype.names}

    def field(name: str, default: int) -> Any:
        return signal.samples[f"CAN_DataFrame.{name}"] if name in known else np.full(len(signal.samples), default)

    length, dlc, fd = (field(name, 0).astype(np.int64) for name in ("DataLength", "DLC", "EDL"))
    stored = field("DataBytes", 0)
    columns = FrameColumns.of(len(length), fd=bool(np.any(length > CLASSIC_BYTES)))
    width = min(columns.data.shape[1], stored.shape[1])
    columns.data[:, :width] = np.where(np.arange(width) < length[:, None], stored[:, :width], 0)
    time_s = signal.timestamps + start.timestamp()
    possible = (time_s >= 0.0) & (time_s <= 1e-9 * LATEST_TIME_STAMP_NS)
    possible &= np.where(fd > 0, length <= FD_BYTES, length == np.minimum(dlc, CLASSIC_BYTES))
    columns.kind[:] = np.where(possible, DATA, DAMAGED)
    columns.time_ns[:] = np.rint(1e9 * np.where(possible, time_s, 0.0))
    identifier = field("ID", 0).astype(np.uint32) & np.uint32(LARGEST_IDENTIFIER)
    columns.key[:] = identifier | np.where(field("IDE", 1) > 0, np.uint32(EXTENDED_BIT), np.uint32(0))
    channels, columns.channel[:] = np.unique(field("BusChannel", 0), return_inverse=True)
    columns.length[:] = length
    return columns.frames([str(channel) for channel in channels.tolist()] if "BusChannel" in known else ["None"])


if __name__ == "__main__":
    main()
