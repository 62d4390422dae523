"""Direct readings of single sensors: zero-current windows, bench checks, trusted vehicles.

A zero-current window (contactors open) shows the offset itself; a bench check shows drift and offset. Each is one more
Gaussian row of the evidence.
"""

from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows
from calibrator.faults import Index
from calibrator.summaries.zero_current import weighted_mean

__all__ = [
    "TRUSTED_DRIFT_SD",
    "TRUSTED_OFFSET_SD",
    "Readings",
    "no_readings",
    "trusted_readings",
    "with_readings",
]

TRUSTED_DRIFT_SD = 0.002
"""Accuracy of a bench check of the gain, as of a laboratory shunt. [1]"""
TRUSTED_OFFSET_SD = 0.0005
"""The same of the zero, in fractions of full scale. [1]"""


@dataclass(frozen=True, kw_only=True)
class Readings:
    """Readings of N vehicles with K branches; NaN where there is none.

    Attributes
    ----------
    drift, drift_sd : ndarray of shape (N, K)
        Read drift, above -1, and its standard deviation, positive. [1]
    offset_a, offset_sd_a : ndarray of shape (N, K)
        Read offset and its standard deviation, positive. [A]
    """

    drift: Array
    drift_sd: Array
    offset_a: Array
    offset_sd_a: Array

    def merged(self, other: "Readings") -> "Readings":
        """Both together: of a sensor that was read twice the mean, weighted by precision."""
        drift, drift_sd = weighted_mean((self.drift, self.drift_sd), (other.drift, other.drift_sd))
        offset_a, offset_sd_a = weighted_mean((self.offset_a, self.offset_sd_a), (other.offset_a, other.offset_sd_a))
        return Readings(drift=drift, drift_sd=drift_sd, offset_a=offset_a, offset_sd_a=offset_sd_a)

    def take(self, index: Index) -> "Readings":
        """Return the readings of some of the vehicles."""
        return Readings(**{name: values[index] for name, values in vars(self).items()})

    def take_branches(self, order: list[int]) -> "Readings":
        """Return the same readings with the branches in another order."""
        return Readings(**{name: values[:, order] for name, values in vars(self).items()})


def no_readings(vehicles: int, branches: int) -> Readings:
    """No readings at all."""
    nothing = np.full((vehicles, branches), np.nan)
    return Readings(drift=nothing, drift_sd=nothing, offset_a=nothing, offset_sd_a=nothing)


def trusted_readings(trusted: Mask, branches: int, full_scale_a: float) -> Readings:
    """Readings of bench-checked vehicles: all their sensors were found faultless.

    Parameters
    ----------
    trusted : ndarray of bool of shape (N,)
        Which vehicles.
    branches : int
        Number of branches K.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    Readings
        Zero for the trusted vehicles, none for the others.
    """

    def where(value: float) -> Array:
        return np.where(trusted[:, None], value, np.nan) * np.ones(branches)

    return Readings(
        drift=where(0.0),
        drift_sd=where(TRUSTED_DRIFT_SD),
        offset_a=where(0.0),
        offset_sd_a=where(TRUSTED_OFFSET_SD * full_scale_a),
    )


def with_readings(rows: FleetRows, readings: Readings, *, full_scale_a: float) -> FleetRows:
    """Evidence with direct readings in it.

    Parameters
    ----------
    rows : FleetRows
        Of N vehicles.
    readings : Readings
        Of the same vehicles and branches.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    FleetRows
        The same with the rows of the readings filled in.
    """
    K = rows.branches
    relative, constant, covariance = rows.relative.copy(), rows.constant.copy(), rows.covariance.copy()
    drift_read = np.isfinite(readings.drift) & np.isfinite(readings.drift_sd)
    offset_read = np.isfinite(readings.offset_a) & np.isfinite(readings.offset_sd_a)
    relative[:, 2 * K - 1 :] = np.where(drift_read, np.log1p(np.where(drift_read, readings.drift, 0.0)), 0.0)
    constant[:, K + 1 :] = np.where(offset_read, readings.offset_a, 0.0) / full_scale_a
    drift_row, offset_row = np.arange(2 * K - 1, 3 * K - 1), np.arange(4 * K, 5 * K)
    log_sd = readings.drift_sd / (1.0 + readings.drift)
    covariance[:, drift_row, drift_row] = np.where(drift_read, log_sd**2, UNKNOWN_VARIANCE)
    covariance[:, offset_row, offset_row] = np.where(
        offset_read, (readings.offset_sd_a / full_scale_a) ** 2, UNKNOWN_VARIANCE
    )
    return replace(rows, relative=relative, constant=constant, covariance=covariance)
