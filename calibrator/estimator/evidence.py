"""Evidence of a fleet: what its drives say of each vehicle, as Gaussian rows that are linear in the faults.

    second moments of drives (FleetMoments)
      -> fleet model (M7): the ideal currents of identical vehicles over their inputs (fit_fleet_model)
      -> slopes and intercepts over it (15), and each vehicle's own junction regression (M8)
      -> evidence rows (M9) to (M11) with their covariance (collect_rows)

Equations (M..) are those of docs/method.md, the others those of [2]_. Every step is done for all vehicles at once.
Covariances follow from how far each block of a drive moves an estimate (its influence): they include correlation in
time and heteroscedasticity [1]_, and hold also between regressions on the same blocks.

With lambda_k = log(1 + d_k), eta = log(1 + d_h) and omega_k = o_k / (1 + d_k), equations (11), (13) and (15) of [2]_
and the junction's sum of currents sum_k (i_m,k - o_k) / (1 + d_k) = l (l: load that no branch measures) become

    relative rows                                             constant rows, in fractions of full scale
    log a_k                  = lambda_k + eta + m_k           b_k / (1 + d_k)   = o_h,k + omega_k + n_k
    log(-g_k), k > 1         = lambda_1 - lambda_k + q_k      c / (1 + d_1)     = sum_k omega_k + l
    log of a bench reading   = lambda_k                       offset reading_k / (1 + d_k) = omega_k

a, b are slopes and intercepts over the fleet model; g, c those of the first measured current over the others. m, n, q
are differences of a vehicle and its drives from the fleet that are no fault: the model spread. An unknown row has the
value 0 and a variance of :data:`UNKNOWN_VARIANCE`.

b and c are values of lines at zero current. If a slope or ratio is in error, its line pivots about the mean of its
data, where it is known far better, and b or c changes with it: (M10). The covariance includes this to first order, the
residuals of an explanation (M11) exactly: :func:`calibrator.estimator.posterior.row_residuals`.

.. [1] H. White, "A heteroskedasticity-consistent covariance matrix estimator", Econometrica 48 (1980) 817-838.
.. [2] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.faults import Index
from calibrator.summaries.moments import DriveSummary, common_bank
from ecu_node.summary import MAD_TO_SD

__all__ = [
    "UNKNOWN_VARIANCE",
    "Blocks",
    "EvidenceRows",
    "FleetMoments",
    "ParameterPlaces",
    "RowPlaces",
    "VehicleRegressions",
    "collect_rows",
    "covariances",
    "densest_clusters",
    "evidence_names",
    "fit_fleet_model",
    "junction_regression",
    "products",
    "ratios_in_doubt",
    "regress_on_fleet",
    "regress_vehicles",
    "row_design",
    "stack_summaries",
]  # fmt: skip

REGRESSION_ROUNDS = 3
"""Rounds of a regression: the residual's variance rho depends on the estimate, and the estimate weakly on rho. [1]"""
LEAST_RHO = 1e-9
"""Least rho over the mean square of y, reached where a regression fits exactly. [1]"""
LEAST_VARIANCE = 1e-12
"""Least rho where y is zero throughout, so that the prior still counts: below a microampere, in any unit in use."""
TOO_FEW = 4.0
"""Number of blocks that is too few to estimate a variance: two go to slope and intercept, two because the error of the
variance itself makes the tails heavier than normal."""
SINGULAR = 1e-12
"""Eigenvalue over the largest one below which a direction counts as unknown. [1]"""
TINY = np.finfo(float).tiny
LEAST_PRIOR = 100.0 * SINGULAR
"""Least share of the prior in the diagonal of the normal equations, for a regressor that never varies."""
GAIN_SD = 0.4
"""Prior deviation of a gain ratio from -1, and of a slope from 1: no running sensor is farther off, and a branch that
hardly moves counts as faultless. [1]"""
NOISE_ROUNDS = 3
"""Rounds of the junction regression: the noise taken out depends on the gains, and they on it; three suffice. [1]"""
MOST_NOISE = 0.9
"""Largest share of a current's variance that is taken for noise. [1]"""
LEAST_WEIGHT = 0.1
"""Least squared weight that a branch counts with when the residual is shared out among the branches as noise. [1]"""
LEAST_APART, SURELY_APART = 0.002, 4.0
"""Difference between the gain ratios of slow and of all changes that matters, and number of standard deviations from
which on it is sure. [1]"""
MODEL_ROUNDS = 12
"""Rounds of alternating least squares; slopes change by less than 1e-4 after eight on all fleets tried. [1]"""
RIDGE = 1e-9
"""Added to the diagonal of the normalised moments of the inputs: an input that hardly varies gets no read-out."""
LEAST_SLOPE_SD = 1e-5
"""Least standard deviation of slopes and intercepts, where a model fits exactly. [1], [A]"""
MOST_VARIATION = 100.0
"""Standard deviation of an input over the fleet's median one, above which the vehicle must use another unit. [1]"""
TINY_A2 = 1e-12
"""Least variance of all currents together, for a fleet that stands still. [A^2]"""
CONSTANT = 1e-12
"""Variance over mean square below which a column counts as constant: the rest is rounding. [1]"""
MOST_CENTRES = 200
SPREADS = 12
SHARE_STEPS = 8
"""Most centres and number of spreads that :func:`densest_clusters` tries, and steps that fit each cluster's share."""
MARGIN = 0.1
"""The background reaches beyond the values by this share of their range. [1]"""
SD_OF_RANGE = 9.0
"""Range of the background over the standard deviation of its Gaussian half, where ``widest`` sets the range. [1]"""
UNKNOWN_VARIANCE = 100.0
"""Variance of an unknown row: a standard deviation of ten times full scale, or of a factor of 20 000. [1]"""
LEAST_GAIN, LEAST_SURE_GAIN = 0.3, 0.085
"""Least slope or gain ratio that is used, and that of those that are known well: a lower one that is known badly comes
from a branch that hardly moved, not from a sensor. Gains of 0.08 and less are not fitted. [1]"""
MOST_RELATIVE_SD = 0.25
"""Standard deviation of a slope or gain ratio, over itself, up to which it is known well. [1]"""
DEAD_SD = 0.5
"""Standard deviation of the logarithm of a slope or ratio that is known to be below the least one: it counts as that
one, and says that the gain is small, not how small. [1]"""
FEWEST_BLOCKS = 4
"""Least number of blocks of a vehicle; from fewer no variance can be estimated."""
FLEET_BLOCKS = 20.0
"""Weight of the fleet's usual correlation of rows against that of one vehicle, in blocks."""
LEAST_SD = np.array([5e-4, 2.5e-4])
"""Standard deviations added to relative and constant rows, as sound sensors are not exact: 0.05 %, and 0.025 % of full
scale. [1]

Where most sensors of a fleet are exact, the learnt model spread is far smaller. Errors of 0.1 % of a few others were
then explained by large faults that cancel ("small errors" of ``experiment attacks``). With 60 % of these values, or
1e-4 for the constants, some still were; with 5e-5 for gains alone fewer vehicles were recovered.
"""


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
        """Make the blocks of vehicles from the number that each has."""
        count = np.asarray(lengths, np.int64)
        return cls(count=count, vehicle=np.repeat(np.arange(len(count)), count))

    def total(self, values: Array) -> Array:
        """Sum values (B, ...) over the blocks of each vehicle, to shape (N, ...).

        The sum of a vehicle is the same to the bit, whichever other vehicles there are.
        """
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
        Variance of the white noise of each measured current; an upper bound where it changes fast itself. [A^2]
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
    def covariance(self) -> Array:
        """Covariances of (inputs, measured currents, 1), shape (N, p, p), see :func:`covariances`."""
        return covariances(self.mean)

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

    @property
    def noise_bound_a2(self) -> Array:
        """Largest noise of the measured currents: what their fast changes show, shape (N, K). [A^2]"""
        return self.blocks.total(self.noise_a2) / self.blocks.count[:, None]


