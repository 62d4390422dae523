"""Second pass over a fleet's summaries: every vehicle of a chunk by itself, with the reference of the fleet."""

from collections.abc import Sequence

import numpy as np

from calibrator.errors import DriveError
from calibrator.evidence.vehicle_summary import VehicleSummary
from calibrator.posterior.fleet import FleetTask
from calibrator.results import ChunkResult, encode_chunk
from calibrator.summaries.record import joined_records
from calibrator.summaries.store import SummaryStore
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters

__all__ = ["calibrate_bucket"]

_BAD_VEHICLE = (UserError, np.linalg.LinAlgError, ArithmeticError, ValueError)
"""What numbers that make no sense may raise."""


def calibrate_bucket(bucket: int, *, store: SummaryStore, task: FleetTask) -> ChunkResult:
    """Calibrate the vehicles of a bucket; one bad vehicle never stops the others.

    Parameters
    ----------
    bucket : int
        Which.
    store : SummaryStore
        The store.
    task : FleetTask
        What was learnt.

    Returns
    -------
    ChunkResult
        Parameters, and who was left out and why.
    """
    vehicles: list[VehicleSummary] = []
    left_out: dict[str, str] = {}
    for name, records in store.read(bucket).items():
        try:
            vehicles.append(joined_records(records))
        except DriveError as error:
            left_out[name] = str(error)
    parameters, refused = _calibrate(vehicles, task)
    return encode_chunk(parameters, left_out | refused)


def _calibrate(vehicles: Sequence[VehicleSummary], task: FleetTask) -> tuple[list[VehicleParameters], dict[str, str]]:
    """All together, or one after the other if one of them cannot be estimated."""
    try:
        return task.calibrate(vehicles)
    except _BAD_VEHICLE as error:
        if len(vehicles) == 1:
            return [], {vehicles[0].vehicle: f"its evidence cannot be used: {error}; look at its recordings"}
    parameters: list[VehicleParameters] = []
    left_out: dict[str, str] = {}
    for vehicle in vehicles:
        found, refused = _calibrate([vehicle], task)
        parameters += found
        left_out |= refused
    return parameters, left_out
