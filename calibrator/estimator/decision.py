"""Find the estimate for each vehicle, the confidence in it, and the probability that correction makes a branch worse.

:func:`estimate_rows` does it for N vehicles: fault models of the fleet -> weighted draws -> one posterior per vehicle
(:class:`FleetPoints`) -> :class:`RowsEstimate`.

The estimate is the candidate that is most probably "recovered"; that probability is the confidence (M18). Correction
with d_hat, o_hat makes a branch worse on a drive with the moments E[i], E[i^2] where

    alpha^2 E[i^2] + 2 alpha beta E[i] + beta^2  >  d^2 E[i^2] + 2 d o E[i] + o^2                               (M19)

with alpha = (1 + d) / (1 + d_hat) - 1 and beta = (o - o_hat) / (1 + d_hat); its probability is a sum over the draws.
Equations (M18) and (M19) are those of docs/method.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import starmap

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.estimator.evidence import EvidenceRows, ParameterPlaces
from calibrator.estimator.posterior import Draws, FaultModel, explain, weigh
from calibrator.score import TOLERANCE
from ecu_node.parameters import Explanation, SensorFinding

__all__ = [
    "FleetEstimate",
    "FleetPoints",
    "Points",
    "RowsEstimate",
    "SensorEstimate",
    "affine_moments",
    "best_estimate",
    "decided",
    "estimate_rows",
    "group_centres",
    "harm_probability",
    "posterior_points",
    "recovery_probability",
]

NEGLIGIBLE = 1e-8
"""Weight of a draw below which it is left out. [1]"""
CANDIDATES, LEAST_CANDIDATE = 8, 0.01
"""Number of explanations that are tried as estimates, and least probability of those after the first. [1]"""
EQUALLY_GOOD = 0.01
"""Difference of confidence below which the estimate of the more probable explanation is taken. [1]"""
SAME = 1e-3
"""Two offsets cancel if the magnitude of their sum, over full scale, is at most this: neither is known better. [1]"""
RESOLUTION = 3e-4
"""Drift [1] and offset in fractions of full scale below which they are zero: no sensor's resolution is finer."""
MOST_GAIN_SD = 0.1
"""Standard deviation from which on a gain counts as unknown: smaller than the faults that matter. [1]"""
LEAST_HARDWARE = 0.025
"""Hardware drift up to which vehicles differ without a fault: three times the 0.8 % by which a branch of one sound car
differs between its trips (docs/limits.md). [1]"""
LEAST_EXPLANATION = 1e-5
"""Least probability of an explanation that is reported. [1]"""
CENTRAL = 0.6827
"""Share of a normal distribution within one standard deviation. [1]"""
LIKE_ESTIMATE = (0.1, 0.001)
"""Faults of an explanation count as those of the estimate if none differs by more than this share of the estimate's
largest fault, plus this drift [1] or offset over full scale. [1]"""


@dataclass(frozen=True)
class Points:
    """Posterior of one vehicle as weighted points.

    Attributes
    ----------
    faults : ndarray of shape (n, 2K)
        Drifts [1], then offsets in fractions of full scale.
    weight : ndarray of shape (n,)
        Weights of the points; they sum to 1, apart from negligible draws that are left out.
    explanation : ndarray of int of shape (n,)
        Number of the explanation that a point comes from, from 0 on.
    """

    faults: Array
    weight: Array
    explanation: NDArray[np.int64]


@dataclass(frozen=True)
class FleetPoints(Points):
    """Posterior of a vehicle of a fleet.

    Attributes
    ----------
    hardware : ndarray of shape (n, 1 + K)
        Drift [1] and offsets, in fractions of full scale, of the hardware fault of the point's explanation.
    load : ndarray of shape (n,)
        Load without a sensor, in fractions of full scale; 0 if the vehicle is in a group, which shares its load.
    group : ndarray of int of shape (n,)
        0, or from 1 on the number of the group of :func:`group_centres` that the vehicle belongs to.
    """

    hardware: Array
    load: Array
    group: NDArray[np.int64]


