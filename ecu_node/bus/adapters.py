"""Opens a bus of python-can; its settings come from the command line, then from python-can's own configuration.

python-can's configuration is CAN_BITRATE and CAN_CONFIG of the environment, and can.conf: the section named like the
channel, then [default]. An adapter's driver would take 500 kbit/s if no bit rate is given, which disturbs a bus of
another rate: so a missing bit rate is an error.
"""

import configparser
import errno
import json
import os
import re
import socket
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypedDict, Unpack

import can
from can.typechecking import BitTimingDict, BitTimingFdDict, CanFilter
from can.util import load_config

from ecu_node.errors import BusError

_SPEED_SET_ELSEWHERE = frozenset({"serial", "socketcan", "socketcand", "udp_multicast", "virtual"})
_WITHOUT_ADAPTER = frozenset({"udp_multicast", "virtual"})
_TAKE_TIMING = frozenset({"canalystii", "cantact", "kvaser", "nixnet", "pcan", "slcan", "usb2can", "vector"})
"""Interfaces that can be given a bit timing; the other drivers of python-can 4.6 drop it silently."""
_TAKE_NO_DATA_BITRATE = frozenset({"nixnet", "pcan", "slcan"})
"""Interfaces whose rates of CAN FD can only be set as bit timing."""
_LISTEN_ONLY: dict[str, dict[str, Any]] = {
    "cantact": {"monitor": True},
    "kvaser": {"driver_mode": False},
    "nixnet": {"listen_only": True},
    "pcan": {"state": can.BusState.PASSIVE},
    "seeedstudio": {"operation_mode": "silent"},
    "slcan": {"listen_only": True},
    "systec": {"state": can.BusState.PASSIVE},
    "vector": {"listen_only": True},
}
"""Settings, by interface, with which the adapter sends nothing at all, not even acknowledgements."""
_RECEIVE_BUFFER_BYTES = 1 << 20
"""Buffer for frames that come while the node is busy; the kernel gives as much of it as it allows. [byte]"""
_NOT_OPENED = (can.CanError, OSError, ValueError, TypeError, KeyError, NotImplementedError, ImportError, NameError)
"""Errors of python-can's interfaces; NameError: its kvaser calls functions of a driver that is missing."""
_FD_MTU = 72
"""MTU of a SocketCAN interface that carries CAN FD. [byte]"""


class Settings(TypedDict, total=False):
    """How a bus is used, and its speed."""

    fd: bool
    """Whether to use CAN FD."""
    listen_only: bool
    """Whether to send nothing, and no acknowledgements either if the adapter can omit them."""
    bitrate: int | None
    data_bitrate: int | None
    """Bit rates given on the command line. [bit/s]"""


def connect(
    interface: str, channel: str | None, *, filters: list[CanFilter] | None = None, **settings: Unpack[Settings]
) -> can.BusABC:
    """Open any bus of python-can.

    Parameters
    ----------
    filters : list of CanFilter, optional
        Frames to receive; all if not given.
    interface, channel, **settings :
        Arguments of :func:`bus_config`.

    Returns
    -------
    can.BusABC
        The bus; it does not receive what it sends.

    Raises
    ------
    BusError
        If it cannot be opened; the message says why.
    """
    config = bus_config(interface, channel, **settings)
    config |= {"can_filters": filters, "receive_own_messages": False}
    try:
        bus = can.Bus(**config, ignore_config=True)
    except _NOT_OPENED as error:
        why = error_text(error)
        if isinstance(error, ImportError | NameError) or re.search("library|driver|module", why):
            why += "; install the driver of the adapter"
        elif isinstance(error, ValueError | TypeError):
            why += "; see --channel, CAN_CONFIG, can.conf"
        raise BusError(f"{interface} {channel}: cannot open the bus: {why}") from None
    if bus.channel_info == can.BusABC.channel_info:
        bus.channel_info = f"{interface} {channel}"  # for interfaces that do not name themselves
    opened = socketcan_socket(bus)
    if opened is not None:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    return bus


