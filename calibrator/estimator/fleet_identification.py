"""``calibrator identify``: the filter bank that a fleet's vehicles share, and how well it simulates each of them.

A read-out (C, D and the offset of equation (2) of [1]_) is fitted to summaries by least squares. The columns of the
bank depend on the inputs alone, so noise of the sensors leaves no bias. Fit and simulation of held-out blocks need
second moments only.

Candidate banks are the plain inputs; low-passes whose time constants are spaced evenly in their logarithm; and poles of
systems of several orders, identified from some vehicles together: as they are, or each replaced by several poles about
it, which suit vehicles whose own pole is a little off. Of the banks that simulate held-out blocks nearly as well as the
best one, the smallest is taken.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from calibrator.drive import Array, Equipment, FleetSource, Samples
from calibrator.errors import DriveError
from calibrator.estimator.evidence import covariances
from calibrator.processes.run_many import Workers
from calibrator.published.state_space import pooled_poles, snr_from_power, solve_scaled
from calibrator.sources.fleet_source import find_fleet, probe_equipment, read_vehicles
from calibrator.summaries.filter_bank import FilterBank, Poles, low_passes
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summarise_fleet import read_samples, read_vehicle_summary
from calibrator.summaries.summariser import summarise_samples
from calibrator.terminal.progress import shown
from calibrator.terminal.text import dumps, left_out_text, table
from ecu_node.database import VehicleDatabase

__all__ = ["IdentificationReport", "choose_filter_bank", "held_out_snr_db", "identify_fleet", "read_outs"]

POOLED_VEHICLES = 8
"""Number of vehicles that a bank is chosen from: more of them hardly move its poles. [1]"""
FOLDS = 5
"""Every fifth block is held out, as the published method holds out 20 %."""
FIRST_HELD_OUT = 2
"""Index of the first block that is held out: a vehicle with three blocks has one to be judged by."""
ORDERS = (1, 2, 3, 4, 5, 6, 8)
"""Orders of the pooled systems: a power train as seen at 10 Hz has few modes. [1]"""
LOW_PASSES = (1, 2, 4, 6)
"""Numbers of evenly spaced low-passes. [1]"""
SHORTEST_S, LONGEST_S = 0.05, 20.0
"""Time constants of poles: faster ones are as good as none at 10 Hz, slower ones settle longer than drives last. [s]"""
SPLITS = (
    ((1.0,), (1.0,)),
    ((1.0 / 1.3, 1.3), (1.0 / 1.2, 1.0, 1.2)),
    ((1.0 / 1.15, 1.0, 1.15), (1.0 / 1.15, 1.0, 1.15)),
)
"""Ways to replace a pole by several: factors on the rate of a real pole, and on that of a resonance. The first way
leaves poles as they are, the others suit vehicles whose poles are within 15 % of the fleet's. [1]"""
TOLERANCE_DB = 0.003
"""A bank is large enough if its simulation error, noise included, is this close to the best: at a signal-to-noise
ratio of 20 dB a misfit of -52 dB. [dB]"""
TINY = 1e-12
"""Power of an error, over that of the signal, below which there is no error. [1]"""


def held_out_snr_db(summaries: Sequence[DriveSummary]) -> Array:
    """Return how well each vehicle's own read-out simulates blocks that it was not fitted to.

    Parameters
    ----------
    summaries : sequence of N DriveSummary
        One per vehicle, of the same bank and branches.

    Returns
    -------
    ndarray of shape (N, K)
        Signal-to-noise ratio of the simulation; NaN for a constant current, or where no block could be held out. [dB]
    """
    K = summaries[0].branches
    held_out = np.stack([summary.moments[FIRST_HELD_OUT::FOLDS].sum(axis=0) for summary in summaries])
    coefficients, offset_a = read_outs(np.stack([summary.total for summary in summaries]) - held_out, K)
    own = np.broadcast_to(np.eye(K), (len(held_out), K, K))
    weights = np.concatenate([-coefficients, own, -offset_a[:, None]], axis=1)  # measured minus simulated current
    error_a2 = np.einsum("nqk,nqr,nrk->nk", weights, held_out, weights) / np.maximum(held_out[:, -1:, -1], 1.0)
    signal_a2 = np.einsum("nkk->nk", covariances(_mean(held_out)))[:, -K - 1 : -1]
    return snr_from_power(signal_a2, np.maximum(error_a2, 0.0))


