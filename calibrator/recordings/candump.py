"""Lines of ``candump`` turned into frame arrays, those of ``candump -L`` by compiled code.

    (1740960798.000833) can0 2E5#000007320000DD00           classic, 11 bits
    (1740960798.000833) can0 000002E5##1000007320000DD00    CAN FD, 29 bits; one digit of flags after ##
    (1740960798.000833) can0 123#R8                         remote frame

    (1740960798.000833)  can0  2E5   [8]  00 00 07 32      printed with -ta, -tA, -tz, -td: turned into the form above

A line of none of these forms is damaged and counted.
"""

import re
from dataclasses import dataclass
from datetime import datetime
from math import isfinite, nan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled, inner
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
)
from calibrator.recordings.log_files import (
    MAX_DAMAGED_SHARE,
    UNREADABLE,
    open_log,
    reason_of,
    remedy_for,
    text_blocks,
    text_head,
)

__all__ = ["is_candump", "parse_candump", "read_candump"]

_PRINTED = re.compile(
    rb"^[ \t]*(?:\((?P<time>[-\d:. ]+)\)[ \t]+)?(?P<channel>[\w.-]+)[ \t]+(?:[RT]X [-B] [-E][ \t]+)?"
    rb"(?P<id>[\dA-F]{8}|[\dA-F]{3})[ \t]+\[(?P<length>\d+)\](?:[ \t]+(?P<remote>remote request)|[ \t]+(?P<data>"
    rb"(?:[\dA-F]{2} ?)*))[^\r\n]*",
    re.MULTILINE | re.IGNORECASE,
)
_LOGGED = re.compile(rb"\(\d+\.\d+\) \S+ [\dA-Fa-f]{3,8}#")
_MOST_DISORDER = 0.1
"""Share of lines whose time is not after the one before: in a log nearly none, of distances about half. [1]"""
_SINCE_1970_S = 1e8
"""Later than any time since a start. [s]"""
_ERROR_BIT = 1 << 29
_MOST_CHANNELS = 256
"""Different names in one block of text; no machine has more buses."""
_LONGEST_NAME = 255
_NOT_HEX = 255
HEX = np.full(256, _NOT_HEX, np.uint8)
"""Value of each character as a hexadecimal digit."""
for _digit, _character in enumerate("0123456789ABCDEF"):
    HEX[[ord(_character), ord(_character.lower())]] = _digit
_Text = NDArray[np.uint8]
_LF, _CR, _SPACE, _OPEN, _CLOSE, _POINT, _HASH = (ord(character) for character in "\n\r ().#")


@dataclass(frozen=True, kw_only=True)
class CandumpBlock:
    """What some lines hold.

    Attributes
    ----------
    frames : Frames
        The data frames, with the counts of the other lines.
    lines : int
        Lines that are not blank.
    first_damaged : int or None
        Index of the first damaged line in the text, counted from 0 with blank lines.
    """

    frames: Frames
    lines: int
    first_damaged: int | None


def is_candump(head: str, *, printed: bool = False) -> bool:
    """Whether a text begins with lines of candump; with `printed`, as it prints them without ``-L``."""
    lines = [line for line in head.splitlines() if line.strip()][:50]
    forms = (_PRINTED,) if printed else (_PRINTED, _LOGGED)
    return 2 * sum(any(form.match(line.encode()) for form in forms) for line in lines) > len(lines)


def read_candump(path: Path) -> Frames:
    """Read a text of candump; single broken lines are left out and counted.

    Parameters
    ----------
    path : Path
        The file, gzipped or not.

    Returns
    -------
    Frames
        In the order of the lines.

    Raises
    ------
    LogError
        If the file is cut, more than :data:`.MAX_DAMAGED_SHARE` of its lines are damaged, or they have no times.
    """
    parts: list[Frames] = []
    first_damaged: int | None = None
    lines = above = 0
    try:
        printed = is_candump(text_head(path)[0], printed=True)
        with open_log(path) as file:
            for text in [_log_lines(file.read(), str(path))] if printed else text_blocks(file):
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
            f"{reason_of(error)}; {frames_before} frames before it are readable; {remedy_for(path, frames_before)}"
        ) from None
    frames = concatenate_frames(parts)
    if frames.damaged > MAX_DAMAGED_SHARE * lines:
        raise LogError(
            f"{path}: line {first_damaged} is damaged, and {frames.damaged} of {lines} lines are; "
            f"expected '(seconds) channel identifier#data' as 'candump -L' writes it; {len(frames)} frames are readable"
        )
    return frames


def _log_lines(text: bytes, where: str) -> bytes:
    """Turn what candump prints into as many lines of ``candump -L``; other lines stay as they are.

    Times are absolute (``-ta``, ``-tA``), since the start (``-tz``) or since the line before (``-td``), which hardly
    ever increase.
    """
    times = [match["time"] for match in _PRINTED.finditer(text)]
    if None in times:
        raise LogError(f"{where}: printed by candump without times; record it with 'candump -L' or 'candump -ta'")
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

    return _PRINTED.sub(line, text)


def _seconds(time: str) -> float:
    """Seconds since 1970 or any other instant; NaN for what is no time."""
    try:
        return datetime.fromisoformat(time).timestamp() if "-" in time else float(time)
    except ValueError:
        return nan


