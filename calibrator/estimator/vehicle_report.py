"""What was found for a vehicle, in words: its sensors, why faults are not corrected, and what evidence would decide."""

from collections.abc import Sequence

import numpy as np

from calibrator.drive import Array
from ecu_node.parameters import BranchParameters, Explanation, HeldBack, VehicleParameters

__all__ = [
    "LEAST_RIVAL",
    "REASONS",
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
LEAST_RIVAL = 0.02
"""Probability from which on another explanation is a rival of the most probable one. [1]"""


def explained_faults(explanation: Explanation, branches: Sequence[str]) -> Array:
    """Return the drifts [1] and offsets [A] of the K sensors in an explanation, shape (2, K)."""
    return np.array([[part.get(name, 0.0) for name in branches] for part in (explanation.drift, explanation.offset_a)])


def explained(parameters: VehicleParameters) -> str:
    """Return the result of a vehicle as readable text: verdict, faults, explanations, findings, sum of the junction.

    If explanations remain that the data cannot tell apart, it also says which further evidence would.
    """
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
