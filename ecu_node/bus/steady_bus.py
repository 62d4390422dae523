"""A bus in use: a full one is tried again for a limited time, and one that was gone is opened again.

Any interface of python-can works frame by frame. On SocketCAN one call of recvmmsg(2) takes all frames that wait, and
one of sendmmsg(2) sends all that were made of them: system calls are what takes a node's time, and python-can makes
four to pass one frame on. Structures are those of linux/can.h and of socket.h.
"""

import contextlib
import ctypes
import errno
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence

import can
from can.util import dlc2len, len2dlc

from ecu_node.bus.adapters import error_text, is_interface, socketcan_socket
from ecu_node.core.status import Counters
from ecu_node.errors import BusError

_SEND_ATTEMPTS = 3
_SEND_PAUSE_S = 0.001
"""Pause between attempts to send; a full send queue drains by some frames in this time. [s]"""
_FULL_S = 1.0
"""A send queue that is full for longer than this is reported. [s]"""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.05, 2.0
"""Pauses between attempts to open a bus again; they double from the first to the longest. [s]"""
_BUS_OFF = 0x40
"""Class bit of SocketCAN error frames that report bus off (linux/can/error.h, CAN_ERR_BUSOFF)."""


_GONE = frozenset((errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EBADF))
"""Errors of sending after which only opening the bus again helps."""
_OF_FRAME = frozenset((errno.EINVAL, errno.EMSGSIZE))
"""Errors of sending a frame that the bus never takes, such as one that is too long for it."""
_ERRORS = (can.CanError, OSError, ValueError)
"""Exceptions of a bus in use; ValueError: the other thread has just closed it."""


def _number(error: Exception) -> int | None:
    """Return the errno of an error of a bus; None if it has none."""
    code = getattr(error, "error_code", None)
    return code if code is not None else getattr(error, "errno", None)


