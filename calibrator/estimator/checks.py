"""Check whether the best explanation fits each vehicle: find what no gain error and no offset of a sensor explains.

The junction law is regressed once more on the vehicle's own data for each cause that is not linear, with a further
column: a curve over the level of a current, or gains that change with time or temperature. The remaining residual shows
noise and loads that switch. The fleet shows how large misfit and noise usually are. The junction law shows that
something is wrong; the fleet model shows in which sensor.
Equations: (M22) to (M25) of docs/method.md, section "Does the best explanation fit?".
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import t as student_t

from calibrator.drive import Array
from calibrator.estimator.evidence import MOST_NOISE, NOISE_ROUNDS, products, stack_summaries
from calibrator.summaries.moments import DriveSummary
from ecu_node.parameters import SensorFinding
from ecu_node.summary import MAD_TO_SD

__all__ = ["UsualMisfits", "find_misfits", "learn_usual_misfits"]

PRIOR = 0.01
"""Probability of each cause in a vehicle, before anything is seen. [1]"""
LEAST_PROBABILITY = 0.5
"""Probability from which on a cause is reported as a finding. [1]"""
NAMED = 0.9
"""Probability from which on one sensor is named. [1]"""
TAIL = 12.0
"""Degrees of freedom of Student's t, by which usual misfits are distributed over vehicles: heavy tails. [1]"""
LEAST_MISFIT = 1e-5
"""Least value of the usual misfit of a fleet, in fractions of full scale: a smaller one harms no correction. [1]"""
LEAST_FOLLOWS, MOST_FOLLOWS = 2e-4, 0.05
"""Least scale of what sensors usually show of another branch's current, over full scale; and its share of that current
from which on no sensor is said to show one: errors of the fleet model look the same. [1]"""
AS_MUCH = 0.99
"""Share of the largest variance from which on a branch moves as much as the one that moves most. [1]"""
LARGEST_MISFIT = 0.2
"""Largest misfit, in fractions of full scale; before anything is seen, its size is log-uniform up to it. [1]"""
EXPLAINED = 0.7
"""Share of the unusual residual that a cause has to explain; if it explains less and what is left is unusual, too,
switching is reported instead. [1]"""
LEAST_NOISE_SPREAD = 0.2
"""Least spread over healthy vehicles of the logarithm of the mean square residual. [1]"""
NOISE_RANGE = 9.0
"""The logarithm of the mean square residual of a vehicle with noise is uniform over a range of this width. [1]"""
FEWEST = 30
"""Least number of samples beyond a bend (current at which a gain changes) for it to be considered. [1]"""
CLIPPED = 0.55
"""Share of the gain that is lost beyond a bend, from which on the sensor counts as clipped. [1]"""
OVERSHOOT = 1.3
"""Without a fleet, a sensor counts as clipped at a bend only if some sensor never reads this multiple of the bend's
current, and another one does. [1]"""
CHANCE = 0.3
"""Correlation by chance between the fleet model and its errors in one vehicle. [1]"""
GAIN_SD, DEAD_SD = 0.3, 0.04
"""Standard deviation of the gains of running sensors about 1 or -1, and of dead ones about 0. [1]"""
MOVING = 0.02
"""Least standard deviation of a current whose level is used, in fractions of full scale: smaller ones are noise. [1]"""
NEAR_ZERO = 0.07
"""A bend at a current below this, in fractions of full scale, counts as a gain that differs by sign: the zero is not
known better. [1]"""
SPIKE_RATE = 5e-4
"""Least value of the usual share of spikes among the samples. [1]"""
NOISE_RATE = 0.015
"""Share of spikes among the samples above which spikes to both sides count as noise. [1]"""
ONE_SIDED = 0.1
"""Share of spikes in the rarer direction up to which they count as one-sided. [1]"""
WARMING_K = 2.0
"""Least standard deviation of the temperature in a drive for its effect to be considered. [K]"""
RIDGE = 1e-10
"""Added to the diagonal of normalised moments: a branch that stands still gets no gain. [1]"""
TINY = 1e-12
"""Replaces zero in denominators."""
LEAST_STRETCH = 0.1
"""Least factor 1 - b h'(y) that counts in :meth:`_Checked._by_level`: a lower one means another, clipped sensor. [1]"""
ALONE = 1e-6
"""A column is used if gains and offsets leave at least this share of its square unexplained. [1]"""
WHITE_GAIN = 1.5
"""Variance of the second difference of white noise of variance 1."""
SHARE_SD = 0.15
"""Standard deviation of the share of a misfit that is found in the branch that has it, even with an exact model. [1]"""

BENDS_A: Array = np.array(
    [10.0, 15, 20, 25, 30, 37, 45, 55, 65, 77, 90, 105, 120, 140, 160, 185, 210, 245, 280, 325, 370, 430, 500]
)
"""Currents at which a gain may change, two per level (bin of a current, by which summaries keep sums); below them noise
decides which level a sample is in. They are absolute, as the levels are: summaries know no full scale. [A]"""
CAUSES = ("quadratic", "cubic", "sign", "bend", "step", "ramp", "temperature")
"""Causes that are columns or splits of the junction law; a bend is a clipped or a saturating sensor."""


