"""Read log files into frame arrays: candump (.log, .txt), ASC, BLF, TRC, MF4, CSV, also gzipped, in folders or .zip.

Each format is one function and one line of :data:`READERS`.

A file that is cut, or cannot be read from some place on, is refused; the message gives the place and the number of
frames before it. Its readable part is not used, because nobody can tell what else is missing. Many logs have single
broken lines, or frames with an impossible length or time: these are left out and counted, up to
:data:`MAX_DAMAGED_SHARE`. A file that python-can reads is refused at the first line on which python-can fails.
"""

from collections.abc import Callable
from pathlib import Path

from calibrator.errors import LogError
from calibrator.recordings.blf import read_blf
from calibrator.recordings.frame_arrays import Frames, concatenate_frames
from calibrator.recordings.log_files import (
    TABLE_SUFFIXES,
    UNREADABLE,
    exists,
    files_in,
    is_bus_log,
    kind_of_text,
    readable,
    reason_of,
    suffix_of,
    text_head,
)
from calibrator.recordings.mf4 import read_mf4
from calibrator.recordings.text_logs import read_asc, read_candump, read_csv, read_trc

__all__ = ["LOG_SUFFIXES", "is_log", "is_table", "logs_in", "read_frames"]

READERS: dict[str, Callable[[Path], Frames]] = {
    ".log": read_candump,
    ".asc": read_asc,
    ".blf": read_blf,
    ".trc": read_trc,
    ".mf4": read_mf4,
    ".csv": read_csv,
    ".txt": read_csv,
}
"""Reader of a file by its suffix; each but that of MF4 also unpacks gzip."""
LOG_SUFFIXES = tuple(READERS)
MAX_DAMAGED_SHARE = 0.05
"""Largest share of damaged lines or frames in a log. Recordings of a real car through a serial adapter had up to 3 %
broken lines and decoded well. [1]"""
_IS_TABLE = "a table of values, not a log of frames, which is needed here"


def is_log(path: Path) -> bool:
    """Check whether a file is a log or a table: by its suffix, a ``.txt`` by its content; an unreadable one counts."""
    suffix = suffix_of(path)
    if suffix == ".txt":
        try:
            with readable(path) as file:
                return exists(path) and kind_of_text(text_head(file)[0], headed=False) != ""
        except (LogError, *UNREADABLE):
            return True
    return suffix in LOG_SUFFIXES or suffix in TABLE_SUFFIXES


def logs_in(path: Path) -> list[Path]:
    """List the logs and tables in a folder, at any depth, or in an archive; LogError if the archive is damaged."""
    return [inner for inner in files_in(path) if is_log(inner)]


def is_table(path: Path) -> bool:
    """Check whether a file is a table, or a folder or archive has tables and no logs of frames.

    If tables and logs of frames share a suffix, the content decides; an unreadable file counts as a table, except a
    ``.txt``.
    """
    suffix = suffix_of(path)
    if suffix == ".zip" or path.is_dir():
        found = logs_in(path)
        return bool(found) and all(map(is_table, found))
    if suffix not in TABLE_SUFFIXES or not exists(path):
        return False
    try:
        with readable(path) as file:
            if suffix == ".mf4":
                return not is_bus_log(file)
            if suffix in {".csv", ".tsv", ".txt"}:
                return kind_of_text(text_head(file)[0], headed=suffix != ".txt") == "table"
    except UNREADABLE:
        return suffix != ".txt"
    return True


def read_frames(path: Path) -> Frames:
    """Read all data frames of a log file.

    Parameters
    ----------
    path : Path
        The file; its suffix says the format, see :data:`LOG_SUFFIXES`. For a folder or an archive, all logs in it are
        read one after the other.

    Returns
    -------
    Frames
        The frames in the order of the file, those of MF4 by time.

    Raises
    ------
    LogError
        If the file cannot be opened, has an unknown suffix, is a table, cut or empty, or has too much damage.
    """
    if path.is_dir() or path.suffix.lower() == ".zip":
        logs = logs_in(path)
        if not logs:
            raise LogError(f"{path}: no logs in it; expected {', '.join(LOG_SUFFIXES)}, each also with .gz")
        return concatenate_frames([read_frames(log) for log in logs])
    reader = READERS.get(suffix_of(path))
    if not exists(path):
        raise LogError(f"{path}: no such file; give a log that is there")
    if not is_log(path):
        raise LogError(f"{path}: not a known log format; expected {', '.join(LOG_SUFFIXES)}, each also with .gz")
    if reader is None or (reader is not read_mf4 and is_table(path)):
        raise LogError(f"{path}: {_IS_TABLE}")
    try:
        with readable(path) as file:
            frames = reader(file)
    except UNREADABLE as error:
        raise LogError(f"{path}: cannot be read: {reason_of(error)}; copy the file again") from None
    if not len(frames) and is_table(path):
        raise LogError(f"{path}: {_IS_TABLE}")
    found = len(frames) + frames.error_frames + frames.remote_frames + frames.damaged
    if frames.damaged > MAX_DAMAGED_SHARE * found and (len(frames) or frames.first_damaged):
        what = f"{frames.damaged} of {found} lines or frames are damaged"
        if frames.first_damaged:
            what = f"line {frames.first_damaged} is damaged, and {frames.damaged} of {found} lines are"
        if reader is read_candump:
            what += "; expected '(seconds) channel identifier#data' as 'candump -L' writes it"
        raise LogError(f"{path}: {what}; {len(frames)} frames are readable; save the log again")
    if not len(frames):
        raise LogError(
            f"{path}: the log is empty: no data frames ({frames.error_frames} error frames, {frames.remote_frames} "
            f"remote frames, {frames.damaged} damaged lines); record it again"
        )
    return frames
