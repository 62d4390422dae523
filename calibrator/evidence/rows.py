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

b and c are where lines meet zero. They turn with the ratios about the means of their data, which are known far better
(:class:`LineMeans`): the rows are linear in the errors of the ratios as far as the covariance tells, and exact beyond.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.faults import Index

__all__ = [
    "MOST_TURN",
    "UNKNOWN_VARIANCE",
    "FleetRows",
    "LineMeans",
    "constant_design",
    "relative_design",
    "with_load_spread",
]

UNKNOWN_VARIANCE = 100.0
"""Of a row that says nothing: ten times full scale, or a factor of 20 000. [1]"""
MOST_TURN = 3.0
"""Largest logarithm by which a ratio can be off. [1]"""


@dataclass(frozen=True, kw_only=True)
class LineMeans:
    """Means of the data that slopes, gain ratios and constants were fitted to, in fractions of full scale.

    Attributes
    ----------
    model, measured : ndarray of shape (N, K)
        Of the fleet model's currents and of the measured ones.
    """

    model: Array
    measured: Array

    def take(self, index: Index) -> "LineMeans":
        """Return the means of some of the vehicles."""
        return LineMeans(model=self.model[index], measured=self.measured[index])

    def lever(self, relative: Array) -> Array:
        """What an error of log a and log(-g) makes of b and c as seen in true currents, shape (N, K + 1, 2K - 1)."""
        N, K = self.model.shape
        lever = np.zeros((N, K + 1, 2 * K - 1))
        lever[:, range(K), range(K)] = -self.model
        lever[:, K, K:] = self.measured[:, 1:] * np.exp(-relative[:, 1:K])
        return lever

    def beyond_linear(self, relative: Array, parameters: Array, residual: Array) -> Array:
        """What is missing from b and c if they are taken to be linear in the errors of the ratios.

        Parameters
        ----------
        relative : ndarray of shape (N, 3K - 1)
            Relative rows.
        parameters : ndarray of shape (N, S, K + 1)
            d_h, d_1 .. d_K of S states.
        residual : ndarray of shape (N, S, 3K - 1)
            What these leave of the relative rows.

        Returns
        -------
        ndarray of shape (N, S, K + 1)
            To be added to the constants as seen in true currents.
        """
        K = self.model.shape[1]
        x = residual[:, :, : 2 * K - 1]
        turned = np.expm1(np.minimum(x, MOST_TURN))
        slopes = (1.0 + parameters[:, :, :1]) * self.model[:, None] * turned[:, :, :K]
        ratios = turned[:, :, K:] * self.measured[:, None, 1:] / (1.0 + parameters[:, :, 2:])
        exact = np.concatenate([slopes, -ratios.sum(axis=2, keepdims=True)], axis=2)
        return np.asarray(exact + x @ np.swapaxes(self.lever(relative), 1, 2))


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
    means : LineMeans or None
        About which the constants turn with the ratios; None: they do not.
    """

    relative: Array
    constant: Array
    covariance: Array
    means: LineMeans | None = None

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
            relative=self.relative[index],
            constant=self.constant[index],
            covariance=self.covariance[index],
            means=None if self.means is None else self.means.take(index),
        )

    def constant_turn(self, parameters: Array) -> Array:
        """Derivative of :meth:`constant_seen` by the logarithms of the relative parameters, without hardware offsets.

        Parameters
        ----------
        parameters : ndarray of shape (N, S, K + 1)
            d_h, d_1 .. d_K of S states.

        Returns
        -------
        ndarray of shape (N, S, 2K + 1, K + 1)
            The residual of the relative rows falls as the parameters rise.
        """
        K, (N, S, _) = self.branches, parameters.shape
        turn = np.zeros((N, S, 2 * K + 1, K + 1))
        if self.means is None:
            return turn
        true = (1.0 + parameters[:, :, :1]) * self.means.model[:, None]
        turn[:, :, range(K), range(1, K + 1)] = turn[:, :, :K, 0] = turn[:, :, K, 1:] = -true
        lever = self.means.lever(self.relative) @ relative_design(K)[: 2 * K - 1]
        turn[:, :, : K + 1] -= lever[:, None]
        return turn

    def intercept_covariance(self) -> Array:
        """Of b at the means, where it does not turn with the slopes, shape (N, K, K)."""
        K = self.branches
        a, b = slice(0, K), slice(3 * K - 1, 4 * K - 1)
        of_b = self.covariance[:, b, b]
        if self.means is None:
            return np.asarray(of_b)
        turn = -self.means.lever(self.relative)[:, :K, :K]
        across = turn @ self.covariance[:, a, b]
        return np.asarray(
            of_b + across + np.swapaxes(across, 1, 2) + turn @ self.covariance[:, a, a] @ np.swapaxes(turn, 1, 2)
        )

    def dispersed(self, dispersion: Array | float) -> tuple[Array, Array]:
        """Covariance if the variance of the intercepts is larger.

        Parameters
        ----------
        dispersion : ndarray of shape (K,), or float
            Factor on their variance at the means, at least 1. [1]

        Returns
        -------
        whole : ndarray of shape (N, 5K, 5K)
            Of all rows.
        added : ndarray of shape (N, K, K)
            What of it is added to the intercepts, independent of everything else.
        """
        K = self.branches
        own = self.intercept_covariance()
        more = np.sqrt(np.broadcast_to(np.asarray(dispersion) - 1.0, K))
        added = own * np.outer(more, more)
        whole = self.covariance.copy()
        whole[:, 3 * K - 1 : 4 * K - 1, 3 * K - 1 : 4 * K - 1] += added
        return whole, added

    def constant_seen(self, parameters: Array, residual: Array) -> Array:
        """Constant rows as seen in true currents, if the relative parameters are known.

        Parameters
        ----------
        parameters : ndarray of shape (N, S, K + 1)
            d_h, d_1 .. d_K of S states.
        residual : ndarray of shape (N, S, 3K - 1)
            What these leave of the relative rows.

        Returns
        -------
        ndarray of shape (N, S, 2K + 1)
            Linear in the errors of the relative rows, as the covariance tells.
        """
        factor = 1.0 + parameters[:, :, 1:]
        seen = self.constant[:, None] / np.concatenate([factor, factor[:, :, :1], factor], axis=2)
        if self.means is not None:
            seen[:, :, : self.branches + 1] += self.means.beyond_linear(self.relative, parameters, residual)
        return np.asarray(seen)


def with_load_spread(rows: FleetRows, sd: float) -> FleetRows:
    """Evidence in which loads that no branch measures differ between vehicles.

    Parameters
    ----------
    rows : FleetRows
        Of N vehicles.
    sd : float
        Standard deviation of these loads over vehicles, in fractions of full scale. [1]

    Returns
    -------
    FleetRows
        The same with a wider constant of the junction law.
    """
    covariance, junction = rows.covariance.copy(), 4 * rows.branches - 1
    covariance[:, junction, junction] += sd**2
    return replace(rows, covariance=covariance)


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
