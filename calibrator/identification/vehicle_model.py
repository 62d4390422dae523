"""From the drives of one vehicle to what a fleet needs of it: its model, and second moments of its currents.

The model is identified on the first 80 % of each drive's valid samples. The rest tells how well it simulates and may
serve as the unity drive. Equations are those of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array, DriveFile, Mask
from calibrator.drives.align import Samples, align
from calibrator.errors import DriveError
from calibrator.identification.identify import identify
from calibrator.identification.state_space import StateSpaceModel, simulation_snr_db
from calibrator.sources.fleet_source import Equipment, load_drive
from calibrator.terminal.text import counted
from ecu_node.database import VehicleDatabase

__all__ = ["LEAD_IN_S", "VehicleModel", "identify_vehicle", "read_vehicle_model"]

TRAIN_SHARE = 0.8
"""Share of each drive that the model is identified on, section IV-C of [1]_. [1]"""
LEAD_IN_S = 60.0
"""Inputs before the held-out part by which the states of the models settle. [s]"""
LEAST_DURATION_S = 60.0
"""Valid data below which a vehicle is left out: a few changes of speed and load. [s]"""
QUIET = 0.03
"""Standard deviation over mean below which an input counts as constant: a constant power over a varying voltage. [1]"""
GAP_S = 60.0
"""Invalid time put between two drives of a vehicle, so that no state carries over. [s]"""


@dataclass(frozen=True, kw_only=True)
class VehicleModel:
    """One vehicle as the fleet sees it.

    Attributes
    ----------
    vehicle : str
        Name.
    drives : tuple of str
        Names of the drives used.
    duration_s : float
        Valid data of all drives. [s]
    model : StateSpaceModel
        Inputs to measured currents (2).
    snr_db : ndarray of shape (K,)
        Simulation signal-to-noise ratio on held-out data. [dB]
    simulation_error_a : ndarray of shape (K,)
        Root mean square of the simulation error on held-out data. [A]
    mean_a : ndarray of shape (K,)
        Mean measured currents on all valid samples. [A]
    moment_a2 : ndarray of shape (K, K)
        Mean of the products of measured currents on all valid samples. [A^2]
    held_out_inputs : ndarray of shape (L + T, M)
        Inputs of the last 20 % of the longest drive with a lead-in of L samples before them, gaps bridged.
    lead_in : int
        L.
    """

    vehicle: str
    drives: tuple[str, ...]
    duration_s: float
    model: StateSpaceModel
    snr_db: Array
    simulation_error_a: Array
    mean_a: Array
    moment_a2: Array
    held_out_inputs: Array
    lead_in: int


def read_vehicle_model(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> VehicleModel:
    """Read the drives of one vehicle and identify its model.

    Parameters
    ----------
    entries : sequence of DriveFile
        Drives of one vehicle.
    equipment : Equipment
        Branches and model inputs of the fleet.
    database : VehicleDatabase
        DBC and layout.

    Returns
    -------
    VehicleModel
        The vehicle.

    Raises
    ------
    UserError
        If a drive cannot be read, or there is too little valid data; the message says which and how much.
    """
    drives = [
        align(load_drive(entry, database), database.layout, equipment.branches, inputs=equipment.inputs)
        for entry in entries
    ]
    names = tuple(entry.name for entry in entries)
    return identify_vehicle(drives, period_s=database.layout.period_s, vehicle=entries[0].vehicle, names=names)


def identify_vehicle(
    drives: Sequence[Samples], *, period_s: float, vehicle: str, names: tuple[str, ...]
) -> VehicleModel:
    """Identify the model of one vehicle from its aligned drives.

    Parameters
    ----------
    drives : sequence of Samples
        Drives of one vehicle, with the same branches and inputs.
    period_s : float
        Distance of the samples. [s]
    vehicle : str
        Name of the vehicle.
    names : tuple of str
        Names of the drives.

    Returns
    -------
    VehicleModel
        The vehicle.

    Raises
    ------
    DriveError
        If there is too little valid data; the message says how much.
    """
    duration_s = period_s * sum(int(drive.valid.sum()) for drive in drives)
    if duration_s < LEAST_DURATION_S:
        raise DriveError(
            f"{duration_s:.1f} s of usable data in {counted(len(drives), 'drive')}; at least {LEAST_DURATION_S:.0f} s "
            f"are needed"
        )
    inputs, currents, training, held_out = _joined(drives, int(GAP_S / period_s))
    valid = training | held_out
    stop = int(np.flatnonzero(training)[-1]) + 1
    model = _identify_excited(inputs[:stop], currents[:stop], training[:stop])
    simulated = model.simulate(_bridged(inputs, valid), initial_state=model.x0)
    longest = max(drives, key=lambda drive: int(drive.valid.sum()))
    first_held_out = int(np.flatnonzero(longest.valid & ~_in_training(longest.valid))[0])
    start = max(0, first_held_out - int(LEAD_IN_S / period_s))
    return VehicleModel(
        vehicle=vehicle,
        drives=names,
        duration_s=duration_s,
        model=model,
        snr_db=simulation_snr_db(currents[held_out], simulated[held_out]),
        simulation_error_a=np.sqrt(np.mean((currents[held_out] - simulated[held_out]) ** 2, axis=0)),
        mean_a=np.mean(currents[valid], axis=0),
        moment_a2=currents[valid].T @ currents[valid] / valid.sum(),
        held_out_inputs=_bridged(longest.inputs, longest.valid)[start:],
        lead_in=first_held_out - start,
    )


def _in_training(valid: Mask) -> Mask:
    """First 80 % of the valid samples of a drive, and what lies between them."""
    return np.asarray(np.cumsum(valid) <= TRAIN_SHARE * valid.sum())


def _identify_excited(inputs: Array, currents: Array, valid: Mask) -> StateSpaceModel:
    """Identify from the inputs that vary; what the others do cannot be learnt from this vehicle, so it is zero."""
    excited = inputs[valid].std(axis=0) > QUIET * np.abs(inputs[valid].mean(axis=0))
    if not excited.any():
        raise DriveError("none of its inputs varies: was it parked? record a drive in which it is used")
    try:
        model = identify(inputs[:, excited], currents, valid=valid)
    except np.linalg.LinAlgError as error:
        raise DriveError(
            f"no model can be identified from its drives ({error}); record a longer, varied drive"
        ) from None
    B = np.zeros((model.order, inputs.shape[1]))
    D = np.zeros((currents.shape[1], inputs.shape[1]))
    B[:, excited], D[:, excited] = model.B, model.D
    return replace(model, B=B, D=D)


def _joined(drives: Sequence[Samples], gap: int) -> tuple[Array, Array, Mask, Mask]:
    """Drives one after the other with invalid gaps: inputs, currents, training mask, held-out mask."""

    def stack(arrays: list[Array]) -> Array:
        spacer = np.full((gap, arrays[0].shape[1]), np.nan)
        return np.concatenate([part for array in arrays for part in (array, spacer)][:-1])

    def mask(first: bool) -> Mask:
        parts = []
        for drive in drives:
            parts += [drive.valid & (_in_training(drive.valid) == first), np.zeros(gap, bool)]
        return np.concatenate(parts[:-1])

    inputs = stack([drive.inputs for drive in drives])
    currents = stack([drive.currents_a for drive in drives])
    return inputs, currents, mask(first=True), mask(first=False)


def _bridged(inputs: Array, valid: Mask) -> Array:
    """Inputs with linear interpolation over samples that are not valid."""
    known = np.flatnonzero(valid)
    everywhere = np.arange(len(inputs))
    return np.column_stack([np.interp(everywhere, known, column[known]) for column in inputs.T])
