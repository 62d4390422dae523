"""CAN logs of one or many vehicles into a drive store. One bad log never stops the others."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from calibrator.drive import DriveFile
from calibrator.drives.fleet_id import read_fleet_ids, write_fleet_ids
from calibrator.drives.store import has_drive, write_drive
from calibrator.processes.messages import Unread
from calibrator.processes.reading import TIME_LIMIT_S, read_in_processes
from calibrator.recordings.readers import read_recording
from calibrator.sources.logs import find_logs
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import Notice, dumps, left_out_text, merged_notices, table
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError

__all__ = ["ImportReport", "ImportedDrive", "import_logs"]


@dataclass(frozen=True, kw_only=True)
class ImportedDrive:
    """One drive that was written."""

    vehicle: str
    name: str
    duration_s: float
    branches: tuple[str, ...]
    notices: tuple[Notice, ...]


@dataclass(frozen=True, kw_only=True)
class ImportReport:
    """What an import did."""

    store: str
    drives: tuple[ImportedDrive, ...]
    already_there: tuple[str, ...]
    """Drives, VEHICLE/NAME, that an earlier import has written; they were not read again."""
    left_out: dict[str, str]

    def as_json(self) -> str:
        """The report as JSON, with the notices of every drive."""
        drives = [{**vars(drive), "notices": list(map(str, drive.notices))} for drive in self.drives]
        return dumps({**vars(self), "drives": drives})

    def as_text(self) -> str:
        """The report for people; a notice that several drives share is told once."""
        rows = [(d.vehicle, d.name, f"{d.duration_s:.1f}", ", ".join(d.branches)) for d in self.drives]
        notices = [f"  {line}" for line in merged_notices({(d.vehicle, d.name): d.notices for d in self.drives})]
        parts = [
            table(("vehicle", "drive", "duration [s]", "branches"), rows) if rows else "",
            "\n".join(["notices:", *notices]) if notices else "",
            left_out_text(self.left_out),
            f"{len(self.drives)} drives written to {self.store}, {len(self.already_there)} already there, "
            f"{len(self.left_out)} left out",
        ]
        return "\n\n".join(part for part in parts if part)


def import_logs(
    logs: Sequence[Path], database: VehicleDatabase, store: Path, *, workers: int, limit_s: float = TIME_LIMIT_S
) -> ImportReport:
    """Read logs and add their drives to a store.

    Parameters
    ----------
    logs : sequence of Path
        Log files, or folders to search; see :mod:`calibrator.sources.logs` for which vehicle a log belongs to.
    database : VehicleDatabase
        DBC and layout.
    store : Path
        Folder of the store; made if there is none.
    workers : int
        Number of processes.
    limit_s : float
        Longest time for one log; one that takes longer is left out. [s]

    Returns
    -------
    ImportReport
        What was written, what was there already, and what was left out and why.
    """
    found = find_logs(logs)
    left_out = {f"problem {k + 1}": str(problem) for k, problem in enumerate(found.problems)}
    drives: list[ImportedDrive] = []
    already_there: list[str] = []
    read = partial(_import_one, database=database, store=store)
    reading = read_in_processes(read, found.logs, workers=workers, limit_s=limit_s)
    with progress_bar("import", len(found.logs), "logs") as progress, closing(reading) as runs:
        for done, (log, outcome) in enumerate(zip(found.logs, runs, strict=True), start=1):
            if isinstance(outcome, ImportedDrive):
                drives.append(outcome)
            elif outcome is None:
                already_there.append(f"{log.vehicle}/{log.name}")
            elif isinstance(outcome, Unread):
                left_out[f"{log.vehicle}/{log.name}"] = f"{log.path}: {outcome.reason}"
            else:
                left_out[f"{log.vehicle}/{log.name}"] = outcome
            progress(done)
    if drives:
        _note_fleets(store, found.logs)
    return ImportReport(store=str(store), drives=tuple(drives), already_there=tuple(already_there), left_out=left_out)


def _note_fleets(store: Path, logs: Sequence[DriveFile]) -> None:
    """Carry over which artificial fleets the logs are of."""
    folders = {log.path.resolve().parent.parent for log in logs}
    fleet_ids = read_fleet_ids(store).union(*(read_fleet_ids(folder) for folder in folders if folder.is_dir()))
    if fleet_ids:
        write_fleet_ids(store, fleet_ids)


def _import_one(log: DriveFile, database: VehicleDatabase, store: Path) -> ImportedDrive | str | None:
    """Import one log; the text of the error if it cannot be used; None if it was imported before."""
    try:
        if has_drive(store, log.vehicle, log.name, database.layout):
            return None
        recording = read_recording(log.path, database, vehicle=log.vehicle, name=log.name)
        write_drive(store, recording.drive, database.layout)
    except UserError as error:
        return str(error)
    drive = recording.drive
    return ImportedDrive(
        vehicle=drive.vehicle,
        name=drive.name,
        duration_s=drive.duration_s,
        branches=tuple(drive.branches),
        notices=tuple(recording.report.notices()),
    )
