"""How well estimated fault parameters agree with the truth of an artificial fleet.

    recovered   drift vector and offset vector (offsets / full scale) each within a tolerance of the truth in the
                Euclidean norm, the truth's norm counted as at least the fleet's smallest fault
    f2          weighted harmonic mean of precision and recall of the hardware classification, footnote 7 of the paper
    harmed      some branch current corrected by (25) is farther (RMSE) from the true one than as measured

Equation (25) is that of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.faults import Faults

__all__ = ["TOLERANCE", "correction_error_rms", "f2_score", "harmed", "recovered"]

TOLERANCE = 0.10
"""Relative error below which a vehicle counts as recovered, section IV-D. [1]"""


def recovered(
    estimate: Faults, truth: Faults, *, full_scale_a: float, smallest_fault: float, tolerance: float = TOLERANCE
) -> Mask:
    """Whether each vehicle's sensor faults were found.

    Parameters
    ----------
    estimate, truth : Faults
        Of the same N vehicles.
    full_scale_a : float
        Full scale of the junction. [A]
    smallest_fault : float
        Smallest magnitude a fault of this fleet can have: drifts [1], offsets in fractions of full scale.
    tolerance : float
        Relative error allowed. [1]

    Returns
    -------
    ndarray of bool of shape (N,)
        True where both the drifts and the offsets are within the tolerance; False where the estimate is NaN.
    """
    drift = _close(estimate.drift, truth.drift, smallest_fault, tolerance)
    offset = _close(estimate.offset_a / full_scale_a, truth.offset_a / full_scale_a, smallest_fault, tolerance)
    return drift & offset


def f2_score(predicted: Mask, actual: Mask) -> float:
    """f_beta score with beta = 2, footnote 7 of [1]_.

    Parameters
    ----------
    predicted, actual : ndarray of bool of shape (N,)
        Which vehicles are held to be, and which are, faulty.

    Returns
    -------
    float
        5 p r / (4 p + r) of precision p and recall r; 1 if no vehicle is faulty and none is held to be.
    """
    hits = np.sum(predicted & actual)
    weighed = hits + 0.8 * np.sum(actual & ~predicted) + 0.2 * np.sum(predicted & ~actual)
    return float(hits / weighed) if weighed else 1.0


def correction_error_rms(
    *, true_drift: Array, true_offset_a: Array, drift: Array, offset_a: Array, mean_a: Array, mean_square_a2: Array
) -> Array:
    """RMSE of corrected against true currents, from the moments of the true currents alone.

    With alpha = (1 + d) / (1 + d_hat) - 1 and beta = (o - o_hat) / (1 + d_hat), corrected minus true current is
    alpha i + beta; parameters d_hat = 0, o_hat = 0 give the error of the measured currents.

    Parameters
    ----------
    true_drift, true_offset_a : ndarray of shape (..., K)
        Sensor faults. [1], [A]
    drift, offset_a : ndarray of shape (..., K)
        Parameters the currents are corrected with. [1], [A]
    mean_a, mean_square_a2 : ndarray of shape (..., K)
        Moments of the true currents on a drive. [A], [A^2]

    Returns
    -------
    ndarray of shape (..., K)
        RMSE of each branch. [A]
    """
    alpha = (1.0 + true_drift) / (1.0 + drift) - 1.0
    beta = (true_offset_a - offset_a) / (1.0 + drift)
    return np.asarray(np.sqrt(np.maximum(alpha**2 * mean_square_a2 + 2.0 * alpha * beta * mean_a + beta**2, 0.0)))


def harmed(estimate: Faults, truth: Faults, *, mean_a: Array, mean_square_a2: Array) -> Mask:
    """Whether the correction makes any branch of a vehicle worse.

    Parameters
    ----------
    estimate, truth : Faults
        Of the same N vehicles.
    mean_a, mean_square_a2 : ndarray of shape (K,) or (N, K)
        Moments of the true currents on a drive that was not used for the calibration. [A], [A^2]

    Returns
    -------
    ndarray of bool of shape (N,)
        True where the corrected current of some branch is strictly farther from the true one than the measured.
    """
    zero = np.zeros_like(truth.drift)
    measured, corrected = (
        correction_error_rms(
            true_drift=truth.drift,
            true_offset_a=truth.offset_a,
            drift=drift,
            offset_a=offset,
            mean_a=mean_a,
            mean_square_a2=mean_square_a2,
        )
        for drift, offset in ((zero, zero), (estimate.drift, estimate.offset_a))
    )
    return np.asarray(np.any(corrected > measured, axis=-1))


def _close(estimate: Array, truth: Array, smallest: float, tolerance: float) -> Mask:
    distance = np.linalg.norm(estimate - truth, axis=-1)
    return np.asarray(distance <= tolerance * np.maximum(np.linalg.norm(truth, axis=-1), smallest))