def covariances(mean: Array) -> Array:
    """Compute covariances from mean products (N, p, p) of columns, the last of them 1; zero for a constant column."""
    means = mean[:, :, -1]
    covariance = mean - means[:, :, None] * means[:, None, :]
    varies = np.diagonal(covariance, axis1=1, axis2=2) > CONSTANT * means**2
    return np.where(varies[:, :, None] & varies[:, None, :], covariance, 0.0)


def stack_summaries(summaries: Sequence[DriveSummary], order: Sequence[int] | None = None) -> FleetMoments:
    """Stack the summaries of a fleet.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        Summaries of N vehicles, at least one, with the same inputs and branches.
    order : sequence of int or None
        Branches to take, in this order; None: all, in the order of the summaries.

    Returns
    -------
    FleetMoments
        Moments of the branches in that order.

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
    """Results of one regression that was done for each of N vehicles.

    Attributes
    ----------
    estimate : ndarray of shape (N, p)
        Coefficients theta of each vehicle.
    influence : ndarray of shape (B, p)
        How far each block moves the estimate of its vehicle; the sum of the outer products over the blocks is the
        covariance of the sampling error.
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
    gram: Array, right: Array, power: Array, blocks: Blocks, *, prior_gain: float
) -> VehicleRegressions:
    """Regress y on z in each of N vehicles, by least squares with a weak prior, (M9) of docs/method.md.

    Parameters
    ----------
    gram : ndarray of shape (B, p, p)
        Sums of z z^T per block; the last z is 1.
    right : ndarray of shape (B, p)
        Sums of z y per block.
    power : ndarray of shape (N,)
        Mean square of y over all blocks of a vehicle: the scale below which a residual is rounding.
    blocks : Blocks
        Which blocks belong to which vehicle.
    prior_gain : float
        Mean of the Gaussian prior of each coefficient but the last, the constant, which has none; the standard
        deviation of the prior is :data:`GAIN_SD`.

    Returns
    -------
    VehicleRegressions
        In the units of y over z.
    """
    count, p = blocks.count, right.shape[1]
    prior_precision = np.append(np.full(p - 1, GAIN_SD**-2), 0.0)
    Z, y = blocks.total(gram), blocks.total(right)
    least = np.maximum(LEAST_RHO * power, LEAST_VARIANCE)
    still = np.diagonal(covariances(Z / Z[:, -1:, -1:]), axis1=1, axis2=2) == 0.0  # only the prior sets these
    least_prior = LEAST_PRIOR * np.diagonal(Z, axis1=1, axis2=2) * (still & (prior_precision > 0.0))
    rho = least
    for _ in range(REGRESSION_ROUNDS):
        # (Z^T Z + rho P) theta = Z^T y + rho P theta_0, by the pseudo-inverse of the matrix scaled to a diagonal of one
        prior = np.maximum(rho[:, None] * prior_precision, least_prior)
        matrix = Z + prior[:, :, None] * np.eye(p)
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), np.finfo(float).tiny))
        square = scale[:, :, None] * scale[:, None, :]
        inverse = np.linalg.pinv(matrix * square, rcond=SINGULAR, hermitian=True) * square
        estimate = products(inverse, y + prior * prior_gain * (prior_precision > 0.0))
        scores = right - products(gram, estimate[blocks.vehicle])
        influence = products(inverse[blocks.vehicle], scores)
        # long-run variance of the residual: its variance times the number of neighbouring samples that are alike
        rho = np.maximum(blocks.total(np.sum(scores * influence, axis=1)) / p, least)
    influence -= (blocks.total(influence) / count[:, None])[blocks.vehicle]
    prior = np.maximum(rho[:, None] * prior_precision, least_prior)
    widened = np.sqrt(np.maximum(count, TOO_FEW + 1.0) / np.maximum(count - TOO_FEW, 1.0))
    return VehicleRegressions(
        estimate=estimate,
        influence=influence * widened[blocks.vehicle][:, None],
        prior_covariance=(inverse * (prior**2 / np.maximum(prior_precision, TINY))[:, None]) @ inverse,
        blocks=blocks,
    )


