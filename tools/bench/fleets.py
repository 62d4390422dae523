"""Fleets of the benchmarks: simulated ones, and large ones that are made from few simulated vehicles.

Faults change currents linearly, equations (11) and (13) of the paper. So the summaries of a few vehicles without faults
can be turned into those of any number of vehicles with faults, without reading a drive.
"""

import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from bench.row import LAYOUT
from calibrator.artificial.random_fleet import FaultSettings
from calibrator.artificial.simulate import FleetPlan, simulate_fleet
from calibrator.artificial.trips import BuiltinTrips
from calibrator.drive import Array, Channel, Equipment
from calibrator.drives.store import write_drive
from calibrator.faults import Faults
from calibrator.files.storage import open_storage
from calibrator.processes.run_many import Workers, run_many
from calibrator.recordings.readers import read_recording
from calibrator.summaries.identity import store_identity, write_identity
from calibrator.summaries.record import Record
from calibrator.summaries.summary_store import SummaryStore, existing_store
from calibrator.summaries.vehicle_summary import VehicleSummary, ZeroCurrent
from calibrator.terminal.progress import shown
from ecu_node.database import read_database
from ecu_node.layout import read_layout

__all__ = ["WORKERS", "calibrator", "make_store", "simulated_fleet", "write_drives"]

WORKERS = 2
"""Processes that make fleets and calibrate them."""
SUMMARISED, SUMMARISED_MINUTES = 16, 6.0
"""Number of simulated vehicles whose summaries a large fleet is made of, and the least length of their trips. [min]"""
DRIVES, DRIVE_MINUTES, STEP_A = 20, 10.0, 0.1
"""Number of different drives that a large fleet is made of, their length [min], and the step of the noise by which
copies differ [A]."""


def calibrator(*words: object) -> list[str]:
    """Return the command line that runs the calibrator with these arguments."""
    return [sys.executable, "-m", "calibrator", *map(str, words)]


def simulated_fleet(folder: Path, *, vehicles: int, minutes: float, currents: int = 3, sparsity: float = 80.0) -> Path:
    """Write logs of a fleet with the paper's faults and delays up to 0.1 s into a new folder, and return the folder."""
    plan = FleetPlan(vehicles=vehicles, currents=currents, sparsity=sparsity, delay_max_s=0.1)
    trips = BuiltinTrips(seed=0, duration_s=60.0 * minutes, unseen_s=60.0)
    simulate_fleet(plan, trips, read_database(read_layout(LAYOUT)), folder, workers=WORKERS)
    return folder


@cache
def _summaries(branches: int) -> tuple[Equipment, list[VehicleSummary]]:
    """Return equipment and summaries of simulated vehicles without faults."""
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        fleet, store = Path(name) / "fleet", Path(name) / "store"
        simulated_fleet(fleet, vehicles=SUMMARISED, minutes=SUMMARISED_MINUTES, currents=branches, sparsity=100.0)
        summarise = calibrator("summarise", fleet, "--layout", LAYOUT, "--workers", WORKERS, "--out", store)
        subprocess.run(summarise, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
        opened = existing_store(store)
        records = [record for bucket in opened.buckets() for (record,) in opened.read(bucket).values()]
    return opened.identity.equipment, [record.found for record in records if record.found is not None]


def make_store(folder: Path, *, vehicles: int, branches: int = 2) -> None:
    """Write a new store of summaries of vehicles with the paper's faults, half of them without hardware faults."""
    database, (equipment, summaries) = read_database(read_layout(LAYOUT)), _summaries(branches)
    identity = store_identity(equipment, database, vehicles=vehicles, fleet="synthetic")
    store = SummaryStore(storage=open_storage(folder), identity=identity)
    write_identity(store.storage, identity)
    buckets = store.by_bucket(f"V{number:08d}" for number in range(vehicles))
    write = partial(_write_bucket, store=store, summaries=summaries, full_scale_a=database.layout.full_scale_a)
    for _ in shown(run_many(write, buckets.items(), Workers(processes=WORKERS)), "summaries", len(buckets), "buckets"):
        pass


def _write_bucket(
    bucket: tuple[int, Sequence[str]], *, store: SummaryStore, summaries: Sequence[VehicleSummary], full_scale_a: float
) -> None:
    """Write the vehicles of a bucket: they take the summaries in turn, each with faults of its own."""
    (number, names), K = bucket, len(store.identity.equipment.branches)
    settings, rng = FaultSettings(sparsity=80.0, balanced=True), np.random.default_rng(number)
    faults = settings.draw(rng, vehicles=len(names), branches=K, full_scale_a=full_scale_a)
    records = []
    for j, name in enumerate(names):
        found = _with_faults(replace(summaries[int(name[1:]) % len(summaries)], vehicle=name), faults.take(j))
        records.append(Record(vehicle=name, drives=found.drives, sources=("",), found=found))
    store.append(number, records)


def _with_faults(found: VehicleSummary, faults: Faults) -> VehicleSummary:
    """Return a vehicle's summary as measured with these faults, and without any zero-current window."""
    summary, unknown = found.summary, np.full(found.summary.branches, np.nan)
    gain = (1.0 + faults.drift) * (1.0 + faults.hardware_drift)
    own = np.arange(summary.branches) + summary.inputs
    change: Array = np.eye(summary.moments.shape[1])
    change[own, own] = gain
    change[own, -1] = (1.0 + faults.drift) * faults.hardware_offset_a + faults.offset_a
    moments, noise_a2 = change @ summary.moments @ change.T, summary.noise_a2 * gain**2
    return replace(
        found,
        summary=replace(summary, moments=moments, noise_a2=noise_a2, fit=None),
        zero_current=ZeroCurrent(offset_a=unknown, sd_a=unknown),
    )


def write_drives(folder: Path, drives: int, *, per_vehicle: int = 10) -> float:
    """Write so many drives of ten minutes, with frames at 10 and 20 Hz, into a store; return their total length. [h]"""
    database, rng, seconds = read_database(read_layout(LAYOUT)), np.random.default_rng(0), 0.0
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        fleet = simulated_fleet(Path(name) / "fleet", vehicles=DRIVES, minutes=DRIVE_MINUTES, currents=2)
        logs = sorted(fleet.glob("logs/*/*.log.gz"))
        base = [read_recording(log, database, vehicle="V", name="d").drive for log in logs]
    base = [replace(drive, branches=_thinned(drive.branches), inputs=_thinned(drive.inputs)) for drive in base]
    for number in range(drives):
        vehicle, trip = divmod(number, per_vehicle)
        like = base[(vehicle + trip) % len(base)]
        own = {
            name: replace(channel, value=channel.value + STEP_A * rng.integers(-1, 2, len(channel.value)))
            for name, channel in like.branches.items()
        }
        write_drive(folder, replace(like, vehicle=f"V{vehicle:06d}", name=f"d{trip}", branches=own), database.layout)
        seconds += like.duration_s
    return seconds / 3600.0


def _thinned(channels: Mapping[str, Channel]) -> dict[str, Channel]:
    """Keep every fifth sample of channels sent at 50 or 100 Hz, with time stamps of a logger that resolves 0.1 ms."""
    return {
        name: Channel(time_s=channel.time_s[::5].round(4), value=channel.value[::5], good=channel.good[::5])
        for name, channel in channels.items()
    }
