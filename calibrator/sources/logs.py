"""Which log belongs to which vehicle.

The rule: a log belongs to the vehicle that its folder is named after, and the drive has the name of the file without
its suffixes: ``FLEET/logs/V0001/monday.log.gz`` is drive ``monday`` of vehicle ``V0001``. Folders and ``.zip`` archives
are searched for logs at any depth; an archive stands for a folder of its name. Logs that lie beside the folders of
vehicles, vehicles whose name stands for two folders, and drives that two files claim, are left out and named.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from calibrator.drive import DriveFile
from calibrator.drives.plain_names import require_plain_name
from calibrator.errors import LogError
from calibrator.recordings.frames import LOG_SUFFIXES, is_log
from calibrator.recordings.log_files import files_in
from ecu_node.errors import UserError

__all__ = ["LogSources", "find_logs"]


@dataclass(frozen=True, kw_only=True)
class LogSources:
    """Logs that can be read, sorted by vehicle and drive, and why others are left out.

    Attributes
    ----------
    logs : tuple of DriveFile
        No two have the same vehicle and name.
    problems : tuple of UserError
        One per file, vehicle or argument that is left out.
    """

    logs: tuple[DriveFile, ...]
    problems: tuple[UserError, ...]


def find_logs(arguments: Iterable[Path]) -> LogSources:
    """Find logs and the vehicles they belong to.

    Parameters
    ----------
    arguments : iterable of Path
        Log files, or folders to search.

    Returns
    -------
    LogSources
        The logs, and what is left out; nothing is opened.
    """
    found: dict[Path, DriveFile] = {}
    problems: list[UserError] = []
    strays: dict[Path, LogError] = {}
    for argument in arguments:
        try:
            paths = _logs_of(argument)
        except UserError as error:
            problems.append(error)
            continue
        has_folders = any(path.parent != argument for path in paths)
        for path in paths:
            if has_folders and path.parent == argument:
                strays[path.resolve()] = _stray(path)
                continue
            try:
                found.setdefault(path.resolve(), _source(path))
            except UserError as error:
                problems.append(error)
    problems += [problem for path, problem in strays.items() if path not in found]
    logs = sorted(found.values(), key=lambda log: (log.vehicle, log.name, str(log.path)))
    refused = _refused_vehicles(logs, problems)
    logs = [log for log in logs if log.vehicle not in refused]
    return LogSources(logs=tuple(_without_twins(logs, problems)), problems=tuple(problems))


def _logs_of(argument: Path) -> list[Path]:
    if not argument.exists():
        raise LogError(f"{argument}: no such file or folder; give logs that are there")
    if argument.is_file() and argument.suffix.lower() != ".zip":
        return [argument]
    inside = [inner for path in files_in(argument) for inner in files_in(path) or [path]]
    paths = [path for path in inside if is_log(path)]
    if not paths:
        raise LogError(f"{argument}: no logs in it; expected {', '.join(LOG_SUFFIXES)}, each also with .gz")
    return paths


def _stray(path: Path) -> LogError:
    return LogError(
        f"{path}: lies beside folders with logs; move it into that of its vehicle, or name the file itself if it is of "
        f"the vehicle {path.resolve().parent.name}"
    )


def _source(path: Path) -> DriveFile:
    name = path.name.removesuffix(".gz")
    vehicle = path.resolve().parent.name.removesuffix(".zip")
    require_plain_name(vehicle, f"{path}: the folder's name, which names the vehicle,")
    require_plain_name(Path(name).stem, f"{path}: the file's name, which names the drive,")
    return DriveFile(vehicle=vehicle, name=Path(name).stem, path=path)


def _refused_vehicles(logs: Sequence[DriveFile], problems: list[UserError]) -> set[str]:
    """Vehicles of one name in two folders."""
    refused: set[str] = set()
    folders: dict[str, dict[Path, Path]] = {}
    for log in logs:
        folders.setdefault(log.vehicle, {})[log.path.resolve().parent] = log.path.parent
    for vehicle, places in folders.items():
        if len(places) > 1:
            refused.add(vehicle)
            problems.append(
                LogError(
                    f"two vehicles with one name: {vehicle} is in {' and in '.join(map(str, places.values()))}; "
                    f"rename one folder, or move the logs into one if it is the same vehicle"
                )
            )
    return refused


def _without_twins(logs: Sequence[DriveFile], problems: list[UserError]) -> list[DriveFile]:
    groups: dict[tuple[str, str], list[DriveFile]] = {}
    for log in logs:
        groups.setdefault((log.vehicle, log.name), []).append(log)
    for (vehicle, name), twins in groups.items():
        if len(twins) > 1:
            paths = " and ".join(str(log.path) for log in twins)
            problems.append(LogError(f"vehicle {vehicle}: drive {name} is in {paths}; remove or rename one"))
    return [twins[0] for twins in groups.values() if len(twins) == 1]
