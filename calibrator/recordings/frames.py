"""Log files into frame arrays: candump (.log, .txt), ASC, BLF, TRC, MF4 and CSV, each also gzipped, in folders or .zip.

A damaged file is refused with the place of the damage and the number of frames before it; the readable part is not
used, because nobody can tell what else is missing. Text logs written by hand-made tools often have single broken lines:
in candump logs such lines are counted and left out, up to :data:`MAX_DAMAGED_SHARE`.
"""

import io
import logging
import re
import shlex
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, TextIO, cast

import can
import numpy as np
import pandas as pd

from calibrator.drive import Array
from calibrator.errors import LogError
from calibrator.recordings.blf import read_blf
from calibrator.recordings.candump import is_candump, log_lines, parse_candump
from calibrator.recordings.frame_arrays import (
    CLASSIC_BYTES,
    EXTENDED_BIT,
    FD_BYTES,
    FrameCollector,
    Frames,
    concatenate_frames,
    frame_key,
)
from calibrator.recordings.log_files import UNREADABLE, exists, files_in, opened, readable, suffix_of
from calibrator.recordings.mf4 import read_mf4
from calibrator.recordings.tables import TABLE_SUFFIXES, is_table, text_head

__all__ = ["LOG_SUFFIXES", "FrameCollector", "Frames", "frame_key", "is_log", "read_frames"]

MAX_DAMAGED_SHARE = 0.05
"""Recordings of a real car through a serial adapter had up to 3 % broken lines and decoded well."""
BLOCK_BYTES = 1 << 23
"""Text parsed at a time: bounds the memory, large enough for the array operations."""

_TEXT_SUFFIXES = (".asc", ".trc")
"""Text formats; not .log, because broken lines of candump logs are counted and left out."""
_IS_TABLE = "a table of values, not a log of frames, which is needed here"
_NO_TEXT = frozenset(range(32)) - frozenset(b"\t\n\v\f\r\x1a")
"""Control characters; the last one kept ends text files of old systems."""
_LOOKED_AT = 4096
"""Bytes: of random ones, a tenth are control characters."""


def is_log(path: Path) -> bool:
    """Whether a file is a log or a table: by its suffix, and a ``.txt`` by what is in it."""
    suffix = suffix_of(path)
    if suffix == ".txt":
        with readable(path) as file:
            return exists(path) and (is_candump(text_head(file)[0]) or is_table(file))
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
    reader = _READERS.get(suffix_of(path))
    if not exists(path):
        raise LogError(f"{path}: no such file; give a log that is there")
    if reader is None and not is_table(path):
        raise LogError(f"{path}: not a known log format; expected {', '.join(LOG_SUFFIXES)}, each also with .gz")
    if reader is None or (reader is not read_mf4 and is_table(path)):
        raise LogError(f"{path}: {_IS_TABLE}")
    try:
        with readable(path) as file, _quiet() as complaints:
            _require_text(file)
            frames = reader(file)
    except UNREADABLE as error:
        raise LogError(f"{path}: cannot be read: {_reason(error)}; copy the file again") from None
    if not len(frames) and is_table(path):
        raise LogError(f"{path}: {_IS_TABLE}")
    if not len(frames):
        raise LogError(
            f"{path}: the log is empty: no data frames ({frames.error_frames} error frames, {frames.remote_frames} "
            f"remote frames, {frames.damaged} damaged lines); record it again"
        )
    return replace(frames, damaged=frames.damaged + len(complaints))


def _require_text(path: Path) -> None:
    """Refuse binary data under a name of text, of which python-can skips whatever it does not know."""
    if suffix_of(path) not in _TEXT_SUFFIXES:
        return
    with opened(path) as file:
        if _NO_TEXT.intersection(file.read(_LOOKED_AT)):
            raise LogError(
                f"{path}: not a {suffix_of(path)} log but binary data; give the file the suffix of its format"
            )


def _reason(error: BaseException) -> str:
    if isinstance(error, EOFError):
        return "the compressed file is cut off"
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return str(text).splitlines()[0]


