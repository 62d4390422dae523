"""Read text logs: candump, ASC (Vector), TRC (PEAK), CSV of SavvyCAN and of python-can.

    (1740960798.000833) can0 2E5#000007320000DD00           candump -L: classic, 11 bits
    (1740960798.000833) can0 000002E5##1000007320000DD00    CAN FD, 29 bits; one digit of flags after ##
    (1740960798.000833) can0 123#R8                         remote frame

       0.011478 1  1F334455x       Rx   d 8 50 04 0C A9 D4 03 88 01  Length = 0 BitCount = 0          ASC

Lines of ``candump -L`` and of ASC are read by compiled code, ASC some thirty times as fast as by python-can. What
candump prints without ``-L``, and the rows of SavvyCAN, are turned into lines of ``candump -L`` first. python-can reads
the rest: TRC, its own CSV, and ASC with CAN FD or decimal numbers.
"""

import io
import re
import sys
import warnings
from codecs import BOM_UTF8
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from logging import WARNING, LogRecord, getLogger
from logging.handlers import BufferingHandler
from math import isfinite, nan
from pathlib import Path
from typing import TextIO

import can
import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled, inlined, inner
from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import (
    CLASSIC_BYTES,
    DAMAGED,
    DATA,
    ERROR,
    EXTENDED_BIT,
    FD_BYTES,
    LARGEST_IDENTIFIER,
    NOTHING,
    REMOTE,
    FrameColumns,
    Frames,
    concatenate_frames,
    frames_of,
)
from calibrator.recordings.log_files import (
    PRINTED_CANDUMP,
    UNREADABLE,
    is_candump,
    open_log,
    read_undamaged,
    reason_of,
    suffix_of,
    text_blocks,
    text_head,
)

__all__ = ["parse_candump", "read_asc", "read_candump", "read_csv", "read_trc"]

_DECIMAL = re.compile(r"^base\s+dec", re.MULTILINE | re.IGNORECASE)
_RELATIVE = re.compile(r"^base\s+\w+\s+timestamps\s+relative", re.MULTILINE | re.IGNORECASE)
_MOST_DISORDER = 0.1
"""If more than this share of the times is no larger than the time before, they count from the line before: then about
half are, and of absolute times nearly none. [1]"""
_SINCE_1970_S = 1e8
"""Times above this are dates: no recording lasts so long since its start. [s]"""
_NO_TEXT = frozenset(range(32)) - frozenset(b"\t\n\v\f\r\x1a")
"""Control characters that no text has. 0x1A is not among them, as it ends text files of old systems."""
_LOOKED_AT = 4096
"""Bytes searched for control characters, which are a tenth of random bytes. [byte]"""
_AT_A_TIME = 10_000
"""Messages of python-can that are collected before they become arrays, which take less memory. [1]"""
_ERROR_BIT = 1 << 29
_MOST_CHANNELS = 256
"""Largest number of channel names in one block of text; no machine has more buses. [1]"""
_NANOSECOND_DIGITS = 9
_NOT_HEX = 255
HEX = np.array([int(c, 16) if c in "0123456789ABCDEFabcdef" else _NOT_HEX for c in map(chr, range(256))], np.uint8)
"""Value of each character as a hexadecimal digit; 255 for all other characters."""
_Text = NDArray[np.uint8]
_Parse = Callable[[bytes], tuple[Frames, NDArray[np.uint8]]]
"""Parser of some lines: returns their frames, and what each line is (``DATA``, ``DAMAGED`` ...)."""


class _CanFdError(Exception):
    """An ASC file has frames of CAN FD, which the compiled parser does not know."""


def read_candump(path: Path) -> Frames:
    """Read the frames of a log that ``candump -L`` wrote, or of the text that candump prints without ``-L``."""
    if is_candump(text_head(path)[0], printed=True):
        return _read_lines(path, lambda text: parse_candump(_as_logged(text, path)), at_once=True)
    return _read_lines(path, parse_candump)


