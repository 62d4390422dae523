"""The drives of a fleet, wherever they are: a drive store, or folders of logs, on this machine or in object storage.

The rule: a log belongs to the vehicle that its folder is named after, and the drive has the name of the file without
its suffixes: ``FLEET/logs/V0001/monday.log.gz`` is drive ``monday`` of vehicle ``V0001``. Folders and ``.zip`` archives
are searched at any depth; an archive stands for a folder of its name. Logs that lie beside the folders of vehicles,
vehicles whose name stands for two folders, and drives that two files claim, are left out and named.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeVar

from calibrator.drive import Drive, DriveFile
from calibrator.drives.align import choose_inputs
from calibrator.drives.fleet_id import read_fleet_ids
from calibrator.drives.store import DRIVES_FOLDER, is_drive_file, is_plain_name, read_drive_file, require_plain_name
from calibrator.errors import DriveError, FleetError, LogError
from calibrator.files.storage import Entry, Storage, is_url, local_copy, open_storage, walk
from calibrator.processes.run_many import Failed, Workers, try_many
from calibrator.recordings.frames import LOG_SUFFIXES, is_log
from calibrator.recordings.log_files import files_in
from calibrator.recordings.readers import read_drive
from calibrator.terminal.options import TIME_LIMIT_S
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import few, few_reasons
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.layout import Layout
from ecu_node.summary import SUFFIX, SummaryFile, decode_summary

__all__ = [
    "Equipment",
    "FleetSource",
    "find_fleet",
    "find_logs",
    "is_onboard",
    "load_drive",
    "probe_equipment",
    "read_onboard_record",
    "read_vehicles",
]

_Vehicle = TypeVar("_Vehicle")
LOGS_FOLDER = "logs"
PROBED_VEHICLES = 7
"""How many vehicles are looked at to learn which branches and inputs the fleet has."""
MEGABYTE = 1e6


@dataclass(frozen=True, kw_only=True)
class FleetSource:
    """A fleet that can be loaded.

    Attributes
    ----------
    place : str
        Path or URL, as the user named it.
    vehicles : mapping of str to tuple of DriveFile
        Drives by vehicle, sorted.
    left_out : mapping of str to str
        Why a vehicle, or a file where its vehicle is unclear, was left out.
    sizes : mapping of str to int
        Size of the drives of each vehicle. [byte]
    fleet_ids : frozenset of str
        Artificial fleets that the drives come from, see :mod:`calibrator.drives.fleet_id`; empty if unknown.
    """

    place: str
    vehicles: Mapping[str, tuple[DriveFile, ...]]
    left_out: Mapping[str, str] = field(default_factory=dict)
    sizes: Mapping[str, int] = field(default_factory=dict)
    fleet_ids: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        """Name of its folder."""
        return self.place.rstrip("/").rpartition("/")[2] if is_url(self.place) else Path(self.place).resolve().name


@dataclass(frozen=True, kw_only=True)
class Equipment:
    """Which branches and model inputs a fleet has, and what it lacks of the layout's."""

    branches: tuple[str, ...]
    inputs: tuple[str, ...]
    fleet_inputs: tuple[str, ...]
    notices: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Names:
    """Branches and inputs that a drive has."""

    branches: tuple[str, ...]
    inputs: tuple[str, ...]


class _Folders(Mapping[str, tuple[DriveFile, ...]]):
    """Drives by vehicle: a folder is listed again when it is its turn, so a large fleet is its names in memory."""

    def __init__(self, folders: Mapping[str, "Storage | Sequence[DriveFile]"]) -> None:
        self._folders = dict(sorted(folders.items()))

    def __getitem__(self, vehicle: str) -> tuple[DriveFile, ...]:
        folder = self._folders[vehicle]
        drives = _drives_of(vehicle, folder, folder.contents()[1]) if isinstance(folder, Storage) else folder
        return tuple(_without_twins(drives)[0])

    def __contains__(self, vehicle: object) -> bool:
        return vehicle in self._folders

    def __iter__(self) -> Iterator[str]:
        return iter(self._folders)

    def __len__(self) -> int:
        return len(self._folders)


