"""How well estimated fault parameters agree with the truth of an artificial fleet.

    recovered   drift vector and offset vector (offsets / full scale) each within a tolerance of the truth in the
                Euclidean norm, the truth's norm counted as at least the fleet's smallest fault
    f2          weighted harmonic mean of precision and recall of the hardware classification, footnote 7 of [1]_
    harmed      some branch current corrected by (i_m - o) / (1 + d), equation (25) of [1]_, is farther (RMSE) from
                the true current than the measured one

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.faults import Faults

__all__ = ["TOLERANCE", "UnseenDrive", "f2_score", "harmed", "recovered"]

TOLERANCE = 0.10
"""Relative error up to which a vehicle counts as recovered, section IV-D of the paper. [1]"""


def recovered(
    estimate: Faults, truth: Faults, *, full_scale_a: float, smallest_fault: float, tolerance: float = TOLERANCE
) -> Mask:
    """Check whether each vehicle's sensor faults were found.

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
    """Return the f_beta score with beta = 2, footnote 7 of [1]_.

    Parameters
    ----------
    predicted, actual : ndarray of bool of shape (N,)
        Which vehicles are classified as faulty, and which really are.

    Returns
    -------
    float
        5 p r / (4 p + r) with precision p and recall r; 1 if no vehicle is faulty and none is classified as faulty.
    """
    hits = np.sum(predicted & actual)
    weighed = hits + 0.8 * np.sum(actual & ~predicted) + 0.2 * np.sum(predicted & ~actual)
    return float(hits / weighed) if weighed else 1.0


@dataclass(frozen=True)
class UnseenDrive:
    """Moments of the true currents i and of the sensors' errors e = i_m - i on a drive not used for calibration.

    Attributes
    ----------
    mean_a, mean_square_a2 : ndarray of shape (N, K)
        E[i] and E[i^2]. [A], [A^2]
    error_mean_a, error_mean_square_a2, error_product_a2 : ndarray of shape (N, K)
        E[e], E[e^2] and E[e i]. [A], [A^2], [A^2]
    """

    mean_a: Array
    mean_square_a2: Array
    error_mean_a: Array
    error_mean_square_a2: Array
    error_product_a2: Array

    @classmethod
    def of_samples(cls, drives: Sequence[tuple[Array, Array]]) -> "UnseenDrive":
        """Compute the moments from N pairs, one per vehicle: true and measured currents, each of shape (T, K). [A]"""
        moments = [(i, i**2, i_m - i, (i_m - i) ** 2, (i_m - i) * i) for i, i_m in drives]
        return cls(*np.array([[values.mean(axis=0) for values in own] for own in moments]).swapaxes(0, 1))

    @classmethod
    def of_linear_sensors(cls, mean_a: Array, mean_square_a2: Array, truth: Faults) -> "UnseenDrive":
        """Compute the moments for sensors that show i_m = (1 + d) i + o, from E[i] and E[i^2], shape (K,) or (N, K)."""
        d, o, i, i2 = truth.drift, truth.offset_a, mean_a, mean_square_a2
        return cls(i, i2, d * i + o, d**2 * i2 + 2.0 * d * o * i + o**2, d * i2 + o * i)

    def rms_a(self, drift: Array, offset_a: Array) -> Array:
        """Return the RMS error of the currents corrected with drifts and offsets, all of shape (N, K). [A]

        (i_m - o) / (1 + d) - i = (e - o - d i) / (1 + d); parameters of 0 give the error as measured.
        """
        square = (
            self.error_mean_square_a2
            + offset_a**2
            + drift**2 * self.mean_square_a2
            + 2.0 * (drift * offset_a * self.mean_a - offset_a * self.error_mean_a - drift * self.error_product_a2)
        )
        return np.asarray(np.sqrt(np.maximum(square, 0.0)) / np.abs(1.0 + drift))

    def worsening_a(self, drift: Array, offset_a: Array) -> Array:
        """Return by how much these corrections raise the RMS error, shape (N, K); negative where they help. [A]"""
        zero = np.zeros_like(drift)
        return self.rms_a(drift, offset_a) - self.rms_a(zero, zero)


def harmed(estimate: Faults, truth: Faults, *, mean_a: Array, mean_square_a2: Array) -> Mask:
    """Check for each vehicle whether the correction makes any branch worse.

    Parameters
    ----------
    estimate, truth : Faults
        Of the same N vehicles.
    mean_a, mean_square_a2 : ndarray of shape (K,) or (N, K)
        Mean and mean square of the true currents on a drive that was not used for the calibration. [A], [A^2]

    Returns
    -------
    ndarray of bool of shape (N,)
        True where the corrected current of some branch is strictly farther from the true one than the measured.
    """
    unseen = UnseenDrive.of_linear_sensors(mean_a, mean_square_a2, truth)
    return np.asarray(np.any(unseen.worsening_a(estimate.drift, estimate.offset_a) > 0.0, axis=-1))


def _close(estimate: Array, truth: Array, smallest: float, tolerance: float) -> Mask:
    distance = np.linalg.norm(estimate - truth, axis=-1)
    return np.asarray(distance <= tolerance * np.maximum(np.linalg.norm(truth, axis=-1), smallest))