def read_csv(path: Path) -> Frames:
    """Read the frames of a CSV in the GVRET form (SavvyCAN and others) or of python-can, or of a text of candump."""
    head = text_head(path)[0]
    if is_candump(head):
        return read_candump(path)
    header = head.partition("\n")[0]
    if "arbitration_id" in header:
        return _read_messages(path, _csv_messages)
    columns = [name.strip() for name in header.split(",")]
    for name in ("Time Stamp", "ID", "Extended", "Bus", "LEN", "D1"):
        if name not in columns:
            raise LogError(f"{path}: a CSV of frames without the column {name!r}; save it with SavvyCAN again")
    return _read_lines(path, lambda text: parse_candump(_gvret_as_logged(text, columns)))


def read_asc(path: Path) -> Frames:
    """Read the frames of an ASC file; LogError if it is damaged, or its times count from the line before."""
    head = text_head(path)[0]
    if _RELATIVE.search(head):
        raise LogError(f"{path}: the time stamps are relative to the line before; save it with absolute ones")
    try:
        frames = None if _DECIMAL.search(head) else _read_lines(path, _parse_plain_asc)
    except _CanFdError:
        frames = None
    return frames if frames is not None and len(frames) else _read_messages(path, can.ASCReader)


def read_trc(path: Path) -> Frames:
    """Read the frames of a TRC file of version 1.0, 1.1, 1.3, 2.0 or 2.1 (any other is read as 1.0).

    LogError if python-can fails on it.
    """
    return _read_messages(path, can.TRCReader)


def _read_lines(path: Path, parse: _Parse, *, at_once: bool = False) -> Frames:
    """Read the frames of a text, gzipped or not, in blocks of lines or all at once; LogError if the file is cut."""
    parts, first_damaged, above = list[Frames](), 0, 0
    try:
        with open_log(path) as file:
            for text in [file.read()] if at_once else text_blocks(file):
                frames, kind = parse(text)
                if frames.damaged and not first_damaged:
                    first_damaged = above + int(np.argmax(kind == DAMAGED)) + 1
                parts.append(frames)
                above += len(kind)
    except UNREADABLE as error:
        raise LogError(
            f"{path}: truncated or damaged {f'after line {above}' if above else 'in its first line'}: "
            f"{reason_of(error)}; {sum(map(len, parts))} frames before it are readable; copy the file again"
        ) from None
    return replace(concatenate_frames(parts), first_damaged=first_damaged)


# ---- other forms as lines of candump -L


def _as_logged(text: bytes, path: Path) -> bytes:
    """Turn the lines that candump prints into lines of ``candump -L``, one for one; other lines stay as they are.

    Times are absolute (``-ta``, ``-tA``), since the start (``-tz``) or since the line before (``-td``). The last kind
    is recognised because such times do not increase steadily.
    """
    times = [match["time"] for match in PRINTED_CANDUMP.finditer(text)]
    if None in times:
        raise LogError(f"{path}: printed by candump without times; record it with 'candump -L' or 'candump -ta'")
    seconds = np.array([_seconds(time.decode()) for time in times])
    known = seconds[np.isfinite(seconds)]
    if np.mean(np.diff(known, prepend=-1.0) <= 0.0) > _MOST_DISORDER and np.all(known < _SINCE_1970_S):
        seconds = np.where(np.isfinite(seconds), np.nancumsum(seconds), np.nan)
    left = iter(seconds.tolist())

    def line(match: re.Match[bytes]) -> bytes:
        time_s, data = next(left), b"R" if match["remote"] else match["data"].replace(b" ", b"")
        if not isfinite(time_s) or (not match["remote"] and len(data) != 2 * int(match["length"])):
            return match[0]
        fd = b"##0" if len(match["length"]) > 1 else b"#"
        return b"(%.6f) %b %b%b%b" % (time_s, match["channel"], match["id"], fd, data)

    return PRINTED_CANDUMP.sub(line, text)


def _seconds(time: str) -> float:
    """Parse a date or a number as seconds since 1970 or another instant; NaN if the text is no time."""
    try:
        return datetime.fromisoformat(time).timestamp() if "-" in time else float(time)
    except ValueError:
        return nan


