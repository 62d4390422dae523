"""Estimate the sensor faults of a fleet: learn what its vehicles have in common, then each vehicle by itself.

    summaries -> fleet model, evidence rows (learn_fleet) -> fault models of the fleet -> FleetReference
    summaries of any vehicles + FleetReference (estimate_vehicles) -> explanations -> decision, checks -> FleetEstimate

The estimate of a vehicle does not depend on which others are estimated in the same call.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import compress

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.estimator.checks import UsualMisfits, find_misfits, learn_usual_misfits
from calibrator.estimator.decision import (
    LEAST_HARDWARE,
    FleetEstimate,
    RowsEstimate,
    SensorEstimate,
    decided,
    estimate_rows,
    group_centres,
)
from calibrator.estimator.evidence import (
    EvidenceRows,
    FleetMoments,
    RowPlaces,
    collect_rows,
    densest_clusters,
    evidence_names,
    fit_fleet_model,
    ratios_in_doubt,
    stack_summaries,
)
from calibrator.estimator.learning import LEAST_SHARED, centre_rows, learn_fault_models
from calibrator.estimator.posterior import FaultModel, Spread
from calibrator.estimator.prior import Prior
from calibrator.estimator.readings import (
    CONTRADICTION,
    FEWEST_TRUSTED,
    TRUSTED_OFFSET_SD,
    untrusted_vehicles,
    with_knowledge,
)
from calibrator.estimator.settings import CONFIDENT, FEWEST_VEHICLES, HARM_LIMIT, SUSPECTED
from calibrator.summaries.moments import DriveSummary
from calibrator.terminal.text import counted
from ecu_node.layout import UnmeasuredLoad
from ecu_node.parameters import Explanation, SensorFinding

__all__ = ["HARM_LIMIT", "FleetEstimate", "FleetReference", "estimate_vehicles", "learn_fleet", "reported_evidence"]

MOST_RATIO, SURE = 3.0, 0.9
"""Gain ratio that no two sensors have, and partial correlation from which on a ratio is not due to noise. [1]"""
LEAST_OWN = 1e-9
"""Least share of a current's variance that is taken to be independent of the other currents. [1]"""
LEAST_SAID = 0.005
"""Least probability of a cause that a notice names. [1]"""
LEFT_OUT_CAUSES = ("spikes", "outliers")
"""Causes of findings whose samples are left out of the summary: they do no harm to the vehicle's other branches."""
LINEAR_CAUSES = (*LEFT_OUT_CAUSES, "noise", "switching")
"""Causes of findings with which a sensor still has a gain and an offset."""
VARIANT_SHARE, VARIANT_SPREAD, FEWEST_VARIANT = 0.15, 0.012, 4
"""Least share of the fleet, half width of the hardware drift, and least number of vehicles of a variant. [1]"""
ALIKE = 0.02
"""Distance up to which slopes of a vehicle count as alike, and as those of most: sound vehicles differ by less. [1]"""
WORSE_SUM, WORSE_SUM_A = 1.5, 0.0025
"""An estimate is wrong with which the sum of the currents scatters more by this factor [1] and by this share of full
scale."""
MOST_SUM, MOST_SUM_A = 0.25, 0.03
"""Currents do not cancel if their sum scatters by more than this share of what the largest of them does, and by this
share of full scale: a heater without a sensor stays below."""


