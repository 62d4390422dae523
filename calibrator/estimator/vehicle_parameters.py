"""Parameters of a vehicle as written for the node: faults, junction sum before and after, and which run found them."""

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.drives.delays import BranchDelays
from calibrator.estimator.decision import FleetEstimate
from calibrator.estimator.readings import flow_findings
from calibrator.estimator.settings import CONFIDENT, SUSPECTED, RunIdentity
from calibrator.estimator.vehicle_report import LEAST_RIVAL, REASONS, explained_faults
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.parameters import (
    BranchParameters,
    Explanation,
    HardwareFault,
    HeldBack,
    JunctionResidual,
    VehicleParameters,
    Verdict,
)

__all__ = [
    "by_branch",
    "current_moments",
    "deciding_evidence",
    "impossible",
    "junction_residual",
    "parameters_of",
]

MOST_REPORTED, LEAST_REPORTED = 3, 0.02
"""Largest number of explanations that are reported, and least probability of one after the first. [1]"""
LEAST_IN_THE_WAY = 1e-4
"""Probability from which on another explanation can hold a correction back. [1]"""
RESOLVED = 0.002
"""Smallest difference that a zero-current window or a bench check shows: drifts, offsets over full scale. [1]"""
QUIET_SHARE = 0.25
"""Share of the blocks, those with the least throughput (current through the junction), that count as at rest. [1]"""
STABILITY = 0.01
"""Least change of gains with temperature between drives that is assumed: the node must not take it for a fault. [1]"""
TINY_A2 = 1e-12
"""Least squared throughput, so that it can be divided by. [A^2]"""


def by_branch(branches: Sequence[str], values: Array) -> dict[str, float]:
    """Return the values of the branches by their names."""
    return dict(zip(branches, values.tolist(), strict=True))


def current_moments(mean_a: Array, product_a2: Array) -> Array:
    """Return moments of the measured currents and of 1 as those of one block, for :func:`junction_residual`.

    Parameters
    ----------
    mean_a : ndarray of shape (K,)
        Mean measured currents. [A]
    product_a2 : ndarray of shape (K, K)
        Mean products of measured currents. [A^2]

    Returns
    -------
    ndarray of shape (1, K + 1, K + 1)
        Mean products of (i_m,1 ... i_m,K, 1).
    """
    row = np.append(mean_a, 1.0)
    return np.block([[product_a2, mean_a[:, None]], [row[None, :]]])[None]


def junction_residual(moments: Array, *, gain: Array, offset_a: Array, expected_a: float) -> JunctionResidual:
    """Compute the RMS and mean of the Kirchhoff sum before and after the correction of given sensor faults.

    Parameters
    ----------
    moments : ndarray of shape (B, K + 1, K + 1)
        Sums or means of products of (i_m,1 ... i_m,K, 1), of each block of the drives. [A^2]
    gain : ndarray of shape (B, K) or (1, K)
        Divisor of each current, 1 where it is not corrected. [1]
    offset_a : ndarray of shape (K,)
        Offset that is subtracted before that. [A]
    expected_a : float
        Mean sum that faultless sensors would show: the load that none of them sees, positive if it takes current. [A]

    Returns
    -------
    JunctionResidual
        RMS and mean of sum_k i_m,k and sum_k (i_m,k - o_k) / gain_k over all valid samples.
    """
    weight = np.broadcast_to(1.0 / gain, (len(moments), gain.shape[1]))
    corrected = np.column_stack([weight, -weight @ offset_a])
    measured = np.column_stack([np.ones_like(weight), np.zeros(len(weight))])
    samples = float(moments[:, -1, -1].sum())

    def rms(sums: Array) -> float:
        return float(np.sqrt(max(float(np.einsum("bk,bkl,bl->", sums, moments, sums)) / samples, 0.0)))

    def mean(sums: Array) -> float:
        return float(np.einsum("bk,bk->", sums, moments[:, :, -1])) / samples

    sd_a, sd_per_a = _spread(moments / samples, corrected - np.append(np.zeros_like(offset_a), expected_a))
    return JunctionResidual(
        measured_a=rms(measured),
        corrected_a=rms(corrected),
        correction_a=rms(measured - corrected),
        measured_mean_a=mean(measured),
        corrected_mean_a=mean(corrected),
        expected_a=expected_a,
        corrected_sd_a=sd_a,
        corrected_sd_per_a=sd_per_a,
    )


def _spread(moments: Array, sums: Array) -> tuple[float, float]:
    """Return the RMS of the sums at rest [A], and what it grows by per ampere of current through the junction [1].

    ``moments`` (B, K + 1, K + 1) and ``sums``, the factors (B, K + 1) that make the sum of (i_m,1 ... i_m,K, 1), are by
    block. The blocks with the least throughput give the RMS at rest; the excess of all blocks over it is taken to grow
    with the throughput. Half the sum of the squared currents stands for the squared throughput and is not more.
    """
    share, weight = moments[:, -1, -1], sums[:, :-1]
    square_a2 = np.maximum(np.einsum("bk,bkl,bl->b", sums, moments, sums), 0.0)
    throughput_a2 = 0.5 * np.einsum("bk,bkk->b", weight**2, moments[:, :-1, :-1])
    level = throughput_a2 / share
    quiet = level <= np.quantile(level, QUIET_SHARE)
    rest_a2 = float(square_a2[quiet].sum() / share[quiet].sum())
    growth = max(float(square_a2.sum()) - rest_a2, 0.0) / max(float(throughput_a2.sum()), TINY_A2)
    return math.sqrt(rest_a2), min(math.hypot(math.sqrt(growth), STABILITY), 1.0)  # 1 with a dead sensor


