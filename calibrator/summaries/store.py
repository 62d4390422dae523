"""A store of summaries: ``STORE/summaries.json`` and ``STORE/buckets/BBBBB-NNNNN.parquet``.

Vehicles are spread over a fixed number of buckets by a hash of their names, so that any number of vehicles makes a
moderate number of files, a vehicle is found without an index, and each bucket is a random sample of the fleet. What is
added to a bucket is a file of its own, numbered upwards: it costs what it is, not what the store is. A file
``BBBBB-NNNNN.whole.parquet`` stands for all that was there before it; older ones are removed after it is written, and
do not count if a run was killed before.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from calibrator.drives.store import is_plain_name
from calibrator.errors import FleetError
from calibrator.files.storage import Storage
from calibrator.sources.fleet_source import Equipment, FleetSource
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.identity import StoreIdentity, bucket_of, read_identity, store_identity, write_identity
from calibrator.summaries.record import Known, Outline, Record
from calibrator.summaries.table import decode_known, decode_outlines, decode_records, encode_records
from calibrator.terminal.text import few
from ecu_node.database import VehicleDatabase

__all__ = ["SummaryStore", "open_store", "require_store_or_nothing"]

_FILE = re.compile(r"(?P<bucket>[0-9]{5})-(?P<number>[0-9]{5})(?P<whole>\.whole)?\.parquet")
_Row = TypeVar("_Row", Record, Known, Outline)


@dataclass(frozen=True, kw_only=True)
class SummaryStore:
    """An open store.

    Attributes
    ----------
    storage : Storage
        Where it is.
    identity : StoreIdentity
        What its summaries have in common.
    """

    storage: Storage
    identity: StoreIdentity

    @property
    def url(self) -> str:
        """Where the store is, for messages."""
        return self.storage.url

    def bucket_of(self, vehicle: str) -> int:
        """Bucket of a vehicle."""
        return bucket_of(vehicle, self.identity.buckets)

    def buckets(self) -> list[int]:
        """Buckets in which there are vehicles, in order.

        Raises
        ------
        FleetError
            If there is a file that would not be read, though it looks like one with vehicles.
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

    def versions(self) -> dict[str, str]:
        """What tells whether a file was changed, by name."""
        return {entry.name: entry.version for entry in self._files.contents()[1]}

    def by_bucket(self, vehicles: Iterable[str]) -> dict[int, list[str]]:
        """Vehicles by the bucket that they are in."""
        found: dict[int, list[str]] = defaultdict(list)
        for vehicle in vehicles:
            found[self.bucket_of(vehicle)].append(vehicle)
        return dict(sorted(found.items()))

    def read(self, bucket: int) -> dict[str, list[Record]]:
        """Records of a bucket by vehicle, in the order of their names, and of their addition; none if it is empty.

        Raises
        ------
        UserError
            If the bucket cannot be read or is damaged.
        """
        return self._by_vehicle(bucket, lambda content, where: decode_records(content, self.identity, where))

    def known(self, bucket: int) -> dict[str, list[Known]]:
        """Which drives the records of a bucket are of, as :meth:`read` but without their moments."""
        return self._by_vehicle(bucket, decode_known)

    def outlines(self, bucket: int) -> list[Outline]:
        """What there is of each vehicle of a bucket; raises as :meth:`read`."""
        return self._rows(bucket, decode_outlines)

    def write(self, bucket: int, records: Mapping[str, Sequence[Record]]) -> None:
        """Replace a bucket, whole or not at all; UserError if it cannot be written."""
        old = self._names(bucket)
        self._files.write(_file(bucket, _next(old), whole=True), self._encoded(records))
        for name in old:
            self._files.remove(name)

    def append(self, bucket: int, records: Mapping[str, Sequence[Record]]) -> None:
        """Add records to a bucket, whole or not at all; UserError if they cannot be written."""
        self._files.write(_file(bucket, _next(self._names(bucket)), whole=False), self._encoded(records))

    def files(self, bucket: int) -> tuple[list[str], list[str]]:
        """Files of a bucket that count, and those that do not any more, in the order of their addition."""
        names = self._names(bucket)
        first = max((k for k, name in enumerate(names) if ".whole." in name), default=0)
        return names[first:], names[:first]

    def size_bytes(self) -> int:
        """Size of its files. [byte]"""
        return sum(entry.size for entry in self._files.contents()[1])

    def locked(self) -> AbstractContextManager[None]:
        """While no other process of this machine does the same; other storage than folders has no locks."""
        return self.storage.locked()

    @property
    def _files(self) -> Storage:
        return self.storage.folder("buckets")

    def _names(self, bucket: int) -> list[str]:
        return [name for name in self._files.names(f"{bucket:05d}-") if _FILE.fullmatch(name)]

    def _encoded(self, records: Mapping[str, Sequence[Record]]) -> bytes:
        return encode_records([record for vehicle in sorted(records) for record in records[vehicle]], self.identity)

    def _rows(self, bucket: int, decode: "Callable[[Sequence[bytes], str], list[_Row]]") -> "list[_Row]":
        """What the files of a bucket hold; refuse vehicles of another one, but not names that no vehicle may have."""
        names = self.files(bucket)[0]
        where = f"{self._files.url}/{names[0] if len(names) == 1 else f'{bucket:05d}-*.parquet'}" if names else ""
        rows = decode([self._files.read(name) for name in names], where)
        for name in {row.vehicle for row in rows}:
            right = self.bucket_of(name)
            if right != bucket and is_plain_name(name):
                raise FleetError(
                    f"{where}: vehicle {name} belongs into bucket {right:05d}; this file was renamed or copied: remove "
                    f"it and summarise again"
                )
        return rows

    def _by_vehicle(
        self, bucket: int, decode: "Callable[[Sequence[bytes], str], list[_Row]]"
    ) -> "dict[str, list[_Row]]":
        found: dict[str, list[_Row]] = {}
        for row in self._rows(bucket, decode):
            found.setdefault(row.vehicle, []).append(row)
        return dict(sorted(found.items()))


def _file(bucket: int, number: int, *, whole: bool) -> str:
    return f"{bucket:05d}-{number:05d}{'.whole' if whole else ''}.parquet"


def _next(names: Sequence[str]) -> int:
    return int(names[-1][6:11]) + 1 if names else 0


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
    vehicles, ids = len(fleet.vehicles), fleet.fleet_ids
    wanted = store_identity(equipment, database, bank=bank, vehicles=vehicles, fleet=fleet.name, fleet_ids=ids)
    if identity is None:
        write_identity(storage, wanted)
        identity = read_identity(storage, database)  # another process may have made the store just now
        assert identity is not None
    if difference := identity.difference(wanted):
        raise FleetError(f"{storage.url}: these drives cannot be added to this store: {difference}; use another store")
    return SummaryStore(storage=storage, identity=identity)
