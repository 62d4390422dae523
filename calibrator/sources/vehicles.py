"""Read all vehicles of a fleet in parallel; one bad vehicle never stops the fleet."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from typing import TypeVar

from threadpoolctl import threadpool_limits

from calibrator.drive import DriveFile
from calibrator.errors import FleetError
from calibrator.processes.messages import Unread
from calibrator.processes.reading import TIME_LIMIT_S, read_in_processes
from calibrator.sources.fleet_source import Equipment, FleetSource
from calibrator.terminal.progress import progress_bar
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError

__all__ = ["ReadVehicle", "Vehicle", "read_each", "read_vehicles"]

Vehicle = TypeVar("Vehicle")
ReadVehicle = Callable[[Sequence[DriveFile], Equipment, VehicleDatabase], Vehicle]


def read_vehicles(
    read: "ReadVehicle[Vehicle]",
    fleet: FleetSource,
    equipment: Equipment,
    database: VehicleDatabase,
    *,
    workers: int,
    limit_s: float = TIME_LIMIT_S,
    label: str = "read drives",
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
    limit_s : float
        Longest time for one vehicle; one that takes longer is left out. [s]
    label : str
        What stands beside the bar of the progress.

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
    readers = dict.fromkeys(fleet.vehicles, read)
    found, errors = read_each(readers, fleet, equipment, database, workers=workers, limit_s=limit_s, label=label)
    left_out = {**fleet.left_out, **errors}
    if not found:
        reason = next(iter(left_out.values()), "")
        raise FleetError(f"{fleet.path}: no vehicle has enough usable data; the first says: {reason}")
    return list(found.values()), left_out


def read_each(
    readers: "Mapping[str, ReadVehicle[Vehicle]]",
    fleet: FleetSource,
    equipment: Equipment,
    database: VehicleDatabase,
    *,
    workers: int,
    limit_s: float = TIME_LIMIT_S,
    label: str = "read drives",
) -> tuple[dict[str, Vehicle], dict[str, str]]:
    """Read some vehicles, each in its own way.

    Parameters
    ----------
    readers : mapping of str to callable
        Makes what is needed of a vehicle from its drives, by name of the vehicle; each can go to another process.
    fleet, equipment, database, workers, limit_s, label
        As for :func:`read_vehicles`.

    Returns
    -------
    found : dict of str to what the reader makes
        The vehicles that can be used, in the order of the readers.
    errors : dict of str to str
        Why the others cannot, by name.
    """
    read_one = partial(_read_one, equipment=equipment, database=database)
    sources = ((read, fleet.vehicles[name]) for name, read in readers.items())
    found: dict[str, Vehicle] = {}
    errors: dict[str, str] = {}
    reading = read_in_processes(read_one, sources, workers=workers, limit_s=limit_s)
    with progress_bar(label, len(readers), "vehicles") as progress, closing(reading) as outcomes:
        for done, (name, outcome) in enumerate(zip(readers, outcomes, strict=True), start=1):
            if isinstance(outcome, Unread):
                errors[name] = outcome.reason
            else:
                found[name] = outcome
            progress(done)
    return found, errors


def _read_one(
    source: "tuple[ReadVehicle[Vehicle], Sequence[DriveFile]]", equipment: Equipment, database: VehicleDatabase
) -> Vehicle | Unread:
    """One vehicle, or the text of the error. One thread: the processes share the cores."""
    read, entries = source
    with threadpool_limits(1):
        try:
            return read(entries, equipment, database)
        except UserError as error:
            return Unread(reason=str(error))
