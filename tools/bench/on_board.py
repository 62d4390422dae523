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

from bench.ingest import LAYOUT
from bench.row import Row
from calibrator.artificial.simulate import FleetPlan, simulate_fleet
from calibrator.artificial.trips import BuiltinTrips
from calibrator.recordings.frames import read_frames
from calibrator.sources.fleet_source import find_fleet, probe_equipment
from calibrator.summaries.summarise_fleet import read_vehicle_summary
from ecu_node.bus.on_board_summary import OnBoardSummary
from ecu_node.core.signals import FrameKey
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout

__all__ = ["main", "rows"]


def main() -> None:
    """Print one line per row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=20.0)
    options = parser.parse_args()
    for row in rows(vehicles=options.vehicles, minutes=options.minutes):
        print(f"{row.name}: {row.value:.3g} {row.unit}")


def rows(*, vehicles: int, minutes: float) -> list[Row]:
    """Measure.

    Parameters
    ----------
    vehicles : int
        Of the fleet; below 8 none is calibrated.
    minutes : float
        Of each drive. [min]

    Returns
    -------
    list of Row
        Share of a core, size, and how much the parameters differ between both ways.
    """
    database = read_database(read_layout(LAYOUT))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        plan = FleetPlan(vehicles=vehicles, currents=3, sparsity=80.0, magnitude=(0.05, 0.25), delay_max_s=0.1)
        simulate_fleet(
            plan, BuiltinTrips(seed=0, duration_s=60.0 * minutes, unseen_s=60.0), database, folder / "fleet", workers=1
        )
        found = _replayed(folder, database)
        if vehicles >= 8:
            found += _compared(folder)
    return found


def _replayed(folder: Path, database: VehicleDatabase) -> list[Row]:
    """Cost of the summaries of all vehicles, with the delays that their logs tell."""
    fleet = find_fleet(folder / "fleet")
    equipment = probe_equipment(fleet, database, None)
    spent_s = driven_s = 0.0
    for vehicle, entries in fleet.vehicles.items():
        delays = read_vehicle_summary(entries, equipment, database).delays
        told = {
            name: (float(delay_s), float(sd_s) if known else None)
            for name, delay_s, sd_s, known in zip(
                delays.branches, delays.delay_s, delays.sd_s, delays.known, strict=True
            )
        }
        summary = OnBoardSummary(folder / "on_board", vehicle, database, delays=told, say=lambda _: None)
        frames = read_frames(Path(entries[0].place))
        messages = [
            (FrameKey(message.arbitration_id, message.is_extended_id), message.data, message.timestamp)
            for message in frames.messages()
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
    for name, source in (("of_logs", "fleet"), ("of_nodes", "on_board")):
        where = ["--layout", str(LAYOUT), "--out", str(folder / name)]
        command = [sys.executable, "-m", "calibrator", "calibrate", str(folder / source), *where, "--workers", "1"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    far, verdicts = [], 0
    for path in sorted((folder / "of_logs" / "params").glob("*.json")):
        one, other = (
            json.loads((folder / name / "params" / path.name).read_text()) for name in ("of_logs", "of_nodes")
        )
        verdicts += one["verdict"] != other["verdict"]
        for branch, values in one["branches"].items():
            for key, sd in (("drift", "drift_sd"), ("offset_a", "offset_sd_a")):
                if values[sd]:
                    far.append((values[key] - other["branches"][branch][key]) / values[sd])
    return [
        Row(name="difference of parameters, root mean square", value=float(np.std(far)), unit="standard deviations"),
        Row(name="vehicles with another verdict", value=verdicts, unit="vehicles"),
    ]


if __name__ == "__main__":
    main()
