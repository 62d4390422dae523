"""Second moments of many vehicles, linear regression on them (M9), and the junction law of each of them (M8).

Each step is done for all vehicles at once. What each block moves an estimate by (its influence) gives the covariance,
correlation in time and heteroscedasticity included [1]_, and also that with any other regression on the same blocks.

The junction law sum_k (i_m,k - o_k) / (1 + d_k) = l holds at every instant, so it needs no model of the vehicle at all:

    i_m,1 = sum_k>1 g_k i_m,k + c,    g_k = -(1 + d_1) / (1 + d_k),    c = (1 + d_1) (sum_k o_k / (1 + d_k) + l).

Least squares would draw the g of a small branch towards zero, as its measured current holds noise (errors in
variables); the noise is therefore taken out of the second moments first. How much noise there is, is bounded by the
fast changes of each current; and all sensors' noise together by what the junction law leaves unexplained, which they
share equally as far as the first bound allows.

.. [1] H. White, "A heteroskedasticity-consistent covariance matrix estimator", Econometrica 48 (1980) 817-838.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.summaries.moments import DriveSummary, common_bank

__all__ = [
    "Blocks",
    "FleetMoments",
    "VehicleRegressions",
    "junction_law",
    "products",
    "regress_vehicles",
    "stack_summaries",
]

ROUNDS = 3
"""The residual's variance rho depends on the estimate and the estimate, weakly, on rho. [1]"""
LEAST_RHO = 1e-9
"""Of the mean square of y: a regression that fits exactly. [1]"""
LEAST_VARIANCE = 1e-12
"""Of y where it is zero throughout, so that the prior stays: below a microampere, in any unit that is used."""
TOO_FEW = 4.0
"""Blocks from which no variance can be estimated: two for slope and intercept, two because the error of the variance
itself makes the tails heavier than normal."""
SINGULAR = 1e-12
"""Eigenvalue over the largest one below which a direction counts as unknown. [1]"""
GAIN_SD = 0.4
"""Prior deviation of a gain ratio from -1: no running sensor is farther off. [1]"""
NOISE_ROUNDS = 3
"""The bound on the noise depends on the gains, and they on it; three rounds settle it. [1]"""
MOST_NOISE = 0.9
"""Largest share of a current's variance that is taken for noise. [1]"""
LEAST_WEIGHT = 0.1
"""Of a branch in the junction sum, where its share of the residual is bounded. [1]"""


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Which of B blocks, stacked vehicle after vehicle, belong to which of N vehicles.

    Attributes
    ----------
    count : ndarray of int of shape (N,)
        Number of blocks of each vehicle, at least one.
    vehicle : ndarray of int of shape (B,)
        Vehicle of each block.
    """

    count: NDArray[np.int64]
    vehicle: NDArray[np.int64]

    @classmethod
    def of_lengths(cls, lengths: Sequence[int]) -> "Blocks":
        """Make the blocks of vehicles that have so many each."""
        count = np.asarray(lengths, np.int64)
        return cls(count=count, vehicle=np.repeat(np.arange(len(count)), count))

    def total(self, values: Array) -> Array:
        """Sums over the blocks of each vehicle, shape (N, ...) of (B, ...); the same to the bit beside any others."""
        first = np.cumsum(self.count) - self.count
        return np.asarray(np.add.reduceat(np.ascontiguousarray(values), first, axis=0))


@dataclass(frozen=True, kw_only=True)
class FleetMoments:
    """Moments of N vehicles with M inputs and K branches in B blocks.

    Attributes
    ----------
    moments : ndarray of shape (B, M + K + 1, M + K + 1)
        Sums of products of (inputs, measured currents [A], 1), as in a
        :class:`~calibrator.summaries.moments.DriveSummary`, stacked vehicle after vehicle.
    noise_a2 : ndarray of shape (B, K)
        White noise of each measured current. [A^2]
    blocks : Blocks
        Which blocks belong to which vehicle.
    branches : int
        Number of branches K.
    """

    moments: Array
    noise_a2: Array
    blocks: Blocks
    branches: int

    def __len__(self) -> int:
        return len(self.blocks.count)

    @property
    def inputs(self) -> int:
        """Number of inputs M."""
        return int(self.moments.shape[1]) - self.branches - 1

    @cached_property
    def mean(self) -> Array:
        """Mean products of (inputs, measured currents, 1) over all samples of a vehicle, shape (N, p, p)."""
        total = self.blocks.total(self.moments)
        return np.asarray(total / total[:, -1:, -1:])

    @property
    def mean_a(self) -> Array:
        """Mean measured currents, shape (N, K). [A]"""
        return self.mean[:, -1, self.inputs : -1]

    @property
    def mean_square_a2(self) -> Array:
        """Mean squares of the measured currents, shape (N, K). [A^2]"""
        return np.diagonal(self.mean, axis1=1, axis2=2)[:, self.inputs : -1]

    @property
    def variance_a2(self) -> Array:
        """Variance of the measured currents, which no offset changes, shape (N, K). [A^2]"""
        return np.asarray(self.mean_square_a2 - self.mean_a**2)


def stack_summaries(summaries: Sequence[DriveSummary], order: Sequence[int] | None = None) -> FleetMoments:
    """Stack the summaries of a fleet.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        Of N vehicles, at least one, with the same inputs and branches.
    order : sequence of int or None
        Branches to take, in this order; None: all in theirs.

    Returns
    -------
    FleetMoments
        Without extra columns.

    Raises
    ------
    DriveError
        If the summaries were made with different filter banks.
    """
    common_bank(summaries)
    M, K = summaries[0].inputs, summaries[0].branches
    chosen = list(range(K)) if order is None else list(order)
    columns = np.array([*range(M), *(M + k for k in chosen), M + K])
    return FleetMoments(
        moments=np.concatenate([summary.moments for summary in summaries])[:, columns[:, None], columns],
        noise_a2=np.concatenate([summary.noise_a2 for summary in summaries])[:, chosen],
        blocks=Blocks.of_lengths([len(summary.moments) for summary in summaries]),
        branches=len(chosen),
    )


@dataclass(frozen=True, kw_only=True)
class VehicleRegressions:
    """The same regression of N vehicles.

    Attributes
    ----------
    estimate : ndarray of shape (N, p)
        theta of each vehicle.
    influence : ndarray of shape (B, p)
        What each block moves the estimate of its vehicle by; the sum of their outer products is the covariance of the
        sampling error.
    prior_covariance : ndarray of shape (N, p, p)
        Part of the covariance that is due to the prior.
    blocks : Blocks
        Which blocks belong to which vehicle.
    """

    estimate: Array
    influence: Array
    prior_covariance: Array
    blocks: Blocks

    @property
    def sd(self) -> Array:
        """Standard deviations, shape (N, p)."""
        prior = np.diagonal(self.prior_covariance, axis1=1, axis2=2)
        return np.asarray(np.sqrt(self.blocks.total(self.influence**2) + prior))


def regress_vehicles(
    gram: Array, right: Array, power: Array, blocks: Blocks, *, prior_mean: Array, prior_precision: Array
) -> VehicleRegressions:
    """Regress y on z in each of N vehicles.

    Parameters
    ----------
    gram : ndarray of shape (B, p, p)
        Sums of z z^T per block.
    right : ndarray of shape (B, p)
        Sums of z y per block.
    power : ndarray of shape (N,)
        Mean square of y over all blocks of a vehicle: the scale below which a residual is rounding.
    blocks : Blocks
        Which blocks belong to which vehicle.
    prior_mean, prior_precision : ndarray of shape (p,)
        Independent Gaussian prior; precision zero where there is none.

    Returns
    -------
    VehicleRegressions
        In the units of y over z.
    """
    count, p = blocks.count, right.shape[1]
    Z, y = blocks.total(gram), blocks.total(right)
    least = np.maximum(LEAST_RHO * power, LEAST_VARIANCE)
    rho = least
    for _ in range(ROUNDS):
        # (Z^T Z + rho P) theta = Z^T y + rho P theta_0, by the pseudo-inverse of the matrix scaled to a diagonal of one
        matrix = Z + rho[:, None, None] * np.diag(prior_precision)
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), np.finfo(float).tiny))
        square = scale[:, :, None] * scale[:, None, :]
        inverse = np.linalg.pinv(matrix * square, rcond=SINGULAR, hermitian=True) * square
        estimate = products(inverse, y + rho[:, None] * prior_precision * prior_mean)
        scores = right - products(gram, estimate[blocks.vehicle])
        influence = products(inverse[blocks.vehicle], scores)
        # long-run variance of the residual: its variance times by how much neighbouring samples repeat each other
        rho = np.maximum(blocks.total(np.sum(scores * influence, axis=1)) / p, least)
    influence -= (blocks.total(influence) / count[:, None])[blocks.vehicle]
    widened = np.sqrt(np.maximum(count, TOO_FEW + 1.0) / np.maximum(count - TOO_FEW, 1.0))
    return VehicleRegressions(
        estimate=estimate,
        influence=influence * widened[blocks.vehicle][:, None],
        prior_covariance=rho[:, None, None] ** 2 * (inverse * prior_precision) @ inverse,
        blocks=blocks,
    )


def products(matrices: Array, vectors: Array) -> Array:
    """Each matrix times its vector, shape (N, q) of (N, q, p) and (N, p).

    The same to the bit for any N, which neither matmul nor einsum promise: these choose their way by the whole shape.
    """
    return np.asarray(np.sum(np.ascontiguousarray(matrices) * vectors[:, None, :], axis=2))


def junction_law(fleet: FleetMoments) -> VehicleRegressions:
    """Regress the first measured current on the others.

    Parameters
    ----------
    fleet : FleetMoments
        Of N vehicles; the first branch should be the one that moves most.

    Returns
    -------
    VehicleRegressions
        Of (g_2 .. g_K [1], c [A]).
    """
    M, K, N = fleet.inputs, fleet.branches, len(fleet)
    z = np.array([*range(M + 1, M + K), M + K])
    gram, right = fleet.moments[:, z[:, None], z], fleet.moments[:, z, M]
    samples, currents = fleet.moments[:, -1, -1], fleet.mean[:, M:, M:]
    bound_a2 = fleet.blocks.total(fleet.noise_a2) / fleet.blocks.count[:, None]
    bound_a2 = np.minimum(bound_a2, MOST_NOISE * fleet.variance_a2)
    noise_a2, others = np.zeros_like(bound_a2), range(K - 1)
    for _ in range(NOISE_ROUNDS):
        clean = gram.copy()
        clean[:, others, others] -= samples[:, None] * noise_a2[fleet.blocks.vehicle, 1:]
        fit = regress_vehicles(
            clean,
            right,
            currents[:, 0, 0],
            fleet.blocks,
            prior_mean=np.append(-np.ones(K - 1), 0.0),
            prior_precision=np.append(np.full(K - 1, GAIN_SD**-2), 0.0),
        )
        sums = np.concatenate([np.ones((N, 1)), -fit.estimate], axis=1)  # i_m,1 - sum g_k i_m,k - c, as weights
        residual_a2 = np.maximum(np.sum(sums * products(currents, sums), axis=1), 0.0)
        noise_a2 = _shared_noise_a2(residual_a2, bound_a2, np.maximum(sums[:, :K] ** 2, LEAST_WEIGHT))
    return fit


def _shared_noise_a2(residual_a2: Array, bound_a2: Array, weight: Array) -> Array:
    """Noise of each current (N, K), equal up to its bound, whose weighted sum is the residual (N,) at most. [A^2]"""
    order = np.argsort(bound_a2, axis=1, kind="stable")
    bound, weight = np.take_along_axis(bound_a2, order, axis=1), np.take_along_axis(weight, order, axis=1)
    # level: noise of the currents from here on, if all before are at their bounds (water filling)
    below = np.cumsum(weight * bound, axis=1) - weight * bound
    level = (residual_a2[:, None] - below) / np.cumsum(weight[:, ::-1], axis=1)[:, ::-1]
    reached: Mask = np.less_equal(level, bound)
    first = np.take_along_axis(level, np.argmax(reached, axis=1)[:, None], axis=1)
    return np.asarray(np.where(reached.any(axis=1, keepdims=True), np.minimum(bound_a2, first), bound_a2))
