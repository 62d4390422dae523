"""Find and load the drives of a fleet: in a drive store or folders of logs, on this machine or in object storage.

A log belongs to the vehicle that its folder is named after, and its drive is named after the file without suffixes:
``FLEET/logs/V0001/monday.log.gz`` is drive ``monday`` of vehicle ``V0001``. Folders and ``.zip`` archives are searched
at any depth; an archive counts as a folder of its name. Logs that lie beside the folders of vehicles, vehicles with
two folders of the same name, and drives for which there are two files, are left out, and the report names them.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from calibrator.drive import Drive, DriveFile, Equipment, FleetSource
from calibrator.drives.align import choose_inputs
from calibrator.drives.store import (
    DRIVES_FOLDER,
    is_drive_file,
    name_problem,
    read_drive_file,
    read_onboard_record,
)
from calibrator.errors import DriveError, FleetError, LogError
from calibrator.files.storage import Entry, Storage, is_url, local_copy, open_storage, walk
from calibrator.processes.run_many import Failed, Workers, try_many
from calibrator.recordings.log_formats import LOG_SUFFIXES, is_log, logs_in
from calibrator.recordings.readers import read_recording
from calibrator.terminal.options import TIME_LIMIT_S
from calibrator.terminal.progress import shown
from calibrator.terminal.text import few, few_reasons
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.summary import SUFFIX

__all__ = [
    "Equipment",
    "find_fleet",
    "find_logs",
    "is_onboard",
    "load_drive",
    "probe_equipment",
    "read_vehicles",
]

_Vehicle = TypeVar("_Vehicle")
LOGS_FOLDER = "logs"
PROBED_VEHICLES = 7
"""So many readable vehicles are looked at to find out which branches and inputs the fleet has. [1]"""


def find_fleet(place: str | Path) -> FleetSource:
    """Find the drives of a fleet without reading them.

    Parameters
    ----------
    place : str or Path
        Path or URL of a drive store, of a fleet that ``calibrator simulate`` wrote, of a folder with a folder of logs
        per vehicle, or of a log.

    Returns
    -------
    FleetSource
        The fleet, with at least one vehicle.

    Raises
    ------
    FleetError
        If there is no drive at all.
    """
    storage = open_storage(place)
    if storage.is_local and not Path(storage.url).exists():
        raise FleetError(f"{place}: no such file or folder; give a log, a drive store, or a folder with logs")
    inside = storage.contents()[0]
    folder = next((storage.folder(name) for name in (DRIVES_FOLDER, LOGS_FOLDER) if name in inside), storage)
    fleet = find_logs([folder.url])
    if not fleet.vehicles:
        raise FleetError(f"{place}: no drive in it{few_reasons(fleet.left_out)}")
    return replace(fleet, place=str(place))


def find_logs(arguments: Iterable[str | Path]) -> FleetSource:
    """Find logs, or drives of a store, and the vehicles they belong to.

    Parameters
    ----------
    arguments : iterable of str or Path
        Files, or folders to search; paths or URLs.

    Returns
    -------
    FleetSource
        The drives, possibly none, and what is left out; the drives are not read yet.
    """
    folders: dict[str, dict[str, Entry]] = {}
    strays: dict[str, dict[str, Entry]] = {}
    problems: list[str] = []
    for argument in arguments:
        try:
            top, logs = open_storage(argument).url, defaultdict[str, dict[str, Entry]](dict)
            for folder, entry in _logs_in(argument, problems):
                logs[folder][entry.name] = entry
            if not logs:
                raise LogError(f"{argument}: no logs in it; expected {', '.join(LOG_SUFFIXES)}, each also with .gz")
            if len(logs) > 1 and top in logs:
                strays[top] = logs.pop(top)
            for folder, entries in logs.items():
                folders.setdefault(folder, {}).update(entries)
        except UserError as error:
            problems.append(str(error))
    problems += [
        f"{folder}/{name}: lies beside folders with logs; move it into that of its vehicle, or name the file itself if "
        f"it is of the vehicle {_folder_name(folder)}"
        for folder, entries in strays.items()
        for name in entries
        if name not in folders.get(folder, {})
    ]
    vehicles = _vehicles(folders, problems)
    left_out = {f"problem {k}": text for k, text in enumerate(dict.fromkeys(problems), start=1)}
    return FleetSource(place="", vehicles=vehicles, left_out=left_out)


def _logs_in(place: str | Path, problems: list[str]) -> Iterator[tuple[str, Entry]]:
    """Yield each log in a folder or archive, or a single one, with the folder that it is in (path or URL).

    An inner folder or archive that cannot be read is added to `problems`.
    """
    storage = open_storage(place)
    if storage.is_local and not Path(storage.url).exists():
        raise LogError(f"{place}: no such file or folder; give logs that are there")
    parent, _, file = storage.url.rpartition("/")
    is_single = Path(storage.url).is_file() if storage.is_local else _is_log(storage, file)
    found = walk(storage, problems)
    if is_single:
        above = Storage(url=parent or "/")
        found = iter([(above, [entry for entry in above.contents(file)[1] if entry.name == file])])
    for folder, entries in found:
        for entry in entries:
            if folder.is_local and entry.name.lower().endswith(".zip"):
                try:
                    for log in logs_in(Path(folder.url) / entry.name):
                        yield str(log.parent), Entry(log.name, 0, entry.version)
                except LogError as error:
                    problems.append(str(error))
            elif is_single or _is_log(folder, entry.name):
                yield folder.url, entry


def _vehicles(folders: Mapping[str, Mapping[str, Entry]], problems: list[str]) -> dict[str, tuple[DriveFile, ...]]:
    """Return the drives of each vehicle that has usable ones, and add what is wrong with others to `problems`."""
    folders_of, drives_of = defaultdict[str, list[str]](list), dict[str, tuple[DriveFile, ...]]()
    for folder in folders:
        vehicle = _without_suffix(_folder_name(folder), ".zip")
        if problem := name_problem(vehicle, f"{folder}: the folder's name, which names the vehicle,"):
            problems.append(problem)
        else:
            folders_of[vehicle].append(folder)
    for vehicle, its in sorted(folders_of.items()):
        if len(its) > 1:
            problems.append(
                f"two vehicles with one name: {vehicle} is in {' and in '.join(its)}; rename one folder, or move the "
                f"logs into one if it is the same vehicle"
            )
            continue
        files = defaultdict[str, list[DriveFile]](list)
        for entry in folders[its[0]].values():
            name, place = Path(_without_suffix(entry.name, ".gz")).stem, f"{its[0]}/{entry.name}"
            if problem := name_problem(name, f"{place}: the file's name, which names the drive,"):
                problems.append(problem)
            else:
                files[name].append(DriveFile(vehicle=vehicle, name=name, place=place, version=entry.version))
        for name, twins in files.items():
            if len(twins) > 1:
                where = " and ".join(sorted(item.place for item in twins))
                problems.append(f"vehicle {vehicle}: drive {name} is in {where}; remove or rename one")
        if drives := tuple(twins[0] for _, twins in sorted(files.items()) if len(twins) == 1):
            drives_of[vehicle] = drives
    return drives_of


def _is_log(folder: Storage, name: str) -> bool:
    """Check by its suffix whether a file is a log or a record made on board; a local text file also by its content."""
    if folder.is_local:
        return name.endswith(SUFFIX) or is_log(Path(folder.url) / name)
    return name.endswith(SUFFIX) or (not name.endswith(".txt") and is_log(Path(name)))


def _folder_name(url: str) -> str:
    return url.rstrip("/").rpartition("/")[2] if is_url(url) else Path(url).resolve().name


def _without_suffix(name: str, suffix: str) -> str:
    """Return a name without a suffix, which may be in lower or upper case."""
    return name[: -len(suffix)] if name.lower().endswith(suffix) else name


def is_onboard(entry: DriveFile) -> bool:
    """Check whether a file is a record that a node made on board: a summary, without samples."""
    return entry.place.endswith(SUFFIX)


def load_drive(entry: DriveFile, database: VehicleDatabase) -> Drive:
    """Load one drive from its store file or its log; raise a UserError that names the file if it cannot be used."""
    if is_onboard(entry):
        raise DriveError(f"{entry.place}: a summary that was made on board, without samples; give the log")
    with local_copy(entry.place) as path:
        if is_drive_file(path):
            return read_drive_file(path, database.layout)
        return read_recording(path, database, vehicle=entry.vehicle, name=entry.name).drive


def read_vehicles(
    read: Callable[..., _Vehicle],
    fleet: FleetSource,
    equipment: Equipment,
    database: VehicleDatabase,
    *,
    workers: Workers,
    limit_s: float = TIME_LIMIT_S,
    names: Sequence[str] | None = None,
    label: str = "read drives",
) -> tuple[list[_Vehicle], dict[str, str]]:
    """Read the vehicles of a fleet in worker processes; a bad one never stops the others.

    Parameters
    ----------
    read : callable
        Function of module level (it is pickled) that turns the DriveFiles of a vehicle, `equipment` and `database` into
        what a method needs of this vehicle.
    fleet, equipment, database : FleetSource, Equipment, VehicleDatabase
        The fleet, its branches and inputs, DBC and layout.
    workers : Workers
        Where the vehicles are read.
    limit_s : float
        Longest time for one vehicle; one that takes longer is left out. [s]
    names : sequence of str or None
        Vehicles to read; None: all.
    label : str
        Text beside the progress bar.

    Returns
    -------
    vehicles : list
        What `read` returned for the vehicles that can be used, in the order of the fleet, or of `names`.
    left_out : dict of str to str
        Why the others cannot be used, by name; problems that were found with the fleet are included.

    Raises
    ------
    FleetError
        If no vehicle can be used.
    """
    chosen = list(fleet.vehicles) if names is None else names
    read_one = partial(read, equipment=equipment, database=database)
    found, reasons = list[_Vehicle](), dict[str, str]()
    with closing(try_many(read_one, map(fleet.vehicles.__getitem__, chosen), workers, limit_s=limit_s)) as outcomes:
        going = shown(outcomes, label, len(chosen), "vehicles")
        for name, (_, outcome) in zip(chosen, going, strict=True):
            if isinstance(outcome, Failed):
                reasons[name] = outcome.reason
            else:
                found.append(outcome)
    left_out = {**fleet.left_out, **reasons}
    if not found:
        reason = next(iter([*reasons.values(), *left_out.values()]), "")
        raise FleetError(f"{fleet.place}: no vehicle has enough usable data; the first says: {reason}")
    return found, left_out


def probe_equipment(
    fleet: FleetSource,
    database: VehicleDatabase,
    branches: Sequence[str] | None,
    *,
    limit_s: float = TIME_LIMIT_S,
    modelled: bool = True,
    drives: Sequence[Drive] = (),
) -> Equipment:
    """Find out from some vehicles which branches and inputs the fleet has.

    The first drive of each is read. A branch counts if more than half of these drives have it, an input if one has it;
    a vehicle that lacks a chosen branch is left out later.

    Parameters
    ----------
    fleet : FleetSource
        The fleet.
    database : VehicleDatabase
        DBC and layout.
    branches : sequence of str, optional
        Branches to use instead of those found.
    limit_s : float
        Longest time for one drive. [s]
    modelled : bool
        Whether the branches are modelled from inputs, as in a fleet; if not, no inputs are chosen.
    drives : sequence of Drive
        One drive of each vehicle to look at, if they have been read already; none are read then.

    Returns
    -------
    Equipment
        Branches, at least two, and inputs, at least one if the branches are modelled.

    Raises
    ------
    FleetError
        If no vehicle can be read, or there are too few branches or inputs.
    LayoutError
        If a branch is named that the layout does not have.
    """
    layout = database.layout
    names = [_names_in(drive) for drive in drives] or _probed_names(fleet, database, limit_s)
    seen = Counter(name for has, _ in names for name in has)
    found = tuple(name for name in layout.branch_names if 2 * seen[name] > len(names))
    chosen = found if branches is None else tuple(branches)
    for name in chosen:
        layout.find_branch(name)
    if len(chosen) < 2:
        given = f"{fleet.place}: branches found: " if branches is None else "--branches "
        raise FleetError(
            f"{given}{', '.join(chosen) or 'none'}; a junction needs two branches or more that are measured"
        )
    available = {name for _, inputs in names for name in inputs}
    inputs, missing_inputs = choose_inputs(layout, available) if modelled else ((), ())
    fleet_inputs, _ = choose_inputs(layout, available, names=layout.fleet_inputs or layout.model_inputs)
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
    return Equipment(branches=chosen, inputs=inputs, fleet_inputs=fleet_inputs if modelled else (), notices=notices)


_Names = tuple[tuple[str, ...], tuple[str, ...]]
"""Names of the branches and of the inputs that a drive has."""


def _probed_names(fleet: FleetSource, database: VehicleDatabase, limit_s: float) -> list[_Names]:
    """Read the names in the first drive of each of the first vehicles that can be read; FleetError if none can."""
    found, errors = list[_Names](), list[str]()
    first = (drives[0] for drives in fleet.vehicles.values())
    with closing(try_many(partial(_names, database=database), first, Workers(), limit_s=limit_s)) as outcomes:
        for _, outcome in outcomes:
            if isinstance(outcome, Failed):
                errors.append(outcome.reason)
            else:
                found.append(outcome)
            if len(found) == PROBED_VEHICLES:
                break
    if not found:
        raise FleetError(
            f"{fleet.place}: none of the first {len(errors)} vehicles can be read; the first says: {errors[0]}"
        )
    return found


def _names(entry: DriveFile, database: VehicleDatabase) -> _Names:
    if not is_onboard(entry):
        return _names_in(load_drive(entry, database))
    with local_copy(entry.place) as path:
        record = read_onboard_record(path, database)
    return tuple(record.branches), tuple(record.recorded)


def _names_in(drive: Drive) -> _Names:
    return tuple(drive.branches), tuple(drive.inputs)