def group_centres(models: Sequence[FaultModel]) -> Array:
    """Return the constant of the feeding branch that each of g groups shares, over full scale, shape (g,).

    Groups are those of the model that has most of them.
    """
    return max((model.prior.group_centre for model in models), key=len)


def posterior_points(models: Sequence[tuple[FaultModel, Draws, Array]]) -> list[FleetPoints]:
    """Return the posterior of each of N vehicles as weighted points, over all fault models that explain their fleet.

    Each model comes with the draws of the N vehicles under it, M from each of Q explanations, and with their weights as
    :func:`.weigh` returns them: shape (N, Q, M, 1 + g), for no group and for each of the g groups of the model.
    """
    centres, parts = group_centres([model for model, _, _ in models]), []
    for i, (model, draws, weights) in enumerate(models):
        K = draws.values.shape[3] // 3
        at, shared, feed, fitted = ParameterPlaces(K), draws.shared, draws.feed, draws.fits.theta
        j, q, m, g = np.nonzero(weights > NEGLIGIBLE)
        x = draws.values[j, q, m]
        gain, omega = np.exp(x[:, at.gains] + shared[K : 2 * K]), x[:, at.offsets]
        offset = omega * gain
        # An offset that a group shares belongs to the sensor; a load that it shares does not, and is taken out.
        alone, of_group = offset[:, feed] == 0.0, np.append(0.0, model.prior.group_centre)[g]
        if shared[-1]:
            offset[:, feed] += np.where(alone, of_group, 0.0)
        else:
            offset[:, feed] -= np.where(alone, 0.0, of_group * gain[:, feed])
        total = offset + shared[:K]
        cancel = (omega == 0.0) & (np.abs(total) <= SAME)  # shares of a group and of all sensors
        hardware = fitted[j, q, at.hardware_offsets]
        same = [1 + np.argmin(np.abs(centres - centre)) for centre in model.prior.group_centre]
        part = FleetPoints(
            faults=np.hstack([gain - 1.0, np.where(cancel, 0.0, total)]),
            weight=weights[j, q, m, g] * model.probability,
            explanation=(q * weights.shape[3] + g) * len(models) + i,
            hardware=np.column_stack([np.expm1(fitted[j, q, at.eta]), hardware, -hardware.sum(axis=1)]),
            load=np.where(g == 0, x[:, at.load], 0.0),
            group=np.array([0, *same])[g],
        )
        parts.append((j, *vars(part).values()))
    vehicle, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(vehicle, kind="stable")
    ends = np.cumsum(np.bincount(vehicle, minlength=len(models[0][2])))[:-1]
    found = starmap(FleetPoints, zip(*(np.split(column[order], ends) for column in columns), strict=True))
    return [replace(each, explanation=np.unique(each.explanation, return_inverse=True)[1]) for each in found]


def best_estimate(points: Points, smallest: Array) -> tuple[Array, float]:
    """Choose the estimate: the candidate that is most probably "recovered".

    Candidates are the mean and the two heaviest points of each of the most probable explanations. Of nearly equal ones
    that of the more probable explanation is taken.

    Parameters
    ----------
    points : Points
        Posterior of one vehicle.
    smallest : ndarray of shape (2,)
        The true vectors of drifts and of offsets count as at least so long: the smallest faults of the fleet. [1]

    Returns
    -------
    faults : ndarray of shape (2K,)
        Drifts [1] and offsets in fractions of full scale.
    confidence : float
        Posterior probability that the vector of drifts and that of offsets are within 10 % of the truth in the
        Euclidean norm.
    """
    mass = np.bincount(points.explanation, points.weight)
    tried: list[Array] = []
    for c in np.argsort(-mass, kind="stable")[:CANDIDATES]:
        if tried and mass[c] < LEAST_CANDIDATE:
            break
        own = np.flatnonzero(points.explanation == c)
        tried.append(points.weight[own] @ points.faults[own] / mass[c])
        tried += [points.faults[i] for i in own[np.argsort(-points.weight[own], kind="stable")[:2]]]
    candidates = np.array(tried)
    candidates[np.abs(candidates) < RESOLUTION] = 0.0
    covered = recovery_probability(points, candidates, smallest)
    best = int(np.argmax(covered >= covered.max() - EQUALLY_GOOD))
    return candidates[best], float(min(covered[best], 1.0))


