"""What is said of one vehicle: its parameter file, what would decide, and all of it in words."""

from collections.abc import Sequence
from typing import cast

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.estimator.fleet_estimate import FleetEstimate
from calibrator.files.parameter_files import RunIdentity, by_branch, current_moments, junction_residual
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.parameters import (
    BranchParameters,
    Explanation,
    HardwareFault,
    HeldBack,
    VehicleParameters,
    Verdict,
)

__all__ = [
    "deciding_evidence",
    "explained",
    "explanation_text",
    "impossible",
    "vehicle_parameters",
]

SUSPECTED = 0.5
"""Probability of a hardware fault from which on it is reported. [1]"""
SETTLED = 0.95
"""Confidence above which no other explanations are reported, if nothing is held back. [1]"""
MOST_REPORTED, LEAST_REPORTED = 3, 0.02
"""Explanations that are reported, and the least probability of one after the first. [1]"""
LEAST_RIVAL, LEAST_IN_THE_WAY = 0.02, 1e-4
"""Probability from which on another explanation is a rival, and from which on it can hold a correction back. [1]"""
RESOLVED = 0.002
"""Smallest difference that a zero-current window or a bench check shows: drifts, offsets over full scale. [1]"""
REASONS: dict[HeldBack, str] = {
    "beyond the limits": "it is beyond the limits of the layout: replace the sensor",
    "does not fit": "no gain error and offset explain what the sensor shows",
    "reference in doubt": "the fleet may be wrong about this branch as a whole",
    "moved too little": "its current moved too little for the gain to be known",
    "harm limit": "the correction might do harm",
}
"""Why a fault that was found is not corrected, in words."""


def impossible(estimate: FleetEstimate, j: int, branches: Sequence[str]) -> str:
    """Why a vehicle's currents are none that a parameter file can describe; empty if they are.

    Parameters
    ----------
    estimate : FleetEstimate
        Of N vehicles.
    j : int
        Which of them.
    branches : sequence of str
        Names of the K branches.

    Returns
    -------
    str
        One sentence.
    """
    possible = np.abs(estimate.drift[j]) < 1.0  # as in the schema of the parameter file
    if possible.all():
        return ""
    k = int(np.argmin(possible))
    for finding in estimate.findings[j]:
        if finding.branch == branches[k]:
            return finding.text
    return (
        f"its {branches[k]} current does not follow its inputs as in the rest of the fleet: parked, stuck, or another "
        f"kind of vehicle? record a drive in which it is used"
    )


def vehicle_parameters(
    vehicle: VehicleSummary,
    estimate: FleetEstimate,
    j: int,
    *,
    branches: Sequence[str],
    identity: RunIdentity,
    fleet_size: int,
    expected_a: float,
) -> VehicleParameters:
    """Write down what was found for one vehicle.

    Parameters
    ----------
    vehicle : VehicleSummary
        The vehicle.
    estimate : FleetEstimate
        Of it and others.
    j : int
        Which of them it is.
    branches : sequence of str
        Names of the K branches.
    identity : RunIdentity
        Of the run.
    fleet_size : int
        Vehicles of the fleet.
    expected_a : float
        Mean junction sum that right sensors show. [A]

    Returns
    -------
    VehicleParameters
        As its parameter file says it.
    """
    corrected = estimate.corrected[j]
    undecided = estimate.verdicts[j] == "cannot tell" or not estimate.confidence[j] >= SETTLED
    reported: list[Explanation] = []
    decisive = ""
    if undecided or (estimate.held_back[j] != "").any():
        found = list(estimate.explanations[j][:MOST_REPORTED])
        reported = [each for n, each in enumerate(found) if not n or each.probability >= LEAST_REPORTED]
        decisive = deciding_evidence(
            estimate,
            j,
            branches,
            full_scale_a=identity.database.layout.full_scale_a,
            layout=identity.database.layout.path.name,
        )
    hardware = _probability(estimate.hardware_probability[j])
    return VehicleParameters(
        vehicle=vehicle.vehicle,
        layout=identity.layout,
        dbc=identity.dbc,
        verdict=cast("Verdict", estimate.verdicts[j]),
        confidence=_probability(estimate.confidence[j]),
        branches={name: _branch(vehicle, estimate, (j, k), name) for k, name in enumerate(branches)},
        hardware_fault=HardwareFault(
            suspected=hardware is not None and hardware > SUSPECTED,
            drift=float(estimate.hardware_drift[j]),
            offset_a=by_branch(branches, estimate.hardware_offset_a[j]),
            probability=hardware,
        ),
        explanations=reported,
        deciding_evidence=decisive,
        findings=list(estimate.findings[j]),
        junction_residual=junction_residual(
            current_moments(vehicle.summary.mean_a, vehicle.summary.mean_product_a2),
            gain=np.where(corrected, 1.0 + estimate.drift[j], 1.0)[None],
            offset_a=np.where(corrected, estimate.offset_a[j], 0.0),
            expected_a=expected_a,
        ),
        provenance=identity.provenance(
            fleet_size=fleet_size, drives=vehicle.drives, duration_s=vehicle.summary.duration_s
        ),
    )