def filters_of(keys: Iterable[tuple[int, bool]]) -> list[CanFilter]:
    """Return filters that let these identifiers pass, each given with whether it has 29 bits."""
    return [{"can_id": key, "can_mask": 0x1FFFFFFF if long else 0x7FF, "extended": long} for key, long in keys]


def error_text(error: Exception) -> str:
    """Say what went wrong, in one line, and what to do if that is known."""
    if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
        return "this kernel has no SocketCAN (modules can, can_raw and, for virtual buses, vcan)"
    if isinstance(error, OSError) and error.errno == errno.ENODEV:
        return "no CAN interface of this name (see 'ip -details link')"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def is_interface(bus: can.BusABC, name: str) -> bool:
    """Check whether a bus belongs to python-can's interface of this name."""
    return any(f"{kind.__module__}.".startswith(f"can.interfaces.{name}.") for kind in type(bus).__mro__)


def socketcan_socket(bus: can.BusABC) -> socket.socket | None:
    """Return the socket of a SocketCAN bus; None for other interfaces."""
    found = getattr(bus, "socket", None) if is_interface(bus, "socketcan") else None
    return found if isinstance(found, socket.socket) else None


def carries_fd(interface: str, channel: str) -> bool:
    """Check whether a SocketCAN interface is set up for CAN FD; False if that is not known."""
    try:
        return interface == "socketcan" and int(Path(f"/sys/class/net/{channel}/mtu").read_text()) >= _FD_MTU
    except (OSError, ValueError):
        return False


def bus_config(interface: str, channel: str | None, **settings: Unpack[Settings]) -> dict[str, Any]:
    """Return the settings of a bus, checked as far as is possible without opening it.

    Parameters
    ----------
    interface, channel : str
        Names of interface and channel in python-can; None: the channel of its configuration.
    **settings : Settings
        Settings that take precedence over those of python-can's configuration.

    Returns
    -------
    dict
        Arguments of ``can.Bus``.

    Raises
    ------
    BusError
        If the interface is not known, or the bus's speed is not given, cannot be set, or contradicts itself.
    """
    given: dict[str, Any] = {**settings, "interface": interface, "channel": channel, "fd": settings.get("fd") or None}
    said = {name: value for name, value in given.items() if value is not None and name != "listen_only"}
    try:
        for name in ("CAN_CONFIG", f"CAN_CONFIG_{channel}"):
            if not isinstance(json.loads(os.environ.get(name, "{}")), dict):
                raise ValueError(f'{name} is no JSON object, such as {{"bitrate": 500000}}')
        config: dict[str, Any] = {**load_config(config=said, context=channel)}
    except (can.CanError, ValueError, TypeError, AttributeError, configparser.Error) as error:
        reason = " ".join(str(error).split())
        raise BusError(
            f"{interface} {channel}: cannot open the bus: {reason}; see --interface, CAN_CONFIG, can.conf"
        ) from None
    if problem := _wrong_speed(config):
        raise BusError(f"{interface} {channel}: {problem}")
    return {**config, **_LISTEN_ONLY.get(interface, {})} if settings.get("listen_only") else config


def _wrong_speed(config: Mapping[str, Any]) -> str | None:
    """Say why the bus would not get the speed that was meant; None if it will."""
    interface, channel = config["interface"], config["channel"]
    rates = {name: config[name] for name in ("bitrate", "data_bitrate") if name in config}
    has_timing = "timing" in config or "f_clock" in config
    if interface in _SPEED_SET_ELSEWHERE:
        if not rates and not has_timing:
            return None
        how = f" (ip link set {channel} type can bitrate ...)" if interface == "socketcan" else ""
        return (
            f"the bit rate of {interface} is not set from here{how}; take {', '.join(rates) or 'f_clock'} out of the "
            f"options, CAN_BITRATE, CAN_CONFIG and can.conf, whose section [channel] is for one bus"
        )
    return next(_wrong_timing(config, rates) if has_timing else _wrong_rates(config, rates), None)


