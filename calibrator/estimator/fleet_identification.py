"""Identify a fleet: one filter bank for all vehicles, or for the published method [1]_ a model of each.

A model of one vehicle is identified on the first 80 % of the valid samples of each drive. The rest says how well it
simulates, and may serve as the unity drive.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibrator.drive import Array, DriveFile, Mask
from calibrator.drives.align import Samples, align
from calibrator.errors import DriveError
from calibrator.estimator.filter_bank_choice import choose_filter_bank, held_out_snr_db
from calibrator.estimator.state_space import StateSpaceModel, bridged, identify, simulation_snr_db
from calibrator.sources.copies import without_copies
from calibrator.sources.fleet_source import Equipment, FleetSource, find_fleet, load_drive, probe_equipment
from calibrator.sources.vehicles import read_each, read_vehicles
from calibrator.summaries.filter_bank import FilterBank, low_pass_bank
from calibrator.summaries.vehicle_summary import read_samples, read_vehicle_summary
from calibrator.terminal.text import counted, dumps, left_out_text, table
from ecu_node.database import VehicleDatabase

__all__ = ["IdentificationReport", "VehicleModel", "identify_fleet", "identify_vehicle", "read_vehicle_model"]

POOLED_VEHICLES = 8
"""Vehicles that a bank is chosen from: more of them hardly move its poles. [1]"""
TRAIN_SHARE = 0.8
"""Share of each drive that a model is identified on, section IV-C of [1]_. [1]"""
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
    """One vehicle with a model of its own.

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
    read = (load_drive(entry, database) for entry in entries)
    drives = [align(drive, database.layout, equipment.branches, inputs=equipment.inputs) for drive in read]
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
    # The drives one after the other, each followed by a gap that is not valid.
    gap = int(GAP_S / period_s)
    inputs = np.concatenate([np.pad(drive.inputs, ((0, gap), (0, 0))) for drive in drives])
    currents = np.concatenate([np.pad(drive.currents_a, ((0, gap), (0, 0))) for drive in drives])
    valid = np.concatenate([np.pad(drive.valid, (0, gap)) for drive in drives])
    training = valid & np.concatenate([np.pad(_in_training(drive.valid), (0, gap)) for drive in drives])
    held_out, stop = valid & ~training, int(np.flatnonzero(training)[-1]) + 1
    model = _identify_excited(inputs[:stop], currents[:stop], training[:stop])
    simulated = model.simulate(bridged(inputs, valid), initial_state=model.x0)
    longest = max(drives, key=lambda drive: int(drive.valid.sum()))
    first_held_out = int(np.argmin(_in_training(longest.valid)))
    start = max(0, first_held_out - int(LEAD_IN_S / period_s))
    return VehicleModel(
        vehicle=vehicle,
        drives=names,
        duration_s=duration_s,
        model=model,
        snr_db=simulation_snr_db(currents[held_out], simulated[held_out]),
        simulation_error_a=np.sqrt(np.mean((currents - simulated)[held_out] ** 2, axis=0)),
        mean_a=np.mean(currents[valid], axis=0),
        moment_a2=currents[valid].T @ currents[valid] / valid.sum(),
        held_out_inputs=bridged(longest.inputs, longest.valid)[start:],
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
    columns = np.eye(len(excited))[excited]
    return replace(model, B=model.B @ columns, D=model.D @ columns)


@dataclass(frozen=True, kw_only=True)
class IdentificationReport:
    """How well one filter bank simulates a fleet.

    Attributes
    ----------
    bank : FilterBank
        The bank.
    branches : tuple of str
        Names of the K branches.
    snr_db : mapping of str to mapping of str to float
        Simulation signal-to-noise ratio on held-out blocks by vehicle and branch; NaN where it is not known. [dB]
    left_out : mapping of str to str
        Why other vehicles could not be used.
    notices : tuple of str
        What else the user should know.
    """

    bank: FilterBank
    branches: tuple[str, ...]
    snr_db: Mapping[str, Mapping[str, float]]
    left_out: Mapping[str, str]
    notices: tuple[str, ...]

    def as_json(self) -> str:
        """The report as JSON."""
        bank = {"identity": self.bank.identity, "file": self.bank, "described": self.bank.described()}
        return dumps({**vars(self), "bank": bank, "branches": self._by_branch()})

    def as_text(self) -> str:
        """The report for people."""
        rows = []
        for branch, row in self._by_branch().items():
            figures = [f"{row[key]:.1f}" if np.isfinite(row[key]) else "-" for key in ("median_db", "worst_db")]
            rows.append([branch, *figures, row["worst_vehicle"]])
        parts = [
            f"filter bank {self.bank.identity} of {len(self.bank.input_names)} inputs: {self.bank.described()}",
            table(("simulation SNR [dB]", "median", "worst", "vehicle"), rows),
            f"vehicles: {len(self.snr_db)}",
            "\n".join(f"notice: {notice}" for notice in self.notices),
            left_out_text(self.left_out),
        ]
        return "\n\n".join(part for part in parts if part)

    def _by_branch(self) -> dict[str, dict[str, Any]]:
        """Median over vehicles [dB] and worst vehicle; NaN and nobody where no vehicle could be judged."""
        rows = {}
        for branch in self.branches:
            judged = {name: snr_db[branch] for name, snr_db in self.snr_db.items() if np.isfinite(snr_db[branch])}
            worst = min(judged, key=lambda name: judged[name], default="")
            median_db = float(np.median(list(judged.values()))) if judged else np.nan
            rows[branch] = {"median_db": median_db, "worst_db": judged.get(worst, np.nan), "worst_vehicle": worst}
        return rows


def identify_fleet(
    path: Path, database: VehicleDatabase, *, bank: FilterBank | None, time_constants_s: Sequence[float], workers: int
) -> IdentificationReport:
    """Choose the filter bank of a fleet, or take one that is given, and judge it by every vehicle.

    Parameters
    ----------
    path : Path
        The fleet, see :func:`calibrator.sources.fleet_source.find_fleet`.
    database : VehicleDatabase
        DBC and layout.
    bank : FilterBank or None
        A bank that is given.
    time_constants_s : sequence of float
        Those of low-passes that are given; empty: chosen from some vehicles of the fleet, if no bank is given. [s]
    workers : int
        Number of processes.

    Returns
    -------
    IdentificationReport
        The bank, and how well it does.

    Raises
    ------
    UserError
        If no vehicle can be used, or the bank is not of the fleet's inputs.
    """
    fleet, period_s = without_copies(find_fleet(path)), database.layout.period_s
    equipment = probe_equipment(fleet, database, None)
    if bank is None and time_constants_s:
        bank = low_pass_bank(equipment.fleet_inputs, time_constants_s, period_s=period_s)
    elif bank is None:
        bank = _chosen_bank(fleet, equipment, database, workers=workers)
    if (bank.input_names, bank.period_s) != (equipment.fleet_inputs, period_s):
        raise DriveError(
            f"the filter bank is of the inputs {', '.join(bank.input_names)} every {bank.period_s:g} s, the fleet has "
            f"{', '.join(equipment.fleet_inputs)} every {period_s:g} s; choose one with 'calibrator identify' for this "
            f"fleet"
        )
    read_one = partial(read_vehicle_summary, bank=bank)
    vehicles, left_out = read_vehicles(read_one, fleet, equipment, database, workers=workers)
    snr_db = held_out_snr_db([vehicle.summary for vehicle in vehicles]).tolist()
    named = {
        one.vehicle: dict(zip(equipment.branches, of, strict=True)) for one, of in zip(vehicles, snr_db, strict=True)
    }
    notices = (*fleet.notices, *equipment.notices)
    return IdentificationReport(
        bank=bank, branches=equipment.branches, snr_db=named, left_out=left_out, notices=notices
    )


def _chosen_bank(fleet: FleetSource, equipment: Equipment, database: VehicleDatabase, *, workers: int) -> FilterBank:
    """Bank chosen from vehicles that are spread evenly over the fleet."""
    names = list(fleet.vehicles)
    some = [names[j] for j in np.unique(np.linspace(0, len(names) - 1, POOLED_VEHICLES).round().astype(int))]
    readers = dict.fromkeys(some, read_samples)
    read, errors = read_each(readers, fleet, equipment, database, workers=workers, label="read some drives")
    if not read:
        raise DriveError(f"none of {len(some)} vehicles can be read to choose a filter bank; {errors[some[0]]}")
    return choose_filter_bank(list(read.values()), period_s=database.layout.period_s)
