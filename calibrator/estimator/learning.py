"""Learn from a fleet what faults its vehicles have and how vehicles without faults differ: the fault models.

A fault model is a prior of the faults and a model spread (how vehicles without faults differ). It is learnt by
expectation maximisation on the fleet's own evidence, (M14) of docs/method.md:

    expectation    explanations of each vehicle under the present model, weighted
    maximisation   numbers and sizes of faults, groups of vehicles that share a constant, centre and covariance of the
                   model spread

The likelihood has several maxima, as a cluster of faulty vehicles can be mistaken for the reference. So it is climbed
from several clusters of the evidence, and all models that explain the fleet nearly as well as the best one are kept,
with their probabilities. What a whole fleet shares in the junction's constant may be a load without a sensor or an
offset of the sensors of a branch: each is a model of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.estimator.evidence import EvidenceRows, ParameterPlaces, RowPlaces, densest_clusters, row_design
from calibrator.estimator.posterior import (
    GAIN,
    OFFSET,
    Draws,
    FaultModel,
    Spread,
    evidence_of,
    explain,
    fault_sizes,
    row_residuals,
    weigh,
)
from calibrator.estimator.prior import (
    GRID,
    LARGEST_SHARED,
    TAIL_DENSITY,
    TAIL_RANGE,
    Prior,
    Slab,
    first_prior,
    sparse_counts,
    uniform_density,
)

__all__ = ["LEAST_SHARED", "centre_rows", "learn_fault_models"]

MOST_LEARNT, MOST_STARTED = 200, 60
"""Most vehicles that a model is learnt from, and that starts are tried on; more change it less than faults do. [1]"""
START_ROUNDS, ROUNDS, PRIOR_STEPS = 2, 5, 6
"""Rounds of learning from each start, further rounds of the best results, and steps of the prior in each round."""
MOST_COMMON = 3
"""Clusters of all slopes to start from: slopes of a vehicle with a hardware fault agree with each other, too. [1]"""
MOST_ZEROS, MOST_CHOICES = 3, 1000
"""Clusters of the intercepts of a branch that are tried, and about how many combinations over all branches. [1]"""
SAME_REFERENCE, NEARLY_AS_MANY = 0.005, 3
"""Difference in any row up to which two references count as one (some A, as drives differ), and number of votes of
vehicles by which another choice of intercepts may stay behind the best."""
SAME_DENSITY = 0.2
"""Difference of the log densities of sizes below which two priors count as one."""
KEPT_LOG_ODDS = 7.0
"""Log odds of the best model over another one up to which the other is kept."""
STARTED_LOG_ODDS, MOST_RIVALS = 15.0, 4
"""Log odds of the best model over another one up to which the other is kept after the first rounds, which use fewer
vehicles; and largest number of references that are kept."""
SAME_START = 0.001
"""Difference in any row, in fractions of full scale, below which two starts count as one."""
LEAST_SHARED = 0.001
"""Size of a constant that vehicles share below which its cause does not matter, in fractions of full scale."""
GROUP_SD = 0.001
"""Standard deviation of vehicles of a group from what they share, before they are known, in fractions of full scale."""
SPREAD_VEHICLES = 5.0
"""Weight of the guessed model spread, in vehicles."""
SPREAD_OVER_SAMPLING, JUNCTION_SPREAD_OVER_SAMPLING = 2.0, 1.0
"""Guessed model spread over the usual sampling deviation, in rows of the fleet model and of the junction law: errors of
the fleet model last for a whole drive. [1]"""
COMMON_SPREADS = (0.0, 0.005, 0.03)
"""Spreads, beyond the guess, that all branches of a vehicle have in common, to start from: on recorded trips it is 0.5
to 0.8 %. If learning starts with a narrow spread, vehicles at its edge keep a small hardware fault each. [1]"""
OWN_SPREAD = 0.03
"""Spread of each slope by itself to start from, too, where the junction law tells a gain ratio less precisely: how two
branches in parallel share a current may differ between vehicles by as much, and looks like two gain errors. [1]"""
MOST_LOAD_SPREAD = 0.005
"""Largest spread over vehicles of loads without a sensor, before anything is known, over full scale: some A. [1]"""
LEAST_SPREAD = (1e-5, 1e-6)
"""Least model spread of relative and constant rows: far below any sensor's resolution. [1]"""
FIRST_DISPERSION = 4.0
"""First value of the dispersion, the variance of intercepts over that expected from their blocks: it falls fast. [1]"""
TAIL_DEGREES = 8.0
"""Degrees of freedom of Student's t, the distribution of vehicles in each row: those far off count less. [1]"""
COUNT_VEHICLES = 2.5
"""Weight of the distribution of sparse faults, equation (20) of the paper, against the fleet's own numbers of faults,
in vehicles."""
OTHERS_STEPS, LEAST_OTHERS = 3, 1e-3
"""Steps of :func:`_tally`, and least share of each count that is left when a vehicle's own faults are taken out. [1]"""
USED_FITS = 16
"""Number of explanations of each vehicle that the model spread is learnt from, the most probable ones."""
LEAST_GROUP, MOST_GROUPS, GROUP_GAIN = 2.0, 2, 5.0
"""Fewest vehicles of a group, most groups, and log evidence that a group must add: three vehicles that agree do."""
LEAST_SHARED_GAIN = (0.3, 0.004)
"""Share of the vehicles that agree, and size of a gain error from which on their sensors may share it. [1]"""
MOST_SHARED_SPREAD = 0.003
"""Most that shared gain errors differ between vehicles: sensors of one batch are alike. Where ratios are off, but not
alike, it is not by gain errors: signals are filtered, clipped or held. [1]"""
SURELY_SHARED = 2.0
"""Size from which on sensors may share a gain error, over the standard deviation of one vehicle's gain ratio. Errors of
the noise that is taken out of the junction regression are alike in all vehicles: they bias all ratios
in the same way, and averaging over vehicles does not remove that. [1]"""
LEAST_EXPECTED = 1e-6
"""Least probability of a vehicle without and of one with a sensor fault, whatever share is expected: no evidence could
overcome a probability of zero. [1]"""
COARSE_LOW, COARSE_HIGH = np.geomspace(0.003, 0.4, 14), np.geomspace(0.015, 1.2, 14)
"""Bounds of sizes that are tried first: drifts [1], offsets in fractions of full scale."""
FINE = 1.06 ** np.arange(-8, 9)
"""Bounds that are tried about the best ones so far, relative to them. [1]"""
TAILS = (0.001, 0.003, 0.01, 0.03, 0.1)
"""Shares of faults in the log-uniform tail that are tried. [1]"""
LEAST_RANGE = (2.0, 1.2)
"""Least ratio of the upper to the lower bound of drifts and of offsets. Vehicles that all have the same drift would be
the reference; all sensors of a branch may have the same offset, where the load is declared. [1]"""
SIZE_FAULTS, ANY_SIZE = 1.0, TAIL_DENSITY * np.gradient(GRID)
"""Weight, in faults, of a fault of any size that is added when bounds are learnt: a single fault would narrow them to
its own size. And the log-uniform probability of its size at :data:`~calibrator.estimator.prior.GRID`."""
SIZE_STARTS = ((0.004, 1.0), (0.03, 0.4), (0.1, 0.2))
"""Bounds from which the prior is climbed again: several small faults together can look like fewer large ones."""


