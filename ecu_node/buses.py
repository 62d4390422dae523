"""Opening a bus, sending on it with bounded patience, and opening it again after it was gone.

Whatever python-can's interfaces raise becomes :class:`~ecu_node.errors.BusError` or is counted here.
"""

import contextlib
import errno
import socket
import struct
import time
from collections.abc import Callable
from typing import Any

import can

from ecu_node.counters import Counters
from ecu_node.errors import BusError

__all__ = ["SteadyBus", "TimeOfDay", "connect", "steady_time_s"]

_SEND_ATTEMPTS = 3
_SEND_PAUSE_S = 0.001
"""A full send queue drains by some frames in this time. [s]"""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.05, 2.0
"""Between attempts to open a bus again. [s]"""
_OLDEST_FRAME_S = 10.0
"""No frame waits for longer: an older time stamp is one of another clock. [s]"""
_LARGEST_JITTER_S = 0.05
"""By more than this the time of day changes against the steady clock only if it is set. [s]"""
_GONE = {errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EBADF}
"""Errors of sending after which only opening the bus again helps."""
_RECEIVE_BUFFER_BYTES = 1 << 20
"""Asked of the kernel, which gives what it allows: frames of the time in which the node does something else."""
_SO_MEMINFO, _DROPS = 55, 8
"""Socket option, and the place of the dropped frames in it (asm-generic/socket.h, linux/sock_diag.h)."""
_BUS_OFF = 0x40
"""Class of error frames of SocketCAN (linux/can/error.h, CAN_ERR_BUSOFF)."""


def connect(
    interface: str, channel: str, *, fd: bool = False, filters: list[can.typechecking.CanFilter] | None = None
) -> can.BusABC:
    """Open any bus of python-can.

    Parameters
    ----------
    interface, channel : str
        As python-can names them.
    fd : bool
        Whether to use CAN FD.
    filters : list of CanFilter, optional
        What to receive; everything if not given.

    Returns
    -------
    can.BusABC
        The bus; it does not receive what it sends.

    Raises
    ------
    BusError
        If it cannot be opened; the message says why.
    """
    options: dict[str, Any] = {"fd": True} if fd else {}
    try:
        bus = can.Bus(
            channel=channel,
            interface=interface,
            ignore_config=True,
            can_filters=filters,
            receive_own_messages=False,
            **options,
        )
    except (can.CanError, OSError, ValueError, TypeError, NotImplementedError) as error:
        raise BusError(f"{interface} {channel}: cannot open the bus: {_why(error)}") from None
    queue = _queue(bus)
    if queue is not None:
        queue.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    return bus