_EXTENDED = {"true": True, "1": True, "false": False, "0": False}


def _gvret_as_logged(text: bytes, columns: Sequence[str]) -> bytes:
    """Turn rows of GVRET (time in us, identifier and bytes hexadecimal) into lines of ``candump -L``, one for one."""
    lines = list[str]()
    for line in text.splitlines():
        row = [cell.strip() for cell in line.removeprefix(BOM_UTF8).decode("latin-1").split(",")]
        if not line.strip() or row == columns:
            lines.append("")
            continue
        cells = dict(zip(columns, row, strict=False))
        try:
            time_us, identifier, extended = int(cells["Time Stamp"]), int(cells["ID"], 16), cells["Extended"].lower()
            data = bytes(int(cells[f"D{k}"], 16) for k in range(1, int(cells["LEN"]) + 1))
            if any(row[len(columns) :]) or not 0 <= identifier <= LARGEST_IDENTIFIER:
                raise ValueError
            name = f"{identifier:08X}" if _EXTENDED[extended] else f"{identifier:03X}"
            fd = "##0" if len(data) > CLASSIC_BYTES else "#"
            lines.append(f"({time_us // 10**6}.{time_us % 10**6:06d}) {cells['Bus'] or '0'} {name}{fd}{data.hex()}")
        except (ValueError, KeyError):
            lines.append("a damaged row")
    return "\n".join(lines).encode("latin-1")


# ---- by python-can


def _csv_messages(text: TextIO) -> Iterator[can.Message]:
    """Yield the messages of a CSV of python-can; those longer than 8 bytes are marked as CAN FD, as it does not say."""
    for message in can.CSVReader(text):
        message.is_fd = message.dlc > CLASSIC_BYTES
        yield message


def _read_messages(path: Path, reader: Callable[[TextIO], Iterable[can.Message]]) -> Frames:
    """Read every message of a text that a reader, such as those of python-can, finds in it.

    Any exception of the reader becomes a LogError with the line.

    A binary file with the suffix of a text is refused first, as python-can would silently skip what it does not know.
    """
    with open_log(path) as file:
        if _NO_TEXT.intersection(read_undamaged(file, _LOOKED_AT)[0]):
            raise LogError(
                f"{path}: not a {suffix_of(path)} log but binary data; give the file the suffix of its format"
            )
    parts, messages = list[Frames](), list[can.Message]()
    with open_log(path) as file, _quiet() as complaints:
        text = _CountedLines(file, encoding="latin-1")
        try:
            for message in reader(text):
                messages.append(message)
                if len(messages) == _AT_A_TIME:
                    parts.append(frames_of(messages))
                    messages.clear()
        except Exception as error:  # noqa: BLE001 (python-can lets through whatever its parsing meets)
            before = sum(map(len, parts)) + len(frames_of(messages))
            raise LogError(
                f"{path}: damaged {'after' if isinstance(error, UNREADABLE) else 'at'} line {text.count} "
                f"({reason_of(error)}); {before} frames before it are readable; copy the file again, or cut it there"
            ) from None
    frames = concatenate_frames([*parts, frames_of(messages)])
    return replace(frames, damaged=frames.damaged + len(complaints))


class _CountedLines(io.TextIOWrapper):
    """A text file that counts the lines read so far."""

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


# ---- by compiled code


def parse_candump(text: bytes) -> tuple[Frames, NDArray[np.uint8]]:
    """Parse lines of ``candump -L``, ended by LF or CRLF; return the data frames in their order, and the lines' kinds.

    Each line, blank and damaged ones too, is ``NOTHING``, ``DATA``, ``ERROR``, ``REMOTE`` or ``DAMAGED``.
    """
    text = text if text.endswith(b"\n") else text + b"\n"
    lines, found, fd = text.count(b"\n"), -1, False
    while found < 0:
        columns, names = FrameColumns.of(lines, fd=fd), np.zeros((_MOST_CHANNELS, 2), np.int64)
        found, fd = _parse_candump(np.frombuffer(text, np.uint8), HEX, names, columns), True
    return columns.frames([text[start:end].decode("latin-1") for start, end in names[:found].tolist()]), columns.kind


