"""Whole calibrations from summaries on disk: time and memory over the size of the fleet, and going on after a kill.

Every run is the command that a user types, watched from outside: its processes' memory, and when its chunks appear.
"""

import argparse
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.row import Row
from bench.synthetic_store import LAYOUT, make_store
from calibrator.artificial.simulate import FleetPlan, draw_vehicles, simulate_fleet, trip_of, vehicle_drive
from calibrator.artificial.trips import BuiltinTrips
from calibrator.drive import Drive
from calibrator.drives.store import write_drive
from ecu_node.database import read_database
from ecu_node.layout import read_layout

__all__ = ["resident_bytes", "rows"]

FLEETS = (1_000, 10_000, 100_000)
QUICK_FLEETS = (500, 1_000)
KILLED_FLEET, KILLS = 2_000, 20
QUICK_KILLED_FLEET, QUICK_KILLS = 500, 2
DRIVE_S, TRIPS = 600.0, 20
"""Length of a drive [s], and how many different ones there are; noise makes each its own."""
WORKERS = 2
"""Processes that make fleets and calibrate them. The time per vehicle is that of one process: of several, the later
ones are still starting while the first one is done with a small fleet."""
WATCH_EVERY_S, WATCHED_SHARE = 0.02, 0.05
"""Least time between two looks at a run, and the largest share of the time that is spent on them. [s], [1]"""
MEBIBYTE = 1024.0**2


@dataclass(frozen=True, kw_only=True)
class Watched:
    """What was seen of one run.

    Attributes
    ----------
    whole_s : float
        From start to end. [s]
    steady_s : float
        From when half of the chunks were written to the last one: all has been loaded by then. [s]
    share : float
        Of the chunks that came within that time. [1]
    peak_bytes : float
        Largest sum of the resident memory of its processes. [byte]
    """

    whole_s: float
    steady_s: float
    share: float
    peak_bytes: float


def rows(*, quick: bool) -> list[Row]:
    """Measure.

    Parameters
    ----------
    quick : bool
        Small fleets, few kills.

    Returns
    -------
    list of Row
        Per fleet size the time per vehicle once the reference is known (in one process), that of the whole run, and the
        peak memory, against those of the smallest fleet; and how many of the killed runs gave the same result.
    """
    found: list[Row] = []
    first: tuple[float, float] | None = None
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        for vehicles in QUICK_FLEETS if quick else FLEETS:
            seen, per_vehicle_s = measure(Path(name), vehicles)
            first = first or (per_vehicle_s, seen.peak_bytes)
            peer = None if first == (per_vehicle_s, seen.peak_bytes) else "the smallest fleet"
            label = f"{vehicles} vehicles from summaries"
            found += [
                Row(
                    name=f"{label}, per vehicle once the reference is known",
                    value=1e3 * per_vehicle_s,
                    unit="ms",
                    peer=peer,
                    ratio=first[0] / per_vehicle_s if peer else None,
                ),
                Row(name=f"{label}, whole run", value=seen.whole_s, unit="s"),
                Row(
                    name=f"{label}, peak memory of all processes",
                    value=seen.peak_bytes / MEBIBYTE,
                    unit="MiB",
                    peer=peer,
                    ratio=first[1] / seen.peak_bytes if peer else None,
                ),
            ]
        vehicles, kills = (QUICK_KILLED_FLEET, QUICK_KILLS) if quick else (KILLED_FLEET, KILLS)
        same = killed_runs(Path(name), vehicles, kills)
    return [
        *found,
        Row(name=f"runs killed at random moments with the identical result, of {kills}", value=same, unit="1"),
    ]


def measure(folder: Path, vehicles: int) -> tuple[Watched, float]:
    """What was seen of a run, and of one in one process the time per vehicle in its later half. [s]"""
    store, out = folder / f"store-{vehicles}", folder / f"result-{vehicles}"
    make_store(store, vehicles=vehicles, workers=WORKERS)
    seen = watch(store, out, workers=WORKERS)
    shutil.rmtree(out)
    alone = watch(store, out, workers=1)
    shutil.rmtree(out)
    shutil.rmtree(store)
    return seen, alone.steady_s / (alone.share * vehicles)


