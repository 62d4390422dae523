"""Read all vehicles of a fleet in parallel; one bad vehicle never stops the fleet."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from joblib import delayed
from threadpoolctl import threadpool_limits

from calibrator.drive import DriveFile
from calibrator.drives.fleet_source import Equipment, FleetSource
from calibrator.errors import FleetError
from calibrator.interrupts import in_processes
from calibrator.report.progress import progress_bar
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError

__all__ = ["read_vehicles"]

Vehicle = TypeVar("Vehicle")
ReadVehicle = Callable[[Sequence[DriveFile], Equipment, VehicleDatabase], Vehicle]


def read_vehicles(
    read: "ReadVehicle[Vehicle]", fleet: FleetSource, equipment: Equipment, database: VehicleDatabase, *, workers: int
) -> tuple[list[Vehicle], dict[str, str]]:
    """Read every vehicle.

    Parameters
    ----------
    read : callable
        Makes what a method needs of a vehicle from its drives; of module level, as it goes to other processes.
    fleet : FleetSource
        The fleet.
    equipment : Equipment
        Its branches and inputs.
    database : VehicleDatabase
        DBC and layout.
    workers : int
        Number of processes.

    Returns
    -------
    vehicles : list
        Those that can be used, in the order of the fleet.
    left_out : dict of str to str
        Why the others cannot, by name.

    Raises
    ------
    FleetError
        If no vehicle can be used.
    """
    tasks = (delayed(_read_one)(read, entries, equipment, database) for entries in fleet.vehicles.values())
    vehicles: list[Vehicle] = []
    left_out = dict(fleet.left_out)
    with progress_bar("read drives", len(fleet.vehicles), "vehicles") as progress:
        outcomes = in_processes(tasks, workers=workers)
        for done, (name, (vehicle, error)) in enumerate(zip(fleet.vehicles, outcomes, strict=True), start=1):
            if vehicle is None:
                left_out[name] = error
            else:
                vehicles.append(vehicle)
            progress(done)
    if not vehicles:
        reason = next(iter(left_out.values()), "")
        raise FleetError(f"{fleet.path}: no vehicle has enough usable data; the first says: {reason}")
    return vehicles, left_out


def _read_one(
    read: "ReadVehicle[Vehicle]", entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase
) -> tuple[Vehicle | None, str]:
    """One vehicle, or the text of the error. One thread: the processes share the cores."""
    with threadpool_limits(1):
        try:
            return read(entries, equipment, database), ""
        except UserError as error:
            return None, str(error)