def _branch(vehicle: VehicleSummary, estimate: FleetEstimate, place: tuple[int, int], name: str) -> BranchParameters:
    k = vehicle.delays.branches.index(name)
    known = bool(vehicle.delays.known[k])
    return BranchParameters(
        drift=float(estimate.drift[place]),
        offset_a=float(estimate.offset_a[place]),
        drift_sd=float(estimate.drift_sd[place]),
        offset_sd_a=float(estimate.offset_sd_a[place]),
        apply=bool(estimate.corrected[place]),
        held_back=cast("HeldBack | None", str(estimate.held_back[place]) or None),
        delay_s=float(vehicle.delays.delay_s[k]) if known else None,
        delay_sd_s=float(vehicle.delays.sd_s[k]) if known else None,
        fault_probability=_probability(estimate.fault_probability[place]),
        harm_probability=_probability(estimate.harm_probability[place]),
        identifiable=bool(estimate.identifiable[place]),
    )


def _probability(value: float) -> float | None:
    """A probability free of rounding beyond its range; None where it is not known (NaN)."""
    return None if np.isnan(value) else float(np.clip(value, 0.0, 1.0))


def deciding_evidence(
    estimate: FleetEstimate, j: int, branches: Sequence[str], *, full_scale_a: float, layout: str = "the layout"
) -> str:
    """What would decide where it cannot be told what is faulty, or where a correction is held back.

    Parameters
    ----------
    estimate : FleetEstimate
        Of N vehicles.
    j : int
        Which of them.
    branches : sequence of str
        Names of the K branches.
    full_scale_a : float
        Full scale of the junction. [A]
    layout : str
        What the limits stand in.

    Returns
    -------
    str
        One sentence.
    """
    held_back, drift, offset_a = estimate.held_back[j], estimate.drift[j], estimate.offset_a[j]
    for k in np.flatnonzero(held_back == "beyond the limits").tolist():
        return (
            f"the {branches[k]} sensor is off by {drift[k]:+.1%} and {offset_a[k]:+.1f} A, beyond the limits of "
            f"{layout}: replace the sensor"
        )
    for k in np.flatnonzero(held_back == "does not fit").tolist():
        texts = [finding.text for finding in estimate.findings[j] if finding.branch == branches[k]]
        return texts[0] if texts else f"a check of the {branches[k]} sensor would decide: {REASONS['does not fit']}"
    doubtful = [branches[k] for k in np.flatnonzero(held_back == "reference in doubt").tolist()]
    if doubtful and not (held_back == "harm limit").any():
        return (
            f"bench-checked vehicles would decide: the fleet's reference is in doubt for branch {', '.join(doubtful)}; "
            f"name at least three with --trusted"
        )
    concerned = held_back != ""
    if rival := _rival(estimate.explanations[j], branches, concerned, full_scale_a):
        return rival
    # One explanation is left, and known too little: which sensor least, in parts of the faults that were found?
    sd = np.array([estimate.drift_sd[j], estimate.offset_sd_a[j] / full_scale_a])
    size = np.linalg.norm([drift, offset_a / full_scale_a], axis=1, keepdims=True)
    doubt = (sd / np.where(size > 0.0, size, 1.0)).max(axis=0)
    k = int(np.argmax(np.where(concerned | ~concerned.any(), doubt, -np.inf)))
    return (
        f"more drives would decide: the {branches[k]} sensor's drift is known to +-{estimate.drift_sd[j, k]:.2%} and "
        f"its offset to +-{estimate.offset_sd_a[j, k]:.2f} A only; record drives in which that current varies"
    )