class SteadyBus:
    """A bus that survives an interface that is down, an adapter that is gone, bus off, and a full send queue.

    One thread may receive while another one sends; the one that receives opens the bus again.

    Parameters
    ----------
    open_bus : callable
        Opens the bus; raises :class:`BusError` if that fails.
    counters : Counters
        Counters to add to.
    say : callable
        Takes one line for the log.
    listen_only : bool
        Whether nothing is ever sent; frames that are given to be sent are then dropped.

    Raises
    ------
    BusError
        If it cannot be opened the first time.
    """

    def __init__(
        self,
        open_bus: Callable[[], can.BusABC],
        counters: Counters,
        say: Callable[[str], None] = lambda _: None,
        *,
        listen_only: bool = False,
    ) -> None:
        self._open, self._counters, self.say = open_bus, counters, say
        bus = open_bus()
        self.channel = bus.channel_info
        self._link: _Link | None = _link(bus)
        self._failed: tuple[_Link, Exception] | None = None
        self._retry_s, self._pause_s = 0.0, _FIRST_PAUSE_S
        self._queue: list[can.Message] = []
        self._full_since_s: float | None = None
        self._is_full_told = False
        self._closing = threading.Lock()
        self.send: Callable[[can.Message], None] = (lambda _: None) if listen_only else self._queue.append
        """Takes a frame to be sent at the next :meth:`flush`."""
        self.asked_s = self.read_s = time.monotonic()
        """When the bus was last asked for frames, and when it last had one, on the steady clock [s]. If it had none
        when asked, all frames that came before have been received."""

    @property
    def at_hand(self) -> bool:
        """Whether the next frame was already taken from the bus, so that the bus need not be asked for it."""
        link = self._link
        return link is not None and link.at_hand

    @property
    def state(self) -> str:
        """State of the bus: "open", "full" (for longer than a second), or "gone" (until it is open again)."""
        return "gone" if self._link is None else "full" if self._is_full_told else "open"

    def receive(self, timeout_s: float) -> can.Message | None:
        """Wait for a data or remote frame.

        Parameters
        ----------
        timeout_s : float
            How long to wait; 0: not at all, and if the last call left no frames the bus is not even asked. [s]

        Returns
        -------
        can.Message or None
            The frame, its time stamp in time of day [s], or 0 if not known; None if none came, or the bus is gone.
        """
        if self._failed is not None:
            failed, error = self._failed
            self._failed = None
            if failed is self._link:
                self._gone(error)
        link = self._link
        if link is None:
            return self._reopened(timeout_s)
        try:
            message = link.receive(timeout_s)
            while message is not None and message.is_error_frame:
                self._count_error(message)
                message = link.receive(0.0)
        except (can.CanError, OSError) as error:
            self._gone(error)
            return None
        self.asked_s, self.read_s = link.asked_s, link.read_s
        return message

    def flush(self) -> tuple[int, int]:
        """Send what was given to :attr:`send`, in order.

        Returns
        -------
        sent, not_sent : int
            Numbers of frames that the bus took, and did not take. If the send queue is full it is tried a few times; at
            later calls, while it stays full, once each.
        """
        queue, first, lost = self._queue, 0, 0
        attempts_left = _SEND_ATTEMPTS if self._full_since_s is None else 1
        while first < len(queue) and (link := self._link) is not None:
            try:
                with self._closing:
                    first += link.send(queue, first)
            except _ERRORS as error:
                if _number(error) in _OF_FRAME:
                    first, lost = first + 1, lost + 1
                    continue
                if _number(error) in _GONE:
                    # The kernel reports this once only, so receiving might not fail: note it for receive.
                    self._failed = link, error
                    break
                attempts_left -= 1
                if not attempts_left:
                    self._stays_full(error)
                    break
                time.sleep(_SEND_PAUSE_S)
            else:
                attempts_left = _SEND_ATTEMPTS
                if self._is_full_told:
                    self.say(f"{self.channel}: the bus takes frames again")
                self._full_since_s, self._is_full_told = None, False
        lost += len(queue) - first  # a bus that is full or gone is so for all that follow
        sent = len(queue) - lost
        queue.clear()
        return sent, lost

    def _stays_full(self, error: Exception) -> None:
        """Note that the send queue is full, and log it once if it stays so."""
        now_s = time.monotonic()
        if self._full_since_s is None:
            self._full_since_s = now_s
        elif not self._is_full_told and now_s - self._full_since_s > _FULL_S:
            self._is_full_told = True
            why = f"({error_text(error)}); is anybody else on this bus?"
            self.say(f"{self.channel}: the send queue stays full, frames are lost {why}")

    def count_dropped(self) -> None:
        """Count the frames that the kernel dropped since the last call, as they were not read in time."""
        link = self._link
        if link is not None:
            self._counters.dropped += link.newly_dropped()

    def close(self) -> None:
        """Close the bus."""
        link, self._link = self._link, None
        if link is not None:
            with self._closing:  # else the other thread might send to a file that reuses the socket's number
                link.close()

    def _count_error(self, message: can.Message) -> None:
        self._counters.bus_errors += 1
        self._counters.bus_off += bool(message.arbitration_id & _BUS_OFF)

    def _gone(self, error: Exception) -> None:
        """Log an error, close the bus, and plan to open it again."""
        self.say(f"{self.channel}: the bus failed: {error_text(error)}; trying to open it again")
        self._retry_s, self._pause_s = time.monotonic() + _FIRST_PAUSE_S, _FIRST_PAUSE_S
        with contextlib.suppress(can.CanError, OSError):
            self.close()

    def _reopened(self, timeout_s: float) -> can.Message | None:
        """Open the bus again if that is due, and receive; wait no longer than the timeout."""
        now_s = self.asked_s = time.monotonic()
        if now_s < self._retry_s:
            time.sleep(min(timeout_s, self._retry_s - now_s))
            self.asked_s = time.monotonic()
            return None
        self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
        self._retry_s = now_s + self._pause_s
        link = None
        try:
            link = _link(self._open())
            message = link.receive(0.0)  # an interface that is down can be opened, but not received from
        except (BusError, can.CanError, OSError):
            if link is not None:
                with contextlib.suppress(can.CanError, OSError):
                    link.close()
            return None
        self._link = link
        self._counters.reopened += 1
        self.say(f"{self.channel}: the bus is open again")
        if message is not None and message.is_error_frame:
            self._count_error(message)
            return None
        return message