def watch(store: Path, out: Path, *, workers: int) -> Watched:
    """Calibrate, and look at it from outside."""
    chunks = out.with_name(f".{out.name}.unfinished") / "chunks"
    total = len(list((store / "buckets").iterdir()))
    start = time.monotonic()
    written_s: dict[str, float] = {}
    peak = 0.0
    with subprocess.Popen(_command(store, out, workers), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as run:
        while run.poll() is None:
            look_s = time.monotonic()
            peak = max(peak, resident_bytes(run.pid))
            if len(written_s) < total:
                with contextlib.suppress(FileNotFoundError):  # the result is there, and the chunks are gone
                    written_s |= {chunk.name: chunk.stat().st_mtime for chunk in chunks.glob("*.rows.parquet")}
            time.sleep(max(WATCH_EVERY_S, (time.monotonic() - look_s) / WATCHED_SHARE))
        whole_s = time.monotonic() - start
        assert run.stderr is not None
        errors = run.stderr.read().decode()
    if run.returncode:
        raise RuntimeError(errors)
    later_s = sorted(written_s.values())[total // 2 - 1 :]
    return Watched(
        whole_s=whole_s, steady_s=later_s[-1] - later_s[0], share=(len(later_s) - 1) / total, peak_bytes=peak
    )


def _command(given: Path, out: Path, workers: int, command: str = "calibrate") -> list[str]:
    options = ["--layout", str(LAYOUT), "--out", str(out), "--workers", str(workers)]
    return [sys.executable, "-m", "calibrator", command, str(given), *options]


def resident_bytes(process: int) -> float:
    """Resident memory of a process and all that descend from it; what processes share is counted in each. [byte]"""
    parents: dict[int, int] = {}
    resident: dict[int, float] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                pages = int((entry / "statm").read_text().split()[1])
            except (OSError, IndexError):
                continue
            parents[int(entry.name)], resident[int(entry.name)] = int(fields[1]), pages * os.sysconf("SC_PAGE_SIZE")
    family = {process}
    while more := {child for child, parent in parents.items() if parent in family} - family:
        family |= more
    return sum(resident.get(member, 0.0) for member in family)


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
    if command == "calibrate":
        given = folder / "store-killed"
        make_store(given, vehicles=vehicles, workers=WORKERS)
    else:
        plan = FleetPlan(vehicles=vehicles, currents=2, sparsity=80.0, magnitude=(0.05, 0.25))
        trips = BuiltinTrips(seed=0, duration_s=DRIVE_S, unseen_s=60.0)
        simulate_fleet(plan, trips, read_database(read_layout(LAYOUT)), folder / "fleet", workers=WORKERS)
        given = folder / "fleet" / "logs"
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}

    def run(out: Path) -> list[str]:
        return _command(given, out, WORKERS, command)

    start = time.monotonic()
    subprocess.run(run(folder / "whole"), check=True, capture_output=True, env=environment)
    whole_s = time.monotonic() - start
    expected, chance = _contents(folder / "whole"), random.Random(0)  # noqa: S311 (moments, no secrets)
    same = 0
    for number in range(kills):
        out = folder / f"killed-{number}"
        with subprocess.Popen(
            run(out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment, process_group=0
        ) as killed:
            try:
                killed.wait(chance.uniform(0.0, whole_s))
            except subprocess.TimeoutExpired:
                os.killpg(killed.pid, signal.SIGKILL)
        if command != "calibrate" or not out.exists():
            subprocess.run(run(out), check=True, capture_output=True, env=environment)
        same += _contents(out) == expected
        shutil.rmtree(out)
    return same


def read_fleet(folder: Path, drives: int, *, per_vehicle: int = 10) -> tuple[Watched, Watched, float]:
    """Summarise drives of ten minutes at 10 Hz and calibrate their vehicles.

    Parameters
    ----------
    folder : Path
        An empty one.
    drives, per_vehicle : int
        Number of drives, and how many each vehicle has.

    Returns
    -------
    reading, calibrating : Watched
        What was seen of the two commands.
    hours : float
        Of driving. [h]
    """
    database = read_database(read_layout(LAYOUT))
    trips, seconds = BuiltinTrips(seed=0, duration_s=DRIVE_S, unseen_s=60.0), 0.0
    rng = np.random.default_rng(0)
    plan = FleetPlan(vehicles=-(-drives // per_vehicle), currents=2, sparsity=80.0, magnitude=(0.05, 0.25))
    base: list[Drive] = []
    for number, vehicle in enumerate(draw_vehicles(plan, database.layout, ("battery", "motor"))):
        for trip in range(per_vehicle):
            if len(base) < TRIPS:
                truth = trip_of(trips, vehicle, len(base), "calibration", database.layout)
                base.append(vehicle_drive(rng, database, vehicle, truth))
            like = base[(number + trip) % len(base)]
            noisy = {
                name: replace(channel, value=channel.value + rng.normal(scale=0.1, size=len(channel.value)))
                for name, channel in like.branches.items()
            }
            write_drive(folder / "fleet", replace(like, vehicle=vehicle.name, name=f"d{trip}", branches=noisy),
                        database.layout)  # fmt: skip
            seconds += like.duration_s
    reading = _watched(_command(folder / "fleet", folder / "store", WORKERS, "summarise"))
    calibrating = _watched(_command(folder / "store", folder / "result", WORKERS))
    return reading, calibrating, seconds / 3600.0


def _watched(command: Sequence[str]) -> Watched:
    """Run a command, and look at its memory."""
    start, peak = time.monotonic(), 0.0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as run:
        while run.poll() is None:
            peak = max(peak, resident_bytes(run.pid))
            time.sleep(0.5)
        assert run.stderr is not None
        if run.returncode:
            raise RuntimeError(run.stderr.read().decode())
    return Watched(whole_s=time.monotonic() - start, steady_s=0.0, share=0.0, peak_bytes=peak)


def _contents(result: Path) -> dict[str, bytes]:
    files: Sequence[Path] = [path for path in sorted(result.rglob("*")) if path.is_file()]
    return {str(path.relative_to(result)): path.read_bytes() for path in files}


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
        if arguments.kill:
            same = killed_runs(folder, arguments.vehicles, arguments.kills, arguments.kill)
            print(f"{arguments.kill}: {same} of {arguments.kills} killed runs gave the identical result")
            return
        if arguments.drives:
            reading, seen, hours = read_fleet(folder, arguments.drives)
            print(
                f"{arguments.drives} drives, {hours:.0f} h: summarised in {reading.whole_s:.0f} s, "
                f"{reading.peak_bytes / MEBIBYTE:.0f} MiB; calibrated in {seen.whole_s:.0f} s, "
                f"{seen.peak_bytes / MEBIBYTE:.0f} MiB"
            )
            return
        store = folder / f"store-{arguments.vehicles}"
        if not store.exists():
            make_store(store, vehicles=arguments.vehicles, workers=WORKERS)
        seen = watch(store, folder / f"result-{arguments.vehicles}", workers=WORKERS)
    print(f"{arguments.vehicles} vehicles: {seen.whole_s:.0f} s, {seen.peak_bytes / MEBIBYTE:.0f} MiB")


if __name__ == "__main__":
    main()