def products(matrices: Array, vectors: Array) -> Array:
    """Multiply each matrix by its vector: (N, q, p) and (N, p) to (N, q).

    The result is the same to the bit for any N. Neither matmul nor einsum promises that: both choose their algorithm
    by the whole shape.
    """
    return np.asarray(np.sum(np.ascontiguousarray(matrices) * vectors[:, None, :], axis=2))


def junction_regression(fleet: FleetMoments) -> VehicleRegressions:
    """Regress the first measured current on the others, (M8) of docs/method.md, with their noise taken out.

    Parameters
    ----------
    fleet : FleetMoments
        Moments of N vehicles; the first branch should be the one whose current varies most.

    Returns
    -------
    VehicleRegressions
        Estimates of (g_2 .. g_K [1], c [A]).
    """
    M, K, N = fleet.inputs, fleet.branches, len(fleet)
    z = np.array([*range(M + 1, M + K), M + K])
    gram, right = fleet.moments[:, z[:, None], z], fleet.moments[:, z, M]
    samples, currents = fleet.moments[:, -1, -1], fleet.mean[:, M:, M:]
    bound_a2 = np.minimum(fleet.noise_bound_a2, MOST_NOISE * fleet.variance_a2)
    noise_a2, others = np.zeros_like(bound_a2), range(K - 1)
    for _ in range(NOISE_ROUNDS):
        clean = gram.copy()
        clean[:, others, others] -= samples[:, None] * noise_a2[fleet.blocks.vehicle, 1:]
        fit = regress_vehicles(
            clean,
            right,
            currents[:, 0, 0],
            fleet.blocks,
            prior_gain=-1.0,
        )
        sums = np.concatenate([np.ones((N, 1)), -fit.estimate], axis=1)  # i_m,1 - sum g_k i_m,k - c, as weights
        residual_a2 = np.maximum(np.sum(sums * products(currents, sums), axis=1), 0.0)
        noise_a2 = _shared_noise_a2(residual_a2, bound_a2, np.maximum(sums[:, :K] ** 2, LEAST_WEIGHT))
    return fit


