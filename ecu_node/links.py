"""How frames get from a bus of python-can to the node and back: one by one, as every interface can."""

import socket
import time
from collections.abc import Sequence
from typing import Protocol

import can

__all__ = ["Link", "OneByOne", "data_frame", "socketcan_socket"]

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
        can.CanError, OSError
            If the bus is gone or down.
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
        can.CanError, OSError, ValueError
            If the first one was not taken.
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