@dataclass(frozen=True, kw_only=True)
class FleetReference:
    """What was learnt from a fleet, with which every vehicle of its kind can be estimated.

    Attributes
    ----------
    branches : tuple of str
        Names of the K branches, in the vehicles' own order.
    order : tuple of int
        Branches in the order of the estimator, in which the one whose current varies most is first: branch k there is
        ``branches[order[k]]``.
    feed : int
        Place of the feeding branch in that order.
    read_out : ndarray of shape (M + 1, K)
        Read-out of the fleet model: ideal currents over the inputs, branches in their own order. [A]
    usual_correlation : ndarray of shape (3K, 3K)
        Usual correlation of the evidence rows that come from drives. [1]
    models : tuple of FaultModel
        Fault models that explain the fleet, by falling probability.
    usual_slopes : ndarray of shape (K,)
        Medians over the vehicles of the logarithms of the slopes, in the order of ``order``. [1]
    usual : ndarray of shape (2, K)
        Mean over full scale, and mean square over its square, of the measured currents: medians over the vehicles.
    misfits : UsualMisfits or None
        How far sensors of the fleet usually are from having one gain and one offset; None: not known.
    full_scale_a : float
        Full scale of the junction. [A]
    load : UnmeasuredLoad or None
        Load that no branch measures, if it is known.
    vehicles : int
        Number of vehicles learnt from.
    carried : bool
        Whether enough trusted vehicles carry the reference, so that the fleet may be small.
    sums_a : (float, float)
        Median junction sum of the trusted vehicles that carry the reference, and the junction sum on which most of the
        others agree; NaN if there are too few, or they do not agree. [A]
    zero_trusted : bool
        Whether the offsets of trusted vehicles are taken as zero, too. Not if their junction sum differs from that of
        the others, and that of the others is the expected load.
    load_denied : bool
        Whether the currents of most vehicles sum to zero although a load is declared, and no offset was read.
    agreeing : tuple of float
        For each branch in ``branches``, share of the vehicles whose slopes agree. [1]
    variants : tuple of float
        Logarithms of the factors on all currents of two variants of the vehicle; empty if there is only one. [1]
    distrusted : mapping of int to str
        How vehicles that the user trusts contradict that trust, by position among those given to learn from.
    unbalanced : int
        Number of vehicles given in which a sign or unit is wrong, and from which nothing was learnt.
    """

    branches: tuple[str, ...]
    order: tuple[int, ...]
    feed: int
    read_out: Array
    usual_correlation: Array
    models: tuple[FaultModel, ...]
    usual_slopes: Array
    usual: Array
    misfits: UsualMisfits | None
    full_scale_a: float
    load: UnmeasuredLoad | None
    vehicles: int
    carried: bool
    sums_a: tuple[float, float]
    zero_trusted: bool
    load_denied: bool
    agreeing: tuple[float, ...]
    variants: tuple[float, ...]
    distrusted: Mapping[int, str]
    unbalanced: int

    @property
    def ordered(self) -> list[str]:
        """Names of the branches in the order of ``order``: the one that varies most first."""
        return [self.branches[k] for k in self.order]

    @property
    def in_doubt(self) -> bool:
        """Whether the fleet is too small, or denies its declared load: only trusted vehicles may be corrected."""
        return not self.carried and (self.vehicles < FEWEST_VEHICLES or self.load_denied)

    @property
    def expected_a(self) -> float:
        """Mean junction sum that faultless sensors show: the unmeasured load, positive if it takes current. [A]"""
        spread, K = self.models[0].spread, len(self.branches)
        return float((spread.mean[RowPlaces(K).junction] - spread.shared[:K].sum()) * self.full_scale_a)

    def details(self) -> dict[str, object]:
        """Return what the record of the run keeps of the reference."""
        ordered, model = self.ordered, self.models[0]
        prior, spread = model.prior, np.sqrt(np.diag(model.spread.covariance))
        return {
            "reference": {
                "agreeing_share": dict(zip(self.branches, self.agreeing, strict=True)),
                "unmeasured_a": self.expected_a,
                "read_out": dict(zip(self.branches, self.read_out.T.tolist(), strict=True)),
            },
            "evidence": evidence_names(ordered),
            "hyperparameters": {
                "hardware_share": float(prior.counts[1:].sum()),
                "drift_magnitude": [prior.gain.low, prior.gain.high],
                "offset_magnitude": [prior.offset.low, prior.offset.high],
                "model_spread": dict(zip(ordered, spread[: len(ordered)].tolist(), strict=True)),
                "log_evidence": model.log_evidence,
                "models": [model.probability for model in self.models],
            },
        }

    @property
    def notices(self) -> list[str]:
        """What may be wrong about the fleet as a whole, one line each."""
        scale_a, ordered = self.full_scale_a, self.ordered
        K, feed = len(ordered), ordered[self.feed]
        notices = []
        if self.load is not None and self.load_denied:
            notices.append(
                f"the currents of most vehicles sum to {self.sums_a[1]:+z.1f} A, as if without a load, and one of "
                f"{self.load.mean_a:g} A is declared: nothing new is corrected; check that load, or read an offset"
            )
        elif self.in_doubt:
            notices.append(
                f"{self.vehicles} vehicles are few for a fleet that is compared with itself: nothing is corrected; at "
                f"least {FEWEST_VEHICLES} are needed, or {FEWEST_TRUSTED} bench-checked vehicles (--trusted)"
            )
        if self.unbalanced:
            notices.append(
                f"in {counted(self.unbalanced, 'vehicle')} the currents do not balance, as a sign or unit is wrong: "
                f"nothing is learnt from them"
            )
        best = self.models[0]
        constant = best.spread.mean[RowPlaces(K).junction]
        trusted_a, others_a = self.sums_a
        apart = (
            f"the currents of trusted vehicles sum to {trusted_a:+z.1f} A, those of most others to {others_a:+z.1f} A"
        )
        if not self.zero_trusted:
            notices.append(
                f"{apart}: the zero of the trusted ones is not believed, but their gains; read offsets again"
            )
        elif abs(trusted_a - others_a) > LEAST_SHARED * scale_a:
            notices.append(
                f"{apart}: the others are compared with the trusted ones, as if they shared an offset; read an "
                f"offset of one of them, as the zero of the trusted ones may be wrong"
            )
        elif self.load is None and abs(constant) > LEAST_SHARED:
            notices.append(
                f"the currents of most vehicles sum to {constant * scale_a:+.1f} A: " + _causes(self.models, ordered)
            )
        for share, centre in zip(best.prior.group_share, best.prior.group_centre, strict=True):
            sensor = sum(model.probability for model in self.models if model.spread.shared[-1])
            notices.append(
                f"about {share:.0%} of the vehicles share {centre * scale_a:+.1f} A in branch {feed} beside the others:"
                f" a load without a sensor ({1.0 - sensor:.0%}), or an offset of a batch of sensors ({sensor:.0%})"
            )
        batches = [model for model in self.models if model.spread.shared[K : 2 * K].any()]
        gains = sum(model.probability for model in batches)
        if gains > LEAST_SAID:
            size = np.abs(batches[0].spread.shared[K : 2 * K]).max()
            which = [name for k, name in enumerate(ordered) if any(model.spread.shared[K + k] for model in batches)]
            notices.append(
                f"most vehicles break the junction law by {size:.1%}: a gain error that a batch of sensors shares "
                f"({gains:.0%}), in branch {' or '.join(which)}"
            )
        if self.variants:
            notices.append(
                f"the currents of some vehicles are all larger by {np.expm1(np.ptp(self.variants)):.1%} than those of "
                f"others: two variants of the vehicle? calibrate them apart"
            )
        return notices