def recovery_probability(points: Points, candidates: Array, smallest: Sequence[float] | Array) -> Array:
    """Compute for each candidate the share of a posterior for which it counts as "recovered".

    Parameters
    ----------
    points : Points
        Posterior of one vehicle.
    candidates : ndarray of shape (C, 2K)
        Drifts [1] and offsets in fractions of full scale.
    smallest : sequence of float or ndarray of shape (2,)
        The true vectors of drifts and of offsets count as at least so long. [1]

    Returns
    -------
    ndarray of shape (C,)
        Probability that the vector of drifts and that of offsets are within 10 % of the truth in the Euclidean norm.
    """
    K = candidates.shape[1] // 2
    near = np.ones((len(points.faults), len(candidates)), bool)
    for part, least in zip((slice(0, K), slice(K, 2 * K)), smallest, strict=True):
        faults, tried = points.faults[:, part], candidates[:, part]
        size2 = np.sum(faults**2, axis=1)
        distance2 = size2[:, None] - 2.0 * faults @ tried.T + np.sum(tried**2, axis=1)
        near &= distance2 <= (TOLERANCE * np.maximum(np.sqrt(size2), least))[:, None] ** 2
    return np.asarray(points.weight @ near)


def harm_probability(points: Points, estimate: Array, mean: Array, mean_square: Array, *, least: float = 0.0) -> Array:
    """Compute for each branch the probability that its correction makes it worse, (M19) of docs/method.md.

    Parameters
    ----------
    points : Points
        Posterior of one vehicle.
    estimate : ndarray of shape (2K,)
        Drifts [1] and offsets in fractions of full scale that the branches would be corrected with.
    mean, mean_square : ndarray of shape (D, K), or of shape (D, n, K) if they differ between the points
        Moments of the true currents on D drives, in fractions of full scale and their squares.
    least : float
        By how much a root mean square error must grow to count, in fractions of full scale.

    Returns
    -------
    ndarray of shape (K,)
        Probability that the branch gets worse on at least one of the drives; 0 where nothing would be corrected.
    """
    K = len(estimate) // 2
    d, o, d_hat, o_hat = points.faults[:, :K], points.faults[:, K:], estimate[:K], estimate[K:]
    alpha, beta = (1.0 + d) / (1.0 + d_hat) - 1.0, (o - o_hat) / (1.0 + d_hat)
    worse = np.zeros(d.shape, bool)
    for m, square in zip(mean, mean_square, strict=True):
        before, after = (g**2 * square + 2.0 * g * c * m + c**2 for g, c in ((d, o), (alpha, beta)))
        worse |= np.sqrt(np.maximum(after, 0.0)) > np.sqrt(np.maximum(before, 0.0)) + least
    harm = points.weight @ (worse & ((d_hat != 0.0) | (o_hat != 0.0)))
    return np.asarray(np.minimum(harm, 1.0))


