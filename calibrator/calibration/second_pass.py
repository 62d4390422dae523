"""Second pass over a fleet's summaries: every vehicle of a chunk by itself, with the reference of the fleet.

If there is an earlier result, vehicles that have not driven since keep its parameters. Of the others it is looked at
whether their new drives alone tell other faults: a sensor that has moved is calibrated from the new drives, any other
from all of them. Summaries do not tell sensors that are not linear; vehicles that have such sensors, or may have, keep
their earlier parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calibrator.calibration.previous import PreviousResult, moved_sensors
from calibrator.errors import DriveError
from calibrator.evidence.vehicle_evidence import VehicleEvidence
from calibrator.posterior.fleet_task import FleetTask
from calibrator.results.chunk import ChunkResult, encode_chunk
from calibrator.results.parameter_parts import Written
from calibrator.summaries.record import Record, drives_digest, joined_records
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters, decode_parameters

__all__ = ["calibrate_bucket"]

_BAD_VEHICLE = (UserError, np.linalg.LinAlgError, ArithmeticError, LookupError, ValueError)
"""What numbers that make no sense may raise."""
SILENT: dict[str, Any] = {"over": "ignore", "invalid": "ignore", "divide": "ignore"}
"""What comes of such numbers is not finite, which is refused; no warning is needed."""
NOT_THERE = "it is not in this store; its earlier parameters are in the earlier result"


@dataclass(kw_only=True)
class _Found:
    """What has been found of a chunk so far."""

    parameters: list[VehicleParameters] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    moved: dict[tuple[str, str], str] = field(default_factory=dict)
    evidence: dict[str, VehicleEvidence] = field(default_factory=dict)


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
    before = previous.written(bucket) if previous is not None else {}
    digests = {name: drives_digest(items) for name, items in records.items()}
    todo: list[VehicleSummary] = []
    for name, items in records.items():
        earlier = _earlier(name, before.get(name))
        if earlier is not None and (before[name].drives == digests[name] or _not_linear(earlier)):
            found.parameters.append(earlier)  # its evidence was found against another reference, and is not kept
            continue
        try:
            todo.append(_what_holds(items, earlier, task, found))
        except DriveError as error:
            found.left_out[name] = str(error)
    found.left_out |= dict.fromkeys(before.keys() - records.keys(), NOT_THERE)
    _calibrate(todo, task, found)
    return encode_chunk(found.parameters, found.left_out, moved=found.moved, drives=digests, evidence=found.evidence)


def _earlier(name: str, written: Written | None) -> VehicleParameters | None:
    return None if written is None else decode_parameters(written.text, f"earlier parameters of {name}")


def _not_linear(earlier: VehicleParameters) -> bool:
    branches = earlier.branches.values()
    return any(branch.sensor_model is not None or branch.held_back == "not linear" for branch in branches)


def _what_holds(
    records: Sequence[Record], earlier: VehicleParameters | None, task: FleetTask, found: _Found
) -> VehicleSummary:
    """Summary of all drives of a vehicle, or of the new ones alone if they show that a sensor has moved.

    Records stand in the order in which they came. Those before the first one that the earlier parameters were found
    from are of a time before a sensor moved.
    """
    drives = set() if earlier is None else set(earlier.provenance.drives)
    known = [place for place, record in enumerate(records) if record.drives and set(record.drives) <= drives]
    if earlier is None or not known:
        return joined_records(records)
    everything = joined_records(records[known[0] :])
    moved = _moved_since(records[known[-1] + 1 :], earlier, task)
    if moved is None:
        return everything
    recent, changes = moved
    found.moved |= {(earlier.vehicle, branch): text for branch, text in changes.items()}
    return recent


def _moved_since(
    new: Sequence[Record], earlier: VehicleParameters, task: FleetTask
) -> tuple[VehicleSummary, dict[str, str]] | None:
    """New drives alone, and what they show to have moved; None if nothing has, or they do not tell."""
    if not any(record.found for record in new):
        return None
    try:
        recent = joined_records(new)
        with np.errstate(**SILENT):
            posterior = task.estimate([recent])
    except _BAD_VEHICLE:
        return None
    scale_a = task.identity.database.layout.full_scale_a
    changes = moved_sensors(earlier, posterior, task.branches, full_scale_a=scale_a)
    return (recent, changes) if changes else None


def _calibrate(vehicles: Sequence[VehicleSummary], task: FleetTask, found: _Found) -> None:
    """All together, or one after the other if one of them cannot be estimated."""
    try:
        with np.errstate(
            over="ignore", invalid="ignore", divide="ignore"
        ):  # what comes of it is not finite, and refused
            calibrated = task.calibrate(vehicles)
    except _BAD_VEHICLE as error:
        if len(vehicles) == 1:
            found.left_out[vehicles[0].vehicle] = f"its evidence cannot be used: {error}; look at its recordings"
            return
        for vehicle in vehicles:
            _calibrate([vehicle], task, found)
    else:
        found.parameters += calibrated.parameters
        found.left_out |= calibrated.left_out
        found.evidence |= calibrated.evidence
