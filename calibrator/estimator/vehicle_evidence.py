"""The evidence rows of each vehicle in the units of its sensors, beside what its estimate makes of them."""

from dataclasses import dataclass
from math import isfinite

import numpy as np

from calibrator.drive import Array
from calibrator.estimator.rows import EvidenceRows

__all__ = ["VehicleEvidence", "reported_evidence"]


@dataclass(frozen=True, kw_only=True)
class VehicleEvidence:
    """What the parameters of one vehicle were found from, in the units of its sensors.

    Attributes
    ----------
    value, sd, explained : list of 5K float or None
        What was measured, its standard deviation, and what the estimate makes of it; None for both of the first two
        where a row is unknown. ``evidence`` in the details of ``run.json`` names the rows: ratios [1], then constants
        [A].
    """

    value: list[float | None]
    sd: list[float | None]
    explained: list[float]


def reported_evidence(
    rows: EvidenceRows,
    *,
    centre: Array,
    covariance: Array,
    drift: Array,
    offset_a: Array,
    hardware_drift: Array,
    hardware_offset_a: Array,
    full_scale_a: float,
) -> list[VehicleEvidence]:
    """The evidence rows in the units of the sensors, beside what the estimates make of them, for the pages of a report.

    Parameters
    ----------
    rows : EvidenceRows
        Of N vehicles with K branches; all that follows has its order of branches.
    centre : ndarray of shape (5K,)
        What vehicles without faults show in the rows: the load without a sensor belongs to the junction constant. [1]
    covariance : ndarray of shape (N, 5K, 5K)
        Of each reading together with what faultless vehicles differ by. [1]
    drift, offset_a, hardware_offset_a : ndarray of shape (N, K)
        Estimates. [1], [A], [A]
    hardware_drift : ndarray of shape (N,)
        Estimates. [1]
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    list of VehicleEvidence
        In the order of the vehicles.
    """
    gain, first = 1.0 + drift, 1.0 + drift[:, :1]
    ratios = np.exp(rows.relative)
    seen = np.concatenate([gain, first, np.ones_like(gain)], axis=1) * full_scale_a  # constants are held over (1 + d)
    value = np.concatenate([ratios, rows.constant * full_scale_a], axis=1)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) * np.concatenate([ratios, seen], axis=1)
    # a_k = (1 + d_k)(1 + d_h); -g_k = (1 + d_1) / (1 + d_k); b_k = o_k + (1 + d_k) o_h,k; c = (1 + d_1) sum o/(1 + d)
    relative = np.concatenate([gain * (1.0 + hardware_drift[:, None]), first / gain[:, 1:], gain], axis=1)
    junction = first * (offset_a / gain).sum(axis=1, keepdims=True)
    constant = np.concatenate([offset_a + gain * hardware_offset_a, junction, offset_a], axis=1)
    at = rows.places
    made = np.concatenate([relative * np.exp(centre[at.relative]), constant + seen * centre[at.constant]], axis=1)
    value[~rows.known], sd[~rows.known] = np.nan, np.nan

    def told(values: Array) -> list[list[float | None]]:
        return [[v if isfinite(v) else None for v in row] for row in values.tolist()]

    columns = zip(told(value), told(sd), made.tolist(), strict=True)
    return [VehicleEvidence(value=v, sd=s, explained=m) for v, s, m in columns]
