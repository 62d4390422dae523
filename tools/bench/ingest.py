"""How fast logs become drives and summaries, beside python-can and cantools message by message.

The log is that of an artificial vehicle with three branches, 230 frames a second. Both ways read the same file in one
thread and make the same channels (compared value by value). The best of several readings counts, in processor time that
includes helping processes, so that other work of the machine does not change the ratio.
"""

import gzip
import resource
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import can
import numpy as np
import psutil
from threadpoolctl import threadpool_limits

from bench.fleets import simulated_fleet
from bench.row import LAYOUT, Row
from calibrator.drive import Channel, DriveFile, Equipment
from calibrator.drives.align import choose_inputs
from calibrator.drives.store import list_drives, write_drive
from calibrator.recordings.readers import read_recording
from calibrator.sources.fleet_source import load_drive
from calibrator.summaries.summarise_fleet import read_vehicle_summary
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout, split_signal

__all__ = ["rows"]

Result = TypeVar("Result")
MINUTES, QUICK_MINUTES = 10.0, 3.0
"""Length of the log. [min]"""
READINGS = 5
"""Number of readings, of which the best counts; the peer, which takes longer and varies less, reads once."""
TIME_STAMP_S = 1e-5
"""Time stamps of log formats differ by less than this. [s]"""
STORE_PERIOD_S = 0.1
"""Period of the samples in the drive store. [s]"""


def rows(*, quick: bool) -> list[Row]:
    """Measure how fast logs and drives are read.

    Parameters
    ----------
    quick : bool
        Whether a log of few minutes is enough.

    Returns
    -------
    list of Row
        Frames per second of a log of each format, and hours of driving summarised per second from a log and from a
        drive store.
    """
    database, minutes = read_database(read_layout(LAYOUT)), QUICK_MINUTES if quick else MINUTES
    with tempfile.TemporaryDirectory() as place, threadpool_limits(1):
        folder = Path(place)
        (packed,) = simulated_fleet(folder / "fleet", vehicles=1, minutes=minutes).glob("logs/*/*.log.gz")
        log = folder / "drive.log"
        log.write_bytes(gzip.decompress(packed.read_bytes()))
        logs = {"BLF": _as(log, ".blf"), "candump": log, "ASC": _as(log, ".asc"), "MF4": _as(log, ".mf4")}
        found = [_log_row(name, path, database) for name, path in logs.items()]
        entry = DriveFile(vehicle="V", name="d", place=str(packed))
        found.append(_summary_row("candump.gz log to summary", entry, ("battery", "motor", "auxiliary"), database))
        drive = read_recording(log, database, vehicle="V", name="d").drive
        thin = {name: _thinned(channel) for name, channel in {**drive.branches, **drive.inputs}.items()}
        two = {name: thin[name] for name in ("battery", "motor")}
        inputs = {name: thin[name] for name in drive.inputs}
        write_drive(folder / "store", replace(drive, branches=two, inputs=inputs), database.layout)
        (entry,) = list_drives(folder / "store")
        return [*found, _summary_row("drive of a store (10 Hz, 2 branches) to summary", entry, tuple(two), database)]


def _as(log: Path, suffix: str) -> Path:
    """Write a log in another format, and return its path."""
    path = log.with_suffix(suffix)
    with can.LogReader(log) as messages, can.Logger(path) as writer:
        for message in messages:
            message.channel, message.is_rx = 0, True  # in these formats channels are numbers
            writer.on_message_received(message)
    return path


def _thinned(channel: Channel) -> Channel:
    """Return the channel with ten samples a second."""
    step = max(round(STORE_PERIOD_S / float(np.median(np.diff(channel.time_s)))), 1)
    return Channel(time_s=channel.time_s[::step], value=channel.value[::step], good=channel.good[::step])


def _log_row(name: str, path: Path, database: VehicleDatabase) -> Row:
    """Measure frames per second of a log file, ours and the peer's; raise if the results differ."""
    recording, seconds = _best(lambda: read_recording(path, database, vehicle="V", name="d"), READINGS)
    others, peer_seconds = _best(lambda: _message_by_message(path, database), 1)
    for channel_name, channel in {**recording.drive.branches, **recording.drive.inputs}.items():
        time_s, value = others[channel_name]
        np.testing.assert_allclose(channel.time_s, time_s, atol=TIME_STAMP_S, rtol=0.0, err_msg=channel_name)
        np.testing.assert_allclose(channel.value, value, rtol=1e-12, err_msg=channel_name)
    frames = recording.report.frames
    peer = f"python-can and cantools message by message, {frames / peer_seconds:.3g} frames/s"
    return Row(
        name=f"{name} log to drive", value=frames / seconds, unit="frames/s", peer=peer, ratio=peer_seconds / seconds
    )


def _message_by_message(path: Path, database: VehicleDatabase) -> dict[str, tuple[Any, Any]]:
    """Return times [s] and values of the same channels, read as most programs do it."""
    layout = database.layout
    signals: dict[str, tuple[str, int]] = {branch.name: (branch.source, branch.sign) for branch in layout.branch}
    signals |= {item.name: (item.signal, 1) for item in layout.input}
    wanted: dict[int, list[tuple[str, str, int]]] = {}
    for name, (source, sign) in signals.items():
        message, signal = split_signal(source)
        wanted.setdefault(database.message(message).frame_id, []).append((name, signal, sign))
    times: dict[int, list[float]] = {frame_id: [] for frame_id in wanted}
    values: dict[str, list[float]] = {name: [] for name in signals}
    decode: Any = database.databases[""].decode_message
    with can.LogReader(path) as reader:
        for frame in reader:
            if frame.arbitration_id in wanted:
                times[frame.arbitration_id].append(frame.timestamp)
                decoded = decode(frame.arbitration_id, frame.data, decode_choices=False)
                for name, signal, sign in wanted[frame.arbitration_id]:
                    values[name].append(sign * decoded[signal])
    start_s = min(stamps[0] for stamps in times.values() if stamps)
    return {
        name: (np.array(times[frame_id]) - start_s, np.array(values[name]))
        for frame_id, items in wanted.items()
        for name, *_ in items
        if times[frame_id]
    }


def _summary_row(name: str, entry: DriveFile, branches: tuple[str, ...], database: VehicleDatabase) -> Row:
    """Measure hours of driving per second, from a file to a vehicle's summary."""
    drive = load_drive(entry, database)
    inputs = choose_inputs(database.layout, set(drive.inputs), names=database.layout.fleet_inputs)[0]
    equipment = Equipment(branches=branches, inputs=inputs, fleet_inputs=inputs, notices=())
    _, seconds = _best(lambda: read_vehicle_summary((entry,), equipment, database), READINGS)
    return Row(name=name, value=drive.duration_s / 3600.0 / seconds, unit="h/s")


def _best(measured: Callable[[], Result], repetitions: int) -> tuple[Result, float]:
    """Return the result of a call and its least processor time, helping processes included. [s]"""
    seconds = []
    for _ in range(repetitions):
        start = _processor_s()
        result = measured()
        seconds.append(_processor_s() - start)
    return result, min(seconds)


def _processor_s() -> float:
    """Return the processor time of this process, of those that it waited for, and of those that still run. [s]"""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    living = [child.cpu_times() for child in psutil.Process().children(recursive=True)]
    return sum(each.ru_utime + each.ru_stime for each in used) + sum(float(each.user + each.system) for each in living)
