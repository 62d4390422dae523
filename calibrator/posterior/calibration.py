"""The default method on a fleet's drive summaries: fleet model, evidence rows, posterior."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from calibrator.drive import Mask
from calibrator.errors import FleetError
from calibrator.evidence.collect import collect_rows
from calibrator.evidence.fleet_model import fit_fleet_model
from calibrator.evidence.readings import Readings, no_readings, trusted_readings, with_readings
from calibrator.evidence.rows import with_load_spread
from calibrator.evidence.summary import DriveSummary
from calibrator.faults import Faults
from calibrator.posterior.estimate import FleetPosterior, Moments, estimate_fleet
from calibrator.posterior.fault_prior import FaultPrior
from calibrator.posterior.health import ReferenceHealth, examine_reference
from calibrator.posterior.model_spread import FEWEST_TRUSTED
from calibrator.posterior.trust import broken_trust
from calibrator.posterior.verdict import SUSPECTED
from ecu_node.layout import UnmeasuredLoad

__all__ = ["calibrate_posterior"]


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
    summaries : sequence of DriveSummary
        One per vehicle, with the same inputs and branches.
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
    learning : ndarray of bool of shape (N,) or None
        Vehicles from which the fleet's reference and hyper-parameters are learnt; None: all.
    load : UnmeasuredLoad or None
        Load that no branch measures, if it is known; None: estimated from the fleet.

    Returns
    -------
    FleetPosterior
        In the order of the summaries, branches in theirs; with the health of the reference.

    Raises
    ------
    FleetError
        If there is no vehicle to learn from.
    """
    if not summaries or (learning is not None and not learning.any()):
        raise FleetError("no vehicle to learn the fleet's reference from")
    K, N = summaries[0].branches, len(summaries)
    names = [f"{k + 1}" for k in range(K)] if branches is None else branches
    order = _most_moving_first(summaries)
    ordered = [summary.take_branches(order) for summary in summaries]
    learnt = np.ones(N, bool) if learning is None else learning
    model = fit_fleet_model([summary for summary, use in zip(ordered, learnt, strict=True) if use])
    rows = collect_rows(ordered, model, full_scale_a=full_scale_a, learning=learnt)
    known = no_readings(N, K) if readings is None else readings
    carriers = np.zeros(N, bool) if trusted is None else trusted.copy()
    distrusted = broken_trust(rows, carriers, [names[k] for k in order], full_scale_a=full_scale_a, load=load)
    carriers[list(distrusted)] = False
    known = known.merged(trusted_readings(carriers, K, full_scale_a))
    if load is not None:
        rows = with_load_spread(rows, load.sd_a / full_scale_a)
    rows = with_readings(rows, known.take_branches(order), full_scale_a=full_scale_a)
    moments = Moments(
        mean_a=np.stack([summary.mean_a for summary in ordered]),
        mean_square_a2=np.stack([np.diag(summary.mean_product_a2) for summary in ordered]),
    )
    estimate = partial(
        estimate_fleet,
        rows,
        moments,
        full_scale_a=full_scale_a,
        given=given,
        learning=learnt,
        load=None if load is None else load.mean_a / full_scale_a,
    )
    posterior, differing = _carried_by(estimate, carriers)
    carriers &= ~differing
    health = examine_reference(
        rows.take(learnt),
        [names[k] for k in order],
        full_scale_a=full_scale_a,
        trusted=carriers[learnt],
        load=load,
        load_in_use_a=float(posterior.hyperparameters.spread.mean[4 * K - 1] * full_scale_a),
    )
    health = replace(health, distrusted=distrusted, differing=tuple(np.flatnonzero(differing).tolist()))
    return _in_own_order(posterior, health, order)


def _carried_by(estimate: Callable[..., FleetPosterior], trusted: Mask) -> tuple[FleetPosterior, Mask]:
    """Posterior whose reference trusted vehicles carry, and those of them that differ as by a hardware fault."""
    posterior = estimate(trusted=trusted)
    if np.count_nonzero(trusted) < FEWEST_TRUSTED:
        return posterior, np.zeros_like(trusted)
    differing = np.asarray(trusted & (posterior.hardware_fault > SUSPECTED))
    return (estimate(trusted=trusted & ~differing) if differing.any() else posterior), differing


def _most_moving_first(summaries: Sequence[DriveSummary]) -> list[int]:
    """Branches by falling variance: the junction law is written for the first, and small ones are drowned in noise."""
    variance = np.median([summary.variance_a2 for summary in summaries], axis=0)
    return [int(k) for k in np.argsort(-variance, kind="stable")]


def _in_own_order(posterior: FleetPosterior, health: ReferenceHealth, order: list[int]) -> FleetPosterior:
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
        health=health.in_order(place),
        order=tuple(order),
    )
