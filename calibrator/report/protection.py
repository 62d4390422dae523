"""What the battery's protection margin costs before and after correction, figure 1 of [1]_.

A controller that may let a current limit I flow must stay below it by what its sensor can be wrong by, or the true
current passes the limit. By the model i_m = (1 + d) i + o it is off by |d| I + |o| at the limit in one direction
or the other, and a margin that is one for all vehicles is set for the worst sensor of the fleet:

    as measured:       M = worst of |d| I + |o|
    after correction:  z s where the branch is corrected or no fault was found, else |d| I + |o| + z s; at most M
    s^2 = (I s_d)^2 + s_o^2

with d, o and their standard deviations s_d, s_o from the posterior. Its doubt counts only against the correction, so
what is given back is not made larger by what is not known. With one margin for all, the correction gives back the
difference of M to the largest that is needed then, which the worst vehicle that is not corrected decides. With a
margin per vehicle, as each has its own parameters, it gives back the difference to what the same vehicle needs where
its sensor is known but not corrected: |d| I + |o| + z s, at most M.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask

__all__ = ["SIGMAS", "Margins", "margins"]

SIGMAS = 3.0
"""z: standard deviations that a margin covers beyond the estimate; 1 in 370 is beyond if errors are Gaussian. [1]"""
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
        What each sensor is off by at the limit. [A]
    known_a, after_a : ndarray of shape (N,)
        Margin that each vehicle needs where its sensor is known but not corrected; and after correction. [A]
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
    """Margins of one branch.

    Parameters
    ----------
    drift, offset_a, drift_sd, offset_sd_a : ndarray of shape (N,)
        Sensor faults and their standard deviations. [1], [A]
    applied : ndarray of bool, shape (N,)
        Whether the node corrects the branch.
    limit_a : float
        Current limit I. [A]

    Returns
    -------
    Margins
        Before and after correction.
    """
    doubt_a = SIGMAS * np.hypot(limit_a * drift_sd, offset_sd_a)
    off_a = np.abs(drift) * limit_a + np.abs(offset_a)
    worst_a = _for_all(off_a)
    return Margins(
        limit_a=limit_a,
        before_a=off_a,
        known_a=np.minimum(off_a + doubt_a, worst_a),
        after_a=np.minimum(np.where(applied, doubt_a, off_a + doubt_a), worst_a),
    )


def _for_all(needed_a: Array) -> float:
    return float(np.max(needed_a) if len(needed_a) * (1.0 - QUANTILE) < 1.0 else np.quantile(needed_a, QUANTILE))
