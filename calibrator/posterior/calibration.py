"""The default method on a fleet's drive summaries: fleet model, evidence rows, posterior.

Learning and estimating are apart: the reference is learnt from some vehicles, and with it every vehicle, learnt from or
not, is estimated by itself.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.evidence.collect import RawRows, collect_rows
from calibrator.evidence.fleet_model import FleetModel, fit_fleet_model
from calibrator.evidence.fleet_moments import FleetMoments, stack_summaries
from calibrator.evidence.readings import Readings, no_readings, trusted_readings, with_readings
from calibrator.evidence.rows import FleetRows, with_load_spread
from calibrator.faults import Faults
from calibrator.posterior.estimate import FleetLaw, FleetPosterior, Moments, estimate_vehicles, learn_law
from calibrator.posterior.fault_prior import FaultPrior
from calibrator.posterior.health import ReferenceHealth, examine_reference
from calibrator.posterior.spread_starts import FEWEST_TRUSTED
from calibrator.posterior.trust import broken_trust
from calibrator.posterior.verdict import SUSPECTED
from calibrator.summaries.moments import DriveSummary
from ecu_node.layout import UnmeasuredLoad

__all__ = ["FleetReference", "calibrate_posterior", "estimate_summaries", "learn_reference"]


@dataclass(frozen=True, kw_only=True)
class FleetReference:
    """What a fleet tells of every vehicle of its kind.

    Attributes
    ----------
    order : tuple of int
        Branches as they are worked with, the most moving first: position of each in the vehicles' own order.
    model : FleetModel
        Ideal currents over the inputs, branches in that order.
    usual_correlation : ndarray of shape (3K, 3K)
        Of the evidence rows. [1]
    law : FleetLaw
        Of the faults.
    health : ReferenceHealth
        Whether all this can be trusted; positions are those of the vehicles learnt from.
    full_scale_a : float
        Full scale of the junction. [A]
    load : UnmeasuredLoad or None
        Load that no branch measures, if it is known.
    """

    order: tuple[int, ...]
    model: FleetModel
    usual_correlation: Array
    law: FleetLaw
    health: ReferenceHealth
    full_scale_a: float
    load: UnmeasuredLoad | None


def calibrate_posterior(
    summaries: Sequence[DriveSummary],
    *,
    full_scale_a: float,
    branches: Sequence[str] | None = None,
    given: FaultPrior | None = None,
    readings: Readings | None = None,
    trusted: Mask | None = None,
    learning: Mask | None = None,
    load: UnmeasuredLoad | None = None,
) -> FleetPosterior:
    """Estimate the faults of a fleet from its drives.

    Parameters
    ----------
    summaries, full_scale_a, branches, given, readings, trusted, load
        As for :func:`learn_reference`.
    learning : ndarray of bool of shape (N,) or None
        Vehicles from which the reference is learnt; None: all.

    Returns
    -------
    FleetPosterior
        In the order of the summaries, branches in theirs; with the health of the reference.

    Raises
    ------
    FleetError
        If there is no vehicle to learn from.
    """
    N = len(summaries)
    carriers = np.zeros(N, bool) if trusted is None else trusted
    learnt = np.arange(N) if learning is None else np.flatnonzero(learning)
    reference = learn_reference(
        [summaries[j] for j in learnt.tolist()],
        full_scale_a=full_scale_a,
        branches=branches,
        given=given,
        readings=None if readings is None else readings.take(learnt),
        trusted=carriers[learnt],
        load=load,
    )
    health = reference.health.of_positions(learnt)
    believed = carriers & ~np.isin(np.arange(N), list(health.distrusted))
    return estimate_summaries(summaries, replace(reference, health=health), readings=readings, believed=believed)


def learn_reference(
    summaries: Sequence[DriveSummary],
    *,
    full_scale_a: float,
    branches: Sequence[str] | None = None,
    given: FaultPrior | None = None,
    readings: Readings | None = None,
    trusted: Mask | None = None,
    load: UnmeasuredLoad | None = None,
) -> FleetReference:
    """Learn what vehicles without faults are like, and which faults there are.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        Of N vehicles, with the same inputs and branches.
    full_scale_a : float
        Full scale of the junction. [A]
    branches : sequence of str or None
        Names of the K branches, for warnings; None: numbers.
    given : FaultPrior or None
        Prior of the faults, if it is known; None: estimated from the fleet.
    readings : Readings or None
        Direct readings of single sensors.
    trusted : ndarray of bool of shape (N,) or None
        Vehicles whose sensors were found faultless on a bench. At least :data:`FEWEST_TRUSTED` carry the reference.
        Those that break the junction law are not trusted, those that differ from the others do not carry: see the
        health.
    load : UnmeasuredLoad or None
        Load that no branch measures, if it is known; None: estimated from the fleet.

    Returns
    -------
    FleetReference
        For these and other vehicles of the fleet.

    Raises
    ------
    FleetError
        If there is no vehicle.
    """
    if not summaries:
        raise FleetError("no vehicle to learn the fleet's reference from")
    K, N = summaries[0].branches, len(summaries)
    names = [f"{k + 1}" for k in range(K)] if branches is None else list(branches)
    carriers = np.zeros(N, bool) if trusted is None else trusted.copy()
    order = _most_moving_first(stack_summaries(summaries))
    fleet = stack_summaries(summaries, order)
    model = fit_fleet_model(fleet)
    raw = collect_rows(fleet, model, full_scale_a=full_scale_a)
    usual = raw.usual_correlation()
    ordered = [names[k] for k in order]
    distrusted = broken_trust(raw.steadied(usual), carriers, ordered, full_scale_a=full_scale_a, load=load)
    carriers[list(distrusted)] = False
    rows = _told(raw, usual, readings, carriers, order=order, full_scale_a=full_scale_a, load=load)
    learn = partial(learn_law, rows, _moments(fleet), given=given, load=_share(load, full_scale_a))
    law, differing = _carried_by(learn, rows, _moments(fleet), carriers, full_scale_a)
    health = examine_reference(
        rows,
        ordered,
        full_scale_a=full_scale_a,
        trusted=carriers & ~differing,
        load=load,
        load_in_use_a=float(law.hyperparameters.spread.mean[4 * K - 1] * full_scale_a),
    )
    health = replace(health, distrusted=distrusted, differing=tuple(np.flatnonzero(differing).tolist()))
    return FleetReference(
        order=order,
        model=model,
        usual_correlation=usual,
        law=law,
        health=health.in_order(np.argsort(order)),
        full_scale_a=full_scale_a,
        load=load,
    )


def estimate_summaries(
    summaries: Sequence[DriveSummary],
    reference: FleetReference,
    *,
    readings: Readings | None = None,
    believed: Mask | None = None,
) -> FleetPosterior:
    """Estimate the faults of some vehicles of a fleet whose reference is known.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        Of N vehicles, at least one.
    reference : FleetReference
        Of their fleet.
    readings : Readings or None
        Direct readings of their sensors.
    believed : ndarray of bool of shape (N,) or None
        Vehicles that are trusted and do not break the junction law; None: none.

    Returns
    -------
    FleetPosterior
        In the order of the summaries, branches in theirs; with the health of the reference.
    """
    fleet = stack_summaries(summaries, reference.order)
    trusted = np.zeros(len(fleet), bool) if believed is None else believed
    scale_a = reference.full_scale_a
    raw = collect_rows(fleet, reference.model, full_scale_a=scale_a)
    rows = _told(
        raw,
        reference.usual_correlation,
        readings,
        trusted,
        order=reference.order,
        full_scale_a=scale_a,
        load=reference.load,
    )
    posterior = estimate_vehicles(rows, _moments(fleet), reference.law, full_scale_a=scale_a)
    return replace(_in_own_order(posterior, reference.health, reference.order), rows=rows)


def _told(
    raw: RawRows,
    usual: Array,
    readings: Readings | None,
    trusted: Mask,
    *,
    order: Sequence[int],
    full_scale_a: float,
    load: UnmeasuredLoad | None,
) -> FleetRows:
    """Evidence with what is known of single sensors and of loads without one."""
    N, K = len(trusted), len(order)
    known = no_readings(N, K) if readings is None else readings
    known = known.merged(trusted_readings(trusted, K, full_scale_a))
    rows = raw.steadied(usual)
    if load is not None:
        rows = with_load_spread(rows, load.sd_a / full_scale_a)
    return with_readings(rows, known.take_branches(list(order)), full_scale_a=full_scale_a)


def _moments(fleet: FleetMoments) -> Moments:
    return Moments(mean_a=fleet.mean_a, mean_square_a2=fleet.mean_square_a2)


def _share(load: UnmeasuredLoad | None, full_scale_a: float) -> float | None:
    return None if load is None else load.mean_a / full_scale_a


def _carried_by(
    learn: Callable[..., FleetLaw], rows: FleetRows, moments: Moments, trusted: Mask, full_scale_a: float
) -> tuple[FleetLaw, Mask]:
    """Law whose reference trusted vehicles carry, and those of them that differ as by a hardware fault."""
    law, differing = learn(trusted=trusted), np.zeros_like(trusted)
    if np.count_nonzero(trusted) < FEWEST_TRUSTED:
        return law, differing
    found = estimate_vehicles(rows.take(trusted), moments.take(trusted), law, full_scale_a=full_scale_a)
    differing[trusted] = found.hardware_fault > SUSPECTED
    return (learn(trusted=trusted & ~differing) if differing.any() else law), differing


def _most_moving_first(fleet: FleetMoments) -> tuple[int, ...]:
    """Branches by falling variance: the junction law is written for the first, and small ones are drowned in noise."""
    return tuple(np.argsort(-np.median(fleet.variance_a2, axis=0), kind="stable").tolist())


def _in_own_order(posterior: FleetPosterior, health: ReferenceHealth, order: tuple[int, ...]) -> FleetPosterior:
    """The same posterior with the branches in their own order; the states keep theirs."""
    faults, place = posterior.faults, np.argsort(order)
    return replace(
        posterior,
        faults=Faults(
            hardware_drift=faults.hardware_drift,
            hardware_offset_a=faults.hardware_offset_a[:, place],
            drift=faults.drift[:, place],
            offset_a=faults.offset_a[:, place],
        ),
        drift_sd=posterior.drift_sd[:, place],
        offset_sd_a=posterior.offset_sd_a[:, place],
        sensor_fault=posterior.sensor_fault[:, place],
        harm=posterior.harm[:, place],
        identifiable=posterior.identifiable[:, place],
        health=health,
        order=order,
    )
