"""One vehicle with impossible values is refused by name, before anything is computed from them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Channel, Drive, Equipment
from calibrator.drives.store import write_drive
from calibrator.errors import DriveError
from calibrator.sources.fleet_source import find_fleet
from calibrator.summaries.summarise_fleet import read_vehicle_summary
from ecu_node.database import VehicleDatabase

EQUIPMENT = Equipment(branches=("battery", "motor"), inputs=("speed",), fleet_inputs=("speed",), notices=())


def channel(value: float, place: float = 0.0) -> Channel:
    values = np.sin(0.01 * np.arange(5000)) * 100.0
    values[100] = value if value else place
    return Channel(time_s=0.1 * np.arange(5000), value=values, good=np.ones(5000, bool))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("motor", 1e12, r"drive d: branch motor shows 1e\+12 A, full scale of the junction being 400 A"),
        ("motor", np.nan, r"drive d: branch motor shows nan A"),
        ("battery", -np.inf, r"drive d: branch battery shows inf A"),
        ("speed", np.nan, r"drive d: input speed has values that are no numbers"),
    ],
)
def test_impossible_values_are_named(
    tmp_path: Path, database: VehicleDatabase, name: str, value: float, message: str
) -> None:
    channels = {key: channel(value if key == name else 0.0) for key in ("battery", "motor", "speed")}
    drive = Drive(
        vehicle="V1",
        name="d",
        branches={key: channels[key] for key in ("battery", "motor")},
        inputs={"speed": channels["speed"]},
    )
    write_drive(tmp_path, drive, database.layout)
    fleet = find_fleet(tmp_path)
    with pytest.raises(DriveError, match=message):
        read_vehicle_summary(fleet.vehicles["V1"], replace(EQUIPMENT), database)
