"""Read MDF 4 files with asammdf: frames of a bus, or decoded channels. Needs the extra ``mf4``.

The format is a graph of binary blocks that point at each other. A damaged file can keep its reader busy for ever or
exhaust the memory; files that cannot be trusted are therefore read within the limits of :func:`.try_many`.
"""

import gc
import importlib.util
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from logging import CRITICAL, getLogger
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

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

__all__ = ["read_mf4", "read_mf4_table"]


def read_mf4(path: Path) -> Frames:
    """Read the frames of an MDF 4 log.

    Parameters
    ----------
    path : Path
        The file, unpacked if it came as .gz or in a .zip; blocks that are compressed within it are read as well.

    Returns
    -------
    Frames
        Its frames, in the order of their time stamps.

    Raises
    ------
    LogError
        If asammdf is not installed, or the file is damaged.
    """
    with _opened(path) as mdf:
        return _frames(mdf)


def read_mf4_table(path: Path) -> tuple[pd.DataFrame, dict[str, str]]:
    """Read the decoded channels of an MDF 4 file; raise LogError as :func:`read_mf4` does.

    Parameters
    ----------
    path : Path
        The file, unpacked if it came as .gz or in a .zip; blocks that are compressed within it are read as well.

    Returns
    -------
    frame : DataFrame
        One row per instant at which any channel has a value; the index is the time [s]. NaN where a channel has no
        value at that instant.
    units : dict of str to str
        Unit of each channel that has one.
    """
    with _opened(path) as mdf:
        frame: pd.DataFrame = mdf.to_dataframe(use_display_names=True, time_as_date=False, reduce_memory_usage=False)
        units = {
            name: channel.unit
            for group in mdf.groups
            for channel in group.channels
            for name in (channel.name, *channel.display_names)
            if channel.unit
        }
    return frame.rename_axis("time [s]"), {name: unit for name in frame if (unit := units.get(name))}


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file; in the block any exception but MemoryError becomes a LogError, and asammdf prints nothing."""
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{path}: reading MF4 needs asammdf; pip install 'hv-current-correction[mf4]'")
    reason, hook = "", sys.unraisablehook
    with redirect_stdout(sys.stderr), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from asammdf import MDF  # noqa: PLC0415 (an extra, slow to import)

        getLogger("asammdf").setLevel(CRITICAL)
        sys.unraisablehook = lambda _: None  # asammdf fails when it closes a damaged file
        try:
            with MDF(path) as mdf:
                yield mdf
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 (asammdf raises anything for a damaged file)
            reason = " ".join(f"{type(error).__name__}: {error}".split())
        finally:
            if reason:
                gc.collect()
            sys.unraisablehook = hook
    if reason:
        raise LogError(f"{path}: not a readable MF4 file: {reason[:200]}; copy the file again")


def _frames(mdf: Any) -> Frames:
    """Return the frames of all groups of a bus log; their channels have the names that the ASAM standard sets."""
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
    """Return the data frames of one group; frames with an impossible length or time are marked as damaged."""
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