@dataclass(frozen=True, kw_only=True)
class UsualMisfits:
    """How far vehicles of a fleet usually are from having linear sensors: the null hypothesis of every check.

    Attributes
    ----------
    misfit_a : ndarray of shape (C,)
        Scale of the misfit of each of the C :data:`CAUSES`. [A]
    residual_a2, fast_a2 : float
        Mean square residual of the junction law, and its white part. [A^2]
    residual_spread : float
        Spread over the vehicles of the logarithm of ``residual_a2``. [1]
    slope_spread, model_error_a : ndarray of shape (K,)
        Robust standard deviation over vehicles of the slopes over the fleet model [1], and median standard deviation of
        the currents about it [A].
    other : ndarray of int of shape (K,)
        For each branch k, the number of the other branch whose modelled current varies most apart from what that of k
        explains.
    follows, follows_a : ndarray of shape (K,)
        Share of the current of branch ``other`` that a sensor shows in addition to its own, as the median of the
        vehicles [1], and how far from this vehicles usually are [A].
    spike_rate : float
        Share of samples that are spikes. [1]
    """

    misfit_a: Array
    residual_a2: float
    fast_a2: float
    residual_spread: float
    slope_spread: Array
    model_error_a: Array
    other: NDArray[np.intp]
    follows: Array
    follows_a: Array
    spike_rate: float


