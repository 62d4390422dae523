"""From a choice back to the linear estimator, and on to the parameters of the sensor.

The linear part of a sensor is a linear sensor of the same offset (:mod:`.families`), and its moments follow from those
of the summary. So a fleet is calibrated again with the linear parts, and what is found is joined with the excess.
"""

from collections.abc import Sequence

import numpy as np

from calibrator.drive import Array
from calibrator.sensor_models.choice import LINEAR, SensorModelChoice
from calibrator.sensor_models.families import FAMILIES, Family, GainBySign, SensorModel, TemperatureDrift
from calibrator.sensor_models.summary import SensorSummary
from calibrator.summaries.moments import DriveSummary
from ecu_node.sensor_models import GainBySign as GainBySignParameters
from ecu_node.sensor_models import SensorModel as SensorModelParameters
from ecu_node.sensor_models import TemperatureDrift as TemperatureDriftParameters

__all__ = ["chosen_sensor", "excess_column", "family_of", "linear_columns", "linear_summary", "sensor_parameters"]


def linear_summary(vehicle: SensorSummary, choices: Sequence[SensorModelChoice]) -> DriveSummary:
    """Summary of the linear parts of one vehicle's sensors.

    Parameters
    ----------
    vehicle : SensorSummary
        Of the vehicle.
    choices : sequence of K SensorModelChoice
        For its branches.

    Returns
    -------
    DriveSummary
        For the linear estimator; where all sensors are linear, the same moments as before.
    """
    summary, columns = vehicle.summary, linear_columns(vehicle, choices)
    return DriveSummary(
        moments=columns.T @ vehicle.products @ columns,
        noise_a2=summary.noise_a2,
        branches=summary.branches,
        period_s=summary.period_s,
        bank=summary.bank,
    )


def linear_columns(vehicle: SensorSummary, choices: Sequence[SensorModelChoice]) -> Array:
    """Inputs, linear parts and 1 as combinations of the columns of :attr:`SensorSummary.products`, (Q, M + K + 1)."""
    M, K = vehicle.summary.inputs, vehicle.summary.branches
    columns = np.eye(vehicle.products.shape[1])[:, : M + K + 1]
    for k, choice in enumerate(choices):
        if choice.model != LINEAR:
            columns[:, M + k] -= choice.excess * excess_column(vehicle, k, choice)
    return columns


def excess_column(vehicle: SensorSummary, k: int, choice: SensorModelChoice) -> Array:
    """What an excess of 1 adds to a branch, h - reference * (i_m - Z), as a combination of the same columns, (Q,)."""
    M, K = vehicle.summary.inputs, vehicle.summary.branches
    column = np.zeros(vehicle.products.shape[1])
    column[vehicle.current_columns(family_of(choice.model))[k]] = 1.0
    column[M + k] -= choice.reference
    column[M + K] += choice.reference * vehicle.zero_a[k]
    return column


def chosen_sensor(choice: SensorModelChoice, drift: float) -> SensorModel | None:
    """Build the sensor of a choice.

    Parameters
    ----------
    choice : SensorModelChoice
        For one branch.
    drift : float
        Drift of its linear part. [1]

    Returns
    -------
    SensorModel or None
        None if the sensor is linear.
    """
    if choice.model == LINEAR:
        return None
    return family_of(choice.model).fitted(choice.excess, choice.reference, drift)


def sensor_parameters(choice: SensorModelChoice, drift: float) -> tuple[float, SensorModelParameters | None] | None:
    """Say a choice as the parameter file does.

    Parameters
    ----------
    choice : SensorModelChoice
        For one branch.
    drift : float
        Drift of its linear part. [1]

    Returns
    -------
    drift : float
        The branch's drift [1]: of a gain by sign the mean of both, of a temperature drift that at its reference.
    sensor_model : GainBySign, TemperatureDrift or None
        As :mod:`ecu_node.sensor_models` has them; None if the sensor is linear.

    Nothing of it, None, if a parameter file cannot say it: gain errors of 100 % and more.
    """
    sensor = chosen_sensor(choice, drift)
    if isinstance(sensor, GainBySign):
        both = (sensor.drift_positive, sensor.drift_negative)
        sd = choice.excess_sd * (1.0 + sensor.drift_positive)
        model = GainBySignParameters(drift_positive=both[0], drift_negative=both[1], difference_sd=sd)
        return (0.5 * sum(both), model) if max(map(abs, both)) < 1.0 else None
    if isinstance(sensor, TemperatureDrift):
        told = TemperatureDriftParameters(
            drift_per_k=sensor.drift_per_k,
            reference_c=sensor.reference_c,
            drift_per_k_sd=choice.excess_sd * (1.0 + drift),
        )
        return (drift, told) if max(abs(drift), abs(sensor.drift_per_k)) < 1.0 else None
    return drift, None


def family_of(name: str) -> Family:
    """Return the family of this name, one of :data:`FAMILIES`."""
    return next(family for family in FAMILIES if family.name == name)