def read_outs(moments: Array, branches: int) -> tuple[Array, Array]:
    """Fit K currents over P columns, from moments of (columns, currents, 1), shape (N, P+K+1, P+K+1).

    Returns coefficients (N, P, K) [A per unit of the column], and offsets (N, K) [A].
    """
    mean = _mean(moments)
    covariance = covariances(mean)
    P = moments.shape[1] - branches - 1
    coefficients = solve_scaled(covariance[:, :P, :P], covariance[:, :P, P:-1])
    return coefficients, mean[:, -1, P:-1] - np.einsum("np,npk->nk", mean[:, -1, :P], coefficients)


def _mean(moments: Array) -> Array:
    """Return the mean products of all columns (N, Q, Q); zero where there is no sample."""
    return np.asarray(moments / np.maximum(moments[:, -1:, -1:], 1.0))


def choose_filter_bank(vehicles: Sequence[Sequence[Samples]], *, period_s: float) -> FilterBank:
    """Choose the bank for a fleet from some of its vehicles.

    Parameters
    ----------
    vehicles : sequence of sequence of Samples
        Aligned drives of each vehicle, with the same inputs and branches.
    period_s : float
        Distance of the samples. [s]

    Returns
    -------
    FilterBank
        Filters of the inputs of the drives.

    Raises
    ------
    DriveError
        If no vehicle has three blocks of valid samples, so that no block could be held out.
    """
    names = vehicles[0][0].input_names
    candidates = [
        FilterBank(input_names=names, period_s=period_s, poles=poles)
        for poles in dict.fromkeys(_candidates(vehicles, period_s))
    ]
    settling = max(bank.settling for bank in candidates)
    errors_db = [
        _error_db(bank, vehicles, settling) for bank in shown(candidates, "try filter banks", len(candidates), "banks")
    ]
    if not np.isfinite(errors_db).any():
        raise DriveError(
            f"none of {len(vehicles)} vehicles has three blocks of varied, valid samples to choose a filter bank by, "
            f"{settling * period_s:.0f} s after a start or a gap; give a bank, or record longer drives"
        )
    good = zip(candidates, errors_db, strict=True)
    return min((bank for bank, error in good if error <= min(errors_db) + TOLERANCE_DB), key=lambda bank: bank.width)


def _candidates(vehicles: Sequence[Sequence[Samples]], period_s: float) -> Iterator[Poles]:
    """Yield candidate sets of poles, beginning with the empty one."""
    yield ()
    for count in LOW_PASSES:
        yield low_passes(np.geomspace(LONGEST_S, 2.0 * period_s, count + 2)[1:-1], period_s=period_s)
    drives = [
        (drive.inputs, drive.currents_a, drive.valid) for drives in vehicles for drive in drives if drive.valid.any()
    ]
    try:
        pooled = pooled_poles(drives, ORDERS) if drives else []
    except (DriveError, np.linalg.LinAlgError):  # too little data, or too little variation
        return
    fastest, slowest = np.exp(-period_s / SHORTEST_S), np.exp(-period_s / LONGEST_S)
    for poles in pooled:
        radius = np.abs(poles)
        kept = (radius >= fastest) & ((poles.imag > 0.0) | (poles.real > 0.0))  # not too fast, nor alternating
        bounded = (poles * np.minimum(1.0, slowest / np.maximum(radius, slowest)))[kept]
        for of_real, of_resonance in SPLITS:
            split = [pole**f for pole in bounded for f in (of_resonance if pole.imag > 0.0 else of_real)]
            # A split may turn a pole beyond the highest frequency; its mirror image is the same filter.
            yield tuple(sorted(((float(pole.real), float(abs(pole.imag))) for pole in split), reverse=True))


def _error_db(bank: FilterBank, vehicles: Sequence[Sequence[Samples]], settling: int) -> float:
    """Return error over signal on held-out blocks, as mean dB over vehicles and branches; inf if none can judge."""
    summaries = []
    for drives in vehicles:
        with suppress(DriveError):  # no block: this vehicle cannot judge
            summaries.append(summarise_samples(drives, period_s=bank.period_s, bank=bank, settling=settling))
    snr_db = held_out_snr_db(summaries) if summaries else np.zeros(0)
    ratio = 10.0 ** (-snr_db[np.isfinite(snr_db)] / 10.0)
    return float(np.mean(10.0 * np.log10(ratio + TINY))) if ratio.size else np.inf


