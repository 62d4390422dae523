"""How fast logs become drives and drives become summaries, beside python-can and cantools message by message.

The log is that of an artificial vehicle. Both ways read the same file in one process and one thread, make the same
channels (compared value by value), and the best of several readings counts, in time of the processor: a machine that
does other things as well does not change the ratio.
"""

import gzip
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from time import process_time
from typing import Any, TypeVar

import can
import numpy as np
from threadpoolctl import threadpool_limits

from bench.row import Row
from calibrator.artificial.simulate import FleetPlan, simulate_fleet
from calibrator.artificial.trips import BuiltinTrips
from calibrator.drive import Channel
from calibrator.drives.store import write_drive
from calibrator.recordings.readers import read_recording
from calibrator.sources.fleet_source import find_fleet, probe_equipment
from calibrator.summaries.vehicle_summary import read_vehicle_summary
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout, split_signal

__all__ = ["main", "rows"]

Result = TypeVar("Result")
LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
PLAN = FleetPlan(vehicles=1, currents=4, sparsity=80.0, magnitude=(0.05, 0.25), delay_max_s=0.1)
MINUTES, QUICK_MINUTES = 30.0, 3.0
"""Of the log; 250 frames a second. [min]"""
READINGS, PEER_READINGS = 7, 3
"""Of which the best counts; the peer's differ less, as they take longer."""
TIME_STAMP_S = 1e-6
"""Log formats differ by less. [s]"""


def main() -> None:
    """Print one line per row."""
    for row in rows(quick=False):
        ratio = "" if row.ratio is None else f", {row.ratio:.1f} times {row.peer}"
        print(f"{row.name}: {row.value:.3g} {row.unit}{ratio}")


def rows(*, quick: bool) -> list[Row]:
    """Measure.

    Parameters
    ----------
    quick : bool
        Whether a log of few minutes is enough.

    Returns
    -------
    list of Row
        Frames per second of a BLF and of a candump log, and hours of drive summarised per second.
    """
    database = read_database(read_layout(LAYOUT))
    minutes = QUICK_MINUTES if quick else MINUTES
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        log = _candump_log(Path(folder), database, minutes)
        logs = (("BLF", _as_blf(log)), ("candump", log))
        found = [_log_row(name, path, database) for name, path in logs]
        return [*found, _summary_row(log, Path(folder) / "store", database)]


def _candump_log(folder: Path, database: VehicleDatabase, minutes: float) -> Path:
    trips = BuiltinTrips(seed=0, duration_s=60.0 * minutes, unseen_s=60.0)
    simulate_fleet(PLAN, trips, database, folder / "fleet", workers=1)
    (packed,) = (folder / "fleet" / "logs").glob("*/*.log.gz")
    log = folder / "drive.log"
    log.write_bytes(gzip.decompress(packed.read_bytes()))
    return log


def _as_blf(log: Path) -> Path:
    path = log.with_suffix(".blf")
    with can.LogReader(log) as messages, can.Logger(path) as blf:
        for message in messages:
            message.channel = 0  # BLF has numbers
            blf.on_message_received(message)
    return path


def _log_row(name: str, path: Path, database: VehicleDatabase) -> Row:
    """Frames per second of a log file."""
    recording, seconds = _best(lambda: read_recording(path, database, vehicle="V", name="d"), READINGS)
    channels, peer_seconds = _best(lambda: _message_by_message(path, database), PEER_READINGS)
    _require_equal({**recording.drive.branches, **recording.drive.inputs}, channels)
    frames = recording.report.frames
    return Row(
        name=f"{name} log to drive",
        value=frames / seconds,
        unit="frames/s",
        peer=f"python-can and cantools message by message, {frames / peer_seconds:.3g} frames/s",
        ratio=peer_seconds / seconds,
    )


def _message_by_message(path: Path, database: VehicleDatabase) -> dict[str, Channel]:
    """The same channels as most programs make them."""
    layout = database.layout
    signals = {branch.name: (branch.source, branch.sign) for branch in layout.branch}
    signals |= {item.name: (item.signal, 1) for item in layout.input}
    names: dict[int, list[tuple[str, str]]] = {}
    for name, (source, _) in signals.items():
        message, signal = split_signal(source)
        names.setdefault(database.message(message).frame_id, []).append((name, signal))
    times: dict[int, list[float]] = {frame_id: [] for frame_id in names}
    values: dict[str, list[float]] = {name: [] for name in signals}
    decode: Any = database.databases[""].decode_message
    with can.LogReader(path) as reader:
        for frame in reader:
            wanted = names.get(frame.arbitration_id)
            if wanted is None:
                continue
            times[frame.arbitration_id].append(frame.timestamp)
            decoded = decode(frame.arbitration_id, frame.data, decode_choices=False)
            for name, signal in wanted:
                values[name].append(decoded[signal])
    start_s = min(min(stamps) for stamps in times.values() if stamps)
    found = {name: frame_id for frame_id, pairs in names.items() for name, _ in pairs if times[frame_id]}
    return {
        name: Channel(
            time_s=np.array(times[frame_id]) - start_s,
            value=signals[name][1] * np.array(values[name]),
            good=np.full(len(values[name]), fill_value=True),
        )
        for name, frame_id in found.items()
    }


def _require_equal(channels: Mapping[str, Channel], others: Mapping[str, Channel]) -> None:
    """Refuse to compare ways that give different results."""
    for name, channel in channels.items():
        other = others[name]
        np.testing.assert_allclose(channel.time_s, other.time_s, atol=TIME_STAMP_S, rtol=0.0, err_msg=name)
        np.testing.assert_allclose(channel.value, other.value, rtol=1e-12, err_msg=name)


def _summary_row(log: Path, store: Path, database: VehicleDatabase) -> Row:
    """Hours of drive per second from the store to a vehicle's summary."""
    drive = read_recording(log, database, vehicle="V", name="d").drive
    write_drive(store, drive, database.layout)
    fleet = find_fleet(store)
    equipment = probe_equipment(fleet, database, None)
    _, seconds = _best(lambda: read_vehicle_summary(fleet.vehicles["V"], equipment, database), READINGS)
    return Row(name="drives summarised", value=drive.duration_s / 3600.0 / seconds, unit="h/s")


def _best(measured: "Callable[[], Result]", repetitions: int) -> "tuple[Result, float]":
    """Result of a call and the least processor time it took. [s]"""
    seconds = []
    for _ in range(repetitions):
        start = process_time()
        result = measured()
        seconds.append(process_time() - start)
    return result, min(seconds)


if __name__ == "__main__":
    main()
