"""Log files into frame arrays: candump (.log, .txt), ASC, BLF, TRC, MF4 and CSV, each also gzipped, in folders or .zip.

A format is one file of this room, or a reader of python-can, and one line of :data:`READERS`.

A damaged file is refused with the place of the damage and the number of frames before it; the readable part is not
used, because nobody can tell what else is missing. Text logs written by hand-made tools often have single broken lines:
in candump and GVRET logs such lines are counted and left out, up to :data:`.MAX_DAMAGED_SHARE`.
"""

import csv
import io
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from logging import WARNING, LogRecord, getLogger
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import TextIO

import can

from calibrator.errors import LogError
from calibrator.recordings.blf import read_blf
from calibrator.recordings.frame_arrays import CLASSIC_BYTES, Frames, concatenate_frames, frames_of
from calibrator.recordings.log_files import (
    MAX_DAMAGED_SHARE,
    TABLE_SUFFIXES,
    UNREADABLE,
    exists,
    files_in,
    is_candump,
    is_table,
    open_log,
    read_undamaged,
    readable,
    reason_of,
    suffix_of,
    text_head,
)
from calibrator.recordings.mf4 import read_mf4
from calibrator.recordings.text_logs import read_candump, read_plain_asc

__all__ = ["LOG_SUFFIXES", "is_log", "read_frames"]

_IS_TABLE = "a table of values, not a log of frames, which is needed here"
_NO_TEXT = frozenset(range(32)) - frozenset(b"\t\n\v\f\r\x1a")
"""Control characters; the last one kept ends text files of old systems."""
_LOOKED_AT = 4096
"""Bytes: of random ones, a tenth are control characters."""
_AT_A_TIME = 10_000
"""Messages of python-can that are kept at a time: they take more memory than arrays."""
_RELATIVE = re.compile(r"^base\s+\w+\s+timestamps\s+relative", re.MULTILINE | re.IGNORECASE)


def is_log(path: Path) -> bool:
    """Whether a file is a log or a table: by its suffix, and a ``.txt`` by what is in it; a damaged one counts."""
    suffix = suffix_of(path)
    if suffix == ".txt":
        try:
            with readable(path) as file:
                return exists(path) and (is_candump(text_head(file)[0]) or is_table(file))
        except (LogError, *UNREADABLE):
            return True
    return suffix in LOG_SUFFIXES or suffix in TABLE_SUFFIXES


def read_frames(path: Path) -> Frames:
    """Read all data frames of a log file.

    Parameters
    ----------
    path : Path
        The file; its suffix says the format, see :data:`LOG_SUFFIXES`. Of a folder or an archive all logs one after the
        other.

    Returns
    -------
    Frames
        The frames in the order of the file.

    Raises
    ------
    LogError
        If the file cannot be opened, has an unknown suffix, is a table, damaged, cut or empty.
    """
    if path.is_dir() or path.suffix.lower() == ".zip":
        logs = [inner for inner in files_in(path) if is_log(inner)]
        if not logs:
            raise LogError(f"{path}: no logs in it; expected {', '.join(LOG_SUFFIXES)}, each also with .gz")
        return concatenate_frames([read_frames(log) for log in logs])
    reader = READERS.get(suffix_of(path))
    if not exists(path):
        raise LogError(f"{path}: no such file; give a log that is there")
    if reader is None and not is_table(path):
        raise LogError(f"{path}: not a known log format; expected {', '.join(LOG_SUFFIXES)}, each also with .gz")
    if reader is None or (reader is not read_mf4 and is_table(path)):
        raise LogError(f"{path}: {_IS_TABLE}")
    try:
        with readable(path) as file, _quiet() as complaints:
            frames = reader(file)
    except UNREADABLE as error:
        raise LogError(f"{path}: cannot be read: {reason_of(error)}; copy the file again") from None
    if not len(frames) and is_table(path):
        raise LogError(f"{path}: {_IS_TABLE}")
    if not len(frames):
        raise LogError(
            f"{path}: the log is empty: no data frames ({frames.error_frames} error frames, {frames.remote_frames} "
            f"remote frames, {frames.damaged} damaged lines); record it again"
        )
    return replace(frames, damaged=frames.damaged + len(complaints))


def _read_blf(path: Path) -> Frames:
    with open_log(path) as file:
        return read_blf(file, str(path))


def _read_asc(path: Path) -> Frames:
    if _RELATIVE.search(text_head(path)[0]):
        raise LogError(f"{path}: the time stamps are relative to the line before; save it with absolute ones")
    plain = read_plain_asc(path)
    return plain if plain is not None and len(plain) else _read_by_python_can(path, can.ASCReader)


