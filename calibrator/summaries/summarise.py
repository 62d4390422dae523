"""Drives of a fleet into a store of summaries: each drive is read once, ever.

The store is its own checkpoint: buckets that are there are not made again, and what a killed run has left is whole.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from calibrator.drive import DriveFile
from calibrator.errors import FleetError
from calibrator.files.storage import Storage
from calibrator.reading_processes import TIME_LIMIT_S, Unread, read_in_processes
from calibrator.sources.fleet_source import Equipment, FleetSource
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.identity import StoreIdentity, read_identity, store_identity, write_identity
from calibrator.summaries.record import Record, source_version
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.vehicle_summary import read_vehicle_summary
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import few
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError

__all__ = ["Added", "add_drives", "open_store", "require_store_or_nothing"]


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


def require_store_or_nothing(storage: Storage) -> None:
    """Refuse a place for summaries, before any drive is read, that is not empty and no store of them.

    Raises
    ------
    FleetError
        If it is another folder, a file, or one that does not last.
    """
    if storage.is_local and Path(storage.url).is_file():
        raise FleetError(f"{storage.url}: is a file; name a folder for the summaries, or a URL")
    if not storage.lasts:
        raise FleetError(
            f"{storage.url}: is gone when the command ends; name a folder for the summaries, or another URL"
        )
    there = storage.names()  # before its identity: another machine may make the store just now
    if there and read_identity(storage) is None:
        raise FleetError(
            f"{storage.url}: no store of summaries, and not empty: {few(there)}; choose an empty or new folder"
        )


def open_store(
    storage: Storage,
    equipment: Equipment,
    database: VehicleDatabase,
    fleet: FleetSource,
    *,
    bank: FilterBank | None = None,
) -> SummaryStore:
    """Open the store at a place, or make one for a fleet.

    Parameters
    ----------
    storage : Storage
        Where it is, or will be.
    equipment, database, fleet : Equipment, VehicleDatabase, FleetSource
        Whose drives are to be added.
    bank : FilterBank or None
        Filters of their inputs; None: those of the store, or the plain inputs for a new one.

    Returns
    -------
    SummaryStore
        To add to.

    Raises
    ------
    FleetError
        If there is a store of another layout, other branches or other inputs.
    """
    identity = read_identity(storage, database)
    if bank is None and identity is not None and identity.fleet_inputs == equipment.fleet_inputs:
        bank = identity.bank
    if bank is not None and bank.input_names != equipment.fleet_inputs:
        raise FleetError(
            f"the filter bank is for the inputs {', '.join(bank.input_names)}, this fleet has "
            f"{', '.join(equipment.fleet_inputs)}; choose a bank for it with 'calibrator identify'"
        )
    wanted = store_identity(
        equipment,
        database,
        bank=bank,
        vehicles=len(fleet.vehicles),
        fleet=fleet.path.resolve().name,
        fleet_ids=fleet.fleet_ids,
    )
    if identity is None:
        write_identity(storage, wanted)
        identity = read_identity(storage, database)  # another process may have made the store just now
        assert identity is not None
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
    exactly: bool = False,
    part: tuple[int, int] = (1, 1),
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
    exactly : bool
        Whether the store is to hold these drives alone: what it has of others is removed.
    part : tuple of int
        Number i, from 1, and count n: only every n-th bucket, from the i-th. Parts do not touch each other's files.

    Returns
    -------
    Added
        What was read. A vehicle whose drives cannot be used has a record that says why.
    """
    number, count = part
    by_bucket = {b: names for b, names in store.by_bucket(fleet.vehicles).items() if b % count == number - 1}
    if exactly:
        _remove_others(store, fleet)
    waiting: deque[_Work] = deque()
    entries = _entries(store, fleet, by_bucket, waiting, retry=not exactly)
    summarise = partial(_summarise, store=store.identity, database=database)
    reading = read_in_processes(summarise, entries, workers=workers, limit_s=time_limit_s)
    total, seen, done = sum(map(len, by_bucket.values())), 0, _Done()
    with progress_bar("summarise drives", total, "vehicles") as progress, closing(reading) as results:
        for outcome in results:
            while not waiting[0].new:
                seen += waiting.popleft().vehicles
            work = waiting[0]
            work.records.append(_record(work.new[len(work.records)].entries, outcome))
            progress(seen + len(work.records))
            if len(work.records) == len(work.new):
                _keep(store, work, done)
                seen += waiting.popleft().vehicles
        progress(total)
    return Added(vehicles=done.vehicles, drives=done.drives, problems=done.problems)