def find_fleet(place: str | Path) -> FleetSource:
    """Find the drives of a fleet; nothing is opened.

    Parameters
    ----------
    place : str or Path
        A drive store, a fleet of ``calibrator simulate``, a folder with a folder of logs per vehicle, or a log. Path or
        URL.

    Returns
    -------
    FleetSource
        At least one vehicle.

    Raises
    ------
    FleetError
        If there is no drive at all.
    """
    storage = open_storage(place)
    if storage.is_local and not Path(storage.url).exists():
        raise FleetError(f"{place}: no such file or folder; give a log, a drive store, or a folder with logs")
    folder = storage
    if not (storage.is_local and Path(storage.url).is_file()):
        inside = storage.contents()[0]
        folder = next((storage.folder(name) for name in (DRIVES_FOLDER, LOGS_FOLDER) if name in inside), storage)
    fleet = find_logs([folder.url])
    if not fleet.vehicles:
        raise FleetError(f"{place}: no drive in it{few_reasons(fleet.left_out)}")
    beside = storage.url.rpartition("/")[0] if folder is storage and Path(storage.url).is_file() else folder.url
    ids = read_fleet_ids(storage.url if folder.url.endswith(f"/{DRIVES_FOLDER}") else beside)
    return FleetSource(
        place=str(place), vehicles=fleet.vehicles, left_out=fleet.left_out, sizes=fleet.sizes, fleet_ids=ids
    )


def find_logs(arguments: Iterable[str | Path]) -> FleetSource:
    """Find logs, or drives of a store, and the vehicles they belong to.

    Parameters
    ----------
    arguments : iterable of str or Path
        Files, or folders to search; paths or URLs.

    Returns
    -------
    FleetSource
        The drives, none perhaps, and what is left out; nothing is opened.
    """
    search = _Search()
    for argument in arguments:
        try:
            search.look_at(open_storage(argument), str(argument))
        except UserError as error:
            search.problems.append(str(error))
    return search.fleet()


@dataclass(kw_only=True)
class _Search:
    """What was found so far."""

    folders: "dict[str, dict[str, Storage | list[DriveFile]]]" = field(default_factory=dict)
    """Of each vehicle its drives by the folder that they are in; more than one is a problem."""
    sizes: Counter[str] = field(default_factory=Counter)
    strays: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def look_at(self, storage: Storage, shown: str) -> None:
        """Look for logs in a folder, an archive, or take a log."""
        path = Path(storage.url)
        if storage.is_local and not path.exists():
            raise LogError(f"{shown}: no such file or folder; give logs that are there")
        if storage.is_local and path.is_file() and path.suffix.lower() != ".zip":
            self._add_files([path])
            return
        found, beside = False, list[str]()
        if storage.is_local and path.is_file():
            found = self._add_files(inner for inner in files_in(path) if is_log(inner))
        for folder, files in walk(storage) if not found else ():
            logs = [entry for entry in files if _is_log(folder, entry.name)]
            for entry in files:
                if folder.is_local and entry.name.lower().endswith(".zip"):
                    inside = files_in(Path(folder.url) / entry.name)
                    found = self._add_files(inner for inner in inside if is_log(inner)) or found
            if logs and folder.url == storage.url:
                beside = [entry.name for entry in logs]
            elif logs:
                found = True
                self._add_folder(folder, logs)
        if beside and found:
            for name in beside:
                self.strays[f"{storage.url}/{name}"] = (
                    f"{storage.url}/{name}: lies beside folders with logs; move it into that of its vehicle, or name "
                    f"the file itself if it is of the vehicle {_folder_name(storage.url)}"
                )
        elif beside:
            self._add_folder(storage, [entry for entry in storage.contents()[1] if entry.name in set(beside)])
        elif not found:
            raise LogError(f"{shown}: no logs in it; expected {', '.join(LOG_SUFFIXES)}, each also with .gz")

    def _add_folder(self, folder: Storage, logs: Sequence[Entry]) -> None:
        vehicle = _folder_name(folder.url)
        if not self._may_be(vehicle, f"{folder.url}: the folder's name, which names the vehicle,"):
            return
        for entry in logs:
            self._may_be(_drive_name(entry.name), f"{folder.url}/{entry.name}: the file's name, which names the drive,")
        if folder.url not in self.folders.get(vehicle, {}):
            self.sizes[vehicle] += sum(entry.size for entry in logs)
        self.folders.setdefault(vehicle, {})[folder.url] = folder
        self.problems += _without_twins(_drives_of(vehicle, folder, logs))[1]

    def _add_files(self, paths: Iterable[Path]) -> bool:
        """Add single files, and those of archives; whether there are any."""
        any_found = False
        for path in paths:
            any_found = True
            vehicle = path.resolve().parent.name.removesuffix(".zip")
            if not (
                self._may_be(vehicle, f"{path}: the folder's name, which names the vehicle,")
                and self._may_be(_drive_name(path.name), f"{path}: the file's name, which names the drive,")
            ):
                continue
            mine = self.folders.setdefault(vehicle, {}).setdefault(str(path.resolve().parent), [])
            if isinstance(mine, Storage):
                continue  # its whole folder was given as well
            on_disk = next(item for item in (path, *path.parents) if item.is_file())
            status = on_disk.stat()
            entry = DriveFile(
                vehicle=vehicle,
                name=_drive_name(path.name),
                place=str(path),
                size=status.st_size if on_disk == path else 0,
                version=f"{status.st_size}-{status.st_mtime_ns}",
            )
            if entry not in mine:
                mine.append(entry)
                self.sizes[vehicle] += entry.size
        return any_found

    def _may_be(self, name: str, what: str) -> bool:
        """Whether a vehicle or drive may be called so; if not, that is a problem."""
        try:
            require_plain_name(name, what)
        except UserError as error:
            self.problems.append(str(error))
            return False
        return True

    def fleet(self) -> FleetSource:
        """All that is of one vehicle without doubt."""
        folders = {vehicle: next(iter(places.values())) for vehicle, places in self.folders.items()}
        given = {item.place for places in self.folders.values() for drives in places.values()
                 if not isinstance(drives, Storage) for item in drives}  # fmt: skip
        problems = [*self.problems, *(text for place, text in self.strays.items() if place not in given)]
        for vehicle, places in self.folders.items():
            if len(places) > 1:
                del folders[vehicle]
                problems.append(
                    f"two vehicles with one name: {vehicle} is in {' and in '.join(places)}; rename one folder, or "
                    f"move the logs into one if it is the same vehicle"
                )
            elif not isinstance(folders[vehicle], Storage):
                problems += _without_twins(folders[vehicle])[1]  # type: ignore[arg-type]
        left_out = {f"problem {k + 1}": text for k, text in enumerate(dict.fromkeys(problems))}
        sizes = {vehicle: self.sizes[vehicle] for vehicle in folders}
        return FleetSource(place="", vehicles=_Folders(folders), left_out=left_out, sizes=sizes)


