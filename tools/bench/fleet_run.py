"""Whole calibrations from summaries on disk: time and memory over the size of the fleet, and going on after a kill.

    python -m bench.fleet_run --vehicles 1000000          (in tools/)

Every run is the command that a user types, and its processes' memory is watched from outside. The summaries are those
of an artificial fleet, made without any drive being read: some trips of the built-in vehicle are recorded without
faults and summarised, and every vehicle takes one of them. What its faults do to the currents, (11) and (13) of the
paper, is linear, so it is done to the moments.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import psutil

from bench.row import LAYOUT, MEBIBYTE, Row
from calibrator.artificial.random_fleet import FaultSettings
from calibrator.artificial.simulate import FleetPlan, draw_vehicles, simulate_fleet, trip_of, vehicle_drive
from calibrator.artificial.trips import BuiltinTrips
from calibrator.drive import Array, Channel, Drive, Equipment
from calibrator.drives.delays import BranchDelays
from calibrator.drives.store import write_drive
from calibrator.experiments.recorded_trips import RecordedCase, builtin_fleet, record_vehicles
from calibrator.faults import Faults
from calibrator.files.storage import open_storage
from calibrator.processes.run_many import Workers, run_many
from calibrator.summaries.identity import store_identity, write_identity
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.record import Record
from calibrator.summaries.summariser import summarise_samples
from calibrator.summaries.summary_store import SummaryStore
from calibrator.summaries.vehicle_summary import VehicleSummary, ZeroCurrent
from calibrator.terminal.progress import shown
from ecu_node.database import read_database
from ecu_node.layout import read_layout

__all__ = ["calibrate", "make_store", "resident_bytes", "rows", "watched"]

FLEETS, QUICK_FLEETS = (1_000, 10_000, 100_000), (500, 1_000)
KILLED_FLEET, KILLS = 2_000, 20
QUICK_KILLED_FLEET, QUICK_KILLS = 500, 2
TRIPS, MINUTES = 64, 6.0
"""Different trips of the summaries, and their least length. [min]"""
BRANCHES, SPARSITY = ("battery", "motor"), 80.0
"""Of the fleets; faults are drawn as in the paper. [%]"""
DRIVES, DRIVE_S, STEP_A = 20, 600.0, 0.1
"""Different drives that are read, their length [s], and the step of the noise that makes each its own [A]."""
WORKERS = 2
"""Processes that make fleets and calibrate them."""
WATCH_EVERY_S = 0.2


def rows(*, quick: bool) -> list[Row]:
    """Measure.

    Parameters
    ----------
    quick : bool
        Small fleets, few kills.

    Returns
    -------
    list of Row
        Per fleet size the time and the peak memory of a run, against those of the smallest fleet; and how many of the
        killed runs gave the same result.
    """
    found, first = list[Row](), 0.0
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        folder = Path(name)
        for vehicles in QUICK_FLEETS if quick else FLEETS:
            make_store(folder / "store", vehicles=vehicles)
            seconds, peak = watched(calibrate(folder / "store", folder / "result"))
            for made in ("store", "result"):
                shutil.rmtree(folder / made)
            peer, ratio = ("the smallest fleet", first / peak) if first else (None, None)
            first, label = first or peak, f"{vehicles} vehicles from summaries"
            what = f"{label}, peak memory of all processes"
            found += [
                Row(name=f"{label}, whole run", value=seconds, unit="s"),
                Row(name=what, value=peak / MEBIBYTE, unit="MiB", peer=peer, ratio=ratio),
            ]
        vehicles, kills = (QUICK_KILLED_FLEET, QUICK_KILLS) if quick else (KILLED_FLEET, KILLS)
        same = killed_runs(folder, vehicles, kills)
    return [
        *found,
        Row(name=f"runs killed at random moments with the identical result, of {kills}", value=same, unit="1"),
    ]


def calibrate(given: Path, out: Path, command: str = "calibrate") -> list[str]:
    """Command line of a calibration, or of what comes before it."""
    options = ("--layout", str(LAYOUT), "--out", str(out), "--workers", str(WORKERS))
    return [sys.executable, "-m", "calibrator", command, str(given), *options]


def watched(command: Sequence[str]) -> tuple[float, float]:
    """Run a command: its time [s], and the largest resident memory of its processes [byte]."""
    start_s, peak = time.monotonic(), 0.0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as run:
        while run.poll() is None:
            peak = max(peak, resident_bytes(run.pid))
            time.sleep(WATCH_EVERY_S)
        assert run.stderr is not None
        if run.returncode:
            raise RuntimeError(run.stderr.read().decode())
    return time.monotonic() - start_s, peak


def resident_bytes(process: int) -> float:
    """Resident memory of a process and all that descend from it; a page that several share counts once. [byte]"""
    kibibytes = 0
    with suppress(psutil.NoSuchProcess):
        root = psutil.Process(process)
        for member in (root, *root.children(recursive=True)):
            with suppress(OSError):
                text = Path(f"/proc/{member.pid}/smaps_rollup").read_text()
                kibibytes += int(text.partition("\nPss:")[2].split()[0])
    return 1024.0 * kibibytes


def killed_runs(folder: Path, vehicles: int, kills: int, command: str = "calibrate") -> int:
    """Kill runs at random moments, finish each with a second one, and count the results that are identical.

    Parameters
    ----------
    folder : Path
        An empty one.
    vehicles, kills : int
        Of the fleet; how many runs are killed.
    command : str
        ``import``, ``summarise`` or ``calibrate``.
    """
    given = folder / "given"
    if command == "calibrate":
        make_store(given, vehicles=vehicles)
    else:
        plan = FleetPlan(vehicles=vehicles, currents=len(BRANCHES), sparsity=SPARSITY)
        trips = BuiltinTrips(seed=0, duration_s=DRIVE_S, unseen_s=60.0)
        simulate_fleet(plan, trips, read_database(read_layout(LAYOUT)), given, workers=WORKERS)
        given /= "logs"
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}

    def run(out: Path, limit_s: float | None = None) -> float:
        """Run to the end, or for so long, and return the time. [s]"""
        start_s, quiet = time.monotonic(), subprocess.DEVNULL
        words = calibrate(given, out, command)
        with subprocess.Popen(words, stdout=quiet, stderr=quiet, env=environment, process_group=0) as process:
            try:
                if process.wait(limit_s):
                    raise RuntimeError(f"calibrator {command} ended with {process.returncode}")
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
        return time.monotonic() - start_s

    whole_s, chance, same = run(folder / "whole"), random.Random(0), 0
    for _ in range(kills):
        out = folder / "killed"
        run(out, chance.uniform(0.0, whole_s))
        if command != "calibrate" or not out.exists():
            run(out)
        same += _contents(out) == _contents(folder / "whole")
        shutil.rmtree(out)
    return same


def _contents(result: Path) -> dict[str, bytes]:
    return {str(path.relative_to(result)): path.read_bytes() for path in result.rglob("*") if path.is_file()}


def make_store(folder: Path, *, vehicles: int, branches: int = 2) -> None:
    """Write a store of summaries of so many vehicles with known kinds of faults."""
    database, K = read_database(read_layout(LAYOUT)), branches
    fleet = builtin_fleet(database, trips=TRIPS, duration_s=60.0 * MINUTES)
    case = RecordedCase(branches=K, sparsity=100.0)
    inputs = database.layout.fleet_inputs or database.layout.model_inputs
    recorded = record_vehicles(fleet, case, fleet.with_branches(K), 0).samples
    trips = [summarise_samples([item.with_inputs(inputs)], period_s=fleet.period_s) for item in recorded]
    fleet_inputs = recorded[0].with_inputs(inputs).input_names
    equipment = Equipment(
        branches=recorded[0].branch_names,
        inputs=tuple(database.layout.model_inputs),
        fleet_inputs=fleet_inputs,
        notices=(),
    )
    identity = store_identity(equipment, database, vehicles=vehicles, fleet="synthetic", fleet_ids=frozenset())
    store = SummaryStore(storage=open_storage(folder), identity=identity)
    write_identity(store.storage, identity)
    buckets = store.by_bucket(f"V{number:08d}" for number in range(vehicles))
    write = partial(_write, store=store, trips=trips, full_scale_a=database.layout.full_scale_a)
    for _ in shown(run_many(write, buckets.items(), Workers(processes=WORKERS)), "summaries", len(buckets), "buckets"):
        pass


def _write(
    bucket: tuple[int, Sequence[str]], *, store: SummaryStore, trips: Sequence[DriveSummary], full_scale_a: float
) -> None:
    (number, names), branches = bucket, store.identity.branches
    K = len(branches)
    settings, rng = FaultSettings(sparsity=SPARSITY, balanced=True), np.random.default_rng(number)
    faults = settings.draw(rng, vehicles=len(names), branches=K, full_scale_a=full_scale_a)
    zero, unknown = np.zeros(K), np.full(K, np.nan)
    records = {}
    for j, name in enumerate(names):
        found = VehicleSummary(
            vehicle=name,
            drives=("trip",),
            summary=_measured(trips[int(name[1:]) % len(trips)], faults.take(j)),
            delays=BranchDelays(branches=branches, delay_s=zero, sd_s=zero, known=np.ones(K, bool)),
            zero_current=ZeroCurrent(offset_a=unknown, sd_a=unknown),
        )
        records[name] = [Record(vehicle=name, drives=("trip",), sources=("",), found=found)]
    store.append(number, records)


def _measured(trip: DriveSummary, faults: Faults) -> DriveSummary:
    """The trip's summary as a vehicle with these faults measures it."""
    gain, own = (1.0 + faults.drift) * (1.0 + faults.hardware_drift), np.arange(trip.branches) + trip.inputs
    change: Array = np.eye(trip.moments.shape[1])
    change[own, own] = gain
    change[own, -1] = (1.0 + faults.drift) * faults.hardware_offset_a + faults.offset_a
    return replace(trip, moments=change @ trip.moments @ change.T, noise_a2=trip.noise_a2 * gain**2, fit=None)


