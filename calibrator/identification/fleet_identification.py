"""Identify a fleet: one filter bank for all vehicles, a read-out for each, and a model of its own where that fails."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from calibrator.drive import Array, DriveFile
from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.identification.pooled_bank import pooled_bank
from calibrator.identification.read_out import far_below_fleet, fit_read_outs
from calibrator.identification.state_space import StateSpaceModel
from calibrator.identification.vehicle_model import identify_vehicle
from calibrator.sources.copies import without_copies
from calibrator.sources.fleet_source import Equipment, FleetSource, find_fleet, probe_equipment
from calibrator.sources.vehicles import read_each, read_vehicles
from calibrator.summaries.filter_bank import FilterBank, low_pass_bank
from calibrator.summaries.vehicle_summary import read_samples, read_vehicle_summary
from calibrator.terminal.text import dumps, left_out_text, table
from ecu_node.database import VehicleDatabase

__all__ = ["IdentificationReport", "OwnModel", "identify_fleet", "own_model", "require_fitting_bank"]

POOLED_VEHICLES = 8
"""Vehicles that a bank is chosen from: more of them hardly move its poles. [1]"""
OWN_GAIN_DB = 3.0
"""By how much a model of its own must simulate its worst branch better than the shared bank does its. [dB]"""
EXACT_DB = 60.0
"""Better simulation than this counts as no better: what is left is the rounding of signals. [dB]"""


@dataclass(frozen=True, kw_only=True)
class OwnModel:
    """A vehicle that does not share the fleet's dynamics.

    Attributes
    ----------
    model : StateSpaceModel
        Identified from its own drives.
    snr_db : ndarray of shape (K,)
        Its simulation signal-to-noise ratio on held-out data. [dB]
    """

    model: StateSpaceModel
    snr_db: Array


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
    own : mapping of str to OwnModel
        Vehicles that need a model of their own.
    left_out : mapping of str to str
        Why other vehicles could not be used.
    notices : tuple of str
        What else the user should know.
    """

    bank: FilterBank
    branches: tuple[str, ...]
    snr_db: Mapping[str, Array]
    own: Mapping[str, OwnModel]
    left_out: Mapping[str, str]
    notices: tuple[str, ...]

    def as_json(self) -> str:
        """The report as JSON."""
        figures = {
            "bank": {"identity": self.bank.identity, "file": self.bank, "described": self.bank.described()},
            "branches": {name: vars(row) for name, row in self._rows().items()},
            "snr_db": {name: dict(zip(self.branches, snr.tolist(), strict=True)) for name, snr in self.snr_db.items()},
            "own_models": {
                name: {
                    "order": own.model.order,
                    "snr_db": dict(zip(self.branches, own.snr_db.tolist(), strict=True)),
                }
                for name, own in self.own.items()
            },
            "left_out": self.left_out,
            "notices": self.notices,
        }
        return dumps(figures)

    def as_text(self) -> str:
        """The report for people."""
        rows = [
            (name, _figure(row.median_db), _figure(row.worst_db), row.worst_vehicle)
            for name, row in self._rows().items()
        ]
        own = [f"  {name}: {_compared(self.snr_db[name], found)}" for name, found in self.own.items()]
        parts = [
            f"filter bank {self.bank.identity} of {len(self.bank.input_names)} inputs: {self.bank.described()}",
            table(("simulation SNR [dB]", "median", "worst", "vehicle"), rows),
            f"vehicles: {len(self.snr_db)}, of which {len(self.own)} need a model of their own",
            "\n".join(["a model of its own:", *own]) if own else "",
            "\n".join(f"notice: {notice}" for notice in self.notices),
            left_out_text(self.left_out),
        ]
        return "\n\n".join(part for part in parts if part)

    def _rows(self) -> dict[str, "_BranchRow"]:
        return {name: _branch_row(self.snr_db, k) for k, name in enumerate(self.branches)}


