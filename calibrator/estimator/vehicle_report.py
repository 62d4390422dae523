"""What was found for a vehicle, in words: its sensors, why faults are not corrected, and what evidence would decide."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from calibrator.drive import Array, Mask
from ecu_node.parameters import BranchParameters, Explanation, HeldBack, VehicleParameters

if TYPE_CHECKING:
    from calibrator.estimator.decision import FleetEstimate  # its import takes a second, which reports need not wait

__all__ = [
    "REASONS",
    "deciding_evidence",
    "explained",
    "explained_faults",
    "explanation_text",
    "held_back_lines",
    "sensor_texts",
]

REASONS: dict[HeldBack, str] = {
    "beyond the limits": "it is beyond the limits of the layout: replace the sensor",
    "does not fit": "no gain error and offset explain what the sensor shows",
    "reference in doubt": "what it is compared with, the fleet or a known sensor, is in doubt",
    "moved too little": "its current moved too little for the gain to be known",
    "harm limit": "the correction might do harm",
}
"""Why a fault that was found is not corrected, in words."""
LEAST_RIVAL, LEAST_IN_THE_WAY = 0.02, 1e-4
"""Probability from which on another explanation is a rival, and from which on it can hold a correction back. [1]"""
RESOLVED = 0.002
"""Smallest difference that a zero-current window or a bench check shows: drifts, offsets over full scale. [1]"""


def explained_faults(explanation: Explanation, branches: Sequence[str]) -> Array:
    """Return the drifts [1] and offsets [A] of the K sensors in an explanation, shape (2, K)."""
    return np.array([[part.get(name, 0.0) for name in branches] for part in (explanation.drift, explanation.offset_a)])


def deciding_evidence(
    estimate: "FleetEstimate", j: int, branches: Sequence[str], *, layout: str
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
            f"name at least three with --trusted"
        ), None
    text, rival = _rival(estimate.explanations[j], branches, held_back != "", full_scale_a)
    if text:
        return text, rival
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


def explained(parameters: VehicleParameters) -> str:
    """Return some lines for people: what was found for a vehicle, why, and what would decide what is open."""
    confidence, hardware, residual = parameters.confidence, parameters.hardware_fault, parameters.junction_residual
    sure = "" if confidence is None else f" (confidence {confidence:.2f})"
    lines = [f"{parameters.vehicle}: {parameters.verdict}{sure}"]
    lines += [f"  {name}: {text}" for name, text in sensor_texts(parameters).items()]
    lines += [f"  {line}" for line in held_back_lines(parameters)]
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
    said = {"", *(each.text for each in parameters.findings)}
    lines += [] if parameters.deciding_evidence in said else [parameters.deciding_evidence]
    lines.append(f"junction sum: {residual.measured_a:.2f} A RMS as measured, {residual.corrected_a:.2f} A corrected")
    return "\n".join(lines)


def held_back_lines(parameters: VehicleParameters) -> list[str]:
    """Return a line per reason: which faults that were found are not corrected, and why."""
    lines = []
    for reason, why in REASONS.items():
        held_back = {name: branch for name, branch in parameters.branches.items() if branch.held_back == reason}
        harm = [branch.harm_probability for branch in held_back.values() if branch.harm_probability is not None]
        shares = ", ".join(f"{share:.2%}" for share in harm)
        more = f", with a probability of {shares} (see --harm-limit)" if reason == "harm limit" and harm else ""
        lines += [f"{', '.join(held_back)} not corrected, because {why}{more}"] if held_back else []
    return lines


def sensor_texts(parameters: VehicleParameters) -> dict[str, str]:
    """Describe for each branch the faults of its sensor, how sure they are, and whether they are corrected."""
    alone = parameters.provenance.fleet_size == 1  # values then are means over all explanations
    rivals = parameters.explanations if alone else []
    return {
        name: _sensor_text(branch, [(each.probability, each.offset_a.get(name, 0.0)) for each in rivals])
        for name, branch in parameters.branches.items()
    }


def _sensor_text(branch: BranchParameters, offsets: Sequence[tuple[float, float]]) -> str:
    """Describe the faults of one sensor; ``offsets`` has the probability [1] and offset [A] of each explanation."""
    chance = branch.fault_probability
    probability = "" if chance is None else f" (probability of a fault {chance:.2f})"
    if not branch.drift and not branch.offset_a:
        return f"no fault found{probability}"
    drift_sd = f" +- {100.0 * branch.drift_sd:.2f} %" if branch.drift_sd else ""
    drift = f"{100.0 * branch.drift:+z.2f} %{drift_sd}" if branch.identifiable else f"not known{drift_sd}"
    offset = f"{branch.offset_a:+.2f} A" + ("" if branch.offset_sd_a is None else f" +- {branch.offset_sd_a:.2f} A")
    peaks = dict.fromkeys(f"{offset_a:+.1f}" if offset_a else "0" for p, offset_a in offsets if p >= LEAST_RIVAL)
    if len(peaks) > 1 and not branch.apply:
        offset = f"{' or '.join(peaks)} A"
    return (
        f"gain error (drift) {drift}, offset {offset}: {'corrected' if branch.apply else 'not corrected'}{probability}"
    )


def explanation_text(explanation: Explanation) -> str:
    """Put one explanation into words, without its probability."""
    sensors = []
    for name in dict.fromkeys([*explanation.drift, *explanation.offset_a]):
        drift, offset_a = explanation.drift.get(name), explanation.offset_a.get(name)
        values = [f"drift {100.0 * drift:+z.2f} %"] if drift else []
        values += [f"offset {offset_a:+.2f} A"] if offset_a else []
        sensors.append(f"{name} sensor: {', '.join(values)}")
    hardware = [f"all currents {100.0 * explanation.hardware_drift:+z.2f} %"] if explanation.hardware_drift else []
    hardware += [f"{name} {value:+.2f} A" for name, value in explanation.hardware_offset_a.items()]
    return "; ".join([*sensors, *(f"hardware: {text}" for text in hardware)]) or "no fault"