def learn_fleet(
    summaries: Sequence[DriveSummary],
    *,
    full_scale_a: float,
    branches: Sequence[str],
    readings: Array | None = None,
    trusted: Mask | None = None,
    load: UnmeasuredLoad | None = None,
    expected_faults: float | None = None,
    known: Prior | None = None,
) -> FleetReference:
    """Learn from a fleet what its vehicles without faults are like, and how many and how large faults are.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        Summaries of N vehicles, with the same inputs and branches.
    full_scale_a : float
        Full scale of the junction. [A]
    branches : sequence of str
        Names of the K branches.
    readings : ndarray of shape (2, 2, N, K), or None
        Direct readings of single sensors, see :func:`calibrator.estimator.readings.bench_readings`.
    trusted : ndarray of bool of shape (N,) or None
        Vehicles whose sensors were found faultless on a bench; if there are three or more, the others are compared with
        these. Those that break the junction law are not trusted.
    load : UnmeasuredLoad or None
        Load that no branch measures, if it is known; None: estimated from the fleet.
    expected_faults : float or None
        Share of vehicles with a sensor fault, if it is known. [1]
    known : Prior or None
        Prior of the faults, if it is known.

    Returns
    -------
    FleetReference
        For these and other vehicles of the fleet.

    Raises
    ------
    FleetError
        If there is no vehicle, or in most of them a branch has the wrong sign or unit.
    DriveError
        If the summaries were made with different filter banks.
    """
    if not summaries:
        raise FleetError("no vehicle to learn the fleet's reference from")
    given, trusted = len(summaries), np.zeros(len(summaries), bool) if trusted is None else trusted
    plain = stack_summaries(summaries)
    order = tuple(np.argsort(-np.median(plain.variance_a2, axis=0), kind="stable").tolist())
    ordered = [branches[k] for k in order]
    balanced = _balanced(stack_summaries(summaries, order), ordered)
    used, summaries = np.flatnonzero(balanced).tolist(), list(compress(summaries, balanced))
    if not summaries:
        raise FleetError("the currents of no vehicle balance; check signs and units of the branches")
    readings = None if readings is None else readings[:, :, balanced]
    fleet = stack_summaries(summaries, order)
    feed = int(np.argmax(np.median(fleet.mean_a, axis=0)))
    read_out = fit_fleet_model(fleet)
    measured, usual_correlation = collect_rows(fleet, read_out, full_scale_a=full_scale_a)
    carriers = trusted[used]
    broken = untrusted_vehicles(measured, carriers, ordered, full_scale_a=full_scale_a, load=load)
    carriers[list(broken)] = False
    carried = int(carriers.sum()) >= FEWEST_TRUSTED
    sums_a = _sums_a(measured, carriers, full_scale_a)
    zero = _says_zero(*sums_a, full_scale_a, load, count=int(carriers.sum()), branches=len(branches))
    rows = with_knowledge(measured, readings, carriers, order=order, full_scale_a=full_scale_a, load=load, zero=zero)
    offsets_read = bool(rows.known[:, rows.places.offset_reads].any())

    mean, square = fleet.mean_a / full_scale_a, fleet.mean_square_a2 / full_scale_a**2
    usual = np.stack([np.median(mean, axis=0), np.median(square, axis=0)])

    doubtful = ratios_in_doubt(fleet)
    models = learn_fault_models(
        rows,
        feed=feed,
        fixed=_carried_centre(rows, carriers, doubtful, zero=zero),
        load=None if load is None else load.mean_a / full_scale_a,
        known=known,
        expected_faults=expected_faults,
        doubtful=doubtful,
    )
    everyone = estimate_rows(rows, models, feed=feed, mean=mean, mean_square=square, usual=usual)
    place = np.argsort(order)
    own_read_out = read_out[:, place]
    return FleetReference(
        branches=tuple(branches),
        order=order,
        feed=feed,
        read_out=own_read_out,
        usual_correlation=usual_correlation,
        models=tuple(models),
        usual_slopes=np.median(rows.relative[:, : len(order)], axis=0),
        usual=usual,
        misfits=learn_usual_misfits(summaries, own_read_out, full_scale_a=full_scale_a),
        full_scale_a=full_scale_a,
        load=load,
        vehicles=len(fleet),
        carried=carried,
        sums_a=sums_a,
        zero_trusted=zero,
        load_denied=load is not None and not offsets_read and _is_denied(load, sums_a[1], full_scale_a),
        agreeing=tuple(_agreeing(rows, int(p)) for p in place),
        variants=_variants(everyone.hardware_drift),
        distrusted={used[j]: why for j, why in broken.items()}
        | dict.fromkeys(np.flatnonzero(trusted & ~balanced).tolist(), "its currents do not balance"),
        unbalanced=given - len(used),
    )


