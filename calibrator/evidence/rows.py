"""Gaussian evidence of a fleet: rows in which the fault parameters are linear.

With lambda_k = log(1 + d_k), eta = log(1 + d_h) and omega_k = o_k / (1 + d_k), equations (11), (13) and (15) of [1]_
and the junction law sum_k (i_m,k - o_k) / (1 + d_k) = l (l: load that no branch measures) become

    relative rows                                             constant rows, in fractions of full scale
    log a_k                  = lambda_k + eta + m_k           b_k / (1 + d_k)   = o_h,k + omega_k + n_k
    log(-g_k), k > 1         = lambda_1 - lambda_k + q_k      c / (1 + d_1)     = sum_k omega_k + l
    log of a bench reading   = lambda_k                       offset reading_k / (1 + d_k) = omega_k

a, b are slopes and intercepts over the fleet reference; g, c those of the first measured current over the others. m, n,
q, l are what the vehicle and its drives differ from the fleet without any fault: the model spread. A row that says
nothing has the value 0 and a variance of :data:`UNKNOWN_VARIANCE`.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.faults import Index

__all__ = ["UNKNOWN_VARIANCE", "FleetRows", "constant_design", "relative_design"]

UNKNOWN_VARIANCE = 100.0
"""Of a row that says nothing: ten times full scale, or a factor of 20 000. [1]"""


@dataclass(frozen=True, kw_only=True)
class FleetRows:
    """Evidence of N vehicles with K branches.

    Attributes
    ----------
    relative : ndarray of shape (N, 3K - 1)
        log a (K), log(-g) (K - 1), bench readings of log(1 + d) (K). [1]
    constant : ndarray of shape (N, 2K + 1)
        b (K), c (1), readings of the offsets (K), in fractions of full scale. [1]
    covariance : ndarray of shape (N, 5K, 5K)
        Of the sampling error of both, relative rows first; of the constant rows as seen in true currents, that is
        divided by 1 + d. [1]
    """

    relative: Array
    constant: Array
    covariance: Array

    def __post_init__(self) -> None:
        N, rows = len(self.relative), self.relative.shape[1] + self.constant.shape[1]
        if self.constant.shape[0] != N or self.covariance.shape != (N, rows, rows) or rows % 5:
            raise FleetError(
                f"rows of shape {self.relative.shape} and {self.constant.shape} do not fit a covariance of shape "
                f"{self.covariance.shape}: expected (N, 3K - 1), (N, 2K + 1) and (N, 5K, 5K)"
            )
        if not all(np.isfinite(values).all() for values in (self.relative, self.constant, self.covariance)):
            raise FleetError("evidence is not finite; leave out the vehicles that have none")

    def __len__(self) -> int:
        return len(self.relative)

    @property
    def branches(self) -> int:
        """Number of branches K."""
        return int(self.relative.shape[1] + 1) // 3

    def take(self, index: Index) -> "FleetRows":
        """Return the evidence of some of the vehicles."""
        return FleetRows(
            relative=self.relative[index], constant=self.constant[index], covariance=self.covariance[index]
        )


def relative_design(branches: int) -> Array:
    """Relative rows over (eta, lambda_1 .. lambda_K), shape (3K - 1, K + 1)."""
    K = branches
    X = np.zeros((3 * K - 1, K + 1))
    X[:K, 0] = 1.0
    X[:K, 1:] = np.eye(K)
    X[K : 2 * K - 1, 1] = 1.0
    X[K : 2 * K - 1, 2:] = -np.eye(K - 1)
    X[2 * K - 1 :, 1:] = np.eye(K)
    return X


def constant_design(branches: int) -> Array:
    """Constant rows over (o_h,1 .. o_h,K-1, omega_1 .. omega_K), shape (2K + 1, 2K - 1); o_h,K is minus the rest."""
    K = branches
    X = np.zeros((2 * K + 1, 2 * K - 1))
    X[: K - 1, : K - 1] = np.eye(K - 1)
    X[K - 1, : K - 1] = -1.0
    X[:K, K - 1 :] = np.eye(K)
    X[K, K - 1 :] = 1.0
    X[K + 1 :, K - 1 :] = np.eye(K)
    return X
