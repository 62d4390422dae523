"""Drives of a fleet into a store of summaries: each drive is read once, ever, and only its summary travels.

The store is its own checkpoint: a bucket whose vehicles are read is written, and what a killed run has left is whole.
A recording counts once. One that two vehicles have counts for neither, as it cannot be told whose it is.
"""

import hashlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from calibrator.drive import Drive, DriveFile
from calibrator.drives.store import recording_digest
from calibrator.files.storage import local_copy, open_storage
from calibrator.processes.run_many import Failed, Workers, try_many
from calibrator.sources.fleet_source import (
    MEGABYTE,
    FleetSource,
    find_fleet,
    is_onboard,
    load_drive,
    probe_equipment,
)
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.identity import StoreIdentity
from calibrator.summaries.onboard import read_onboard
from calibrator.summaries.record import Known, Record, added_summaries
from calibrator.summaries.store import SummaryStore, open_store, require_store_or_nothing
from calibrator.summaries.vehicle_summary import VehicleSummary, summarise_drives
from calibrator.terminal.options import TIME_LIMIT_S
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import counted, dumps, left_out_text
from ecu_node.database import VehicleDatabase

__all__ = ["Added", "SummariseReport", "add_drives", "summarise_fleet"]

COPY = "same recording as"
"""How the problem of a recording begins that is there already."""


@dataclass(frozen=True, kw_only=True)
class SummariseReport:
    """What was summarised."""

    store: str
    vehicles: int
    drives: int
    left_out: Mapping[str, str]
    notices: tuple[str, ...]

    def as_json(self) -> str:
        """The report as JSON."""
        return dumps(vars(self))

    def as_text(self) -> str:
        """The report for people."""
        parts = [
            "\n".join(f"notice: {notice}" for notice in self.notices),
            left_out_text(self.left_out),
            f"{counted(self.drives, 'drive')} of {counted(self.vehicles, 'vehicle')} summarised in {self.store}",
        ]
        return "\n\n".join(part for part in parts if part)


def summarise_fleet(
    fleet: str | Path,
    database: VehicleDatabase,
    out: str,
    *,
    branches: tuple[str, ...] | None,
    bank: FilterBank | None = None,
    workers: Workers,
    time_limit_s: float = TIME_LIMIT_S,
) -> SummariseReport:
    """Summarise the drives of a fleet that a store does not have yet.

    Parameters
    ----------
    fleet : str or Path
        The drives, see :func:`calibrator.sources.fleet_source.find_fleet`.
    database : VehicleDatabase
        DBC and layout.
    out : str
        Path or URL of the store; made if there is none.
    branches : tuple of str or None
        Branches to use; None: those that the fleet has.
    bank : FilterBank or None
        Filters of their inputs; None: those of the store, or the plain inputs for a new one.
    workers : Workers
        Where the drives are read.
    time_limit_s : float
        Longest time for the drives of one vehicle. [s]

    Returns
    -------
    SummariseReport
        What was read; it is in the store then.

    Raises
    ------
    UserError
        If the drives do not fit the store, or it cannot be written.
    """
    storage = open_storage(out)
    require_store_or_nothing(storage)
    source = find_fleet(fleet)
    equipment = probe_equipment(source, database, branches, limit_s=time_limit_s)
    store = open_store(storage, equipment, database, source, bank=bank)
    added = add_drives(store, source, database, workers=workers, time_limit_s=time_limit_s)
    return SummariseReport(
        store=out,
        vehicles=added.vehicles,
        drives=added.drives,
        left_out={**source.left_out, **added.problems},
        notices=(*equipment.notices, *added.notices),
    )


@dataclass(kw_only=True)
class Added:
    """What was added to a store.

    Attributes
    ----------
    vehicles, drives : int
        Vehicles whose drives were read, and these drives; those that were in the store already are not.
    problems : dict of str to str
        Vehicles whose drives could not be used, and why.
    notices : list of str
        What else the user should know.
    """

    vehicles: int = 0
    drives: int = 0
    problems: dict[str, str] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)


