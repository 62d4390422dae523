"""Evidence on each vehicle from its simulation on the unity drive: regression (15) and features (5), (6) of [1]_.

Symbols: N vehicles, K branches, T samples of the unity drive. Currents are positive into the junction.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.errors import FleetError

__all__ = ["FleetEvidence", "collect_evidence", "fleet_mean"]


@dataclass(frozen=True, kw_only=True)
class FleetEvidence:
    """Regressions and features of N vehicles with K branches.

    Attributes
    ----------
    slopes : ndarray of shape (N, K)
        a_k of equation (15) of the paper: simulated over reference current. [1]
    intercepts_a : ndarray of shape (N, K)
        b_k of equation (15) of the paper. [A]
    slope_variances, intercept_variances_a2 : ndarray of shape (N, K)
        Variances of slopes and intercepts if residuals are not correlated in time. [1], [A^2]
    deviation_a2 : ndarray of shape (N, K)
        Mean square of simulated minus reference current, equation (5) of the paper. [A^2]
    junction_a2 : ndarray of shape (N,)
        Mean square of the sum of the measured currents, equation (6) of the paper. [A^2]
    """

    slopes: Array
    intercepts_a: Array
    slope_variances: Array
    intercept_variances_a2: Array
    deviation_a2: Array
    junction_a2: Array

    @property
    def features(self) -> Array:
        """Features f_1 to f_K+1 of each vehicle, equations (5) and (6) of the paper, shape (N, K + 1). [A^2]"""
        return np.column_stack([self.deviation_a2, self.junction_a2])


def fleet_mean(simulated: Iterable[Array]) -> Array:
    """Estimate the ideal currents by the mean of the fleet's simulations, equations (3) and (24) of the paper.

    Parameters
    ----------
    simulated : iterable of ndarray of shape (T, K)
        Simulated currents, one vehicle after the other; an array of shape (N, T, K) will do. [A]

    Returns
    -------
    ndarray of shape (T, K)
        Fleet reference. [A]

    Raises
    ------
    FleetError
        If there is no vehicle.
    """
    total, count = np.zeros(()), 0
    for currents in simulated:
        total, count = total + currents, count + 1
    if not count:
        raise FleetError("no vehicle left to take the fleet mean of")
    return np.asarray(total / count)


def collect_evidence(simulated: Iterable[Array], reference: Array, junction_a2: Array) -> FleetEvidence:
    """Compare each vehicle's simulation with the fleet reference, equations (5) and (15) of the paper.

    Parameters
    ----------
    simulated : iterable of ndarray of shape (T, K)
        Simulated currents, one vehicle after the other. [A]
    reference : ndarray of shape (T, K)
        Fleet reference. [A]
    junction_a2 : ndarray of shape (N,)
        Mean square of the sum of each vehicle's measured currents, equation (6) of the paper: 0 for faultless sensors.
        [A^2]

    Returns
    -------
    FleetEvidence
        Evidence of all vehicles.

    Raises
    ------
    FleetError
        If a branch of the reference does not vary, or junction_a2 has not one value per simulated vehicle.
    """
    centred = reference - reference.mean(axis=0)
    power = np.sum(centred**2, axis=0)
    if not (power > 0.0).all():
        raise FleetError(f"the fleet reference of branch {power.argmin() + 1} is constant; choose another unity drive")
    rows = np.array([_compare(currents, reference, centred, power) for currents in simulated])
    if len(rows) != len(junction_a2):
        raise FleetError(f"{len(rows)} vehicles were simulated, but {len(junction_a2)} have a measured junction sum")
    slopes, intercepts, slope_variances, intercept_variances, deviation = rows.transpose(1, 0, 2)
    return FleetEvidence(
        slopes=slopes,
        intercepts_a=intercepts,
        slope_variances=slope_variances,
        intercept_variances_a2=intercept_variances,
        deviation_a2=deviation,
        junction_a2=junction_a2,
    )


def _compare(currents: Array, reference: Array, centred: Array, power: Array) -> Array:
    """Return slope, intercept, variances of these, and mean square deviation of one vehicle, as an array (5, K)."""
    samples = len(reference)
    mean = reference.mean(axis=0)
    slope = np.sum(centred * currents, axis=0) / power
    intercept = currents.mean(axis=0) - slope * mean
    residual = np.sum((currents - slope * reference - intercept) ** 2, axis=0) / max(samples - 2, 1)
    deviation = np.mean((currents - reference) ** 2, axis=0)
    return np.stack([slope, intercept, residual / power, residual * (1.0 / samples + mean**2 / power), deviation])