class _FrameByFrame:
    """A bus of any interface, used frame by frame; has the attributes and methods of :class:`SocketCanLink`."""

    at_hand = False

    def __init__(self, bus: can.BusABC) -> None:
        self._bus, self.close = bus, bus.shutdown
        self.asked_s = self.read_s = time.monotonic()
        # Time stamps of other interfaces come from the adapter's own clock, and are useless here.
        self._has_time_of_day = any(is_interface(bus, name) for name in ("socketcan", "udp_multicast", "virtual"))

    def receive(self, timeout_s: float) -> can.Message | None:
        asked_s = time.monotonic()
        try:
            message = self._bus.recv(timeout_s)
        except (ValueError, TypeError, struct.error) as error:  # python-can's serial driver, on a disturbed line
            raise can.CanOperationError(f"the adapter sends what is no frame: {error}") from None
        now_s = time.monotonic()
        self.asked_s = min(now_s, asked_s + timeout_s)  # in a pause after the timeout nothing is heard
        if message is not None:
            self.read_s = now_s
            if not self._has_time_of_day:
                message.timestamp = 0.0
        return message

    def send(self, messages: Sequence[can.Message], first: int) -> int:
        self._bus.send(messages[first])
        return 1

    def newly_dropped(self) -> int:
        return 0


MOST_AT_ONCE = 16
"""Most frames per system call, and so the most that one frame waits for: a fraction of a millisecond."""
_CLASSIC_BYTES, _FD_BYTES = 16, 72
"""Sizes of struct can_frame and struct canfd_frame, which tell classic frames from those of CAN FD."""
_FRAME = struct.Struct("=IBBxB64s")
"""Identifier with flags, length, flags of CAN FD, DLC if above 8, data; the first 16 bytes are a classic frame."""
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_BITRATE_SWITCH, _ERROR_STATE, _FD = 0x01, 0x02, 0x04
_LONGEST_CLASSIC, _LARGEST_DLC = 8, 15
_FD_LENGTHS = [dlc2len(len2dlc(length)) for length in range(65)]
"""Length of the CAN FD frame that holds a number of bytes, by that number."""
_STAMP = struct.Struct("@Niill")
"""Control message with a time stamp: length, level, type, seconds, nanoseconds."""
_SO_TIMESTAMPNS, _SO_MEMINFO, _DROPS = 35, 55, 8
"""Socket options, and where SO_MEMINFO has the dropped frames (asm-generic/socket.h, linux/sock_diag.h)."""
_VECTOR = struct.Struct("@PN")
"""struct iovec: address and length of a frame."""
_HEADER = struct.Struct("@PIPNPNi0PI0P")
"""struct mmsghdr: peer address (none) and its length; address and number (1) of vectors; address and length of the
control message; flags; bytes received."""
_CAME, _CAME_AT = struct.Struct("@Ni0PI"), struct.calcsize("@PIPNP")
"""The part of struct mmsghdr that the kernel fills in (control length, flags, bytes received), and where it starts."""

_libc = ctypes.PyDLL(None, use_errno=True)  # keeps the GIL: the calls never wait, releasing it would cost more


class _Batch:
    """Memory for frames and their control messages, with the headers that tell the kernel where they are."""

    def __init__(self, control_bytes: int) -> None:
        sizes = _FD_BYTES, _STAMP.size, _VECTOR.size, _HEADER.size
        parts = [(ctypes.c_char * (MOST_AT_ONCE * size))() for size in sizes]
        self.frames, self.control, self._vectors, self.headers = (memoryview(part).cast("B") for part in parts)
        self._frames_at, control_at, vectors_at, headers_at = map(ctypes.addressof, parts)
        self.headers_at = ctypes.c_void_p(headers_at)
        for number in range(MOST_AT_ONCE):
            self.set_length(number, _FD_BYTES)
            vector_at, stamp_at = vectors_at + number * _VECTOR.size, control_at + number * _STAMP.size
            place = number * _HEADER.size
            _HEADER.pack_into(self.headers, place, 0, 0, vector_at, 1, stamp_at, control_bytes, 0, 0)
        self._fresh = bytes(self.headers)

    def set_length(self, number: int, length: int) -> None:
        """Set how many bytes of a frame the kernel takes or puts."""
        _VECTOR.pack_into(self._vectors, number * _VECTOR.size, self._frames_at + number * _FD_BYTES, length)

    def reset(self, used: int) -> None:
        """Undo what the kernel wrote into the first `used` headers."""
        self.headers[: used * _HEADER.size] = self._fresh[: used * _HEADER.size]