class _Checked:
    """Checks of N vehicles with fit sums: junction law, currents over the fleet model, and what each cause explains.

    The residual of the law is r = y - g^T z: y the branch whose current varies most, z the others and 1. B blocks, M
    inputs, K branches, p = M + K + 1 columns (inputs, currents, 1), L levels of a current, C causes.

    Attributes
    ----------
    fleet : FleetMoments
        Moments of the vehicles.
    fast, levels : ndarray of shape (N, K, K), (N, K, L, p + 1)
        Sums of products of second differences of the currents [A^2]; per level of each current, sums of the columns and
        of that current's square over its samples.
    total : ndarray of shape (N, p, p)
        Moments of (inputs, measured currents, 1) of all blocks of a vehicle.
    samples : ndarray of shape (N,)
        Number of samples.
    y, z : int, ndarray of int of shape (K,)
        Places of y and z in the moments.
    law, weights : ndarray of shape (N, K)
        g: gain ratios and constant [A]; weight of each branch in r [1].
    noise : ndarray of shape (N, K)
        Noise variance of each branch times its g: noise lowers the mean product of the current with r by this; 0 for y.
        [A^2]
    with_z : ndarray of shape (B, K)
        Sums of z r, with the effect of the noise of z taken out.
    square_a2, n_eff : ndarray of shape (N,)
        Sum of r^2 [A^2], effective number of independent samples.
    columns, basis : ndarray of shape (M + 1,), (K, M + 1, 2)
        Places of the inputs and of 1 in the moments; coefficients over these of the fleet model's current and of 1.
    model_gram, model_right : ndarray of shape (N, K, 2, 2), (N, K, 2)
        Normal equations of each current over the fleet model's and 1.
    slope, slope_sd, zero_a : ndarray of shape (N, K)
        Slope over the model and its standard deviation [1], reading at zero current of the model [A].
    variance_a2 : ndarray of shape (N, K)
        Variance of the residual over the model times the number of neighbouring samples that are alike. [A^2]
    moves_a, error_a : ndarray of shape (N, K)
        Standard deviations of the model and of the residual over it. [A]
    other : ndarray of int of shape (K,)
        For each branch, the other one whose fleet model moves most besides.
    follows, sum_follows, other_a : ndarray of shape (N, K)
        Share of that model which each current shows beside its own, and which the sum of the currents shows [1]; root
        mean square of that model beyond what goes with its own [A].
    fit : ndarray of shape (N, C)
        Log likelihood of each of :data:`CAUSES` relative to linear sensors, less a penalty for its parameters.
    size, place : ndarray of shape (N, C)
        Size of causes by level: error at full scale, or change of the gain [1]. Place: level at which a bend begins
        [A], share of the time before a step [1], standard deviation of a temperature [K].
    level_branch : ndarray of int of shape (N, C)
        Branch on whose level the cause depends; -1 for causes by time.
    branch_fit : ndarray of shape (N, C, K)
        Log likelihood that the sensor of branch k has the cause, by the fleet model; 0 without a fleet.
    misfit_a : ndarray of shape (N, C)
        Root mean square of what each cause explains beyond gains and offsets. [A]
    residual_a2 : ndarray of shape (N, C + 1)
        Mean square residual of the junction law with each cause, and with none (last). [A^2]
    fast_a2 : ndarray of shape (N,)
        White part of the mean square residual. [A^2]
    noise_share : ndarray of shape (N, K)
        Share of each sensor in the fast part of the residual. [1]
    spikes : ndarray of shape (N, K, 2)
        Share of samples that are upward and downward spikes. [1]
    """

    def __init__(
        self,
        summaries: Sequence[DriveSummary],
        read_out: Array,
        full_scale_a: float,
        other: NDArray[np.intp] | None = None,
    ) -> None:
        self.fleet, self.full_scale_a, self.has_fleet = stack_summaries(summaries), full_scale_a, len(read_out) > 1
        fits = [summary.fit for summary in summaries if summary.fit is not None]
        self.fast = np.stack([fit.fast_a2.sum(axis=0) for fit in fits])
        self.levels = np.stack([fit.levels for fit in fits])
        self.total = self.fleet.blocks.total(self.fleet.moments)
        self.samples = self.total[:, -1, -1]
        self._regress_law()
        self._regress_on_model(read_out)
        self._regress_on_others(read_out, other)
        middle = np.concatenate([np.cumsum(n := s.moments[:, -1, -1]) - n / 2.0 for s in summaries])
        warm_c = np.concatenate([fit.temperature_c for fit in fits])
        causes = [
            *self._by_level(),
            self._step(),
            self._drifting(middle / self.samples[self.fleet.blocks.vehicle], least=0.0),
            self._drifting(warm_c, least=WARMING_K),
        ]
        stacked = [np.stack(part, axis=1) for part in zip(*causes, strict=True)]
        explained_a2, self.fit, self.size, self.place, self.level_branch, self.branch_fit = stacked
        samples, weights = self.samples, self.weights
        unit = np.sqrt((weights**2).mean(axis=1))  # so gain errors of the branches do not scale the residual
        fast_sum = np.einsum("nkl,nl->nk", self.fast, weights)
        white = np.einsum("nk,nk->n", weights, fast_sum)
        left = np.maximum(self.square_a2[:, None] - np.column_stack([explained_a2, np.zeros(len(unit))]), 0.0)
        self.misfit_a = np.sqrt(explained_a2 / samples[:, None]) / unit[:, None]
        self.residual_a2 = left / (samples * unit**2)[:, None]
        self.fast_a2 = white / (WHITE_GAIN * samples * unit**2)
        self.noise_share = weights * fast_sum / np.maximum(white, TINY)[:, None]
        self.spikes = np.stack([fit.spikes.sum(axis=0) for fit in fits]) / samples[:, None, None]

    def _regress_law(self) -> None:
        """Regress the junction law of each vehicle.

        The noise of z would bias g towards zero, so it is taken out of the moments. Noise makes fast changes that the
        junction law does not balance: with the fast part q_l of each current and q = sum w_l q_l that of the residual,
        white noise of variance n_k in current k gives E[q_k q] = 1.5 n_k w_k.
        """
        fleet, total, samples = self.fleet, self.total, self.samples
        M, K, blocks, variance_a2 = fleet.inputs, fleet.branches, fleet.blocks, fleet.variance_a2
        self.y = y = M + int(np.argmax(np.median(variance_a2, axis=0)))
        self.z = z = np.array([i for i in range(M, M + K + 1) if i != y])
        others = z[:-1] - M
        noise, self.weights = np.zeros((len(fleet), K)), np.ones((len(fleet), K))
        for _ in range(NOISE_ROUNDS):
            clean = total[:, z[:, None], z]
            clean[:, range(K), range(K)] -= samples[:, None] * noise
            law = _solve(clean, total[:, z, y])
            self.weights[:, others] = -law[:, :-1]
            fast = np.einsum("nkl,nl->nk", self.fast, self.weights)[:, others]
            unbalanced = fast / -np.where(law[:, :-1], law[:, :-1], 1.0) / (WHITE_GAIN * samples[:, None])
            noise[:, :-1] = np.clip(unbalanced, 0.0, MOST_NOISE * variance_a2[:, others])
        sums = np.column_stack([self.weights, -law[:, -1]])[blocks.vehicle]
        scores = products(fleet.moments[:, M:, M:], sums)  # of (measured currents, 1) with r
        own = fleet.moments[:, -1, -1]
        squares = blocks.total(_dot(scores, sums))
        # Neighbouring samples are alike where sums of r over blocks scatter more than those of white noise would.
        scatter = blocks.total(scores[:, -1] ** 2 / own) / blocks.count
        repeated = max(float(np.median(scatter / np.maximum(squares / samples, TINY))), 1.0)
        # In a block in which a current stands still it has no noise.
        varies = np.diagonal(fleet.moments, axis1=1, axis2=2)[:, z] - fleet.moments[:, z, -1] ** 2 / own[:, None]
        noisy = np.clip(varies, 0.0, own[:, None] * noise[blocks.vehicle])
        noisy *= (samples[:, None] * noise / np.maximum(blocks.total(noisy), TINY))[blocks.vehicle]
        self.law, self.noise = law, np.insert((noise * law)[:, :-1], y - M, 0.0, axis=1)
        self.with_z = scores[:, z - M] + noisy * law[blocks.vehicle]
        self.square_a2, self.n_eff = np.maximum(squares, TINY), samples / repeated

    def _regress_on_model(self, read_out: Array) -> None:
        """Regress each measured current on the fleet model's and 1."""
        fleet, total = self.fleet, self.total
        M, K, blocks = fleet.inputs, fleet.branches, fleet.blocks
        self.columns = columns = np.array([*range(M), M + K])
        self.basis = basis = np.stack([read_out.T, np.tile(np.eye(M + 1)[-1], (K, 1))], axis=-1)

        def normal_equations(moments: Array) -> tuple[Array, Array]:
            gram = np.swapaxes(basis, 1, 2) @ moments[:, None, columns[:, None], columns] @ basis
            return gram, np.einsum("nmk,kma->nka", moments[:, columns, M:-1], basis)

        (gram, right), (each_gram, each_right) = normal_equations(total), normal_equations(fleet.moments)
        fitted, own = _solve(gram, right), _solve(gram, np.broadcast_to([1.0, 0.0], right.shape))
        left = np.diagonal(total, axis1=1, axis2=2)[:, M:-1] - _dot(fitted, right)
        left = np.maximum(left, TINY) / self.samples[:, None]
        scores = each_right - _dot(each_gram, fitted[blocks.vehicle][:, :, None])
        self.slope_sd = np.sqrt(blocks.total(_dot(scores, own[blocks.vehicle]) ** 2))
        repeated = np.maximum(np.median(self.slope_sd**2 / np.maximum(left * own[..., 0], TINY), axis=0), 1.0)
        determinant = gram[..., 0, 0] * gram[..., 1, 1] - gram[..., 0, 1] ** 2
        self.model_gram, self.model_right = gram, right
        self.slope, self.zero_a = fitted[..., 0], fitted[..., 1]
        self.moves_a = np.sqrt(np.maximum(determinant, 0.0)) / self.samples[:, None]
        self.variance_a2, self.error_a = repeated * left, np.sqrt(left)

    def _regress_on_others(self, read_out: Array, other: NDArray[np.intp] | None) -> None:
        """Regress each current, and the sum of all, on its own fleet model, 1, and the model of another branch.

        ``other`` (K,) are the other branches; None: the one that moves most beside the branch in half of the vehicles.
        """
        N, K, measured = len(self.fleet), self.fleet.branches, slice(self.fleet.inputs, -1)
        models = np.column_stack([read_out, np.eye(len(read_out))[-1]])  # K models and 1
        gram = models.T @ self.total[:, self.columns[:, None], self.columns] @ models
        right = models.T @ self.total[:, self.columns, measured]
        self.other = np.zeros(K, np.intp) if other is None else other
        self.follows, self.sum_follows, self.other_a = np.zeros((3, N, K))
        for k in range(K if self.has_fleet else 0):
            own = [k, K]
            on_own = gram[:, :, own] @ np.linalg.pinv(gram[:, own][:, :, own], hermitian=True)
            left = np.maximum(np.einsum("nll->nl", gram - on_own @ gram[:, own])[:, :K], 0.0)
            if other is None:  # two branches that move alike differ by rounding
                moves = np.median(np.delete(left, k, axis=1), axis=0)
                self.other[k] = np.delete(np.arange(K), k)[np.argmax(moves >= AS_MUCH * moves.max())]
            at = self.other[k]
            shown = np.stack([right[:, :, k], right.sum(axis=2)])
            shared = shown[:, :, at] - np.einsum("na,sna->sn", on_own[:, at], shown[:, :, own])
            self.follows[:, k], self.sum_follows[:, k] = shared / np.maximum(left[:, at], TINY)
            self.other_a[:, k] = np.sqrt(left[:, at] / self.samples)

    def _cause(
        self,
        explained_a2: Array,
        parameters: float,
        *,
        pattern: Array,
        square: Array,
        place: ArrayLike,
        size: ArrayLike = 0.0,
        level_branch: ArrayLike = -1,
        stretch: ArrayLike = 0.0,
    ) -> tuple[Array, ...]:
        """Return how much of the sum of r^2 one cause explains, then its fit, size, place, level_branch, branch_fit.

        The fit is the log likelihood with noise of unknown size, less a penalty for the parameters (BIC). ``pattern``
        (N, p) and ``square`` (N,) are products of the misfit with all columns and with itself; ``stretch`` is the mean
        logarithm of the derivative of a transformed variable.
        """
        explained_a2, N = np.maximum(explained_a2, 0.0), len(explained_a2)
        left = np.maximum(1.0 - explained_a2 / self.square_a2, RIDGE)
        fit = self.n_eff * (np.asarray(stretch) - 0.5 * np.log(left)) - 0.5 * parameters * np.log(self.n_eff)
        size, place, level_branch = (np.broadcast_to(each, N) for each in (size, place, level_branch))
        return explained_a2, fit, size, place, level_branch, self._whose(pattern, square)

    def _whose(self, pattern: Array, square: Array) -> Array:
        """Return the log likelihood that each branch's sensor makes a misfit, shape (N, K).

        The misfit is looked for in each branch's residual over the fleet model: in the branch that has it, all of it is
        found, and in the others nothing.
        """
        if not self.has_fleet:
            return np.zeros_like(self.weights)
        M, K, weights = self.fleet.inputs, self.fleet.branches, self.weights
        cross = np.einsum("nm,kma->nka", pattern[:, self.columns], self.basis)
        base = _solve(self.model_gram, cross)
        alone = np.maximum(square[:, None] - _dot(base, cross), TINY)
        share = weights * (pattern[:, M:-1] - _dot(base, self.model_right)) / alone
        sd = np.hypot(weights * np.sqrt(self.variance_a2 / alone), SHARE_SD)
        off = np.sum(((share[:, None] - np.eye(K)) / sd[:, None]) ** 2, axis=-1)
        return np.asarray(-0.5 * (K - 1) / K * off)  # the shares of all branches add up to one

    @property
    def _of_z(self) -> Array:
        """Moments of all columns with z in each block, shape (B, p, K)."""
        return self.fleet.moments[:, :, self.z]

    @property
    def _gram(self) -> Array:
        """Moments of z with z, shape (N, K, K)."""
        return self.total[:, self.z[:, None], self.z]

    def _by_level(self) -> list[tuple[Array, ...]]:
        """Fit the causes quadratic, cubic, sign and bend: a column h that depends on the level of one of the currents.

        The current in h contains noise n that is in r, too: E[h n] = var(n) E[h'] if it is normal (Stein). In y all
        that z does not explain acts as noise, such as the current of a branch without a sensor: the likelihood of
        y - b h(y) = g^T z has the factor prod |1 - b h'(y)| of a transformed variable, so that a straight h explains
        nothing. In a fleet both are left out, as the effect of noise is part of what is usual.
        """
        fleet, z, levels, full_scale_a, (N, K) = self.fleet, self.z, self.levels, self.full_scale_a, self.zero_a.shape
        count = levels[..., -2]
        x = np.stack([levels[:, k, :, fleet.inputs + k] for k in range(K)], axis=1) / np.maximum(count, 1.0)
        from_zero = x - self.zero_a[:, :, None]
        above, below = (
            np.stack([np.maximum(sign * x - bend, 0.0) for bend in BENDS_A], axis=2) for sign in (1.0, -1.0)
        )
        bent_there = 1.0 * (np.concatenate([above, below, above + below], axis=2) > 0.0)
        shapes = {  # h and its derivative
            "quadratic": ((from_zero**2 / full_scale_a)[:, :, None], (2.0 * from_zero / full_scale_a)[:, :, None]),
            "cubic": ((from_zero**3 / full_scale_a**2)[:, :, None], (3.0 * from_zero**2 / full_scale_a**2)[:, :, None]),
            "sign": (np.maximum(from_zero, 0.0)[:, :, None], 1.0 * (from_zero > 0.0)[:, :, None]),
            "bend": (np.concatenate([above, -below, above - below], axis=2), bent_there),
        }
        moving = fleet.variance_a2[:, :, None] > (MOVING * full_scale_a) ** 2
        reach_a = np.max(np.abs(x) * (count >= FEWEST), axis=2)
        least_a = np.min(reach_a, axis=1, where=moving[..., 0], initial=np.inf)[:, None, None]
        greatest_a = np.max(reach_a, axis=1)[:, None, None]
        gram, found, own = self._gram[:, None, None], [], self.y - fleet.inputs
        for cause, (h, slope) in shapes.items():  # (N, K, S, L), constant within a level
            bent = cause == "bend"
            with_all = np.einsum("nksl,nkli->nksi", h, levels[..., :-1])
            square = np.einsum("nksl,nkl->nks", h**2, count)
            alone = square - _dot(_solve(gram, with_all[..., z]), with_all[..., z])
            with_r = with_all[..., self.y] - np.einsum("nksi,ni->nks", with_all[..., z], self.law)
            if not self.has_fleet:
                # If a current is switched between two levels, noise moves no sample to another level, as levels are
                # wide. So the product with r is taken with or without the noise's part, whichever is nearer to 0; it is
                # 0 if the two differ in sign.
                sign = np.sign(with_r)
                clean = with_r + self.noise[:, :, None] * np.einsum("nksl,nkl->nks", slope, count)
                with_r = sign * np.clip(sign * clean, 0.0, np.abs(with_r))
            beyond = np.einsum("nksl,nkl->nks", h != 0.0, count)
            usable = moving & (alone > ALONE * square) & (beyond >= FEWEST)
            size = np.where(usable, with_r, 0.0) / np.where(usable, alone, 1.0)
            stretch = np.zeros(size.shape)
            if not self.has_fleet:
                if bent:  # a clipped sensor reads no more than this, others do; else it is a ramp's delay
                    beyond_a = OVERSHOOT * np.tile(BENDS_A, 3)
                    reached = (least_a <= beyond_a) & (beyond_a <= greatest_a)
                    size = np.where((abs(size) < CLIPPED) | reached, size, 0.0)
                factor = np.maximum(np.abs(1.0 - size[:, own, :, None] * slope[:, own]), LEAST_STRETCH)
                stretch[:, own] = np.minimum(np.einsum("nsl,nl->ns", np.log(factor), count[:, own]), 0.0)
                stretch /= self.samples[:, None, None]
            explained_a2 = size * with_r
            left = 1.0 - explained_a2 / self.square_a2[:, None, None]
            best = (stretch - 0.5 * np.log(np.maximum(left, RIDGE))).reshape(N, -1).argmax(axis=1)
            at = (np.arange(N), *np.unravel_index(best, size.shape[1:]))
            weight = self.weights[at[:2]]
            found.append(
                self._cause(
                    explained_a2[at],
                    2.0 if bent else 1.0,
                    pattern=with_all[at] * size[at][:, None],
                    square=square[at] * size[at] ** 2,
                    place=BENDS_A[at[2] % len(BENDS_A)] if bent else 0.0,
                    size=size[at] / np.where(weight, weight, 1.0),
                    level_branch=at[1],
                    stretch=stretch[at],
                )
            )
        return found

    def _step(self) -> tuple[Array, ...]:
        """Fit a step: another junction law from some block on; the block of the change has a law of its own."""
        z, blocks, gram, right = self.z, self.fleet.blocks, self._of_z[:, self.z], self.with_z
        last = np.cumsum(blocks.count)
        first, vehicle = last - blocks.count, blocks.vehicle

        def before(values: Array) -> Array:
            """Sum over the earlier blocks of the same vehicle."""
            sums = np.cumsum(values, axis=0) - values
            return np.asarray(sums - sums[first][vehicle])

        earlier = before(gram), before(right)
        later = self._gram[vehicle] - earlier[0] - gram, blocks.total(right)[vehicle] - earlier[1] - right
        parts = (earlier, (gram, right), later)
        laws = [_solve(*part) for part in parts]
        number = np.arange(len(vehicle)) - first[vehicle]
        inside = (number >= 2) & (number <= blocks.count[vehicle] - 3)
        explained_a2 = np.where(inside, sum(_dot(law, part[1]) for law, part in zip(laws, parts, strict=True)), 0.0)
        best = np.array([a + np.argmax(explained_a2[a:b]) for a, b in zip(first, last, strict=True)])
        change = laws[2][best] - laws[0][best]
        late = blocks.total(self._of_z * (np.arange(len(vehicle)) > best[vehicle])[:, None, None])
        return self._cause(
            explained_a2[best],
            len(z) + 2.0,
            pattern=np.einsum("nij,nj->ni", late, change),
            square=np.einsum("ni,nij,nj->n", change, late[:, z], change),
            place=(earlier[0][best, -1, -1] + 0.5 * gram[best, -1, -1]) / self.samples,
        )

    def _drifting(self, course: Array, *, least: float) -> tuple[Array, ...]:
        """Fit a law that changes in proportion to a course (B,), such as time or temperature; NaN where not known.

        Vehicles in which the course has a standard deviation up to ``least`` are left out.
        """
        z, blocks, own = self.z, self.fleet.blocks, self.fleet.moments[:, -1, -1]
        known = np.isfinite(course)
        course = np.where(known, course, 0.0)
        course = course - (blocks.total(course * own) / self.samples)[blocks.vehicle]
        deviation = np.sqrt(blocks.total(course**2 * own) / self.samples)
        usable = (deviation > least) & (blocks.total(known * 1.0) == blocks.count)
        first = blocks.total(course[:, None, None] * self._of_z)
        second = blocks.total(course[:, None, None] ** 2 * self._of_z[:, z])
        gram = np.block([[self._gram, first[:, z]], [first[:, z], second]])
        right = blocks.total(np.column_stack([self.with_z, course[:, None] * self.with_z]))
        fitted = _solve(gram, right)
        change = np.where(usable[:, None], fitted[:, len(z) :], 0.0)
        return self._cause(
            np.where(usable, _dot(fitted, right), 0.0),
            len(z),
            pattern=np.einsum("nij,nj->ni", first, change),
            square=np.einsum("ni,nij,nj->n", change, second, change),
            place=deviation,
        )

    def of_slopes(self, usual: UsualMisfits) -> tuple[Array, Array]:
        """Return the probabilities that each sensor is inverted, and that it is dead, each of shape (N, K)."""

        def density(about: float, sd: Array) -> Array:
            return np.asarray(np.exp(-0.5 * ((self.slope - about) / sd) ** 2) / sd)

        # Errors of the model may correlate with it by chance, and hide it where the current hardly moves.
        chance = CHANCE * usual.model_error_a / np.maximum(self.moves_a, TINY)
        sd = np.hypot(self.slope_sd, np.minimum(chance, 100.0))
        wide = np.hypot(np.hypot(GAIN_SD, usual.slope_spread), sd)
        inverted, dead = PRIOR * density(-1.0, wide), PRIOR * density(0.0, np.hypot(DEAD_SD, sd))
        whole = (1.0 - PRIOR) * density(1.0, wide) + inverted + dead + TINY
        return inverted / whole, dead / whole


