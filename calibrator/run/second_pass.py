"""Second pass over a fleet's summaries: every vehicle of a chunk by itself, with the reference of the fleet.

If there is an earlier result, vehicles that have not driven since keep its parameters. Of the others it is looked at
whether their new drives alone tell other faults: a sensor that has moved is calibrated from the new drives, any other
from all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calibrator.errors import DriveError
from calibrator.evidence.vehicle_summary import VehicleSummary
from calibrator.posterior.fleet import FleetTask
from calibrator.results import ChunkResult, encode_chunk
from calibrator.run.previous import PreviousResult, moved_sensors
from calibrator.summaries.record import Record, joined_records
from calibrator.summaries.store import SummaryStore
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters

__all__ = ["calibrate_bucket"]

_BAD_VEHICLE = (UserError, np.linalg.LinAlgError, ArithmeticError, ValueError)
"""What numbers that make no sense may raise."""


@dataclass(kw_only=True)
class _Found:
    """What has been found of a chunk so far."""

    parameters: list[VehicleParameters] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    moved: dict[tuple[str, str], str] = field(default_factory=dict)


def calibrate_bucket(
    bucket: int, *, store: SummaryStore, task: FleetTask, previous: PreviousResult | None = None
) -> ChunkResult:
    """Calibrate the vehicles of a bucket; one bad vehicle never stops the others.

    Parameters
    ----------
    bucket : int
        Which.
    store : SummaryStore
        The store.
    task : FleetTask
        What was learnt.
    previous : PreviousResult or None
        Earlier result to go on from.

    Returns
    -------
    ChunkResult
        Parameters, and who was left out and why.
    """
    records, found = store.read(bucket), _Found()
    before = previous.parameters(bucket, list(records)) if previous is not None else {}
    todo: list[VehicleSummary] = []
    for name, items in records.items():
        known, new = _known_and_new(items, before.get(name))
        if known and not any(record.found for record in new):
            found.parameters.append(before[name])
            continue
        try:
            todo.append(_what_holds(known, new, before[name], task, found) if known else joined_records(new))
        except DriveError as error:
            found.left_out[name] = str(error)
    _calibrate(todo, task, found)
    return encode_chunk(found.parameters, found.left_out, found.moved)


def _known_and_new(
    records: Sequence[Record], before: VehicleParameters | None
) -> tuple[Sequence[Record], Sequence[Record]]:
    """Records that the earlier parameters were found from, and those that came since.

    Records stand in the order in which they came. Those before the first known one are of a time before a sensor moved.
    """
    drives = set() if before is None else set(before.provenance.drives)
    known = [place for place, record in enumerate(records) if drives & set(record.drives)]
    if not known:
        return [], records
    return records[known[0] : known[-1] + 1], records[known[-1] + 1 :]


def _what_holds(
    known: Sequence[Record], new: Sequence[Record], before: VehicleParameters, task: FleetTask, found: _Found
) -> VehicleSummary:
    """Summary of all drives of a vehicle, or of the new ones alone if they show that a sensor has moved."""
    everything = joined_records([*known, *new])
    try:
        recent = joined_records(new)
    except DriveError:
        return everything
    try:
        posterior = task.estimate([recent])
    except _BAD_VEHICLE:
        return everything
    scale_a = task.identity.database.layout.full_scale_a
    moved = moved_sensors(before, posterior, task.branches, full_scale_a=scale_a)
    found.moved |= {(before.vehicle, branch): text for branch, text in moved.items()}
    return recent if moved else everything


def _calibrate(vehicles: Sequence[VehicleSummary], task: FleetTask, found: _Found) -> None:
    """All together, or one after the other if one of them cannot be estimated."""
    try:
        with np.errstate(
            over="ignore", invalid="ignore", divide="ignore"
        ):  # what comes of it is not finite, and refused
            parameters, left_out = task.calibrate(vehicles)
    except _BAD_VEHICLE as error:
        if len(vehicles) == 1:
            found.left_out[vehicles[0].vehicle] = f"its evidence cannot be used: {error}; look at its recordings"
            return
        for vehicle in vehicles:
            _calibrate([vehicle], task, found)
    else:
        found.parameters += parameters
        found.left_out |= left_out