def centre_rows(branches: int, doubtful: Mask | None = None) -> Mask:
    """Return for which rows the centre is learnt, shape (5K,): slopes, intercepts, junction constant, ratios in doubt.

    The centre of other gain ratios is 0. Of a ratio in doubt (``doubtful``, shape (K - 1,)) only differences between
    vehicles count.
    """
    free, at = np.zeros(5 * branches, bool), RowPlaces(branches)
    free[at.slopes] = free[at.intercepts] = free[at.junction] = True
    if doubtful is not None:
        free[at.ratios] = doubtful
    return free


def learn_fault_models(
    rows: EvidenceRows,
    *,
    feed: int,
    fixed: Array | None = None,
    load: float | None = None,
    known: Prior | None = None,
    expected_faults: float | None = None,
    doubtful: Mask | None = None,
) -> list[FaultModel]:
    """Learn the fault models that explain a fleet.

    Parameters
    ----------
    rows : EvidenceRows
        Evidence of N vehicles.
    feed : int
        Number of the branch that carries loads without a sensor, in the order of the rows.
    fixed : ndarray of shape (5K,) or None
        Centre of the rows for which trusted vehicles are the reference; NaN in the others. None: the whole fleet is the
        reference for all rows. [1]
    load : float or None
        Load that no branch measures, in fractions of full scale, if it is known. [1]
    known : Prior or None
        Prior of the faults, if it is known.
    expected_faults : float or None
        Share of vehicles with a sensor fault, if it is known. [1]
    doubtful : ndarray of bool of shape (K - 1,) or None
        Gain ratios that are in doubt in the whole fleet, see :func:`.ratios_in_doubt`; None: none is.

    Returns
    -------
    list of FaultModel
        By falling probability.
    """
    fixed = np.full(rows.values.shape[1], np.nan) if fixed is None else fixed.copy()
    if load is not None:
        fixed[rows.places.junction] = load
    order = np.lexsort(rows.values.T[::-1])  # the same whatever the order of the vehicles

    def some_rows(most: int) -> EvidenceRows:
        return rows.take(np.sort(order[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)]))

    learner = _Learner(
        rows=some_rows(MOST_LEARNT),
        feed=feed,
        fixed=fixed,
        free=centre_rows(rows.branches, doubtful) & np.isnan(fixed),
        known=known,
        expected_faults=expected_faults,
        declared=load is not None,
    )
    starter = replace(learner, rows=some_rows(MOST_STARTED))
    spreads = [(common, 0.0) for common in COMMON_SPREADS]
    ratio_sds = [rows.shown(rows.places.ratio(k))[1] for k in range(1, rows.branches)]
    if any(not len(sd) or np.median(sd) > OWN_SPREAD for sd in ratio_sds):
        spreads.append((0.0, OWN_SPREAD))
    starts = [starter.initial_model(centre, *spread) for centre, spread in product(learner.initial_centres(), spreads)]
    climbed = [starter.climb(start, START_ROUNDS) for start in starts]
    references = [learner.climb(model, ROUNDS, begun=True) for model in learner.rivals(climbed, STARTED_LOG_ODDS)]
    models = learner.variants(learner.rivals(references, KEPT_LOG_ODDS))
    return [learner.with_modes(model) for model in sorted(models, key=lambda model: -model.probability)]