def add_drives(
    store: SummaryStore,
    fleet: FleetSource,
    database: VehicleDatabase,
    *,
    workers: Workers,
    time_limit_s: float = TIME_LIMIT_S,
    exactly: bool = False,
) -> Added:
    """Summarise the drives of a fleet that a store does not have yet.

    Parameters
    ----------
    store : SummaryStore
        Where to; what is new in a bucket is written when all of its vehicles are read.
    fleet, database : FleetSource, VehicleDatabase
        The drives; DBC and layout.
    workers : Workers
        Where the drives are read.
    time_limit_s : float
        Longest time for the drives of one vehicle. [s]
    exactly : bool
        Whether the store is to hold these drives alone: what it has of others is removed.

    Returns
    -------
    Added
        What was read. A vehicle whose drives cannot be used has a record that says why.
    """
    if exactly:
        _remove_others(store, fleet)
    waiting, added, owners, seen = deque[_Work](), Added(), _Owners(), 0.0
    entries = _entries(store, fleet, waiting, owners, retry=not exactly)
    outcomes = try_many(
        partial(_read_record, store=store.identity, database=database), entries, workers, limit_s=time_limit_s
    )
    total = int(sum(fleet.sizes.values()) / MEGABYTE) + 1
    with progress_bar("summarise drives", total, "MB") as progress, closing(outcomes):
        for (drives, _), outcome in outcomes:
            while not waiting[0].versions:
                seen += waiting.popleft().size
            work = waiting[0]
            work.records.append(_unusable(drives, outcome.reason) if isinstance(outcome, Failed) else outcome)
            done = seen + sum(fleet.sizes.get(record.vehicle, 0) for record in work.records)
            progress(done / MEGABYTE)
            if len(work.records) == len(work.versions):
                _keep(store, work, added, owners)
                seen += waiting.popleft().size
        progress(total)
    _mark_copies(store, added, owners)
    return added


@dataclass(frozen=True, kw_only=True)
class _Work:
    """What is to be read for a bucket: versions of all drives by vehicle; and the records of them so far."""

    bucket: int
    size: int
    versions: Mapping[str, Mapping[str, str]]
    records: list[Record] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class _Owners:
    """Whose recording is whose, by the first half of its digest, as a fleet has many; those that several share."""

    first: dict[int, str] = field(default_factory=dict)
    shared: dict[int, set[str]] = field(default_factory=dict)

    def add(self, vehicle: str, digests: Iterable[str]) -> None:
        """Note the recordings of a vehicle."""
        for digest in digests:
            other = self.first.setdefault(_key(digest), vehicle)
            if other != vehicle:
                self.shared.setdefault(_key(digest), {other}).add(vehicle)


def _key(digest: str) -> int:
    return int(digest[:16], 16)


def _entries(
    store: SummaryStore, fleet: FleetSource, waiting: deque[_Work], owners: _Owners, *, retry: bool
) -> Iterator[tuple[tuple[DriveFile, ...], frozenset[str]]]:
    """Drives to read, vehicle by vehicle, with the digests of those that it has; ``waiting`` gets their buckets."""
    for bucket, names in store.by_bucket(fleet.vehicles).items():
        records, new, versions = store.known(bucket), [], {}
        for name in names:
            drives = fleet.vehicles[name]
            there = {drive.name: drive.version for drive in drives}
            kept = [k for k in records.get(name, ()) if _stays(k, there) and not _is_tried_again(k, retry=retry)]
            digests = frozenset(digest for record in kept for digest in record.digests)
            owners.add(name, digests)
            known = {drive for record in kept for drive in record.drives}
            if wanted := tuple(drive for drive in drives if drive.name not in known):
                versions[name] = there
                new.append((wanted, digests))
        waiting.append(_Work(bucket=bucket, size=sum(fleet.sizes.get(n, 0) for n in names), versions=versions))
        yield from new


def _is_tried_again(record: Known, *, retry: bool) -> bool:
    """Whether a record without a summary is to be made anew, though its drives did not change."""
    return bool(record.problem) and (retry or record.problem.startswith(COPY))


def _stays(record: Known | Record, versions: Mapping[str, str]) -> bool:
    """Whether a record is still right, or cannot be made anew as not all of its drives are given."""
    known = zip(record.drives, record.sources, strict=True)
    return not versions.keys() >= set(record.drives) or all(versions[drive] == source for drive, source in known)