def ratios_in_doubt(fleet: FleetMoments) -> Mask:
    """Find gain ratios that differ between slow and fast changes of the currents, in the fleet as a whole.

    A gain error is the same in both. The effect of filtered signals, means over a second, held values and loads that
    follow the vehicle's speed is not, and looks like a gain error that all vehicles share: (M8a) of docs/method.md.

    Parameters
    ----------
    fleet : FleetMoments
        Moments of N vehicles; the first branch should be the one whose current varies most.

    Returns
    -------
    ndarray of bool of shape (K - 1,)
        Whether the ratio of each branch but the first differs between slow and fast changes.
    """
    sums, samples = fleet.moments[:, -1], fleet.moments[:, -1, -1]
    of_means = sums[:, :, None] * sums[:, None, :] / samples[:, None, None]  # each block as if constant
    slow = junction_regression(replace(fleet, moments=of_means, noise_a2=np.zeros_like(fleet.noise_a2)))
    usual = junction_regression(fleet)
    apart = (slow.estimate - usual.estimate)[:, :-1]
    sd = np.hypot(slow.sd, usual.sd)[:, :-1]
    centre = np.median(apart, axis=0)
    scatter = np.maximum(MAD_TO_SD * np.median(np.abs(apart - centre), axis=0), np.median(sd, axis=0))
    return np.asarray(np.abs(centre) > np.maximum(LEAST_APART, SURELY_APART * scatter / np.sqrt(len(fleet))))


def _shared_noise_a2(residual_a2: Array, bound_a2: Array, weight: Array) -> Array:
    """Share the residual (N,) out as noise of the currents (N, K): equal, but at most the bound. [A^2]

    The weight is the square of each current's factor in the residual. [1]
    """
    order = np.argsort(bound_a2, axis=1, kind="stable")
    bound, weight = np.take_along_axis(bound_a2, order, axis=1), np.take_along_axis(weight, order, axis=1)
    # level: noise of the currents from here on, if all before are at their bounds (water filling)
    below = np.cumsum(weight * bound, axis=1) - weight * bound
    level = (residual_a2[:, None] - below) / np.cumsum(weight[:, ::-1], axis=1)[:, ::-1]
    reached: Mask = np.less_equal(level, bound)
    first = np.take_along_axis(level, np.argmax(reached, axis=1)[:, None], axis=1)
    return np.asarray(np.where(reached.any(axis=1, keepdims=True), np.minimum(bound_a2, first), bound_a2))


def fit_fleet_model(fleet: FleetMoments) -> Array:
    """Learn the fleet model, equation (M7) of docs/method.md.

    Parameters
    ----------
    fleet : FleetMoments
        Moments of the N vehicles to learn from.

    Returns
    -------
    ndarray of shape (M + 1, K)
        Read-out: ideal currents per unit of each input, and in the last row the constants. Scale and zero are those of
        the vehicles that agree; each row sums to zero. [A]
    """
    M, K = fleet.inputs, fleet.branches
    u = [*range(M), M + K]  # columns of the inputs and the constant
    centred = fleet.covariance
    variance = np.diagonal(centred, axis1=1, axis2=2)[:, :M]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # an input that varies in no vehicle has no median
        median = np.nanmedian(np.where(variance > 0.0, variance, np.nan), axis=0)
    usual = ~(variance > MOST_VARIATION**2 * median).any(axis=1)
    centred = centred[usual]
    slopes = np.ones((len(fleet), K))
    for _ in range(MODEL_ROUNDS):
        # Read-outs by least squares about each vehicle's own means, as it has an intercept of its own; all vehicles
        # count alike, however long they drove. The constants stay zero.
        read_out = np.zeros((M + 1, K))
        for k, a in enumerate(slopes[usual].T):
            gram = np.einsum("n,npq->pq", a**2, centred[:, :M, :M])
            scale = np.where(np.diag(gram) > 0.0, np.sqrt(np.abs(np.diag(gram))), 1.0)
            normalised = gram / np.outer(scale, scale) + RIDGE * np.eye(M)
            read_out[:M, k] = np.linalg.solve(normalised, a @ centred[:, :M, M + k] / scale) / scale
        fits = regress_on_fleet(fleet, read_out)
        sd = [np.maximum(fit.sd, LEAST_SLOPE_SD) for fit in fits]
        scale, zero = (
            np.array([densest_clusters(fit.estimate[:, i], e[:, i])[0].centre for fit, e in zip(fits, sd, strict=True)])
            for i in (0, 1)
        )
        read_out = read_out * scale
        read_out[-1] += zero
        slopes = np.stack([fit.estimate[:, 0] for fit in fits], axis=1) / scale
    # Ideal currents sum to zero, whatever the inputs. The excess of an input is shared among the branches in proportion
    # to the variance of their currents. The excess of the constants is the mean load that no branch measures: it is
    # taken from the source, as it does not grow with other currents.
    mean = fleet.mean[usual].mean(axis=0)
    mean_a = mean[-1, u] @ read_out
    variance_a2 = np.diag(read_out.T @ mean[np.ix_(u, u)] @ read_out) - mean_a**2
    excess = read_out.sum(axis=1)
    read_out = read_out - np.outer(np.append(excess[:-1], 0.0), variance_a2 / max(variance_a2.sum(), TINY_A2))
    read_out[-1, int(np.argmax(mean_a))] -= excess[-1]
    return read_out


