"""ASC files (Vector's text logs) into frame arrays: plain lines of classic frames by compiled code, else by python-can.

       0.011478 1  1F334455x       Rx   d 8 50 04 0C A9 D4 03 88 01  Length = 0 BitCount = 0

python-can takes about thirty times as long, and reads what is left: files with CAN FD, decimal numbers, or anything
that looks like a frame and is not quite one.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled, inner
from calibrator.recordings.candump import HEX
from calibrator.recordings.frame_arrays import (
    CLASSIC_BYTES,
    DAMAGED,
    DATA,
    ERROR,
    EXTENDED_BIT,
    LARGEST_IDENTIFIER,
    NOTHING,
    REMOTE,
    FrameColumns,
    Frames,
    concatenate_frames,
)
from calibrator.recordings.log_files import UNREADABLE, open_log, text_blocks, text_head

__all__ = ["read_plain_asc"]

_DECIMAL = re.compile(r"^base\s+dec", re.MULTILINE | re.IGNORECASE)
_UNUSUAL = 255
"""Of a line that python-can is to judge."""
_MOST_CHANNEL = 255
_LONGEST_FRACTION = 9
"""Digits of a second. [1]"""
_Text = NDArray[np.uint8]


def read_plain_asc(path: Path) -> Frames | None:
    """Read an ASC file.

    Parameters
    ----------
    path : Path
        The file, gzipped or not.

    Returns
    -------
    Frames or None
        In the order of the lines; None if the file is damaged or has lines for python-can.
    """
    parts: list[Frames] = []
    try:
        if _DECIMAL.search(text_head(path)[0]):
            return None
        with open_log(path) as file:
            for text in text_blocks(file):
                columns = FrameColumns.of(text.count(b"\n") + (not text.endswith(b"\n")), fd=False)
                if not _parse(np.frombuffer(text, np.uint8), HEX, columns):
                    return None
                parts.append(columns.frames())
    except UNREADABLE:
        return None
    return concatenate_frames(parts)


@compiled
def _parse(text: _Text, digits: _Text, columns: FrameColumns) -> bool:
    """Parse line by line; whether all of them are usual."""
    row, start = 0, 0
    while start < len(text):
        end = start
        while end < len(text) and text[end] != ord("\n"):
            end += 1
        columns.kind[row] = _parse_line(text[:end], start, digits, row, columns)
        if columns.kind[row] == _UNUSUAL:
            return False
        row += 1
        start = end + 1
    return True


@inner
def _parse_line(  # noqa: PLR0911, PLR0912 (a line is judged from left to right)
    text: _Text, at: int, digits: _Text, row: int, columns: FrameColumns
) -> int:
    """Parse what starts here and ends with the text into a row; what it is."""
    at, end = _word(text, at)
    seconds, fraction = 0, 0
    while at < end and ord("0") <= text[at] <= ord("9"):
        seconds = 10 * seconds + (text[at] - ord("0"))
        at += 1
    point = at
    if point == end or text[point] != ord("."):
        return NOTHING  # a line of the header, or a comment
    for at in range(point + 1, end):
        if not ord("0") <= text[at] <= ord("9"):
            return NOTHING
        fraction = 10 * fraction + (text[at] - ord("0"))
    if end - point - 1 > _LONGEST_FRACTION or seconds >= 9 * 10**9:
        return _UNUSUAL
    for _ in range(end - point - 1, _LONGEST_FRACTION):
        fraction *= 10
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
    identifier, identifier_end = _hexadecimal(text, identifier_at, identifier_end - extended, digits)
    at, end = _word(text, end)
    if identifier < 0 or identifier > LARGEST_IDENTIFIER or end - at != 1 or channel > _MOST_CHANNEL:
        return _UNUSUAL
    if text[at] == ord("r"):
        return REMOTE
    at, end = _word(text, end)
    length, _ = _hexadecimal(text, at, end, digits)
    if length < 0 or length > CLASSIC_BYTES:
        return _UNUSUAL
    for k in range(length):
        at, end = _word(text, end)
        if at == len(text):
            return DAMAGED
        value, _ = _hexadecimal(text, at, end, digits)
        if value < 0 or value > 0xFF:
            return _UNUSUAL
        columns.data[row, k] = value
    columns.time_ns[row] = seconds * 10**9 + fraction
    columns.key[row] = identifier | EXTENDED_BIT if extended else identifier
    columns.channel[row], columns.length[row] = channel, length
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
def _hexadecimal(text: _Text, at: int, end: int, digits: _Text) -> tuple[int, int]:
    """Number of up to 8 hexadecimal digits, -1 for anything else, and where it ends."""
    value = 0 if 0 < end - at <= 8 else -1
    for k in range(at, end):
        value = -1 if value < 0 or digits[text[k]] > 15 else 16 * value + digits[text[k]]
    return value, end
