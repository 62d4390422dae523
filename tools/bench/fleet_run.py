"""Whole calibrations from summaries on disk: time and memory over the size of the fleet.

    python -m bench.fleet_run --vehicles 1000000          (in tools/)

Every run is the command that a user types, and its processes' memory is watched from outside.
"""

import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import psutil
import typer

from bench.fleets import WORKERS, calibrator, make_store, simulated_fleet, write_drives
from bench.row import LAYOUT, MEBIBYTE, Row

__all__ = ["calibrated", "resident_bytes", "rows"]

FLEETS, QUICK_FLEETS = (1_000, 10_000, 100_000), (500, 1_000)
WATCH_EVERY_S = 0.2


def rows(*, quick: bool) -> list[Row]:
    """Measure a run from logs, and time and peak memory of runs from summaries, compared with the smallest fleet."""
    logs, minutes = (6, 2.0) if quick else (60, 10.0)
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        simulated_fleet(Path(name) / "fleet", vehicles=logs, minutes=minutes)
        seconds, _ = calibrated(Path(name) / "fleet", Path(name) / "result")
    found = [Row(name=f"{logs} logs of {minutes:.0f} minutes, three branches, to parameters", value=seconds, unit="s")]
    first = 0.0
    for vehicles in QUICK_FLEETS if quick else FLEETS:
        with tempfile.TemporaryDirectory(prefix="bench-") as name:
            make_store(Path(name) / "store", vehicles=vehicles)
            seconds, peak = calibrated(Path(name) / "store", Path(name) / "result")
        peer, ratio = ("the smallest fleet", first / peak) if first else (None, None)
        first, label = first or peak, f"{vehicles} vehicles from summaries"
        what = f"{label}, peak memory of all processes"
        found += [
            Row(name=f"{label}, whole run", value=seconds, unit="s"),
            Row(name=what, value=peak / MEBIBYTE, unit="MiB", peer=peer, ratio=ratio),
        ]
    return found


def calibrated(given: Path, out: Path, command: str = "calibrate") -> tuple[float, float]:
    """Run a command of the calibrator; return its duration [s] and the peak resident memory of its processes [byte]."""
    words = calibrator(command, given, "--layout", LAYOUT, "--workers", WORKERS, "--out", out)
    start_s, peak = time.monotonic(), 0.0
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as run:
        while run.poll() is None:
            peak = max(peak, resident_bytes(run.pid))
            time.sleep(WATCH_EVERY_S)
        assert run.stderr is not None
        if run.returncode:
            raise RuntimeError(run.stderr.read().decode())
    return time.monotonic() - start_s, peak


def resident_bytes(process: int) -> float:
    """Return the resident memory of a process and its descendants; a page that several share counts once. [byte]"""
    kibibytes = 0
    with suppress(psutil.NoSuchProcess):
        root = psutil.Process(process)
        for member in (root, *root.children(recursive=True)):
            with suppress(OSError):
                text = Path(f"/proc/{member.pid}/smaps_rollup").read_text()
                kibibytes += int(text.partition("\nPss:")[2].split()[0])
    return 1024.0 * kibibytes


def main(*, vehicles: int = 1_000_000, drives: int = 0) -> None:
    """Calibrate so many vehicles from summaries; or, if `drives` is not 0, from so many drives, ten of each vehicle."""
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        place, store = Path(name), Path(name) / "store"
        if drives:
            hours = write_drives(place / "fleet", drives)
            seconds, peak = calibrated(place / "fleet", store, "summarise")
            print(f"{drives} drives, {hours:.0f} h, summarised: {seconds:.0f} s, {peak / MEBIBYTE:.0f} MiB")
        else:
            make_store(store, vehicles=vehicles)
        seconds, peak = calibrated(store, place / "result")
    print(f"calibrated: {seconds:.0f} s, {peak / MEBIBYTE:.0f} MiB")


if __name__ == "__main__":
    typer.run(main)
