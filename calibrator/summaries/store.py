"""A store of summaries: ``STORE/summaries.json`` and ``STORE/buckets/NNNNN.parquet``.

Vehicles are spread over a fixed number of buckets by a hash of their names, so that any number of vehicles makes a
moderate number of files of moderate size, a vehicle is found without an index, and each bucket is a random sample of
the fleet. A bucket is written whole or not at all.
"""

import fcntl
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from calibrator.drives.plain_names import is_plain_name
from calibrator.errors import FleetError
from calibrator.files.storage import Storage
from calibrator.summaries.buckets import bucket_of
from calibrator.summaries.identity import StoreIdentity
from calibrator.summaries.record import Outline, Record
from calibrator.summaries.table import decode_outlines, decode_records, encode_records

__all__ = ["SummaryStore"]

_BUCKET = re.compile(r"[0-9]{5}\.parquet")


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
        names = [name for name in self._files.names() if name.endswith(".parquet")]
        count = self.identity.buckets
        for name in names:
            if not (_BUCKET.fullmatch(name) and int(name[:5]) < count):
                raise FleetError(
                    f"{self._files.url}/{name}: no bucket of this store, whose buckets are {_file(0)} to "
                    f"{_file(count - 1)}; remove it"
                )
        return [int(name[:5]) for name in names]

    def versions(self) -> dict[str, str]:
        """What tells whether a bucket was changed, by file."""
        return self._files.versions()

    def by_bucket(self, vehicles: Iterable[str]) -> dict[int, list[str]]:
        """Vehicles by the bucket that they are in."""
        found: dict[int, list[str]] = defaultdict(list)
        for vehicle in vehicles:
            found[self.bucket_of(vehicle)].append(vehicle)
        return dict(sorted(found.items()))

    def read(self, bucket: int) -> dict[str, list[Record]]:
        """Records of a bucket by vehicle, in the order of their names; none if there is no such bucket.

        Raises
        ------
        UserError
            If the bucket cannot be read or is damaged.
        """
        name = _file(bucket)
        content = self._files.read_if_there(name)
        if content is None:
            return {}
        records = decode_records(content, self.identity, f"{self._files.url}/{name}")
        found: dict[str, list[Record]] = {}
        for record in records:
            found.setdefault(record.vehicle, []).append(record)
        self._require_in(bucket, found)
        return found

    def outlines(self, bucket: int) -> list[Outline]:
        """What there is of each vehicle of a bucket; raises as :meth:`read`."""
        content = self._files.read(_file(bucket))
        outlines = decode_outlines(content, f"{self._files.url}/{_file(bucket)}")
        self._require_in(bucket, [item.vehicle for item in outlines])
        return outlines

    def _require_in(self, bucket: int, vehicles: Iterable[str]) -> None:
        """Refuse a bucket with vehicles of another; those whose names no vehicle may have are left out anyway."""
        for name in vehicles:
            right = self.bucket_of(name)
            if right != bucket and is_plain_name(name):
                raise FleetError(
                    f"{self._files.url}/{_file(bucket)}: vehicle {name} belongs into {_file(right)}; this file was "
                    f"renamed or copied: remove it and summarise again"
                )

    def write(self, bucket: int, records: Mapping[str, Sequence[Record]]) -> None:
        """Replace a bucket, whole or not at all.

        Raises
        ------
        UserError
            If it cannot be written.
        """
        rows = [record for vehicle in sorted(records) for record in records[vehicle]]
        self._files.write(_file(bucket), encode_records(rows, self.identity))

    @contextmanager
    def locked(self) -> Iterator[None]:
        """While no other process of this machine does the same; other storage than folders has no locks."""
        if not self.storage.is_local:
            yield
            return
        handle = os.open(self.storage.url, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)

    @property
    def _files(self) -> Storage:
        return self.storage.folder("buckets")


def _file(bucket: int) -> str:
    return f"{bucket:05d}.parquet"
