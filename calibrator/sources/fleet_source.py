"""Find and load the drives of a fleet: in a drive store or folders of logs, on this machine or in object storage.

A log belongs to the vehicle that its folder is named after, and its drive is named after the file without suffixes:
``FLEET/logs/V0001/monday.log.gz`` is drive ``monday`` of vehicle ``V0001``. Folders and ``.zip`` archives are searched
at any depth; an archive counts as a folder of its name. Left out, and named in the report, are logs that lie beside
the folders of vehicles, folders beside these that hold no logs, vehicles with two folders of the same name, and drives
for which there are two files.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import NamedTuple, TypeVar

from calibrator.drive import Drive, DriveFile, Equipment, FleetSource
from calibrator.drives.align import choose_inputs
from calibrator.drives.computed_inputs import SharedNoise, computed_inputs, shared_noise, why_computed
from calibrator.drives.store import (
    DRIVES_FOLDER,
    is_drive_file,
    is_plain_name,
    name_problem,
    read_drive_file,
    read_onboard_record,
)
from calibrator.errors import DriveError, FleetError, LogError
from calibrator.files.storage import Entry, Storage, is_url, local_copy, open_storage, walk
from calibrator.processes.run_many import Failed, Workers, try_many, try_many_shown
from calibrator.recordings.log_formats import LOG_SUFFIXES, is_log, logs_in
from calibrator.recordings.readers import read_recording
from calibrator.terminal.options import TIME_LIMIT_S
from calibrator.terminal.text import few, few_reasons
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.layout import Layout
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
_EXPECTED = f"expected {', '.join(LOG_SUFFIXES)}, each also with .gz"
PROBED_VEHICLES = 7
"""So many readable vehicles are looked at to find out which branches and inputs the fleet has. [1]"""


_Place = Storage | list[DriveFile]
"""Where the drives of a vehicle are: a folder, which is listed again when they are needed, or single files."""


class _Vehicles(Mapping[str, tuple[DriveFile, ...]]):
    """Drives by vehicle. Folders are listed on access, so of a large fleet only names and folders are in memory."""

    def __init__(self, places: Mapping[str, _Place]) -> None:
        self._places = dict(sorted(places.items()))

    def __getitem__(self, vehicle: str) -> tuple[DriveFile, ...]:
        place = self._places[vehicle]
        if isinstance(place, Storage):
            logs = [entry for entry in place.contents()[1] if _is_log(place, entry.name)]
            place = _drives(vehicle, place.url, logs)
        return tuple(twins[0] for _, twins in sorted(_by_name(place).items()) if len(twins) == 1)

    def __contains__(self, vehicle: object) -> bool:
        return vehicle in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


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
        If the place does not exist, or no drive is found in it.
    """
    storage = open_storage(place)
    if storage.is_local and not Path(storage.url).exists():
        raise FleetError(f"{place}: no such file or folder; give a log, a drive store, or a folder with logs")
    fleet = find_logs([place])
    if not fleet.vehicles:
        raise FleetError(f"{place}: no drive in it{few_reasons(fleet.left_out)}")
    return replace(fleet, place=str(place))


