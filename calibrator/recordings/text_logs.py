"""Lines of candump and of ASC files (Vector's text logs) turned into frame arrays by compiled code.

    (1740960798.000833) can0 2E5#000007320000DD00           candump -L: classic, 11 bits
    (1740960798.000833) can0 000002E5##1000007320000DD00    CAN FD, 29 bits; one digit of flags after ##
    (1740960798.000833) can0 123#R8                         remote frame

    (1740960798.000833)  can0  2E5   [8]  00 00 07 32      printed with -ta, -tA, -tz, -td: turned into the form above

       0.011478 1  1F334455x       Rx   d 8 50 04 0C A9 D4 03 88 01  Length = 0 BitCount = 0          ASC

A line of candump of none of these forms is damaged and counted. python-can takes about thirty times as long for an ASC
file, and reads what is left: files with CAN FD, decimal numbers, or anything that looks like a frame and is not quite
one.
"""

import re
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
    PRINTED_CANDUMP,
    UNREADABLE,
    is_candump,
    open_log,
    reason_of,
    text_blocks,
    text_head,
)

__all__ = ["parse_candump", "read_candump", "read_plain_asc"]

_DECIMAL = re.compile(r"^base\s+dec", re.MULTILINE | re.IGNORECASE)
_MOST_DISORDER = 0.1
"""Share of lines whose time is not after the one before: in a log nearly none, of distances about half. [1]"""
_SINCE_1970_S = 1e8
"""Later than any time since a start. [s]"""
_ERROR_BIT = 1 << 29
_MOST_CHANNELS = 256
"""Different names in one block of text; no machine has more buses."""
_NANOSECOND_DIGITS = 9
_UNUSUAL = 255
"""Of a line of an ASC file that python-can is to judge."""
_NOT_HEX = 255
HEX = np.array([int(c, 16) if c in "0123456789ABCDEFabcdef" else _NOT_HEX for c in map(chr, range(256))], np.uint8)
"""Value of each character as a hexadecimal digit."""
_Text = NDArray[np.uint8]


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
    first_damaged, lines, above = 0, 0, 0
    try:
        printed = is_candump(text_head(path)[0], printed=True)
        with open_log(path) as file:
            for text in [_log_lines(file.read(), str(path))] if printed else text_blocks(file):
                frames, kind = parse_candump(text)
                if frames.damaged and not first_damaged:
                    first_damaged = above + int(np.argmax(kind == DAMAGED)) + 1
                parts.append(frames)
                lines += int(np.count_nonzero(kind))
                above += len(kind)
    except UNREADABLE as error:
        raise LogError(
            f"{path}: truncated or damaged {f'after line {above}' if above else 'in its first line'}: "
            f"{reason_of(error)}; {sum(map(len, parts))} frames before it are readable; copy the file again"
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
    times = [match["time"] for match in PRINTED_CANDUMP.finditer(text)]
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

    return PRINTED_CANDUMP.sub(line, text)


def _seconds(time: str) -> float:
    """Seconds since 1970 or any other instant; NaN for what is no time."""
    try:
        return datetime.fromisoformat(time).timestamp() if "-" in time else float(time)
    except ValueError:
        return nan


def parse_candump(text: bytes) -> tuple[Frames, NDArray[np.uint8]]:
    """Parse lines of ``candump -L`` that end in LF or CRLF: frames in their order, and what each line is."""
    text = text if text.endswith(b"\n") else text + b"\n"
    lines, found, fd = text.count(b"\n"), -1, False
    while found < 0:
        columns, names = FrameColumns.of(lines, fd=fd), np.zeros((_MOST_CHANNELS, 2), np.int64)
        found, fd = _parse_candump(np.frombuffer(text, np.uint8), HEX, names, columns), True
    return columns.frames([text[start:end].decode("latin-1") for start, end in names[:found].tolist()]), columns.kind


def read_plain_asc(path: Path) -> Frames | None:
    """Read an ASC file, gzipped or not; None if it is damaged or has lines for python-can."""
    parts: list[Frames] = []
    try:
        if _DECIMAL.search(text_head(path)[0]):
            return None
        with open_log(path) as file:
            for text in text_blocks(file):
                columns = FrameColumns.of(_lines(text), fd=False)
                if not _parse_asc(np.frombuffer(text, np.uint8), HEX, columns):
                    return None
                parts.append(columns.frames())
    except UNREADABLE:
        return None
    return concatenate_frames(parts)


def _lines(text: bytes) -> int:
    return text.count(b"\n") + (not text.endswith(b"\n"))


@compiled
def _parse_candump(  # noqa: PLR0912, PLR0915 (a line is judged from left to right)
    text: _Text, digits: _Text, names: NDArray[np.int64], columns: FrameColumns
) -> int:
    """Parse line by line; the number of different channels, whose first and last places in the text are `names`.

    The text ends with a line end. -1: a payload has no room in the columns. One loop without calls is three times as
    fast as a function per line; nothing goes beyond a line end, so what follows a fault in a line does no harm.
    """
    kind, time_ns, key, channel, length, data = columns
    row, at, channels = 0, 0, 0
    while at < len(text):
        start, seconds, fraction, identifier, size = at, 0, 0, 0, 0
        at += text[at] == ord("(")
        while ord("0") <= text[at] <= ord("9"):
            seconds = 10 * seconds + (text[at] - ord("0"))
            at += 1
        sound = text[start] == ord("(") and 2 <= at - start <= 11 and seconds < 9 * 10**9 and text[at] == ord(".")
        at += sound
        point = at
        while ord("0") <= text[at] <= ord("9"):
            fraction = 10 * fraction + (text[at] - ord("0"))
            at += 1
        nanoseconds = at - point == 9
        sound = sound and (nanoseconds or at - point == 6) and text[at] == ord(")") and text[at + 1] == ord(" ")
        at += 2 * sound
        first = at
        while text[at] > ord(" "):
            at += 1
        last = at
        while text[at] == ord(" "):
            at += 1
        begin = at
        while digits[text[at]] != _NOT_HEX and at - begin <= 8:
            identifier = 16 * identifier + digits[text[at]]
            at += 1
        extended = at - begin == 8
        sound = sound and (extended or at - begin == 3) and text[at] == ord("#")
        sound = sound and identifier <= ((_ERROR_BIT | LARGEST_IDENTIFIER) if extended else 0x7FF)
        at += sound
        fd = text[at] == ord("#")
        what = ERROR if identifier & _ERROR_BIT else DATA
        if fd:  # a digit of flags follows
            at += 1
            sound = sound and digits[text[at]] != _NOT_HEX
            at += sound
        elif text[at] & 0xDF == ord("R"):  # upper case
            what = REMOTE
            while text[at] > ord(" "):
                at += 1
        while digits[text[at]] != _NOT_HEX and digits[text[at + 1]] != _NOT_HEX:
            if size < data.shape[1]:
                data[row, size] = 16 * digits[text[at]] + digits[text[at + 1]]
            size, at = size + 1, at + 2
        if text[at] == ord(" ") and (text[at + 1] & 0xDF == ord("R") or text[at + 1] & 0xDF == ord("T")):
            at += 2
        at += text[at] == ord("\r")
        sound = sound and size <= (FD_BYTES if fd else CLASSIC_BYTES) and text[at] == ord("\n")
        if sound and what == DATA:
            if size > data.shape[1]:
                return -1
            number = 0
            while number < channels and not _is_same(text, names[number, 0], names[number, 1], first, last):
                number += 1
            if number == channels and channels < len(names):
                names[number, 0], names[number, 1] = first, last
                channels += 1
            sound = number < len(names)
            time_ns[row], channel[row], length[row] = (
                seconds * 10**9 + fraction * (1 if nanoseconds else 1000),
                number,
                size,
            )
            key[row] = identifier | EXTENDED_BIT if extended else identifier
        is_blank = text[start] == ord("\n") or (text[start] == ord("\r") and text[start + 1] == ord("\n"))
        kind[row] = what if sound else NOTHING if is_blank else DAMAGED
        while text[at] != ord("\n"):
            at += 1
        row, at = row + 1, at + 1
    return channels


@compiled
def _parse_asc(text: _Text, digits: _Text, columns: FrameColumns) -> bool:
    """Parse line by line; whether all of them are usual."""
    row, start = 0, 0
    while start < len(text):
        stop, end = _line_end(text, start)
        columns.kind[row] = _asc_line(text[:stop], start, digits, row, columns)
        if columns.kind[row] == _UNUSUAL:
            return False
        row, start = row + 1, end + 1
    return True


@inner
def _line_end(text: _Text, end: int) -> tuple[int, int]:
    """Where a line ends without and with CR."""
    start = end
    while end < len(text) and text[end] != ord("\n"):
        end += 1
    return (end - 1 if end > start and text[end - 1] == ord("\r") else end), end


@inner
def _is_same(text: _Text, first: int, last: int, first_too: int, last_too: int) -> bool:
    """Whether two parts of the text are the same."""
    if last - first != last_too - first_too:
        return False
    for k in range(last - first):  # noqa: SIM110 (compiled)
        if text[first + k] != text[first_too + k]:
            return False
    return True


@inner
def _asc_line(  # noqa: PLR0911, PLR0912 (as above)
    text: _Text, at: int, digits: _Text, row: int, columns: FrameColumns
) -> int:
    """Parse what starts here and ends with the text into a row; what it is."""
    at, end = _word(text, at)
    time_ns, fraction, at = _time(text, at)
    if fraction < 0 or at != end:
        return NOTHING  # a line of the header, or a comment
    if time_ns < 0:
        return _UNUSUAL
    at, end = _word(text, end)
    if end - at == 5 and text[at] == ord("C") and text[at + 4] == ord("D"):
        return _UNUSUAL  # CANFD
    channel = 0
    for k in range(at, end):
        if not ord("0") <= text[k] <= ord("9"):
            return NOTHING  # another event
        channel = 10 * channel + (text[k] - ord("0"))
    identifier_at, identifier_end = _word(text, end)
    if identifier_at < len(text) and text[identifier_at] == ord("E") and identifier_end - identifier_at == 10:
        return ERROR
    at, end = _word(text, identifier_end)
    if end - at != 2 or text[at + 1] != ord("x") or not (text[at] == ord("R") or text[at] == ord("T")):
        return NOTHING
    extended = text[identifier_end - 1] == ord("x")
    identifier = _hexadecimal(text, identifier_at, identifier_end - extended, digits)
    at, end = _word(text, end)
    if not 0 <= identifier <= LARGEST_IDENTIFIER or end - at != 1 or channel > 255:
        return _UNUSUAL
    if text[at] == ord("r"):
        return REMOTE
    at, end = _word(text, end)
    length = _hexadecimal(text, at, end, digits)
    if not 0 <= length <= CLASSIC_BYTES:
        return _UNUSUAL
    for k in range(length):
        at, end = _word(text, end)
        if at == len(text):
            return DAMAGED
        value = _hexadecimal(text, at, end, digits)
        if not 0 <= value <= 0xFF:
            return _UNUSUAL
        columns.data[row, k] = value
    columns.time_ns[row], columns.channel[row], columns.length[row] = time_ns, channel, length
    columns.key[row] = identifier | EXTENDED_BIT if extended else identifier
    return DATA


@inner
def _word(text: _Text, at: int) -> tuple[int, int]:
    """First and last place of the next word; both the end if there is none."""
    while at < len(text) and text[at] <= ord(" "):
        at += 1
    end = at
    while end < len(text) and text[end] > ord(" "):
        end += 1
    return at, end


@inner
def _time(text: _Text, at: int) -> tuple[int, int, int]:
    """Seconds with a fraction in ns, -1 if they are too many digits; digits of the fraction, -1 for none; its end."""
    time_ns, seconds, point = 0, 0, -1
    start = at
    while at < len(text) and (ord("0") <= text[at] <= ord("9") or (text[at] == ord(".") and point < 0)):
        if text[at] == ord("."):
            point, seconds, time_ns = at, time_ns, 0
        elif time_ns < 10**11:
            time_ns = 10 * time_ns + (text[at] - ord("0"))
        at += 1
    digits = at - point - 1 if point >= start else -1
    if digits < 0 or digits > _NANOSECOND_DIGITS or seconds >= 9 * 10**9:
        return -1, digits, at
    for _ in range(digits, _NANOSECOND_DIGITS):
        time_ns *= 10
    return seconds * 10**9 + time_ns, digits, at


@inner
def _hexadecimal(text: _Text, at: int, end: int, digits: _Text) -> int:
    """Number of up to 8 hexadecimal digits, -1 for anything else."""
    value = 0 if 0 < end - at <= 8 else -1
    for k in range(at, end):
        value = -1 if value < 0 or digits[text[k]] == _NOT_HEX else 16 * value + digits[text[k]]
    return value