def _is_log(folder: Storage, name: str) -> bool:
    """Whether a file is a log: by its suffix; a text file of this machine also by what is in it."""
    if folder.is_local:
        return name.endswith(SUFFIX) or is_log(Path(folder.url) / name)
    return name.endswith(SUFFIX) or (not name.endswith(".txt") and is_log(Path(name)))


def _folder_name(url: str) -> str:
    return url.rstrip("/").rpartition("/")[2] if is_url(url) else Path(url).resolve().name


def _drive_name(file: str) -> str:
    return Path(file.removesuffix(".gz")).stem


def _drives_of(vehicle: str, folder: Storage, files: Iterable[Entry]) -> list[DriveFile]:
    """Drives of the vehicle whose folder this is."""
    return [
        DriveFile(
            vehicle=vehicle,
            name=_drive_name(entry.name),
            place=f"{folder.url}/{entry.name}",
            size=entry.size,
            version=entry.version,
        )
        for entry in files
        if _is_log(folder, entry.name) and is_plain_name(_drive_name(entry.name))
    ]


def _without_twins(drives: Sequence[DriveFile]) -> tuple[list[DriveFile], list[str]]:
    """Drives, sorted, that one file claims, and what is to be said of the others."""
    places: dict[str, list[DriveFile]] = {}
    for drive in sorted(drives, key=lambda item: (item.name, item.place)):
        places.setdefault(drive.name, []).append(drive)
    kept = [twins[0] for twins in places.values() if len(twins) == 1]
    problems = [
        f"vehicle {twins[0].vehicle}: drive {name} is in {' and '.join(item.place for item in twins)}; remove or "
        f"rename one"
        for name, twins in places.items()
        if len(twins) > 1
    ]
    return kept, problems