def find_logs(arguments: Iterable[str | Path]) -> FleetSource:
    """Find logs, or drives of a store, and the vehicles they belong to.

    Parameters
    ----------
    arguments : iterable of str or Path
        Files, or folders to search; paths or URLs. In a folder that has a folder ``drives``, or else ``logs``, only
        this one is searched.

    Returns
    -------
    FleetSource
        The drives, possibly none, and what is left out; the drives are not read yet.
    """
    places: dict[str, dict[str, _Place]] = {}
    usable, sizes = dict[str, bool](), Counter[str]()
    strays, problems = dict[str, str](), list[str]()

    def add(url: str, logs: Sequence[Entry], folder: Storage | None) -> None:
        vehicle = _without_suffix(_folder_name(url), ".zip")
        what = [name_problem(vehicle, f"{url}: the folder's name, which names the vehicle,")]
        what += [
            name_problem(_drive_name(entry.name), f"{url}/{entry.name}: the file's name, which names the drive,")
            for entry in logs
        ]
        problems.extend(filter(None, what))
        if what[0]:
            return
        mine, drives = places.setdefault(vehicle, {}), _drives(vehicle, url, logs)
        known = mine.get(url, [])
        if isinstance(known, Storage):
            return  # the whole folder was given as well
        mine[url] = folder or list(dict.fromkeys([*known, *drives]))
        sizes[vehicle] += sum(entry.size for entry in logs)
        by_name = _by_name(drives if folder else [*known, *drives])
        usable[vehicle] = any(len(set(twins)) == 1 for twins in by_name.values())
        for name, twins in by_name.items():
            if len(set(twins)) > 1:
                where = " and ".join(item.place for item in twins)
                problems.append(f"vehicle {vehicle}: drive {name} is in {where}; remove or rename one")

    for argument in arguments:
        try:
            storage, beside, is_found, inside = open_storage(argument), list[Entry](), False, set[str]()
            folders = storage.contents()[0]
            if whole := next((name for name in (DRIVES_FOLDER, LOGS_FOLDER) if name in folders), None):
                storage = storage.folder(whole)
                folders = storage.contents()[0]
            for url, logs, folder in _logs_in(storage, str(argument), problems):
                if folder is not None and url == storage.url:
                    beside = logs
                else:
                    add(url, logs, folder)
                    inside.add(url.removeprefix(f"{storage.url}/").partition("/")[0])
                    is_found = True
            if beside and not is_found:
                add(storage.url, beside, storage)
            elif not is_found:
                what = "no logs in it" if storage.is_local else "nothing is there, or no logs in it"
                raise LogError(f"{argument}: {what}; {_EXPECTED}")
            inside |= {re.split("[:/]", text.removeprefix(f"{storage.url}/"), maxsplit=1)[0] for text in problems}
            if is_found and (empty := [name for name in folders if name not in inside]):
                problems.append(f"{storage.url}: no logs in {few(empty)}; {_EXPECTED}")
            for entry in beside if is_found else ():
                strays[f"{storage.url}/{entry.name}"] = (
                    f"{storage.url}/{entry.name}: lies beside folders with logs; move it into that of its vehicle, or "
                    f"name the file itself if it is of the vehicle {_folder_name(storage.url)}"
                )
        except UserError as error:
            problems.append(str(error))
    single = [place for mine in places.values() for place in mine.values() if isinstance(place, list)]
    given = {item.place for place in single for item in place}
    problems += [text for place, text in strays.items() if place not in given]
    problems += [
        f"two vehicles with one name: {vehicle} is in {' and in '.join(mine)}; rename one folder, or move the logs "
        f"into one if it is the same vehicle"
        for vehicle, mine in places.items()
        if len(mine) > 1
    ]
    vehicles = {
        vehicle: next(iter(mine.values())) for vehicle, mine in places.items() if len(mine) == 1 and usable[vehicle]
    }
    left_out = {f"problem {k + 1}": text for k, text in enumerate(dict.fromkeys(problems))}
    sizes_ = {vehicle: sizes[vehicle] for vehicle in vehicles}
    return FleetSource(place="", vehicles=_Vehicles(vehicles), left_out=left_out, sizes=sizes_)


def _logs_in(storage: Storage, shown: str, problems: list[str]) -> Iterator[tuple[str, list[Entry], Storage | None]]:
    """Yield each folder with logs that is in a folder or an archive, or the folder of a single log.

    Each is given as (path or URL, logs, storage); the storage is None for an archive or a single log. An inner folder
    or archive that cannot be read is added to `problems`; `shown` is the place as the user named it.
    """
    path = Path(storage.url)
    if storage.is_local and not path.exists():
        raise LogError(f"{shown}: no such file or folder; give logs that are there")
    if storage.is_local and path.is_file():
        yield from _in_archive(path) if path.suffix.lower() == ".zip" else [(str(path.parent), [_entry(path)], None)]
        return
    folder_url, _, name = storage.url.rpartition("/")
    if not storage.is_local and _is_log(storage, name):
        yield from ((folder_url, [log], None) for log in open_storage(folder_url).contents(name)[1] if log.name == name)
    for folder, files in walk(storage, problems):
        if logs := [entry for entry in files if _is_log(folder, entry.name)]:
            yield folder.url, logs, folder
        for entry in files:
            if folder.is_local and entry.name.lower().endswith(".zip"):
                try:
                    yield from _in_archive(Path(folder.url) / entry.name)
                except LogError as error:
                    problems.append(str(error))