def _thinned(channels: Mapping[str, Channel]) -> dict[str, Channel]:
    """Every fifth sample of channels, which are sent at 50 or 100 Hz, with the time stamps of a logger of 0.1 ms."""
    return {
        name: Channel(time_s=channel.time_s[::5].round(4), value=channel.value[::5], good=channel.good[::5])
        for name, channel in channels.items()
    }


def write_drives(folder: Path, drives: int, *, per_vehicle: int = 10) -> float:
    """Write drives of ten minutes with frames at 10 and 20 Hz into a store; how long they are together. [h]"""
    database, rng, seconds = read_database(read_layout(LAYOUT)), np.random.default_rng(0), 0.0
    trips = BuiltinTrips(seed=0, duration_s=DRIVE_S, unseen_s=60.0)
    plan = FleetPlan(vehicles=-(-drives // per_vehicle), currents=len(BRANCHES), sparsity=SPARSITY)
    base: list[Drive] = []
    for number, vehicle in enumerate(draw_vehicles(plan, database.layout, BRANCHES)):
        for trip in range(per_vehicle):
            if len(base) < DRIVES:
                truth = trip_of(trips, vehicle, len(base), "calibration", database.layout)
                drive = vehicle_drive(rng, database, vehicle, truth)
                base.append(replace(drive, branches=_thinned(drive.branches), inputs=_thinned(drive.inputs)))
            like = base[(number + trip) % len(base)]
            own = {
                name: replace(channel, value=channel.value + STEP_A * rng.integers(-1, 2, len(channel.value)))
                for name, channel in like.branches.items()
            }
            drive = replace(like, vehicle=vehicle.name, name=f"d{trip}", branches=own)
            write_drive(folder, drive, database.layout)
            seconds += drive.duration_s
    return seconds / 3600.0


def main() -> None:
    """Calibrate one fleet of a given size and print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--vehicles", type=int, default=1_000_000)
    parser.add_argument("--folder", type=Path, help="where store and result are put, and stay; else a temporary one")
    parser.add_argument("--drives", type=int, help="read so many drives of ten minutes, ten of each vehicle, first")
    parser.add_argument("--kill", choices=["import", "summarise", "calibrate"], help="kill this command instead")
    parser.add_argument("--kills", type=int, default=KILLS)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        folder = arguments.folder or Path(name)
        store = folder / "store"
        if arguments.kill:
            same = killed_runs(folder, arguments.vehicles, arguments.kills, arguments.kill)
            print(f"{arguments.kill}: {same} of {arguments.kills} killed runs gave the identical result")
            return
        if arguments.drives:
            hours = write_drives(folder / "fleet", arguments.drives)
            seconds, peak = watched(calibrate(folder / "fleet", store, "summarise"))
            print(f"{arguments.drives} drives, {hours:.0f} h, summarised: {seconds:.0f} s, {peak / MEBIBYTE:.0f} MiB")
        elif not store.exists():
            make_store(store, vehicles=arguments.vehicles)
        seconds, peak = watched(calibrate(store, folder / "result"))
    print(f"calibrated: {seconds:.0f} s, {peak / MEBIBYTE:.0f} MiB")


if __name__ == "__main__":
    from bench import fleet_run  # processes of run_many find its functions by this name

    fleet_run.main()
