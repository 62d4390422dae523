"""Import logs of one or many vehicles as drives of a store. A log that cannot be used does not stop the import."""

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from calibrator.drive import DriveFile
from calibrator.drives.store import has_drive, remove_leftovers, write_drive
from calibrator.files.storage import StorageError, local_copy, open_storage
from calibrator.processes.run_many import Failed, Workers, try_many_shown
from calibrator.recordings.readers import read_recording
from calibrator.sources.fleet_source import find_logs
from calibrator.terminal.options import TIME_LIMIT_S
from calibrator.terminal.text import Notice, counted, dumps, left_out_text, merged_notices, table
from ecu_node.database import VehicleDatabase

__all__ = ["ImportReport", "ImportedDrive", "import_logs"]


@dataclass(frozen=True, kw_only=True)
class ImportedDrive:
    """One drive that was written, its duration [s], branches and notices."""

    vehicle: str
    name: str
    duration_s: float
    branches: tuple[str, ...]
    notices: tuple[Notice, ...]


@dataclass(frozen=True, kw_only=True)
class ImportReport:
    """Result of an import: drives written, already there and left out."""

    store: str
    drives: tuple[ImportedDrive, ...]
    already_there: tuple[str, ...]
    """Drives (VEHICLE/NAME) that an earlier import wrote; their logs were not read again."""
    left_out: dict[str, str]

    def as_json(self) -> str:
        """Return the report as JSON, with the notices of every drive."""
        drives = [{**vars(drive), "notices": list(map(str, drive.notices))} for drive in self.drives]
        return dumps({**vars(self), "drives": drives})

    def as_text(self) -> str:
        """Return the report as readable text; a notice that several drives share appears once."""
        rows = [(d.vehicle, d.name, f"{d.duration_s:.1f}", ", ".join(d.branches)) for d in self.drives]
        notices = [f"  {line}" for line in merged_notices({(d.vehicle, d.name): d.notices for d in self.drives})]
        parts = [
            table(("vehicle", "drive", "duration [s]", "branches"), rows) if rows else "",
            "\n".join(["notices:", *notices]) if notices else "",
            left_out_text(self.left_out),
            f"{counted(len(self.drives), 'drive')} written to {self.store}, {len(self.already_there)} already there, "
            f"{len(self.left_out)} left out",
        ]
        return "\n\n".join(part for part in parts if part)


def import_logs(
    logs: Sequence[str | Path],
    database: VehicleDatabase,
    store: str | Path,
    *,
    workers: Workers,
    limit_s: float = TIME_LIMIT_S,
) -> ImportReport:
    """Read logs and add their drives to a store.

    Parameters
    ----------
    logs : sequence of str or Path
        Log files, or folders to search, see :mod:`calibrator.sources.fleet_source`; paths or URLs.
    database : VehicleDatabase
        DBC and layout.
    store : str or Path
        Path or URL of the store; it is made if there is none.
    workers : Workers
        Where the logs are read.
    limit_s : float
        Longest time for one log; one that takes longer is left out. [s]

    Returns
    -------
    ImportReport
        What was written, what was there already, and what was left out and why.

    Raises
    ------
    UserError
        If a drive cannot be written to the store. The import ends, as later drives could not be written either.
    """
    found, start_s = find_logs(logs), time.time()
    left_out, drives, already_there = dict(found.left_out), list[ImportedDrive](), list[str]()
    read = partial(_import_one, database=database, store=open_storage(store).url)
    entries = (log for vehicle in found.vehicles for log in found.vehicles[vehicle])
    size = sum(found.sizes.values())
    outcomes = try_many_shown(
        read, entries, workers, limit_s=limit_s, label="import", size=size, size_of=lambda log: log.size
    )
    with closing(outcomes):
        for log, outcome in outcomes:
            if isinstance(outcome, StorageError):
                raise outcome
            if isinstance(outcome, ImportedDrive):
                drives.append(outcome)
            elif isinstance(outcome, Failed):
                named = log.place in outcome.reason
                left_out[f"{log.vehicle}/{log.name}"] = outcome.reason if named else f"{log.place}: {outcome.reason}"
            else:
                already_there.append(f"{log.vehicle}/{log.name}")
    if drives:
        remove_leftovers(store, {drive.vehicle for drive in drives}, before_s=start_s)
    return ImportReport(store=str(store), drives=tuple(drives), already_there=tuple(already_there), left_out=left_out)


def _import_one(log: DriveFile, database: VehicleDatabase, store: str) -> ImportedDrive | StorageError | None:
    """Import one log; None if it was imported before, StorageError if its drive cannot be written."""
    if has_drive(store, log.vehicle, log.name, database.layout):
        return None
    with local_copy(log.place) as path:
        recording = read_recording(path, database, vehicle=log.vehicle, name=log.name)
    drive = recording.drive
    try:
        write_drive(store, drive, database.layout)
    except StorageError as error:
        return error
    return ImportedDrive(
        vehicle=drive.vehicle,
        name=drive.name,
        duration_s=drive.duration_s,
        branches=tuple(drive.branches),
        notices=tuple(recording.report.notices()),
    )
