"""The default method on a fleet's drive summaries: fleet model, evidence rows, posterior."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibrator.evidence.collect import collect_rows
from calibrator.evidence.fleet_model import fit_fleet_model
from calibrator.evidence.summary import DriveSummary
from calibrator.faults import Faults
from calibrator.posterior.estimate import FleetPosterior, Moments, estimate_fleet
from calibrator.posterior.fault_prior import FaultPrior

__all__ = ["calibrate_posterior"]


def calibrate_posterior(
    summaries: Sequence[DriveSummary], *, full_scale_a: float, given: FaultPrior | None = None
) -> FleetPosterior:
    """Estimate the faults of a fleet from its drives.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        One per vehicle, with the same inputs and branches.
    full_scale_a : float
        Full scale of the junction. [A]
    given : FaultPrior or None
        Prior of the faults, if it is known; None: estimated from the fleet.

    Returns
    -------
    FleetPosterior
        In the order of the summaries, branches in theirs.
    """
    order = _largest_first(summaries)
    ordered = [summary.take_branches(order.tolist()) for summary in summaries]
    model = fit_fleet_model(ordered)
    rows = collect_rows(ordered, model, full_scale_a=full_scale_a)
    moments = Moments(
        mean_a=np.stack([summary.mean_a for summary in ordered]),
        mean_square_a2=np.stack([np.diag(summary.mean_product_a2) for summary in ordered]),
    )
    posterior = estimate_fleet(rows, moments, full_scale_a=full_scale_a, given=given)
    return _reordered(posterior, np.argsort(order))


def _largest_first(summaries: Sequence[DriveSummary]) -> NDArray[np.int64]:
    """Branches by falling current: the junction law is written for the first, and small ones are drowned in noise."""
    power = np.median([np.diag(summary.mean_product_a2) for summary in summaries], axis=0)
    return np.argsort(-power, kind="stable")


def _reordered(posterior: FleetPosterior, place: NDArray[np.int64]) -> FleetPosterior:
    """The same posterior with the branches in their own order; the states keep theirs."""
    faults = posterior.faults
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
    )