@dataclass(frozen=True, kw_only=True)
class IdentificationReport:
    """How well one filter bank simulates a fleet.

    Attributes
    ----------
    bank : FilterBank
        The bank.
    snr_db : DataFrame
        Simulation signal-to-noise ratio on held-out blocks, vehicles by branches; NaN where it is not known. [dB]
    left_out : mapping of str to str
        Vehicles that could not be used, and why.
    notices : tuple of str
        Branches and inputs of the layout that are not used, and why.
    """

    bank: FilterBank
    snr_db: pd.DataFrame
    left_out: Mapping[str, str]
    notices: tuple[str, ...]

    def as_json(self) -> str:
        """Return the report as JSON."""
        bank = {"identity": self.bank.identity, "file": self.bank, "described": self.bank.described()}
        branches, snr_db = self._by_branch().to_dict("index"), self.snr_db.to_dict("index")
        return dumps({**vars(self), "bank": bank, "branches": branches, "snr_db": snr_db})

    def as_text(self) -> str:
        """Return the report as readable text."""
        rows = [
            [branch, *(f"{value:.1f}" if np.isfinite(value) else "-" for value in (median_db, worst_db)), vehicle]
            for branch, median_db, worst_db, vehicle in self._by_branch().itertuples()
        ]
        parts = [
            f"filter bank {self.bank.identity} of {len(self.bank.input_names)} inputs: {self.bank.described()}",
            table(("simulation SNR [dB]", "median", "worst", "vehicle"), rows),
            f"vehicles: {len(self.snr_db)}",
            "\n".join(f"notice: {notice}" for notice in self.notices),
            left_out_text(self.left_out),
        ]
        return "\n\n".join(part for part in parts if part)

    def _by_branch(self) -> pd.DataFrame:
        """Return median over vehicles [dB] and worst vehicle by branch; NaN and "" where no vehicle could be judged."""
        judged = self.snr_db.dropna(axis=1, how="all")
        found = {"median_db": judged.median(), "worst_db": judged.min(), "worst_vehicle": judged.idxmin()}
        return pd.DataFrame(found).reindex(self.snr_db.columns).fillna({"worst_vehicle": ""})


def identify_fleet(path: str | Path, database: VehicleDatabase, *, workers: Workers) -> IdentificationReport:
    """Choose the filter bank of a fleet, and judge it by every vehicle.

    Parameters
    ----------
    path : str or Path
        The fleet, see :func:`calibrator.sources.fleet_source.find_fleet`.
    database : VehicleDatabase
        DBC and layout.
    workers : Workers
        Processes or cluster that read the drives.

    Returns
    -------
    IdentificationReport
        The bank, and how well it simulates each vehicle.

    Raises
    ------
    UserError
        If no vehicle can be used.
    """
    fleet = find_fleet(path)
    equipment = probe_equipment(fleet, database, None)
    bank = _chosen_bank(fleet, equipment, database, workers=workers)
    read_one = partial(read_vehicle_summary, bank=bank)
    vehicles, left_out = read_vehicles(read_one, fleet, equipment, database, workers=workers)
    snr_db = pd.DataFrame(
        held_out_snr_db([vehicle.summary for vehicle in vehicles]),
        index=[vehicle.vehicle for vehicle in vehicles],
        columns=list(equipment.branches),
    )
    return IdentificationReport(bank=bank, snr_db=snr_db, left_out=left_out, notices=equipment.notices)


def _chosen_bank(
    fleet: FleetSource, equipment: Equipment, database: VehicleDatabase, *, workers: Workers
) -> FilterBank:
    """Choose a bank from vehicles that are spread evenly over the fleet."""
    names = list(fleet.vehicles)
    some = [names[j] for j in np.unique(np.linspace(0, len(names) - 1, POOLED_VEHICLES).round().astype(int))]
    read, _ = read_vehicles(
        read_samples, fleet, equipment, database, workers=workers, names=some, label="read some drives"
    )
    return choose_filter_bank(read, period_s=database.layout.period_s)
