"""Opening a bus of python-can, and one with what the node needs of it.

Whatever python-can's interfaces raise becomes :class:`~ecu_node.errors.BusError` here.
"""

import socket
from pathlib import Path
from typing import Any

import can

from ecu_node.bus_errors import error_text
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError
from ecu_node.guard import Mode, needs_fd, received, transmitted
from ecu_node.links import socketcan_socket

__all__ = ["carries_fd", "connect", "open_bus", "receive_filters"]

_STANDARD_MASK = 0x7FF
_EXTENDED_MASK = 0x1FFFFFFF
_RECEIVE_BUFFER_BYTES = 1 << 20
"""Asked of the kernel, which gives what it allows: frames of the time in which the node does something else."""
_INTERFACES = Path("/sys/class/net")
_FD_BYTES = 72
"""Of struct canfd_frame: the largest unit of an interface that carries them."""


def receive_filters(database: VehicleDatabase) -> list[can.typechecking.CanFilter]:
    """Filters of an overlay node, for the kernel to apply: the branches' messages, and its own as sent by others."""
    return [
        {
            "can_id": key.identifier,
            "can_mask": _EXTENDED_MASK if key.extended else _STANDARD_MASK,
            "extended": key.extended,
        }
        for key in (*received(database), *transmitted(database, Mode.OVERLAY))
    ]


def open_bus(database: VehicleDatabase, *, interface: str, channel: str, fd: bool, mode: Mode) -> can.BusABC:
    """Open a bus for the node.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    interface, channel : str
        As python-can names them, such as socketcan and can0.
    fd : bool
        Whether to use CAN FD.
    mode : Mode
        An overlay node receives what it needs, a gateway everything.

    Returns
    -------
    can.BusABC
        The bus; it does not receive what it sends.

    Raises
    ------
    BusError
        If there is no such bus, or the DBC needs CAN FD and ``fd`` is not given.
    """
    if not fd and (names := needs_fd(database, mode)):
        raise BusError(f"{database.layout.dbc_path}: CAN FD messages ({', '.join(names)}); start with --fd")
    filters = receive_filters(database) if mode is Mode.OVERLAY else None
    return connect(interface, channel, fd=fd, filters=filters)


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
