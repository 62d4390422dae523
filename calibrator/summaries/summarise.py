"""Drives of a fleet into a store of summaries: each drive is read once, ever.

The store is its own checkpoint: buckets that are there are not made again, and what a killed run has left is whole.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from threadpoolctl import threadpool_limits

from calibrator.drive import DriveFile
from calibrator.drives.fleet_source import Equipment, FleetSource
from calibrator.errors import FleetError
from calibrator.evidence.vehicle_summary import read_vehicle_summary
from calibrator.reading_processes import TIME_LIMIT_S, Unread, read_in_processes
from calibrator.report.progress import progress_bar
from calibrator.storage import Storage
from calibrator.summaries.identity import read_identity, store_identity, write_identity
from calibrator.summaries.record import Record
from calibrator.summaries.store import SummaryStore
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError

__all__ = ["Added", "add_drives", "open_store"]


@dataclass(frozen=True, kw_only=True)
class Added:
    """What was added to a store.

    Attributes
    ----------
    vehicles : int
        Vehicles whose drives were read.
    drives : int
        Drives read; those that were in the store already are not.
    problems : mapping of str to str
        Vehicles whose drives could not be used, and why.
    """

    vehicles: int
    drives: int
    problems: Mapping[str, str]


def open_store(
    storage: Storage, equipment: Equipment, database: VehicleDatabase, fleet: FleetSource
) -> SummaryStore:
    """Open the store at a place, or make one for a fleet.

    Parameters
    ----------
    storage : Storage
        Where it is, or will be.
    equipment, database, fleet : Equipment, VehicleDatabase, FleetSource
        Whose drives are to be added.

    Returns
    -------
    SummaryStore
        To add to.

    Raises
    ------
    FleetError
        If there is a store of another layout, other branches or other inputs.
    """
    wanted = store_identity(
        equipment,
        database,
        vehicles=len(fleet.vehicles),
        fleet=fleet.path.resolve().name,
        fleet_ids=fleet.fleet_ids,
    )
    identity = read_identity(storage, database)
    if identity is None:
        write_identity(storage, wanted)
        return SummaryStore(storage=storage, identity=wanted)
    if difference := identity.difference(wanted):
        raise FleetError(f"{storage.url}: these drives cannot be added to this store: {difference}; use another store")
    return SummaryStore(storage=storage, identity=identity)


def add_drives(
    store: SummaryStore,
    fleet: FleetSource,
    database: VehicleDatabase,
    *,
    workers: int,
    time_limit_s: float = TIME_LIMIT_S,
) -> Added:
    """Summarise the drives of a fleet that a store does not have yet.

    Parameters
    ----------
    store : SummaryStore
        Where to; each bucket is written when all of its vehicles are read.
    fleet : FleetSource
        The drives.
    database : VehicleDatabase
        DBC and layout.
    workers : int
        Number of processes.
    time_limit_s : float
        Longest time for the drives of one vehicle. [s]

    Returns
    -------
    Added
        What was read. A vehicle whose drives cannot be used has a record that says why.
    """
    by_bucket = store.by_bucket(fleet.vehicles)
    problems: dict[str, str] = {}
    vehicles = drives = seen = 0
    summarise = partial(_summarise, equipment=store.identity.equipment, database=database)
    with progress_bar("summarise drives", len(fleet.vehicles), "vehicles") as progress:
        results = read_in_processes(
            summarise, _new_drives(store, fleet, by_bucket), workers=workers, limit_s=time_limit_s
        )
        for bucket, names in by_bucket.items():
            records = store.read(bucket)
            new = {name: _not_yet(fleet.vehicles[name], records.get(name, [])) for name in names}
            for name, entries in new.items():
                if entries:
                    record = _record(name, entries, next(results))
                    records[name] = [*records.get(name, []), record]
                    vehicles, drives = vehicles + 1, drives + len(entries)
                    if record.problem:
                        problems[name] = record.problem
                seen += 1
                progress(seen)
            if any(new.values()):
                store.write(bucket, records)
    return Added(vehicles=vehicles, drives=drives, problems=problems)


def _new_drives(
    store: SummaryStore, fleet: FleetSource, by_bucket: Mapping[int, Sequence[str]]
) -> Iterator[tuple[DriveFile, ...]]:
    """Drives to read of each vehicle that has any, in the order of the buckets."""
    for bucket, names in by_bucket.items():
        records = store.read(bucket)
        for name in names:
            entries = _not_yet(fleet.vehicles[name], records.get(name, []))
            if entries:
                yield entries


def _not_yet(entries: Sequence[DriveFile], records: Sequence[Record]) -> tuple[DriveFile, ...]:
    """Drives that no record holds."""
    there = {name for record in records for name in record.drives}
    return tuple(entry for entry in entries if entry.name not in there)


def _record(name: str, entries: Sequence[DriveFile], outcome: "Record | Unread") -> Record:
    if isinstance(outcome, Unread):
        drives = tuple(entry.name for entry in entries)
        return Record(vehicle=name, drives=drives, found=None, problem=outcome.reason)
    return outcome


def _summarise(entries: tuple[DriveFile, ...], *, equipment: Equipment, database: VehicleDatabase) -> Record:
    """Record of some drives of one vehicle. One thread: the processes share the cores."""
    vehicle, drives = entries[0].vehicle, tuple(entry.name for entry in entries)
    with threadpool_limits(1):
        try:
            found = read_vehicle_summary(entries, equipment, database)
        except UserError as error:
            return Record(vehicle=vehicle, drives=drives, found=None, problem=str(error))
    return Record(vehicle=vehicle, drives=drives, found=found)
