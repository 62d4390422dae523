"""Evidence rows of vehicles that all make one drive: simulations over the fleet reference, and the junction law.

The reference is not the mean r of the fleet (3), which a fleet without symmetry shifts, but c_0 r + c_1 with the
densest cluster of slopes and of intercepts as c_0 and c_1, branch by branch: vehicles that agree with each other.
Slopes and intercepts a, b over r become

    a' = a / c_0,    b' = b - a c_1 / c_0

The measured currents of these experiments hold no noise, so the junction law on their second moments is exact: with
(.)_1 the first branch and (.)_r the others, g = M_rr^-1 M_r1 and c = mean_1 - g^T mean_r, M the covariance of the
measured currents.
"""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.cluster import densest_clusters
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.published.evidence import FleetEvidence

__all__ = ["MeasuredMoments", "common_rows", "measured_moments"]

GAIN_VARIANCE, CONSTANT_VARIANCE = 1e-10, 1e-12
"""Of the exact junction law: above rounding, far below any fault. [1]"""
ROUNDS = 3
"""Over a better reference, vehicles agree more closely; more rounds change nothing. [1]"""
LEAST_SD = 1e-6
"""Of slopes [1] and intercepts [A] of simulations without noise."""


@dataclass(frozen=True, kw_only=True)
class MeasuredMoments:
    """Mean (N, K) [A] and covariance (N, K, K) [A^2] of each vehicle's measured currents."""

    mean_a: Array
    covariance_a2: Array

    @property
    def mean_square_a2(self) -> Array:
        """Mean squares, shape (N, K). [A^2]"""
        return np.asarray(np.einsum("nkk->nk", self.covariance_a2) + self.mean_a**2)


@dataclass(frozen=True)
class _Regression:
    """Slopes (N, K) [1], intercepts (N, K) [A] and the covariance of both (N, K, 2, 2)."""

    slope: Array
    intercept_a: Array
    covariance: Array


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


def common_rows(
    evidence: FleetEvidence, reference_mean_a: Array, moments: MeasuredMoments, *, full_scale_a: float
) -> FleetRows:
    """Evidence rows of a fleet on its common drive.

    Parameters
    ----------
    evidence : FleetEvidence
        Slopes and intercepts of the simulations over the fleet mean, with white residuals.
    reference_mean_a : ndarray of shape (K,)
        Mean of the fleet mean on the unity drive. [A]
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
    found = _over_cluster(_over_mean(evidence, reference_mean_a))
    gain, constant_a = _junction_law(moments)
    nothing = np.zeros((N, K))
    covariance = np.tile(np.diag(np.full(5 * K, UNKNOWN_VARIANCE)), (N, 1, 1))
    for k in range(K):
        unit = np.array([np.ones(N), np.full(N, 1.0 / full_scale_a)]).T / found.slope[:, k, None]
        place = np.array([k, 3 * K - 1 + k])
        covariance[:, place[:, None], place] = found.covariance[:, k] * unit[:, :, None] * unit[:, None, :]
    for row in range(K, 2 * K - 1):
        covariance[:, row, row] = GAIN_VARIANCE
    covariance[:, 4 * K - 1, 4 * K - 1] = CONSTANT_VARIANCE
    return FleetRows(
        relative=np.concatenate([np.log(found.slope), np.log(-gain), nothing], axis=1),
        constant=np.concatenate([found.intercept_a / full_scale_a, constant_a / full_scale_a, nothing], axis=1),
        covariance=covariance,
    )


def _over_mean(evidence: FleetEvidence, reference_mean_a: Array) -> _Regression:
    """Slopes and intercepts as found, with the covariance of least squares."""
    covariance = np.empty((*evidence.slopes.shape, 2, 2))
    covariance[..., 0, 0] = np.maximum(evidence.slope_variances, LEAST_SD**2)
    covariance[..., 1, 1] = np.maximum(evidence.intercept_variances_a2, LEAST_SD**2)
    covariance[..., 0, 1] = covariance[..., 1, 0] = -reference_mean_a * evidence.slope_variances
    return _Regression(evidence.slopes, evidence.intercepts_a, covariance)


def _over_cluster(found: _Regression) -> _Regression:
    """The same over the densest cluster."""
    for _ in range(ROUNDS):
        sd = np.sqrt(np.einsum("nkii->nki", found.covariance))
        scale, zero = (
            np.array([densest_clusters(values[:, k], sd[:, k, i])[0].centre for k in range(values.shape[1])])
            for i, values in enumerate((found.slope, found.intercept_a))
        )
        jacobian = np.zeros((len(scale), 2, 2))
        jacobian[:, 0, 0], jacobian[:, 1, 0], jacobian[:, 1, 1] = 1.0 / scale, -zero / scale, 1.0
        found = _Regression(
            found.slope / scale,
            found.intercept_a - found.slope * zero / scale,
            jacobian @ found.covariance @ np.swapaxes(jacobian, 1, 2),
        )
    return found


def _junction_law(moments: MeasuredMoments) -> tuple[Array, Array]:
    """Gains of the other branches (N, K - 1) and constant (N, 1) [A] in the first branch's measured current."""
    among_others, with_first = moments.covariance_a2[:, 1:, 1:], moments.covariance_a2[:, 1:, :1]
    gain = np.linalg.solve(among_others, with_first)[:, :, 0]
    constant = moments.mean_a[:, :1] - np.sum(gain * moments.mean_a[:, 1:], axis=1, keepdims=True)
    return gain, constant
