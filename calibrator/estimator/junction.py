"""Estimate the sensors of one junction by itself, from its recordings and from what is known of some of its sensors.

No fleet is needed. Every vehicle gives K - 1 gain ratios and one constant of the junction law, (M8) of docs/method.md,

    -g_k = exp(lambda_1 - lambda_k),    c = o_1 - sum over k > 1 of g_k o_k + (1 + d_1) l,    lambda = log(1 + d),

with the offsets o and the load l that no branch measures. They are linearised in the unknowns (lambda, o, l), so
recordings of one car that has another sensor ("meter") in one branch each time, as at different chargers, are one
system of equations. If the current of a branch hardly varies, its ratio may be far off, and c by as much times the mean
current. The covariance says so, and is therefore that of g and c, not of logarithms. Ratios do not give the scale of
the gains: it comes from sensors that are known. Offsets come from known sensors, zero-current windows, a declared load,
or a charge balance. As no fleet shows what is usual, the gain of a sensor that is not known is open: its prior is a
wide Gaussian. Its offset is absent (a narrow Gaussian: no zero is exact) or present, of any size; each choice is one
explanation. What stays open is reported with its standard deviation, and is not corrected.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.stats import norm, qmc

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.estimator.checks import CAUSES, UsualMisfits, find_misfits
from calibrator.estimator.decision import (
    FleetEstimate,
    Points,
    affine_moments,
    decided,
    harm_probability,
    recovery_probability,
)
from calibrator.estimator.evidence import (
    MOST_NOISE,
    RIDGE,
    TINY,
    FleetMoments,
    junction_regression,
    ratios_in_doubt,
    stack_summaries,
)
from calibrator.estimator.readings import CONTRADICTION, TRUSTED_DRIFT_SD, TRUSTED_OFFSET_SD
from calibrator.estimator.settings import SUSPECTED
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.layout import Layout, UnmeasuredLoad
from ecu_node.parameters import Explanation, SensorFinding

__all__ = ["SEEN", "JunctionKnowledge", "JunctionLaw", "estimate_junction", "named_ratios"]

LAW_GAIN_SD, LAW_OFFSET_SD = 0.002, 0.0005
"""Standard deviation that delays, noise and curvature of sensors add to a gain ratio, and to c over full scale. [1]"""
LAW_MOVING_SD = 0.00003
"""The same for the part of the junction sum, over full scale, that moves with a branch by chance, as where the delay of
another, switched current is not quite right: gains of branches whose current moves little are known less well. [1]"""
MOST_RATIO, SURE_SD = 3.0, 0.1
"""Gain ratio that no two sensors have, and standard deviation below which it is refused (times the ratio, if greater);
else it counts with its deviation. [1]"""
OPEN_GAIN_SD, OPEN_OFFSET_SD, OPEN_LOAD_SD = 0.3, 0.2, 0.04
"""Standard deviations before anything is known: of lambda, and over full scale of an offset and of a load. [1]"""
FAULT_SHARE = 0.2
"""Probability of a gain error, and of an offset, before anything is known. [1]"""
LEAST_FAULT = 0.02
"""Least size with which "recovered" counts the faults: gain errors, and offsets over full scale. [1]"""
KNOWN_GAIN_SD, KNOWN_OFFSET_SD = 0.03, 0.005
"""Standard deviations up to which a gain, and an offset over full scale, count as known. [1]"""
OFFSET_SIZES = (0.0015, 0.005, 0.02, 0.2)
"""Standard deviations of an offset that is present, over full scale: each is as probable as the others. [1]"""
MOST_OFFSETS, MARGIN = 3, 12.0
"""Most offsets of one explanation, and distance of its log weight below the best from which on it is left out."""
DRAWS, FEWEST_DRAWS = 8192, 64
"""Draws in all, shared by weight of the explanations, and fewest of one: the usual harm limit of 0.001 is 8 draws."""
CANCELLED = 0.0025
"""Offset of a sensor by a declared charge, over full scale, from which on the sum of the currents must show it. [1]"""
USUAL_MISFIT, USUAL_RESIDUAL, USUAL_SPREAD = 0.0002, 0.002, 0.5
"""Usual misfit, due to curvature of good sensors, and usual residual of the sum, due to noise and switched loads, over
full scale; and spread between cars of the logarithm of the square of that residual. [1]"""
STEPS = 6
"""Gauss-Newton steps for the gains in ratios, charges and loads; more change nothing. [1]"""
STILL = 0.003
"""Standard deviation of all currents, over full scale, up to which the car stands still. [1]"""
SOUND_GAIN_SD, SOUND_OFFSET_SD = 0.01, 0.0025
"""Standard deviations up to which a sensor without a fault is called right: gain, and offset over full scale. [1]"""
SEEN = 3.0
"""Standard deviations from which on a fault is clear. [1]"""


class JunctionLaw(NamedTuple):
    """K rows of a vehicle's junction law, (M8) of docs/method.md: -g of K - 1 branches, c over full scale. [1]"""

    order: list[int]
    """Numbers of the K branches, the one whose current varies most first: the rows are -g of ``order[1:]``."""
    value: Array
    """Values of the rows, shape (K,)."""
    covariance: Array
    """Covariance of their errors, shape (K, K)."""
    constant_a: tuple[float, float]
    """c with its standard deviation. [A]"""