def _rival(found: Sequence[Explanation], branches: Sequence[str], concerned: Mask, full_scale_a: float) -> str:
    """What would tell the most probable explanation from the one that stands most in its way; empty if none does."""
    least = LEAST_IN_THE_WAY if concerned.any() else LEAST_RIVAL
    first, *others = [each for n, each in enumerate(found) if not n or each.probability >= least]
    if not others:
        return ""

    def faults(each: Explanation) -> Array:
        """Drifts and offsets over full scale, shape (2, K)."""
        drift, offset_a = ([part.get(name, 0.0) for name in branches] for part in (each.drift, each.offset_a))
        return np.array([drift, np.divide(offset_a, full_scale_a)])

    best = faults(first)
    apart = [np.hypot(*(faults(each) - best))[concerned | ~concerned.any()] for each in others]
    in_the_way = [each.probability * a[a > RESOLVED].sum() for each, a in zip(others, apart, strict=True)]
    n = int(np.argmax(in_the_way))
    if not in_the_way[n]:
        same = "the explanations differ in the vehicle, not in its sensors: inspect the hardware"
        return "" if concerned.any() else same
    rival = faults(others[n])
    drift, offset = np.abs(rival - best)
    k = int(np.argmax(offset))
    if offset[k] > RESOLVED:
        readings = f"{best[1, k] * full_scale_a:+.1f} A or {rival[1, k] * full_scale_a:+.1f} A"
        return f"a zero-current window (contactors open) would decide: the {branches[k]} sensor then shows {readings}"
    k = int(np.argmax(drift))
    readings = f"{best[0, k]:+.1%} or {rival[0, k]:+.1%}"
    return f"a check of the {branches[k]} sensor against a reference would decide: its gain is off by {readings}"


def explained(parameters: VehicleParameters) -> str:
    """What was found for a vehicle, why, and what would decide, for people.

    Parameters
    ----------
    parameters : VehicleParameters
        Of the vehicle.

    Returns
    -------
    str
        A few lines.
    """
    confidence, hardware = parameters.confidence, parameters.hardware_fault
    sure = "" if confidence is None else f" (confidence {confidence:.2f})"
    lines = [f"{parameters.vehicle}: {parameters.verdict}{sure}"]
    lines += [f"  {name}: {_sensor_text(branch)}" for name, branch in parameters.branches.items()]
    if hardware.suspected:
        offset_a = {name: value for name, value in hardware.offset_a.items() if value}
        changes = Explanation(probability=1.0, hardware_drift=hardware.drift, hardware_offset_a=offset_a)
        sure = "" if hardware.probability is None else f", probability {hardware.probability:.2f}"
        lines.append(f"  the vehicle itself differs from its fleet{sure}: {explanation_text(changes)}")
    if parameters.explanations:
        lines.append("possible explanations:")
        lines += [f"  {each.probability:.3f}  {explanation_text(each)}" for each in parameters.explanations]
    if parameters.findings:
        lines.append("for the workshop:")
        lines += [f"  {each.probability:.2f}  {each.text}" for each in parameters.findings]
    if parameters.deciding_evidence:
        lines.append(parameters.deciding_evidence)
    residual = parameters.junction_residual
    lines.append(f"junction sum: {residual.measured_a:.2f} A RMS as measured, {residual.corrected_a:.2f} A corrected")
    return "\n".join(lines)


def _sensor_text(branch: BranchParameters) -> str:
    probability = "" if branch.fault_probability is None else f" (probability of one {branch.fault_probability:.2f})"
    if not branch.drift and not branch.offset_a:
        return f"no fault found{probability}"
    drift_sd, offset_sd = (
        "" if sd is None else f" +- {text}"
        for sd, text in (
            (branch.drift_sd, f"{branch.drift_sd or 0.0:.2%}"),
            (branch.offset_sd_a, f"{branch.offset_sd_a or 0.0:.2f} A"),
        )
    )
    reason = "" if branch.held_back is None else f", because {REASONS[branch.held_back]}"
    fate = "corrected" if branch.apply else f"not corrected{reason}"
    return f"gain error (drift) {branch.drift:+.2%}{drift_sd}, offset {branch.offset_a:+.2f} A{offset_sd}: {fate}"


def explanation_text(explanation: Explanation) -> str:
    """One explanation in words, without its probability."""
    sensors = []
    for name in dict.fromkeys([*explanation.drift, *explanation.offset_a]):
        drift, offset_a = explanation.drift.get(name), explanation.offset_a.get(name)
        values = [f"drift {drift:+.2%}"] if drift else []
        values += [f"offset {offset_a:+.2f} A"] if offset_a else []
        sensors.append(f"{name} sensor: {', '.join(values)}")
    hardware = [f"all currents {explanation.hardware_drift:+.2%}"] if explanation.hardware_drift else []
    hardware += [f"{name} {value:+.2f} A" for name, value in explanation.hardware_offset_a.items()]
    return "; ".join([*sensors, *(f"hardware: {text}" for text in hardware)]) or "no fault"
