"""Identify a fleet: one filter bank for all vehicles, a read-out for each, and a model of its own where that fails.

A model of its own, as the published method [1]_ needs of every vehicle, is identified on the first 80 % of the valid
samples of each drive. The rest says how well it simulates, and may serve as the unity drive.

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
from calibrator.estimator.filter_bank_choice import choose_filter_bank, far_below_fleet, fit_read_outs
from calibrator.estimator.state_space import StateSpaceModel, bridged, identify, simulation_snr_db
from calibrator.sources.copies import without_copies
from calibrator.sources.fleet_source import Equipment, FleetSource, find_fleet, load_drive, probe_equipment
from calibrator.sources.vehicles import read_each, read_vehicles
from calibrator.summaries.filter_bank import FilterBank, low_pass_bank
from calibrator.summaries.vehicle_summary import read_samples, read_vehicle_summary
from calibrator.terminal.text import counted, dumps, left_out_text, table
from ecu_node.database import VehicleDatabase

__all__ = [
    "IdentificationReport",
    "VehicleModel",
    "identify_better",
    "identify_fleet",
    "identify_vehicle",
    "read_vehicle_model",
]

POOLED_VEHICLES = 8
"""Vehicles that a bank is chosen from: more of them hardly move its poles. [1]"""
OWN_GAIN_DB = 3.0
"""By how much a model of its own must simulate its worst branch better than the shared bank does its. [dB]"""
EXACT_DB = 60.0
"""Better simulation than this counts as no better: the residual is the rounding of signals. [dB]"""
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
    layout = database.layout
    drives = [
        align(load_drive(entry, database), layout, equipment.branches, inputs=equipment.inputs) for entry in entries
    ]
    names = tuple(entry.name for entry in entries)
    return identify_vehicle(drives, period_s=layout.period_s, vehicle=entries[0].vehicle, names=names)


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
    inputs, currents = (
        np.concatenate([np.pad(part, ((0, gap), (0, 0)), constant_values=np.nan) for part in parts])
        for parts in ([drive.inputs for drive in drives], [drive.currents_a for drive in drives])
    )
    valid = np.concatenate([np.pad(drive.valid, (0, gap)) for drive in drives])
    training = valid & np.concatenate([np.pad(_in_training(drive.valid), (0, gap)) for drive in drives])
    held_out = valid & ~training
    stop = int(np.flatnonzero(training)[-1]) + 1
    model = _identify_excited(inputs[:stop], currents[:stop], training[:stop])
    error_a = currents[held_out] - model.simulate(bridged(inputs, valid), initial_state=model.x0)[held_out]
    longest = max(drives, key=lambda drive: int(drive.valid.sum()))
    first_held_out = int(np.flatnonzero(longest.valid & ~_in_training(longest.valid))[0])
    start = max(0, first_held_out - int(LEAD_IN_S / period_s))
    return VehicleModel(
        vehicle=vehicle,
        drives=names,
        duration_s=duration_s,
        model=model,
        snr_db=simulation_snr_db(currents[held_out], currents[held_out] - error_a),
        simulation_error_a=np.sqrt(np.mean(error_a**2, axis=0)),
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
    B, D = np.zeros((model.order, len(excited))), np.zeros((currents.shape[1], len(excited)))
    B[:, excited], D[:, excited] = model.B, model.D
    return replace(model, B=B, D=D)


@dataclass(frozen=True, kw_only=True)
class IdentificationReport:
    """How well one filter bank simulates a fleet.

    Attributes
    ----------
    bank : FilterBank
        The bank.
    branches : tuple of str
        Names of the K branches.
    snr_db : mapping of str to ndarray of shape (K,)
        Simulation signal-to-noise ratio of each vehicle on held-out blocks. [dB]
    own : mapping of str to VehicleModel
        Vehicles that need a model of their own.
    left_out : mapping of str to str
        Why other vehicles could not be used.
    notices : tuple of str
        What else the user should know.
    """

    bank: FilterBank
    branches: tuple[str, ...]
    snr_db: Mapping[str, Array]
    own: Mapping[str, VehicleModel]
    left_out: Mapping[str, str]
    notices: tuple[str, ...]

    def as_json(self) -> str:
        """The report as JSON."""
        return dumps(
            {
                "bank": {"identity": self.bank.identity, "file": self.bank, "described": self.bank.described()},
                "branches": self._by_branch(),
                "snr_db": {name: self._named(snr_db) for name, snr_db in self.snr_db.items()},
                "own_models": {
                    name: {"order": own.model.order, "snr_db": self._named(own.snr_db)}
                    for name, own in self.own.items()
                },
                "left_out": self.left_out,
                "notices": self.notices,
            }
        )

    def as_text(self) -> str:
        """The report for people."""
        rows = []
        for branch, row in self._by_branch().items():
            figures = [f"{row[key]:.1f}" if np.isfinite(row[key]) else "-" for key in ("median_db", "worst_db")]
            rows.append([branch, *figures, row["worst_vehicle"]])
        parts = [
            f"filter bank {self.bank.identity} of {len(self.bank.input_names)} inputs: {self.bank.described()}",
            table(("simulation SNR [dB]", "median", "worst", "vehicle"), rows),
            f"vehicles: {len(self.snr_db)}, of which {len(self.own)} need a model of their own",
        ]
        if self.own:
            own = ["a model of its own:"]
            for name, found in self.own.items():
                shared_db, own_db = _worst_db(self.snr_db[name], found.snr_db)
                simulated = (
                    f"{shared_db:.1f} dB with the bank, {own_db:.1f} dB with a model of order {found.model.order}"
                )
                own.append(f"  {name}: worst branch {simulated}")
            parts.append("\n".join(own))
        parts += ["\n".join(f"notice: {notice}" for notice in self.notices), left_out_text(self.left_out)]
        return "\n\n".join(part for part in parts if part)

    def _named(self, values: Array) -> dict[str, float]:
        return dict(zip(self.branches, values.tolist(), strict=True))

    def _by_branch(self) -> dict[str, dict[str, Any]]:
        """Median over vehicles [dB] and worst vehicle; NaN and nobody where no vehicle could be judged."""
        rows = {}
        for k, branch in enumerate(self.branches):
            judged = {name: float(snr_db[k]) for name, snr_db in self.snr_db.items() if np.isfinite(snr_db[k])}
            worst = min(judged, key=lambda name: judged[name], default="")
            median_db = float(np.median(list(judged.values()))) if judged else np.nan
            rows[branch] = {"median_db": median_db, "worst_db": judged.get(worst, np.nan), "worst_vehicle": worst}
        return rows


def identify_fleet(
    path: Path, database: VehicleDatabase, *, bank: FilterBank | None, time_constants_s: Sequence[float], workers: int
) -> IdentificationReport:
    """Choose the filter bank of a fleet, or take one that is given, and identify every vehicle with it.

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
    fleet = without_copies(find_fleet(path))
    equipment = probe_equipment(fleet, database, None)
    period_s = database.layout.period_s
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
    read_outs = fit_read_outs([vehicle.summary for vehicle in vehicles])
    snr_db = {vehicle.vehicle: read_outs.snr_db[j] for j, vehicle in enumerate(vehicles)}
    readers = {
        vehicle.vehicle: partial(_read_better_model, shared_db=snr_db[vehicle.vehicle])
        for vehicle, far in zip(vehicles, far_below_fleet(read_outs), strict=True)
        if far
    }
    own: dict[str, VehicleModel] = {}
    if readers:
        own, _ = read_each(readers, fleet, equipment, database, workers=workers, label="look again at some")
    return IdentificationReport(
        bank=bank,
        branches=equipment.branches,
        snr_db=snr_db,
        own=own,
        left_out=left_out,
        notices=(*fleet.notices, *equipment.notices),
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


def _read_better_model(
    entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase, *, shared_db: Array
) -> VehicleModel:
    drives = read_samples(entries, equipment, database)
    return identify_better(drives, shared_db, period_s=database.layout.period_s, vehicle=entries[0].vehicle)


def identify_better(drives: Sequence[Samples], shared_db: Array, *, period_s: float, vehicle: str) -> VehicleModel:
    """Identify a vehicle that the shared bank may not fit from its own drives.

    Parameters
    ----------
    drives : sequence of Samples
        Its aligned drives.
    shared_db : ndarray of shape (K,)
        Simulation signal-to-noise ratio with the shared bank. [dB]
    period_s : float
        Distance of the samples. [s]
    vehicle : str
        Its name.

    Returns
    -------
    VehicleModel
        With a model of its own that simulates its worst branch clearly better than the bank does.

    Raises
    ------
    DriveError
        If there is none: its sensors are noisy, or its inputs do not show enough.
    """
    found = identify_vehicle(drives, period_s=period_s, vehicle=vehicle, names=())
    shared, own = _worst_db(shared_db, found.snr_db)
    if not own - shared >= OWN_GAIN_DB:  # nor where neither can simulate anything
        raise DriveError(f"a model of its own simulates it to {own:.1f} dB, the shared one to {shared:.1f} dB")
    return found


def _worst_db(shared_db: Array, own_db: Array) -> tuple[float, float]:
    """Worst of the branches that both could simulate, at most :data:`EXACT_DB`; NaN where there is none."""
    known = ~(np.isnan(shared_db) | np.isnan(own_db))
    if not known.any():
        return np.nan, np.nan
    return min(float(shared_db[known].min()), EXACT_DB), min(float(own_db[known].min()), EXACT_DB)