def _in_archive(path: Path) -> Iterator[tuple[str, list[Entry], None]]:
    version = _entry(path).version
    for folder, logs in groupby(logs_in(path), key=lambda inner: inner.parent):
        yield str(folder), [Entry(log.name, 0, version) for log in logs], None


def _entry(path: Path) -> Entry:
    status = path.stat()
    return Entry(path.name, status.st_size, f"{status.st_size}-{status.st_mtime_ns}")


def _is_log(folder: Storage, name: str) -> bool:
    """Check by its suffix whether a file is a log or a record made by a node; a local ``.txt`` file by its content."""
    if folder.is_local:
        return name.endswith(SUFFIX) or is_log(Path(folder.url) / name)
    return name.endswith(SUFFIX) or (not name.endswith(".txt") and is_log(Path(name)))


def _folder_name(url: str) -> str:
    return url.rstrip("/").rpartition("/")[2] if is_url(url) else Path(url).resolve().name


def _drive_name(file: str) -> str:
    return Path(_without_suffix(file, ".gz")).stem


def _without_suffix(name: str, suffix: str) -> str:
    """Return a name without a suffix, which may be in lower or upper case."""
    return name[: -len(suffix)] if name.lower().endswith(suffix) else name


def _drives(vehicle: str, folder: str, logs: Iterable[Entry]) -> list[DriveFile]:
    """Return the drives of a vehicle whose logs are in a folder; logs with unusable names are skipped."""
    return [
        DriveFile(
            vehicle=vehicle,
            name=_drive_name(entry.name),
            place=f"{folder}/{entry.name}",
            size=entry.size,
            version=entry.version,
        )
        for entry in logs
        if is_plain_name(_drive_name(entry.name))
    ]