def _wrong_timing(config: Mapping[str, Any], rates: Mapping[str, int]) -> Iterator[str]:
    """Yield why python-can would drop a bit timing, or how the timing contradicts bit rates that are given too."""
    timing, fd = config.get("timing"), config.get("fd")
    if config["interface"] not in _TAKE_TIMING:
        yield "python-can cannot set a bit timing there; take f_clock out, and give a bit rate"
    if not isinstance(timing, can.BitTimingFd if fd else can.BitTiming):
        kind = "CAN FD" if fd else "classic CAN (CAN FD: --fd)"
        yield f"the bit timing is incomplete, impossible, or not one of {kind}, which has {_timing_keys(fd=fd)}"
    own = {"bitrate": getattr(timing, "nom_bitrate" if fd else "bitrate", None)}
    own["data_bitrate"] = getattr(timing, "data_bitrate", None)
    if wrong := [f"{name} = {rate}" for name, rate in rates.items() if own[name] != rate]:
        yield f"{', '.join(wrong)} contradicts the bit timing ({timing}); leave one of them out"


def _timing_keys(*, fd: Any) -> str:
    """Return the names of the settings that make up a bit timing, for messages."""
    return ", ".join((BitTimingFdDict if fd else BitTimingDict).__annotations__)


def _wrong_rates(config: Mapping[str, Any], rates: Mapping[str, int]) -> Iterator[str]:
    """Yield which bit rate is missing, or is not one that the adapter can set."""
    interface, channel, fd = config["interface"], config["channel"], config.get("fd")
    if fd and interface in _TAKE_NO_DATA_BITRATE:
        yield f"CAN FD needs its bit timing: {_timing_keys(fd=fd)} in section [{channel}] of can.conf"
    for name in ("bitrate", "data_bitrate") if fd else ("bitrate",):
        if name not in rates:
            yield (
                f"no {name}: this adapter sets the speed of the bus, and a wrong one disturbs it; put {name} into "
                f"section [{channel}] of can.conf (for ecu-node also --{name.replace('_', '-')} BIT_PER_S)"
            )
        elif not isinstance(rates[name], int) or rates[name] <= 0:
            yield f"{name} = {rates[name]}: a number of bit/s is expected, such as 250000"
    if interface == "pcan":
        from can.interfaces.pcan.basic import PCAN_BITRATES  # noqa: PLC0415  # here, as its import warns of what it lacks

        if rates["bitrate"] not in PCAN_BITRATES:  # the driver would set 500 kbit/s
            known = ", ".join(map(str, PCAN_BITRATES))
            yield f"bitrate = {rates['bitrate']}: pcan has {known}; or give the bit timing"


def config_text(config: Mapping[str, Any]) -> str:
    """Describe a bus and the settings that it is opened with, in one line."""
    hidden = {"interface", "channel", "can_filters", "receive_own_messages"}
    if "timing" in config:
        hidden |= BitTimingDict.__annotations__.keys() | BitTimingFdDict.__annotations__.keys()
    settings = [f"{name} {value}" for name, value in config.items() if name not in hidden]
    if config["interface"] in _SPEED_SET_ELSEWHERE - _WITHOUT_ADAPTER:
        settings.append("bit rate as it is set up")
    return f"{config['interface']} {config['channel']}: {', '.join(settings) or 'no settings'}"


def acknowledgement(interface: str, channel: str) -> str:
    """Return the line that a listen-only node logs: whether its adapter still acknowledges frames."""
    if interface in _LISTEN_ONLY:
        return "listen-only: nothing is sent, and no frame acknowledged"
    if interface in _WITHOUT_ADAPTER:
        return "listen-only: nothing is sent"
    if interface == "socketcan":
        words = f"unless its interface is listen-only, too ('ip link set {channel} type can listen-only on')"
    else:
        words = f"as python-can has no listen-only mode of {interface}"
    return f"listen-only: nothing is sent, but the adapter acknowledges frames, {words}"
