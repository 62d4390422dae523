"""Log files into frame arrays: candump (.log), ASC, BLF, TRC and MF4, each also gzipped.

A damaged file is refused with the place of the damage and the number of frames before it; the readable part is not
used, because nobody can tell what else is missing. Text logs written by hand-made tools often have single broken lines:
in candump logs such lines are counted and left out, up to :data:`MAX_DAMAGED_SHARE`.
"""

import gzip
import io
import logging
import shlex
import shutil
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, TextIO, cast

import can

from calibrator.errors import LogError
from calibrator.recordings.blf import read_blf
from calibrator.recordings.candump import parse_candump
from calibrator.recordings.frame_arrays import FrameCollector, Frames, concatenate_frames, frame_key
from calibrator.recordings.mf4 import read_mf4

__all__ = ["LOG_SUFFIXES", "FrameCollector", "Frames", "frame_key", "is_log", "read_frames"]

MAX_DAMAGED_SHARE = 0.05
"""Recordings of a real car through a serial adapter had up to 3 % broken lines and decoded well."""
BLOCK_BYTES = 1 << 23
"""Text parsed at a time: bounds the memory, large enough for the array operations."""

_TEXT_SUFFIXES = (".asc", ".trc")
"""Text formats; not .log, because broken lines of candump logs are counted and left out."""
_NO_TEXT = frozenset(range(32)) - frozenset(b"\t\n\v\f\r\x1a")
"""Control characters; the last one kept ends text files of old systems."""
_LOOKED_AT = 4096
"""Bytes: of random ones, a tenth are control characters."""

_UNREADABLE = (OSError, EOFError, zlib.error)
"""What opening and unpacking may raise; gzip.BadGzipFile is an OSError."""


def is_log(path: Path) -> bool:
    """Whether the name of a file is that of a log this module reads."""
    return _suffix(path) in LOG_SUFFIXES


def read_frames(path: Path) -> Frames:
    """Read all data frames of a log file.

    Parameters
    ----------
    path : Path
        The file; its suffix says the format, see :data:`LOG_SUFFIXES`.

    Returns
    -------
    Frames
        The frames in the order of the file.

    Raises
    ------
    LogError
        If the file cannot be opened, has an unknown suffix, is damaged, cut or empty.
    """
    reader = _READERS.get(_suffix(path))
    if reader is None and not path.exists():
        raise LogError(f"{path}: no such file")
    if reader is None:
        raise LogError(f"{path}: not a known log format; expected {', '.join(LOG_SUFFIXES)}, each also with .gz")
    if not path.is_file():
        raise LogError(f"{path}: no such file; give a log that is there")
    try:
        _require_text(path)
        with _quiet() as complaints:
            frames = reader(path)
    except _UNREADABLE as error:
        raise LogError(f"{path}: cannot be read: {_reason(error)}; copy the file again") from None
    if not len(frames):
        raise LogError(
            f"{path}: the log is empty: no data frames ({frames.error_frames} error frames, {frames.remote_frames} "
            f"remote frames, {frames.damaged} damaged lines); record it again"
        )
    return replace(frames, damaged=frames.damaged + len(complaints))


def _require_text(path: Path) -> None:
    """Refuse binary data under a name of text, of which python-can skips whatever it does not know."""
    if _suffix(path) not in _TEXT_SUFFIXES:
        return
    with _open(path) as file:
        if _NO_TEXT.intersection(file.read(_LOOKED_AT)):
            raise LogError(f"{path}: not a {_suffix(path)} log but binary data; give the file the suffix of its format")


def _suffix(path: Path) -> str:
    name = path.name.lower().removesuffix(".gz")
    return Path(name).suffix


def _reason(error: BaseException) -> str:
    if isinstance(error, EOFError):
        return "the compressed file is cut off"
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return str(text).splitlines()[0]


def _open(path: Path) -> BinaryIO:
    return cast("BinaryIO", gzip.open(path, "rb") if path.name.lower().endswith(".gz") else path.open("rb"))


def _read_candump(path: Path) -> Frames:
    parts: list[Frames] = []
    first_damaged: int | None = None
    lines = above = 0
    try:
        with _open(path) as file:
            for text in _blocks(file):
                block = parse_candump(text)
                if block.first_damaged is not None and first_damaged is None:
                    first_damaged = above + block.first_damaged + 1
                parts.append(block.frames)
                lines += block.lines
                above += text.count(b"\n")
    except _UNREADABLE as error:
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
    except _UNREADABLE as error:
        return b"".join(parts), error
    return b"".join(parts), None


def _read_blf(path: Path) -> Frames:
    with _open(path) as file:
        return read_blf(file, str(path))


def _read_asc(path: Path) -> Frames:
    with _open(path) as file:
        text = _CountedLines(file)
        reader = can.ASCReader(cast("TextIO", text))
        frames = _collect(reader, path, text.place)
        if reader.timestamps_format == "relative":
            raise LogError(f"{path}: the time stamps are relative to the line before; save it with absolute ones")
    return frames


def _read_trc(path: Path) -> Frames:
    with _open(path) as file:
        text = _CountedLines(file)
        return _collect(can.TRCReader(cast("TextIO", text)), path, text.place)


def _read_mf4(path: Path) -> Frames:
    if path.suffix.lower() != ".gz":
        return read_mf4(path)
    with tempfile.NamedTemporaryFile(prefix=f"{path.stem}.", suffix=".mf4") as unpacked:
        with _open(path) as file:
            shutil.copyfileobj(file, unpacked)
        unpacked.flush()
        try:
            return read_mf4(Path(unpacked.name))
        except LogError as error:
            raise LogError(str(error).replace(unpacked.name, str(path))) from None


def _collect(reader: can.io.generic.MessageReader, path: Path, place: Callable[[Exception], str]) -> Frames:
    """Take every message; what python-can raises on damage becomes a LogError with the place."""
    collector = FrameCollector()
    try:
        with reader:
            for message in reader:
                collector.add(message)
    except Exception as error:  # noqa: BLE001 (python-can lets through whatever its parsing meets)
        unreadable = isinstance(error, _UNREADABLE)
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

    def read(self, size: int = -1) -> str:
        """By this method python-can knows an open file."""
        return self._text.read(size)

    def close(self) -> None:
        """Close the file."""
        self._text.close()

    def place(self, error: Exception) -> str:
        """Where an error is: in the line read last, or behind it if no more could be read."""
        return f" {'after' if isinstance(error, _UNREADABLE) else 'at'} line {self._count}"


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
    ".mf4": _read_mf4,
}
LOG_SUFFIXES = tuple(_READERS)
"""Suffixes of the log formats."""