def _parse_plain_asc(text: bytes) -> tuple[Frames, NDArray[np.uint8]]:
    """Parse lines of an ASC file with hexadecimal numbers; return frames in their order, and each line's kind."""
    if b"CANFD" in text:
        raise _CanFdError
    text = text if text.endswith(b"\n") else text + b"\n"
    columns = FrameColumns.of(text.count(b"\n"), fd=False)
    _parse_asc(np.frombuffer(text, np.uint8), HEX, columns)
    return columns.frames(), columns.kind


@compiled
def _parse_candump(text: _Text, digits: _Text, names: NDArray[np.int64], columns: FrameColumns) -> int:
    """Parse line by line into `columns`, and return the number of different channels.

    The text must end with a line end: no step passes one, so parsing ends. `names` receives where each channel's name
    starts and ends in the text. The result is -1 if a payload does not fit into the columns.
    """
    kind, time_ns, key, channel, length, data = columns
    row, start, channels = 0, 0, 0
    while start < len(text):
        at, end = _word(text, start)
        is_blank = at == end
        stamp_ns, fraction, last = _time(text, at + (text[at] == ord("(")))
        sound = stamp_ns >= 0 and (fraction == 6 or fraction == 9)  # noqa: PLR1714 (compiled)
        sound = sound and text[at] == ord("(") and text[last] == ord(")") and last == end - 1
        name_at, name_end = _word(text, end)
        at, end = _word(text, name_end)
        mark = at
        while mark < end and text[mark] != ord("#"):
            mark += 1
        identifier, extended = _hexadecimal(text, at, mark, digits), mark - at == 8
        sound = sound and mark < end and (extended or mark - at == 3)
        sound = sound and 0 <= identifier <= ((_ERROR_BIT | LARGEST_IDENTIFIER) if extended else 0x7FF)
        what = ERROR if identifier & _ERROR_BIT else DATA
        at = min(mark + 1, end)
        fd = text[at] == ord("#")
        if fd:  # a digit of flags follows
            sound = sound and digits[text[at + 1]] != _NOT_HEX
            at += 2
        elif text[at] & 0xDF == ord("R"):  # upper case
            what, at = REMOTE, end
        size = (end - at) // 2
        sound = sound and end - at == 2 * size and 0 <= size <= (FD_BYTES if fd else CLASSIC_BYTES)
        last = end
        while text[end] != ord("\n"):
            end += 1
        rest = end - last - (text[end - 1] == ord("\r"))  # the direction may follow
        is_direction = rest == 2 and (text[last + 1] & 0xDF == ord("R") or text[last + 1] & 0xDF == ord("T"))
        sound = sound and (rest == 0 or is_direction)
        if sound and what == DATA:
            if size > data.shape[1]:
                return -1
            for k in range(size):
                high, low = digits[text[at + 2 * k]], digits[text[at + 2 * k + 1]]
                sound = sound and high < 16 and low < 16
                data[row, k] = 16 * high + low
            number = 0
            while number < channels and not _is_same(text, names[number, 0], names[number, 1], name_at, name_end):
                number += 1
            if sound and number == channels and channels < len(names):
                names[number, 0], names[number, 1] = name_at, name_end
                channels += 1
            sound = sound and number < channels
            time_ns[row], channel[row], length[row] = stamp_ns, number, size
            key[row] = identifier | EXTENDED_BIT if extended else identifier
        kind[row] = NOTHING if is_blank else what if sound else DAMAGED
        row, start = row + 1, end + 1
    return channels


@compiled
def _parse_asc(text: _Text, digits: _Text, columns: FrameColumns) -> None:
    """Parse line by line into `columns`; the text must end with a line end."""
    row, start = 0, 0
    while start < len(text):
        columns.kind[row] = _asc_line(text, start, digits, row, columns)
        while text[start] != ord("\n"):
            start += 1
        row, start = row + 1, start + 1


