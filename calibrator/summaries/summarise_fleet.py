"""Summarise the drives of a fleet into a store: each drive is read only once, and only its summary is passed on.

The store is its own checkpoint: a bucket is written when all its vehicles are read, and a killed run leaves only
complete files. A recording that a vehicle has twice counts once. If two vehicles have the same recording, it counts for
neither, as it is unclear to which it belongs.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calibrator.drive import Array, Drive, DriveFile, Equipment, FleetSource, Samples
from calibrator.drives.delays import BranchDelays
from calibrator.drives.store import read_onboard_record, recording_digest
from calibrator.errors import DriveError
from calibrator.files.storage import local_copy, open_storage
from calibrator.processes.run_many import Failed, Workers, try_many_shown
from calibrator.sources.fleet_source import find_fleet, is_onboard, load_drive, probe_equipment
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.identity import StoreIdentity
from calibrator.summaries.moments import LEVEL_EDGES_A, DriveSummary, FitSums
from calibrator.summaries.record import Record
from calibrator.summaries.summary_store import SummaryStore, open_store, require_store_or_nothing
from calibrator.summaries.vehicle_summary import (
    VehicleSummary,
    ZeroCurrent,
    added_summaries,
    aligned_drives,
    summarise_drives,
)
from calibrator.terminal.options import TIME_LIMIT_S
from calibrator.terminal.text import counted, dumps, few, few_reasons, left_out_text
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.summary import SummaryFile, unpacked

__all__ = [
    "SummariseReport",
    "add_drives",
    "read_samples",
    "read_vehicle_summary",
    "summarise_fleet",
]

COPY = "same recording as"
"""Beginning of a record's problem if its recording is in the store already, for the same or another vehicle."""