class SocketCanLink:
    """A socket of SocketCAN, used many frames at a time.

    Parameters
    ----------
    opened : socket.socket
        Raw CAN socket, opened by python-can.
    close : callable, optional
        Closes the bus that the socket belongs to; if not given, the socket is closed.

    Attributes
    ----------
    at_hand : bool
        Whether the next frame was already taken from the bus, so that the bus need not be asked for it.
    asked_s, read_s : float
        When the bus was asked last, and when it had frames last, on the steady clock. [s]
    """

    def __init__(self, opened: socket.socket, close: Callable[[], None] | None = None) -> None:
        self._socket, self.close = opened, close or opened.close
        opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._waiting = select.poll()
        self._waiting.register(opened, select.POLLIN)
        self._in, self._out = _Batch(_STAMP.size), _Batch(0)
        self._next = self._came = self._dropped = 0
        self._had_no_more = self.at_hand = False
        self.asked_s = self.read_s = time.monotonic()

    def receive(self, timeout_s: float) -> can.Message | None:
        """Wait for a frame of any kind, see :meth:`SteadyBus.receive`; raise OSError if the bus is gone or down."""
        if not self.at_hand and not self._fill(timeout_s):
            return None
        number = self._next
        self._next = number + 1
        self.at_hand = self._next < self._came
        return self._message(number)

    def _fill(self, timeout_s: float) -> bool:
        """Take the frames that wait, at most :data:`MOST_AT_ONCE`; return whether there were any."""
        if timeout_s > 0.0:
            waiting_s = time.monotonic()
            is_asked = bool(self._waiting.poll(1e3 * timeout_s))
            self.asked_s = min(time.monotonic(), waiting_s + timeout_s)  # in a pause after the timeout nothing is heard
        else:
            is_asked, self._had_no_more = not self._had_no_more, False
            if is_asked:
                self.asked_s = time.monotonic()
        if not is_asked:
            return False
        self._in.reset(self._came)
        self._next = self._came = 0
        came = _libc.recvmmsg(self._socket.fileno(), self._in.headers_at, MOST_AT_ONCE, socket.MSG_DONTWAIT, None)
        if came < 0:
            error = _last_error()
            if isinstance(error, BlockingIOError):
                return False
            raise error
        self.read_s = time.monotonic()
        self._came, self._had_no_more = came, came < MOST_AT_ONCE
        return True

    def _message(self, number: int) -> can.Message:
        """Return the frame of this number in the batch that was received."""
        batch = self._in
        word, length, flags, dlc, data = _FRAME.unpack_from(batch.frames, number * _FD_BYTES)
        control_bytes, _, came_bytes = _CAME.unpack_from(batch.headers, number * _HEADER.size + _CAME_AT)
        stamp_s = 0.0
        if control_bytes:  # time stamps, as no other kind was asked for
            _, _, _, seconds, nanoseconds = _STAMP.unpack_from(batch.control, number * _STAMP.size)
            stamp_s = seconds + 1e-9 * nanoseconds
        is_fd = came_bytes == _FD_BYTES
        extended = bool(word & _EXTENDED)
        return can.Message(
            stamp_s,
            word & (0x1FFFFFFF if extended else 0x7FF),
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
            Number of frames that were taken, at least 1.

        Raises
        ------
        OSError
            If the first one was not taken.
        """
        batch = self._out
        some = messages[first : first + MOST_AT_ONCE]
        for number, message in enumerate(some):
            batch.set_length(number, _put(batch.frames, number * _FD_BYTES, message))
        sent: int = _libc.sendmmsg(self._socket.fileno(), batch.headers_at, len(some), socket.MSG_DONTWAIT)
        if sent < 0:
            raise _last_error()
        return sent

    def newly_dropped(self) -> int:
        """Return the number of frames that the kernel dropped since the last call; 0 if that is not known."""
        try:
            info = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_DROPS + 1))
            (dropped,) = struct.unpack_from("=I", info, 4 * _DROPS)
        except (OSError, struct.error):  # closed meanwhile, or a kernel before 4.12
            return 0
        before, self._dropped = self._dropped, int(dropped)
        return max(self._dropped - before, 0)


def _put(frames: memoryview, at: int, message: can.Message) -> int:
    """Write a frame into memory; return its size in bytes."""
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


def _last_error() -> OSError:
    number = ctypes.get_errno()
    return OSError(number, os.strerror(number))


_Link = SocketCanLink | _FrameByFrame


def _link(bus: can.BusABC) -> _Link:
    """Return how to use a bus: many frames at a time on SocketCAN, else frame by frame."""
    opened = socketcan_socket(bus)
    return _FrameByFrame(bus) if opened is None else SocketCanLink(opened, bus.shutdown)
