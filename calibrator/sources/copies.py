"""Recordings that a fleet holds twice: a copy tells nothing new, yet would count as another vehicle or drive.

Two drives are the same recording if they hold the same, whatever they are called and however logs are packed. No two
recordings of a car are: noise and time stamps differ. Of one that two vehicles have it cannot be told whose it is, so
neither is calibrated with it. Copies of a drive that different versions of this program stored are not recognised.
"""

import hashlib
import io
from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import cast

from calibrator.drive import DriveFile
from calibrator.drives.drive_file import drive_digest, drive_outline, is_drive_file
from calibrator.recordings.log_files import UNREADABLE, open_log, readable
from calibrator.sources.fleet_source import FleetSource
from ecu_node.errors import UserError

__all__ = ["without_copies"]

_HEAD_BYTES = 1 << 16
"""Looked at before a whole log is: where the noise differs, it does so here."""
WHOSE = "it cannot be told whose it is: remove it where it does not belong"
_UNREADABLE = (UserError, *UNREADABLE)
"""What a damaged file may raise; whoever reads the drive tells of it."""


def without_copies(fleet: FleetSource) -> FleetSource:
    """Count a recording that a vehicle has twice once, and leave out those that several vehicles have.

    Parameters
    ----------
    fleet : FleetSource
        The fleet.

    Returns
    -------
    FleetSource
        The same without copies; vehicles that have no other drives are left out, other copies stand in the notices.
    """
    dropped: dict[DriveFile, DriveFile] = {}
    notices: list[str] = []
    entries = [entry for entries in fleet.vehicles.values() for entry in entries]
    for same in (group for suspects in _groups(entries, _outline) for group in _groups(suspects, _digest)):
        if len({entry.vehicle for entry in same}) > 1:
            dropped |= {entry: next(e for e in same if e.vehicle != entry.vehicle) for entry in same}
        else:
            dropped |= dict.fromkeys(same[1:], same[0])
    left_out, vehicles = dict(fleet.left_out), {}
    for name, drives in fleet.vehicles.items():
        kept = tuple(entry for entry in drives if entry not in dropped)
        originals = [dropped[entry] for entry in drives if entry in dropped]
        if kept:
            vehicles[name] = kept
            notices += [_notice(entry, dropped[entry]) for entry in drives if entry in dropped]
        else:
            others = ", ".join(dict.fromkeys(entry.vehicle for entry in originals))
            left_out[name] = f"same recording as {others}; {WHOSE}"
    return replace(fleet, vehicles=vehicles, left_out=left_out, notices=(*fleet.notices, *notices))


def _notice(copy: DriveFile, original: DriveFile) -> str:
    if copy.vehicle == original.vehicle:
        return f"vehicle {copy.vehicle}: drive {copy.name} is the same recording as {original.name}, and counts once"
    same = f"same recording as {original.vehicle}/{original.name}"
    return f"vehicle {copy.vehicle}: drive {copy.name} is left out: {same}; {WHOSE}"


def _groups(entries: Iterable[DriveFile], key: Callable[[Path], Hashable]) -> list[list[DriveFile]]:
    """Drives that share a key; those without companions, or that cannot be read, are not among them."""
    groups: dict[Hashable, list[DriveFile]] = {}
    for entry in entries:
        try:
            groups.setdefault(key(entry.path), []).append(entry)
        except _UNREADABLE:
            continue
    return [group for group in groups.values() if len(group) > 1]


def _outline(path: Path) -> Hashable:
    """What is quickly seen of a recording; it differs between different ones, as a rule."""
    if is_drive_file(path):
        return drive_outline(path)
    with readable(path) as copy, open_log(copy) as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise EOFError  # an empty log is no recording
    return hashlib.blake2b(head).digest()


def _digest(path: Path) -> Hashable:
    """What tells a recording from all others."""
    if is_drive_file(path):
        return drive_digest(path)
    with readable(path) as copy, open_log(copy) as file:
        return hashlib.file_digest(cast("io.BufferedIOBase", file), "blake2b").digest()