def is_onboard(entry: DriveFile) -> bool:
    """Whether a file is the record of a node's own summary, which has no samples."""
    return entry.place.endswith(SUFFIX)


def read_onboard_record(path: Path, database: VehicleDatabase) -> SummaryFile:
    """Read the record of a node; DriveError if it is damaged, or was made with another layout or DBC."""
    try:
        record = decode_summary(path.read_bytes())
    except OSError as error:
        raise DriveError(f"{path}: cannot be read: {error.strerror}; copy it again from the vehicle") from None
    except ValueError as error:
        raise DriveError(f"{path}: not a node's summary, or damaged: {error}; copy it again") from None
    for what, its, mine in (
        ("layout", record.layout_sha256, database.layout.digest),
        ("DBC", record.dbc_sha256, database.digest),
    ):
        if its != mine:
            raise DriveError(f"{path}: made with another {what} than {database.layout.path}; use the vehicle's own")
    return record


def load_drive(entry: DriveFile, database: VehicleDatabase) -> Drive:
    """Load one drive from its store file or its log; UserError if the file cannot be used, which it names."""
    if is_onboard(entry):
        raise DriveError(f"{entry.place}: a summary that was made on board, without samples; give the log")
    with local_copy(entry.place) as path:
        if is_drive_file(path):
            return read_drive_file(path, database.layout)
        return read_drive(path, database, vehicle=entry.vehicle, name=entry.name)


ReadVehicle = Callable[[Sequence[DriveFile], "Equipment", VehicleDatabase], _Vehicle]


def read_vehicles(
    read: "ReadVehicle[_Vehicle]",
    fleet: FleetSource,
    equipment: "Equipment",
    database: VehicleDatabase,
    *,
    workers: Workers,
    limit_s: float = TIME_LIMIT_S,
    names: Sequence[str] | None = None,
    label: str = "read drives",
) -> tuple[list[_Vehicle], dict[str, str]]:
    """Read vehicles; one that is bad never stops the others.

    Parameters
    ----------
    read : callable
        Makes what a method needs of a vehicle from its drives; of module level, as it goes to other processes.
    fleet, equipment, database : FleetSource, Equipment, VehicleDatabase
        The fleet, its branches and inputs, DBC and layout.
    workers : Workers
        Where.
    limit_s : float
        Longest time for one vehicle; one that takes longer is left out. [s]
    names : sequence of str or None
        Which vehicles; None: all.
    label : str
        What stands beside the bar of the progress.

    Returns
    -------
    vehicles : list
        Those that can be used, in the order of the fleet.
    left_out : dict of str to str
        Why the others cannot, by name.

    Raises
    ------
    FleetError
        If no vehicle can be used.
    """
    chosen = list(fleet.vehicles) if names is None else names
    read_one = partial(_read_one, read=read, equipment=equipment, database=database)
    found, left_out, done = list[_Vehicle](), dict(fleet.left_out), 0.0
    sizes = [fleet.sizes.get(name, 0) / MEGABYTE for name in chosen]
    outcomes = try_many(read_one, (fleet.vehicles[name] for name in chosen), workers, limit_s=limit_s)
    with progress_bar(label, int(sum(sizes)) + 1, "MB") as progress, closing(outcomes):
        for name, size, (_, outcome) in zip(chosen, sizes, outcomes, strict=True):
            if isinstance(outcome, Failed):
                left_out[name] = outcome.reason
            else:
                found.append(outcome)
            done += size
            progress(done)
        progress(int(sum(sizes)) + 1)
    if not found:
        reason = next((left_out[name] for name in chosen if name in left_out), next(iter(left_out.values()), ""))
        raise FleetError(f"{fleet.place}: no vehicle has enough usable data; the first says: {reason}")
    return found, left_out


def _read_one(
    entries: Sequence[DriveFile], *, read: "ReadVehicle[_Vehicle]", equipment: "Equipment", database: VehicleDatabase
) -> _Vehicle:
    return read(entries, equipment, database)