def _balanced(fleet: FleetMoments, branches: Sequence[str]) -> Mask:
    """Return in which vehicles currents balance with ratios that may be gain errors, shape (N,).

    In the others a sign or unit is wrong, so nothing is learnt from them. FleetError if they are most of the fleet.
    """
    M, K = fleet.inputs, fleet.branches
    covariance = fleet.covariance[:, M:-1, M:-1]
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), np.finfo(float).tiny))
    precision = np.linalg.inv(covariance / sd[:, :, None] / sd[:, None, :] + LEAST_OWN * np.eye(K))
    own = np.diagonal(precision, axis1=1, axis2=2)
    partial = precision[:, 0, 1:] / np.sqrt(own[:, :1] * own[:, 1:])  # minus the partial correlation; < 0: wrong sign
    ratio = precision[:, 0, 1:] / own[:, :1] * sd[:, :1] / sd[:, 1:]
    wrong = (np.abs(partial) > SURE) & ((ratio < 1.0 / MOST_RATIO) | (ratio > MOST_RATIO))
    found = np.flatnonzero(wrong.mean(axis=0) > 0.5)
    if found.size:
        k = int(found[0])
        alone = branches[0] if 1 < found.size == K - 1 else f"{branches[k + 1]} or {branches[0]}"
        raise FleetError(
            f"the currents of most vehicles do not balance: 1 A in branch {branches[k + 1]} goes with "
            f"{-np.median(ratio[:, k]):+.2g} A in branch {branches[0]}, expected -1 A; check sign and unit of branch "
            f"{alone}"
        )
    return np.asarray(~wrong.any(axis=1))


