"""A drive as a CAN log: the way back from channels to frames, through the DBC and the layout."""

from pathlib import Path

import numpy as np

from calibrator.drive import Array, Channel, Drive
from calibrator.recordings.canlog import FrameSeries, encode_message, write_candump
from ecu_node.database import VehicleDatabase
from ecu_node.layout import split_signal
from ecu_node.units import AMPERE, unit_factor

__all__ = ["drive_series", "write_drive_log"]


def write_drive_log(path: Path, drive: Drive, database: VehicleDatabase) -> int:
    """Write a drive as a candump log, every message at the instants of its own signals.

    Parameters
    ----------
    path : Path
        ``.log`` or ``.log.gz``; its folder is made if needed.
    drive : Drive
        The drive. Samples that are not good become "signal not available". Branches that the layout computes from a
        power cannot be written and are left out.
    database : VehicleDatabase
        DBC and layout.

    Returns
    -------
    int
        Number of frames written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_candump(path, drive_series(drive, database))


def drive_series(drive: Drive, database: VehicleDatabase) -> list[FrameSeries]:
    """Frames of a drive, one series per message; see :func:`write_drive_log`."""
    messages: dict[str, dict[str, Channel]] = {}
    for signal, channel in _signals(drive, database).items():
        message_name, signal_name = split_signal(signal)
        messages.setdefault(message_name, {})[signal_name] = channel
    return [_series(database, name, signals) for name, signals in messages.items()]


def _signals(drive: Drive, database: VehicleDatabase) -> dict[str, Channel]:
    """Channels by ``Message.Signal`` in the unit and with the sign of the DBC."""
    layout = database.layout
    signals = {item.signal: drive.inputs[item.name] for item in layout.input if item.name in drive.inputs}
    for branch in layout.branch:
        if branch.signal is None or branch.name not in drive.branches:
            continue
        _, signal = database.signal(branch.signal)
        factor = branch.sign / unit_factor(signal, AMPERE, f"{layout.path}: branch {branch.name}")
        channel = drive.branches[branch.name]
        signals[branch.signal] = Channel(time_s=channel.time_s, value=factor * channel.value, good=channel.good)
    return signals


def _series(database: VehicleDatabase, message_name: str, signals: dict[str, Channel]) -> FrameSeries:
    time_s = np.unique(np.concatenate([channel.time_s for channel in signals.values()]))
    values = {name: _at_instants(channel, time_s) for name, channel in signals.items()}
    return encode_message(database, message_name, time_s, values)


def _at_instants(channel: Channel, time_s: Array) -> Array:
    """Values at instants of the channel's own, NaN at others and where not good."""
    values = np.full(len(time_s), np.nan)
    values[np.searchsorted(time_s, channel.time_s)] = np.where(channel.good, channel.value, np.nan)
    return values