def probe_equipment(
    fleet: FleetSource,
    database: VehicleDatabase,
    branches: Sequence[str] | None,
    *,
    limit_s: float = TIME_LIMIT_S,
    modelled: bool = True,
    drives: Sequence[Drive] = (),
) -> Equipment:
    """Learn from some vehicles which branches and inputs the fleet has.

    A branch counts if more than half of the vehicles looked at have it; later, a vehicle that lacks it is left out.

    Parameters
    ----------
    fleet : FleetSource
        The fleet.
    database : VehicleDatabase
        DBC and layout.
    branches : sequence of str, optional
        Different branches to use instead of those found.
    limit_s : float
        Longest time for one drive. [s]
    modelled : bool
        Whether the branches are modelled from inputs, as those of a fleet are.
    drives : sequence of Drive
        One of each vehicle to look at, if they were read already.

    Returns
    -------
    Equipment
        At least two branches, and one input if they are modelled.

    Raises
    ------
    FleetError
        If no vehicle can be read, too little is there, or a branch is asked for twice.
    LayoutError
        If a branch is asked for that the layout does not have.
    """
    layout = database.layout
    names, errors = [_names_in(drive) for drive in drives], list[str]()
    if not names:
        names, errors = _probed(fleet, database, limit_s)
    if not names:
        raise FleetError(
            f"{fleet.place}: none of the first {len(errors)} vehicles can be read; the first says: {errors[0]}"
        )
    seen = Counter(name for each in names for name in each.branches)
    found = [name for name in layout.branch_names if 2 * seen[name] > len(names)]
    if branches is not None and len(branches) < 2:
        raise FleetError(
            f"--branches {','.join(branches)}: a junction has two branches or more; name all that are measured, or "
            f"leave --branches out"
        )
    chosen = _distinct(branches, layout) if branches is not None else tuple(found)
    available = {name for each in names for name in each.inputs}
    inputs, missing_inputs = choose_inputs(layout, available) if modelled else ((), ())
    wanted = layout.fleet_inputs or layout.model_inputs
    fleet_inputs = choose_inputs(layout, available, names=wanted)[0] if modelled else ()
    if len(chosen) < 2:
        raise FleetError(f"{fleet.place}: branches found: {', '.join(chosen) or 'none'}; a junction needs two or more")
    if modelled and not inputs:
        named = few(layout.model_inputs)
        why = f"none of the model_inputs of {{}} was recorded: {named}" if named else "no model_inputs in {}"
        raise FleetError(
            f"{fleet.place}: {why.format(layout.path)}; a fleet is compared by inputs that its currents follow from, "
            f"such as torque: name some there, see docs/layout.md; or name a branch whose sensor is right (--trusted)"
        )
    texts = {
        "branches not recorded, taken as not fitted": [b for b in layout.branch_names if b not in {*found, *chosen}],
        "branches recorded but not asked for, missing from the junction sum": [b for b in found if b not in chosen],
        "model inputs not recorded, left out": missing_inputs,
    }
    notices = tuple(f"{text}: {', '.join(names)}" for text, names in texts.items() if names)
    return Equipment(branches=chosen, inputs=inputs, fleet_inputs=fleet_inputs, notices=notices)


def _distinct(branches: Sequence[str], layout: Layout) -> tuple[str, ...]:
    """Branches asked for; refused if the layout lacks one or one is there twice."""
    for name in branches:
        layout.find_branch(name)
    twice = sorted({name for name in branches if branches.count(name) > 1})
    if twice:
        raise FleetError(f"branch {', '.join(twice)} is asked for twice; name each branch once")
    return tuple(branches)


def _probed(fleet: FleetSource, database: VehicleDatabase, limit_s: float) -> tuple[list[_Names], list[str]]:
    """Names in the first drive of the first vehicles that can be read, and the errors met before."""
    found: list[_Names] = []
    errors: list[str] = []
    first = (drives[0] for drives in fleet.vehicles.values() if drives)
    with closing(try_many(partial(_names, database=database), first, Workers(), limit_s=limit_s)) as read:
        for _, names in read:
            if isinstance(names, Failed):
                errors.append(names.reason)
            else:
                found.append(names)
            if len(found) == PROBED_VEHICLES:
                break
    return found, errors


def _names(entry: DriveFile, database: VehicleDatabase) -> _Names:
    if is_onboard(entry):
        with local_copy(entry.place) as path:
            record = read_onboard_record(path, database)
        return _Names(branches=tuple(record.branches), inputs=tuple(record.recorded))
    return _names_in(load_drive(entry, database))


def _names_in(drive: Drive) -> _Names:
    return _Names(branches=tuple(drive.branches), inputs=tuple(drive.inputs))
