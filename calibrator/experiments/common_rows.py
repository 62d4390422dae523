"""Evidence rows of vehicles that all make one drive: their simulations over the fleet mean, and the junction law.

The measured currents of these experiments hold no noise, so the junction law on their second moments is exact: with
(.)_1 the first branch and (.)_r the others, g = M_rr^-1 M_r1 and c = mean_1 - g^T mean_r, M the covariance of the
measured currents.
"""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.published.evidence import FleetEvidence

__all__ = ["MeasuredMoments", "common_rows", "measured_moments"]

GAIN_VARIANCE, CONSTANT_VARIANCE = 1e-10, 1e-12
"""Of the exact junction law: above rounding, far below any fault. [1]"""


@dataclass(frozen=True, kw_only=True)
class MeasuredMoments:
    """Mean (N, K) [A] and covariance (N, K, K) [A^2] of each vehicle's measured currents."""

    mean_a: Array
    covariance_a2: Array

    @property
    def mean_square_a2(self) -> Array:
        """Mean squares, shape (N, K). [A^2]"""
        return np.asarray(np.einsum("nkk->nk", self.covariance_a2) + self.mean_a**2)


def measured_moments(i_s: Array, truth: Faults) -> MeasuredMoments:
    """Moments of what the vehicles measure on a drive, (14) and (15).

    Parameters
    ----------
    i_s : ndarray of shape (T, K)
        Ideal currents. [A]
    truth : Faults
        Of N vehicles.

    Returns
    -------
    MeasuredMoments
        Of the N vehicles.
    """
    slope, intercept = slopes_and_intercepts(truth)
    centred = i_s - i_s.mean(axis=0)
    covariance = centred.T @ centred / len(i_s)
    return MeasuredMoments(
        mean_a=slope * i_s.mean(axis=0) + intercept,
        covariance_a2=slope[:, :, None] * covariance * slope[:, None, :],
    )


def common_rows(evidence: FleetEvidence, moments: MeasuredMoments, *, full_scale_a: float) -> FleetRows:
    """Evidence rows of a fleet on its common drive.

    Parameters
    ----------
    evidence : FleetEvidence
        Slopes and intercepts of the simulations, with white residuals.
    moments : MeasuredMoments
        Of the measured currents of the same vehicles.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    FleetRows
        Without bench readings.
    """
    N, K = evidence.slopes.shape
    gain, constant_a = _junction_law(moments)
    nothing = np.zeros((N, K))
    variance = np.concatenate(
        [
            evidence.slope_variances / evidence.slopes**2,
            np.full((N, K - 1), GAIN_VARIANCE),
            np.full((N, K), UNKNOWN_VARIANCE),
            evidence.intercept_variances_a2 / (full_scale_a * evidence.slopes) ** 2,
            np.full((N, 1), CONSTANT_VARIANCE),
            np.full((N, K), UNKNOWN_VARIANCE),
        ],
        axis=1,
    )
    return FleetRows(
        relative=np.concatenate([np.log(evidence.slopes), np.log(-gain), nothing], axis=1),
        constant=np.concatenate([evidence.intercepts_a / full_scale_a, constant_a / full_scale_a, nothing], axis=1),
        covariance=variance[:, :, None] * np.eye(5 * K),
    )


def _junction_law(moments: MeasuredMoments) -> tuple[Array, Array]:
    """Gains of the other branches (N, K - 1) and constant (N, 1) [A] in the first branch's measured current."""
    among_others, with_first = moments.covariance_a2[:, 1:, 1:], moments.covariance_a2[:, 1:, :1]
    gain = np.linalg.solve(among_others, with_first)[:, :, 0]
    constant = moments.mean_a[:, :1] - np.sum(gain * moments.mean_a[:, 1:], axis=1, keepdims=True)
    return gain, constant
