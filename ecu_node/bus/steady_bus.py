"""A bus in use: it is sent on with bounded patience, and opened again after it was gone.

Whatever python-can's interfaces raise meanwhile is counted here.
"""

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable

import can

from ecu_node.bus.links import Link, OneByOne, SocketCanLink, error_text, is_of_frame, means_gone, socketcan_socket
from ecu_node.core.status import Counters
from ecu_node.errors import BusError

__all__ = ["SteadyBus"]


_SEND_ATTEMPTS = 3
_SEND_PAUSE_S = 0.001
"""A full send queue drains by some frames in this time. [s]"""
_FULL_S = 1.0
"""A send queue that is full for longer is told. [s]"""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.05, 2.0
"""Between attempts to open a bus again. [s]"""
_SO_MEMINFO, _DROPS = 55, 8
"""Socket option, and the place of the dropped frames in it (asm-generic/socket.h, linux/sock_diag.h)."""
_BUS_OFF = 0x40
"""Class of error frames of SocketCAN (linux/can/error.h, CAN_ERR_BUSOFF)."""


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
    listen_only : bool
        Whether nothing is ever sent: what is given to be sent is dropped.

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
        self._opened: _Opened | None = _Opened(bus)
        self._failed: tuple[_Opened, Exception] | None = None
        self._retry_s, self._pause_s = 0.0, _FIRST_PAUSE_S
        self._queue: list[can.Message] = []
        self._is_full = self._is_full_told = False
        self._full_since_s = 0.0
        self._closing = threading.Lock()
        self.send: Callable[[can.Message], None] = (lambda _: None) if listen_only else self._queue.append
        """Takes a frame to be sent at the next :meth:`flush`."""
        self.asked_s = time.monotonic()
        """When the bus was asked last; if it had no more, all that came before was received. [s]"""
        self.read_s = self.asked_s
        """When the last frame was read. [s]"""
        self.channel = bus.channel_info

    @property
    def at_hand(self) -> bool:
        """Whether a frame that came is here already."""
        opened = self._opened
        return opened is not None and opened.link.at_hand

    @property
    def is_open(self) -> bool:
        """Whether it is there; False from when it failed until it is open again."""
        return self._opened is not None

    @property
    def state(self) -> str:
        """What it is: gone, full for longer than a second, or open."""
        return "gone" if self._opened is None else "full" if self._is_full_told else "open"

    def receive(self, timeout_s: float) -> can.Message | None:
        """Wait for a data or remote frame; None if none came in time, or the bus is gone."""
        if self._failed is not None:
            failed, error = self._failed
            self._failed = None
            if failed is self._opened:
                self._gone(error)
        opened = self._opened
        if opened is None:
            return self._reopened(timeout_s)
        try:
            message = opened.link.receive(timeout_s)
            while message is not None and message.is_error_frame:
                self._count_error(message)
                message = opened.link.receive(0.0)
        except (can.CanError, OSError) as error:
            self._gone(error)
            return None
        self.asked_s, self.read_s = opened.link.asked_s, opened.link.read_s
        return message

    def flush(self) -> tuple[int, int]:
        """Send what was given to :attr:`send`, in order.

        Returns
        -------
        sent, not_sent : int
            Frames that the bus took, and that it did not: a full one is asked a few times, and once while it stays so.
        """
        queue, done, lost = self._queue, 0, 0
        while done < len(queue):
            opened = self._opened
            if opened is None:
                lost += len(queue) - done
                break
            taken, error = self._given(opened, done)
            done += taken
            if error is None:
                continue
            if means_gone(error):
                # Whoever asks first is told that the bus is gone, and nobody after: receiving need not fail, too.
                self._failed = opened, error
            refused = 1 if is_of_frame(error) else len(queue) - done  # what is full is full for all that follow
            done, lost = done + refused, lost + refused
        sent = len(queue) - lost
        queue.clear()
        return sent, lost

    def _given(self, opened: "_Opened", done: int) -> tuple[int, Exception | None]:
        """Give the bus what it takes now: how many frames, and why not the next one after some patience."""
        for attempt in range(1 if self._is_full else _SEND_ATTEMPTS):
            if attempt:
                time.sleep(_SEND_PAUSE_S)
            try:
                with self._closing:
                    taken = opened.link.send(self._queue, done)
            except (can.CanError, OSError, ValueError) as error:  # ValueError: closed by the other thread just now
                last = error
                if means_gone(error) or is_of_frame(error):
                    return 0, error
            else:
                if self._is_full:
                    self._opens()
                return taken, None
        self._stays_full()
        return 0, last

    def _stays_full(self) -> None:
        now_s = time.monotonic()
        if not self._is_full:
            self._is_full, self._full_since_s = True, now_s
        elif not self._is_full_told and now_s - self._full_since_s > _FULL_S:
            self._is_full_told = True
            self.say(f"{self.channel}: the send queue stays full, frames are lost: is anybody else on this bus?")

    def _opens(self) -> None:
        if self._is_full_told:
            self.say(f"{self.channel}: the bus takes frames again")
        self._is_full = self._is_full_told = False

    def count_dropped(self) -> None:
        """Count the frames that the kernel dropped since the last time, because they were not read in time."""
        opened = self._opened
        if opened is not None:
            self._counters.dropped += opened.newly_dropped()

    def close(self) -> None:
        """Close it."""
        opened, self._opened = self._opened, None
        if opened is not None:
            with self._closing:  # else the other thread might send into whatever takes the socket's number
                opened.bus.shutdown()

    def _count_error(self, message: can.Message) -> None:
        self._counters.bus_errors += 1
        self._counters.bus_off += bool(message.arbitration_id & _BUS_OFF)

    def _gone(self, error: Exception) -> None:
        self.say(f"{self.channel}: the bus failed: {error_text(error)}; trying to open it again")
        self._retry_s, self._pause_s = time.monotonic() + _FIRST_PAUSE_S, _FIRST_PAUSE_S
        with contextlib.suppress(can.CanError, OSError):
            self.close()

    def _reopened(self, timeout_s: float) -> can.Message | None:
        """Open it again if it is time to, and receive; wait no longer than the timeout."""
        now_s = self.asked_s = time.monotonic()
        if now_s < self._retry_s:
            time.sleep(min(timeout_s, self._retry_s - now_s))
            self.asked_s = time.monotonic()
            return None
        self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
        self._retry_s = now_s + self._pause_s
        try:
            opened = _Opened(self._open())
        except BusError:
            return None
        try:
            message = opened.link.receive(0.0)  # an interface that is down can be opened, but not received from
        except (can.CanError, OSError):
            with contextlib.suppress(can.CanError, OSError):
                opened.bus.shutdown()
            return None
        self._opened = opened
        self._counters.reopened += 1
        self.say(f"{self.channel}: the bus is open again")
        if message is not None and message.is_error_frame:
            self._count_error(message)
            return None
        return message


class _Opened:
    """An open bus, and what belongs to it alone."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus
        self._socket = socketcan_socket(bus)
        self.link: Link = OneByOne(bus) if self._socket is None else SocketCanLink(self._socket)
        self._dropped = 0

    def newly_dropped(self) -> int:
        """Frames that the kernel dropped since the last time; 0 where that is not known."""
        if self._socket is None:
            return 0
        try:
            info = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_DROPS + 1))
            (dropped,) = struct.unpack_from("=I", info, 4 * _DROPS)
        except (OSError, struct.error):  # closed meanwhile, or a kernel before 4.12
            return 0
        before, self._dropped = self._dropped, int(dropped)
        return max(self._dropped - before, 0)