def _sums_a(rows: EvidenceRows, carriers: Mask, full_scale_a: float) -> tuple[float, float]:
    """Return what the currents of trusted vehicles sum to, and those of most others, see :class:`FleetReference`."""
    trusted, others = (rows.take(some).shown(rows.places.junction) for some in (carriers, ~carriers))
    trusted_sum = float(np.median(trusted[0])) if len(trusted[0]) >= FEWEST_TRUSTED else np.nan
    found = densest_clusters(*others, widest=1.0) if len(others[0]) >= FEWEST_TRUSTED else []
    shared = found[0].centre if found and found[0].share > 0.5 else np.nan
    return trusted_sum * full_scale_a, shared * full_scale_a


def _says_zero(
    trusted_a: float, others_a: float, full_scale_a: float, load: UnmeasuredLoad | None, *, count: int, branches: int
) -> bool:
    """Return whether ``count`` trusted vehicles say where zero is: not if only the others' currents sum to the load.

    The others would have to share an offset that happens to cancel a load of all vehicles. It is likelier that the
    trusted vehicles share a wrong zero, or a load such as a recorder. They may differ by chance, as loads and bench
    checks do.
    """
    mean_a, sd_a = (0.0, 0.0) if load is None else (load.mean_a, load.sd_a)
    least_a = LEAST_SHARED * full_scale_a
    chance_a = np.sqrt((sd_a**2 + branches * (TRUSTED_OFFSET_SD * full_scale_a) ** 2) / max(count, 1))
    apart = abs(trusted_a - others_a) > max(least_a, CONTRADICTION * float(chance_a))
    return not (apart and abs(others_a - mean_a) < max(least_a, sd_a))


def _is_denied(load: UnmeasuredLoad, others_a: float, full_scale_a: float) -> bool:
    """Return whether most vehicles sum to zero (NaN: not known), and clearly not to the declared load."""
    least_a = LEAST_SHARED * full_scale_a
    is_apart = abs(others_a - load.mean_a) > least_a + CONTRADICTION * load.sd_a
    return is_apart and abs(others_a) < max(least_a, load.sd_a)


def _carried_centre(rows: EvidenceRows, carriers: Mask, doubtful: Mask, *, zero: bool) -> Array:
    """Return the median over trusted vehicles of each row that enough of them show, shape (5K,); NaN in the others.

    If the ``zero`` of these vehicles is not trusted, only rows of ratios have one.
    """
    fixed = np.full(rows.values.shape[1], np.nan)
    if np.count_nonzero(carriers) >= FEWEST_TRUSTED:
        for row in np.flatnonzero(centre_rows(rows.branches, doubtful)):
            shown = carriers & rows.known[:, row]
            if np.count_nonzero(shown) >= FEWEST_TRUSTED:
                fixed[row] = np.median(rows.values[shown, row])
    if not zero:
        fixed[rows.places.constant] = np.nan
    return fixed


def _agreeing(rows: EvidenceRows, branch: int) -> float:
    """Return the share of the vehicles whose slopes of a branch agree, 0 to 1."""
    found = densest_clusters(*rows.shown(rows.places.slope(branch)), widest=1.0)
    return found[0].share if found else 0.0


def _variants(hardware_drift: Array) -> tuple[float, ...]:
    """Find two groups of vehicles, each with its own hardware drift in common; return log(1 + drift) of both, or ()."""
    eta = np.log1p(hardware_drift)
    near = np.abs(eta[:, None] - eta[None, :]) < VARIANT_SPREAD
    centres: list[float] = []
    left = np.ones(len(eta), bool)
    for _ in range(2):
        count = np.where(left, (near & left).sum(axis=1), 0)
        best = int(np.argmax(count))
        if count[best] < max(FEWEST_VARIANT, VARIANT_SHARE * len(eta)):
            return ()
        centres.append(float(np.median(eta[near[best] & left])))
        left &= np.abs(eta - centres[-1]) > 2.0 * VARIANT_SPREAD
    return tuple(sorted(centres))


