"""Lines of ``candump`` turned into frame arrays; those of ``candump -L`` without a Python object per frame.

    (1740960798.000833) can0 2E5#000007320000DD00           classic, 11 bits
    (1740960798.000833) can0 000002E5##1000007320000DD00    CAN FD, 29 bits; one digit of flags after ##
    (1740960798.000833) can0 123#R8                         remote frame

    (1740960798.000833)  can0  2E5   [8]  00 00 07 32      printed with -ta, -tA, -tz, -td: turned into the form above

Lines of one shape (lengths of time stamp, channel, identifier and payload) are a matrix of characters; a file has a few
dozen shapes at most. A line of no known shape is damaged and counted.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from math import isfinite, nan
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import (
    CLASSIC_BYTES,
    EXTENDED_BIT,
    FD_BYTES,
    LARGEST_IDENTIFIER,
    Frames,
    concatenate_frames,
)
from calibrator.recordings.log_files import (
    MAX_DAMAGED_SHARE,
    UNREADABLE,
    open_log,
    read_undamaged,
    reason_of,
    remedy_for,
    text_head,
)

__all__ = ["is_candump", "parse_candump", "read_candump"]

_Characters = NDArray[np.uint8]
_Numbers = NDArray[np.int64]

BLOCK_BYTES = 1 << 23
"""Text parsed at a time: bounds the memory, large enough for the array operations."""

_ERROR_BIT = 1 << 29
_STANDARD_DIGITS = 3
_EXTENDED_DIGITS = 8
_LARGEST_SHAPE = 256
"""No field of a line is this long; longer ones are damage."""
_FD_MARK = len("##1")
_SECOND_DIGITS = range(1, 11)
_FRACTION_DIGITS = (6, 9)
"""candump writes microseconds, or nanoseconds where asked."""

_NOT_HEX = 255
_HEX = np.full(256, _NOT_HEX, np.uint8)
for _digit, _character in enumerate("0123456789ABCDEF"):
    _HEX[[ord(_character), ord(_character.lower())]] = _digit


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
            for text in [_log_lines(file.read(), str(path))] if printed else _blocks(file):
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


def _blocks(file: BinaryIO) -> Iterator[bytes]:
    """Pieces of some size that end at a line end; those before a damage come before its error."""
    rest, damage, ended = b"", None, False
    while damage is None and not ended:
        part, damage = read_undamaged(file, BLOCK_BYTES)
        ended = not part and damage is None
        text = rest + part
        cut = len(text) if ended else text.rfind(b"\n") + 1
        rest = text[cut:]
        if cut:
            yield text[:cut]
    if damage is not None:
        raise damage


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
    buffer = np.frombuffer(text, np.uint8)
    starts, ends, numbers = _lines(buffer)
    if not starts.size:
        return CandumpBlock(frames=concatenate_frames([]), lines=0, first_damaged=None)
    edges, known = _edges(buffer, starts, ends)
    damaged = ~known
    kept, parts = [np.zeros(0, np.int64)], []
    for lines in _shapes(edges, np.flatnonzero(known)):
        frames, sound = _parse_shape(buffer, edges, damaged, lines)
        parts.append(frames)
        kept.append(sound)
    frames = concatenate_frames(parts).take(np.argsort(np.concatenate(kept), kind="stable"))
    first = int(numbers[np.argmax(damaged)]) if damaged.any() else None
    return CandumpBlock(frames=replace(frames, damaged=int(damaged.sum())), lines=len(starts), first_damaged=first)


def _lines(buffer: _Characters) -> tuple[_Numbers, _Numbers, _Numbers]:
    """Start, end and number of each line that is not blank; blanks at the ends are left out."""
    breaks = np.flatnonzero(buffer == ord("\n"))
    starts = np.concatenate([[0], breaks + 1])
    ends = np.concatenate([breaks, [len(buffer)]])
    has_return = (ends > starts) & (buffer[np.maximum(ends - 1, 0)] == ord("\r")) if buffer.size else ends > starts
    ends = ends - has_return
    kept = np.flatnonzero(ends > starts)
    return starts[kept], ends[kept], kept


def _edges(buffer: _Characters, starts: _Numbers, ends: _Numbers) -> tuple[list[_Numbers], NDArray[np.bool_]]:
    """Where time, channel, identifier and payload of each line start and end; if it has just these."""

    def at(position: _Numbers) -> _Characters:
        return buffer[np.clip(position, 0, len(buffer) - 1)]

    spaces = np.append(np.flatnonzero(buffer == ord(" ")), [len(buffer)] * 3)
    hashes = np.append(np.flatnonzero(buffer == ord("#")), [len(buffer)])
    first = np.searchsorted(spaces, starts)
    space, second_space = spaces[first], spaces[first + 1]
    payload_end = np.minimum(spaces[first + 2], ends)
    mark = hashes[np.searchsorted(hashes, starts)]
    fd = at(mark + 1) == ord("#")
    time, channel, identifier = (starts + 1, space - 1), (space + 1, second_space), (second_space + 1, mark)
    edges = [*time, *channel, *identifier, np.where(fd, mark + _FD_MARK, mark + 1), payload_end]
    known = (buffer[starts] == ord("(")) & (at(space - 1) == ord(")"))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        known &= (start <= end) & (end - start < _LARGEST_SHAPE)
    direction = at(ends - 1) & ~np.uint8(0x20)
    tail = ends - payload_end
    known &= (tail == 0) | ((tail == len(" R")) & ((direction == ord("R")) | (direction == ord("T"))))
    return edges, known & (~fd | (_HEX[at(mark + 2)] != _NOT_HEX))


def _shapes(edges: list[_Numbers], known: _Numbers) -> list[_Numbers]:
    """Groups of lines whose fields have the same lengths."""
    if not known.size:
        return []
    shape = np.zeros(len(known), np.int64)
    for k in (0, 2, 4, 5, 6):  # from 5 to 6 is the mark
        shape = shape * _LARGEST_SHAPE + (edges[k + 1] - edges[k])[known]
    order = np.argsort(shape, kind="stable")
    return np.split(known[order], np.flatnonzero(np.diff(shape[order])) + 1)


def _parse_shape(
    buffer: _Characters, edges: list[_Numbers], damaged: NDArray[np.bool_], lines: _Numbers
) -> tuple[Frames, _Numbers]:
    """Frames of lines of one shape and their lines; marks the lines that are none in `damaged`."""
    time, channel, identifier_text, payload = (
        _matrix(buffer, edges[k][lines], edges[k + 1][lines[0]]) for k in (0, 2, 4, 6)
    )
    fd = edges[6][lines[0]] - edges[5][lines[0]] == _FD_MARK
    remote = np.full(len(lines), fill_value=False)
    if not fd and payload.shape[1]:
        remote = (payload[:, 0] & ~np.uint8(0x20)) == ord("R")
    time_ns, time_ok = _times(time)
    identifier, identifier_ok = _identifiers(identifier_text)
    data, data_ok = _payloads(payload, FD_BYTES if fd else CLASSIC_BYTES)
    error = identifier_ok & (identifier & _ERROR_BIT > 0)
    sound = time_ok & identifier_ok & (data_ok | remote | error)
    damaged[lines[~sound]] = True
    kept = sound & ~remote & ~error
    number, channels = _channels(channel)
    extended = EXTENDED_BIT if identifier_text.shape[1] == _EXTENDED_DIGITS else 0
    frames = Frames(
        time_ns=time_ns[kept],
        key=(identifier[kept] & LARGEST_IDENTIFIER | extended).astype(np.uint32),
        channel=number[kept],
        length=np.full(int(kept.sum()), payload.shape[1] // 2 if data_ok.any() else 0, np.uint8),
        data=data[kept],
        channels=channels,
        error_frames=int((sound & error).sum()),
        remote_frames=int((sound & remote & ~error).sum()),
    )
    return frames, lines[kept]


def _matrix(buffer: _Characters, starts: _Numbers, first_end: np.int64) -> _Characters:
    """Characters of a field of the same length in all lines, shape (n, width)."""
    width = int(first_end - starts[0])
    return sliding_window_view(buffer, width)[starts] if width else np.zeros((len(starts), 0), np.uint8)


def _decimal(digits: _Characters) -> tuple[_Numbers, NDArray[np.bool_]]:
    values = digits - np.uint8(ord("0"))
    return _positional(values, 10), np.all(values <= 9, axis=1)  # what lies below "0" wraps


def _positional(digits: _Characters, base: int) -> _Numbers:
    """Value of up to 10 digits; in float64, where that is exact, as it multiplies matrices faster."""
    powers = float(base) ** np.arange(digits.shape[1])[::-1]
    return np.asarray(digits.astype(np.float64) @ powers).astype(np.int64)


def _times(text: _Characters) -> tuple[_Numbers, NDArray[np.bool_]]:
    """Time stamps such as 1740960798.000833 in nanoseconds."""
    for fraction in _FRACTION_DIGITS:
        whole = text.shape[1] - fraction - 1
        if whole in _SECOND_DIGITS and np.all(text[:, whole] == ord(".")):
            seconds, seconds_ok = _decimal(text[:, :whole])
            parts, parts_ok = _decimal(text[:, whole + 1 :])
            time_ns = seconds * 10**9 + parts * 10 ** (9 - fraction)
            return time_ns, seconds_ok & parts_ok & (seconds < 9 * 10**9)
    return np.zeros(len(text), np.int64), np.full(len(text), fill_value=False)


def _identifiers(text: _Characters) -> tuple[_Numbers, NDArray[np.bool_]]:
    if text.shape[1] not in {_STANDARD_DIGITS, _EXTENDED_DIGITS}:
        return np.zeros(len(text), np.int64), np.full(len(text), fill_value=False)
    digits = _HEX[text]
    value = _positional(digits, 16)
    largest = 0x7FF if text.shape[1] == _STANDARD_DIGITS else _ERROR_BIT | LARGEST_IDENTIFIER
    return value, np.all(digits != _NOT_HEX, axis=1) & (value <= largest)


def _payloads(text: _Characters, width: int) -> tuple[_Characters, NDArray[np.bool_]]:
    data = np.zeros((len(text), width), np.uint8)
    if text.shape[1] % 2 or text.shape[1] > 2 * width:
        return data, np.full(len(text), fill_value=False)
    digits = _HEX[text]
    data[:, : text.shape[1] // 2] = (digits[:, ::2] << 4) | (digits[:, 1::2] & 0xF)
    return data, np.all(digits != _NOT_HEX, axis=1)


def _channels(text: _Characters) -> tuple[NDArray[np.uint32], tuple[str, ...]]:
    """Index of each line's channel, and the names."""
    if not text.shape[1]:
        return np.zeros(len(text), np.uint32), ("",)
    names, index = np.unique(np.ascontiguousarray(text).view(f"S{text.shape[1]}").ravel(), return_inverse=True)
    return index.astype(np.uint32), tuple(bytes(name).decode("latin-1") for name in names)