def _solve(gram: Array, right: Array) -> Array:
    """Solve normal equations (..., q, q), (..., q); return (..., q)."""
    scale = np.sqrt(np.maximum(np.diagonal(gram, axis1=-2, axis2=-1), TINY))
    normal = gram / scale[..., :, None] / scale[..., None, :] + RIDGE * np.eye(gram.shape[-1])
    return np.asarray(np.linalg.solve(normal, (right / scale)[..., None])[..., 0] / scale)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))


def learn_usual_misfits(
    summaries: Sequence[DriveSummary], read_out: Array, *, full_scale_a: float
) -> UsualMisfits | None:
    """Learn from a fleet how vehicles usually differ from linear sensors.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        Summaries of the vehicles to learn from, most of them with linear sensors.
    read_out : ndarray of shape (M + 1, K)
        Read-out of the fleet model, its branches in the order of the summaries. [A]
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    UsualMisfits or None
        Medians: a fault in less than half of the vehicles does not move them far. None if no vehicle has fit sums.
    """
    known = [summary for summary in summaries if summary.fit is not None]
    if not known:
        return None
    found = _Checked(known, read_out, full_scale_a)
    left = np.log(np.maximum(found.residual_a2[:, -1], TINY))
    centre = np.median(left)
    follows = np.median(found.follows, axis=0)
    apart_a = np.abs(found.follows - follows) * found.other_a
    return UsualMisfits(
        # The size of a misfit has half of a symmetric distribution, whose median is 0.67 standard deviations.
        misfit_a=np.maximum(MAD_TO_SD * np.median(found.misfit_a, axis=0), LEAST_MISFIT * full_scale_a),
        residual_a2=float(np.exp(centre)),
        fast_a2=float(np.median(found.fast_a2)),
        residual_spread=max(MAD_TO_SD * float(np.median(np.abs(left - centre))), LEAST_NOISE_SPREAD),
        slope_spread=MAD_TO_SD * np.median(np.abs(found.slope - np.median(found.slope, axis=0)), axis=0),
        model_error_a=np.median(found.error_a, axis=0),
        other=found.other,
        follows=follows,
        follows_a=np.maximum(MAD_TO_SD * np.median(apart_a, axis=0), LEAST_FOLLOWS * full_scale_a),
        spike_rate=max(float(np.median(found.spikes.sum(axis=2))), SPIKE_RATE),
    )