def _causes(models: Sequence[FaultModel], branches: Sequence[str]) -> str:
    """Name the causes of a junction constant that most vehicles share, with their probabilities, for a notice."""
    share = {"a load without a sensor": 0.0}
    for model in models:
        offsets = model.spread.shared[: len(branches)]
        cause = "a load without a sensor"
        if np.abs(offsets).max() > LEAST_SHARED:
            cause = f"an offset that the sensors of branch {branches[int(np.argmax(np.abs(offsets)))]} share"
        share[cause] = share.get(cause, 0.0) + model.probability
    said = sorted(((p, cause) for cause, p in share.items() if p > LEAST_SAID), reverse=True)
    return " or ".join(f"{cause} ({p:.0%})" for p, cause in said) + "; declare the load if it is known"


def estimate_vehicles(
    summaries: Sequence[DriveSummary],
    reference: FleetReference,
    *,
    readings: Array | None = None,
    trusted: Mask | None = None,
    harm_limit: float = HARM_LIMIT,
    limits: tuple[float, float] | None = None,
) -> FleetEstimate:
    """Estimate the sensor faults of vehicles, each by itself, and decide which branches are corrected.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        Summaries of N vehicles.
    reference : FleetReference
        Reference of their fleet.
    readings : ndarray of shape (2, 2, N, K), or None
        Direct readings of their sensors, see :func:`calibrator.estimator.readings.bench_readings`.
    trusted : ndarray of bool of shape (N,) or None
        Vehicles that are trusted and do not break the junction law.
    harm_limit : float
        A branch is corrected if the probability of harm is below this. [1]
    limits : tuple of float or None
        Largest drift [1] and offset [A] that are corrected; None: any.

    Returns
    -------
    FleetEstimate
        In the order of the summaries.
    """
    scale_a, order = reference.full_scale_a, list(reference.order)
    trusted = np.zeros(len(summaries), bool) if trusted is None else trusted
    fleet = stack_summaries(summaries, order)
    measured, _ = collect_rows(
        fleet, reference.read_out[:, order], full_scale_a=scale_a, usual_correlation=reference.usual_correlation
    )
    rows = with_knowledge(
        measured,
        readings,
        trusted,
        order=order,
        full_scale_a=scale_a,
        load=reference.load,
        zero=reference.zero_trusted,
    )
    found = estimate_rows(
        rows,
        reference.models,
        feed=reference.feed,
        mean=fleet.mean_a / scale_a,
        mean_square=fleet.mean_square_a2 / scale_a**2,
        usual=reference.usual,
        order=order,
        full_scale_a=scale_a,
    )
    unfit = find_misfits(
        summaries, reference.read_out, reference.misfits, full_scale_a=scale_a, branches=reference.branches
    )
    covariance_a2 = fleet.covariance[:, fleet.inputs : -1, fleet.inputs : -1]
    sums = _sum_findings(covariance_a2, 1.0 + found.drift[:, order], scale_a)
    slopes = rows.relative[:, : len(order)] - reference.usual_slopes
    is_open = found.faulty[:, order] & ~rows.known[:, rows.places.gain_reads].any(axis=1, keepdims=True)
    hidden = _hidden_findings(slopes, is_open, found.drift[:, order], reference.ordered)
    unfit = [(*mine, *of_sum, *of_gain) for mine, of_sum, of_gain in zip(unfit, sums, hidden, strict=True)]
    drift_limit, offset_limit_a = (np.inf, np.inf) if limits is None else limits
    has_own_load = np.array([each.weight @ (each.load != 0.0) > SUSPECTED for each in found.points])
    is_read = rows.known[:, rows.places.offset_reads][:, reference.feed]  # then the load is no offset
    has_finding = np.array(list(map(bool, unfit)))
    held_back, corrected, verdicts = decided(
        found.faulty,
        unfit=np.array([_unfit(each, reference.branches) for each in unfit]),
        in_doubt=reference.in_doubt & ~trusted[:, None],
        still=~found.identifiable,
        harmful=~(found.harm_probability < harm_limit),
        beyond=(np.abs(found.drift) > drift_limit) | (np.abs(found.offset_a) > offset_limit_a),
        sound=~found.faulty.any(axis=1) & (found.confidence >= CONFIDENT) & ~has_finding & ~(has_own_load & ~is_read),
    )
    shared = _shared_findings(found, reference, is_read)
    linear = [
        1.0 - max((each.probability for each in mine if each.cause not in LINEAR_CAUSES), default=0.0) for mine in unfit
    ]
    estimate = {each.name: getattr(found, each.name) for each in fields(SensorEstimate)}
    return FleetEstimate(
        **{**estimate, "confidence": found.confidence * linear},
        corrected=corrected,
        held_back=held_back,
        verdicts=verdicts,
        explanations=[[_explanation(*each, reference) for each in mine] for mine in found.supports],
        findings=[(*each, *others) for each, others in zip(unfit, shared, strict=True)],
        evidence=reported_evidence(rows, found, reference.models[0].spread),
    )


