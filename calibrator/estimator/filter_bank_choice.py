"""Read-outs of vehicles that share a filter bank, and the choice of the bank by how well they simulate held-out data.

A read-out is C, D and the offset of (2) in [1]_ by least squares on summaries. The columns of the bank depend on the
inputs alone, so noise of the sensors leaves no bias. Fit and simulation of held-out blocks need second moments only.

Candidate banks are the plain inputs; low-passes whose time constants are spaced evenly in their logarithm; and poles of
systems of several orders, identified from some vehicles together, as they are, and with several poles about each, which
follow vehicles whose own is a little off. Each candidate is judged on held-out blocks that are the same for all; of
those about as good as the best, the smallest is taken.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.estimator.state_space import StateSpaceModel, pooled_poles, snr_from_power
from calibrator.summaries.filter_bank import FilterBank, Poles, low_passes
from calibrator.summaries.moments import DriveSummary, common_bank
from calibrator.summaries.summariser import Summariser
from calibrator.terminal.progress import shown

__all__ = ["ReadOuts", "choose_filter_bank", "far_below_fleet", "fit_read_outs", "state_space_model"]

RIDGE = 1e-12
"""Added to standardised second moments: above rounding, far below any signal. [1]"""
FOLDS = 5
"""Every fifth block is held out, as the published method holds out 20 %."""
FIRST_HELD_OUT = 2
"""So that three blocks already have one to judge from, amid the others."""
CONSTANT = 1e-12
"""Variance over mean square below which a column counts as constant: rounding. [1]"""
GOOD_DB = 40.0
"""Simulation this good bends no slope noticeably. [dB]"""
BELOW_FLEET_DB = 6.0
"""How far below the fleet's median a branch is simulated that may not share its dynamics. [dB]"""

ORDERS = (1, 2, 3, 4, 5, 6, 8)
"""Of the pooled systems: a power train as seen at 10 Hz has few modes. [1]"""
LOW_PASSES = (1, 2, 4, 6)
"""Numbers of evenly spaced low-passes. [1]"""
SHORTEST_S, LONGEST_S = 0.05, 20.0
"""Time constants of poles: faster ones are as good as none at 10 Hz, slower ones settle longer than drives last. [s]"""
SPLITS = (
    ((1.0,), (1.0,)),
    ((1.0 / 1.3, 1.3), (1.0 / 1.2, 1.0, 1.2)),
    ((1.0 / 1.15, 1.0, 1.15), (1.0 / 1.15, 1.0, 1.15)),
)
"""Factors on the rates of a real pole and of a resonance that replace it: as it is, and so that they follow vehicles
whose poles are within 15 % of the fleet's. [1]"""
TOLERANCE_DB = 0.003
"""A bank is large enough if its simulation error, noise included, is this close to the best: at a signal-to-noise
ratio of 20 dB a misfit of -52 dB. [dB]"""
TINY = 1e-12
"""Power of an error, over that of the signal, that counts as none. [1]"""


@dataclass(frozen=True, kw_only=True)
class ReadOuts:
    """Read-outs of N vehicles over P columns of a bank.

    Attributes
    ----------
    bank : str
        Identity of the bank.
    coefficients : ndarray of shape (N, P, K)
        Currents per unit of each column. [A]
    offset_a : ndarray of shape (N, K)
        Constant part of the currents. [A]
    mean_inputs : ndarray of shape (N, P)
        Mean of the columns.
    snr_db : ndarray of shape (N, K)
        Simulation signal-to-noise ratio on held-out blocks, of read-outs of the others; NaN for a constant current, or
        where no block could be held out. [dB]
    """

    bank: str
    coefficients: Array
    offset_a: Array
    mean_inputs: Array
    snr_db: Array


def fit_read_outs(summaries: Sequence[DriveSummary]) -> ReadOuts:
    """Fit the read-outs of vehicles, and judge them from blocks that were held out.

    Parameters
    ----------
    summaries : sequence of N DriveSummary
        One per vehicle, of the same bank and branches.

    Returns
    -------
    ReadOuts
        Of the N vehicles, fitted on all blocks.

    Raises
    ------
    DriveError
        If the summaries were made with different banks.
    """
    bank, K = common_bank(summaries), summaries[0].branches
    total = np.stack([summary.total for summary in summaries])
    held_out = np.stack([summary.moments[FIRST_HELD_OUT::FOLDS].sum(axis=0) for summary in summaries])
    coefficients, offset_a = _solve(total, K)
    mean, covariance = _centred(held_out)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    signal_a2 = np.where(variance > CONSTANT * mean**2, variance, 0.0)[:, -K - 1 : -1]
    # Power of the error: mean square of y - coefficients^T u - offset, of the read-out of all other blocks.
    others, others_a = _solve(total - held_out, K)
    weights = np.concatenate([-others, np.broadcast_to(np.eye(K), (len(others), K, K))], axis=1)
    centre = np.einsum("nq,nqk->nk", mean[:, :-1], weights) - others_a
    error_a2 = np.einsum("nqk,nqr,nrk->nk", weights, covariance[:, :-1, :-1], weights) + centre**2
    return ReadOuts(
        bank=bank,
        coefficients=coefficients,
        offset_a=offset_a,
        mean_inputs=_centred(total)[0][:, : -K - 1],
        snr_db=snr_from_power(signal_a2, error_a2),
    )