def regress_on_fleet(fleet: FleetMoments, read_out: Array) -> list[VehicleRegressions]:
    """Regress each branch of each vehicle on the fleet model, on its own drives, equation (15) of the paper.

    Parameters
    ----------
    fleet : FleetMoments
        Moments of N vehicles.
    read_out : ndarray of shape (M + 1, K)
        Read-out of the fleet model. [A]

    Returns
    -------
    list of K VehicleRegressions
        Estimates of (a_k [1], b_k [A]).
    """
    M, K = fleet.inputs, fleet.branches
    u = np.array([*range(M), M + K])
    gram = np.ascontiguousarray(fleet.moments[:, u[:, None], u])
    fits = []
    for k in range(K):
        z = np.stack([read_out[:, k], np.append(np.zeros(M), 1.0)])  # modelled current and constant
        fits.append(
            regress_vehicles(
                z @ gram @ z.T,
                products(np.broadcast_to(z, (len(gram), 2, M + 1)), fleet.moments[:, u, M + k]),
                fleet.mean[:, M + k, M + k],
                fleet.blocks,
                prior_gain=1.0,
            )
        )
    return fits


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """One cluster of values that agree; centre and spread are in the unit of the values.

    Attributes
    ----------
    centre, spread : float
        Mean of its members, and their standard deviation without the sampling error.
    share : float
        Share of the values in it. [1]
    """

    centre: float
    spread: float
    share: float


