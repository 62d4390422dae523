"""The node on a bus: a thin shell around :class:`~ecu_node.corrector.Corrector` that owns clock, bus and parameters."""

import errno
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can

from ecu_node.corrector import Corrector, Frame, FrameKey
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError
from ecu_node.guard import needs_fd, received
from ecu_node.parameters import UnfitError, check_fit, read_parameters
from ecu_node.wiring import InForce

__all__ = ["choose_parameters", "connect", "open_bus", "receive_filters", "serve"]

_LONGEST_WAIT_S = 0.1
"""A wake-up at least this often, so that a request to stop is seen. [s]"""
_SEND_ATTEMPTS = 3
_SEND_PAUSE_S = 0.001
"""A full send queue drains by some frames in this time. [s]"""
_STANDARD_MASK = 0x7FF
_EXTENDED_MASK = 0x1FFFFFFF


def choose_parameters(path: Path, database: VehicleDatabase, vehicle: str | None) -> tuple[InForce, str | None]:
    """Read parameters, and decide whether they may be applied here.

    Parameters
    ----------
    path : Path
        Parameter file.
    database : VehicleDatabase
        Layout and DBC in use.
    vehicle : str or None
        Identity of the vehicle; None: not checked.

    Returns
    -------
    InForce
        The parameters, or the reason why measured values are passed through.
    str or None
        That reason in words, one line; None if the parameters fit.
    """
    try:
        parameters = read_parameters(path)
    except UnfitError as error:
        return InForce(parameters=None, reason=error.reason), str(error)
    try:
        check_fit(parameters, database, vehicle)
    except UnfitError as error:
        return InForce(parameters=None, reason=error.reason), f"{path}: {error}"
    return InForce(parameters=parameters), None


def receive_filters(database: VehicleDatabase) -> list[can.typechecking.CanFilter]:
    """Filters that let only the branches' messages through, for the kernel to apply."""
    return [
        {
            "can_id": key.identifier,
            "can_mask": _EXTENDED_MASK if key.extended else _STANDARD_MASK,
            "extended": key.extended,
        }
        for key in received(database)
    ]


def open_bus(database: VehicleDatabase, *, interface: str, channel: str, fd: bool) -> can.BusABC:
    """Open the bus for the branches' messages only.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    interface, channel : str
        As python-can names them, such as socketcan and can0.
    fd : bool
        Whether to use CAN FD.

    Returns
    -------
    can.BusABC
        The bus; it does not receive what it sends.

    Raises
    ------
    BusError
        If there is no such bus, or the DBC needs CAN FD and ``fd`` is not given.
    """
    if not fd and (names := needs_fd(database)):
        raise BusError(f"{database.layout.dbc_path}: CAN FD messages ({', '.join(names)}); start with --fd")
    return connect(interface, channel, fd=fd, filters=receive_filters(database))


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
        return can.Bus(
            channel=channel,
            interface=interface,
            ignore_config=True,
            can_filters=filters,
            receive_own_messages=False,
            **options,
        )
    except (can.CanError, OSError, ValueError, TypeError, NotImplementedError) as error:
        raise BusError(f"{interface} {channel}: cannot open the bus: {_why(error)}") from None


def serve(
    bus: can.BusABC,
    corrector: Corrector,
    *,
    stop: Callable[[], bool],
    status_period_s: float,
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Correct until told to stop.

    Parameters
    ----------
    bus : can.BusABC
        An open bus.
    corrector : Corrector
        The core; its counters tell what happened.
    stop : callable
        Asked at every wake-up; True ends the work.
    status_period_s : float
        Time between status messages. [s]
    clock : callable
        Steady clock. [s]

    Raises
    ------
    BusError
        If the bus fails while receiving.
    """
    status_due_s = clock()
    while not stop():
        if clock() >= status_due_s:
            status_due_s = max(status_due_s + status_period_s, clock())
            status = corrector.status(clock())
            if status is not None:
                corrector.counters.send_errors += not _send(bus, status)
        message = _receive(bus, min(_LONGEST_WAIT_S, max(0.0, status_due_s - clock())))
        while message is not None:
            _answer(bus, corrector, message, clock())
            message = _receive(bus, 0.0) if clock() < status_due_s and not stop() else None


def _answer(bus: can.BusABC, corrector: Corrector, message: can.Message, now_s: float) -> None:
    if message.is_error_frame or message.is_remote_frame:
        return
    frame = Frame(
        FrameKey(message.arbitration_id, message.is_extended_id),
        bytes(message.data),
        message.is_fd,
        message.bitrate_switch,
    )
    for answer in corrector.receive(frame, now_s):
        corrector.counters.send_errors += not _send(bus, answer)


def _receive(bus: can.BusABC, timeout_s: float) -> can.Message | None:
    try:
        return bus.recv(timeout_s)
    except can.CanError as error:
        raise BusError(f"{bus.channel_info}: the bus failed: {error}") from None


def _send(bus: can.BusABC, frame: Frame) -> bool:
    """Send one frame; False if the bus did not take it in a few attempts."""
    message = can.Message(
        arbitration_id=frame.key.identifier,
        is_extended_id=frame.key.extended,
        is_fd=frame.fd,
        bitrate_switch=frame.bitrate_switch,
        data=frame.data,
        is_rx=False,
    )
    for attempt in range(_SEND_ATTEMPTS):
        if attempt:
            time.sleep(_SEND_PAUSE_S)
        try:
            bus.send(message)
        except can.CanError:
            continue
        return True
    return False


def _why(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
        return "this kernel has no SocketCAN (try tools/with_vcan)"
    if isinstance(error, OSError) and error.errno == errno.ENODEV:
        return "no such interface (see 'ip link')"
    return str(error).splitlines()[0] if str(error) else type(error).__name__
