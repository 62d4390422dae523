"""Recorded trips of the BMW i3 as the frames of vehicles with faults and known delays; run, it prints the errors.

python -m tests.real.delay_trips
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from calibrator.artificial.random_fleet import FaultSettings
from calibrator.artificial.simulate import Vehicle, vehicle_frames
from calibrator.artificial.trips import GroundTruth, ground_truth_from_drive, with_branches
from calibrator.drive import Array, Channel, Drive, Mask
from calibrator.drives.delays import estimate_delays
from calibrator.drives.store import iterate_drives
from calibrator.random_streams import Purpose, random_stream
from calibrator.recordings.decode import decode_signal
from calibrator.recordings.write_logs import FrameSeries
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout

ROOT = Path(__file__).parents[2]
LAYOUT = ROOT / "dbc" / "hv_powertrain.toml"
BRANCHES = ("battery", "motor", "auxiliary")
NOISE = 0.001
"""Of full scale: 0.4 A."""
UNMEASURED_A = (2.5, 0.75)
"""Mean and standard deviation of the loads that no branch measures: 1 to 4 A."""
MAX_DELAY_S = 0.3
FAULTS, SPARSITY = (0.05, 0.25), 60.0


@dataclass(frozen=True, kw_only=True)
class DelayedTrip:
    """One vehicle: what was recorded, and how much later than the battery's its branches are seen. [s]"""

    drive: Drive
    delay_s: Array


@dataclass(frozen=True, kw_only=True)
class DelayErrors:
    """Errors of all vehicles in the delay of each branch after the first, shape (N, K-1). [s]"""

    names: tuple[str, ...]
    error_s: Array
    sd_s: Array
    known: Mask
    elapsed_s: Array


def import_trips(data: Path, store: Path) -> str:
    """Make a drive store of the recordings; returns the account of the import as JSON."""
    command = [
        sys.executable, str(ROOT / "tools" / "import_bmw_i3.py"), str(data / "bmw_i3_summer"),
        "--layout", str(LAYOUT), "--out", str(store), "--json",
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def delayed_trips(store: Path, *, branches: int, seed: int = 0) -> Iterator[DelayedTrip]:
    """Every trip whose branches have good samples, each a vehicle of its own."""
    layout = read_layout(LAYOUT)
    database = read_database(msgspec.structs.replace(layout, e2e=[]))  # it takes long to make and plays no part here
    for number, drive in enumerate(iterate_drives(store, layout)):
        trip = _ideal_trip(drive, BRANCHES[:branches])
        if trip is not None:
            yield _delayed(trip, database, random_stream(Purpose.FRAMES, seed, branches, number))


def delay_errors(store: Path, *, branches: int, seed: int = 0) -> DelayErrors:
    """Estimate the delays of every trip and compare them with the truth."""
    rows: list[tuple[Array, Array, Mask, float]] = []
    for trip in delayed_trips(store, branches=branches, seed=seed):
        start_s = time.perf_counter()
        found = estimate_delays([trip.drive], BRANCHES[:branches])
        elapsed_s = time.perf_counter() - start_s
        rows.append(((found.delay_s - trip.delay_s)[1:], found.sd_s[1:], found.known[1:], elapsed_s))
    error_s, sd_s, known, elapsed = (np.array(column) for column in zip(*rows, strict=True))
    return DelayErrors(names=BRANCHES[1:branches], error_s=error_s, sd_s=sd_s, known=known, elapsed_s=elapsed)


def rms(x: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(x**2)))


def _ideal_trip(drive: Drive, branches: Sequence[str]) -> GroundTruth | None:
    """A trip whose currents sum to zero; None if a branch other than the motor has no good sample."""
    recorded = {name: drive.branches[name] for name in branches if name != "motor"}
    trip = ground_truth_from_drive(replace(drive, branches=recorded, inputs={}), 0.1)
    if trip is None:
        return None
    nothing = np.zeros(len(trip))
    return with_branches(
        replace(trip, currents_a={**dict.fromkeys(branches, nothing), **trip.currents_a}), branches, "motor"
    )


def _delayed(trip: GroundTruth, database: VehicleDatabase, rng: np.random.Generator) -> DelayedTrip:
    names = tuple(trip.currents_a)
    full_scale_a = database.layout.full_scale_a
    settings = FaultSettings(sparsity=SPARSITY, magnitude=FAULTS)
    faults = settings.draw(rng, vehicles=1, branches=len(names), full_scale_a=full_scale_a).take(0)
    vehicle = Vehicle(
        name=trip.name,
        branches=names,
        faults=faults,
        noise_a=NOISE * full_scale_a,
        delay_s=rng.uniform(0.0, MAX_DELAY_S, size=len(names)),
        unmeasured_a=max(0.0, float(rng.normal(*UNMEASURED_A))),
    )
    series = {item.arbitration_id: item for item in vehicle_frames(rng, database, vehicle, trip)}
    channels = {name: _channel(database, series, name) for name in names}
    drive = Drive(vehicle=trip.name, name="d", branches=channels, inputs={})
    return DelayedTrip(drive=drive, delay_s=vehicle.delay_s - vehicle.delay_s[0])


def _channel(database: VehicleDatabase, series: dict[int, FrameSeries], name: str) -> Channel:
    branch = database.layout.find_branch(name)
    assert branch.signal is not None
    message, signal = database.signal(branch.signal)
    frames = series[message.frame_id]
    decoded = decode_signal(message, signal, frames.data, np.full(len(frames.data), message.length, np.uint8))
    return Channel(time_s=frames.time_s, value=branch.sign * decoded.value, good=decoded.good)


def _print_errors(store: Path, branches: int) -> None:
    errors = delay_errors(store, branches=branches)
    print(f"K = {branches}, {len(errors.known)} trips, {errors.elapsed_s.mean():.2f} s per vehicle")
    for k, name in enumerate(errors.names):
        known = errors.known[:, k]
        error_s, z = errors.error_s[known, k], errors.error_s[known, k] / errors.sd_s[known, k]
        print(
            f"  {name}: known in {known.sum()}, RMSE {1e3 * rms(error_s):.2f} ms, "
            f"largest {1e3 * np.abs(error_s).max():.2f} ms, rms of error/sd {rms(z):.2f}"
        )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        import_trips(ROOT.parent / "shared" / "data", Path(folder) / "store")
        for count in (2, 3):
            _print_errors(Path(folder) / "store", count)
