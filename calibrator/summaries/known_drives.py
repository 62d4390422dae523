"""Which drives of a fleet a store of summaries has as they are now, and which are to be read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calibrator.drive import DriveFile
from calibrator.sources.fleet_source import FleetSource
from calibrator.summaries.record import Record, source_version
from calibrator.summaries.store import SummaryStore

__all__ = ["NewDrives", "new_drives", "remove_others", "stays"]


@dataclass(frozen=True, kw_only=True)
class NewDrives:
    """Drives of a vehicle to be read, and which version of each drive there is."""

    entries: tuple[DriveFile, ...]
    versions: Mapping[str, str]


def new_drives(
    records: Mapping[str, Sequence[Record]], fleet: FleetSource, names: Sequence[str], *, retry: bool
) -> list[NewDrives]:
    """Vehicles of a bucket that have drives which no record holds as they are now.

    A record is made anew with all its drives if one of them was changed; what could not be used is tried again if it
    was changed, or if that is asked for.
    """
    found = []
    for name in names:
        versions = {entry.name: source_version(entry.path) for entry in fleet.vehicles[name]}
        stored = records.get(name, [])
        kept = [item for item in stored if stays(item, versions) and not (item.damaged or (retry and item.problem))]
        there = {drive for record in kept for drive in record.drives}
        entries = tuple(entry for entry in fleet.vehicles[name] if entry.name not in there)
        if entries:
            found.append(NewDrives(entries=entries, versions=versions))
    return found


def stays(record: Record, versions: Mapping[str, str]) -> bool:
    """Whether a record is still right, or cannot be made anew as not all of its drives are given."""
    known = zip(record.drives, record.sources, strict=True)
    return not versions.keys() >= set(record.drives) or all(versions[drive] == source for drive, source in known)


def remove_others(store: SummaryStore, fleet: FleetSource) -> None:
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
