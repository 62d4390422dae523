"""Lines of ``candump`` turned into frame arrays; those of ``candump -L`` without a Python object per frame.

    (1740960798.000833) can0 2E5#000007320000DD00           classic, 11 bits
    (1740960798.000833) can0 000002E5##1000007320000DD00    CAN FD, 29 bits; one digit of flags after ##
    (1740960798.000833) can0 123#R8                         remote frame

    (1740960798.000833)  can0  2E5   [8]  00 00 07 32      printed with -ta, -tA, -tz, -td: turned into the form above

Lines of one shape (lengths of time stamp, channel, identifier and payload) are a matrix of characters; a file has a few
dozen shapes at most. A line of no known shape is damaged and counted.
"""

import re
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import CLASSIC_BYTES, EXTENDED_BIT, FD_BYTES, Frames, concatenate_frames

__all__ = ["CandumpBlock", "is_candump", "log_lines", "parse_candump"]

_Bytes = NDArray[np.uint8]
_Index = NDArray[np.int64]

_ERROR_BIT = 1 << 29
_IDENTIFIER_MASK = (1 << 29) - 1
_STANDARD_DIGITS = 3
_EXTENDED_DIGITS = 8
_LARGEST_SHAPE = 256
"""No field of a line is this long; longer ones are damage."""
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


@dataclass(frozen=True, kw_only=True)
class _Fields:
    """Where the fields of each line start and end, shape (n,) each; `known` is False where the line has other parts."""

    known: NDArray[np.bool_]
    time: tuple[_Index, _Index]
    channel: tuple[_Index, _Index]
    identifier: tuple[_Index, _Index]
    payload: tuple[_Index, _Index]
    fd: NDArray[np.bool_]


def is_candump(head: str, *, printed: bool = False) -> bool:
    """Whether a text begins with lines of candump; with `printed`, as it prints them without ``-L``."""
    lines = [line for line in head.splitlines() if line.strip()][:50]
    forms = (_PRINTED,) if printed else (_PRINTED, _LOGGED)
    return 2 * sum(any(form.match(line.encode()) for form in forms) for line in lines) > len(lines)


def log_lines(text: bytes, where: str) -> bytes:
    """Turn what candump prints into lines of ``candump -L``.

    Parameters
    ----------
    text : bytes
        Whole lines with absolute times (``-ta``, ``-tA``), times since the start (``-tz``) or since the line before
        (``-td``), which hardly ever increase. Other lines stay as they are.
    where : str
        The file, for messages.

    Returns
    -------
    bytes
        As many lines.

    Raises
    ------
    LogError
        If the lines have no times.
    """
    times = [match["time"] for match in _PRINTED.finditer(text)]
    if None in times:
        raise LogError(f"{where}: printed by candump without times; record it with 'candump -L' or 'candump -ta'")
    seconds = np.array([_seconds(time.decode()) for time in times])
    if np.mean(np.diff(seconds, prepend=-1.0) <= 0.0) > _MOST_DISORDER and np.all(seconds < _SINCE_1970_S):
        seconds = np.cumsum(seconds)
    left = iter(seconds.tolist())

    def line(match: re.Match[bytes]) -> bytes:
        fd = b"##0" if len(match["length"]) > 1 else b"#"
        data = b"R" if match["remote"] else match["data"].replace(b" ", b"")
        return b"(%.6f) %b %b%b%b" % (next(left), match["channel"], match["id"], fd, data)

    return _PRINTED.sub(line, text)


def _seconds(time: str) -> float:
    return datetime.fromisoformat(time).timestamp() if "-" in time else float(time)


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
    fields = _fields(buffer, starts, ends)
    damaged = ~fields.known
    groups = [_parse_shape(buffer, fields, index, damaged) for index in _shapes(fields, np.flatnonzero(fields.known))]
    order = np.argsort(np.concatenate([np.zeros(0, np.int64), *(lines for _, lines in groups)]), kind="stable")
    joined = concatenate_frames([frames for frames, _ in groups])
    frames = replace(joined.take(order), damaged=int(damaged.sum()))
    first = int(numbers[np.argmax(damaged)]) if damaged.any() else None
    return CandumpBlock(frames=frames, lines=len(starts), first_damaged=first)