def find_misfits(
    summaries: Sequence[DriveSummary],
    read_out: Array,
    usual: UsualMisfits | None,
    *,
    full_scale_a: float,
    branches: Sequence[str],
) -> list[tuple[SensorFinding, ...]]:
    """Find in each vehicle, by itself, what gain errors and offsets of its sensors do not explain.

    Parameters
    ----------
    summaries : sequence of N DriveSummary
        Summaries of the vehicles; one without fit sums has no findings.
    read_out : ndarray of shape (M + 1, K)
        Read-out of the fleet model, its branches in the order of the summaries; zeros of shape (1, K) without one. [A]
    usual : UsualMisfits or None
        Usual misfits of the fleet; None: nothing is found.
    full_scale_a : float
        Full scale of the junction. [A]
    branches : sequence of str
        Names of the K branches.

    Returns
    -------
    list of N tuples of SensorFinding
        By falling probability; causes are ``inverted``, ``dead``, ``follows``, ``clipped``, ``saturating``,
        ``quadratic``, ``cubic``, ``sign``, ``step``, ``ramp``, ``temperature``, ``spikes``, ``outliers``, ``noise`` and
        ``switching``.
        No branch is named where the evidence does not tell which sensor it is, or the cause is not a sensor.
    """
    found: list[tuple[SensorFinding, ...]] = [()] * len(summaries)
    places = [j for j, summary in enumerate(summaries) if summary.fit is not None]
    if usual is None or not places:
        return found
    misfits = _Checked([summaries[j] for j in places], read_out, full_scale_a, usual.other)
    # Where there is more noise than usual, larger misfits come by chance.
    noisier = np.sqrt(np.maximum(misfits.residual_a2[:, :-1] / usual.residual_a2, 1.0))
    shape = _probability(misfits.misfit_a, usual.misfit_a * noisier, LARGEST_MISFIT * full_scale_a)
    above = np.log(np.maximum(misfits.residual_a2, TINY) / usual.residual_a2) / usual.residual_spread
    factor = usual.residual_spread / (NOISE_RANGE * np.maximum(student_t.pdf(above, TAIL), TINY))
    unusual = np.where(above > 0.0, _posterior(PRIOR * factor), 0.0)
    inverted, dead = misfits.of_slopes(usual)
    # A load that grows with another current leaves the sum as it is, so only what the sum shows, too, is the sensor's.
    apart = misfits.follows - usual.follows
    by_sensor = np.minimum(np.abs(apart), np.maximum(misfits.sum_follows * np.sign(apart), 0.0))
    follows_a = by_sensor * misfits.other_a
    # Where more than usual is left of a current, larger shares come by chance.
    rest_a = np.sqrt(np.maximum(misfits.error_a**2 - follows_a**2, 0.0))
    usual_a = usual.follows_a * np.maximum(rest_a / np.maximum(usual.model_error_a, TINY), 1.0)
    follows = _probability(follows_a, usual_a, LARGEST_MISFIT * full_scale_a)
    follows[usual_a > MOST_FOLLOWS * misfits.other_a] = 0.0
    for i, j in enumerate(places):
        vehicle = _Vehicle(misfits, usual, i, branches)
        mine = vehicle.of_slopes(inverted[i], dead[i]) + vehicle.of_others(follows[i])
        if not any(each.cause == "dead" for each in mine):  # without its current the junction law tells nothing
            mine += vehicle.of_law(shape[i], unusual[i])
            clipped = {each.branch for each in mine if each.cause == "clipped"}
            # Beyond the range of a clipped sensor the peaks of the other branches look like spikes.
            mine += [each for each in vehicle.of_spikes() if not clipped or each.branch in clipped]
        found[j] = tuple(sorted(mine, key=lambda each: -each.probability))
    return found


