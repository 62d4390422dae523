"""What the parameter file and the notices say of sensors that are not linear."""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from scipy.special import expit, logit

from calibrator.files.parameter_files import junction_residual
from calibrator.posterior.model_decision import JudgedSensor
from calibrator.sensor_models.choice import LINEAR, PRIOR_SHARE, SensorModelChoice
from calibrator.sensor_models.fleet import SensorFindings
from calibrator.sensor_models.linear_part import sensor_parameters
from calibrator.sensor_models.modelled import ModelledVehicle
from ecu_node.parameters import BranchParameters, VehicleParameters

__all__ = ["finding_notices", "tell_sensors", "with_model_residual"]

TEMPERATURE_ADVICE = "name the temperature of the sensors in the layout, and calibrate anew"


def tell_sensors(
    parameters: VehicleParameters, choices: Sequence[SensorModelChoice], judged: Mapping[int, JudgedSensor]
) -> VehicleParameters:
    """Say in a vehicle's parameters which of its sensors are not linear.

    Parameters
    ----------
    parameters : VehicleParameters
        Of the linear parts, as decided by :func:`~calibrator.posterior.second_pass.with_sensor_models`.
    choices : sequence of K SensorModelChoice
        For its branches, in their order.
    judged : mapping of int to JudgedSensor
        Those that are not linear, by branch.

    Returns
    -------
    VehicleParameters
        With the sensor models, and what would decide on those that are not corrected. A vehicle of which it is
        undecided which sensor is not linear has no confidence. The same parameters if all sensors are linear.
    """
    names = list(parameters.branches)
    branches = {
        name: _told(branch, choices[k], judged[k]) if k in judged else branch
        for k, (name, branch) in enumerate(parameters.branches.items())
    }
    undecided = [name for name, choice in zip(names, choices, strict=True) if choice.undecided]
    told = msgspec.structs.replace(
        parameters, branches=branches, confidence=None if undecided else parameters.confidence
    )
    advice = _undecided(undecided) if undecided else _advice(told, choices, judged)
    return msgspec.structs.replace(told, deciding_evidence=advice or parameters.deciding_evidence)


def _told(linear_part: BranchParameters, choice: SensorModelChoice, judged: JudgedSensor) -> BranchParameters:
    """Parameters of a branch; those of the linear part if a parameter file cannot say it."""
    found = sensor_parameters(choice, linear_part.drift)
    if found is None:
        return linear_part
    drift, model = found
    probably_linear = float(expit(-choice.log_bayes_factor - logit(PRIOR_SHARE)))
    in_doubt = linear_part.harm_probability is None
    return msgspec.structs.replace(
        linear_part,
        drift=drift,
        drift_sd=judged.drift_sd,
        offset_sd_a=judged.offset_sd_a,
        sensor_model=model,
        fault_probability=None if in_doubt else 1.0 - (1.0 - (linear_part.fault_probability or 0.0)) * probably_linear,
        harm_probability=None if in_doubt else judged.harm,
    )


def _undecided(branches: Sequence[str]) -> str:
    return (
        f"a sensor is not linear, and it cannot be told which ({' or '.join(branches)}); check them on a bench or "
        f"record more drives"
    )


def _advice(
    parameters: VehicleParameters, choices: Sequence[SensorModelChoice], judged: Mapping[int, JudgedSensor]
) -> str:
    """What would decide on the first sensor with a model that is not corrected; empty if its linear part tells."""
    for k, (name, branch) in enumerate(parameters.branches.items()):
        if k not in judged:
            continue
        sensor = f"the {name} sensor ({choices[k].model})"
        match branch.held_back:
            case "no temperature":
                return f"{sensor} cannot be corrected without its temperature: {TEMPERATURE_ADVICE}"
            case "not linear":
                return f"{sensor} is off by more than a parameter file can say; replace the sensor"
            case "beyond the limits":
                off = f"up to {judged[k].largest_drift:.1%} and {branch.offset_a:+.1f} A"
                return f"{sensor} is off by {off}, beyond the limits of {parameters.layout.name}: replace the sensor"
            case "harm limit":
                return (
                    f"{sensor} is not known well enough to correct it: record more drives, in which that current varies"
                )
    return ""


def with_model_residual(
    parameters: VehicleParameters, vehicle: ModelledVehicle, *, linear: Mapping[str, float]
) -> VehicleParameters:
    """Correct the junction sum of a vehicle's parameters for what is applied of its sensor models.

    Parameters
    ----------
    parameters : VehicleParameters
        With the sensor models.
    vehicle : ModelledVehicle
        The same vehicle.
    linear : mapping of str to float
        Drifts of the linear parts, by branch. [1]

    Returns
    -------
    VehicleParameters
        With the root mean square of the sum of what the node publishes.
    """
    applied = [branch.apply for branch in parameters.branches.values()]
    drift = np.array(list(linear.values()))
    offset_a = np.array([branch.offset_a for branch in parameters.branches.values()])
    parts = vehicle.with_excess({s.branch: 0.0 for s in vehicle.sensors if not applied[s.branch]})
    gain = np.tile(np.where(applied, 1.0 + drift, 1.0), (len(parts.moments), 1))
    for sensor in vehicle.sensors:
        if applied[sensor.branch]:
            gain[:, sensor.branch] *= sensor.block_gain()
    before = parameters.junction_residual
    found = junction_residual(
        parts.moments[:, parts.inputs :, parts.inputs :],
        gain=gain,
        offset_a=np.where(applied, offset_a, 0.0),
        expected_a=before.expected_a,
    )
    residual = msgspec.structs.replace(  # of the parts that are linear only what is corrected is that of the drives
        before, corrected_a=found.corrected_a, corrected_mean_a=found.corrected_mean_a, correction_a=None
    )
    return msgspec.structs.replace(parameters, junction_residual=residual)


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
    reasons = [_finding(choices, branches) for choices in findings.choices]
    lines = [f"vehicle {vehicle}: {reason}" for vehicle, reason in zip(vehicles, reasons, strict=True) if reason]
    return (*findings.notices, *lines)


def _finding(choices: Sequence[SensorModelChoice], branches: Sequence[str]) -> str:
    """What is found of one vehicle; empty if its sensors are linear."""
    pairs = list(zip(branches, choices, strict=True))
    if undecided := [name for name, choice in pairs if choice.undecided]:
        return _undecided(undecided)
    found = ", ".join(f"{name} ({choice.model})" for name, choice in pairs if choice.model != LINEAR)
    return f"not linear: {found}; its parameter file says whether that is corrected" if found else ""
