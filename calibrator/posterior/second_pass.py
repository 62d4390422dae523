"""What becomes of sensors that are not linear: they are told in the parameter file, and never corrected.

The node corrects linear sensors, so a branch with a sensor model is passed through. Where a vehicle has such a sensor
and it is not clear which, none of its branches is corrected.
"""

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
from scipy.special import expit, logit

from calibrator.drive import Mask
from calibrator.posterior.verdict import Deployment
from calibrator.sensor_models.choice import LINEAR, PRIOR_SHARE, SensorModelChoice
from calibrator.sensor_models.fleet import SensorFindings
from calibrator.sensor_models.linear_part import sensor_parameters
from ecu_node.parameters import BranchParameters, VehicleParameters, Verdict
from ecu_node.sensor_models import GainBySign

__all__ = ["finding_notices", "tell_sensors", "without_sensor_models"]


def without_sensor_models(deployment: Deployment, findings: SensorFindings) -> Deployment:
    """Take back what cannot be deployed because a sensor is not linear.

    Parameters
    ----------
    deployment : Deployment
        Decision for the linear parts of N vehicles with K branches.
    findings : SensorFindings
        Of the same vehicles.

    Returns
    -------
    Deployment
        No branch with a sensor model is corrected, and none of a vehicle with an undecided one. Such a vehicle has the
        verdict "corrected" if another of its branches is, else "cannot tell".
    """
    not_linear, undecided = findings.not_linear, findings.undecided
    not_corrected: Mask = not_linear | undecided.any(axis=1, keepdims=True)
    held_back = deployment.held_back.copy()
    held_back[not_linear | (deployment.corrected & not_corrected)] = "not linear"
    corrected = deployment.corrected & ~not_corrected
    concerned: Mask = np.any(not_corrected, axis=1)
    verdicts = tuple(
        _verdict(any_corrected=bool(corrected[j].any())) if concerned[j] else verdict
        for j, verdict in enumerate(deployment.verdicts)
    )
    return replace(deployment, corrected=corrected, held_back=held_back, verdicts=verdicts)


def _verdict(*, any_corrected: bool) -> Verdict:
    return "corrected" if any_corrected else "cannot tell"


def tell_sensors(parameters: VehicleParameters, choices: Sequence[SensorModelChoice]) -> VehicleParameters:
    """Say in a vehicle's parameters which of its sensors are not linear.

    Parameters
    ----------
    parameters : VehicleParameters
        Of the linear parts, as deployed after :func:`without_sensor_models`.
    choices : sequence of K SensorModelChoice
        For its branches, in their order.

    Returns
    -------
    VehicleParameters
        With the sensor models, and what would decide if it cannot tell. A branch with a sensor model has no probability
        of harm, as nothing is corrected with it; a vehicle of which it is undecided which sensor is not linear has no
        confidence. The same parameters if all sensors are linear.
    """
    why_not = _why_not_corrected(choices, list(parameters.branches))
    if not why_not:
        return parameters
    held_back = any(branch.held_back == "not linear" for branch in parameters.branches.values())
    concerned = held_back or parameters.verdict == "cannot tell"
    return msgspec.structs.replace(
        parameters,
        branches={
            name: _told(branch, choice)
            for (name, branch), choice in zip(parameters.branches.items(), choices, strict=True)
        },
        confidence=None if any(choice.undecided for choice in choices) else parameters.confidence,
        deciding_evidence=why_not if concerned else parameters.deciding_evidence,
    )


def _told(linear_part: BranchParameters, choice: SensorModelChoice) -> BranchParameters:
    """Parameters of a branch; those of the linear part if a parameter file cannot say it (gain errors of 100 %)."""
    if choice.model == LINEAR:
        return linear_part
    drift, model = sensor_parameters(choice, linear_part.drift)
    drift_sd = linear_part.drift_sd
    if isinstance(model, GainBySign) and drift_sd is not None and model.difference_sd is not None:
        drift_sd = float(np.hypot(drift_sd, 0.5 * model.difference_sd))
    probably_linear = float(expit(-choice.log_bayes_factor - logit(PRIOR_SHARE)))
    told = msgspec.structs.replace(
        linear_part,
        drift=drift,
        drift_sd=drift_sd,
        sensor_model=model,
        fault_probability=1.0 - (1.0 - (linear_part.fault_probability or 0.0)) * probably_linear,
        harm_probability=None,
    )
    try:
        return msgspec.convert(msgspec.to_builtins(told), BranchParameters)
    except msgspec.ValidationError:
        return linear_part


def _why_not_corrected(choices: Sequence[SensorModelChoice], branches: Sequence[str]) -> str:
    """Why a vehicle cannot be corrected as if its sensors were linear; empty if they are."""
    undecided = [name for name, choice in zip(branches, choices, strict=True) if choice.undecided]
    if undecided:
        return (
            f"a sensor is not linear, and it cannot be told which ({' or '.join(undecided)}); check them on a bench "
            f"or record more drives"
        )
    found = _found(choices, branches)
    return f"not linear, which the node cannot correct: {found}; replace the sensor" if found else ""


def finding_notices(vehicles: Sequence[str], findings: SensorFindings, branches: Sequence[str]) -> tuple[str, ...]:
    """Say which sensors of a fleet are not linear.

    Parameters
    ----------
    vehicles : sequence of str
        Names of the N vehicles.
    findings : SensorFindings
        Of the same vehicles.
    branches : sequence of str
        Names of the K branches.

    Returns
    -------
    tuple of str
        One line per vehicle concerned, after the notices of the second pass itself.
    """
    reasons = [_why_not_corrected(choices, branches) for choices in findings.choices]
    lines = [f"vehicle {vehicle}: {reason}" for vehicle, reason in zip(vehicles, reasons, strict=True) if reason]
    return (*findings.notices, *lines)


def _found(choices: Sequence[SensorModelChoice], branches: Sequence[str]) -> str:
    pairs = zip(branches, choices, strict=True)
    return ", ".join(f"{name} ({choice.model})" for name, choice in pairs if choice.model != LINEAR)