@dataclass(kw_only=True)
class _Learner:
    """Expectation maximisation on the evidence of one fleet.

    The parameters are as in :func:`learn_fault_models`, but ``fixed`` has the declared load, too, and ``declared`` says
    whether there is one; ``free`` (5K,) says for which rows the centre is learnt.
    """

    rows: EvidenceRows
    feed: int
    fixed: Array
    free: Mask
    known: Prior | None
    expected_faults: float | None
    declared: bool

    def __post_init__(self) -> None:
        K = self.rows.branches
        self.at, self.parameters, self.design = self.rows.places, ParameterPlaces(K), row_design(K, self.feed)
        least_sd = np.empty(5 * K)
        least_sd[self.at.relative], least_sd[self.at.constant] = LEAST_SPREAD
        self.least = np.diag(least_sd**2)
        self.guess = self._guessed_spread()

    def _guessed_spread(self) -> Array:
        """Return a guess of the model spread (5K, 5K): diagonal, from the usual sampling variance of each row."""
        rows, K, at = self.rows, self.rows.branches, self.at
        variance = np.diagonal(rows.covariance, axis1=1, axis2=2).copy()
        variance[:, at.intercepts] = np.diagonal(rows.intercept_covariance(), axis1=1, axis2=2)
        guess = np.zeros(5 * K)
        for row in at.measured:
            known = rows.known[:, row]
            guess[row] = np.median(variance[known, row]) if known.any() else 1.0
        factor = np.full(5 * K, SPREAD_OVER_SAMPLING)
        factor[at.ratios] = factor[at.junction] = JUNCTION_SPREAD_OVER_SAMPLING
        return np.diag(factor**2 * guess)

    def clusters(self, row: int, most: int = 1, farthest: float = np.inf) -> list[float]:
        """Return the centres of the densest clusters of a row, the best first; [0.0] if there is none."""
        found = densest_clusters(*self.rows.shown(row), most=most, farthest=farthest)
        return [cluster.centre for cluster in found] or [0.0]

    def initial_intercepts(self, constant: float) -> list[Array]:
        """Propose intercepts of vehicles without faults, each of shape (K,), that add up to the junction's constant.

        All but one are centres of clusters. The first proposal has the densest clusters, and the feeding branch takes
        what is left. Further proposals have nearly as many votes of vehicles as the best one, as a cluster of few may
        be chance.
        """
        K = self.rows.branches
        most = min(MOST_ZEROS, int(MOST_CHOICES ** (1.0 / K)))
        clusters = [self.clusters(self.at.intercept(k), most) for k in range(K)]
        chosen = []
        for follows in (self.feed, *(k for k in range(K) if k != self.feed)):
            zeros = np.array(list(product(*(clusters[k] if k != follows else [0.0] for k in range(K)))))
            zeros[:, follows] = constant - zeros.sum(axis=1)
            chosen.append(zeros)
        tried = np.concatenate(chosen)
        votes = np.zeros(len(tried), np.int64)
        for k, near in product(range(K), (SAME_START, SAME_REFERENCE)):  # close agreement has two votes
            values, sd = self.rows.shown(self.at.intercept(k))
            agree = np.abs(values[:, None] - tried[:, k]) < np.maximum(3.0 * sd, near)[:, None]
            votes += np.count_nonzero(agree, axis=0)
        found = [tried[0]]
        for i in np.argsort(-votes, kind="stable"):
            apart = all(np.abs(tried[i] - other).max() > SAME_REFERENCE for other in found)
            if apart and len(found) < MOST_ZEROS and votes[i] >= votes.max() - NEARLY_AS_MANY:
                found.append(tried[i])
        return found

    def initial_slopes(self) -> list[Array]:
        """Propose slopes of vehicles without faults, each of shape (K,), as logarithms.

        The fleet model may be off by a factor in each branch. How these factors differ between branches follows from
        two slopes and their gain ratio, in every vehicle and whatever its faults; where ratios are vague, clusters of
        the slopes are tried as well. The factor that all branches have in common comes from clusters of all slopes.
        """
        rows, K, at = self.rows, self.rows.branches, self.at
        by_ratios, by_clusters, first = np.zeros(K), np.zeros(K), at.slope(0)
        for k in range(1, K):
            slope, ratio = at.slope(k), at.ratio(k)
            known = rows.known[:, [first, slope, ratio]].all(axis=1)
            apart = rows.values[known, slope] - rows.values[known, first] + rows.values[known, ratio]
            by_ratios[k] = by_clusters[k] = np.median(apart) if known.any() else 0.0
            if not known.any() or np.median(rows.shown(ratio)[1]) > LEAST_SHARED_GAIN[1]:
                by_clusters[k] = self.clusters(slope)[0] - self.clusters(first)[0]
        known, sd = rows.known[:, at.slopes], np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2)[:, at.slopes])
        found = list[Array]()
        for apart in (by_ratios, by_clusters) if (by_ratios != by_clusters).any() else (by_ratios,):
            agreeing = densest_clusters((rows.values[:, at.slopes] - apart)[known], sd[known], most=MOST_COMMON)
            found += [apart + excess for excess in [cluster.centre for cluster in agreeing] or [0.0]]
        return found

    def initial_centres(self) -> list[Array]:
        """Propose centres of the rows to start from, each of shape (5K,), by what vehicles agree on.

        Slopes and intercepts are those of clusters; of the feeding branch's intercept several clusters are tried. The
        intercepts of a centre add up to its junction constant, as those of a vehicle without faults do.
        """
        K, at = self.rows.branches, self.at
        intercept = at.intercept(self.feed)
        others = sum(self.clusters(at.intercept(k))[0] for k in range(K) if k != self.feed)
        # The junction law shows the constant most exactly. Values beyond any load come from intercepts that few share.
        constants = [*self.clusters(at.junction, 2, LARGEST_SHARED), 0.0]
        constants += [zero + others for zero in self.clusters(intercept, 2, LARGEST_SHARED)]
        constants = [constant for constant in constants if abs(constant) <= LARGEST_SHARED]
        ratios = [self.clusters(row)[0] if self.free[row] else 0.0 for row in range(at.ratios.start, at.ratios.stop)]
        slopes, found = self.initial_slopes(), list[Array]()
        for constant in constants if np.isnan(self.fixed[at.junction]) else [float(self.fixed[at.junction])]:
            for zeros, slope in product(self.initial_intercepts(constant), slopes):
                start = np.zeros(5 * K)
                start[at.ratios] = ratios
                start[at.slopes], start[at.intercepts], start[at.junction] = slope, zeros, constant
                start = np.where(np.isnan(self.fixed), start, self.fixed)
                if not any(np.abs(start - other).max() < SAME_START for other in found):
                    found.append(start)
        return found

    def initial_model(self, centre: Array, common_spread: float = 0.0, own_spread: float = 0.0) -> FaultModel:
        """Make a first model from a centre, and spreads [1] of slopes: common to a vehicle's branches, and of each."""
        rows, K = self.rows, self.rows.branches
        junction, eta = self.at.junction, self.design[:, self.parameters.eta]
        covariance = self.guess + self.least + common_spread**2 * np.outer(eta, eta)
        covariance[range(K), range(K)] += own_spread**2  # the rows of slopes come first
        clusters = densest_clusters(
            rows.values[:, junction], np.sqrt(rows.covariance[:, junction, junction]), farthest=LARGEST_SHARED
        )
        if clusters:  # loads without a sensor differ between vehicles
            load = self.design[:, self.parameters.load]
            covariance += min(clusters[0].spread, MOST_LOAD_SPREAD) ** 2 * np.outer(load, load)
        spread = Spread(
            mean=centre, covariance=covariance, dispersion=np.full(K, FIRST_DISPERSION), shared=np.zeros(2 * K + 1)
        )
        return FaultModel(spread=spread, priors=((1.0, self.known or first_prior(K)),))

    def climb(self, model: FaultModel, rounds: int, *, begun: bool = False) -> FaultModel:
        """Do some rounds of expectation and maximisation, and return the best model of all rounds.

        ``begun``: the model was climbed before, so bounds of sizes are tried near its own, and groups at once.
        """
        best = replace(model, log_evidence=-np.inf)
        for n in range(rounds):
            draws = explain(self.rows, model, feed=self.feed)
            prior = self._next_prior(draws, model.prior, coarse=not begun, grouping=begun or n > 0)
            weight, log_evidence = weigh(draws, prior)
            met = FaultModel(spread=model.spread, priors=((1.0, prior),), log_evidence=float(log_evidence.sum()))
            centred = met.prior.group_share.max(initial=0.0) <= 1.0 - met.prior.group_share.sum()
            if met.log_evidence > best.log_evidence and (centred or met.spread.shared.any()):
                best = met
            model = self._recentred(replace(met, spread=self._next_spread(draws, weight, model.spread)))
        return best if best.log_evidence > -np.inf else model

    def _recentred(self, model: FaultModel) -> FaultModel:
        """Move the centre to the largest group and drop the groups, if it has more vehicles than are in no group."""
        prior, spread, at = model.prior, model.spread, self.at
        shares = prior.group_share
        if not shares.size or shares.max() <= 1.0 - shares.sum() or spread.shared.any() or not self.free[at.junction]:
            return model
        mean = spread.mean.copy()
        mean[[at.intercept(self.feed), at.junction]] += prior.group_centre[int(np.argmax(shares))]
        alone = replace(prior, group_share=np.zeros(0), group_centre=np.zeros(0), group_sd=np.zeros(0))
        return replace(model, spread=replace(spread, mean=mean), priors=((1.0, alone),), log_evidence=-np.inf)

    def rivals(self, models: Sequence[FaultModel], log_odds: float) -> list[FaultModel]:
        """Return the best model and, by falling evidence, those with another centre and at most these log odds less."""
        found = list[FaultModel]()
        for model in sorted(models, key=lambda model: -model.log_evidence):
            apart = (np.abs(model.spread.mean - other.spread.mean).max() > SAME_REFERENCE for other in found)
            if all(apart) and (not found or model.log_evidence > found[0].log_evidence - log_odds):
                found.append(model)
        return found[:MOST_RIVALS]

    def variants(self, references: Sequence[FaultModel]) -> list[FaultModel]:
        """Make of each model one per cause of what vehicles share (loads, offsets or gains of a branch's sensors).

        Return those that explain the fleet nearly as well as the best one, with their probabilities.
        """
        K, at = self.rows.branches, self.at
        found = [
            (plausible, replace(model, spread=replace(model.spread, shared=shared)))
            for model in references
            for plausible, shared in self._shared_constants(float(model.spread.mean[at.junction]), model.prior)
        ]
        for model in references:
            if not len(model.prior.group_centre):
                # Sensors of a batch read the same offset; seen through their gain errors it looks like different loads.
                shared = np.append(model.spread.shared[:-1], 1.0)
                spread = replace(model.spread, shared=shared)
                batch = self.climb(replace(model, spread=spread), START_ROUNDS, begun=True)
                if batch.prior.group_share.max(initial=0.0) > 1.0 / len(self.rows):
                    c0 = float(batch.spread.mean[at.junction])
                    found.append((_log_plausible(c0, 0.0, batch.prior, of_sensor=True), batch))
        slopes = np.array([self.clusters(at.slope(k))[0] for k in range(K)])  # includes what most sensors share
        for model, shared in product(references, self._shared_gains()):
            mean = model.spread.mean.copy()
            mean[at.slopes] = np.where(self.free[at.slopes], slopes - shared[K : 2 * K], mean[at.slopes])
            fresh = replace(self.initial_model(mean), spread=replace(model.spread, mean=mean, shared=shared))
            found.append((0.0, self.climb(fresh, START_ROUNDS)))
        if len(found) > 1:
            climbed = [(plausible, self.climb(model, START_ROUNDS, begun=True)) for plausible, model in found]
            # If no vehicle is left in a group, the cause of the group does not matter.
            found = [
                (p, model)
                for p, model in climbed
                if not model.spread.shared[-1] or model.prior.group_share.max(initial=0.0) > 1.0 / len(self.rows)
            ]
        evidence = np.array([model.log_evidence for _, model in found])
        of_gains = np.array([model.spread.shared[K : 2 * K].any() for _, model in found])
        if self.free[at.slopes].all() and of_gains.any():
            # Models of different branches differ only in the noise of the constants, scaled by the gain: no evidence.
            evidence[of_gains] = evidence[of_gains].max()
        log_odds = evidence + [plausible for plausible, _ in found]
        odds = np.where(log_odds > log_odds.max() - KEPT_LOG_ODDS, np.exp(log_odds - log_odds.max()), 0.0)
        kept = zip((odds / odds.sum()).tolist(), found, strict=True)
        return [replace(model, probability=share) for share, (_, model) in kept if share]

    def _shared_constants(self, c0: float, prior: Prior) -> list[tuple[float, Array]]:
        """List causes of the junction's constant ``c0``: log prior, and what sensors share (:attr:`.Spread.shared`)."""
        K = self.rows.branches
        found: list[tuple[float, Array]] = []
        for of_sensor in (False, True) if len(prior.group_centre) else (False,):
            offsets = [(0.0, self.feed)]
            if abs(c0) > LEAST_SHARED and np.isnan(self.fixed[self.at.junction]):
                offsets += [(c0, k) for k in range(K)]
            for z in [-float(centre) for centre in prior.group_centre] if of_sensor else []:
                if all(abs(z - known) > LEAST_SHARED for known, _ in offsets):
                    offsets.append((z, self.feed))
            for offset, k in offsets:
                shared: Array = np.zeros(2 * K + 1)
                shared[k], shared[-1] = offset, of_sensor
                plausible = _log_plausible(c0, offset, prior, of_sensor=of_sensor) - np.log(K if offset else 1)
                found.append((float(plausible), shared))
        return found

    def _shared_gains(self) -> list[Array]:
        """List gains that sensors may share (:attr:`.Spread.shared`), if many vehicles break the junction law alike."""
        K, at = self.rows.branches, self.at
        centre, sd = np.zeros(K), np.full(K, np.inf)  # of ratios that are alike in many vehicles; infinite: unknown
        for k in range(1, K):
            values, errors = self.rows.shown(at.ratio(k))
            if self.free[at.ratio(k)] or not len(values):
                continue
            for cluster in densest_clusters(values, errors, widest=1.0):  # at most one
                if cluster.spread < MOST_SHARED_SPREAD and cluster.share > LEAST_SHARED_GAIN[0]:
                    centre[k], sd[k] = cluster.centre, np.median(errors)
        broken = np.abs(centre) > np.maximum(LEAST_SHARED_GAIN[1], SURELY_SHARED * sd)
        if not broken.any():
            return []
        # Ratios show lambda_1 - lambda_k only, so lambda_1 is free. 0 and each centre are tried; those count that leave
        # the fewest branches wrong.
        found: dict[tuple[bool, ...], Array] = {tuple(broken): np.where(broken, -centre, 0.0)}
        tolerance = LEAST_SHARED_GAIN[1] + SURELY_SHARED * sd
        for first in centre[broken]:
            alike = broken & (np.abs(centre - first) <= tolerance)
            first_gain = np.average(centre[alike], weights=sd[alike] ** -2.0)
            gains = np.where(np.abs(centre - first_gain) > tolerance, first_gain - centre, 0.0)
            gains[0] = first_gain
            found.setdefault(tuple(gains != 0.0), gains)
        fewest = min(sum(wrong) for wrong in found)
        return [np.concatenate([np.zeros(K), gains, [0.0]]) for wrong, gains in found.items() if sum(wrong) == fewest]

    def with_modes(self, model: FaultModel) -> FaultModel:
        """Return the model with all priors that explain the fleet nearly as well as the best one.

        They are learnt from several starts.
        """
        if self.known is not None:
            return model
        draws = explain(self.rows, model, feed=self.feed)
        found: list[tuple[float, Prior]] = []
        for bounds in (None, *SIZE_STARTS):
            prior = model.prior
            if bounds is not None:
                slab = Slab(low=bounds[0], high=bounds[1], tail=0.03)
                prior = replace(prior, gain=slab, offset=slab)
            for n in range(3):
                prior = self._next_prior(draws, prior, coarse=bounds is not None and not n, grouping=False)
            found.append((float(weigh(draws, prior)[1].sum()), prior))
        found.sort(key=lambda item: -item[0])
        odds: list[tuple[float, Prior]] = []
        for value, prior in found:
            same = (np.abs(prior.log_density - other.log_density).max() < SAME_DENSITY for _, other in odds)
            if value > found[0][0] - 0.5 * KEPT_LOG_ODDS and not any(same):
                odds.append((float(np.exp(value - found[0][0])), prior))
        total = sum(share for share, _ in odds)
        return replace(model, priors=tuple((share / total, prior) for share, prior in odds))

    def _next_prior(self, draws: Draws, prior: Prior, *, coarse: bool, grouping: bool) -> Prior:
        """Return a prior that fits the draws better; with ``grouping`` it may get one more group."""
        if self.known is not None:
            return self.known
        for _ in range(PRIOR_STEPS):
            prior = self._next_shares(draws, prior)
        prior = _next_sizes(draws, prior, coarse=coarse)
        if grouping and len(prior.group_share) < MOST_GROUPS:
            prior = self._with_group(draws, prior)
        return prior

    def _next_shares(self, draws: Draws, prior: Prior) -> Prior:
        """Update the numbers of faults, loads and groups from the weights of the draws."""
        weight, _ = weigh(draws, prior)
        N, load = len(weight), self.parameters.load
        tally = _tally(draws, weight, prior)
        counts = (tally + COUNT_VEHICLES * sparse_counts(tally)) / (N + COUNT_VEHICLES)
        if self.expected_faults is not None:
            sound, faulty = counts[:, :1], counts[:, 1:]
            expected = float(np.clip(self.expected_faults, LEAST_EXPECTED, 1.0 - LEAST_EXPECTED))
            counts = np.concatenate([(1.0 - expected) * sound / sound.sum(), expected * faulty / faulty.sum()], axis=1)
        loaded = draws.fits.support[:, :, load]
        share, centre, sd = prior.group_share.copy(), prior.group_centre.copy(), prior.group_sd.copy()
        for g in range(len(share)):
            share[g] = (weight[..., 1 + g].sum() + 0.02) / (N + 1.0)
            w = (weight[..., 1 + g] * loaded[:, :, None]).ravel()
            if w.sum() > 0.5:
                x = draws.values[..., load].ravel()
                centre[g] = w @ x / w.sum()
                sd[g] = np.sqrt((w @ (x - centre[g]) ** 2 + 2.0 * GROUP_SD**2) / (w.sum() + 2.0))
        # as with faults (CVB0), a load is judged by those of the others: one vehicle must not confirm itself
        own = (weight[..., 0] * loaded[:, :, None]).sum(axis=(1, 2))
        others = own.sum() - np.square(own).sum() / max(own.sum(), 1e-300)
        return replace(
            prior,
            counts=counts,
            load_share=float((others + 0.02) / (N + 1.0)),
            group_share=share,
            group_centre=centre,
            group_sd=np.maximum(sd, 0.7 * GROUP_SD),
        )

    def _with_group(self, draws: Draws, prior: Prior) -> Prior:
        """Add a group of vehicles that share a constant of the feeding branch, if the fleet's evidence gains enough."""
        N, fits = len(draws.values), draws.fits
        weight = weigh(draws, prior)[0][..., 0].sum(axis=2)
        found = []
        for column in (self.parameters.offset(self.feed), self.parameters.load):
            on = fits.support[:, :, column] & (weight > 0.05)
            sd = np.sqrt((fits.root[:, :, column] ** 2).sum(axis=2))
            found.append(np.stack([fits.theta[:, :, column][on], sd[on], weight[on]]))
        value, sd, share = np.concatenate(found, axis=1)
        near = (np.abs(value) > 4.0 * GROUP_SD) & (np.abs(value) < LARGEST_SHARED) & (sd < 10.0 * GROUP_SD)
        value, sd, share = value[near], sd[near], share[near]
        width = np.hypot(sd, GROUP_SD)
        vehicles = np.exp(-0.5 * ((value[:, None] - value) / width) ** 2) @ share
        for centre in prior.group_centre:
            vehicles[np.abs(value - centre) < 4.0 * GROUP_SD] = 0.0
        if not vehicles.size or vehicles.max() < LEAST_GROUP:
            return prior
        first = int(np.argmax(vehicles))
        grouped = replace(
            prior,
            group_share=np.append(prior.group_share, min(vehicles[first] / N, 0.7)),
            group_centre=np.append(prior.group_centre, value[first]),
            group_sd=np.append(prior.group_sd, 1.5 * GROUP_SD),
        )
        for _ in range(PRIOR_STEPS):
            prior, grouped = self._next_shares(draws, prior), self._next_shares(draws, grouped)
        if self.declared and grouped.group_share.max() > 0.5:  # most vehicles have the load that is declared
            return prior
        gain = float(weigh(draws, grouped)[1].sum() - weigh(draws, prior)[1].sum())
        return grouped if gain > GROUP_GAIN else prior

    def _next_spread(self, draws: Draws, weight: Array, spread: Spread) -> Spread:
        """Update centre, covariance and dispersion from residuals of explanations, (M14a), (M14b) of docs/method.md."""
        rows, b, N = self.rows, self.at.intercepts, len(self.rows)
        of_fit = weight.sum(axis=(2, 3))
        top = np.argsort(-of_fit, axis=1, kind="stable")[:, :USED_FITS]
        share = np.take_along_axis(of_fit, top, axis=1)
        share /= share.sum(axis=1, keepdims=True)
        theta = np.take_along_axis(draws.fits.theta, top[:, :, None], axis=1)
        root = np.take_along_axis(draws.fits.root, top[:, :, None, None], axis=1)
        whole, added = rows.dispersed(spread.dispersion)
        evidence = evidence_of(
            rows.values, whole + spread.covariance, rows.means, centre=spread.mean, shared=spread.shared, feed=self.feed
        )
        left = row_residuals(evidence, theta)

        def counted(square: Array, variance: Array) -> Array:
            """Return the weights w of Student's t, row by row, shape (N, Q, r), (M14a) of docs/method.md."""
            return share[:, :, None] * (TAIL_DEGREES + 1.0) / (TAIL_DEGREES + square / variance)

        def expected(prior_covariance: Array, gain: Array) -> tuple[Array, Array]:
            """Return mean (N, Q, r) and covariance (N, Q, r, r) of a part of the error that has this prior and gain."""
            shown = (gain @ self.design)[:, None] @ root  # what the fitted parameters hide of it
            return np.einsum("nab,nqb->nqa", gain, left), prior_covariance + shown @ np.swapaxes(shown, 2, 3)

        V, P = spread.covariance, evidence.precision
        mean, covariance = expected((V - V @ P @ V)[:, None], V @ P)
        count = counted(mean**2 + np.diagonal(covariance, axis1=2, axis2=3), np.diag(V))
        shift = np.where(self.free, np.einsum("nqa,nqa->a", count, mean) / count.sum(axis=(0, 1)), 0.0)
        root_count = np.sqrt(count)
        apart = root_count * (mean - shift)
        scatter = np.einsum("nqa,nqb->ab", apart, apart)
        scatter += np.einsum("nqa,nqb,nqab->ab", root_count, root_count, covariance)
        gain = added @ P[:, b]
        error, doubt = expected((added - gain[:, :, b] @ added)[:, None], gain)
        stated = np.diagonal(rows.intercept_covariance(), axis1=1, axis2=2)[:, None]
        more = (error**2 + np.diagonal(doubt, axis1=2, axis2=3)) / stated
        count = counted(more, np.maximum(spread.dispersion - 1.0, 1.0))
        guessed = SPREAD_VEHICLES / (SPREAD_VEHICLES + N)
        return Spread(
            mean=spread.mean + shift,
            covariance=(1.0 - guessed) * scatter / N + guessed * self.guess + self.least,
            dispersion=1.0 + ((count * more).sum(axis=(0, 1)) + SPREAD_VEHICLES) / (N + SPREAD_VEHICLES),
            shared=spread.shared,
        )


