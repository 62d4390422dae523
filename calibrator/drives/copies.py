"""Recordings that a fleet holds twice: a copy tells nothing new, yet would count as another vehicle or drive.

Two drives are the same recording if their files hold the same bytes but for compression and names. No two recordings of
a car are: noise and time stamps differ.
"""

import gzip
import hashlib
import io
import zlib
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from calibrator.drive import DriveFile
from calibrator.drives.fleet_source import FleetSource
from calibrator.drives.store import drive_digest, drive_outline
from ecu_node.errors import UserError

__all__ = ["without_copies"]

_HEAD_BYTES = 1 << 16
"""Looked at before a whole log is: where the noise differs, it does so here."""
_UNREADABLE = (UserError, OSError, EOFError, zlib.error)
"""What a damaged file may raise; whoever reads the drive tells of it."""


def without_copies(fleet: FleetSource) -> FleetSource:
    """Leave out every drive that is a copy of an earlier one, and vehicles that have no others.

    Parameters
    ----------
    fleet : FleetSource
        The fleet.

    Returns
    -------
    FleetSource
        The same without copies; why they are left out stands by VEHICLE or VEHICLE/DRIVE.
    """
    originals = _originals([entry for entries in fleet.vehicles.values() for entry in entries])
    left_out = dict(fleet.left_out)
    vehicles: dict[str, tuple[DriveFile, ...]] = {}
    for name, entries in fleet.vehicles.items():
        kept = tuple(entry for entry in entries if entry not in originals)
        copies = [entry for entry in entries if entry in originals]
        if kept:
            vehicles[name] = kept
            left_out |= {f"{name}/{e.name}": _reason([f"{originals[e].vehicle}/{originals[e].name}"]) for e in copies}
        else:
            left_out[name] = _reason([originals[entry].vehicle for entry in copies])
    return replace(fleet, vehicles=vehicles, left_out=left_out)


def _reason(originals: Sequence[str]) -> str:
    return (
        f"same recording as {', '.join(dict.fromkeys(originals))}; a copy tells nothing new: remove the one that "
        f"is in the wrong place"
    )


def _originals(entries: Sequence[DriveFile]) -> dict[DriveFile, DriveFile]:
    """The first drive of the same recording, by copy."""
    found: dict[DriveFile, DriveFile] = {}
    for suspects in _groups(entries, _outline):
        for same in _groups(suspects, _digest):
            found |= dict.fromkeys(same[1:], same[0])
    return found


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
    if path.suffix == ".parquet":
        return drive_outline(path)
    with _unpacked(path) as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise EOFError  # an empty log is no recording
    return hashlib.blake2b(head).digest()


def _digest(path: Path) -> Hashable:
    """What tells a recording from all others."""
    if path.suffix == ".parquet":
        return drive_digest(path)
    with _unpacked(path) as file:
        return hashlib.file_digest(file, "blake2b").digest()


def _unpacked(path: Path) -> io.BufferedIOBase:
    return gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb")
