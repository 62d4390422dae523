"""What the battery's protection margin costs before and after correction, figure 1 of [1]_; docs/report.md derives it.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask

__all__ = ["SIGMAS", "Margins", "Protection", "margins", "protection_of"]

SIGMAS = 3.0
"""Standard deviations that a margin covers beyond the estimate; 1 in 370 is beyond if errors are Gaussian. [1]"""
QUANTILE = 0.999
"""Share of the fleet that one margin for all must cover; of fewer than a thousand vehicles all of them. [1]"""


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Margins that the vehicles of a fleet need.

    Attributes
    ----------
    limit_a : float
        The battery's current limit I. [A]
    before_a : ndarray of shape (N,)
        Error of each sensor at the limit. [A]
    known_a, after_a : ndarray of shape (N,)
        Margin of each vehicle where its sensor is known but not corrected; and after correction. [A]
    """

    limit_a: float
    before_a: Array
    known_a: Array
    after_a: Array

    @property
    def common_before_a(self) -> float:
        """One margin for all vehicles as they are. [A]"""
        return _for_all(self.before_a)

    @property
    def common_after_a(self) -> float:
        """One margin for all vehicles after correction. [A]"""
        return _for_all(self.after_a)

    @property
    def own_gain_a(self) -> Array:
        """What the correction gives back to each vehicle that has a margin of its own, shape (N,). [A]"""
        return self.known_a - self.after_a


def margins(
    drift: Array, offset_a: Array, drift_sd: Array, offset_sd_a: Array, applied: Mask, *, limit_a: float
) -> Margins:
    """Margins of one branch of N vehicles.

    Parameters
    ----------
    drift, offset_a, drift_sd, offset_sd_a : ndarray of shape (N,)
        Sensor faults and their standard deviations. [1], [A]
    applied : ndarray of bool, shape (N,)
        Whether the node corrects the branch.
    limit_a : float
        Current limit I. [A]
    """
    uncertain_a = SIGMAS * np.hypot(limit_a * drift_sd, offset_sd_a)
    error_a = np.abs(drift) * limit_a + np.abs(offset_a)
    worst_a = _for_all(error_a)
    return Margins(
        limit_a=limit_a,
        before_a=error_a,
        known_a=np.minimum(error_a + uncertain_a, worst_a),
        after_a=np.minimum(np.where(applied, uncertain_a, error_a + uncertain_a), worst_a),
    )


def _for_all(needed_a: Array) -> float:
    return float(np.max(needed_a) if len(needed_a) * (1.0 - QUANTILE) < 1.0 else np.quantile(needed_a, QUANTILE))


@dataclass(frozen=True, kw_only=True)
class Protection:
    """Battery protection margin before and after correction.

    Attributes
    ----------
    branch : str
        The battery's.
    limit_a, voltage_v : float, float or None
        Current limit, and the voltage that makes kW of A. [A], [V]
    common_before_a, common_after_a : float
        One margin for all vehicles. [A]
    corrected : int
        Vehicles of which the branch is corrected.
    common_gain_a, own_gain_a : float, float or None
        What the correction gives back: with one margin for all; and with a margin per vehicle, the median of the
        vehicles that are corrected, None if there is none. [A]
    common_gain_kw, own_gain_kw : float or None
        The same at the voltage. [kW]
    """

    branch: str
    limit_a: float
    voltage_v: float | None
    common_before_a: float
    common_after_a: float
    corrected: int
    common_gain_a: float
    own_gain_a: float | None
    common_gain_kw: float | None
    own_gain_kw: float | None


def protection_of(found: Margins, corrected: Mask, *, branch: str, voltage_v: float | None) -> Protection:
    """Summarise the margins of a fleet; `corrected`, shape (N,), are the vehicles of which the branch is corrected."""
    common_a = found.common_before_a - found.common_after_a
    own_a = float(np.median(found.own_gain_a[corrected])) if corrected.any() else None
    return Protection(
        branch=branch,
        limit_a=found.limit_a,
        voltage_v=voltage_v,
        common_before_a=found.common_before_a,
        common_after_a=found.common_after_a,
        corrected=int(corrected.sum()),
        common_gain_a=common_a,
        own_gain_a=own_a,
        common_gain_kw=None if voltage_v is None else common_a * voltage_v / 1e3,
        own_gain_kw=None if voltage_v is None or own_a is None else own_a * voltage_v / 1e3,
    )
