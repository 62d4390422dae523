"""Drives of a fleet into a store of summaries: each drive is read once, ever.

The store is its own checkpoint: buckets that are there are not made again, and what a killed run has left is whole.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial

from calibrator.drive import DriveFile
from calibrator.processes.reading import TIME_LIMIT_S, read_in_processes
from calibrator.sources.fleet_source import FleetSource
from calibrator.summaries.known_drives import NewDrives, new_drives, remove_others, stays
from calibrator.summaries.read_record import read_record, record_of
from calibrator.summaries.record import Record
from calibrator.summaries.store import SummaryStore
from calibrator.terminal.progress import progress_bar
from ecu_node.database import VehicleDatabase

__all__ = ["Added", "add_drives"]


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
        remove_others(store, fleet)
    waiting: deque[_Work] = deque()
    entries = _entries(store, fleet, by_bucket, waiting, retry=not exactly)
    summarise = partial(read_record, store=store.identity, database=database)
    reading = read_in_processes(summarise, entries, workers=workers, limit_s=time_limit_s)
    total, seen, done = sum(map(len, by_bucket.values())), 0, _Done()
    with progress_bar("summarise drives", total, "vehicles") as progress, closing(reading) as results:
        for outcome in results:
            while not waiting[0].new:
                seen += waiting.popleft().vehicles
            work = waiting[0]
            work.records.append(record_of(work.new[len(work.records)].entries, outcome))
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
class _Work:
    """What is to be read for a bucket, and the records that there are of it, in the same order."""

    bucket: int
    vehicles: int
    new: Sequence[NewDrives]
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
        work = _Work(bucket=bucket, vehicles=len(names), new=new_drives(store.read(bucket), fleet, names, retry=retry))
        waiting.append(work)
        yield from (item.entries for item in work.new)


def _keep(store: SummaryStore, work: _Work, done: _Done) -> None:
    """Put the records of a bucket into the store, beside what others have put there meanwhile."""
    with store.locked():
        records = store.read(work.bucket)
        for item, record in zip(work.new, work.records, strict=True):
            drives = set(record.drives)
            others = [
                old
                for old in records.get(record.vehicle, [])
                if stays(old, item.versions) and not drives & set(old.drives)
            ]
            records[record.vehicle] = [*others, record]
            done.vehicles += 1
            done.drives += len(record.drives)
            if record.problem:
                done.problems[record.vehicle] = record.problem
        store.write(work.bucket, records)
