"""What a store of summaries holds; whether it is sound; its files put together."""

from collections.abc import Mapping
from dataclasses import dataclass

from calibrator.errors import FleetError
from calibrator.files.storage import open_storage
from calibrator.summaries.identity import read_identity
from calibrator.summaries.store import SummaryStore
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import counted, dumps, few, reasons_text
from ecu_node.errors import UserError

__all__ = ["CompactReport", "StoreReport", "compact_store", "look_at_store"]


@dataclass(frozen=True, kw_only=True)
class StoreReport:
    """What a store holds; sizes in bytes, durations in hours."""

    store: str
    layout: str
    branches: tuple[str, ...]
    inputs: tuple[str, ...]
    vehicles: int
    unusable: int
    drives: int
    hours: float | None
    files: int
    size_bytes: int
    faults: Mapping[str, str]

    def as_json(self) -> str:
        """The report as JSON."""
        return dumps(vars(self))

    def as_text(self) -> str:
        """The report for people."""
        hours = "" if self.hours is None else f", {self.hours:.1f} h"
        lines = [
            f"{self.store}: {counted(self.vehicles, 'vehicle')}, {self.unusable} of them without usable drives; "
            f"{counted(self.drives, 'drive')}{hours}; {counted(self.files, 'file')}, {self.size_bytes / 1e6:.1f} MB",
            f"layout {self.layout}; branches {', '.join(self.branches)}; inputs {few(self.inputs)}",
        ]
        return "\n".join([*lines, *([reasons_text("faults:", self.faults)] if self.faults else [])])


def look_at_store(place: str, *, whole: bool = False) -> StoreReport:
    """Look at a store.

    Parameters
    ----------
    place : str
        Path or URL.
    whole : bool
        Whether to read all that it holds, and to look for damage and for recordings that several vehicles have; else
        names of vehicles and drives only.

    Returns
    -------
    StoreReport
        What was found; faults by vehicle or file.

    Raises
    ------
    FleetError
        If it is no store.
    """
    store, faults, vehicles, unusable, drives, files = _open(place), dict[str, str](), 0, 0, 0, 0
    owners, hours = dict[str, str](), 0.0
    buckets = store.buckets()
    with progress_bar("look at vehicles", len(buckets), "buckets") as progress:
        for done, bucket in enumerate(buckets, 1):
            current, old = store.files(bucket)
            files += len(current) + len(old)
            faults |= dict.fromkeys(old, "does not count any more, as a run was killed: 'calibrator store compact'")
            try:
                outlines = store.outlines(bucket)
                vehicles += len(outlines)
                unusable += sum(bool(item.problem) for item in outlines)
                drives += sum(len(item.drives) for item in outlines)
                for name, records in store.read(bucket).items() if whole else ():
                    for record in records:
                        hours += 0.0 if record.found is None else record.found.summary.duration_s / 3600.0
                        if record.damaged:
                            faults[name] = record.problem
                        for digest in record.digests if record.found else ():
                            other = owners.setdefault(digest, name)
                            if other != name:
                                faults[name] = f"has a recording that {other} has as well; remove it where it is wrong"
            except UserError as error:
                faults[f"bucket {bucket:05d}"] = str(error)
            progress(done)
    return StoreReport(
        store=place,
        layout=store.identity.layout,
        branches=store.identity.branches,
        inputs=store.identity.fleet_inputs,
        vehicles=vehicles,
        unusable=unusable,
        drives=drives,
        hours=hours if whole else None,
        files=files,
        size_bytes=store.size_bytes(),
        faults=faults,
    )


@dataclass(frozen=True, kw_only=True)
class CompactReport:
    """What was put together: numbers of buckets written anew and of damaged records removed."""

    store: str
    buckets: int
    removed: int

    def as_json(self) -> str:
        """The report as JSON."""
        return dumps(vars(self))

    def as_text(self) -> str:
        """The report for people."""
        done = f"{counted(self.buckets, 'bucket')} written anew, {counted(self.removed, 'damaged record')} removed"
        return f"{self.store}: {done}"


def compact_store(place: str) -> CompactReport:
    """Make one file of each bucket, without damaged records. FleetError if it is no store."""
    store, merged, removed = _open(place), 0, 0
    buckets = store.buckets()
    with progress_bar("put files together", len(buckets), "buckets") as progress:
        for done, bucket in enumerate(buckets, 1):
            with store.locked():
                records = store.read(bucket)
                sound = {name: [item for item in items if not item.damaged] for name, items in records.items()}
                lost = sum(map(len, records.values())) - sum(map(len, sound.values()))
                if lost or sum(map(len, store.files(bucket))) > 1:
                    store.write(bucket, sound)
                    merged, removed = merged + 1, removed + lost
            progress(done)
    return CompactReport(store=place, buckets=merged, removed=removed)


def _open(place: str) -> SummaryStore:
    storage = open_storage(place)
    identity = read_identity(storage)
    if identity is None:
        raise FleetError(f"{place}: no store of summaries there; make one with 'calibrator summarise --out'")
    return SummaryStore(storage=storage, identity=identity)
