"""A store of summaries: ``STORE/summaries.json`` and ``STORE/buckets/BBBBB-NNNNN.parquet``.

Vehicles are spread over a fixed number of buckets by a hash of their names, so that any number of vehicles makes a
moderate number of files, a vehicle is found without an index, and each bucket is a random sample of the fleet. Each
addition to a bucket BBBBB is a new file with the next number NNNNN, so its cost depends on its own size, not on that of
the store. Nothing is changed in place: a record replaces the earlier ones of its vehicle with which it shares a drive.
"""

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from calibrator.drive import Equipment, FleetSource
from calibrator.errors import FleetError
from calibrator.files.storage import Storage, open_storage
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.identity import StoreIdentity, bucket_of, read_identity, store_identity, write_identity
from calibrator.summaries.record import Outline, Record, decode_records, encode_records
from calibrator.terminal.progress import shown
from calibrator.terminal.text import counted, dumps, few, reasons_text
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError

__all__ = [
    "StoreReport",
    "SummaryStore",
    "compact_store",
    "existing_store",
    "look_at_store",
    "open_store",
    "require_store_or_nothing",
]

MOST_FILES, LAST_NUMBER = 32, 99_999
"""More files of a bucket than this are merged, as each is opened to read it; largest number of a file. [1]"""
_FILE = re.compile(r"[0-9]{5}-[0-9]{5}\.parquet")


@dataclass(frozen=True, kw_only=True)
class SummaryStore:
    """A store of summaries that exists.

    Attributes
    ----------
    storage : Storage
        Where the store is.
    identity : StoreIdentity
        What all summaries in it have in common.
    """

    storage: Storage
    identity: StoreIdentity

    @property
    def url(self) -> str:
        """Where the store is, for messages."""
        return self.storage.url

    @property
    def _files(self) -> Storage:
        return self.storage.folder("buckets")

    def bucket_of(self, vehicle: str) -> int:
        """Return the bucket of a vehicle."""
        return bucket_of(vehicle, self.identity.buckets)

    def by_bucket(self, vehicles: Iterable[str]) -> dict[int, list[str]]:
        """Group vehicles by bucket, in the order of the buckets."""
        found: dict[int, list[str]] = defaultdict(list)
        for vehicle in vehicles:
            found[self.bucket_of(vehicle)].append(vehicle)
        return dict(sorted(found.items()))

    def buckets(self) -> list[int]:
        """List the buckets that have files, in order.

        Raises
        ------
        FleetError
            If a Parquet file has a name that no file of this store can have, so that it would never be read.
        """
        names, count = [name for name in self._files.names() if name.endswith(".parquet")], self.identity.buckets
        for name in names:
            if not _FILE.fullmatch(name) or int(name[:5]) >= count:
                raise FleetError(
                    f"{self._files.url}/{name}: no file of this store, whose buckets are 00000 to {count - 1:05d} "
                    f"and files BUCKET-NUMBER.parquet; remove it"
                )
        return sorted({int(name[:5]) for name in names})

    def files(self, bucket: int) -> list[str]:
        """Return the names of the files of a bucket, in the order of addition."""
        return [name for name in self._files.names(f"{bucket:05d}-") if _FILE.fullmatch(name)]

    def versions(self) -> dict[str, str]:
        """Return the version of each file of all buckets by name; it changes when the file does."""
        return {entry.name: entry.version for entry in self._files.contents()[1] if _FILE.fullmatch(entry.name)}

    def size_bytes(self) -> int:
        """Return the size of all files. [byte]"""
        return sum(entry.size for entry in self._files.contents()[1])

    def read(self, bucket: int, *, whole: bool = True) -> dict[str, list[Record]]:
        """Read the records of a bucket by vehicle: vehicles sorted by name, records of each in the order of addition.

        Parameters
        ----------
        bucket : int
            Number of the bucket.
        whole : bool
            Whether to read the summaries as well, and not only which drives there are.

        Raises
        ------
        UserError
            If the bucket cannot be read, is damaged, or holds vehicles that belong in another one.
        """
        found: dict[str, list[Record]] = {}
        for name in self.files(bucket):
            where = f"{self._files.url}/{name}"
            for record in decode_records(self._files.read(name), self.identity, where, whole=whole):
                if (right := self.bucket_of(record.vehicle)) != bucket:
                    raise FleetError(
                        f"{where}: vehicle {record.vehicle} belongs into bucket {right:05d}; this file was renamed or "
                        f"copied: remove it and summarise again"
                    )
                older = found.get(record.vehicle, [])
                kept = [each for each in older if set(each.drives).isdisjoint(record.drives)]
                found[record.vehicle] = [*kept, record]
        return dict(sorted(found.items()))

    def outlines(self, bucket: int) -> list[Outline]:
        """Return the outline of each vehicle of a bucket without reading summaries; errors as for :meth:`read`."""
        return [Outline.of(records) for records in self.read(bucket, whole=False).values()]

    def is_empty(self) -> bool:
        """Check whether the store has no usable drive; errors as for :meth:`read`."""
        return not any(outline.drives for bucket in self.buckets() for outline in self.outlines(bucket))

    def append(self, bucket: int, records: Iterable[Record]) -> None:
        """Write records as a new file of a bucket, and merge its files if they are many; UserError if that fails."""
        with self.storage.locked():
            self._append(bucket, records)
            if len(self.files(bucket)) > MOST_FILES:
                self._merge(bucket)

    def _append(self, bucket: int, records: Iterable[Record]) -> None:
        files = self.files(bucket)
        number = int(files[-1][6:11]) + 1 if files else 0
        if number > LAST_NUMBER:
            raise FleetError(f"{self._files.url}: {LAST_NUMBER + 1} additions to a bucket; summarise into a new store")
        self._files.write(f"{bucket:05d}-{number:05d}.parquet", encode_records(list(records), self.identity))

    def compact(self, bucket: int) -> None:
        """Merge the files of a bucket into one.

        If the program is killed midway, old and new files stay, and no record counts twice.
        """
        with self.storage.locked():
            self._merge(bucket)

    def _merge(self, bucket: int) -> None:
        old = self.files(bucket)
        self._append(bucket, [record for records in self.read(bucket).values() for record in records])
        for name in old:
            self._files.remove(name)