def _read_candump(path: Path) -> Frames:
    parts: list[Frames] = []
    first_damaged: int | None = None
    lines = above = 0
    try:
        printed = is_candump(text_head(path)[0], printed=True)
        with opened(path) as file:
            for text in [log_lines(file.read(), str(path))] if printed else _blocks(file):
                block = parse_candump(text)
                if block.first_damaged is not None and first_damaged is None:
                    first_damaged = above + block.first_damaged + 1
                parts.append(block.frames)
                lines += block.lines
                above += text.count(b"\n")
    except UNREADABLE as error:
        frames_before = sum(map(len, parts))
        raise LogError(
            f"{path}: truncated or damaged {f'after line {above}' if above else 'in its first line'}: "
            f"{_reason(error)}; {frames_before} frames before it are readable; {_remedy(path, frames_before)}"
        ) from None
    frames = concatenate_frames(parts)
    if frames.damaged > MAX_DAMAGED_SHARE * lines:
        raise LogError(
            f"{path}: line {first_damaged} is damaged, and {frames.damaged} of {lines} lines are; "
            f"expected '(seconds) channel identifier#data' as 'candump -L' writes it; {len(frames)} frames are readable"
        )
    return frames


def _remedy(path: Path, frames: int) -> str:
    """What to do with a text log of which only the first frames can be read."""
    if not frames or not path.name.lower().endswith(".gz"):
        return "copy the file again"
    part = f"'gzip -dc {shlex.quote(path.name)} > {shlex.quote(path.stem)}'"
    return f"copy the file again, or keep the readable part, {part}, and remove {path.name}"


def _blocks(file: BinaryIO) -> Iterator[bytes]:
    """Pieces of some size that end at a line end; those before a damage come before its error."""
    rest = b""
    damage: Exception | None = None
    while damage is None:
        block, damage = _whole_block(file)
        if not block:
            break
        cut = block.rfind(b"\n") + 1
        if cut:
            yield rest + block[:cut]
            rest = block[cut:]
        else:
            rest += block
    if damage is not None:
        raise damage
    if rest:
        yield rest


def _whole_block(file: BinaryIO) -> tuple[bytes, Exception | None]:
    """As much of a block as can be read, and what kept the rest; a single large read would lose it all."""
    parts: list[bytes] = []
    left = BLOCK_BYTES
    read1 = cast("io.BufferedIOBase", file).read1
    try:
        while left > 0 and (part := read1(left)):
            parts.append(part)
            left -= len(part)
    except UNREADABLE as error:
        return b"".join(parts), error
    return b"".join(parts), None


def _read_blf(path: Path) -> Frames:
    with opened(path) as file:
        return read_blf(file, str(path))


def _read_asc(path: Path) -> Frames:
    with opened(path) as file:
        text = _CountedLines(file)
        reader = can.ASCReader(cast("TextIO", text))
        frames = _collect(reader, path, text.place)
        if reader.timestamps_format == "relative":
            raise LogError(f"{path}: the time stamps are relative to the line before; save it with absolute ones")
    return frames


def _read_trc(path: Path) -> Frames:
    with opened(path) as file:
        text = _CountedLines(file)
        return _collect(can.TRCReader(cast("TextIO", text)), path, text.place)


def _read_csv(path: Path) -> Frames:
    """CSV of python-can, of SavvyCAN and other programs of GVRET; a text of candump."""
    head = text_head(path)[0]
    if is_candump(head):
        return _read_candump(path)
    if "arbitration_id" in head.partition("\n")[0]:
        with opened(path) as file:
            text = _CountedLines(file)
            return _collect(_with_fd(can.CSVReader(cast("TextIO", text))), path, text.place)
    return _read_gvret(path)


def _with_fd(reader: Iterable[can.Message]) -> Iterator[can.Message]:
    """Messages of a file that does not say which are CAN FD."""
    for message in reader:
        message.is_fd = message.dlc > CLASSIC_BYTES
        yield message