def parse_candump(text: bytes) -> CandumpBlock:
    """Parse whole lines of ``candump -L``.

    Parameters
    ----------
    text : bytes
        Whole lines; line ends may be LF or CRLF.

    Returns
    -------
    CandumpBlock
        The frames in the order of the lines, and what could not be read.
    """
    columns = FrameColumns.of(text.count(b"\n") + (not text.endswith(b"\n")), fd=b"##" in text)
    names = np.zeros((_MOST_CHANNELS, 2), np.int64)
    found = _parse(np.frombuffer(text, np.uint8), HEX, names, columns)
    frames = columns.frames([text[start:end].decode("latin-1") for start, end in names[:found].tolist()])
    first = int(np.argmax(columns.kind == DAMAGED)) if frames.damaged else None
    return CandumpBlock(frames=frames, lines=int(np.count_nonzero(columns.kind)), first_damaged=first)


@compiled
def _parse(text: _Text, digits: _Text, names: NDArray[np.int64], columns: FrameColumns) -> int:
    """Parse line by line; the number of different channels, whose first and last places in the text are `names`."""
    row, start, channels = 0, 0, 0
    while start < len(text):
        end = start
        while end < len(text) and text[end] != _LF:
            end += 1
        stop = end - 1 if end > start and text[end - 1] == _CR else end
        columns.kind[row], first, last = _parse_line(text[:stop], start, digits, row, columns)
        if columns.kind[row] == DATA:
            number = 0
            while number < channels and not _same(text, names[number], first, last):
                number += 1
            if number == _MOST_CHANNELS:
                columns.kind[row] = DAMAGED
            elif number == channels:
                names[number, 0], names[number, 1] = first, last
                channels += 1
            columns.channel[row] = number
        row += 1
        start = end + 1
    return channels


@inner
def _same(text: _Text, name: NDArray[np.int64], first: int, last: int) -> bool:
    """Whether two parts of the text are the same."""
    if name[1] - name[0] != last - first:
        return False
    for k in range(last - first):  # noqa: SIM110 (compiled)
        if text[name[0] + k] != text[first + k]:
            return False
    return True


@inner
def _parse_line(  # noqa: PLR0911, PLR0912 (a line is judged from left to right)
    text: _Text, at: int, digits: _Text, row: int, columns: FrameColumns
) -> tuple[int, int, int]:
    """Parse what starts here and ends with the text into a row: what it is, and where its channel stands."""
    stop = len(text)
    if at == stop:
        return NOTHING, 0, 0
    if text[at] != _OPEN:
        return DAMAGED, 0, 0
    seconds, at = _decimal(text, at + 1, 10)
    if at < 0 or seconds >= 9 * 10**9 or at == stop or text[at] != _POINT:
        return DAMAGED, 0, 0
    fraction, end = _decimal(text, at + 1, 9)
    if end - at - 1 == 6:
        fraction *= 1000
    elif end - at - 1 != 9:
        return DAMAGED, 0, 0
    if end + 2 > stop or text[end] != _CLOSE or text[end + 1] != _SPACE:
        return DAMAGED, 0, 0
    first = last = end + 2
    while last < stop and text[last] != _SPACE:
        last += 1
    at, identifier = last + 1, 0
    while at < stop and digits[text[at]] != _NOT_HEX and at - last <= 8:
        identifier = 16 * identifier + digits[text[at]]
        at += 1
    extended = at - last == 9
    largest = (_ERROR_BIT | LARGEST_IDENTIFIER) if extended else 0x7FF
    if last - first > _LONGEST_NAME or not (extended or at - last == 4) or identifier > largest:
        return DAMAGED, 0, 0
    if at >= stop or text[at] != _HASH:
        return DAMAGED, 0, 0
    fd = at + 1 < stop and text[at + 1] == _HASH
    at += 1
    if fd:
        if at + 1 >= stop or digits[text[at + 1]] == _NOT_HEX:
            return DAMAGED, 0, 0
        at += 2
    end = at
    while end < stop and text[end] != _SPACE:
        end += 1
    direction = text[stop - 1] & 0xDF  # upper case
    if end < stop and not (stop - end == 2 and (direction == ord("R") or direction == ord("T"))):
        return DAMAGED, 0, 0
    if identifier & _ERROR_BIT:
        return ERROR, first, last
    if not fd and end > at and text[at] & 0xDF == ord("R"):
        return REMOTE, first, last
    size = (end - at) // 2
    if (end - at) % 2 or size > (FD_BYTES if fd else CLASSIC_BYTES):
        return DAMAGED, 0, 0
    for k in range(size):
        high, low = digits[text[at + 2 * k]], digits[text[at + 2 * k + 1]]
        if max(high, low) == _NOT_HEX:
            return DAMAGED, 0, 0
        columns.data[row, k] = 16 * high + low
    columns.time_ns[row] = seconds * 10**9 + fraction
    columns.key[row] = identifier | EXTENDED_BIT if extended else identifier
    columns.length[row] = size
    return DATA, first, last


@inner
def _decimal(text: _Text, at: int, most: int) -> tuple[int, int]:
    """Number of up to so many decimal digits, and where it ends; -1 if there is none."""
    value, end = 0, at
    while end < len(text) and end - at < most and ord("0") <= text[end] <= ord("9"):
        value = 10 * value + (text[end] - ord("0"))
        end += 1
    return value, end if end > at else -1
