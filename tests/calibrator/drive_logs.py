"""A drive as a candump log: what the readers of logs are tested with."""

from pathlib import Path

import numpy as np

from calibrator.drive import Channel, Drive
from calibrator.recordings.write_logs import FrameSeries, encode_message, write_candump
from ecu_node.core.signals import AMPERE, unit_factor
from ecu_node.database import VehicleDatabase
from ecu_node.layout import split_signal


def write_drive_log(path: Path, drive: Drive, database: VehicleDatabase) -> None:
    """Write every message at the instants of its own signals, into a folder that is made if needed.

    Samples that are not good become "signal not available". Branches that the layout computes are left out.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_candump(path, drive_series(drive, database))


def drive_series(drive: Drive, database: VehicleDatabase) -> list[FrameSeries]:
    """Frames of a drive, one series per message."""
    layout = database.layout
    channels = {item.signal: drive.inputs[item.name] for item in layout.input if item.name in drive.inputs}
    for branch in layout.branch:
        if branch.signal is not None and branch.name in drive.branches:
            signal = database.signal(branch.signal)[1]
            factor = branch.sign / unit_factor(signal, AMPERE, f"{layout.path}: branch {branch.name}")
            channel = drive.branches[branch.name]
            value = factor * channel.value
            channels[branch.signal] = Channel(time_s=channel.time_s, value=value, good=channel.good)
    messages: dict[str, dict[str, Channel]] = {}
    for name, channel in channels.items():
        message_name, signal_name = split_signal(name)
        messages.setdefault(message_name, {})[signal_name] = channel
    series = []
    for message_name, signals in messages.items():
        time_s = np.unique(np.concatenate([channel.time_s for channel in signals.values()]))
        values = {name: np.full(len(time_s), np.nan) for name in signals}
        for name, channel in signals.items():
            good = channel.good
            values[name][np.searchsorted(time_s, channel.time_s[good])] = channel.value[good]
        series.append(encode_message(database, message_name, time_s, values))
    return series