def _read_gvret(path: Path) -> Frames:
    """``Time Stamp,ID,Extended,Dir,Bus,LEN,D1,...``: microseconds, and identifier and bytes in hexadecimal digits."""
    with opened(path) as file:
        try:
            rows = pd.read_csv(file, dtype=str, index_col=False, skipinitialspace=True, on_bad_lines="skip")
            rows.columns = [str(name).strip() for name in rows.columns]
            bytes_ = [_hexadecimal(rows[name]) for name in rows.columns if re.fullmatch(r"D\d+", name)]
            time_us, length = (pd.to_numeric(rows[key], errors="coerce").to_numpy() for key in ("Time Stamp", "LEN"))
            key, extended, bus = _hexadecimal(rows["ID"]), rows["Extended"].str.lower() == "true", rows["Bus"]
        except (pd.errors.ParserError, UnicodeError) as error:
            raise LogError(f"{path}: not a SavvyCAN log: {_reason(error)}; copy the file again") from None
        except KeyError as error:
            raise LogError(f"{path}: a CSV of frames without the column {error}; save it with SavvyCAN again") from None
    width = FD_BYTES if len(bytes_) > CLASSIC_BYTES else CLASSIC_BYTES
    data = np.full((len(rows), width), np.nan)
    data[:, : len(bytes_)] = np.column_stack(bytes_)
    within = np.arange(width) < length[:, None]
    sound = np.isfinite(time_us) & np.isfinite(key) & (length <= width) & ~np.any(within & ~(data <= 0xFF), axis=1)
    if np.sum(~sound) > MAX_DAMAGED_SHARE * len(rows):
        line = int(np.argmin(sound)) + 2
        raise LogError(f"{path}: line {line} is damaged, and {np.sum(~sound)} of {len(rows)} are; save the log again")
    number, channels = pd.factorize(bus.fillna(""))
    return Frames(
        time_ns=np.rint(1e3 * time_us[sound]).astype(np.int64),
        key=key[sound].astype(np.uint32) | np.where(extended[sound], np.uint32(EXTENDED_BIT), np.uint32(0)),
        channel=number[sound].astype(np.uint32),
        length=length[sound].astype(np.uint8),
        data=np.where(within, data, 0.0)[sound].astype(np.uint8),
        channels=tuple(map(str, channels)),
        damaged=int(np.sum(~sound)),
    )


def _hexadecimal(texts: "pd.Series[str]") -> Array:
    """Numbers of hexadecimal digits, NaN where there are none."""
    places, different = pd.factorize(texts)
    values = [float(int(text, 16)) if re.fullmatch(r"(0x)?[\dA-Fa-f]+", text) else np.nan for text in different]
    numbers: Array = np.array([*values, np.nan])[places]  # the last one is of what is missing, whose place is -1
    return numbers


def _collect(reader: Iterable[can.Message], path: Path, place: Callable[[Exception], str]) -> Frames:
    """Take every message; what python-can raises on damage becomes a LogError with the place."""
    collector = FrameCollector()
    try:
        for message in reader:
            collector.add(message)
    except Exception as error:  # noqa: BLE001 (python-can lets through whatever its parsing meets)
        unreadable = isinstance(error, UNREADABLE)
        remedy = _remedy(path, len(collector)) if unreadable else "copy the file again, or cut it there"
        raise LogError(
            f"{path}: damaged{place(error)} ({_reason(error)}); {len(collector)} frames before it are readable; "
            f"{remedy}"
        ) from None
    return collector.frames()


class _CountedLines:
    """A text file, as far as python-can needs one, that knows how many of its lines were read."""

    def __init__(self, file: BinaryIO) -> None:
        self._text = io.TextIOWrapper(file, encoding="latin-1")
        self._count = 0

    def __iter__(self) -> Iterator[str]:
        for line in self._text:
            self._count += 1
            yield line

    def __next__(self) -> str:
        self._count += 1
        return next(self._text)

    def read(self, size: int = -1) -> str:
        """By this method python-can knows an open file."""
        return self._text.read(size)

    def close(self) -> None:
        """Close the file."""
        self._text.close()

    def place(self, error: Exception) -> str:
        """Where an error is: in the line read last, or behind it if no more could be read."""
        return f" {'after' if isinstance(error, UNREADABLE) else 'at'} line {self._count}"


class _Complaints(logging.Handler):
    """Keeps what python-can complains of, one entry per damaged line."""

    def __init__(self, kept: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._kept = kept

    def emit(self, record: logging.LogRecord) -> None:
        self._kept.append(record.getMessage())


@contextmanager
def _quiet() -> Iterator[list[str]]:
    """Collect the log lines of python-can, and keep its warnings from the terminal."""
    complaints: list[str] = []
    logger = logging.getLogger("can")
    handler = _Complaints(complaints)
    before = logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield complaints
    finally:
        logger.propagate = before
        logger.removeHandler(handler)


_READERS: dict[str, Callable[[Path], Frames]] = {
    ".log": _read_candump,
    ".asc": _read_asc,
    ".blf": _read_blf,
    ".trc": _read_trc,
    ".mf4": read_mf4,
    ".csv": _read_csv,
    ".txt": _read_csv,
}
LOG_SUFFIXES = tuple(_READERS)
"""Suffixes of logs."""