def _tally(draws: Draws, weight: Array, prior: Prior) -> Array:
    """Count the expected vehicles with each number of hardware and of sensor faults, shape (K + 1, 2K + 1).

    Each vehicle is judged by the numbers of faults of the others (CVB0 of [1]_): otherwise a few vehicles would confirm
    what their own faults have made likely.

    .. [1] A. Asuncion et al., "On smoothing and inference for topic models", UAI 2009.
    """
    fits, N = draws.fits, len(weight)
    vehicle, cell = np.arange(N)[:, None], (fits.hardware, fits.sensor)
    of_fit = weight.sum(axis=(2, 3))
    shown = of_fit / prior.counts[cell]
    everybody = (N + COUNT_VEHICLES) * prior.counts
    for _ in range(OTHERS_STEPS):
        own = np.zeros((N, *prior.counts.shape))
        np.add.at(own, (vehicle, *cell), of_fit)
        of_fit = shown * np.maximum(everybody - own, LEAST_OTHERS * everybody)[vehicle, *cell]
        of_fit /= of_fit.sum(axis=1, keepdims=True)
    tally = np.zeros(prior.counts.shape)
    np.add.at(tally, cell, of_fit)
    return tally


def _next_sizes(draws: Draws, prior: Prior, *, coarse: bool) -> Prior:
    """Return the prior with new bounds, tail and density of the sizes of drifts and offsets.

    The density is a mean over the bounds and tails that the fleet allows. ``coarse``: any bounds are tried first, else
    only those near the present ones.
    """
    slabs = [prior.gain, prior.offset]
    for kind in (GAIN, OFFSET):
        best, odds, least, sizes = slabs[kind], {}, LEAST_RANGE[kind], fault_sizes(draws, prior, kind)
        for again in (False, True):
            for name in ("high", "low", "tail"):
                grid: Sequence[float] | Array = TAILS
                if name != "tail":
                    first = COARSE_LOW if name == "low" else COARSE_HIGH
                    grid = first if coarse and not again else getattr(best, name) * FINE
                tried = [replace(best, **{name: float(value)}, density=np.zeros(0)) for value in grid]
                tried = [slab for slab in tried if slab.high > least * slab.low and slab.low > TAIL_RANGE[0]] or [best]
                densities = np.stack([slab.density for slab in tried])
                evidence = sizes.evidence(densities) + SIZE_FAULTS * np.log(densities) @ ANY_SIZE
                best = tried[int(np.argmax(evidence))]
                weight = np.exp(evidence - evidence.max())
                odds[name] = [(getattr(slab, name), w) for slab, w in zip(tried, weight / weight.sum(), strict=True)]
        both = product(odds["low"], odds["high"])
        pairs = np.array([(low, high, a * b) for (low, a), (high, b) in both if high > least * low])
        uniform = uniform_density(pairs[:, 0], pairs[:, 1]) @ pairs[:, 2] / pairs[:, 2].sum()
        tail = sum(value * w for value, w in odds["tail"])
        slabs[kind] = replace(best, density=(1.0 - tail) * uniform + tail * TAIL_DENSITY)
        prior = replace(prior, gain=slabs[GAIN], offset=slabs[OFFSET])
    return prior


def _log_plausible(c0: float, offset: float, prior: Prior, *, of_sensor: bool) -> float:
    """Return the log prior that ``offset`` of a branch's sensors, and a load for the rest, make the constant ``c0``.

    An offset that most sensors share is rarer than one of a few; a load can only take current; and a load and an offset
    would cancel only by chance.
    """
    levels = c0 + np.append(0.0, prior.group_centre)  # what the currents of the vehicles of each group sum to
    shares = np.append(1.0 - prior.group_share.sum(), prior.group_share)
    sensors = offset + np.append(0.0, prior.group_centre if of_sensor else 0.0 * prior.group_centre)
    loads, affected = levels - sensors, np.abs(sensors) > LEAST_SHARED
    value = np.log(max(1.0 - shares[affected].sum(), 0.3))
    if (loads < -LEAST_SHARED).any() or (loads > LARGEST_SHARED).any():
        value -= 7.0
    if (affected & (np.abs(levels) < LEAST_SHARED)).any():
        value -= 4.0
    return float(value)
