"""The evidence rows of a vehicle in the units of its sensors, beside what its estimate makes of them.

Of each branch the slope a_k and the intercept b_k over the fleet model (15) in [1]_, and what a bench or a zero-current
window showed of it; of the junction law the gain ratios -g_k and the constant c, see :mod:`calibrator.evidence.rows`:

    a_k = (1 + d_k) (1 + d_h)             b_k = o_k + (1 + d_k) o_h,k
    -g_k = (1 + d_1) / (1 + d_k)          c = (1 + d_1) sum_k o_k / (1 + d_k)

about the centres that vehicles without faults have in the same rows: to c belongs the load that no branch measures.
A standard deviation is that of the reading together with what faultless vehicles differ by.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.rows import UNKNOWN_VARIANCE
from calibrator.evidence.vehicle_evidence import VehicleEvidence
from calibrator.posterior.estimate import FleetPosterior

__all__ = ["told_evidence"]


def told_evidence(posterior: FleetPosterior, *, full_scale_a: float) -> list[VehicleEvidence]:
    """Evidence of every vehicle.

    Parameters
    ----------
    posterior : FleetPosterior
        Of N vehicles, with the rows that it was estimated from.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    list of VehicleEvidence
        In the order of the vehicles; none if the posterior has no rows.
    """
    rows = posterior.rows
    if rows is None:
        return []
    order = list(posterior.order)
    gain = 1.0 + posterior.faults.drift[:, order]
    ratios = np.exp(rows.relative)
    spread = posterior.hyperparameters.spread
    known = np.diagonal(rows.covariance, axis1=1, axis2=2) < UNKNOWN_VARIANCE / 2.0
    whole = rows.dispersed(spread.dispersion)[0] + spread.covariance
    sd = np.sqrt(np.diagonal(whole, axis1=1, axis2=2))
    seen = np.concatenate([gain, gain[:, :1], np.ones_like(gain)], axis=1) * full_scale_a
    values = np.concatenate([ratios, rows.constant * full_scale_a], axis=1)
    deviations = sd * np.concatenate([ratios, seen], axis=1)
    values[~known], deviations[~known] = np.nan, np.nan
    ratio_centre, constant_centre = np.split(spread.mean, [ratios.shape[1]])
    relative, constant = _explained(posterior, gain, order)
    explained = np.concatenate([relative * np.exp(ratio_centre), constant + seen * constant_centre], axis=1)
    return [
        VehicleEvidence(value=_listed(values[j]), sd=_listed(deviations[j]), explained=explained[j].tolist())
        for j in range(len(values))
    ]


def _explained(posterior: FleetPosterior, gain: Array, order: Sequence[int]) -> tuple[Array, Array]:
    """What the estimates make of the rows, shapes (N, 3K - 1) [1] and (N, 2K + 1) [A]."""
    faults = posterior.faults
    offset_a, hardware_a = faults.offset_a[:, order], faults.hardware_offset_a[:, order]
    slope = gain * (1.0 + faults.hardware_drift[:, None])
    junction = gain[:, :1] * (offset_a / gain).sum(axis=1, keepdims=True)
    relative = np.concatenate([slope, gain[:, :1] / gain[:, 1:], gain], axis=1)
    return relative, np.concatenate([offset_a + gain * hardware_a, junction, offset_a], axis=1)


def _listed(values: Array) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]