@dataclass(kw_only=True)
class _Done:
    """What has been read so far."""

    vehicles: int = 0
    drives: int = 0
    problems: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class _New:
    """Drives of a vehicle to be read, and which version of each drive there is."""

    entries: tuple[DriveFile, ...]
    versions: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class _Work:
    """What is to be read for a bucket, and the records that there are of it, in the same order."""

    bucket: int
    vehicles: int
    new: Sequence[_New]
    records: list[Record] = field(default_factory=list)


def _entries(
    store: SummaryStore,
    fleet: FleetSource,
    by_bucket: Mapping[int, Sequence[str]],
    waiting: "deque[_Work]",
    *,
    retry: bool,
) -> Iterator[tuple[DriveFile, ...]]:
    """Drives to read, vehicle by vehicle; ``waiting`` gets what they belong to."""
    for bucket, names in by_bucket.items():
        work = _Work(bucket=bucket, vehicles=len(names), new=_new(store.read(bucket), fleet, names, retry=retry))
        waiting.append(work)
        yield from (item.entries for item in work.new)


def _new(
    records: Mapping[str, Sequence[Record]], fleet: FleetSource, names: Sequence[str], *, retry: bool
) -> list[_New]:
    """Vehicles of a bucket that have drives which no record holds as they are now.

    A record is made anew with all its drives if one of them was changed; what could not be used is tried again if it
    was changed, or if that is asked for.
    """
    found = []
    for name in names:
        versions = {entry.name: source_version(entry.path) for entry in fleet.vehicles[name]}
        stored = records.get(name, [])
        kept = [item for item in stored if _stays(item, versions) and not (item.damaged or (retry and item.problem))]
        there = {drive for record in kept for drive in record.drives}
        entries = tuple(entry for entry in fleet.vehicles[name] if entry.name not in there)
        if entries:
            found.append(_New(entries=entries, versions=versions))
    return found


def _stays(record: Record, versions: Mapping[str, str]) -> bool:
    """Whether a record is still right, or cannot be made anew as not all of its drives are given."""
    known = zip(record.drives, record.sources, strict=True)
    return not versions.keys() >= set(record.drives) or all(versions[drive] == source for drive, source in known)


def _keep(store: SummaryStore, work: _Work, done: _Done) -> None:
    """Put the records of a bucket into the store, beside what others have put there meanwhile."""
    with store.locked():
        records = store.read(work.bucket)
        for item, record in zip(work.new, work.records, strict=True):
            drives = set(record.drives)
            others = [
                old
                for old in records.get(record.vehicle, [])
                if _stays(old, item.versions) and not drives & set(old.drives)
            ]
            records[record.vehicle] = [*others, record]
            done.vehicles += 1
            done.drives += len(record.drives)
            if record.problem:
                done.problems[record.vehicle] = record.problem
        store.write(work.bucket, records)


def _remove_others(store: SummaryStore, fleet: FleetSource) -> None:
    """Remove what a store has of drives that are not, or no longer, those of the fleet."""
    for bucket in store.buckets():
        records = store.read(bucket)
        kept = {name: [item for item in items if _is_of(item, fleet)] for name, items in records.items()}
        if any(len(kept[name]) < len(items) for name, items in records.items()):
            store.write(bucket, kept)


def _is_of(record: Record, fleet: FleetSource) -> bool:
    """Whether all drives of a record are the fleet's, as they are now."""
    versions = {entry.name: source_version(entry.path) for entry in fleet.vehicles.get(record.vehicle, ())}
    known = zip(record.drives, record.sources, strict=True)
    return all(versions.get(drive) == source for drive, source in known)


def _record(entries: Sequence[DriveFile], outcome: "Record | Unread") -> Record:
    return _unusable(entries, outcome.reason) if isinstance(outcome, Unread) else outcome


def _summarise(entries: tuple[DriveFile, ...], *, store: StoreIdentity, database: VehicleDatabase) -> Record:
    """Record of some drives of one vehicle. One thread: the processes share the cores."""
    sources = _sources(entries)
    with threadpool_limits(1):
        try:
            found = read_vehicle_summary(entries, store.equipment, database, bank=store.bank)
        except UserError as error:
            return _unusable(entries, str(error))
        except (np.linalg.LinAlgError, ArithmeticError, LookupError, ValueError) as error:
            return _unusable(entries, f"its drives cannot be summarised: {error}; look at its recordings")
    return Record(vehicle=found.vehicle, drives=found.drives, sources=sources, found=found)


def _sources(entries: Sequence[DriveFile]) -> tuple[str, ...]:
    return tuple(source_version(entry.path) for entry in entries)


def _unusable(entries: Sequence[DriveFile], problem: str) -> Record:
    drives = tuple(entry.name for entry in entries)
    return Record(vehicle=entries[0].vehicle, drives=drives, sources=_sources(entries), found=None, problem=problem)