def _by_name(drives: Iterable[DriveFile]) -> dict[str, list[DriveFile]]:
    """Group drives by name, as several files may have the same drive name."""
    found: dict[str, list[DriveFile]] = {}
    for drive in sorted(drives, key=lambda item: item.place):
        found.setdefault(drive.name, []).append(drive)
    return found


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
    """Read the vehicles of a fleet in worker processes; one that cannot be used is left out, the rest is read.

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
        Why a vehicle cannot be used, by its name; and all of ``fleet.left_out``.

    Raises
    ------
    FleetError
        If no vehicle can be used.
    """
    chosen = list(fleet.vehicles) if names is None else names
    read_one = partial(read, equipment=equipment, database=database)
    found, left_out = list[_Vehicle](), dict(fleet.left_out)
    outcomes = try_many_shown(
        read_one,
        (fleet.vehicles[name] for name in chosen),
        workers,
        limit_s=limit_s,
        label=label,
        size=sum(fleet.sizes.get(name, 0) for name in chosen),
        size_of=lambda drives: sum(drive.size for drive in drives),
    )
    with closing(outcomes):
        for name, (_, outcome) in zip(chosen, outcomes, strict=True):
            if isinstance(outcome, Failed):
                left_out[name] = outcome.reason
            else:
                found.append(outcome)
    if not found:
        reason = next((left_out[name] for name in chosen if name in left_out), next(iter(left_out.values()), ""))
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

    The first readable drive of each of the first :data:`PROBED_VEHICLES` readable vehicles is read. The fleet has a
    branch if more than half of these drives have it, and an input if at least one has it, unless it is computed from a
    current sensor. A vehicle that lacks a chosen branch is left out later.

    Parameters
    ----------
    fleet : FleetSource
        The fleet.
    database : VehicleDatabase
        DBC and layout.
    branches : sequence of str, optional
        Branches to use instead of those found, each named once.
    limit_s : float
        Longest time for one vehicle. [s]
    modelled : bool
        Whether the branches are modelled from inputs, as in a fleet; if not, no inputs are chosen.
    drives : sequence of Drive
        One drive of each vehicle to look at, if they have been read already; then no drive is read here.

    Returns
    -------
    Equipment
        Branches, at least two, and inputs, at least one if the branches are modelled.

    Raises
    ------
    FleetError
        If no vehicle can be read, there are too few branches or inputs, or a branch is named twice.
    LayoutError
        If a branch is named that the layout does not have.
    """
    layout = database.layout
    looks, errors = [_look_at(drive, layout, modelled=modelled) for drive in drives], list[str]()
    if not looks:
        vehicles, look = filter(None, fleet.vehicles.values()), partial(_look, database=database, modelled=modelled)
        with closing(try_many(look, vehicles, Workers(), limit_s=limit_s)) as read:
            for _, outcome in read:
                if isinstance(outcome, Failed):
                    errors.append(outcome.reason)
                else:
                    looks.append(outcome)
                if len(looks) == PROBED_VEHICLES:
                    break
    if not looks:
        raise FleetError(
            f"{fleet.place}: none of the first {len(errors)} vehicles can be read; the first says: {errors[0]}"
        )
    seen = Counter(name for look in looks for name in look.branches)
    found = [name for name in layout.branch_names if 2 * seen[name] > len(looks)]
    chosen = tuple(found if branches is None else branches)
    if branches is not None and len(branches) < 2:
        raise FleetError(
            f"--branches {','.join(branches)}: a junction has two branches or more; name all that are measured, or "
            f"leave --branches out"
        )
    for name in chosen:
        layout.find_branch(name)
    if twice := sorted({name for name in chosen if chosen.count(name) > 1}):
        raise FleetError(f"branch {', '.join(twice)} is asked for twice; name each branch once")
    if len(chosen) < 2:
        raise FleetError(f"{fleet.place}: branches found: {', '.join(chosen) or 'none'}; a junction needs two or more")
    texts = {
        "branches not recorded, taken as not fitted": [b for b in layout.branch_names if b not in {*found, *chosen}],
        "branches recorded but not asked for, missing from the junction sum": [b for b in found if b not in chosen],
    }
    notices = [f"{text}: {', '.join(names)}" for text, names in texts.items() if names]
    if not modelled:
        return Equipment(branches=chosen, inputs=(), fleet_inputs=(), notices=tuple(notices))
    return _with_inputs(chosen, looks, layout, fleet.place, notices)


def _with_inputs(
    branches: tuple[str, ...], looks: "Sequence[_Look]", layout: Layout, place: str, notices: Sequence[str]
) -> Equipment:
    """Add the inputs that a fleet has, and notices on those that it lacks; FleetError if there is none."""
    recorded = {name for look in looks for name in look.inputs}
    computed = computed_inputs([look.noise for look in looks])
    wanted = layout.fleet_inputs or layout.model_inputs
    inputs, _ = choose_inputs(layout, recorded - computed.keys())
    fleet_inputs, _ = choose_inputs(layout, recorded - computed.keys(), names=wanted)
    _, missing = choose_inputs(layout, recorded)
    if not inputs:
        named = few(layout.model_inputs)
        why = f"none of the model_inputs of {{}} was recorded: {named}" if named else "no model_inputs in {}"
        if computed:
            why = f"model_inputs of {{}}: {why_computed(computed)}"
        raise FleetError(
            f"{place}: {why.format(layout.path)}; a fleet is compared by inputs that its currents follow from, "
            f"such as torque: name some there, see docs/layout.md; or name a branch whose sensor is right (--trusted)"
        )
    more = [f"model inputs not recorded, left out: {', '.join(missing)}"] if missing else []
    more += [f"model inputs left out: {why_computed(computed)}"] if computed else []
    return Equipment(branches=branches, inputs=inputs, fleet_inputs=fleet_inputs, notices=(*notices, *more))


class _Look(NamedTuple):
    """What a drive of a vehicle has: branches, recorded inputs, and noise that its model inputs share with sensors."""

    branches: tuple[str, ...]
    inputs: tuple[str, ...]
    noise: Mapping[str, SharedNoise]


def _look(entries: Sequence[DriveFile], database: VehicleDatabase, *, modelled: bool) -> _Look:
    """Look at the first readable drive; UserError if none is readable."""
    problems = list[UserError]()
    for entry in entries:
        try:
            if not is_onboard(entry):
                return _look_at(load_drive(entry, database), database.layout, modelled=modelled)
            with local_copy(entry.place) as path:
                record = read_onboard_record(path, database)
            return _Look(tuple(record.branches), tuple(record.recorded), {})
        except UserError as error:
            problems.append(error)
    raise problems[0]


def _look_at(drive: Drive, layout: Layout, *, modelled: bool) -> _Look:
    wanted = layout.base_inputs({*layout.model_inputs, *layout.fleet_inputs}) if modelled else set()
    return _Look(tuple(drive.branches), tuple(drive.inputs), shared_noise(drive, sorted(wanted), layout))