def affine_moments(factor: Array, mean: Array, mean_square: Array, added: Array) -> Array:
    """Return mean and mean square of the currents factor * x + added, stacked, from those of the currents x."""
    square = factor**2 * np.maximum(mean_square, mean**2) + 2.0 * factor * added * mean + added**2
    return np.stack([factor * mean + added, square])


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorEstimate:
    """Estimated sensor faults of N vehicles with K branches, branches in the vehicles' own order.

    Attributes
    ----------
    drift, offset_a, drift_sd, offset_sd_a : ndarray of shape (N, K)
        Sensor faults and their standard deviations; in a fleet these are the distances from the estimate within which
        68 % of the posterior lies. [1], [A]
    hardware_drift, hardware_probability, confidence : ndarray of shape (N,)
        Drift of a hardware fault; probability of a hardware fault, as which a drift up to :data:`LEAST_HARDWARE` alone
        does not count (NaN for single junctions); probability that the estimate is recovered. [1]
    hardware_offset_a : ndarray of shape (N, K)
        Offsets of a hardware fault. [A]
    fault_probability, harm_probability : ndarray of shape (N, K)
        Probability that the sensor is faulty; that its correction makes the branch worse. [1]
    identifiable : ndarray of bool of shape (N, K)
        Whether drives or readings show the gain of the sensor well enough for a correction.
    points : sequence of N Points
        Posterior of each vehicle.
    order : tuple of int
        Branches in the order of the points: branch k of the points is branch ``order[k]`` of the vehicles. Offsets of
        the points are in fractions of full scale.
    full_scale_a : float
        Full scale of the junction. [A]
    """

    drift: Array
    offset_a: Array
    drift_sd: Array
    offset_sd_a: Array
    hardware_drift: Array
    hardware_offset_a: Array
    hardware_probability: Array
    confidence: Array
    fault_probability: Array
    harm_probability: Array
    identifiable: Mask
    points: Sequence[Points]
    order: tuple[int, ...]
    full_scale_a: float

    @property
    def faulty(self) -> Mask:
        """Whether a fault was found in each sensor: it is corrected if nothing speaks against it. Shape (N, K)."""
        return np.asarray((self.drift != 0.0) | (self.offset_a != 0.0))

    def pit(self, drift: Array, offset_a: Array) -> tuple[Array, Array]:
        """Return the shares of the posterior below the true drifts [1] and below the true offsets [A], each (N, K).

        This is the probability integral transform of the truth. Half of the share that lies exactly at the truth (of a
        sensor without fault) counts as below.
        """
        place, N, K = np.argsort(self.order), *drift.shape
        truth = np.concatenate([drift[:, list(self.order)], offset_a[:, list(self.order)] / self.full_scale_a], axis=1)
        below = np.zeros((N, 2 * K))
        for j, points in enumerate(self.points):
            less, same = points.faults < truth[j] - 1e-9, np.abs(points.faults - truth[j]) <= 1e-9
            below[j] = points.weight @ (less + 0.5 * same)
        return below[:, :K][:, place], below[:, K:][:, place]


@dataclass(frozen=True, kw_only=True, eq=False)
class RowsEstimate(SensorEstimate):
    """Estimate from evidence rows, before it is decided what is corrected.

    Attributes
    ----------
    points : sequence of N FleetPoints
        Posterior of each vehicle.
    supports : sequence of N sequences of (float, ndarray of shape (3K + 1,))
        Explanations by falling probability, each with its probability [1] and its hardware drift, K hardware offsets, K
        drifts and K offsets; drifts [1], offsets in fractions of full scale, branches in the order of ``order``.
    """

    points: Sequence[FleetPoints]
    supports: Sequence[Sequence[tuple[float, Array]]]


@dataclass(frozen=True, kw_only=True, eq=False)
class FleetEstimate(SensorEstimate):
    """Estimate of whole vehicles, with what is decided and reported.

    Attributes
    ----------
    corrected : ndarray of bool of shape (N, K)
        Whether the node is to correct the branch.
    held_back : ndarray of str of shape (N, K)
        Why a fault that was found is not corrected; empty if it is corrected, or no fault was found.
    verdicts : sequence of N str
        Verdict on each vehicle: "corrected", "no sensor fault" or "cannot tell".
    explanations : sequence of N sequences of Explanation
        Explanations by falling probability, at least one.
    findings : sequence of N sequences of SensorFinding
        What gain errors and offsets do not explain, and what the vehicle shares with others.
    evidence : ndarray of shape (N, 3, 5K)
        Value, standard deviation and prediction of each row, see :func:`.reported_evidence`; (N, 3, 0) for single
        junctions.
    """

    corrected: Mask
    held_back: NDArray[np.str_]
    verdicts: Sequence[str]
    explanations: Sequence[Sequence[Explanation]]
    findings: Sequence[Sequence[SensorFinding]]
    evidence: Array