def _centred(moments: Array) -> tuple[Array, Array]:
    """Means (N, Q) and covariance (N, Q, Q) of all columns, the constant included; zero where there is no sample."""
    samples = np.maximum(moments[:, -1, -1], 1.0)[:, None]
    mean = moments[:, -1] / samples
    return mean, moments / samples[:, :, None] - mean[:, :, None] * mean[:, None, :]


def _solve(moments: Array, branches: int) -> tuple[Array, Array]:
    """Coefficients (N, P, K) and offsets (N, K) of the currents over the columns; moments of shape (N, Q, Q)."""
    mean, covariance = _centred(moments)
    P = moments.shape[1] - branches - 1
    scale = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    safe = np.where(scale > np.sqrt(CONSTANT) * np.abs(mean), scale, np.inf)  # constant columns drop out
    standardised = covariance / (safe[:, :, None] * safe[:, None, :])
    found = np.linalg.solve(standardised[:, :P, :P] + RIDGE * np.eye(P), standardised[:, :P, P:-1])
    coefficients = found * np.where(np.isinf(safe), 0.0, safe)[:, None, P:-1] / safe[:, :P, None]
    return coefficients, mean[:, P:-1] - np.einsum("np,npk->nk", mean[:, :P], coefficients)


def far_below_fleet(read_outs: ReadOuts) -> Mask:
    """Find vehicles that the shared bank may not fit; a noisy sensor looks the same until an own model is tried.

    Parameters
    ----------
    read_outs : ReadOuts
        Of the fleet.

    Returns
    -------
    ndarray of bool of shape (N,)
        True where the simulation of a branch is far below the fleet's median, and not good anyway.
    """
    usual_db = np.median(np.where(np.isnan(read_outs.snr_db), np.inf, read_outs.snr_db), axis=0)
    return np.asarray(np.any(read_outs.snr_db < np.minimum(usual_db - BELOW_FLEET_DB, GOOD_DB), axis=1))


def state_space_model(bank: FilterBank, read_outs: ReadOuts, vehicle: int) -> StateSpaceModel:
    """Make a model (2) of a bank and a read-out.

    Parameters
    ----------
    bank : FilterBank
        The bank that the read-outs are of.
    read_outs : ReadOuts
        Of the fleet.
    vehicle : int
        Index of the vehicle.

    Returns
    -------
    StateSpaceModel
        With the state of the vehicle's mean inputs as initial state, and its simulation SNR on held-out blocks.

    Raises
    ------
    DriveError
        If the read-outs are of another bank.
    """
    if bank.identity != read_outs.bank:
        raise DriveError(
            f"read-outs of the filter bank {read_outs.bank} do not fit the bank {bank.identity}; summarise the drives "
            "with this bank"
        )
    A, B = bank.system()
    M, coefficients = len(bank.input_names), read_outs.coefficients[vehicle]
    return StateSpaceModel(
        A=A,
        B=B,
        C=coefficients[M:].T,
        D=coefficients[:M].T,
        x0=np.linalg.solve(np.eye(len(A)) - A, B @ read_outs.mean_inputs[vehicle, :M]),
        offset_a=read_outs.offset_a[vehicle],
        snr_db=read_outs.snr_db[vehicle],
    )


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
        Of the inputs of the drives.

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
    best_db = min(errors_db)
    good = [bank for bank, error in zip(candidates, errors_db, strict=True) if error <= best_db + TOLERANCE_DB]
    return min(good, key=lambda bank: bank.width)


def _candidates(vehicles: Sequence[Sequence[Samples]], period_s: float) -> Iterator[Poles]:
    """Sets of poles, from the smallest on."""
    yield ()
    for count in LOW_PASSES:
        yield low_passes(np.geomspace(LONGEST_S, 2.0 * period_s, count + 2)[1:-1], period_s=period_s)
    drives = [
        (drive.inputs, drive.currents_a, drive.valid) for drives in vehicles for drive in drives if drive.valid.any()
    ]
    try:
        pooled = pooled_poles(drives, ORDERS, branches=drives[0][1].shape[1]) if drives else []
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
    """Mean over vehicles and branches of the power of the simulation error on held-out blocks, over the signal's."""
    snr_db = []
    for drives in vehicles:
        summariser = Summariser(bank, branches=drives[0].currents_a.shape[1], settling=settling)
        for drive in drives:
            summariser.add(drive.inputs, drive.currents_a, drive.valid)
            summariser.end_drive()
        try:
            snr_db.append(fit_read_outs([summariser.summary()]).snr_db[0])
        except DriveError:  # no block: this vehicle cannot judge
            continue
    values: Array = np.concatenate([np.zeros(0), *snr_db])
    ratio = 10.0 ** (-values[np.isfinite(values)] / 10.0)
    return float(np.mean(10.0 * np.log10(ratio + TINY))) if ratio.size else np.inf