def _lines(buffer: _Bytes) -> tuple[_Index, _Index, _Index]:
    """Start, end and number of each line that is not blank; blanks at the ends are left out."""
    breaks = np.flatnonzero(buffer == ord("\n"))
    starts = np.concatenate([[0], breaks + 1])
    ends = np.concatenate([breaks, [len(buffer)]])
    has_return = (ends > starts) & (buffer[np.maximum(ends - 1, 0)] == ord("\r")) if buffer.size else ends > starts
    ends = ends - has_return
    kept = np.flatnonzero(ends > starts)
    return starts[kept], ends[kept], kept


def _fields(buffer: _Bytes, starts: _Index, ends: _Index) -> _Fields:
    spaces = np.append(np.flatnonzero(buffer == ord(" ")), [len(buffer)] * 3)
    hashes = np.append(np.flatnonzero(buffer == ord("#")), [len(buffer)])
    first = np.searchsorted(spaces, starts)
    space, second_space = spaces[first], spaces[first + 1]
    payload_end = np.minimum(spaces[first + 2], ends)
    mark = hashes[np.searchsorted(hashes, starts)]
    known = (space < second_space) & (second_space < mark) & (mark < payload_end)
    known &= (buffer[starts] == ord("(")) & (_at(buffer, space - 1) == ord(")"))
    tail = ends - payload_end
    direction = _at(buffer, ends - 1) & ~np.uint8(0x20)
    known &= (tail == 0) | ((tail == 2) & ((direction == ord("R")) | (direction == ord("T"))))
    fd = _at(buffer, mark + 1) == ord("#")
    known &= ~fd | (_HEX[_at(buffer, mark + 2)] != _NOT_HEX)
    fields = _Fields(
        known=known,
        time=(starts + 1, space - 1),
        channel=(space + 1, second_space),
        identifier=(second_space + 1, mark),
        payload=(np.where(fd, mark + 3, mark + 1), payload_end),
        fd=fd,
    )
    for start, end in (fields.time, fields.channel, fields.identifier, fields.payload):
        known &= (start <= end) & (end - start < _LARGEST_SHAPE)
    return fields


def _at(buffer: _Bytes, position: _Index) -> _Bytes:
    """Characters at these positions, which may lie outside where a line is damaged."""
    return buffer[np.clip(position, 0, len(buffer) - 1)]


def _shapes(fields: _Fields, known: _Index) -> list[_Index]:
    """Groups of lines whose fields have the same lengths."""
    if not known.size:
        return []
    shape = fields.fd[known].astype(np.int64)
    for start, end in (fields.time, fields.channel, fields.identifier, fields.payload):
        shape = shape * _LARGEST_SHAPE + (end - start)[known]
    order = np.argsort(shape, kind="stable")
    return np.split(known[order], np.flatnonzero(np.diff(shape[order])) + 1)


def _matrix(buffer: _Bytes, field: tuple[_Index, _Index], lines: _Index) -> _Bytes:
    """Characters of one field of lines of one shape, shape (n, width)."""
    start = field[0][lines]
    width = int(field[1][lines[0]] - start[0])
    return sliding_window_view(buffer, width)[start] if width else np.zeros((len(lines), 0), np.uint8)


