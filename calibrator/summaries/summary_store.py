"""A store of summaries: ``STORE/summaries.json`` and ``STORE/buckets/BBBBB-NNNNN.parquet``.

Vehicles are spread over a fixed number of buckets by a hash of their names, so that any number of vehicles makes a
moderate number of files, a vehicle is found without an index, and each bucket is a random sample of the fleet. Each
addition to a bucket BBBBB is a new file with the next number NNNNN, so its cost depends on its own size, not on that of
the store. A file ``BBBBB-NNNNN.whole.parquet`` replaces all earlier files of its bucket; these are removed once it is
written, and are ignored if a run was killed before it removed them.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
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

_FILE = re.compile(r"(?P<bucket>[0-9]{5})-(?P<number>[0-9]{5})(?P<whole>\.whole)?\.parquet")
Records = Mapping[str, Sequence[Record]]
"""Records by vehicle."""


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
            If there is a Parquet file whose name is not that of a file of this store; it would never be read.
        """
        found, count = set[int](), self.identity.buckets
        for name in self._files.names():
            if name.endswith(".parquet"):
                parts = _FILE.fullmatch(name)
                if parts is None or int(parts["bucket"]) >= count:
                    raise FleetError(
                        f"{self._files.url}/{name}: no file of this store, whose buckets are 00000 to {count - 1:05d} "
                        f"and files BUCKET-NUMBER.parquet; remove it"
                    )
                found.add(int(parts["bucket"]))
        return sorted(found)

    def files(self, bucket: int) -> tuple[list[str], list[str]]:
        """Return the files of a bucket that count, and those that have been replaced, each in the order of addition."""
        names = [name for name in self._files.names(f"{bucket:05d}-") if _FILE.fullmatch(name)]
        first = max((k for k, name in enumerate(names) if ".whole." in name), default=0)
        return names[first:], names[:first]

    def versions(self) -> dict[str, str]:
        """Return the version of each file of all buckets by name; it changes when the file does."""
        return {entry.name: entry.version for entry in self._files.contents()[1]}

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
        names, found = self.files(bucket)[0], dict[str, list[Record]]()
        where = f"{self._files.url}/{names[0] if len(names) == 1 else f'{bucket:05d}-*.parquet'}" if names else ""
        contents = [self._files.read(name) for name in names]
        for record in decode_records(contents, self.identity, where, whole=whole):
            found.setdefault(record.vehicle, []).append(record)
        for name in found:
            if (right := self.bucket_of(name)) != bucket:
                raise FleetError(
                    f"{where}: vehicle {name} belongs into bucket {right:05d}; this file was renamed or copied: remove "
                    f"it and summarise again"
                )
        return dict(sorted(found.items()))

    def outlines(self, bucket: int) -> list[Outline]:
        """Return the outline of each vehicle of a bucket without reading summaries; errors as for :meth:`read`."""
        return [Outline.of(records) for records in self.read(bucket, whole=False).values()]

    def append(self, bucket: int, records: Records, *, whole: bool = False) -> None:
        """Write records as a new file of a bucket; with `whole` it replaces the bucket. UserError if that fails."""
        old = [name for names in self.files(bucket)[::-1] for name in names]
        number = int(old[-1][6:11]) + 1 if old else 0
        content = encode_records([record for name in sorted(records) for record in records[name]], self.identity)
        self._files.write(f"{bucket:05d}-{number:05d}{'.whole' * whole}.parquet", content)
        for name in old if whole else ():
            self._files.remove(name)

    def change(
        self, bucket: int, change: Callable[[Record], Record | None], new: Sequence[Record] = (), *, whole: bool = False
    ) -> None:
        """Replace each record of a bucket by what a function returns for it (None: remove it), and add new records.

        The function must not look at summaries: it is called without them first. The bucket is rewritten only if the
        function changes a record, or if `whole` is true. The bucket is locked against other processes of this machine;
        storage that is not a folder has no locks.
        """
        added = {record.vehicle: [record] for record in new}
        with self.storage.locked():
            old = [record for records in self.read(bucket, whole=False).values() for record in records]
            if not whole and all(change(record) is record for record in old):
                if added:
                    self.append(bucket, added)
                return
            records = {
                name: [left for record in items if (left := change(record)) is not None]
                for name, items in self.read(bucket).items()
            }
            records |= {name: [*records.get(name, ()), *items] for name, items in added.items()}
            self.append(bucket, records, whole=True)