def _law(summary: DriveSummary, branches: Sequence[str], where: str, scale_a: float) -> JunctionLaw:
    """Regress the junction law of a vehicle, ``where`` in messages; FleetError if a sign or unit is wrong."""
    order = np.argsort(-summary.variance_a2, kind="stable").tolist()
    moments = stack_summaries([summary], order)
    fit = junction_regression(moments)
    K, others, mean_a = len(order), order[1:], summary.mean_a
    covariance = fit.influence.T @ fit.influence + fit.prior_covariance[0]
    if summary.variance_a2.max() < (STILL * scale_a) ** 2:  # ratios stay open, and the mean sum is the constant
        ratio: Array = np.ones(K - 1)
        constant_a = float(mean_a.sum())
        turns = np.vstack([np.eye(K - 1), mean_a[others]])
        covariance = block_diag(np.zeros((K - 1, K - 1)), covariance[-1, -1]) + turns @ turns.T
    else:
        ratio, constant_a = -fit.estimate[0, :-1], float(fit.estimate[0, -1])
        sign = np.append(-np.ones(K - 1), 1.0)
        covariance *= np.outer(sign, sign)
        turns = np.vstack([np.eye(K - 1), mean_a[others]])[:, _is_only_noise(moments)[1:]]
        covariance += turns @ turns.T  # its ratio is open
        sure = np.sqrt(np.diagonal(covariance)[:-1]) < SURE_SD * np.maximum(1.0, np.abs(ratio))
        for k, value in zip(np.array(others)[sure].tolist(), ratio[sure].tolist(), strict=True):
            if not 1.0 / MOST_RATIO < value < MOST_RATIO:
                raise FleetError(
                    f"{where}: the currents do not balance: 1 A in branch {branches[k]} goes with {-value:+.2g} A in "
                    f"branch {branches[order[0]]}, expected -1 A; check sign and unit of branch {branches[k]} or "
                    f"{branches[order[0]]}"
                )
    constant_sd_a = float(np.hypot(np.sqrt(covariance[-1, -1]), LAW_OFFSET_SD * scale_a))
    unit = np.append(np.ones(K - 1), 1.0 / scale_a)
    # an error of a ratio turns the line about the mean current, and so moves the constant
    moved = np.maximum(np.sqrt(summary.variance_a2[others]) / scale_a, LAW_MOVING_SD)
    error = np.hypot(LAW_GAIN_SD * _possible(ratio), LAW_MOVING_SD / moved)
    jacobian = np.vstack([np.eye(K - 1), mean_a[others] / scale_a]) * error
    covariance = covariance * np.outer(unit, unit) + jacobian @ jacobian.T
    covariance[-1, -1] += LAW_OFFSET_SD**2
    return JunctionLaw(order, np.append(ratio, constant_a / scale_a), covariance, (constant_a, constant_sd_a))


def _is_only_noise(moments: FleetMoments) -> Mask:
    """Return which of the K currents only noise moves: it changes from sample to sample, and not with the others."""
    covariance = moments.covariance[0, moments.inputs : -1, moments.inputs : -1]
    precision = np.linalg.inv(covariance + RIDGE * np.trace(covariance) * np.eye(len(covariance)))
    diagonal = np.diagonal(precision)
    shared = precision[0] ** 2 / np.maximum(precision[0, 0] * diagonal, TINY)  # square of the partial correlation
    fast = moments.noise_bound_a2[0] >= MOST_NOISE * moments.variance_a2[0]
    return np.asarray(fast & (shared < 1.0 - MOST_NOISE))


