"""One record of a store: what one reading of a vehicle's drives gave. Records of a vehicle add up."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

import numpy as np

from calibrator.drive import Array
from calibrator.drives.delays import BranchDelays
from calibrator.drives.store import require_plain_name
from calibrator.errors import DriveError
from calibrator.summaries.vehicle_summary import LEAST_DURATION_S, VehicleSummary
from calibrator.summaries.zero_current import ZeroCurrent, weighted_mean
from calibrator.terminal.text import counted

__all__ = [
    "IMPOSSIBLE",
    "MOST_MOMENT",
    "MOST_VARIANCE_A2",
    "Known",
    "Outline",
    "Record",
    "added_summaries",
    "drives_digest",
    "joined_records",
    "name_problem",
    "outline_of",
    "stored_problem",
]

IMPOSSIBLE = "its summary holds impossible numbers; look at its recordings, and summarise them again"
"""Why a vehicle is left out."""
FEWEST_BLOCKS = 4
"""Fewer do not tell how sure anything is; a node's own are of several minutes. [1]"""
MOST_MOMENT, MOST_VARIANCE_A2 = 1e30, 1e10
"""Far beyond what any vehicle's recordings give: sums of products in any unit, variance of a current [A^2]."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """Some drives of one vehicle that were read together.

    Attributes
    ----------
    vehicle : str
        Name.
    drives : tuple of str
        Names of the drives.
    sources : tuple of str
        Which version of each drive's file was read, see :class:`.DriveFile`.
    digests : tuple of str
        What each drive holds, see :func:`.recording_digest`; none of drives that could not be read.
    found : VehicleSummary or None
        What they tell; None if they cannot be used.
    problem : str
        Why not; empty if they can.
    damaged: bool
        Whether they could be used, but what is stored of them makes no sense: their vehicle is left out.
    """

    vehicle: str
    drives: tuple[str, ...]
    sources: tuple[str, ...]
    found: VehicleSummary | None
    problem: str = ""
    damaged: bool = False
    digests: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Known:
    """Which drives a record is of; attributes as of :class:`Record`."""

    vehicle: str
    drives: tuple[str, ...]
    sources: tuple[str, ...]
    digests: tuple[str, ...]
    problem: str


@dataclass(frozen=True, kw_only=True)
class Outline:
    """What there is of one vehicle.

    Attributes
    ----------
    vehicle : str
        Name.
    drives : tuple of str
        Names of the drives that can be used.
    problem : str
        Why the vehicle cannot be calibrated; empty if it can.
    """

    vehicle: str
    drives: tuple[str, ...]
    problem: str


def drives_digest(records: Sequence[Record]) -> str:
    """Digest of the drives of a vehicle that can be used, as they are: another one if any was added or changed."""
    known = sorted(
        pair for record in records if record.found for pair in zip(record.drives, record.sources, strict=True)
    )
    return hashlib.blake2b(repr(known).encode(), digest_size=16).hexdigest()


def name_problem(vehicle: str) -> str:
    """Why a vehicle of this name cannot be used, as its parameter file is named after it; empty if it can."""
    try:
        require_plain_name(vehicle, "vehicle")
    except DriveError as error:
        return str(error)
    return ""


def stored_problem(text: str) -> str:
    """The problem of a record as one line, whatever is stored."""
    return " ".join(text.split()) or "no reason is stored; summarise its drives again"


def outline_of(vehicle: str, rows: Sequence[Mapping[str, Any]]) -> Outline:
    """Outline of a vehicle from the rows of its records, without their moments."""
    usable = [row for row in rows if row["problem"] is None]
    drives = tuple(name for row in usable for name in row["drives"] or ())
    return Outline(vehicle=vehicle, drives=drives, problem=name_problem(vehicle) or _problem_of(rows, usable, drives))


def _problem_of(rows: Sequence[Mapping[str, Any]], usable: Sequence[Mapping[str, Any]], drives: Sequence[str]) -> str:
    if not usable:
        return stored_problem(rows[-1]["problem"])
    durations_s = [row["duration_s"] for row in usable]
    if not all(value is not None and math.isfinite(value) and value > 0.0 for value in durations_s):
        return IMPOSSIBLE
    return _too_short(sum(durations_s), drives)


def _too_short(duration_s: float, drives: Sequence[str]) -> str:
    """Why so much data cannot be used; empty if it can."""
    if duration_s >= LEAST_DURATION_S:
        return ""
    found = f"{duration_s:.1f} s of usable data in {counted(len(drives), 'drive')}"
    return f"{found}; at least {LEAST_DURATION_S:.0f} s are needed"


def joined_records(records: Sequence[Record]) -> VehicleSummary:
    """All that the records of one vehicle tell.

    Parameters
    ----------
    records : sequence of Record
        Of one vehicle, at least one.

    Returns
    -------
    VehicleSummary
        With the blocks of all of them; delays are those of the record that tells them best, as drives are aligned with
        their own; readings in zero-current windows are averaged by their precision.

    Raises
    ------
    DriveError
        If none can be used, one is damaged, or they are too short together.
    """
    for record in records:
        if record.damaged:
            raise DriveError(record.problem)
    usable = [record.found for record in records if record.found is not None]
    if not usable:
        raise DriveError(records[-1].problem)
    found = added_summaries(usable)
    if problem := _too_short(found.summary.duration_s, found.drives):
        raise DriveError(problem)
    if len(found.summary.moments) < FEWEST_BLOCKS:
        raise DriveError(
            f"{counted(len(found.summary.moments), 'block')} in {counted(len(found.drives), 'drive')}; at least "
            f"{FEWEST_BLOCKS} are needed"
        )
    if not np.abs(found.summary.moments).max() < MOST_MOMENT or found.summary.variance_a2.max() > MOST_VARIANCE_A2:
        raise DriveError(IMPOSSIBLE)
    return found


def added_summaries(parts: Sequence[VehicleSummary]) -> VehicleSummary:
    """Summary of all drives of several summaries of one vehicle, at least one."""
    return VehicleSummary(
        vehicle=parts[0].vehicle,
        drives=tuple(name for part in parts for name in part.drives),
        summary=reduce(add, [part.summary for part in parts]),
        delays=_best_delays([part.delays for part in parts]),
        zero_current=_mean_reading([part.zero_current for part in parts]),
        recorded=frozenset.intersection(*(part.recorded for part in parts)),
    )


def _best_delays(parts: Sequence[BranchDelays]) -> BranchDelays:
    """Delays of the record that knows most of them, and these best: records may have different reference branches."""
    return max(parts, key=lambda part: (int(part.known.sum()), -float(part.sd_s[part.known].sum())))


def _mean_reading(parts: Sequence[ZeroCurrent]) -> ZeroCurrent:
    pairs: list[tuple[Array, Array]] = [(part.offset_a, part.sd_a) for part in parts]
    offset_a, sd_a = weighted_mean(*pairs)
    return ZeroCurrent(offset_a=offset_a, sd_a=sd_a)