def estimate_rows(
    rows: EvidenceRows,
    models: Sequence[FaultModel],
    *,
    feed: int,
    mean: Array,
    mean_square: Array,
    usual: Array,
    order: Sequence[int] | None = None,
    full_scale_a: float = 1.0,
) -> RowsEstimate:
    """Estimate the sensor faults of N vehicles from their evidence rows.

    Parameters
    ----------
    rows : EvidenceRows
        Evidence of the vehicles.
    models : sequence of FaultModel
        Fault models that explain their fleet.
    feed : int
        Number of the branch that carries loads without a sensor, in the order of the rows.
    mean, mean_square : ndarray of shape (N, K)
        Mean and mean square of the measured currents, over full scale and its square.
    usual : ndarray of shape (2, K)
        Mean and mean square of each current on the fleet's usual drive, over full scale and its square: medians over
        the vehicles, which count as ideal currents.
    order : sequence of int or None
        Branches in the order of the rows: branch k of the rows is branch ``order[k]`` of the vehicles; None: branch k.
    full_scale_a : float
        Full scale of the junction; 1: the offsets of the estimate are fractions of it. [A]

    Returns
    -------
    RowsEstimate
        Vehicles in the order of the rows; branches in their own order, except for ``points`` and ``supports``.
    """
    N, K = mean.shape
    order = tuple(range(K) if order is None else order)
    place = np.argsort(order)
    explained = []
    for model in models:
        draws = explain(rows, model, feed=feed)
        explained.append(
            (model, draws, np.sum([share * weigh(draws, prior)[0] for share, prior in model.priors], axis=0))
        )
    smallest = np.array([models[0].prior.gain.smallest, models[0].prior.offset.smallest])
    estimate, sd, confidence, harm = np.zeros((N, 2 * K)), np.zeros((N, 2 * K)), np.zeros(N), np.zeros((N, K))
    fault, hardware, points, supports = np.zeros((N, K)), np.zeros((N, 1 + K)), posterior_points(explained), []
    hardware_probability = np.zeros(N)
    for j, found in enumerate(points):
        estimate[j], confidence[j] = best_estimate(found, smallest)
        # Each point has true currents of its own, i = (i_m - o) / (1 + d) on the vehicle's drives, and on the usual one
        # i = (1 + d_h) i_s + o_h. Their mean decides whether a gain error and an offset beside it add up or cancel.
        gain, hardware_gain = 1.0 + found.faults[:, :K], 1.0 + found.hardware[:, :1]
        own = affine_moments(1.0 / gain, mean[j], mean_square[j], -found.faults[:, K:] / gain)
        drives = np.stack([own, affine_moments(hardware_gain, usual[0], usual[1], found.hardware[:, 1:])], axis=1)
        harm[j] = harm_probability(found, estimate[j], *drives)
        sd[j] = _central_sd(found, estimate[j])
        all_shared = (estimate[j] != 0.0) & np.isclose(sd[j], 0.0, atol=1e-9)  # one value in all draws
        sd[j, all_shared] = RESOLUTION
        faulty = found.faults != 0.0
        fault[j] = np.minimum(found.weight @ (faulty[:, :K] | faulty[:, K:]), 1.0)
        supports.append(_supports(found))
        hardware[j] = _nearest(supports[j], estimate[j])[: 1 + K]
        of_hardware = [each for each, (d, *values) in supports[j] if abs(d) > LEAST_HARDWARE or any(values[:K])]
        hardware_probability[j] = min(sum(of_hardware), 1.0)
    confidence[~rows.known.any(axis=1)] = 0.0  # nothing is known of these: a prior is no evidence
    return RowsEstimate(
        drift=estimate[:, place],
        offset_a=estimate[:, K + place] * full_scale_a,
        drift_sd=sd[:, place],
        offset_sd_a=sd[:, K + place] * full_scale_a,
        hardware_drift=hardware[:, 0],
        hardware_offset_a=hardware[:, 1 + place] * full_scale_a,
        hardware_probability=hardware_probability,
        confidence=confidence,
        fault_probability=fault[:, place],
        harm_probability=harm[:, place],
        identifiable=_identifiable(rows)[:, place],
        supports=supports,
        points=points,
        order=order,
        full_scale_a=full_scale_a,
    )