def _read_csv(path: Path) -> Frames:
    """CSV of python-can, of SavvyCAN and other programs of GVRET; a text of candump."""
    head = text_head(path)[0]
    if is_candump(head):
        return read_candump(path)
    if "arbitration_id" in head.partition("\n")[0]:
        return _read_by_python_can(path, _csv_messages)
    return _read_by_python_can(path, partial(_gvret_messages, where=str(path)))


def _gvret_messages(text: TextIO, where: str) -> Iterator[can.Message]:
    """Messages of a CSV of GVRET: microseconds, identifier and bytes in hexadecimal digits; few may be damaged."""
    rows = csv.DictReader(text, quoting=csv.QUOTE_NONE, skipinitialspace=True)
    rows.fieldnames = [name.strip() for name in rows.fieldnames or ()]
    for name in ("Time Stamp", "ID", "Extended", "Bus", "LEN", "D1"):
        if name not in rows.fieldnames:
            raise LogError(f"{where}: a CSV of frames without the column {name!r}; save it with SavvyCAN again")
    count, damaged = 0, list[int]()
    for row in rows:
        count += 1
        try:
            if any(row.get(None, ())):
                raise ValueError  # there are cells beyond those of the header
            data = bytes(int(row[f"D{k}"], 16) for k in range(1, int(row["LEN"]) + 1))
            yield can.Message(
                timestamp=1e-6 * int(row["Time Stamp"]),
                arbitration_id=int(row["ID"], 16),
                is_extended_id=row["Extended"].lower() == "true",
                channel=row["Bus"],
                data=data,
                is_fd=len(data) > CLASSIC_BYTES,
                check=True,
            )
        except (ValueError, TypeError, KeyError, AttributeError):
            damaged.append(rows.line_num)
            yield can.Message(timestamp=-1.0)  # which counts as damaged
    if len(damaged) > MAX_DAMAGED_SHARE * count:
        raise LogError(f"{where}: line {damaged[0]} is damaged, and {len(damaged)} of {count} are; save the log again")


def _csv_messages(text: TextIO) -> Iterator[can.Message]:
    """Messages of a file that does not say which are CAN FD."""
    for message in can.CSVReader(text):
        message.is_fd = message.dlc > CLASSIC_BYTES
        yield message


def _read_by_python_can(path: Path, reader: Callable[[TextIO], Iterable[can.Message]]) -> Frames:
    """Take every message of a text; what python-can raises on damage becomes a LogError with the place.

    Binary data under the name of a text are refused, as python-can skips whatever it does not know.
    """
    with open_log(path) as file:
        if _NO_TEXT.intersection(read_undamaged(file, _LOOKED_AT)[0]):
            raise LogError(
                f"{path}: not a {suffix_of(path)} log but binary data; give the file the suffix of its format"
            )
    parts, messages = list[Frames](), list[can.Message]()
    with open_log(path) as file:
        text = _CountedLines(file, encoding="latin-1")
        try:
            for message in reader(text):
                messages.append(message)
                if len(messages) == _AT_A_TIME:
                    parts.append(frames_of(messages))
                    messages.clear()
        except LogError:
            raise
        except Exception as error:  # noqa: BLE001 (python-can lets through whatever its parsing meets)
            before = sum(map(len, parts)) + len(frames_of(messages))
            raise LogError(
                f"{path}: damaged {'after' if isinstance(error, UNREADABLE) else 'at'} line {text.count} "
                f"({reason_of(error)}); {before} frames before it are readable; copy the file again, or cut it there"
            ) from None
    return concatenate_frames([*parts, frames_of(messages)])


class _CountedLines(io.TextIOWrapper):
    """A text file that knows how many of its lines were read."""

    count = 0

    def __next__(self) -> str:  # type: ignore[override]  # as TextIOBase has it
        line = super().__next__()
        self.count += 1
        return line


@contextmanager
def _quiet() -> Iterator[list[LogRecord]]:
    """Collect what python-can logs, an entry per damaged line, and keep its warnings from the terminal."""
    logger, handler = getLogger("can"), BufferingHandler(sys.maxsize)
    handler.setLevel(WARNING)
    before = logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield handler.buffer
    finally:
        logger.propagate = before
        logger.removeHandler(handler)


READERS: dict[str, Callable[[Path], Frames]] = {
    ".log": read_candump,
    ".asc": _read_asc,
    ".blf": _read_blf,
    ".trc": partial(_read_by_python_can, reader=can.TRCReader),
    ".mf4": read_mf4,
    ".csv": _read_csv,
    ".txt": _read_csv,
}
"""What reads a file that is not packed or only gzipped, by its suffix."""
LOG_SUFFIXES = tuple(READERS)
"""Suffixes of logs."""
