"""Read-outs of vehicles that share a filter bank: C, D and the offset of (2) in [1]_ by least squares on summaries.

The columns of the bank depend on the inputs alone, so noise of the sensors leaves no bias. Everything is told by second
moments: the fit, what it leaves over, and how well it simulates blocks that it was not fitted on.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.errors import DriveError
from calibrator.identification.state_space import StateSpaceModel, snr_from_power
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.moments import DriveSummary, common_bank

__all__ = ["ReadOuts", "far_below_fleet", "fit_read_outs", "state_space_model"]

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
    residual_a2 : ndarray of shape (N, K, K)
        Covariance of what the read-outs leave over on all blocks. [A^2]
    mean_inputs : ndarray of shape (N, P)
        Mean of the columns.
    snr_db : ndarray of shape (N, K)
        Simulation signal-to-noise ratio on held-out blocks, of read-outs of the others; NaN for a constant current, or
        where no block could be held out. [dB]
    """

    bank: str
    coefficients: Array
    offset_a: Array
    residual_a2: Array
    mean_inputs: Array
    snr_db: Array


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """Coefficients (N, P, K), offsets (N, K) and means of the columns (N, P)."""

    coefficients: Array
    offset_a: Array
    mean_inputs: Array


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
    held_out = np.stack([summary.moments[_held_out(summary)].sum(axis=0) for summary in summaries])
    fit, judged = _solve(total, K), _solve(total - held_out, K)
    signal = _variance(held_out)[:, -K - 1 : -1]
    error = np.diagonal(_residual(held_out, judged), axis1=1, axis2=2)
    return ReadOuts(
        bank=bank,
        coefficients=fit.coefficients,
        offset_a=fit.offset_a,
        residual_a2=_residual(total, fit),
        mean_inputs=fit.mean_inputs,
        snr_db=snr_from_power(signal, error),
    )


def far_below_fleet(read_outs: ReadOuts) -> Mask:
    """Tell which vehicles the shared bank may not fit; a noisy sensor looks the same until a model of its own is tried.

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
    M = len(bank.input_names)
    coefficients = read_outs.coefficients[vehicle]
    return StateSpaceModel(
        A=A,
        B=B,
        C=coefficients[M:].T,
        D=coefficients[:M].T,
        x0=np.linalg.solve(np.eye(len(A)) - A, B @ read_outs.mean_inputs[vehicle, :M]),
        offset_a=read_outs.offset_a[vehicle],
        snr_db=read_outs.snr_db[vehicle],
    )


def _held_out(summary: DriveSummary) -> Mask:
    return np.asarray(np.arange(len(summary.moments)) % FOLDS == FIRST_HELD_OUT)


def _solve(moments: Array, branches: int) -> _Fit:
    """Least squares of the currents on the columns and a constant; moments of shape (N, Q, Q)."""
    mean, covariance = _centred(moments)
    P = moments.shape[1] - branches - 1
    scale = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    safe = np.where(scale > np.sqrt(CONSTANT) * np.abs(mean), scale, np.inf)
    standardised = covariance / (safe[:, :, None] * safe[:, None, :])
    gram = standardised[:, :P, :P] + RIDGE * np.eye(P)
    found = np.linalg.solve(gram, standardised[:, :P, P:-1])
    coefficients = found * np.where(np.isinf(safe), 0.0, safe)[:, None, P:-1] / safe[:, :P, None]
    offset_a = mean[:, P:-1] - np.einsum("np,npk->nk", mean[:, :P], coefficients)
    return _Fit(coefficients=coefficients, offset_a=offset_a, mean_inputs=mean[:, :P])


def _residual(moments: Array, fit: _Fit) -> Array:
    """Mean of the products of what a fit leaves over, shape (N, K, K). [A^2]"""
    K = fit.offset_a.shape[1]
    left = np.concatenate([-fit.coefficients, np.broadcast_to(np.eye(K), (len(moments), K, K))], axis=1)
    mean, covariance = _centred(moments)
    residual = np.swapaxes(left, 1, 2) @ covariance[:, :-1, :-1] @ left
    centre = np.einsum("nq,nqk->nk", mean[:, :-1], left) - fit.offset_a
    return np.asarray(residual + centre[:, :, None] * centre[:, None, :])


def _centred(moments: Array) -> tuple[Array, Array]:
    """Means (N, Q) and covariance (N, Q, Q) of all columns, the constant included; zero where there is no sample."""
    samples = np.maximum(moments[:, -1, -1], 1.0)[:, None]
    mean = moments[:, -1] / samples
    return mean, moments / samples[:, :, None] - mean[:, :, None] * mean[:, None, :]


def _variance(moments: Array) -> Array:
    """Variance of each column, shape (N, Q); zero where it is rounding."""
    mean, covariance = _centred(moments)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return np.where(variance > CONSTANT * mean**2, variance, 0.0)
