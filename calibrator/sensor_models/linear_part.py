"""From a choice back to the linear estimator, and on to the parameters of the sensor.

The linear part of a sensor is a linear sensor of the same offset (:mod:`.families`), and its moments follow from those
of the summary. So a fleet is calibrated again with the linear parts, and what is found is joined with the excess.
"""

from collections.abc import Sequence

import numpy as np

from calibrator.evidence.summary import DriveSummary
from calibrator.sensor_models.choice import LINEAR, SensorModelChoice
from calibrator.sensor_models.families import FAMILIES, Family, GainBySign, SensorModel, TemperatureDrift
from calibrator.sensor_models.summary import SensorSummary
from ecu_node.sensor_models import GainBySign as GainBySignParameters
from ecu_node.sensor_models import SensorModel as SensorModelParameters
from ecu_node.sensor_models import TemperatureDrift as TemperatureDriftParameters

__all__ = ["chosen_sensor", "linear_summary", "sensor_parameters"]


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
    summary = vehicle.summary
    M, K = summary.inputs, summary.branches
    columns = np.eye(vehicle.products.shape[1])[:, : M + K + 1]
    for k, choice in enumerate(choices):
        if choice.model != LINEAR:
            beyond_zero = columns[:, M + k] - vehicle.zero_a[k] * columns[:, M + K]
            column = np.zeros(len(columns))
            column[vehicle.current_columns(_family(choice.model))[k]] = 1.0
            columns[:, M + k] -= choice.excess * (column - choice.reference * beyond_zero)
    return DriveSummary(
        moments=columns.T @ vehicle.products @ columns,
        noise_a2=summary.noise_a2,
        branches=K,
        period_s=summary.period_s,
        bank=summary.bank,
    )


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
    return _family(choice.model).fitted(choice.excess, choice.reference, drift)


def sensor_parameters(choice: SensorModelChoice, drift: float) -> tuple[float, SensorModelParameters | None]:
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
    """
    sensor = chosen_sensor(choice, drift)
    if isinstance(sensor, GainBySign):
        return 0.5 * (sensor.drift_positive + sensor.drift_negative), GainBySignParameters(
            drift_positive=sensor.drift_positive,
            drift_negative=sensor.drift_negative,
            difference_sd=choice.excess_sd * (1.0 + sensor.drift_positive),
        )
    if isinstance(sensor, TemperatureDrift):
        return drift, TemperatureDriftParameters(
            drift_per_k=sensor.drift_per_k,
            reference_c=sensor.reference_c,
            drift_per_k_sd=choice.excess_sd * (1.0 + drift),
        )
    return drift, None


def _family(name: str) -> Family:
    return next(family for family in FAMILIES if family.name == name)