def impossible(estimate: FleetEstimate, j: int, branches: Sequence[str]) -> str:
    """Return why a parameter file cannot describe the sensors of vehicle j; empty if it can."""
    possible = np.abs(estimate.drift[j]) < 1.0  # as in the schema of the parameter file
    if possible.all():
        return ""
    k = int(np.argmin(possible))
    return next((each.text for each in estimate.findings[j] if each.branch == branches[k]), "") or (
        f"its {branches[k]} sensor reads {1.0 + estimate.drift[j, k]:.1f} times the current: another unit, parked, "
        f"stuck, or another kind of vehicle? check it, and what is known of other sensors, or record a drive in which "
        f"it is used"
    )


def parameters_of(
    vehicle: VehicleSummary,
    estimate: FleetEstimate,
    j: int,
    *,
    identity: RunIdentity,
    branches: Sequence[str],
    expected_a: float,
    fleet_size: int,
    decisive: str | None = None,
) -> VehicleParameters:
    """Return the parameters of vehicle j of an estimate: faults, explanations, findings, and where they come from.

    Parameters
    ----------
    vehicle, estimate, j : VehicleSummary, FleetEstimate, int
        The vehicle, the estimate, and the position of the vehicle in it.
    identity : RunIdentity
        Identity of the run.
    branches : sequence of str
        Names of the K branches.
    expected_a : float
        Mean junction sum that faultless sensors show, see :func:`junction_residual`. [A]
    fleet_size : int
        Number of usable vehicles of the fleet; 1: the vehicle was calibrated by itself.
    decisive : str or None
        Evidence that would decide what is in doubt; None: it is found from the explanations.

    Returns
    -------
    VehicleParameters
        Content of its parameter file.
    """
    corrected, held_back = estimate.corrected[j], estimate.held_back[j] != ""
    reported, deciding = list[Explanation](), decisive or ""
    if estimate.verdicts[j] == "cannot tell" or not estimate.confidence[j] >= CONFIDENT or held_back.any():
        first, *others = estimate.explanations[j][:MOST_REPORTED]
        reported = [first, *(each for each in others if each.probability >= LEAST_REPORTED)]
        if decisive is None:
            deciding, rival = deciding_evidence(estimate, j, branches, layout=identity.database.layout.path.name)
            reported += [rival] if rival is not None and rival not in reported else []
    hardware, inputs = _probability(estimate.hardware_probability[j]), vehicle.summary.inputs
    return VehicleParameters(
        vehicle=vehicle.vehicle,
        layout=identity.layout,
        dbc=identity.dbc,
        verdict=cast("Verdict", estimate.verdicts[j]),
        confidence=_probability(estimate.confidence[j]),
        branches={name: _branch(vehicle.delays, estimate, (j, k), name) for k, name in enumerate(branches)},
        hardware_fault=HardwareFault(
            suspected=hardware is not None and hardware > SUSPECTED,
            drift=float(estimate.hardware_drift[j]),
            offset_a=by_branch(branches, estimate.hardware_offset_a[j]),
            probability=hardware,
        ),
        explanations=reported,
        deciding_evidence=deciding,
        findings=[*estimate.findings[j], *flow_findings(vehicle)],
        junction_residual=junction_residual(
            vehicle.summary.moments[:, inputs:, inputs:],
            gain=np.where(corrected, 1.0 + estimate.drift[j], 1.0)[None],
            offset_a=np.where(corrected, estimate.offset_a[j], 0.0),
            expected_a=expected_a,
        ),
        provenance=identity.provenance(
            fleet_size=fleet_size, drives=vehicle.drives, duration_s=vehicle.summary.duration_s
        ),
    )


def _branch(delays: BranchDelays, estimate: FleetEstimate, place: tuple[int, int], name: str) -> BranchParameters:
    k = delays.branches.index(name)
    delay_s, delay_sd_s = (float(values[k]) if delays.known[k] else None for values in (delays.delay_s, delays.sd_s))
    numbers: dict[str, Any] = {
        each: float(getattr(estimate, each)[place]) for each in ("drift", "offset_a", "drift_sd", "offset_sd_a")
    }
    return BranchParameters(
        **numbers,
        apply=bool(estimate.corrected[place]),
        held_back=cast("HeldBack | None", str(estimate.held_back[place]) or None),
        delay_s=delay_s,
        delay_sd_s=delay_sd_s,
        fault_probability=_probability(estimate.fault_probability[place]),
        harm_probability=_probability(estimate.harm_probability[place]),
        identifiable=bool(estimate.identifiable[place]),
    )