def _sum_findings(covariance_a2: Array, gain: Array, full_scale_a: float) -> list[tuple[SensorFinding, ...]]:
    """Find the vehicles whose currents would sum to more if these gains were right, or do not cancel anyway.

    Gains of parallel branches, which the junction law does not tell apart, come from the fleet model alone.
    """
    before_a, after_a = (
        np.sqrt(np.maximum(np.einsum("nkl,nk,nl->n", covariance_a2, weight, weight), 0.0))
        for weight in (np.ones_like(gain), 1.0 / gain)
    )
    largest_a = np.sqrt(np.diagonal(covariance_a2, axis1=1, axis2=2).max(axis=1))
    grows = after_a > np.maximum(WORSE_SUM * before_a, before_a + WORSE_SUM_A * full_scale_a)
    remains = after_a > np.maximum(MOST_SUM_A * full_scale_a, MOST_SUM * largest_a)
    found = list[tuple[SensorFinding, ...]]()
    for j in range(len(gain)):
        why = (
            "a variant of the vehicle" if grows[j] else "a signal late by more than half a second, or a branch missing"
        )
        after, before = f"{after_a[j]:.1f} A RMS about their mean", f"{before_a[j]:.1f} A without"
        text = f"with these gains the currents sum to {after}, to {before}: is it {why}?"
        is_wrong = grows[j] or remains[j]
        found.append((SensorFinding(branch=None, cause="sum", probability=1.0, text=text),) if is_wrong else ())
    return found


def _hidden_findings(
    slopes: Array, faulty: Mask, drift: Array, branches: Sequence[str]
) -> list[tuple[SensorFinding, ...]]:
    """Find the vehicles in which the only faulty gain is that of the one sensor which shows what the fleet's do.

    The vehicle would draw more, and this sensor happen to hide it. That the others share a gain error, as sensors of
    one control unit do, is as probable. ``slopes`` (N, K) are logarithms, relative to the fleet; in vehicles of
    which a gain was read none is ``faulty`` here.
    """
    found = list[tuple[SensorFinding, ...]]()
    for own, is_faulty, gain_error in zip(slopes, faulty, drift, strict=True):
        named = np.flatnonzero(is_faulty & (np.abs(gain_error) > LEAST_HARDWARE))
        rest = np.delete(own, named)
        more = float(rest.mean()) if len(rest) > 1 else 0.0
        if len(named) != 1 or abs(own[named[0]]) >= min(ALIKE, abs(more)) or np.ptp(rest) >= ALIKE:
            found.append(())
            continue
        either = f"either the vehicle draws {np.expm1(more):+.1%} and one sensor hides it, or the others share that"
        text = f"{either} gain error; a bench check of any gain decides"
        found.append((SensorFinding(branch=branches[named[0]], cause="hidden", probability=0.5, text=text),))
    return found


def reported_evidence(rows: EvidenceRows, found: SensorEstimate, spread: Spread) -> Array:
    """Return for a report what each evidence row measured, how uncertain it is, and what the estimate predicts.

    Parameters
    ----------
    rows : EvidenceRows
        Evidence of N vehicles with K branches.
    found : SensorEstimate
        Estimate of the same vehicles.
    spread : Spread
        Model spread of their fleet; the centre of the junction constant includes the load without a sensor.

    Returns
    -------
    ndarray of shape (N, 3, 5K)
        Measured value, standard deviation of a faultless vehicle's row (sampling errors and model spread), prediction.
        The first two are NaN where a row is unknown. 3K - 1 ratios [1] (slopes, gain ratios, gain readings), then
        2K + 1 constants [A], as ``evidence`` in the details of ``run.json`` names them.
    """
    order, scale_a, at = list(found.order), found.full_scale_a, rows.places
    gain, offset_a, hardware_a = (
        1.0 + found.drift[:, order],
        found.offset_a[:, order],
        found.hardware_offset_a[:, order],
    )
    first, ratios = gain[:, :1], np.exp(rows.relative)
    seen = np.concatenate([gain, first, np.ones_like(gain)], axis=1) * scale_a  # constants are stored over 1 + d
    value = np.concatenate([ratios, rows.constant * scale_a], axis=1)
    sd = np.sqrt(np.diagonal(spread.of_rows(rows), axis1=1, axis2=2)) * np.concatenate([ratios, seen], axis=1)
    # a_k = (1 + d_k)(1 + d_h); -g_k = (1 + d_1) / (1 + d_k); b_k = o_k + (1 + d_k) o_h,k; c = (1 + d_1) sum o/(1 + d)
    relative = np.concatenate([gain * (1.0 + found.hardware_drift[:, None]), first / gain[:, 1:], gain], axis=1)
    junction = first * (offset_a / gain).sum(axis=1, keepdims=True)
    constant = np.concatenate([offset_a + gain * hardware_a, junction, offset_a], axis=1)
    centre = spread.mean
    made = np.concatenate([relative * np.exp(centre[at.relative]), constant + seen * centre[at.constant]], axis=1)
    value[~rows.known], sd[~rows.known] = np.nan, np.nan
    return np.stack([value, sd, made], axis=1)


