"""Opening a bus of python-can, and how its frames get to the node and back.

Any interface works frame by frame. On SocketCAN one system call, recvmmsg(2) and sendmmsg(2), takes all frames that
wait and sends all that were made of them: a system call per frame, and python-can makes four to pass one on, is what a
node's time goes to. Structures are those of linux/can.h and of socket.h, as laid out by the machine's C compiler.
"""

import ctypes
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import can
from can.util import CAN_FD_DLC

from ecu_node.bus.adapters import bus_config
from ecu_node.bus.guard import Mode, needs_fd, received, transmitted
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError

__all__ = [
    "MOST_AT_ONCE",
    "Link",
    "OneByOne",
    "SocketCanLink",
    "carries_fd",
    "connect",
    "data_frame",
    "error_text",
    "is_of_frame",
    "means_gone",
    "open_bus",
    "receive_filters",
    "require_fd",
    "socketcan_socket",
]


_GONE = {errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EBADF}
"""Errors of sending after which only opening the bus again helps."""


def means_gone(error: Exception) -> bool:
    """Whether after an error of sending only opening the bus again helps."""
    return _number(error) in _GONE


def is_of_frame(error: Exception) -> bool:
    """Whether it is this frame that the bus does not take, whatever its state, as one that is too long for it."""
    return _number(error) in {errno.EINVAL, errno.EMSGSIZE}


def error_text(error: Exception) -> str:
    """What went wrong, in one line; where it is known, what to do."""
    if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
        return "this kernel has no SocketCAN (modules can, can_raw and, for virtual buses, vcan)"
    if isinstance(error, OSError) and error.errno == errno.ENODEV:
        return "no such interface (see 'ip link')"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _number(error: Exception) -> int | None:
    code = getattr(error, "error_code", None)
    return code if code is not None else getattr(error, "errno", None)


_SYSTEM_CLOCK = ("socketcan", "udp_multicast", "virtual")
"""Interfaces whose time stamps are of this computer's time of day; an adapter's own clock tells nothing here."""


class Link(Protocol):
    """One way to use a bus."""

    at_hand: bool
    """Whether the next frame is here already, and :meth:`receive` need not ask the bus for it."""
    asked_s: float
    """When the bus was asked last, on the steady clock; if it had no more, all that came before was received. [s]"""
    read_s: float
    """When the last frame was read: it came before that. [s]"""

    def receive(self, timeout_s: float) -> can.Message | None:
        """Wait for a frame of any kind; None if none came in time.

        Parameters
        ----------
        timeout_s : float
            How long to wait; 0: not at all, and the bus need not be asked if it had no more the last time. [s]

        Returns
        -------
        can.Message or None
            Its time stamp is of the time of day, or 0 where that is not known. [s]

        Raises
        ------
        OSError
            If the bus is gone or down; python-can may raise its ``CanError`` instead.
        """

    def send(self, messages: Sequence[can.Message], first: int) -> int:
        """Send as many frames as the bus takes now.

        Parameters
        ----------
        messages : sequence of can.Message
            Frames in the order in which they are to be sent.
        first : int
            The first one of them that is still to be sent.

        Returns
        -------
        int
            How many were taken, at least 1.

        Raises
        ------
        OSError, ValueError
            If the first one was not taken; python-can may raise its ``CanError`` instead.
        """


def _is_of(bus: can.BusABC, interface: str) -> bool:
    """Whether a bus is one of python-can's interface of this name."""
    return any(kind.__module__.split(".")[:3] == ["can", "interfaces", interface] for kind in type(bus).__mro__)


def socketcan_socket(bus: can.BusABC) -> socket.socket | None:
    """Socket of a bus of SocketCAN; None for other interfaces."""
    found = getattr(bus, "socket", None) if _is_of(bus, "socketcan") else None
    return found if isinstance(found, socket.socket) else None


class OneByOne:
    """A bus of any interface.

    Parameters
    ----------
    bus : can.BusABC
        An open bus.
    """

    at_hand = False

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self.asked_s = self.read_s = time.monotonic()
        self._has_stamps = any(_is_of(bus, name) for name in _SYSTEM_CLOCK)

    def receive(self, timeout_s: float) -> can.Message | None:
        """Wait for a frame; see :meth:`Link.receive`."""
        if timeout_s > 0.0:
            message = self._bus.recv(timeout_s)
            self.asked_s = time.monotonic()
        else:
            self.asked_s = time.monotonic()
            message = self._bus.recv(0.0)
        if message is not None:
            self.read_s = time.monotonic()
            if not self._has_stamps:
                message.timestamp = 0.0
        return message

    def send(self, messages: Sequence[can.Message], first: int) -> int:
        """Send one frame; see :meth:`Link.send`."""
        self._bus.send(messages[first])
        return 1