@inner
def _is_same(text: _Text, first: int, last: int, first_too: int, last_too: int) -> bool:
    """Check whether two parts of the text are the same; `last` is one past the end."""
    if last - first != last_too - first_too:
        return False
    for k in range(last - first):  # noqa: SIM110 (compiled)
        if text[first + k] != text[first_too + k]:
            return False
    return True


@inner
def _asc_line(  # noqa: PLR0911 (a line is judged from left to right)
    text: _Text, at: int, digits: _Text, row: int, columns: FrameColumns
) -> int:
    """Parse the line that starts at `at` into a row of `columns`; return what kind of line it is."""
    at, end = _word(text, at)
    time_ns, fraction, at = _time(text, at)
    if fraction < 0 or at != end:
        return NOTHING  # a line of the header, or a comment
    if time_ns < 0:
        return DAMAGED
    at, end = _word(text, end)
    channel = 0
    for k in range(at, end):
        if not ord("0") <= text[k] <= ord("9"):
            return NOTHING  # another event
        channel = 10 * channel + (text[k] - ord("0"))
    identifier_at, identifier_end = _word(text, end)
    if text[identifier_at] == ord("E") and identifier_end - identifier_at == 10:
        return ERROR
    at, end = _word(text, identifier_end)
    if end - at != 2 or text[at + 1] != ord("x") or not (text[at] == ord("R") or text[at] == ord("T")):
        return NOTHING
    extended = text[identifier_end - 1] == ord("x")
    identifier = _hexadecimal(text, identifier_at, identifier_end - extended, digits)
    at, end = _word(text, end)
    if not 0 <= identifier <= LARGEST_IDENTIFIER or end - at != 1 or channel > 255:
        return DAMAGED
    if text[at] == ord("r"):
        return REMOTE
    at, end = _word(text, end)
    length = _hexadecimal(text, at, end, digits)
    if not 0 <= length <= CLASSIC_BYTES:
        return DAMAGED
    for k in range(length):
        at, end = _word(text, end)
        value = _hexadecimal(text, at, end, digits)
        if not 0 <= value <= 0xFF:
            return DAMAGED
        columns.data[row, k] = value
    columns.time_ns[row], columns.channel[row], columns.length[row] = time_ns, channel, length
    columns.key[row] = identifier | EXTENDED_BIT if extended else identifier
    return DATA


@inlined
def _is_blank(letter: int) -> bool:
    return letter == ord(" ") or letter == ord("\t") or letter == ord("\r")


@inlined
def _word(text: _Text, at: int) -> tuple[int, int]:
    """Return where the next word of the line starts, and one past its end; the line's end for both if there is none."""
    while _is_blank(text[at]):
        at += 1
    end = at
    while text[end] != ord("\n") and not _is_blank(text[end]):
        end += 1
    return at, end


@inlined
def _time(text: _Text, at: int) -> tuple[int, int, int]:
    """Parse seconds with a fraction; return the time [ns], the number of fraction digits, and where the number ends.

    The time is -1 if it has no fraction, too many digits or too many seconds; the digits are -1 if there is no point.
    """
    time_ns, seconds, point = 0, 0, -1
    while ord("0") <= text[at] <= ord("9") or (text[at] == ord(".") and point < 0):
        if text[at] == ord("."):
            point, seconds, time_ns = at, time_ns, 0
        elif time_ns < 10**11:
            time_ns = 10 * time_ns + (text[at] - ord("0"))
        at += 1
    digits = at - point - 1 if point >= 0 else -1
    for _ in range(digits, _NANOSECOND_DIGITS):
        time_ns *= 10
    possible = 0 <= digits <= _NANOSECOND_DIGITS and seconds < 9 * 10**9
    return seconds * 10**9 + time_ns if possible else -1, digits, at


@inlined
def _hexadecimal(text: _Text, at: int, end: int, digits: _Text) -> int:
    """Parse a number of up to 8 hexadecimal digits; return -1 for anything else."""
    value = 0 if 0 < end - at <= 8 else -1
    for k in range(at, end):
        value = -1 if value < 0 or digits[text[k]] == _NOT_HEX else 16 * value + digits[text[k]]
    return value