def _shared_findings(found: RowsEstimate, reference: FleetReference, is_read: Mask) -> list[list[SensorFinding]]:
    """Return for each vehicle findings of loads without a sensor, batches and variants: reported, not corrected.

    `is_read` (N,) says of which vehicles the offset of the feeding sensor was read directly.
    """
    feed, findings, scale_a = reference.ordered[reference.feed], list[list[SensorFinding]](), reference.full_scale_a
    sensor = sum(model.probability for model in reference.models if model.spread.shared[-1])
    cause, rival = ("batch", "load") if sensor > SUSPECTED else ("load", "batch")
    what = {"load": "a load without a sensor", "batch": "an offset of a batch of sensors"}
    groups = group_centres(reference.models)
    for points, supports, read in zip(found.points, found.supports, is_read, strict=True):
        others = f"A in branch {feed} as in other vehicles: {what[cause]}, or {what[rival]}"
        of_group = np.bincount(points.group, points.weight, minlength=1 + len(groups))[1:]
        said: list[tuple[str | None, str, float, str]] = [
            (feed, cause, p, f"{centre * scale_a:+.1f} {others}") for p, centre in zip(of_group, groups, strict=True)
        ]
        alone = points.weight @ (points.load != 0.0)
        load_a = points.weight @ points.load / max(alone, 1e-300) * scale_a
        load = f"a load without a sensor of {load_a:.1f} A" + ("" if read else f", or an offset of the {feed} sensor")
        said.append((feed, "load", alone, load))
        if reference.variants:
            eta = [(p, float(np.log1p(values[0]))) for p, values in supports]
            of = [sum(p for p, each in eta if abs(each - centre) < VARIANT_SPREAD) for centre in reference.variants]
            size, than = f"{np.expm1(np.ptp(reference.variants)):.1%}", "larger" if of[1] > of[0] else "smaller"
            text = f"all its currents are {than} by {size} than those of some other vehicles: one of two variants?"
            said.append((None, "variant", sum(of), text))
        findings.append(
            [
                SensorFinding(branch=branch, cause=each, probability=float(min(p, 1.0)), text=text)
                for branch, each, p, text in said
                if p > SUSPECTED
            ]
        )
    return findings


def _unfit(findings: Sequence[SensorFinding], branches: Sequence[str]) -> list[bool]:
    """Return for each branch whether a finding concerns it: spikes and outliers only their own, others every branch."""
    everywhere = any(each.cause not in LEFT_OUT_CAUSES or each.branch is None for each in findings)
    return [everywhere or any(each.branch == name for each in findings) for name in branches]


def _explanation(share: float, values: Array, reference: FleetReference) -> Explanation:
    """Return an explanation with the names of the branches; ``values`` as in :attr:`.RowsEstimate.supports`."""

    def nonzero(row: Array, unit: float) -> dict[str, float]:
        named = zip(reference.ordered, row.tolist(), strict=True)
        return {name: value * unit for name, value in named if abs(value) > 1e-9}

    hardware_offset, drift, offset = values[1:].reshape(3, -1)
    return Explanation(
        probability=min(share, 1.0),
        drift=nonzero(drift, 1.0),
        offset_a=nonzero(offset, reference.full_scale_a),
        hardware_drift=float(values[0]),
        hardware_offset_a=nonzero(hardware_offset, reference.full_scale_a),
    )
