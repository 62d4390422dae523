"""What a node's own summaries cost, and what the calibrator makes of them beside the logs of the same drives.

The drives of an artificial fleet, 230 frames a second, are read as logs and replayed to the node's summary; both stores
are calibrated. ``python -m bench.on_board --vehicles 24 --minutes 60`` prints the figures that the documents name.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.row import LAYOUT, Row, show
from calibrator.artificial.simulate import FleetPlan, simulate_fleet
from calibrator.artificial.trips import BuiltinTrips
from calibrator.recordings.frames import read_frames
from calibrator.sources.fleet_source import find_fleet, probe_equipment
from calibrator.summaries.summarise_fleet import read_vehicle_summary
from ecu_node.bus.on_board_summary import OnBoardSummary
from ecu_node.core.signals import FrameKey
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout

__all__ = ["rows"]

FEWEST = 8
"""Vehicles that are calibrated."""


def rows(*, vehicles: int, minutes: float) -> list[Row]:
    """Measure share of a core and size, and how much the parameters of the two ways differ.

    Parameters
    ----------
    vehicles : int
        Of the fleet; below 8 none is calibrated.
    minutes : float
        Of each drive. [min]
    """
    database, trips = read_database(read_layout(LAYOUT)), BuiltinTrips(seed=0, duration_s=60 * minutes, unseen_s=60.0)
    plan = FleetPlan(vehicles=vehicles, currents=3, sparsity=80.0, magnitude=(0.05, 0.25), delay_max_s=0.1)
    with tempfile.TemporaryDirectory() as place:
        simulate_fleet(plan, trips, database, Path(place) / "fleet", workers=1)
        found = _replayed(Path(place), database)
        return found + _compared(Path(place)) if vehicles >= FEWEST else found


def _replayed(folder: Path, database: VehicleDatabase) -> list[Row]:
    """Cost of the summaries of all vehicles, with the delays that their logs tell."""
    fleet = find_fleet(folder / "fleet")
    equipment = probe_equipment(fleet, database, None)
    spent_s = driven_s = 0.0
    for vehicle, entries in fleet.vehicles.items():
        delays = read_vehicle_summary(entries, equipment, database).delays
        rows = zip(delays.branches, delays.delay_s, delays.sd_s, delays.known, strict=True)
        told = {name: (float(delay_s), float(sd_s) if known else None) for name, delay_s, sd_s, known in rows}
        summary = OnBoardSummary(folder / "on_board", vehicle, database, delays=told, say=lambda _: None)
        frames = read_frames(Path(entries[0].place))
        messages = [
            (FrameKey(item.arbitration_id, item.is_extended_id), item.data, item.timestamp)
            for item in frames.messages()
        ]
        started_s = time.process_time()
        for number, message in enumerate(messages):
            summary.take(*message)
            if number % 5 == 0:
                summary.look(0.0)
        summary.close()
        spent_s += time.process_time() - started_s
        driven_s += float(frames.time_s[-1])
    size = sum(path.stat().st_size for path in (folder / "on_board").rglob("*.summary"))
    return [
        Row(name="on-board summary, share of a core", value=100.0 * spent_s / driven_s, unit="%"),
        Row(name="on-board summary, size", value=3.6 * size / driven_s, unit="kB per hour"),
    ]


def _compared(folder: Path) -> list[Row]:
    """Differences of the drifts and offsets between both ways, over their standard deviations."""
    found = []
    for name, source in (("of_logs", "fleet"), ("of_nodes", "on_board")):
        words = ("calibrate", folder / source, "--layout", LAYOUT, "--out", folder / name, "--workers", "1")
        subprocess.run([sys.executable, "-m", "calibrator", *words], check=True, stdout=subprocess.DEVNULL)
        files = sorted((folder / name / "params").glob("*.json"))
        found.append([json.loads(path.read_text()) for path in files])
    far = [
        (values[key] - other["branches"][branch][key]) / values[sd]
        for one, other in zip(*found, strict=True)
        for branch, values in one["branches"].items()
        for key, sd in (("drift", "drift_sd"), ("offset_a", "offset_sd_a"))
        if values[sd]
    ]
    verdicts = sum(one["verdict"] != other["verdict"] for one, other in zip(*found, strict=True))
    return [
        Row(name="difference of parameters, root mean square", value=float(np.std(far)), unit="standard deviations"),
        Row(name="vehicles with another verdict", value=verdicts, unit="vehicles"),
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=20.0)
    show(rows(**vars(parser.parse_args())))