def densest_clusters(
    values: Array, sd: Array, *, most: int = 1, farthest: float = np.inf, widest: float = 0.0
) -> list[Cluster]:
    """Find the most likely clusters, (M15) of docs/method.md, the best first; later ones lie apart from those before.

    Values are taken as a mixture of one Gaussian cluster (centre c, spread s, each value with its own sampling error)
    and a broad background. The most likely of a grid of centres and spreads is chosen. Unlike the mean and the median
    the result does not need a symmetric fleet, nor that most vehicles are without faults.

    Parameters
    ----------
    values, sd : ndarray of shape (N,)
        Values, and standard deviations of their sampling errors, positive.
    most : int
        Number of clusters wanted.
    farthest : float
        Largest magnitude of a centre.
    widest : float
        Range of values that faults can produce: the background is at least as wide, so that values that all agree are
        a cluster, too.

    Returns
    -------
    list of Cluster
        Up to ``most`` clusters; at least one, unless the magnitude of every value is beyond ``farthest``.
    """
    near = values[np.abs(values) <= farthest]
    if not near.size:
        return []
    extent, narrowest = float(np.ptp(values)), float(np.median(sd))
    if extent <= narrowest:
        return [Cluster(centre=float(np.median(near)), spread=0.0, share=1.0)]
    centres = np.unique(np.quantile(near, np.linspace(0.0, 1.0, min(len(near), MOST_CENTRES)), method="nearest"))
    spreads = np.geomspace(narrowest / 4.0, max(extent / 4.0, narrowest), SPREADS)
    wide, sd_wide = max(extent * (1.0 + 2.0 * MARGIN), widest), max(values.std(), widest / SD_OF_RANGE)
    background = 0.5 * norm.pdf(values, values.mean(), sd_wide) + 0.5 / wide  # half Gaussian, half uniform
    gain, share = np.empty((2, SPREADS, len(centres)))
    for s, spread in enumerate(spreads):
        variance = sd**2 + spread**2
        density = np.exp(-0.5 * (values - centres[:, None]) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
        kappa = np.full((len(centres), 1), 0.5)  # share of the cluster, by expectation maximisation
        for _ in range(SHARE_STEPS):
            inside = kappa * density
            kappa = np.mean(inside / (inside + (1.0 - kappa) * background), axis=1, keepdims=True)
        gain[s] = np.sum(np.log(kappa * density / background + (1.0 - kappa)), axis=1)
        share[s] = kappa[:, 0]
    clusters: list[Cluster] = []
    while len(clusters) < most and np.isfinite(gain).any():
        s, c = divmod(int(np.argmax(gain)), len(centres))
        variance = sd**2 + spreads[s] ** 2
        members = np.abs(values - centres[c]) <= 3.0 * np.sqrt(variance)
        centre = float(np.average(values, weights=members / variance))
        clusters.append(Cluster(centre=centre, spread=float(spreads[s]), share=float(share[s, c])))
        gain[:, np.abs(centres - centre) <= 3.0 * (spreads[s] + narrowest)] = -np.inf
    return clusters


class RowPlaces:
    """Places of each kind of row in an array of 5K rows, for K branches.

    Attributes
    ----------
    slopes : slice
        K rows log a. [1]
    ratios : slice
        K - 1 rows log(-g), of every branch but the first. [1]
    gain_reads : slice
        K rows of bench readings of log(1 + d). [1]
    intercepts : slice
        K rows b, in fractions of full scale.
    junction : int
        The row c, in fractions of full scale.
    offset_reads : slice
        K rows of readings of the offsets, in fractions of full scale.
    relative, constant : slice
        The 3K - 1 rows of slopes, ratios and gain readings, and the 2K + 1 rows of intercepts, junction and offset
        readings.
    measured : ndarray of int
        The 3K rows that come from drives; the others are readings.
    """

    def __init__(self, branches: int) -> None:
        K = branches
        self.slopes, self.ratios, self.gain_reads = slice(0, K), slice(K, 2 * K - 1), slice(2 * K - 1, 3 * K - 1)
        self.intercepts, self.junction, self.offset_reads = slice(3 * K - 1, 4 * K - 1), 4 * K - 1, slice(4 * K, 5 * K)
        self.relative, self.constant = slice(0, 3 * K - 1), slice(3 * K - 1, 5 * K)
        self.measured: NDArray[np.int64] = np.r_[self.slopes, self.ratios, self.intercepts, self.junction]

    def slope(self, branch: int) -> int:
        """Return the row of the slope of a branch; branches and rows are counted from 0."""
        return int(self.slopes.start) + branch

    def ratio(self, branch: int) -> int:
        """Return the row of the gain ratio of a branch, 1 to K - 1; branch 0 has none."""
        return int(self.ratios.start) + branch - 1

    def intercept(self, branch: int) -> int:
        """Return the row of the intercept of a branch; branches and rows are counted from 0."""
        return int(self.intercepts.start) + branch


class ParameterPlaces:
    """Places of each kind of parameter in an array of 3K + 1, for K branches, in the symbols of the module's docstring.

    Attributes
    ----------
    eta : int
        Hardware gain. [1]
    gains : slice
        lambda of K sensors. [1]
    hardware_offsets : slice
        o_h of all branches but the last, which is minus their sum, in fractions of full scale.
    offsets : slice
        omega of K sensors, in fractions of full scale.
    load : int
        l, in fractions of full scale.
    """

    def __init__(self, branches: int) -> None:
        K = branches
        self.eta, self.load = 0, 3 * K
        self.gains, self.hardware_offsets, self.offsets = slice(1, K + 1), slice(K + 1, 2 * K), slice(2 * K, 3 * K)

    def offset(self, branch: int) -> int:
        """Return the place of omega of the sensor of a branch; branches and places are counted from 0."""
        return int(self.offsets.start) + branch


@dataclass(frozen=True, kw_only=True)
class EvidenceRows:
    """Evidence of N vehicles with K branches: what drives and readings say, one number per row.

    Attributes
    ----------
    values : ndarray of shape (N, 5K)
        Relative rows: log a (K), log(-g) (K - 1), bench readings of log(1 + d) (K); then constant rows in fractions of
        full scale: b (K), c (1), readings of the offsets (K). [1]
    covariance : ndarray of shape (N, 5K, 5K)
        Covariance of their sampling errors; constant rows are seen in true currents, that is divided by 1 + d. [1]
    means : ndarray of shape (N, 2, K)
        Means of the fleet model's and of the measured currents, in fractions of full scale: the lines of the constants
        pivot about them; zero where constants do not depend on the ratios. [1]

    Raises
    ------
    FleetError
        If any number is not finite.
    """

    values: Array
    covariance: Array
    means: Array

    def __post_init__(self) -> None:
        if not all(np.isfinite(each).all() for each in vars(self).values()):
            raise FleetError("evidence is not finite; leave out the vehicles that have none")

    def __len__(self) -> int:
        return len(self.values)

    @property
    def branches(self) -> int:
        """Number of branches K."""
        return int(self.values.shape[1]) // 5

    @property
    def places(self) -> RowPlaces:
        """Places of each kind of row in ``values``, :attr:`known` and the covariance."""
        return RowPlaces(self.branches)

    @property
    def relative(self) -> Array:
        """Relative rows, shape (N, 3K - 1). [1]"""
        return self.values[:, self.places.relative]

    @property
    def constant(self) -> Array:
        """Constant rows in fractions of full scale, shape (N, 2K + 1). [1]"""
        return self.values[:, self.places.constant]

    @property
    def known(self) -> Mask:
        """Which rows are known, shape (N, 5K)."""
        return np.asarray(np.diagonal(self.covariance, axis1=1, axis2=2) < UNKNOWN_VARIANCE / 2.0)

    def shown(self, row: int) -> tuple[Array, Array]:
        """Return the values of a row in the vehicles where it is known, and their standard deviations."""
        known = self.known[:, row]
        return self.values[known, row], np.sqrt(self.covariance[known, row, row])

    def take(self, index: Index) -> "EvidenceRows":
        """Return the evidence of some of the vehicles."""
        return EvidenceRows(**{name: values[index] for name, values in vars(self).items()})

    def intercept_covariance(self) -> Array:
        """Return the covariance (N, K, K) of the intercepts at the mean current, where slope errors have no effect."""
        b = self.places.intercepts
        return _shifted(self.covariance, -_pivot(self.means, self.values), first=b.start)[:, b, b]

    def dispersed(self, dispersion: Array | float) -> tuple[Array, Array]:
        """Return the covariance, with the variance of the intercepts at the mean currents multiplied by a factor.

        Parameters
        ----------
        dispersion : ndarray of shape (K,), or float
            Factor on the variance of the intercepts, at least 1. [1]

        Returns
        -------
        whole : ndarray of shape (N, 5K, 5K)
            Covariance of all rows.
        added : ndarray of shape (N, K, K)
            Part of it that was added to the intercepts, independent of everything else.
        """
        b = self.places.intercepts
        more = np.sqrt(np.broadcast_to(np.asarray(dispersion) - 1.0, self.branches))
        added = self.intercept_covariance() * np.outer(more, more)
        whole = self.covariance.copy()
        whole[:, b, b] += added
        return whole, added


def collect_rows(
    fleet: FleetMoments, read_out: Array, *, full_scale_a: float, usual_correlation: Array | None = None
) -> tuple[EvidenceRows, Array]:
    """Compute the evidence rows of every vehicle of a fleet from its moments, without bench readings.

    Parameters
    ----------
    fleet : FleetMoments
        Moments of N vehicles.
    read_out : ndarray of shape (M + 1, K)
        Read-out of the fleet model, see :func:`fit_fleet_model`. [A]
    full_scale_a : float
        Full scale of the junction. [A]
    usual_correlation : ndarray of shape (3K, 3K), or None
        Correlation of the rows that is usual in the fleet, as an earlier call returned it; None: the mean over these
        vehicles. The correlation of each vehicle is drawn towards it, as a few blocks say little about it. [1]

    Returns
    -------
    rows : EvidenceRows
        Slopes and intercepts over the fleet model, and the junction law; without bench readings.
    usual_correlation : ndarray of shape (3K, 3K)
        The argument, or the mean over these vehicles. [1]
    """
    M, K, N = fleet.inputs, fleet.branches, len(fleet)
    R = 2 * K - 1  # number of slopes and gain ratios: the first of the rows that are measured, before b and c
    fits = [*regress_on_fleet(fleet, read_out), junction_regression(fleet)]
    influence = np.concatenate([fit.influence for fit in fits], axis=1)
    covariance = fleet.blocks.total(influence[:, :, None] * influence[:, None, :])
    for k, fit in enumerate(fits):
        part = slice(2 * k, 2 * k + fit.estimate.shape[1])
        covariance[:, part, part] += fit.prior_covariance
    # from (a_1, b_1 .. a_K, b_K, g_2 .. g_K, c) to (a, -g, b, c), the latter two over full scale
    order = np.array([*range(0, 2 * K, 2), *range(2 * K, 3 * K - 1), *range(1, 2 * K, 2), 3 * K - 1])
    unit = np.concatenate([np.ones(K), -np.ones(K - 1), np.full(K + 1, 1.0 / full_scale_a)])
    values = np.concatenate([fit.estimate for fit in fits], axis=1)[:, order] * unit
    covariance = covariance[:, order[:, None], order] * np.outer(unit, unit)
    inputs = fleet.mean[:, -1, [*range(M), -1]]
    model_a = products(np.broadcast_to(read_out.T, (N, K, M + 1)), inputs)
    means = np.stack([model_a, fleet.mean_a], axis=1) / full_scale_a

    # Correlations are smoothed for the constants at the means (M10): at zero they depend on how far away the means
    # are, and no average over vehicles would respect that.
    to_means = np.zeros((N, K + 1, R))
    to_means[:, range(K), range(K)] = means[:, 0]
    to_means[:, K, K:] = -means[:, 1, 1:]
    covariance = _shifted(covariance, to_means, first=R)
    blocks = fleet.blocks.count[:, None, None]
    covariance[blocks[:, 0, 0] < FEWEST_BLOCKS] = UNKNOWN_VARIANCE * np.eye(3 * K)
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))  # below 0 is rounding
    safe_sd = np.where(sd > 0.0, sd, np.inf)
    own = covariance / (safe_sd[:, :, None] * safe_sd[:, None, :])
    usual = own.mean(axis=0) if usual_correlation is None else usual_correlation
    correlation = (blocks * own + FLEET_BLOCKS * usual) / (blocks + FLEET_BLOCKS)
    correlation[:, range(3 * K), range(3 * K)] = 1.0
    covariance = correlation * sd[:, :, None] * sd[:, None, :]

    # Logarithms of the ratios, constants as seen in true currents. An unknown ratio becomes 1; its constant pivots.
    ratios, constant = values[:, :R], values[:, R:]
    sure = sd[:, :R] < MOST_RELATIVE_SD * np.maximum(ratios, LEAST_SURE_GAIN)
    dead = sure & (np.abs(ratios) < LEAST_SURE_GAIN)
    known = (ratios > LEAST_GAIN) | (sure & (ratios > -LEAST_SURE_GAIN))
    safe = np.where(known, np.maximum(ratios, LEAST_SURE_GAIN), 1.0)
    constant = constant + products(to_means, ratios - safe)
    per_unit = np.concatenate([1.0 / safe, 1.0 / safe[:, :K], 1.0 / safe[:, :1]], axis=1)
    covariance = covariance * per_unit[:, :, None] * per_unit[:, None, :]
    covariance += np.diag(np.repeat(LEAST_SD, [R, K + 1]) ** 2)
    covariance[:, range(R), range(R)] += DEAD_SD**2 * dead
    vehicle, row = np.nonzero(~known)
    covariance[vehicle, row, :], covariance[vehicle, :, row] = 0.0, 0.0
    covariance[vehicle, row, row] = UNKNOWN_VARIANCE

    unread = np.zeros((N, K))
    everything = np.concatenate([np.log(safe), unread, constant, unread], axis=1)
    whole = np.tile(np.diag(np.full(5 * K, UNKNOWN_VARIANCE)), (N, 1, 1))
    place = RowPlaces(K).measured
    whole[:, place[:, None], place] = _shifted(covariance, _pivot(means, everything), first=R)
    return EvidenceRows(values=everything, covariance=whole, means=means), usual