def _posterior(odds: ArrayLike) -> Array:
    """Return the probability of a cause, given :data:`PRIOR` times its likelihood ratio."""
    return 1.0 - (1.0 - PRIOR) / (1.0 - PRIOR + np.asarray(odds, np.float64))


def _probability(misfit_a: Array, usual_a: Array, largest_a: float) -> Array:
    """Return the probability that a misfit is unusual.

    Sizes of unusual misfits are log-uniform, those of usual ones have half a Student's t distribution.
    """
    z = np.maximum(misfit_a / usual_a, 1.0)
    alternative = 1.0 / (z * np.log(np.maximum(largest_a / usual_a, math.e)))
    return _posterior(PRIOR * alternative / np.maximum(2.0 * student_t.pdf(z, TAIL), 1e-300))


def _finding(branch: str | None, cause: str, probability: float, text: str) -> SensorFinding:
    # Rounded, as vehicles that are checked together change the last digits.
    return SensorFinding(branch=branch, cause=cause, probability=min(round(float(probability), 4), 1.0), text=text)


def _who(name: str | None) -> str:
    return f"sensor {name}" if name is not None else "one of the sensors, it is not known which"


class _Vehicle(NamedTuple):
    """One vehicle, number j of those checked; the methods put what is found in it into words."""

    misfits: _Checked
    usual: UsualMisfits
    j: int
    branches: Sequence[str]

    def of_slopes(self, inverted: Array, dead: Array) -> list[SensorFinding]:
        """Report sensors that are inverted or dead, by their slope over the fleet model."""
        found, slope, mean_a = [], self.misfits.slope[self.j], self.misfits.fleet.mean_a[self.j]
        for k, name in enumerate(self.branches):
            reversed_ = (
                f"reads with the wrong sign, {slope[k]:+.2f} A per ampere of the fleet's; turn it round, or correct "
            )
            stays = f"does not follow the current, it stays near {mean_a[k]:.1f} A; check it, its plug and its supply"
            for cause, probability, text in (
                ("inverted", inverted[k], reversed_ + "its signal's sign"),
                ("dead", dead[k], stays),
            ):
                if probability >= LEAST_PROBABILITY:
                    found.append(_finding(name, cause, probability, f"sensor {name} {text}"))
        return found

    def of_others(self, follows: Array) -> list[SensorFinding]:
        """Report sensors that show a share of another branch's current, by the probability of each, shape (K,)."""
        found, shares = [], 100.0 * (self.misfits.follows[self.j] - self.usual.follows)
        for name, other, probability, share in zip(self.branches, self.usual.other, follows, shares, strict=True):
            if probability >= LEAST_PROBABILITY:
                text = (
                    f"sensor {name} shows {share:+.1f} % of the current of {self.branches[other]}, too: a stray field?"
                )
                found.append(_finding(name, "follows", probability, text))
        return found

    def of_law(self, shape: Array, unusual: Array) -> list[SensorFinding]:
        """Report the cause that explains most of the junction law's residual; noise or switching if too much is left.

        Probabilities: ``shape`` (C,) that each misfit is unusual, ``unusual`` (C + 1,) that :attr:`residual_a2` is.
        """
        misfits, usual, j = self.misfits, self.usual, self.j
        fit, level, left = misfits.fit[j], misfits.level_branch[j], misfits.residual_a2[j]
        c = int(fit.argmax())
        weight = np.exp(fit - fit[c])
        alike = level == level[c] if level[c] >= 0 else fit == fit[c]  # the shapes of one curve are one cause
        share = weight[alike].sum() / weight.sum()
        probability = float(shape[c] * share) if fit[c] > 0.0 else 0.0
        at = c if probability >= LEAST_PROBABILITY else -1
        found = [self._worded(c, probability)] if at >= 0 else []
        if unusual[at] < LEAST_PROBABILITY:
            return found
        if misfits.fast_a2[j] - usual.fast_a2 > 0.5 * (left[at] - usual.residual_a2):
            k = int(misfits.noise_share[j].argmax())
            name = self.branches[k] if misfits.noise_share[j, k] >= NAMED else None
            rms_a, usual_a = np.sqrt(misfits.fast_a2[j]), np.sqrt(usual.fast_a2)
            text = f"{_who(name)}: noise of {rms_a:.1f} A RMS, usual are {usual_a:.1f} A; check its shield and its plug"
            return [_finding(name, "noise", unusual[at], text), *found]
        if at < 0 or left[-1] - left[c] < EXPLAINED * (left[-1] - usual.residual_a2):
            rms_a, usual_a = np.sqrt(left[-1]), np.sqrt(usual.residual_a2)
            text = f"the sum of the currents wanders by {rms_a:.1f} A RMS, usual are {usual_a:.1f} A; look for a branch"
            return [_finding(None, "switching", unusual[at], f"{text} or load without a sensor, or a loose contact")]
        return found

    def _worded(self, c: int, probability: float) -> SensorFinding:
        """Put one of :data:`CAUSES` into words, with its sensor and figures."""
        misfits, j, cause = self.misfits, self.j, CAUSES[c]
        weight = np.exp(misfits.branch_fit[j, c] - misfits.branch_fit[j, c].max())
        k = int(weight.argmax())
        name = self.branches[k] if weight[k] >= NAMED * weight.sum() else None
        size, place, level = misfits.size[j, c], misfits.place[j, c], misfits.level_branch[j, c]
        percent = f"{100.0 * abs(size):.0f} %"
        if cause in {"bend", "sign"}:
            cause = (
                "clipped"
                if abs(size) >= CLIPPED
                else "sign"
                if place <= NEAR_ZERO * misfits.full_scale_a
                else "saturating"
            )
        text = {
            "quadratic": f"its error grows with the square of the current, {percent} at full scale",
            "cubic": f"its error grows with the cube of the current, {percent} at full scale",
            "sign": f"its gain differs by {percent} with the sign of the current, or a load without a sensor takes "
            f"{50.0 * abs(size):.0f} % of |{self.branches[level]}|",
            "clipped": f"it shows no more than about {place:.0f} A" if place else "it shows currents of one sign only",
            "saturating": f"its gain changes by {percent} beyond about {place:.0f} A",
            "step": f"its gain or offset changed after {100.0 * place:.0f} % of the recordings, or a load without a "
            f"sensor was switched",
            "ramp": "its gain or offset drifts with time",
            "temperature": f"its gain or offset drifts with temperature (standard deviation {place:.0f} K)",
        }[cause]
        this_makes = f"this makes {misfits.misfit_a[j, c]:.1f} A RMS; check the sensor against a reference"
        return _finding(name, cause, probability, f"{_who(name)}: {text}; {this_makes}")

    def of_spikes(self) -> list[SensorFinding]:
        """Report sensors with more spikes than is usual in the fleet.

        A spike is a sample at which one current alone leaps and returns. The cause is ``spikes`` if nearly all go to
        one side, else ``outliers``, or ``noise`` if there are very many.
        """
        found, n, usual = [], self.misfits.samples[self.j], self.usual.spike_rate
        for name, (up, down) in zip(self.branches, self.misfits.spikes[self.j], strict=True):
            if (rate := float(up + down)) <= usual:
                continue
            # Poisson counts at this rate against the fleet's, less what the unknown rate costs.
            likelihood = n * (rate * (np.log(rate / usual) - 1.0) + usual) - 0.5 * np.log(rate * n)
            one_sided = bool(min(up, down) <= ONE_SIDED * rate)
            cause = "spikes" if one_sided else "noise" if rate > NOISE_RATE else "outliers"
            text = (
                f"sensor {name}: spikes{' to one side' * one_sided} in {100.0 * rate:.2f} % of the samples, which are "
            )
            text += "left out; check its plug and its shield"
            found.append(_finding(name, cause, float(_posterior(PRIOR * np.exp(min(likelihood, 500.0)))), text))
        return [each for each in found if each.probability >= LEAST_PROBABILITY]