@dataclass(frozen=True, kw_only=True)
class _BranchRow:
    """Of one branch: median over vehicles and worst vehicle; NaN and nobody where no vehicle could be judged. [dB]"""

    median_db: float
    worst_db: float
    worst_vehicle: str


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
    chosen = bank or _bank(fleet, equipment, database, time_constants_s, workers=workers)
    require_fitting_bank(chosen, equipment, database)
    vehicles, left_out = read_vehicles(
        partial(read_vehicle_summary, bank=chosen), fleet, equipment, database, workers=workers
    )
    read_outs = fit_read_outs([vehicle.summary for vehicle in vehicles])
    snr_db = {vehicle.vehicle: read_outs.snr_db[j] for j, vehicle in enumerate(vehicles)}
    different = [vehicle.vehicle for vehicle, far in zip(vehicles, far_below_fleet(read_outs), strict=True) if far]
    readers = {name: partial(_read_own_model, shared_db=snr_db[name]) for name in different}
    own, _ = (
        read_each(readers, fleet, equipment, database, workers=workers, label="look again at some")
        if different
        else ({}, {})
    )
    return IdentificationReport(
        bank=chosen,
        branches=equipment.branches,
        snr_db=snr_db,
        own={name: found[0] for name, found in own.items() if found},
        left_out=left_out,
        notices=(*fleet.notices, *equipment.notices),
    )


def require_fitting_bank(bank: FilterBank, equipment: Equipment, database: VehicleDatabase) -> None:
    """Refuse a bank of other inputs than the fleet's, or of another period than the layout's."""
    wanted = (equipment.fleet_inputs, database.layout.period_s)
    if (bank.input_names, bank.period_s) != wanted:
        raise DriveError(
            f"the filter bank is of the inputs {', '.join(bank.input_names)} every {bank.period_s:g} s, the fleet has "
            f"{', '.join(wanted[0])} every {wanted[1]:g} s; choose one with 'calibrator identify' for this fleet"
        )


def own_model(drives: Sequence[Samples], shared_db: Array, *, period_s: float, vehicle: str) -> OwnModel | None:
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
    OwnModel or None
        None if a model of its own simulates hardly better: its sensors are noisy, or its inputs do not tell enough.

    Raises
    ------
    DriveError
        If no model can be identified.
    """
    found = identify_vehicle(drives, period_s=period_s, vehicle=vehicle, names=())
    shared, own = _worst_db(shared_db, found.snr_db)
    if not own - shared >= OWN_GAIN_DB:  # nor where neither tells anything
        return None
    return OwnModel(model=found.model, snr_db=found.snr_db)


def _read_own_model(
    entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase, *, shared_db: Array
) -> tuple[OwnModel, ...]:
    """The vehicle's own model, or nothing."""
    drives = read_samples(entries, equipment, database)
    found = own_model(drives, shared_db, period_s=database.layout.period_s, vehicle=entries[0].vehicle)
    return () if found is None else (found,)


def _bank(
    fleet: FleetSource,
    equipment: Equipment,
    database: VehicleDatabase,
    time_constants_s: Sequence[float],
    *,
    workers: int,
) -> FilterBank:
    """Bank of low-passes that are given, or chosen from vehicles that are spread evenly over the fleet."""
    period_s = database.layout.period_s
    if time_constants_s:
        return low_pass_bank(equipment.fleet_inputs, time_constants_s, period_s=period_s)
    names = list(fleet.vehicles)
    some = [names[j] for j in np.unique(np.linspace(0, len(names) - 1, POOLED_VEHICLES).round().astype(int))]
    read, errors = read_each(
        dict.fromkeys(some, read_samples), fleet, equipment, database, workers=workers, label="read some drives"
    )
    if not read:
        raise DriveError(f"none of {len(some)} vehicles can be read to choose a filter bank; {errors[some[0]]}")
    return pooled_bank(list(read.values()), period_s=period_s)


def _branch_row(snr_db: Mapping[str, Array], branch: int) -> _BranchRow:
    values = {name: float(snr[branch]) for name, snr in snr_db.items() if np.isfinite(snr[branch])}
    if not values:
        return _BranchRow(median_db=np.nan, worst_db=np.nan, worst_vehicle="")
    worst = min(values, key=lambda name: values[name])
    return _BranchRow(median_db=float(np.median(list(values.values()))), worst_db=values[worst], worst_vehicle=worst)


def _figure(value_db: float) -> str:
    return f"{value_db:.1f}" if np.isfinite(value_db) else "-"


def _compared(shared_db: Array, own: OwnModel) -> str:
    shared, alone = _worst_db(shared_db, own.snr_db)
    return f"worst branch {shared:.1f} dB with the bank, {alone:.1f} dB with a model of order {own.model.order}"


def _worst_db(shared_db: Array, own_db: Array) -> tuple[float, float]:
    """Worst of the branches that both tell something of, at most :data:`EXACT_DB`; NaN where there is none."""
    told = ~(np.isnan(shared_db) | np.isnan(own_db))
    if not told.any():
        return np.nan, np.nan
    return min(float(shared_db[told].min()), EXACT_DB), min(float(own_db[told].min()), EXACT_DB)