@dataclass(kw_only=True)
class SummariseReport:
    """Result of a run: what was summarised, and what was left out.

    Attributes
    ----------
    store : str
        Path or URL of the store.
    vehicles, drives : int
        Number of vehicles with newly summarised drives, and of these drives; drives that the store had before, or that
        were left out, do not count.
    left_out : dict of str to str
        Why drives were not used: by name of the vehicle, as ``VEHICLE/DRIVE`` if the vehicle has other drives, or as
        ``problem 1`` ... for files whose vehicle is unclear.
    notices : list of str
        Further notices for the user.
    """

    store: str
    vehicles: int = 0
    drives: int = 0
    left_out: dict[str, str] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)

    def as_json(self) -> str:
        """Return the report as JSON."""
        return dumps(vars(self))

    def as_text(self) -> str:
        """Return the report as readable text."""
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
        Branches to use; None: those found in the fleet.
    bank : FilterBank or None
        Filters of the fleet's inputs; None: those of the store, or the plain inputs for a new one.
    workers : Workers
        Where the drives are read.
    time_limit_s : float
        Longest time to read the drives of one vehicle, which is left out if that takes longer. [s]

    Returns
    -------
    SummariseReport
        What was added to the store, and what was left out.

    Raises
    ------
    UserError
        If no drive is found, the drives do not fit the store, or it cannot be written.
    """
    storage = open_storage(out)
    require_store_or_nothing(storage)
    source = find_fleet(fleet)
    equipment = probe_equipment(source, database, branches, limit_s=time_limit_s)
    store = open_store(storage, equipment, database, source, bank=bank)
    report = add_drives(store, source, database, workers=workers, time_limit_s=time_limit_s)
    report.store, report.notices = out, [*equipment.notices, *report.notices]
    return report


def add_drives(
    store: SummaryStore,
    fleet: FleetSource,
    database: VehicleDatabase,
    *,
    workers: Workers,
    time_limit_s: float = TIME_LIMIT_S,
) -> SummariseReport:
    """Add summaries of the drives of a fleet that an open store does not have yet.

    Parameters
    ----------
    store : SummaryStore
        Store to add to; a bucket is written when all of its vehicles are read.
    fleet, database : FleetSource, VehicleDatabase
        The drives; DBC and layout.
    workers : Workers
        Where the drives are read.
    time_limit_s : float
        Longest time to read the drives of one vehicle, which is left out if that takes longer. [s]

    Returns
    -------
    SummariseReport
        What was added and left out. Drives that cannot be used get a record that says why.

    Raises
    ------
    UserError
        If the store cannot be read or written.
    """
    report, owners = SummariseReport(store=store.url, left_out=dict(fleet.left_out)), _Owners()
    summarised = dict[str, tuple[int, int]]()  # number of drives, and hash of their names, as names take memory
    outcomes = try_many_shown(
        partial(_read_records, store=store.identity, database=database),
        _tasks(store, fleet, owners),
        workers,
        limit_s=time_limit_s,
        label="summarise drives",
        size=sum(fleet.sizes.values()),
        size_of=lambda task: task.size,
    )
    with closing(outcomes):
        for bucket, group in groupby(outcomes, key=lambda pair: pair[0].bucket):
            records = list[Record]()
            for task, outcome in group:
                if isinstance(outcome, Failed):
                    records.append(_record(task.drives, problem=outcome.reason))
                    report.left_out[task.drives[0].vehicle] = outcome.reason
                else:
                    records += outcome
                    problems = {f"{each.vehicle}/{few(each.drives)}": each.problem for each in outcome}
                    report.left_out |= {name: problem for name, problem in problems.items() if problem}
            known = store.read(bucket, whole=False)
            if new := [each for each in records if each.found or not _is_known(each, known.get(each.vehicle, ()))]:
                store.append(bucket, new)
            for record in records:
                owners.add(record.vehicle, record.digests)
                report.notices += _twins(record)
                if not record.problem:
                    summarised[record.vehicle] = len(record.drives), hash(record.drives)
    for bucket, vehicles in store.by_bucket(set().union(*owners.shared.values())).items():
        known = store.read(bucket, whole=False)
        copies = [copy for vehicle in vehicles for copy in owners.without_copies(known[vehicle])]
        store.append(bucket, copies)
        report.left_out |= {copy.vehicle: copy.problem for copy in copies}
        for copy in copies:
            if summarised.get(copy.vehicle) == (len(copy.drives), hash(copy.drives)):
                del summarised[copy.vehicle]
    report.vehicles, report.drives = len(summarised), sum(number for number, _ in summarised.values())
    return report


class _Task(NamedTuple):
    """Unit of work: the drives of one vehicle that are not in the store yet.

    ``digests`` and ``known_s`` (duration [s]) describe the recordings of the vehicle that the store has. ``size`` is
    what the progress bar advances by: that of this vehicle's drives and of those skipped since the task before. [byte]
    """

    bucket: int
    drives: tuple[DriveFile, ...]
    digests: frozenset[str]
    known_s: float
    size: int


@dataclass(frozen=True, kw_only=True)
class _Owners:
    """First vehicle seen with each recording, and all vehicles of each recording that several vehicles have.

    The key of a recording is the first half of its digest, which saves memory.
    """

    first: dict[int, str] = field(default_factory=dict)
    shared: dict[int, set[str]] = field(default_factory=dict)

    def add(self, vehicle: str, digests: Iterable[str]) -> None:
        """Enter the recordings of a vehicle, given by their digests."""
        for key in map(_key, digests):
            if (other := self.first.setdefault(key, vehicle)) != vehicle:
                self.shared.setdefault(key, {other}).add(vehicle)

    def without_copies(self, records: Iterable[Record]) -> Iterator[Record]:
        """Yield the records that share a recording with another vehicle, with a problem in place of the summary."""
        for record in records:
            sharing = set[str]().union(*(self.shared.get(_key(digest), ()) for digest in record.digests))
            if others := ", ".join(sorted(sharing - {record.vehicle})):
                problem = f"{COPY} {others}; it cannot be told whose it is: remove it where it does not belong"
                yield replace(record, found=None, problem=problem)


def _key(digest: str) -> int:
    return int(digest[:16], 16)


def _tasks(store: SummaryStore, fleet: FleetSource, owners: _Owners) -> Iterator[_Task]:
    """Yield the drives to read, bucket by bucket; enter into `owners` the recordings that the store has already."""
    size = 0
    for bucket, names in store.by_bucket(fleet.vehicles).items():
        records = store.read(bucket, whole=False)
        for name in names:
            drives = fleet.vehicles[name]
            versions = {drive.name: drive.version for drive in drives}
            kept = [k for k in records.get(name, ()) if _stays(k, versions) and not k.problem]
            digests = frozenset(digest for record in kept for digest in record.digests)
            owners.add(name, digests)
            known = {drive for record in kept for drive in record.drives}
            size += fleet.sizes.get(name, 0)
            if wanted := tuple(drive for drive in drives if drive.name not in known):
                yield _Task(bucket, wanted, digests, sum(record.duration_s for record in kept), size)
                size = 0


def _is_known(record: Record, known: Iterable[Record]) -> bool:
    """Check whether the store says already why these drives, which are tried in each run, cannot be used."""
    what = record.drives, record.sources, record.problem
    return any(what == (each.drives, each.sources, each.problem) for each in known)


def _stays(record: Record, versions: Mapping[str, str]) -> bool:
    """Check whether to keep a record: its drives are unchanged, or the fleet lacks one, so it cannot be made anew."""
    known = zip(record.drives, record.sources, strict=True)
    return not versions.keys() >= set(record.drives) or all(versions[drive] == source for drive, source in known)


def _read_records(task: _Task, *, store: StoreIdentity, database: VehicleDatabase) -> list[Record]:
    """Read the drives of a task and summarise them; each that cannot be read has a record of its own, which says why.

    A recording that the store has of this vehicle is skipped. DriveError if the vehicle has no drive that can be used.
    """
    found, digests, unreadable = dict[str, Drive | VehicleSummary](), dict[DriveFile, str](), dict[DriveFile, str]()
    for entry in task.drives:
        try:
            digests[entry], content = _read(entry, store, database)
            found[digests[entry]] = content
        except UserError as error:
            unreadable[entry] = str(error)
    if not digests and not task.digests:
        raise DriveError(unreadable[task.drives[0]])
    records = [_record([entry], problem=why) for entry, why in unreadable.items()]
    new = [content for digest, content in found.items() if digest not in task.digests]
    parts = [content for content in new if isinstance(content, VehicleSummary)]
    if drives := [content for content in new if isinstance(content, Drive)]:
        try:
            parts.insert(0, summarise_drives(drives, store.equipment, database, bank=store.bank, known_s=task.known_s))
        except DriveError as error:
            raise DriveError(f"{error}{few_reasons({entry.name: why for entry, why in unreadable.items()})}") from None
    if parts:
        records.append(_record([*digests], [*digests.values()], found=added_summaries(parts)))
    elif digests:
        problem = f"{COPY} one that this vehicle has already; it counts once"
        records.append(_record([*digests], [*digests.values()], problem=problem))
    return records


def _read(entry: DriveFile, store: StoreIdentity, database: VehicleDatabase) -> tuple[str, Drive | VehicleSummary]:
    """Read a drive, or the record that a node made of it; return the digest of its content, and itself."""
    if is_onboard(entry):
        with local_copy(entry.place) as path:
            digest = hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()
            return digest, _read_onboard(path, store, database, vehicle=entry.vehicle, name=entry.name)
    drive = load_drive(entry, database)
    return recording_digest(drive), drive


def _record(
    drives: Sequence[DriveFile], digests: Sequence[str] = (), *, found: VehicleSummary | None = None, problem: str = ""
) -> Record:
    vehicle, names = drives[0].vehicle, tuple(entry.name for entry in drives)
    return Record(
        vehicle=vehicle,
        drives=names,
        sources=tuple(entry.version for entry in drives),
        digests=tuple(digests),
        found=found and replace(found, vehicle=vehicle, drives=names),
        problem=problem,
    )


def _twins(record: Record) -> list[str]:
    """Say which drives of a record hold the same recording."""
    twins = [n for n, d in zip(record.drives, record.digests, strict=False) if record.digests.count(d) > 1]
    where = f"vehicle {record.vehicle}: drives {', '.join(twins)}"
    return [f"{where} hold the same recording, which counts once"] if twins else []


# ---- vehicles whose drives are still to be loaded


def read_samples(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> list[Samples]:
    """Load the drives of one vehicle and align them with delays taken out; UserError if they cannot be used."""
    return aligned_drives([load_drive(entry, database) for entry in entries], equipment, database)[1]


def read_vehicle_summary(
    entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase, *, bank: FilterBank | None = None
) -> VehicleSummary:
    """Load the drives of one vehicle and summarise them; UserError if they cannot be used."""
    found = summarise_drives([load_drive(entry, database) for entry in entries], equipment, database, bank=bank)
    return replace(found, vehicle=entries[0].vehicle, drives=tuple(entry.name for entry in entries))


# ---- records that a node made on board


def _read_onboard(
    path: Path, store: StoreIdentity, database: VehicleDatabase, *, vehicle: str, name: str
) -> VehicleSummary:
    """Read a record that a node made on board, as a summary with the branches and inputs of a store.

    Parameters
    ----------
    path : Path
        File of the record.
    store : StoreIdentity
        Identity of the store.
    database : VehicleDatabase
        DBC and layout.
    vehicle, name : str
        Vehicle to which the record must belong, and name of the drive for which it stands.

    Returns
    -------
    VehicleSummary
        Summary with a block for each of the B entries of the record, see :class:`~ecu_node.summary.SummaryFile`.

    Raises
    ------
    DriveError
        If the file is damaged, of another vehicle, layout or DBC, or lacks a branch or input of the store, or the store
        has filters, which need samples.
    """
    record = read_onboard_record(path, database)
    if record.vehicle != vehicle:
        raise DriveError(f"{path}: a record of vehicle {record.vehicle}; move it into the folder of its vehicle")
    if store.bank.poles:
        raise DriveError(f"{path}: made on board of plain inputs; a store with a filter bank needs the log")
    branches, inputs = store.equipment.branches, store.equipment.fleet_inputs
    if lacking := [x for x in (*branches, *inputs) if x not in {*record.branches, *record.inputs}]:
        raise DriveError(f"{path}: no {', '.join(lacking)} in it; summarise it with branches that it has")
    try:
        summary = _onboard_summary(record, store.bank.identity)
    except (ValueError, IndexError) as error:
        raise DriveError(f"{path}: damaged: {error}; copy it again from the vehicle") from None
    place = [record.branches.index(branch) for branch in branches]
    of_branches = (record.delay_s, record.delay_sd_s, record.zero_offset_a, record.zero_sd_a)
    delay_s, sd_s, zero_a, zero_sd_a = (np.array(values, np.float64)[place] for values in of_branches)  # None is NaN
    sd_s[np.isnan(sd_s)] = np.inf
    return VehicleSummary(
        vehicle=vehicle,
        drives=(name,),
        summary=summary.take_branches(place, [record.inputs.index(each) for each in inputs]),
        delays=BranchDelays(branches=branches, delay_s=delay_s, sd_s=sd_s, known=np.isfinite(sd_s)),
        zero_current=ZeroCurrent(offset_a=zero_a, sd_a=zero_sd_a),
    )


def _onboard_summary(record: SummaryFile, bank: str) -> DriveSummary:
    """Compute moments from means and covariances; ValueError or IndexError if there are wrong or missing numbers."""
    B, M, K = len(record.count), len(record.inputs), len(record.branches)
    p = M + K + 1
    count, mean, covariance = np.array(record.count, np.float64), np.ones((B, p)), np.zeros((B, p, p))
    mean[:, :-1] = _numbers(record.mean, B, p - 1)
    covariance[:, :-1, :-1] = _symmetric(record.covariance, B, p - 1)
    levels, visited = np.zeros((K, len(LEVEL_EDGES_A) + 1, p + 1)), [len(chosen) for chosen in record.levels]
    sums = np.split(_numbers(record.level_sums, sum(visited), p + 1), np.cumsum(visited)[:-1])
    for k, chosen in enumerate(record.levels):
        levels[k, chosen] = sums[k]
    summary = DriveSummary(
        moments=count[:, None, None] * (covariance + mean[:, :, None] * mean[:, None, :]),
        noise_a2=_numbers(record.noise_a2, B, K),
        branches=K,
        period_s=record.period_s,
        bank=bank,
        fit=FitSums(
            levels=levels,
            fast_a2=_symmetric(record.fast_a2, B, K),
            spikes=_numbers(record.spikes, B, 2 * K).reshape(B, K, 2),
            temperature_c=_numbers(record.temperature_c, B, 1)[:, 0],
            starts=np.array(record.starts, np.bool_).reshape(B),
        ),
    )
    if not B or not (np.isfinite(summary.moments).all() and (count > 0.0).all()):
        raise ValueError("impossible numbers")
    return summary


def _symmetric(content: bytes, rows: int, size: int) -> Array:
    """Unpack symmetric matrices, shape (rows, size, size), from their lower triangles."""
    full, lower = np.zeros((rows, size, size)), np.tril_indices(size)
    full[:, lower[0], lower[1]] = full[:, lower[1], lower[0]] = _numbers(content, rows, len(lower[0]))
    return full


def _numbers(content: bytes, rows: int, columns: int) -> Array:
    return np.array(unpacked(content), np.float64).reshape(rows, columns)
