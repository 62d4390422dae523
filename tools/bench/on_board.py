"""Cost of summaries made on board, measured with the frames of an artificial fleet's drives, 230 a second."""

import tempfile
import time
from pathlib import Path

from bench.fleets import simulated_fleet
from bench.row import LAYOUT, Row
from calibrator.recordings.log_formats import read_frames
from calibrator.sources.fleet_source import find_fleet, probe_equipment
from calibrator.summaries.summarise_fleet import read_vehicle_summary
from ecu_node.bus.on_board_summary import OnBoardSummary
from ecu_node.core.signals import FrameKey
from ecu_node.database import read_database
from ecu_node.layout import read_layout

__all__ = ["rows"]


def rows(*, quick: bool) -> list[Row]:
    """Measure the share of a processor core that summaries take, and their size."""
    vehicles, minutes = (1, 10.0) if quick else (2, 60.0)
    with tempfile.TemporaryDirectory() as place:
        simulated_fleet(Path(place) / "fleet", vehicles=vehicles, minutes=minutes)
        return _replayed(Path(place))


def _replayed(folder: Path) -> list[Row]:
    """Return the cost of the summaries of all vehicles, made with the delays that their logs show."""
    database, fleet = read_database(read_layout(LAYOUT)), find_fleet(folder / "fleet")
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
