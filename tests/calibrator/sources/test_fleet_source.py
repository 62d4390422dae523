from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Channel, Drive
from calibrator.drives.store import write_drive
from calibrator.errors import FleetError
from calibrator.sources.fleet_source import find_fleet, probe_equipment
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError

INPUTS = ("voltage", "torque", "speed")


def channel() -> Channel:
    return Channel(time_s=np.arange(100) * 0.1, value=np.ones(100), good=np.full(100, True))


@pytest.fixture
def store(database: VehicleDatabase, tmp_path: Path) -> Path:
    """One vehicle with battery, motor and auxiliary."""
    branches = {name: channel() for name in ("battery", "motor", "auxiliary")}
    drive = Drive(vehicle="V", name="d", branches=branches, inputs={name: channel() for name in INPUTS})
    write_drive(tmp_path, drive, database.layout)
    return tmp_path


@pytest.mark.parametrize(
    ("branches", "beside"),
    [
        (None, []),
        (["battery", "motor"], ["branches recorded but not asked for, missing from the junction sum: auxiliary"]),
    ],
)
def test_branches_that_were_not_recorded_or_not_asked_for_are_named(
    store: Path, database: VehicleDatabase, branches: list[str] | None, beside: list[str]
) -> None:
    notices = [n for n in probe_equipment(find_fleet(store), database, branches).notices if n.startswith("branches")]
    assert notices == ["branches not recorded, taken as not fitted: dcdc, motor_rear", *beside]


@pytest.mark.parametrize(
    ("branches", "words"),
    [
        (["battery", "battery"], "branch battery is asked for twice; name each branch once"),
        (["pack", "battery"], "no branch 'pack'; known are battery, motor"),
    ],
)
def test_branches_that_cannot_be_asked_for_are_refused(
    store: Path, database: VehicleDatabase, branches: list[str], words: str
) -> None:
    with pytest.raises((FleetError, LayoutError), match=words):
        probe_equipment(find_fleet(store), database, branches)
