"""What is known of the model spread before any explanation: which rows have one, how much is guessed, and at least."""

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows

__all__ = ["GUESSED_OUTLIER_SHARE", "free_centres", "guessed_spread", "informed_rows", "least_spread", "told_rows"]

SPREAD_OVER_SAMPLING = 2.0
"""Guess of the model spread over the usual sampling deviation: a model errs alike over a whole drive. [1]"""
LEAST_SPREAD = np.array([1e-5, 1e-6])
"""Least model spread of relative and constant rows: far below any sensor's resolution. [1]"""
GUESSED_OUTLIER_SHARE = 0.05
"""Share of vehicles that differ more before anything is known. [1]"""


def free_centres(branches: int) -> Array:
    """Rows whose centre the fleet tells, shape (5K,): slopes, intercepts and junction constant."""
    K = branches
    free = np.zeros(5 * K, bool)
    free[:K], free[3 * K - 1 : 4 * K] = True, True
    return free


def informed_rows(branches: int) -> list[int]:
    """Slopes, gain ratios, intercepts and junction constant; bench readings have no centre of the fleet."""
    K = branches
    return [*range(2 * K - 1), *range(3 * K - 1, 4 * K)]


def told_rows(rows: FleetRows) -> Mask:
    """Rows that say something, shape (N, 5K)."""
    return np.asarray(np.diagonal(rows.covariance, axis1=1, axis2=2) < UNKNOWN_VARIANCE / 2.0)


def guessed_spread(rows: FleetRows) -> Array:
    """Covariance of the model spread before anything is known: a multiple of the usual sampling covariance."""
    informed = np.zeros(5 * rows.branches, bool)
    informed[informed_rows(rows.branches)] = True
    told = told_rows(rows)
    variance = np.ones(len(informed))
    sharp = rows.covariance.copy()
    intercepts = slice(3 * rows.branches - 1, 4 * rows.branches - 1)
    sharp[:, intercepts, intercepts] = rows.intercept_covariance()
    for row in np.flatnonzero(informed & told.any(axis=0)):
        variance[row] = np.median(sharp[told[:, row], row, row])
    return np.diag(np.where(informed, SPREAD_OVER_SAMPLING**2 * variance, 0.0))


def least_spread(branches: int) -> Array:
    """Least standard deviation of each row, shape (5K,). [1]"""
    return np.repeat(LEAST_SPREAD, [3 * branches - 1, 2 * branches + 1])