def require_store_or_nothing(storage: Storage) -> None:
    """Check, before any drive is read, that a place is a store of summaries, empty, or not there yet.

    Raises
    ------
    FleetError
        If it is a folder with other content, or a file.
    """
    if storage.is_local and Path(storage.url).is_file():
        raise FleetError(f"{storage.url}: is a file; name a folder for the summaries, or a URL")
    there = storage.names()  # listed before the identity is read, as another machine may be making the store
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
        Where the store is, or will be.
    equipment, database, fleet : Equipment, VehicleDatabase, FleetSource
        Branches and inputs, DBC and layout, and the fleet whose drives are to be added.
    bank : FilterBank or None
        Filters of the fleet's inputs; None: those of the store, or the plain inputs for a new one.

    Returns
    -------
    SummaryStore
        Store to which the drives can be added.

    Raises
    ------
    FleetError
        If there is a store with another layout, DBC, branches, inputs or filter bank, or the bank has other inputs.
    """
    if bank is not None and bank.input_names != equipment.fleet_inputs:
        raise FleetError(
            f"the filter bank is for the inputs {', '.join(bank.input_names)}, this fleet has "
            f"{', '.join(equipment.fleet_inputs)}; choose a bank for it with 'calibrator identify'"
        )
    identity = read_identity(storage, database)
    if identity is None:
        identity = store_identity(equipment, database, bank=bank, vehicles=len(fleet.vehicles), fleet=fleet.name)
        write_identity(storage, identity)
    known, bank = identity.equipment, bank or identity.bank
    for what, its, wanted in (
        ("branches", known.branches, equipment.branches),
        ("inputs", known.fleet_inputs, equipment.fleet_inputs),
        ("filter bank", [identity.bank.identity], [bank.identity]),
    ):
        if its != wanted:
            raise FleetError(
                f"{storage.url}: these drives cannot be added to this store: {what} {', '.join(its)} against "
                f"{', '.join(wanted)}; use another store"
            )
    return SummaryStore(storage=storage, identity=identity)


# ---- ``calibrator store``


@dataclass(kw_only=True)
class StoreReport:
    """What a store holds: size in bytes, duration in hours, and faults by vehicle or bucket.

    ``unusable`` is the number of vehicles that cannot be calibrated.
    """

    store: str
    layout: str
    branches: tuple[str, ...]
    inputs: tuple[str, ...]
    vehicles: int = 0
    unusable: int = 0
    drives: int = 0
    hours: float = 0.0
    files: int = 0
    size_bytes: int
    faults: dict[str, str] = field(default_factory=dict)

    def as_json(self) -> str:
        """Return the report as JSON."""
        return dumps(vars(self))

    def as_text(self) -> str:
        """Return the report as readable text."""
        lines = [
            f"{self.store}: {counted(self.vehicles, 'vehicle')}, {self.unusable} of them cannot be calibrated; "
            f"{counted(self.drives, 'drive')}, {self.hours:.1f} h; {counted(self.files, 'file')}, "
            f"{self.size_bytes / 1e6:.1f} MB",
            f"layout {self.layout}; branches {', '.join(self.branches)}; inputs {few(self.inputs)}",
        ]
        return "\n".join([*lines, *([reasons_text("faults", self.faults)] if self.faults else [])])


def look_at_store(place: str, *, whole: bool = False) -> StoreReport:
    """Count what a store holds, and find its faults.

    Parameters
    ----------
    place : str
        Path or URL.
    whole : bool
        Whether to read everything, and to look for damage and for recordings that several vehicles share; otherwise
        only names of vehicles and drives are read.

    Returns
    -------
    StoreReport
        What the store holds, and its faults by vehicle or bucket.

    Raises
    ------
    FleetError
        If there is no store at the place, or it has a Parquet file with a name that none of its files can have.
    """
    store, owners = existing_store(place), dict[str, str]()
    about, buckets = store.identity, store.buckets()
    report = StoreReport(
        store=place,
        layout=about.layout,
        branches=about.equipment.branches,
        inputs=about.equipment.fleet_inputs,
        size_bytes=store.size_bytes(),
    )
    for bucket in shown(buckets, "look at vehicles", len(buckets), "buckets"):
        report.files += len(store.files(bucket))
        try:
            found = store.read(bucket, whole=whole)
        except UserError as error:
            report.faults[f"bucket {bucket:05d}"] = str(error)
            continue
        for name, records in found.items():
            outline = Outline.of(records)
            report.vehicles += 1
            report.unusable += bool(outline.problem)
            report.drives += len(outline.drives)
            report.hours += sum(record.duration_s for record in records) / 3600.0
            for digest in {digest for record in records if not record.problem for digest in record.digests}:
                if whole and (other := owners.setdefault(digest, name)) != name:
                    report.faults[name] = f"has a recording that {other} has as well; remove it where it is wrong"
    return report


def compact_store(place: str) -> int:
    """Merge the files of each bucket into one; return how many buckets that changed. FleetError if it is no store."""
    store = existing_store(place)
    many = [bucket for bucket in store.buckets() if len(store.files(bucket)) > 1]
    for bucket in shown(many, "put files together", len(many), "buckets"):
        store.compact(bucket)
    return len(many)


def existing_store(place: str | Path) -> SummaryStore:
    """Open a store; FleetError if there is none."""
    storage = open_storage(place)
    identity = read_identity(storage)
    if identity is None:
        raise FleetError(f"{place}: no store of summaries there; make one with 'calibrator summarise --out'")
    return SummaryStore(storage=storage, identity=identity)