def _central_sd(points: Points, estimate: Array) -> Array:
    """Return each parameter's distance from its estimate within which 68 % of the posterior lies, shape (2K,)."""
    sd, total = np.zeros(len(estimate)), points.weight.sum()
    exactly = points.weight @ (points.faults == estimate)
    for i in np.flatnonzero(exactly < CENTRAL * total):
        away = np.abs(points.faults[:, i] - estimate[i])
        order = np.argsort(away, kind="stable")
        inside = np.cumsum(points.weight[order])
        sd[i] = away[order[min(int(np.searchsorted(inside, CENTRAL * inside[-1])), len(order) - 1)]]
    return sd


def _supports(points: FleetPoints) -> list[tuple[float, Array]]:
    """List :attr:`RowsEstimate.supports` of a vehicle.

    Explanations whose parameters have the same signs count as one, with the values of the most probable of them.
    """
    share = np.bincount(points.explanation, points.weight)
    parameters = np.hstack([points.hardware, points.faults])
    total = np.zeros((len(share), parameters.shape[1]))
    np.add.at(total, points.explanation, points.weight[:, None] * parameters)
    found: dict[bytes, tuple[float, Array]] = {}
    for i in np.argsort(-share, kind="stable"):
        if share[i] >= LEAST_EXPLANATION:
            values = total[i] / share[i]
            signs = np.sign(np.where(np.abs(values) < 1e-9, 0.0, values)).tobytes()
            before, kept = found.get(signs, (0.0, values))
            found[signs] = (before + float(share[i]), kept)
    return sorted(found.values(), key=lambda item: -item[0])


def _nearest(supports: list[tuple[float, Array]], estimate: Array) -> Array:
    """Return the values of the most probable support whose sensor faults are like the estimate's; zeros without one."""
    share, least = LIKE_ESTIMATE
    for _, values in supports:
        if np.abs(values[-len(estimate) :] - estimate).max() < share * np.abs(estimate).max() + least:
            return values
    return np.zeros(len(estimate) // 2 * 3 + 1)


def _identifiable(rows: EvidenceRows) -> Mask:
    """Return whether a slope, gain ratio or bench reading shows each gain better than :data:`MOST_GAIN_SD`, (N, K)."""
    at, sd = rows.places, np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2))
    best = np.minimum(sd[:, at.slopes], sd[:, at.gain_reads])
    best[:, 1:] = np.minimum(best[:, 1:], sd[:, at.ratios])
    return np.asarray(best < MOST_GAIN_SD)


def decided(
    faulty: Mask, *, unfit: Mask, in_doubt: Mask, still: Mask, harmful: Mask, beyond: Mask, sound: Mask
) -> tuple[NDArray[np.str_], Mask, list[str]]:
    """Return why faults are not corrected (N, K), which branches are corrected (N, K), and the verdicts of N vehicles.

    The arguments from ``unfit`` to ``beyond`` are reasons not to correct and broadcast to (N, K); the first one that
    applies is reported. ``sound`` (N,) says which vehicles have no sensor fault.
    """
    reasons = {
        "": ~faulty,
        "does not fit": unfit,
        "reference in doubt": in_doubt,
        "moved too little": still,
        "harm limit": harmful,
        "beyond the limits": beyond,
    }
    held_back = np.select([np.broadcast_to(each, faulty.shape) for each in reasons.values()], list(reasons), "")
    corrected = faulty & (held_back == "")
    verdicts = np.select([corrected.any(axis=1), sound], ["corrected", "no sensor fault"], "cannot tell")
    return held_back, corrected, verdicts.tolist()
