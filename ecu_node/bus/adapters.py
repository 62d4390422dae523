"""What python-can is to open a bus with: the command line first, then python-can's own configuration.

That is CAN_BITRATE and CAN_CONFIG of the environment, and can.conf: its section named as the channel, then [default].
An adapter's driver takes 500 kbit/s where nothing is said, which disturbs a bus of another rate: it is never asked to.
"""

import configparser
from collections.abc import Mapping
from typing import Any

import can
from can.typechecking import BitTimingDict, BitTimingFdDict
from can.util import load_config

from ecu_node.errors import BusError

__all__ = ["acknowledgement", "bus_config", "config_text"]


_SPEED_SET_ELSEWHERE = frozenset({"serial", "socketcan", "socketcand", "udp_multicast", "virtual"})
_WITHOUT_ADAPTER = frozenset({"udp_multicast", "virtual"})
_TAKE_TIMING = frozenset({"canalystii", "cantact", "kvaser", "nixnet", "pcan", "slcan", "usb2can", "vector"})
"""The other drivers of python-can 4.6 drop a bit timing silently."""
_TAKE_NO_DATA_BITRATE = frozenset({"nixnet", "pcan", "slcan"})
"""Of these the rates of CAN FD can only be set as bit timing."""
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
"""Settings with which a driver's adapter sends nothing at all, not even acknowledgements."""


def bus_config(
    interface: str,
    channel: str | None,
    *,
    fd: bool = False,
    listen_only: bool = False,
    bitrates: Mapping[str, int | None] = {},
) -> dict[str, Any]:
    """Settings of a bus, checked as far as that goes without opening it.

    Parameters
    ----------
    interface, channel : str
        As python-can names them; None: the channel of its configuration.
    fd, listen_only : bool
        Whether to use CAN FD, and to send nothing, acknowledgements included where the adapter can do without.
    bitrates : mapping
        ``bitrate`` and ``data_bitrate`` of the command line, or None. [bit/s]

    Returns
    -------
    dict
        Arguments of ``can.Bus``.

    Raises
    ------
    BusError
        If the interface is not known, or the bus's speed is not given, cannot be set, or contradicts itself.
    """
    given = {"interface": interface, "channel": channel, "fd": fd or None, **bitrates}
    said = {name: value for name, value in given.items() if value is not None}
    try:
        config: dict[str, Any] = {**load_config(config=said, context=channel)}
    except (can.CanError, ValueError, TypeError, AttributeError, configparser.Error) as error:
        reason = " ".join(str(error).split())
        raise BusError(
            f"{interface} {channel}: cannot open the bus: {reason}; see --interface, CAN_CONFIG, can.conf"
        ) from None
    _check_speed(config, f"{interface} {channel}")
    return {**config, **_LISTEN_ONLY.get(interface, {})} if listen_only else config


def _check_speed(config: Mapping[str, Any], where: str) -> None:
    """Refuse a bus whose speed would not be the one that was meant."""
    interface, channel, fd = config["interface"], config["channel"], bool(config.get("fd"))
    rates = {name: config[name] for name in ("bitrate", "data_bitrate") if name in config}
    has_timing = "timing" in config or "f_clock" in config
    if interface in _SPEED_SET_ELSEWHERE:
        if rates or has_timing:
            how = f" (ip link set {channel} type can bitrate ...)" if interface == "socketcan" else ""
            raise BusError(
                f"{where}: the bit rate of {interface} is not set from here{how}; take {', '.join(rates) or 'f_clock'} "
                f"out of the options, CAN_BITRATE, CAN_CONFIG and can.conf, whose section [channel] is for one bus"
            )
    elif has_timing:
        _check_timing(config, rates, where)
    elif fd and interface in _TAKE_NO_DATA_BITRATE:
        keys = ", ".join(BitTimingFdDict.__annotations__)
        raise BusError(f"{where}: CAN FD needs its bit timing: {keys} in section [{channel}] of can.conf")
    else:
        for name in ("bitrate", "data_bitrate") if fd else ("bitrate",):
            if name not in rates:
                raise BusError(
                    f"{where}: no {name}: this adapter sets the speed of the bus, and a wrong one disturbs it; give "
                    f"ecu-node --{name.replace('_', '-')} BIT_PER_S, or {name} in section [{channel}] of can.conf"
                )
            if not isinstance(rates[name], int) or rates[name] <= 0:
                raise BusError(f"{where}: {name} = {rates[name]}: a number of bit/s is expected, such as 250000")
        if interface == "pcan":
            from can.interfaces.pcan.basic import PCAN_BITRATES  # noqa: PLC0415  # warns of what it lacks

            if rates["bitrate"] not in PCAN_BITRATES:  # the driver would set 500 kbit/s
                known = ", ".join(map(str, PCAN_BITRATES))
                raise BusError(f"{where}: bitrate = {rates['bitrate']}: pcan has {known}; or give the bit timing")


def _check_timing(config: Mapping[str, Any], rates: Mapping[str, int], where: str) -> None:
    """Refuse a bit timing that python-can would drop, or that contradicts the bit rates given beside it."""
    timing, fd = config.get("timing"), bool(config.get("fd"))
    if config["interface"] not in _TAKE_TIMING:
        raise BusError(f"{where}: python-can cannot set a bit timing there; take f_clock out, and give a bit rate")
    if isinstance(timing, can.BitTimingFd) and fd:
        own = {"bitrate": timing.nom_bitrate, "data_bitrate": timing.data_bitrate}
    elif isinstance(timing, can.BitTiming) and not fd:
        own = {"bitrate": timing.bitrate}
    else:
        keys = ", ".join((BitTimingFdDict if fd else BitTimingDict).__annotations__)
        raise BusError(
            f"{where}: the bit timing is incomplete, impossible, or not one of "
            f"{'CAN FD' if fd else 'classic CAN (CAN FD: --fd)'}, which has {keys}"
        )
    if wrong := [f"{name} = {rate}" for name, rate in rates.items() if own.get(name) != rate]:
        raise BusError(f"{where}: {', '.join(wrong)} contradicts the bit timing ({timing}); leave one of them out")


def config_text(config: Mapping[str, Any]) -> str:
    """A bus, and what it is opened with, in one line."""
    hidden = {"interface", "channel", "can_filters", "receive_own_messages"}
    if "timing" in config:
        hidden |= BitTimingDict.__annotations__.keys() | BitTimingFdDict.__annotations__.keys()
    settings = [f"{name} {value}" for name, value in config.items() if name not in hidden]
    if config["interface"] in _SPEED_SET_ELSEWHERE - _WITHOUT_ADAPTER:
        settings.append("bit rate as it is set up")
    return f"{config['interface']} {config['channel']}: {', '.join(settings) or 'no settings'}"


def acknowledgement(interface: str, channel: str) -> str:
    """What a listen-only node says of itself: whether its adapter still acknowledges frames."""
    if interface in _LISTEN_ONLY:
        return "listen-only: nothing is sent, and no frame acknowledged"
    if interface in _WITHOUT_ADAPTER:
        return "listen-only: nothing is sent"
    if interface == "socketcan":
        words = f"unless its interface is listen-only, too ('ip link set {channel} type can listen-only on')"
    else:
        words = f"as python-can has no listen-only mode of {interface}"
    return f"listen-only: nothing is sent, but the adapter acknowledges frames, {words}"
