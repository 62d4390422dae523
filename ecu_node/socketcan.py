"""Frames of a SocketCAN bus, many with one system call: recvmmsg(2) and sendmmsg(2).

A system call per frame, and python-can makes four to pass one on, is what a node's time goes to. Here one call takes
all frames that wait, and one sends all that were made of them. The bus itself is python-can's: it opens and sets up
the socket. Structures are those of linux/can.h and of socket.h, as laid out by the machine's C compiler.
"""

import ctypes
import os
import select
import socket
import struct
import time
from collections.abc import Sequence

import can
from can.util import CAN_FD_DLC

__all__ = ["MOST_AT_ONCE", "SocketCanLink"]

MOST_AT_ONCE = 16
"""Frames per system call, and so the most that a frame waits for others: they take a fraction of a millisecond."""
_CLASSIC_BYTES, _FD_BYTES = 16, 72
"""Of struct can_frame and struct canfd_frame."""
_FRAME = struct.Struct("=IBBxB64s")
"""Identifier with flags, length, flags of CAN FD, DLC if above 8, data; the first 16 bytes are a classic frame."""
_HEADER_BYTES = 8
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_IDENTIFIER_29, _IDENTIFIER_11 = 0x1FFFFFFF, 0x7FF
_BITRATE_SWITCH, _ERROR_STATE, _FD = 0x01, 0x02, 0x04
_LONGEST_CLASSIC, _LARGEST_DLC = 8, 15
_FD_LENGTHS = tuple(min(length for length in CAN_FD_DLC if length >= wanted) for wanted in range(CAN_FD_DLC[-1] + 1))
"""The length that CAN FD has for each number of bytes."""
_STAMP = struct.Struct("@Niill")
"""Control message with a time stamp: its length, level and type, seconds, nanoseconds."""
_SO_TIMESTAMPNS = 35
"""Socket option, and type of the control message (asm-generic/socket.h)."""
_CONTROL_BYTES = 64