def _parse_shape(buffer: _Bytes, fields: _Fields, lines: _Index, damaged: NDArray[np.bool_]) -> tuple[Frames, _Index]:
    """Frames of lines of one shape and their lines; marks the lines that are none in `damaged`."""
    payload = _matrix(buffer, fields.payload, lines)
    fd = bool(fields.fd[lines[0]])
    remote = np.full(len(lines), fill_value=False)
    if not fd and payload.shape[1]:
        remote = (payload[:, 0] & ~np.uint8(0x20)) == ord("R")
    time_ns, time_ok = _times(_matrix(buffer, fields.time, lines))
    identifier, identifier_ok = _identifiers(_matrix(buffer, fields.identifier, lines))
    data, data_ok = _payloads(payload, FD_BYTES if fd else CLASSIC_BYTES)
    error = identifier_ok & (identifier & _ERROR_BIT > 0)
    sound = time_ok & identifier_ok & (data_ok | remote | error)
    damaged[lines[~sound]] = True
    kept = sound & ~remote & ~error
    channel, channels = _channels(_matrix(buffer, fields.channel, lines))
    extended = fields.identifier[1][lines[0]] - fields.identifier[0][lines[0]] == _EXTENDED_DIGITS
    frames = Frames(
        time_ns=time_ns[kept],
        key=(identifier[kept] & _IDENTIFIER_MASK | (EXTENDED_BIT if extended else 0)).astype(np.uint32),
        channel=channel[kept],
        length=np.full(int(kept.sum()), payload.shape[1] // 2 if data_ok.any() else 0, np.uint8),
        data=data[kept],
        channels=channels,
        error_frames=int((sound & error).sum()),
        remote_frames=int((sound & remote & ~error).sum()),
    )
    return frames, lines[kept]


def _decimal(digits: _Bytes) -> tuple[_Index, NDArray[np.bool_]]:
    values = digits - np.uint8(ord("0"))
    return _positional(values, 10), np.all(values <= 9, axis=1)  # what lies below "0" wraps


def _positional(digits: _Bytes, base: int) -> _Index:
    """Value of up to 10 digits; in float64, where that is exact, as it multiplies matrices faster."""
    powers = float(base) ** np.arange(digits.shape[1])[::-1]
    return np.asarray(digits.astype(np.float64) @ powers).astype(np.int64)


def _times(text: _Bytes) -> tuple[_Index, NDArray[np.bool_]]:
    """Time stamps such as 1740960798.000833 in nanoseconds."""
    for fraction in _FRACTION_DIGITS:
        whole = text.shape[1] - fraction - 1
        if whole in _SECOND_DIGITS and np.all(text[:, whole] == ord(".")):
            seconds, seconds_ok = _decimal(text[:, :whole])
            parts, parts_ok = _decimal(text[:, whole + 1 :])
            time_ns = seconds * 10**9 + parts * 10 ** (9 - fraction)
            return time_ns, seconds_ok & parts_ok & (seconds < 9 * 10**9)
    return np.zeros(len(text), np.int64), np.full(len(text), fill_value=False)


def _identifiers(text: _Bytes) -> tuple[_Index, NDArray[np.bool_]]:
    if text.shape[1] not in {_STANDARD_DIGITS, _EXTENDED_DIGITS}:
        return np.zeros(len(text), np.int64), np.full(len(text), fill_value=False)
    digits = _HEX[text]
    value = _positional(digits, 16)
    largest = 0x7FF if text.shape[1] == _STANDARD_DIGITS else _ERROR_BIT | _IDENTIFIER_MASK
    return value, np.all(digits != _NOT_HEX, axis=1) & (value <= largest)


def _payloads(text: _Bytes, width: int) -> tuple[_Bytes, NDArray[np.bool_]]:
    data = np.zeros((len(text), width), np.uint8)
    if text.shape[1] % 2 or text.shape[1] > 2 * width:
        return data, np.full(len(text), fill_value=False)
    digits = _HEX[text]
    data[:, : text.shape[1] // 2] = (digits[:, ::2] << 4) | (digits[:, 1::2] & 0xF)
    return data, np.all(digits != _NOT_HEX, axis=1)


def _channels(text: _Bytes) -> tuple[NDArray[np.uint32], tuple[str, ...]]:
    """Index of each line's channel, and the names."""
    if not text.shape[1]:
        return np.zeros(len(text), np.uint32), ("",)
    names, index = np.unique(np.ascontiguousarray(text).view(f"S{text.shape[1]}").ravel(), return_inverse=True)
    return index.astype(np.uint32), tuple(bytes(name).decode("latin-1") for name in names)