def data_frame(
    key: tuple[int, bool], data: bytes | bytearray, *, fd: bool, bitrate_switch: bool = False
) -> can.Message:
    """Make a frame to be sent.

    Parameters
    ----------
    key : tuple of int and bool
        Its identifier, and whether that has 29 bits.
    data : bytes or bytearray
        Its payload.
    fd, bitrate_switch : bool
        Whether it is one of CAN FD, and if so one with the fast bit rate.
    """
    identifier, extended = key
    return can.Message(
        arbitration_id=identifier,
        is_extended_id=extended,
        is_fd=fd,
        bitrate_switch=bitrate_switch,
        data=data,
        is_rx=False,
    )


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
    """A bus of SocketCAN; see :class:`ecu_node.bus.links.Link`.

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


_STANDARD_MASK = 0x7FF
_EXTENDED_MASK = 0x1FFFFFFF
_RECEIVE_BUFFER_BYTES = 1 << 20
"""Asked of the kernel, which gives what it allows: frames of the time in which the node does something else."""
_INTERFACES = Path("/sys/class/net")


def receive_filters(database: VehicleDatabase, mode: Mode, *, own: bool = True) -> list[can.typechecking.CanFilter]:
    """Filters for the kernel to apply: what the node needs of the vehicle, and its own messages as sent by others."""
    sent = transmitted(database, mode) if own else {}
    return [
        {
            "can_id": key.identifier,
            "can_mask": _EXTENDED_MASK if key.extended else _STANDARD_MASK,
            "extended": key.extended,
        }
        for key in (*received(database), *sent)
    ]


def open_bus(
    database: VehicleDatabase,
    *,
    interface: str,
    channel: str,
    fd: bool,
    mode: Mode,
    routed: bool = False,
    own: bool = True,
    listen_only: bool = False,
    bitrates: Mapping[str, int | None] = {},
) -> can.BusABC:
    """Open a bus for the node.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    mode : Mode
        An overlay node receives what it needs, a gateway everything.
    routed : bool
        Whether the kernel carries what a gateway does not need.
    own : bool
        Whether an overlay node also receives what only one node may send, as sent by others.
    interface, channel, fd, listen_only, bitrates :
        As for :func:`ecu_node.bus.adapters.bus_config`.

    Returns
    -------
    can.BusABC
        The bus; it does not receive what it sends.

    Raises
    ------
    BusError
        If there is no such bus, or the DBC needs CAN FD and ``fd`` is not given.
    """
    require_fd(database, mode, fd=fd)
    filters = receive_filters(database, mode, own=own) if mode is Mode.OVERLAY or routed else None
    return connect(interface, channel, fd=fd, filters=filters, listen_only=listen_only, bitrates=bitrates)


def require_fd(database: VehicleDatabase, mode: Mode, *, fd: bool) -> None:
    """Raise BusError if the DBC needs CAN FD and ``fd`` is not given."""
    if not fd and (names := needs_fd(database, mode)):
        raise BusError(f"{database.layout.dbc_path}: CAN FD messages ({', '.join(names)}); start with --fd")


def connect(
    interface: str,
    channel: str | None,
    *,
    fd: bool = False,
    filters: list[can.typechecking.CanFilter] | None = None,
    listen_only: bool = False,
    bitrates: Mapping[str, int | None] = {},
) -> can.BusABC:
    """Open any bus of python-can.

    Parameters
    ----------
    filters : list of CanFilter, optional
        What to receive; everything if not given.
    interface, channel, fd, listen_only, bitrates :
        As for :func:`ecu_node.bus.adapters.bus_config`.

    Returns
    -------
    can.BusABC
        The bus; it does not receive what it sends.

    Raises
    ------
    BusError
        If it cannot be opened; the message says why.
    """
    config = bus_config(interface, channel, fd=fd, listen_only=listen_only, bitrates=bitrates)
    config |= {"can_filters": filters, "receive_own_messages": False}
    try:
        bus = can.Bus(**config, ignore_config=True)
    except (can.CanError, OSError, ValueError, TypeError, KeyError, NotImplementedError) as error:
        raise BusError(f"{interface} {channel}: cannot open the bus: {error_text(error)}") from None
    if bus.channel_info == can.BusABC.channel_info:
        bus.channel_info = f"{interface} {channel}"  # what an interface does not tell of itself
    opened = socketcan_socket(bus)
    if opened is not None:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    return bus


def carries_fd(interface: str, channel: str) -> bool:
    """Whether an interface of SocketCAN is set up for CAN FD; False where that is not known."""
    if interface != "socketcan":
        return False
    try:
        return int((_INTERFACES / channel / "mtu").read_text()) >= _FD_BYTES
    except (OSError, ValueError):
        return False