class _Vector(ctypes.Structure):
    """struct iovec."""

    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """struct msghdr."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vector", ctypes.POINTER(_Vector)),
        ("vectors", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _CountedHeader(ctypes.Structure):
    """struct mmsghdr: a header, and the bytes that came."""

    _fields_ = (("header", _Header), ("length", ctypes.c_uint))


_LENGTH = struct.Struct("@I")
_COUNTED_BYTES, _LENGTH_AT = ctypes.sizeof(_CountedHeader), _CountedHeader.length.offset

_libc = ctypes.PyDLL(None, use_errno=True)  # calls that never wait: handing over Python's lock would cost more


class _Batch:
    """Room for frames, and the headers that tell the kernel where."""

    def __init__(self, control_bytes: int) -> None:
        self._control_bytes = control_bytes
        self._frames = (ctypes.c_char * (MOST_AT_ONCE * _FD_BYTES))()
        self._control = (ctypes.c_char * (MOST_AT_ONCE * max(control_bytes, 1)))()
        self.vectors = (_Vector * MOST_AT_ONCE)()
        self.headers = (_CountedHeader * MOST_AT_ONCE)()
        for number, (vector, counted) in enumerate(zip(self.vectors, self.headers, strict=True)):
            vector.base = ctypes.addressof(self._frames) + number * _FD_BYTES
            vector.length = _FD_BYTES
            counted.header.vector, counted.header.vectors = ctypes.pointer(vector), 1
            if control_bytes:
                counted.header.control = ctypes.addressof(self._control) + number * control_bytes
                counted.header.control_length = control_bytes
        self.frames = memoryview(self._frames).cast("B")
        self.control = memoryview(self._control).cast("B")
        self.lengths = memoryview(self.headers).cast("B")
        self._fresh = bytes(self.headers)

    def reset(self, used: int) -> None:
        """Undo what the kernel wrote into the headers, and forget its time stamps."""
        ctypes.memmove(self.headers, self._fresh, used * _COUNTED_BYTES)
        ctypes.memset(self._control, 0, used * self._control_bytes)


class SocketCanLink:
    """A bus of SocketCAN; see :class:`ecu_node.links.Link`.

    Parameters
    ----------
    opened : socket.socket
        Raw CAN socket, as python-can has opened it.
    """

    def __init__(self, opened: socket.socket) -> None:
        self._socket = opened
        opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._waiting = select.poll()
        self._waiting.register(opened, select.POLLIN)
        self._in, self._out = _Batch(_CONTROL_BYTES), _Batch(0)
        self._next = self._came = 0
        self._had_no_more = False
        self.at_hand = False
        self.asked_s = self.read_s = time.monotonic()

    def receive(self, timeout_s: float) -> can.Message | None:
        """Wait for a frame of any kind; None if none came in time, or there were no more when last asked."""
        if not self.at_hand and not self._fill(timeout_s):
            return None
        number = self._next
        self._next = number + 1
        self.at_hand = self._next < self._came
        return self._message(number)

    def _fill(self, timeout_s: float) -> bool:
        """Take all frames that wait."""
        if timeout_s > 0.0:
            came = bool(self._waiting.poll(1e3 * timeout_s))
        else:
            came, self._had_no_more = not self._had_no_more, False
            if not came:
                return False
        self.asked_s = time.monotonic()
        if not came:
            return False
        batch = self._in
        batch.reset(self._came)
        self._next = self._came = 0
        came = _libc.recvmmsg(self._socket.fileno(), batch.headers, MOST_AT_ONCE, socket.MSG_DONTWAIT, None)
        if came < 0:
            _raise_unless_empty()
            return False
        self.read_s = time.monotonic()
        self._came, self._had_no_more = came, came < MOST_AT_ONCE
        return True

    def _message(self, number: int) -> can.Message:
        batch = self._in
        word, length, flags, dlc, data = _FRAME.unpack_from(batch.frames, number * _FD_BYTES)
        _, level, kind, seconds, nanoseconds = _STAMP.unpack_from(batch.control, number * _CONTROL_BYTES)
        is_fd = _LENGTH.unpack_from(batch.lengths, number * _COUNTED_BYTES + _LENGTH_AT)[0] == _FD_BYTES
        is_stamped = kind == _SO_TIMESTAMPNS and level == socket.SOL_SOCKET
        extended = bool(word & _EXTENDED)
        return can.Message(
            seconds + 1e-9 * nanoseconds if is_stamped else 0.0,
            word & (_IDENTIFIER_29 if extended else _IDENTIFIER_11),
            extended,
            bool(word & _REMOTE),
            bool(word & _ERROR),
            None,
            length if is_fd or length < _LONGEST_CLASSIC or dlc <= _LONGEST_CLASSIC else dlc,
            bytearray(data[:length]),
            is_fd,
            True,
            bool(is_fd and flags & _BITRATE_SWITCH),
            bool(is_fd and flags & _ERROR_STATE),
        )

    def send(self, messages: Sequence[can.Message], first: int) -> int:
        """Send as many frames as the bus takes now, one at least."""
        batch = self._out
        some = messages[first : first + MOST_AT_ONCE]
        for number, message in enumerate(some):
            batch.vectors[number].length = _put(batch.frames, number * _FD_BYTES, message)
        sent: int = _libc.sendmmsg(self._socket.fileno(), batch.headers, len(some), socket.MSG_DONTWAIT)
        if sent < 0:
            raise _error()
        return sent


def _put(frames: memoryview, at: int, message: can.Message) -> int:
    """Write a frame; the bytes that it takes."""
    word = message.arbitration_id
    if message.is_extended_id:
        word |= _EXTENDED
    if message.is_remote_frame:
        word |= _REMOTE
    length = message.dlc
    if message.is_fd:
        flags = _FD | message.bitrate_switch * _BITRATE_SWITCH | message.error_state_indicator * _ERROR_STATE
        _FRAME.pack_into(frames, at, word, _FD_LENGTHS[length], flags, 0, message.data)
        return _FD_BYTES
    long_dlc = length if _LONGEST_CLASSIC < length <= _LARGEST_DLC else 0
    _FRAME.pack_into(frames, at, word, min(length, _LONGEST_CLASSIC), 0, long_dlc, message.data)
    return _CLASSIC_BYTES


def _raise_unless_empty() -> None:
    error = _error()
    if not isinstance(error, BlockingIOError):
        raise error


def _error() -> OSError:
    number = ctypes.get_errno()
    return OSError(number, os.strerror(number))