class SteadyBus:
    """A bus that survives what buses do: going down, away, off, or being full.

    One thread may receive while another one sends; the one that receives opens the bus again.

    Parameters
    ----------
    open_bus : callable
        Opens it, raising :class:`BusError` if it cannot.
    counters : Counters
        Where it is counted what happened.
    say : callable
        Takes one line for the log.

    Raises
    ------
    BusError
        If it cannot be opened the first time.
    """

    def __init__(
        self, open_bus: Callable[[], can.BusABC], counters: Counters, say: Callable[[str], None] = lambda _: None
    ) -> None:
        self._open, self._counters, self._say = open_bus, counters, say
        self._bus: can.BusABC | None = open_bus()
        self._failed: tuple[can.BusABC, Exception] | None = None
        self._retry_s, self._pause_s = 0.0, _FIRST_PAUSE_S
        self._dropped, self._is_full = 0, False
        self.channel = self._bus.channel_info

    def receive(self, timeout_s: float) -> can.Message | None:
        """Wait for a data or remote frame; None if none came in time, or the bus is gone."""
        if self._failed is not None:
            failed, error = self._failed
            self._failed = None
            if failed is self._bus:
                self._gone(error)
        bus = self._bus
        if bus is None:
            return self._reopened(timeout_s)
        try:
            message = bus.recv(timeout_s)
            while message is not None and message.is_error_frame:
                self._count_error(message)
                message = bus.recv(0.0)
        except (can.CanError, OSError) as error:
            self._gone(error)
            return None
        return message

    def send(self, message: can.Message) -> bool:
        """Send one frame; False if the bus did not take it in a few attempts, or in one while it is full."""
        for attempt in range(1 if self._is_full else _SEND_ATTEMPTS):
            bus = self._bus
            if bus is None:
                return False
            if attempt:
                time.sleep(_SEND_PAUSE_S)
            try:
                bus.send(message)
            except (can.CanError, OSError, ValueError) as error:  # ValueError: closed by the other thread just now
                if _number(error) in _GONE:
                    # Whoever asks first is told that the bus is gone, and nobody after: receiving need not fail, too.
                    self._failed = bus, error
                    return False
                continue
            self._is_full = False
            return True
        self._is_full = True
        return False

    def count_dropped(self) -> None:
        """Count the frames that the kernel dropped since the last time, because they were not read in time."""
        bus = self._bus
        if bus is not None:
            dropped = _dropped(bus)
            self._counters.dropped += max(dropped - self._dropped, 0)
            self._dropped = dropped

    def close(self) -> None:
        """Close it."""
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def _count_error(self, message: can.Message) -> None:
        self._counters.bus_errors += 1
        self._counters.bus_off += bool(message.arbitration_id & _BUS_OFF)

    def _gone(self, error: Exception) -> None:
        self._say(f"{self.channel}: the bus failed: {_why(error)}; trying to open it again")
        self._retry_s, self._pause_s = time.monotonic() + _FIRST_PAUSE_S, _FIRST_PAUSE_S
        try:
            self.close()
        except (can.CanError, OSError):
            self._bus = None

    def _reopened(self, timeout_s: float) -> can.Message | None:
        """Open it again if it is time to, and receive; wait no longer than the timeout."""
        now_s = time.monotonic()
        if now_s < self._retry_s:
            time.sleep(min(timeout_s, self._retry_s - now_s))
            return None
        self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
        self._retry_s = now_s + self._pause_s
        try:
            bus = self._open()
        except BusError:
            return None
        try:
            message = bus.recv(0.0)  # an interface that is down can be opened, but not received from
        except (can.CanError, OSError):
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()
            return None
        self._bus, self._dropped = bus, 0
        self._counters.reopened += 1
        self._say(f"{self.channel}: the bus is open again")
        if message is not None and message.is_error_frame:
            self._count_error(message)
            return None
        return message


def steady_time_s(stamp_s: float, now_s: float, clock_ahead_s: float) -> float:
    """When a frame came, on the steady clock.

    Parameters
    ----------
    stamp_s : float
        Its time stamp by the kernel or the adapter; 0 if there is none. [s]
    now_s : float
        The steady clock now. [s]
    clock_ahead_s : float
        By how much the time of day is ahead of the steady clock; infinity if it was set a short while ago. [s]

    Returns
    -------
    float
        The stamp on the steady clock; now if that would be in the future or very long ago, or the clock was set.
    """
    time_s = stamp_s - clock_ahead_s
    return time_s if now_s - _OLDEST_FRAME_S <= time_s <= now_s else now_s


class TimeOfDay:
    """By how much the time of day is ahead of the steady clock, and whether it was set.

    Parameters
    ----------
    counters : Counters
        Where it is counted how often it was set.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._ahead_s = time.time() - time.monotonic()
        self._set_s = float("-inf")

    def ahead_s(self, now_s: float) -> float:
        """Now, on the steady clock; infinity while frames may be waiting that were stamped before it was set."""
        ahead_s = time.time() - now_s
        if abs(ahead_s - self._ahead_s) > _LARGEST_JITTER_S:
            self._set_s = now_s
            self._counters.clock_steps += 1
        self._ahead_s = ahead_s
        return ahead_s if now_s - self._set_s > _OLDEST_FRAME_S else float("inf")


def _queue(bus: can.BusABC) -> socket.socket | None:
    """Socket of a bus of SocketCAN."""
    found = getattr(bus, "socket", None)
    return found if isinstance(found, socket.socket) else None


def _dropped(bus: can.BusABC) -> int:
    """Frames that the kernel has dropped; 0 where that is not known."""
    queue = _queue(bus)
    if queue is None:
        return 0
    try:
        info = queue.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_DROPS + 1))
    except OSError:  # closed meanwhile, or a kernel before 4.12
        return 0
    return int(struct.unpack(f"={_DROPS + 1}I", info)[_DROPS]) if len(info) == 4 * (_DROPS + 1) else 0


def _number(error: Exception) -> int | None:
    code = getattr(error, "error_code", None)
    return code if code is not None else getattr(error, "errno", None)


def _why(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
        return "this kernel has no SocketCAN (try tools/with_vcan)"
    if isinstance(error, OSError) and error.errno == errno.ENODEV:
        return "no such interface (see 'ip link')"
    return str(error).splitlines()[0] if str(error) else type(error).__name__