def require_store_or_nothing(storage: Storage) -> None:
    """Check, before any drive is read, that a place is a store of summaries, empty, or not there yet.

    Raises
    ------
    FleetError
        If it is a folder with other content, a file, or storage that ends with this process (``memory://``).
    """
    if storage.is_local and Path(storage.url).is_file():
        raise FleetError(f"{storage.url}: is a file; name a folder for the summaries, or a URL")
    if not storage.lasts:
        raise FleetError(
            f"{storage.url}: is gone when the command ends; name a folder for the summaries, or another URL"
        )
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
    identity = read_identity(storage, database)
    if bank is None and identity is not None and identity.fleet_inputs == equipment.fleet_inputs:
        bank = identity.bank
    if bank is not None and bank.input_names != equipment.fleet_inputs:
        raise FleetError(
            f"the filter bank is for the inputs {', '.join(bank.input_names)}, this fleet has "
            f"{', '.join(equipment.fleet_inputs)}; choose a bank for it with 'calibrator identify'"
        )
    wanted = store_identity(equipment, database, bank=bank, vehicles=len(fleet.vehicles), fleet=fleet.name)
    if identity is None:
        write_identity(storage, wanted)
        identity = read_identity(storage, database)  # another process may have just made the store
        assert identity is not None
    if difference := identity.difference(wanted):
        raise FleetError(f"{storage.url}: these drives cannot be added to this store: {difference}; use another store")
    return SummaryStore(storage=storage, identity=identity)


# ---- ``calibrator store``


@dataclass(kw_only=True)
class StoreReport:
    """What a store holds: size in bytes, duration in hours, and faults by vehicle, bucket or file.

    `unusable` of the vehicles cannot be calibrated.
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
        """The report as JSON."""
        return dumps(vars(self))

    def as_text(self) -> str:
        """The report for people."""
        lines = [
            f"{self.store}: {counted(self.vehicles, 'vehicle')}, {self.unusable} of them without usable drives; "
            f"{counted(self.drives, 'drive')}, {self.hours:.1f} h; {counted(self.files, 'file')}, "
            f"{self.size_bytes / 1e6:.1f} MB",
            f"layout {self.layout}; branches {', '.join(self.branches)}; inputs {few(self.inputs)}",
        ]
        return "\n".join([*lines, *([reasons_text("faults:", self.faults)] if self.faults else [])])


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
        What the store holds, and its faults by vehicle, bucket or file.

    Raises
    ------
    FleetError
        If there is no store at the place.
    """
    store, owners = existing_store(place), dict[str, str]()
    about, buckets = store.identity, store.buckets()
    report = StoreReport(
        store=place,
        layout=about.layout,
        branches=about.branches,
        inputs=about.fleet_inputs,
        size_bytes=store.size_bytes(),
    )
    for bucket in shown(buckets, "look at vehicles", len(buckets), "buckets"):
        current, old = store.files(bucket)
        report.files += len(current) + len(old)
        report.faults |= dict.fromkeys(old, "does not count any more, as a run was killed: 'calibrator store compact'")
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
            for record in records if whole else ():
                for digest in record.digests if not record.problem else ():
                    if (other := owners.setdefault(digest, name)) != name:
                        problem = f"has a recording that {other} has as well; remove it where it is wrong"
                        report.faults[name] = problem
    return report


def compact_store(place: str) -> int:
    """Merge the files of each bucket into one; return how many buckets that changed. FleetError if it is no store."""
    store = existing_store(place)
    many = [bucket for bucket in store.buckets() if sum(map(len, store.files(bucket))) > 1]
    for bucket in shown(many, "put files together", len(many), "buckets"):
        store.change(bucket, lambda record: record, whole=True)
    return len(many)


def existing_store(place: str | Path) -> SummaryStore:
    """Open a store; FleetError if there is none."""
    storage = open_storage(place)
    identity = read_identity(storage)
    if identity is None:
        raise FleetError(f"{place}: no store of summaries there; make one with 'calibrator summarise --out'")
    return SummaryStore(storage=storage, identity=identity)