def _possible(ratio: Array) -> Array:
    """Return gain ratios with those that no two sensors have, which are not sure, moved to the nearest possible one."""
    return np.clip(ratio, 1.0 / MOST_RATIO, MOST_RATIO)


class JunctionKnowledge(NamedTuple):
    """What is known beside the recordings of N vehicles with K branches."""

    read: Array
    """Readings by zero-current windows, bench and trust: value and standard deviation, each of drifts [1] and offsets
    [A], shape (3, 2, 2, N, K); NaN where there are none."""
    load: UnmeasuredLoad | None
    """Load that no branch measures; None: not known."""
    charge_a: Mapping[str, tuple[float, float, float]]
    """By branch: mean current over all drives as measured, mean current that the known charge makes, and standard
    deviation of the latter. [A]"""
    meter: str | None
    """Branch that has another sensor in each of the N vehicles, which are recordings of one car then."""


class _System:
    """Linear equations y = design x + error of N recordings for x = (lambda of S sensors, S offsets, N loads).

    The first rows are the junction laws, then come the charges, and last what is known of single x. Offsets and loads
    are in fractions of full scale. The prior of all x is wide and centred on 0.

    Attributes
    ----------
    places : ndarray of int of shape (N, K)
        Number of the sensor of each vehicle and branch: vehicles have all sensors in common except the meters.
    names : list of S str
        Names of the sensors.
    laws : list of N JunctionLaw
        The junction laws.
    known : list of int
        For each of the last rows: place in x of the unknown that it gives.
    """

    def __init__(
        self, vehicles: Sequence[VehicleSummary], branches: Sequence[str], known: JunctionKnowledge, scale_a: float
    ) -> None:
        N, K, self.scale_a = len(vehicles), len(branches), scale_a
        self.places = np.tile(np.arange(K), (N, 1))
        if known.meter is not None:
            self.places[1:, branches.index(known.meter)] = K + np.arange(N - 1)
        self.sensors = S = int(self.places.max()) + 1
        self.names = [branches[k] if k < K else f"{known.meter} ({vehicles[k - K + 1].vehicle})" for k in range(S)]
        self.laws = [_law(each.summary, branches, each.vehicle, scale_a) for each in vehicles]
        load = known.load or UnmeasuredLoad(mean_a=0.0, sd_a=0.0)
        given = [
            (int(self.places[j, k]) + what * S, *known.read[r, :, what, j, k].tolist())
            for r, what, j, k in np.argwhere(np.isfinite(known.read[:, 0])).tolist()
        ]
        given += [(2 * S + j, load.mean_a, load.sd_a) for j in range(N) if known.load is not None]
        self.known = [p for p, _, _ in given]
        of_gain = np.array(self.known) < S
        value, sd = np.array([each[1:] for each in given]).reshape(-1, 2).T
        design = np.zeros((N * K + len(known.charge_a) + len(given), 2 * S + N))
        charges = np.array([*known.charge_a.values()]).reshape(-1, 3) / scale_a  # mean measured = (1 + d) true + o
        charged = [branches.index(name) for name in known.charge_a]
        for i, k in enumerate(charged, start=N * K):
            design[i, S + k] = 1.0
        design[range(len(design) - len(given), len(design)), self.known] = 1.0
        self.design = design
        known_x = np.where(of_gain, np.log1p(np.where(of_gain, value, 0.0)), value / scale_a)
        self.y = np.append(np.zeros(len(design) - len(given)), known_x)
        self.covariance = block_diag(
            *(law.covariance for law in self.laws),
            np.diag(charges[:, 2] ** 2 + LAW_OFFSET_SD**2),
            np.diag(np.where(of_gain, sd / (1.0 + value), sd / scale_a) ** 2),
        )
        self.open_sd = np.repeat([OPEN_GAIN_SD, OPEN_OFFSET_SD, OPEN_LOAD_SD], [S, S, N])
        found: Array = np.zeros(2 * S + N)
        for j, law in enumerate(self.laws):
            design[(j + 1) * K - 1, S + self.places[j, law.order[0]]] = 1.0
            found[self.places[j][law.order[1:]]] = -np.log(_possible(law.value[:-1]))
        for _ in range(STEPS):  # 1 + d = exp(lambda), linear about the lambda that is found
            for j, law in enumerate(self.laws):
                first, *others = self.places[j][law.order].tolist()
                ratios, constant = slice(j * K, (j + 1) * K - 1), (j + 1) * K - 1
                gain, ratio = np.exp(found[first]), _possible(np.exp(found[first] - found[others]))
                design[ratios, first], design[ratios, others] = ratio, -np.diag(ratio)
                self.y[ratios] = law.value[:-1] - ratio + ratio * np.log(ratio)
                design[constant, [S + s for s in others]] = ratio
                design[constant, [first, 2 * S + j]] = gain * load.mean_a / scale_a, gain  # (1 + d_1) l
                self.y[constant] = law.value[-1] + design[constant, first] * found[first]
            for i, k in enumerate(charged, start=N * K):
                measured, true, _ = charges[i - N * K]
                design[i, k] = true * np.exp(found[k])
                self.y[i] = measured - design[i, k] * (1.0 - found[k])
            found = self.condition(self.open_sd)[0]

    def condition(self, sd: Array, without: int | None = None) -> tuple[Array, Array, float]:
        """Return mean (P,) and covariance (P, P) of x, and log evidence, for a prior of standard deviations (P,).

        P = 2S + N is the length of x. ``without`` is a row that is left out.
        """
        used = np.arange(len(self.y)) != (len(self.y) if without is None else without)
        A, prior, y = self.design[used], np.diag(sd**2), self.y[used]
        rows = A @ prior @ A.T + self.covariance[used][:, used]
        gain = np.linalg.solve(rows, A @ prior).T
        log_evidence = -0.5 * (y @ np.linalg.solve(rows, y) + np.linalg.slogdet(2.0 * np.pi * rows)[1])
        return gain @ y, prior - gain @ A @ prior, float(log_evidence)

    def contradictions(self) -> list[str]:
        """List known values that all other rows contradict, whatever the faults of the sensors that are not known."""
        S, found = self.sensors, []
        for row, p in enumerate(self.known, start=len(self.y) - len(self.known)):
            mean, covariance, _ = self.condition(self.open_sd, without=row)
            if abs(mean[p] - self.y[row]) > CONTRADICTION * np.sqrt(covariance[p, p] + self.covariance[row, row]):
                known, rest = (
                    f"{np.expm1(value):+z.2%}" if p < S else f"{value * self.scale_a:+.2f} A"
                    for value in (self.y[row], mean[p])
                )
                kind = ("gain error", "offset")[p // S] if p < 2 * S else ""
                name = f"{kind} of {self.names[p % S]}" if kind else "load that no branch measures"
                found.append(f"the {name} is known as {known}, the rest makes it {rest}")
        return found


class _Posterior(NamedTuple):
    """Posterior of x as n weighted draws (n, P), each with the number of its explanation; 0 is the most probable one.

    ``mean`` and ``sd`` (P,) are those of x over all explanations.
    """

    draws: Array
    weight: Array
    explanation: NDArray[np.int64]
    mean: Array
    sd: Array
    offset_probability: Array
    """Probability that each of the S sensors has an offset. [1]"""


def _posterior(system: _System) -> _Posterior:
    """Compute the posterior over the explanations: which sensors have an offset, and of which size."""
    S = system.sensors
    may = [s for s in range(S) if S + s not in system.known]
    found = []
    for size in range(min(len(may), MOST_OFFSETS) + 1):
        for chosen in combinations(may, size):
            for sizes in product(OFFSET_SIZES, repeat=size):
                sd = system.open_sd.copy()
                sd[[S + s for s in may]] = TRUSTED_OFFSET_SD
                sd[[S + s for s in chosen]] = sizes
                mean, covariance, log_weight = system.condition(sd)
                log_weight += size * np.log(FAULT_SHARE / len(OFFSET_SIZES))
                log_weight += (len(may) - size) * np.log(1.0 - FAULT_SHARE)
                found.append((log_weight, chosen, mean, covariance))
    found.sort(key=lambda each: -each[0])
    found = [each for each in found if each[0] > found[0][0] - MARGIN]
    weight = np.exp([each[0] - found[0][0] for each in found])
    weight /= weight.sum()
    centre = weight @ np.array([each[2] for each in found])
    square = [np.diagonal(covariance) + (mean - centre) ** 2 for _, _, mean, covariance in found]
    normal = norm.ppf(qmc.Sobol(len(centre), scramble=True, rng=1).random(DRAWS))
    number = np.maximum((DRAWS * weight).astype(np.int64), FEWEST_DRAWS)
    draws, with_offset = [], np.zeros(S)
    for (_, chosen, mean, covariance), n, share in zip(found, number, weight, strict=True):
        values, vectors = np.linalg.eigh(covariance)
        draws.append(mean + normal[:n] @ (vectors * np.sqrt(np.maximum(values, 0.0))).T)
        with_offset[list(chosen)] += share
    return _Posterior(
        np.concatenate(draws),
        np.repeat(weight / number, number),
        np.repeat(np.arange(len(found)), number),
        centre,
        np.sqrt(weight @ np.array(square)),
        with_offset,
    )


def _fault_probability(mean: Array, sd: Array, prior_sd: float, sound_sd: float) -> Array:
    """Return for parameters with this posterior mean and sd the probability that they are faulty, all of shape (S,).

    The prior of a faulty one is Gaussian with ``prior_sd``, which the posterior includes, of a sound one with
    ``sound_sd``. The likelihood is the posterior over the prior: Gaussian, of precision 1 / sd^2 - 1 / prior_sd^2.
    """
    precision = np.maximum(sd**-2.0 - prior_sd**-2.0, 1e-12)
    value, variance = mean / sd**2 / precision, 1.0 / precision
    open_, sound = variance + prior_sd**2, variance + sound_sd**2
    log_odds = 0.5 * (np.log(sound / open_) + value**2 * (1.0 / sound - 1.0 / open_))
    return np.asarray(1.0 / (1.0 + (1.0 - FAULT_SHARE) / FAULT_SHARE * np.exp(-np.minimum(log_odds, 700.0))))


def estimate_junction(
    vehicles: Sequence[VehicleSummary],
    branches: Sequence[str],
    known: JunctionKnowledge,
    *,
    layout: Layout,
    harm_limit: float,
) -> tuple[FleetEstimate, list[JunctionLaw], list[str], list[str]]:
    """Estimate the sensors of one vehicle; or of one car in several recordings, each with its own meter.

    Parameters
    ----------
    vehicles : sequence of VehicleSummary
        N recordings of the same sensors in K branches, except for the meter; one recording if there is no meter.
    branches : sequence of str
        Names of the K branches.
    known : JunctionKnowledge
        What is known beside the recordings.
    layout : Layout
        Has the full scale and the limits of corrections.
    harm_limit : float
        A branch is corrected if the probability of harm is below this. [1]

    Returns
    -------
    estimate : FleetEstimate
        In the form of a fleet's; drifts and offsets are means of the posterior, also where no fault is suspected; an
        offset is 0 where only the gain may be corrected.
    laws : list of N JunctionLaw
        The junction laws.
    deciding : list of N str
        Sentence on what is still open and what would decide it, for each vehicle; empty if all is known.
    contradictions : list of str
        Sentences on known values that the rest contradicts, and on gain ratios that differ at slow and fast changes.

    Raises
    ------
    FleetError
        If currents do not balance as those of a junction: a sign or a unit is wrong.
    """
    N, K, scale_a = len(vehicles), len(branches), layout.full_scale_a
    system = _System(vehicles, branches, known, scale_a)
    S, places, contradictions = system.sensors, system.places, system.contradictions()
    scale_known, posterior = any(p < S for p in system.known), _posterior(system)
    mean, sd, draws, weight = posterior.mean, posterior.sd, posterior.draws, posterior.weight
    for s in map(branches.index, known.charge_a):  # of one vehicle
        others = [p for p in system.known if p >= S and p != S + s]
        own_a = float(mean[S + s]) * scale_a
        sum_a = system.laws[0].constant_a[0] - float(mean[others].sum()) * scale_a
        if abs(own_a) > CANCELLED * scale_a and abs(sum_a) < 0.5 * abs(own_a):
            unknown = " and the load that no branch measures (--load)" if known.load is None else ""
            contradictions.append(
                f"by the charge given for {branches[s]} its sensor has an offset of {own_a:+.1f} A, but what is not "
                f"known of the offsets{unknown} sums to {sum_a:+.1f} A: check value and sign of --charge"
            )
    for vehicle, law in zip(vehicles, system.laws, strict=True):
        apart = ratios_in_doubt(stack_summaries([vehicle.summary], law.order))
        contradictions += [
            f"{vehicle.vehicle}: gains of {branches[k]} and {branches[law.order[0]]} differ between slow and fast "
            f"changes of the currents: a signal is late, filtered, or a mean over time"
            for k in np.array(law.order[1:])[apart].tolist()
        ]
    gain_fault = _fault_probability(mean[:S], sd[:S], OPEN_GAIN_SD, TRUSTED_DRIFT_SD)
    offset_fault = _fault_probability(mean[S : 2 * S], sd[S : 2 * S], OPEN_OFFSET_SD, TRUSTED_OFFSET_SD)
    offset_read = [S + s in system.known for s in range(S)]
    offset_fault = np.where(offset_read, offset_fault, posterior.offset_probability)
    fault = (1.0 - (1.0 - gain_fault) * (1.0 - offset_fault))[places]
    drift, offset, gain_sd, offset_sd = np.expm1(mean[places]), mean[S + places], sd[places], sd[S + places]
    harm, harm_of_gain, points = np.zeros((N, K)), np.zeros((N, K)), []
    for j, vehicle in enumerate(vehicles):
        faults = np.concatenate([np.expm1(draws[:, places[j]]), draws[:, S + places[j]]], axis=1)
        points.append(Points(faults, weight, posterior.explanation))
        measured, gain = vehicle.summary.mean_a / scale_a, 1.0 + faults[:, :K]
        square = measured**2 + vehicle.summary.variance_a2 / scale_a**2
        true = affine_moments(1.0 / gain, measured, square, -faults[:, K:] / gain)[:, None]
        estimate, gain_only = np.append(drift[j], offset[j]), np.append(drift[j], np.zeros(K))
        # Growth within the accuracy of the constant c is no harm: while offsets are open, a right gain can do that.
        harm[j] = harm_probability(points[j], estimate, *true, least=LAW_OFFSET_SD)
        harm_of_gain[j] = harm_probability(points[j], gain_only, *true, least=LAW_OFFSET_SD)
    # Where no offset is suspected or read, or it is open which sensor has it, the gain alone may be corrected.
    is_vague = (offset_fault[places] <= SUSPECTED) & (np.abs(offset) < SEEN * offset_sd)
    gain_alone = (harm_of_gain < harm_limit) & (gain_fault[places] > SUSPECTED) & ((harm >= harm_limit) | is_vague)
    harm, faulty = np.where(gain_alone, harm_of_gain, harm), fault > SUSPECTED
    well_known = (gain_sd <= SOUND_GAIN_SD) & (offset_sd <= SOUND_OFFSET_SD)
    offset_sd = np.where(gain_alone, np.hypot(offset_sd, offset), offset_sd)
    offset = np.where(gain_alone, 0.0, offset)
    confidence = np.array(
        [
            recovery_probability(each, np.append(*estimate)[None], (LEAST_FAULT, LEAST_FAULT))[0]
            for each, *estimate in zip(points, drift, offset, strict=True)
        ]
    )
    findings = _misfits([each.summary for each in vehicles], branches, scale_a)
    unfit = np.array([[bool(mine)] for mine in findings])
    in_doubt = not scale_known or bool(contradictions) or bool(gain_sd.min() > KNOWN_GAIN_SD)
    held_back, corrected, verdicts = decided(
        faulty,
        unfit=unfit,
        in_doubt=np.array(in_doubt),
        still=gain_sd > KNOWN_GAIN_SD,
        harmful=~(harm < harm_limit),
        beyond=(np.abs(drift) > layout.limits.drift) | (np.abs(offset * scale_a) > layout.offset_limit_a),
        sound=(~faulty & well_known).all(axis=1) & ~unfit[:, 0] & scale_known & (not contradictions),
    )
    found = FleetEstimate(
        drift=drift,
        offset_a=offset * scale_a,
        drift_sd=gain_sd * (1.0 + drift),
        offset_sd_a=offset_sd * scale_a,
        hardware_drift=np.zeros(N),
        hardware_offset_a=np.zeros((N, K)),
        hardware_probability=np.full(N, np.nan),
        confidence=confidence,
        fault_probability=fault,
        harm_probability=harm,
        identifiable=gain_sd <= KNOWN_GAIN_SD,
        points=points,
        order=tuple(range(K)),
        full_scale_a=scale_a,
        corrected=corrected,
        held_back=held_back,
        verdicts=verdicts,
        explanations=[_explanations(each, branches, scale_a) for each in points],
        findings=findings,
        evidence=np.zeros((N, 3, 0)),
    )
    deciding = [
        "; ".join(
            [
                *(each.text for each in mine[:1]),
                *_deciding(branches, gain_sd[j], offset_sd[j], scale=scale_known, load=known.load is not None),
            ]
        )
        for j, mine in enumerate(findings)
    ]
    return found, system.laws, deciding, contradictions


def _misfits(summaries: Sequence[DriveSummary], branches: Sequence[str], scale_a: float) -> list[list[SensorFinding]]:
    """Find per vehicle what gain errors and offsets do not explain, other than noise.

    Without a fleet no finding names the sensor.
    """
    K = len(branches)
    usual = UsualMisfits(
        misfit_a=np.full(len(CAUSES), USUAL_MISFIT * scale_a),
        residual_a2=(USUAL_RESIDUAL * scale_a) ** 2,
        fast_a2=(USUAL_RESIDUAL * scale_a) ** 2,
        residual_spread=USUAL_SPREAD,
        slope_spread=np.ones(K),
        model_error_a=np.full(K, scale_a),
        other=np.zeros(K, np.intp),
        follows=np.zeros(K),
        follows_a=np.full(K, scale_a),
        spike_rate=1.0,
    )
    found = find_misfits(summaries, np.zeros((1, K)), usual, full_scale_a=scale_a, branches=branches)
    return [[each for each in mine if each.cause != "noise"] for mine in found]


def named_ratios(law: JunctionLaw, branches: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return K - 1 gain ratios (value, standard deviation) by name "a / b", where branch a comes before b. [1]"""
    first, *others = law.order
    ratios, sds = _possible(law.value[:-1]).tolist(), np.sqrt(np.diagonal(law.covariance)[:-1]).tolist()
    found = {}
    for k, ratio, sd in sorted(zip(others, ratios, sds, strict=True)):
        above, below, value = (first, k, ratio) if first < k else (k, first, 1.0 / ratio)
        found[f"{branches[above]} / {branches[below]}"] = (value, value * sd / ratio)
    return found


def _explanations(points: Points, branches: Sequence[str], scale_a: float) -> list[Explanation]:
    """List explanations by falling probability, each with its mean faults above :data:`SEEN` deviations.

    Explanations in which the same faults are above it count as one, with the sizes of the most probable of them.
    """
    K, found = len(branches), dict[bytes, tuple[float, Array, Mask]]()
    for number in range(points.explanation[-1] + 1):
        own = points.explanation == number
        share, faults = float(points.weight[own].sum()), points.faults[own]
        mean = points.weight[own] @ faults / share
        clear = np.abs(mean) > SEEN * np.sqrt(points.weight[own] @ (faults - mean) ** 2 / share)
        before, kept, _ = found.get(clear.tobytes(), (0.0, mean, clear))
        found[clear.tobytes()] = (before + share, kept, clear)
    return [
        Explanation(
            probability=min(share, 1.0),
            drift={name: float(mean[k]) for k, name in enumerate(branches) if clear[k]},
            offset_a={name: float(mean[K + k] * scale_a) for k, name in enumerate(branches) if clear[K + k]},
        )
        for share, mean, clear in sorted(found.values(), key=lambda each: -each[0])
    ]


def _deciding(branches: Sequence[str], gain_sd: Array, offset_sd: Array, *, scale: bool, load: bool) -> list[str]:
    """Say what is not known of the sensors, and what would tell it; ``scale``, ``load``: whether these are known."""
    if not scale:
        return [
            f"only ratios of gains are known: name a sensor that you trust (--trusted {branches[0]}), or give bench "
            f"readings (--readings)"
        ]
    if gain_sd.min() > KNOWN_GAIN_SD:
        return [f"no gain is known better than to +-{gain_sd.min():.1%}: a better reference would decide"]
    texts = []
    if gains := [name for name, sd in zip(branches, gain_sd, strict=True) if sd > KNOWN_GAIN_SD]:
        texts.append(f"the gain of {', '.join(gains)} needs a drive in which that current varies more")
    if offsets := [name for name, sd in zip(branches, offset_sd, strict=True) if sd > KNOWN_OFFSET_SD]:
        more = "" if load else ", or the load that no branch measures (--load)"
        whose = ", ".join(offsets)
        texts.append(f"the offset of {whose} needs a zero-current window (contactors open), a bench reading{more}")
    return texts