def _read_record(
    work: tuple[tuple[DriveFile, ...], frozenset[str]], *, store: StoreIdentity, database: VehicleDatabase
) -> Record:
    """Record of some drives of one vehicle, which has others with these digests already."""
    entries, known = work
    made, drives, digests = dict[str, VehicleSummary](), dict[str, Drive](), list[str]()
    for entry in entries:
        if is_onboard(entry):
            with local_copy(entry.place) as path:
                digests.append(hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest())
                made[digests[-1]] = read_onboard(path, store, database, vehicle=entry.vehicle, name=entry.name)
        else:
            drive = load_drive(entry, database)
            digests.append(recording_digest(drive))
            drives[digests[-1]] = drive
    new = [drive for digest, drive in drives.items() if digest not in known]
    parts = [summarise_drives(new, store.equipment, database, bank=store.bank)] if new else []
    parts += [summary for digest, summary in made.items() if digest not in known]
    if not parts:
        return _unusable(entries, f"{COPY} one that this vehicle has already; it counts once", tuple(digests))
    names = tuple(entry.name for entry in entries)
    return Record(
        vehicle=entries[0].vehicle,
        drives=names,
        sources=tuple(entry.version for entry in entries),
        digests=tuple(digests),
        found=replace(added_summaries(parts), vehicle=entries[0].vehicle, drives=names),
    )


def _unusable(entries: Sequence[DriveFile], problem: str, digests: tuple[str, ...] = ()) -> Record:
    return Record(
        vehicle=entries[0].vehicle,
        drives=tuple(entry.name for entry in entries),
        sources=tuple(entry.version for entry in entries),
        digests=digests,
        found=None,
        problem=problem,
    )


def _keep(store: SummaryStore, work: _Work, added: Added, owners: _Owners) -> None:
    """Put the new records of a bucket into the store, beside what others have put there meanwhile."""
    new = {record.vehicle: record for record in work.records}

    def is_replaced(old: Known | Record) -> bool:
        record = new.get(old.vehicle)
        return record is not None and (
            not _stays(old, work.versions[old.vehicle]) or bool(set(old.drives) & set(record.drives))
        )

    with store.locked():
        if any(is_replaced(old) for records in store.known(work.bucket).values() for old in records):
            records = {
                name: [old for old in items if not is_replaced(old)] for name, items in store.read(work.bucket).items()
            }
            for name, record in new.items():
                records[name] = [*records.get(name, ()), record]
            store.write(work.bucket, records)
        else:
            store.append(work.bucket, {name: [record] for name, record in new.items()})
    for record in work.records:
        owners.add(record.vehicle, record.digests)
        added.vehicles += 1
        added.drives += len(record.drives)
        if record.problem:
            added.problems[record.vehicle] = record.problem
        if len(set(record.digests)) < len(record.digests):
            twins = [name for k, name in enumerate(record.drives) if record.digests.count(record.digests[k]) > 1]
            added.notices.append(
                f"vehicle {record.vehicle}: drives {', '.join(twins)} hold the same recording, which counts once"
            )


def _mark_copies(store: SummaryStore, added: Added, owners: _Owners) -> None:
    """Take away the summaries of recordings that several vehicles have."""
    for bucket in store.by_bucket(set().union(*owners.shared.values())):
        with store.locked():
            records = store.read(bucket)
            marked = {name: [_marked(record, owners) for record in items] for name, items in records.items()}
            if marked != records:
                store.write(bucket, marked)
        copies = [record for items in marked.values() for record in items if record.problem.startswith(COPY)]
        added.problems.update({record.vehicle: record.problem for record in copies})


def _marked(record: Record, owners: _Owners) -> Record:
    sharing = set[str]().union(*(owners.shared.get(_key(digest), ()) for digest in record.digests)) - {record.vehicle}
    if not sharing:
        return record
    problem = f"{COPY} {', '.join(sorted(sharing))}; it cannot be told whose it is: remove it where it does not belong"
    return replace(record, found=None, problem=problem)


def _remove_others(store: SummaryStore, fleet: FleetSource) -> None:
    """Remove what a store has of drives that are not, or no longer, those of the fleet."""

    def is_right(record: Known | Record) -> bool:
        drives = fleet.vehicles.get(record.vehicle, ())
        versions = {drive.name: drive.version for drive in drives}
        return all(versions.get(d) == source for d, source in zip(record.drives, record.sources, strict=True))

    for bucket in store.buckets():
        if not all(is_right(record) for records in store.known(bucket).values() for record in records):
            records = store.read(bucket).items()
            store.write(bucket, {name: [item for item in items if is_right(item)] for name, items in records})
