"""The drives of a fleet, wherever they are: a drive store, or folders of CAN logs."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path

from calibrator.drive import Drive, DriveFile
from calibrator.drives.align import choose_inputs
from calibrator.drives.drive_file import is_drive_file, read_drive_file
from calibrator.drives.fleet_id import read_fleet_ids
from calibrator.drives.store import list_drives
from calibrator.errors import FleetError
from calibrator.processes.messages import Unread
from calibrator.processes.reading import TIME_LIMIT_S, read_in_processes
from calibrator.recordings.readers import read_drive
from calibrator.sources.logs import find_logs
from calibrator.terminal.text import few, few_reasons
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.layout import Layout

__all__ = [
    "LOGS_FOLDER",
    "STORE_FOLDER",
    "Equipment",
    "FleetSource",
    "find_fleet",
    "load_drive",
    "probe_equipment",
]

STORE_FOLDER, LOGS_FOLDER = "drives", "logs"
PROBED_VEHICLES = 7
"""How many vehicles are looked at to learn which branches and inputs the fleet has."""


@dataclass(frozen=True, kw_only=True)
class FleetSource:
    """A fleet that can be loaded.

    Attributes
    ----------
    path : Path
        Folder of the fleet.
    vehicles : mapping of str to tuple of DriveFile
        Drives by vehicle, sorted.
    left_out : mapping of str to str
        Why a vehicle, or a file where its vehicle is unclear, was left out.
    notices : tuple of str
        What else the user should know.
    fleet_ids : frozenset of str
        Artificial fleets that the drives come from, see :mod:`calibrator.drives.fleet_id`; empty if unknown.
    """

    path: Path
    vehicles: Mapping[str, tuple[DriveFile, ...]]
    left_out: Mapping[str, str]
    notices: tuple[str, ...] = ()
    fleet_ids: frozenset[str] = frozenset()


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


def find_fleet(path: Path) -> FleetSource:
    """Find the drives of a fleet; nothing is opened.

    Parameters
    ----------
    path : Path
        A drive store, a fleet of ``calibrator simulate``, or a folder with a folder of logs per vehicle.

    Returns
    -------
    FleetSource
        At least one vehicle.

    Raises
    ------
    FleetError
        If there is no drive at all.
    """
    if not path.exists():
        raise FleetError(f"{path}: no such file or folder; give a log, a drive store, or a folder with logs")
    left_out: dict[str, str] = {}
    folder = path
    if (path / STORE_FOLDER).is_dir():
        entries = list_drives(path)
    else:
        folder = path / LOGS_FOLDER if (path / LOGS_FOLDER).is_dir() else path
        found = find_logs([folder])
        entries = list(found.logs)
        left_out = {f"problem {k + 1}": str(problem) for k, problem in enumerate(found.problems)}
    if not entries:
        raise FleetError(f"{path}: no drive in it{few_reasons(left_out)}")
    entries.sort(key=lambda entry: (entry.vehicle, entry.name))
    vehicles = {vehicle: tuple(group) for vehicle, group in groupby(entries, key=lambda entry: entry.vehicle)}
    ids = read_fleet_ids(path.parent if path.is_file() else folder)
    return FleetSource(path=path, vehicles=vehicles, left_out=left_out, fleet_ids=ids)


def load_drive(entry: DriveFile, database: VehicleDatabase) -> Drive:
    """Load one drive from its store file or its log.

    Parameters
    ----------
    entry : DriveFile
        Which.
    database : VehicleDatabase
        DBC and layout.

    Returns
    -------
    Drive
        The drive.

    Raises
    ------
    UserError
        If the file cannot be used; the message names it.
    """
    if is_drive_file(entry.path):
        return read_drive_file(entry.path, database.layout)
    return read_drive(entry.path, database, vehicle=entry.vehicle, name=entry.name)


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
            f"{fleet.path}: none of the first {len(errors)} vehicles can be read; the first says: {errors[0]}"
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
        raise FleetError(f"{fleet.path}: branches found: {', '.join(chosen) or 'none'}; a junction needs two or more")
    if modelled and not inputs:
        named = few(layout.model_inputs)
        why = f"none of the model_inputs of {{}} was recorded: {named}" if named else "no model_inputs in {}"
        raise FleetError(
            f"{fleet.path}: {why.format(layout.path)}; a fleet is compared by inputs that its currents follow from, "
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
    first = [entries[0] for entries in fleet.vehicles.values()]
    found: list[_Names] = []
    errors: list[str] = []
    with closing(read_in_processes(partial(_names, database=database), first, workers=1, limit_s=limit_s)) as read:
        for entry, names in zip(first, read, strict=True):
            if isinstance(names, Unread):
                errors.append(f"{entry.path}: {names.reason}")
            elif isinstance(names, str):
                errors.append(names)
            else:
                found.append(names)
            if len(found) == PROBED_VEHICLES:
                break
    return found, errors


def _names(entry: DriveFile, database: VehicleDatabase) -> _Names | str:
    """Names in one drive, or the text of the error."""
    try:
        drive = load_drive(entry, database)
    except UserError as error:
        return str(error)
    return _names_in(drive)


def _names_in(drive: Drive) -> _Names:
    return _Names(branches=tuple(drive.branches), inputs=tuple(drive.inputs))
