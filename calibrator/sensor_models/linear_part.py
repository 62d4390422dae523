"""From a choice back to the linear estimator, and on to the parameters of the sensor.

The linear part of a sensor is a linear sensor of the same offset (:mod:`.families`), and its moments follow from those
of the summary. So a fleet is calibrated again with the linear parts, and what is found is joined with the excess.
"""

from collections.abc import Sequence

import numpy as np

from calibrator.evidence.summary import DriveSummary
from calibrator.sensor_models.choice import LINEAR, SensorModelChoice
from calibrator.sensor_models.families import FAMILIES, Family, SensorModel
from calibrator.sensor_models.summary import SensorSummary

__all__ = ["chosen_sensor", "linear_summary"]


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


def _family(name: str) -> Family:
    return next(family for family in FAMILIES if family.name == name)
