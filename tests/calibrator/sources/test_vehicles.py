import os
import signal
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pytest

from calibrator.drive import DriveFile
from calibrator.errors import DriveError, FleetError
from calibrator.sources.fleet_source import Equipment, FleetSource
from calibrator.sources.vehicles import ReadVehicle, read_each, read_vehicles
from ecu_node.database import VehicleDatabase

EQUIPMENT = Equipment(branches=("battery", "motor"), inputs=("speed",), fleet_inputs=("speed",), notices=())


def fleet_of(folder: Path, names: Sequence[str]) -> FleetSource:
    vehicles = {name: (DriveFile(vehicle=name, name="d", path=folder / f"{name}.parquet"),) for name in names}
    return FleetSource(path=folder, vehicles=vehicles, left_out={})


def name_of(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> str:
    return f"{entries[0].vehicle} with {', '.join(equipment.branches)} of {database.layout.name}"


def endless(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase, *, path: Path) -> str:
    return path.read_text()


def dying(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> str:
    os.kill(os.getpid(), signal.SIGKILL)
    return ""


def refusing(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> str:
    raise DriveError(f"{entries[0].vehicle}: too short")


@pytest.mark.parametrize("workers", [1, 2])
def test_a_vehicle_that_hangs_or_kills_its_reader_costs_itself_only(
    database: VehicleDatabase, tmp_path: Path, workers: int
) -> None:
    path = tmp_path / "endless"
    os.mkfifo(path)
    readers: dict[str, ReadVehicle[str]] = {
        "A": partial(endless, path=path), "B": name_of, "C": dying, "D": refusing, "E": name_of
    }  # fmt: skip
    fleet = fleet_of(tmp_path, list(readers))
    found, errors = read_each(readers, fleet, EQUIPMENT, database, workers=workers, limit_s=2.0)
    assert found == {name: f"{name} with battery, motor of {database.layout.name}" for name in "BE"}
    assert errors.keys() == {"A", "C", "D"}
    assert errors["A"].startswith("reading took more than 2 s and was ended; ")
    assert errors["C"].startswith("the process that read it was killed by SIGKILL; ")
    assert errors["D"] == "D: too short"


def test_a_fleet_of_which_no_vehicle_can_be_read_is_refused_with_the_first_reason(
    database: VehicleDatabase, tmp_path: Path
) -> None:
    with pytest.raises(FleetError, match="no vehicle has enough usable data; the first says: the process that read it"):
        read_vehicles(dying, fleet_of(tmp_path, ["A", "B"]), EQUIPMENT, database, workers=1)