def _probability(value: float) -> float | None:
    """Clip a probability to its range, which rounding may exceed; None where it is not known (NaN)."""
    return None if np.isnan(value) else float(np.clip(value, 0.0, 1.0))


def deciding_evidence(
    estimate: FleetEstimate, j: int, branches: Sequence[str], *, layout: str
) -> tuple[str, Explanation | None]:
    """Return a sentence on what evidence would decide which sensor is faulty, or allow a correction that is held back.

    Parameters
    ----------
    estimate, j : FleetEstimate, int
        Estimate of N vehicles, and position of the vehicle in it.
    branches : sequence of str
        Names of the K branches.
    layout : str
        Name of the layout file, which contains the limits.

    Returns
    -------
    text : str
        The sentence.
    rival : Explanation or None
        The explanation that this evidence would tell from the most probable one, if the text is about one.
    """
    held_back, drift, offset_a = estimate.held_back[j], estimate.drift[j], estimate.offset_a[j]
    full_scale_a = estimate.full_scale_a

    def those(reason: HeldBack) -> list[str]:
        return [branches[k] for k in np.flatnonzero(held_back == reason).tolist()]

    if beyond := those("beyond the limits"):
        k = branches.index(beyond[0])
        return (
            f"the {branches[k]} sensor is off by {100.0 * drift[k]:+z.1f} % and {offset_a[k]:+.1f} A, beyond the "
            f"limits of {layout}: replace the sensor"
        ), None
    if unfit := those("does not fit"):  # a finding of such a branch, else of no branch, else of another one
        found = sorted(estimate.findings[j], key=lambda each: (each.branch not in unfit, each.branch is not None))
        check = f"a check of the {unfit[0]} sensor would decide: {REASONS['does not fit']}"
        return found[0].text if found else check, None
    doubtful = those("reference in doubt")
    if doubtful and not those("harm limit"):
        return (
            f"bench-checked vehicles would decide: the fleet's reference is in doubt for branch {', '.join(doubtful)}; "
            f"see the notices, or name at least three with --trusted"
        ), None
    text, rival = _rival(estimate.explanations[j], branches, held_back != "", full_scale_a)
    if text:
        return text, rival
    loads = [each for each in estimate.findings[j] if each.cause == "load"]
    if loads and not (held_back != "").any():
        what = f"a zero-current window (contactors open) or a bench check of the {loads[0].branch} sensor would decide"
        return f"{what}: {loads[0].text}", None
    # One explanation is left, and not known well enough: which sensor is known least, relative to the faults found?
    sd = np.array([estimate.drift_sd[j], estimate.offset_sd_a[j] / full_scale_a])
    size = np.linalg.norm([drift, offset_a / full_scale_a], axis=1, keepdims=True)
    unsure = (sd / np.where(size > 0.0, size, 1.0)).max(axis=0)
    k = int(np.argmax(np.where((held_back != "") | ~(held_back != "").any(), unsure, -np.inf)))
    return (
        f"more drives would decide: the {branches[k]} sensor's drift is known to "
        f"+-{100.0 * estimate.drift_sd[j, k]:.2f} % and its offset to "
        f"+-{estimate.offset_sd_a[j, k]:.2f} A only; record drives in which that current varies"
    ), None


def _rival(
    found: Sequence[Explanation], branches: Sequence[str], held: Mask, full_scale_a: float
) -> tuple[str, Explanation | None]:
    """Return what would tell the most probable explanation from its strongest rival ("": nothing), and that rival.

    Only differences in sensors whose correction is held back (``held``, shape (K,)) count; if none is, all count.
    """
    least = LEAST_IN_THE_WAY if held.any() else LEAST_RIVAL
    others = [each for each in found[1:] if each.probability >= least]
    best, *rivals = (explained_faults(each, branches) / [[1.0], [full_scale_a]] for each in (found[0], *others))
    apart = [np.hypot(*(rival - best))[held | ~held.any()] for rival in rivals]
    in_the_way = [each.probability * a[a > RESOLVED].sum() for each, a in zip(others, apart, strict=True)]
    if not any(in_the_way):
        same = "the explanations differ in the vehicle, not in its sensors: inspect the hardware"
        return same if rivals and not held.any() else "", None
    most = int(np.argmax(in_the_way))
    rival, explanation = rivals[most], others[most]
    drift, offset = np.abs(rival - best)
    k = int(np.argmax(offset))
    if offset[k] > RESOLVED:
        what = f"a zero-current window (contactors open) would decide: the {branches[k]} sensor then shows"
        return f"{what} {best[1, k] * full_scale_a:+.1f} A or {rival[1, k] * full_scale_a:+.1f} A", explanation
    k = int(np.argmax(drift))
    what = f"a check of the {branches[k]} sensor against a reference would decide: its gain is off by"
    return f"{what} {100.0 * best[0, k]:+z.1f} % or {100.0 * rival[0, k]:+z.1f} %", explanation