def _pivot(means: Array, values: Array) -> Array:
    """Return by how much b and c, in true currents, change per error of log a and log(-g), shape (N, K + 1, 2K - 1)."""
    N, _, K = means.shape
    pivot = np.zeros((N, K + 1, 2 * K - 1))
    pivot[:, range(K), range(K)] = -means[:, 0]
    pivot[:, K, K:] = means[:, 1, 1:] * np.exp(-values[:, 1:K])  # -g_k / (1 + d_1) = 1 / (1 + d_k), about 1 / a_k
    return pivot


def _shifted(covariance: Array, by: Array, *, first: int) -> Array:
    """Return the covariance of variables x after x[first : first + c] += by @ x[:r], with ``by`` of shape (N, c, r)."""
    jacobian = np.tile(np.eye(covariance.shape[-1]), (len(covariance), 1, 1))
    jacobian[:, first : first + by.shape[1], : by.shape[2]] += by
    return np.asarray(jacobian @ covariance @ np.swapaxes(jacobian, 1, 2))


def row_design(branches: int, feed: int) -> Array:
    """Build the matrix that turns a vehicle's fault parameters into its rows, with constants in true currents.

    Parameters
    ----------
    branches : int
        Number of branches K.
    feed : int
        Branch that carries a load without a sensor, counted from 0.

    Returns
    -------
    ndarray of shape (5K, 3K + 1)
        Rows as :class:`RowPlaces`, columns as :class:`ParameterPlaces` names them. [1]
    """
    K, row, column = branches, RowPlaces(branches), ParameterPlaces(branches)
    design = np.zeros((5 * K, 3 * K + 1))
    design[row.slopes, column.eta] = 1.0
    design[row.slopes, column.gains] = design[row.gain_reads, column.gains] = np.eye(K)
    design[row.ratios, column.gains] = np.hstack([np.ones((K - 1, 1)), -np.eye(K - 1)])
    design[row.intercepts, column.hardware_offsets] = np.vstack([np.eye(K - 1), -np.ones((1, K - 1))])
    design[row.intercepts, column.offsets] = design[row.offset_reads, column.offsets] = np.eye(K)
    design[row.junction, column.offsets] = 1.0
    design[[row.intercept(feed), row.junction], column.load] = 1.0
    return design


def evidence_names(branches: Sequence[str]) -> list[str]:
    """Return a readable name for each of the 5K rows, such as "slope battery" or "gain ratio battery / motor".

    Parameters
    ----------
    branches : sequence of str
        The K branches; the first is the one whose current varies most, for which the junction law is solved.

    Returns
    -------
    list of str
        K slopes, K - 1 gain ratios and K gain readings [1]; then K intercepts, the junction constant and K offset
        readings [A].
    """
    first = branches[0]
    return [
        *(f"slope {name}" for name in branches),
        *(f"gain ratio {first} / {name}" for name in branches[1:]),
        *(f"gain read {name}" for name in branches),
        *(f"intercept {name}" for name in branches),
        "junction constant",
        *(f"offset read {name}" for name in branches),
    ]
