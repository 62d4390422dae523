"""Logs of SavvyCAN and other programs of GVRET.

``Time Stamp,ID,Extended,Dir,Bus,LEN,D1,...``: microseconds, and identifier and bytes in hexadecimal digits.
"""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from calibrator.drive import Array
from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import (
    CLASSIC_BYTES,
    DAMAGED,
    DATA,
    EXTENDED_BIT,
    LARGEST_IDENTIFIER,
    LATEST_TIME_STAMP_NS,
    FrameColumns,
    Frames,
)
from calibrator.recordings.log_files import MAX_DAMAGED_SHARE, open_log, read_rows, reason_of

__all__ = ["read_gvret"]


def read_gvret(path: Path) -> Frames:
    """Read a CSV of GVRET; single broken rows are left out and counted.

    Parameters
    ----------
    path : Path
        The file, gzipped or not.

    Returns
    -------
    Frames
        In the order of the rows.

    Raises
    ------
    LogError
        If a column is missing, or more than :data:`.MAX_DAMAGED_SHARE` of the rows are damaged.
    """
    try:
        with open_log(path) as file:
            rows, left_out = read_rows(file, dtype=str, quoting=csv.QUOTE_NONE)
    except (pd.errors.ParserError, UnicodeError) as error:
        raise LogError(f"{path}: not a SavvyCAN log: {reason_of(error)}; copy the file again") from None
    rows.columns = [str(name).strip() for name in rows.columns]
    for name in ("Time Stamp", "ID", "Extended", "Bus", "LEN", "D1"):
        if name not in rows:
            raise LogError(f"{path}: a CSV of frames without the column {name!r}; save it with SavvyCAN again")
    time_us, length = (pd.to_numeric(rows[key], errors="coerce").to_numpy() for key in ("Time Stamp", "LEN"))
    key, extended = _hexadecimal(rows["ID"]), rows["Extended"].str.lower() == "true"
    bytes_ = [_hexadecimal(rows[name]) for name in rows.columns if re.fullmatch(r"D\d+", name)]
    columns = FrameColumns.of(len(rows), fd=len(bytes_) > CLASSIC_BYTES)
    width = columns.data.shape[1]
    data = np.full((len(rows), width), np.nan)
    data[:, : len(bytes_)] = np.column_stack(bytes_)
    within = np.arange(width) < length[:, None]
    sound = (time_us >= 0.0) & (time_us <= 1e-3 * LATEST_TIME_STAMP_NS) & (key <= LARGEST_IDENTIFIER)
    sound &= (length >= 0) & (length <= width) & ~np.any(within & ~(data <= 0xFF), axis=1)
    damaged = left_out + int(np.sum(~sound))
    if damaged > MAX_DAMAGED_SHARE * len(rows):
        line = f"line {np.argmin(sound) + 2}" if not sound.all() else "a line with too many cells"
        raise LogError(f"{path}: {line} is damaged, and {damaged} of {len(rows) + left_out} are; save the log again")
    columns.channel[:], channels = pd.factorize(rows["Bus"].fillna(""))
    columns.kind[:] = np.where(sound, DATA, DAMAGED)
    columns.time_ns[sound] = np.rint(1e3 * time_us[sound])
    columns.key[sound] = key[sound].astype(np.uint32) | np.where(extended[sound], np.uint32(EXTENDED_BIT), np.uint32(0))
    columns.length[sound] = length[sound]
    columns.data[sound] = np.where(within, data, 0.0)[sound]
    frames = columns.frames(tuple(map(str, channels)))
    return replace(frames, damaged=damaged)


def _hexadecimal(texts: "pd.Series[str]") -> Array:
    """Numbers of hexadecimal digits, NaN where there are none."""
    places, different = pd.factorize(texts)
    values = [float(int(text, 16)) if re.fullmatch(r"(0x)?[\dA-Fa-f]{1,8}", text) else np.nan for text in different]
    numbers: Array = np.array([*values, np.nan])[places]  # the last one is of what is missing, whose place is -1
    return numbers
