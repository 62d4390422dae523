"""What becomes of sensors that are not linear: they are corrected with their models where that is sure enough.

The same limits hold as for linear sensors. A model that depends on the temperature needs one that the node can read.
Where a vehicle has a sensor that is not linear and it is not clear which, none of its branches is corrected.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Mask
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.model_decision import JudgedSensor
from calibrator.posterior.verdict import Deployment
from calibrator.sensor_models.choice import SensorModelChoice
from calibrator.sensor_models.fleet import SensorFindings
from calibrator.sensor_models.linear_part import sensor_parameters
from ecu_node.layout import Layout
from ecu_node.parameters import HeldBack, Verdict
from ecu_node.sensor_models import TemperatureDrift

__all__ = ["ModelJudge", "with_sensor_models"]


@dataclass(frozen=True, kw_only=True)
class ModelJudge:
    """By what it is decided whether a sensor that is not linear is corrected.

    Attributes
    ----------
    layout : Layout
        Holds the limits, and names the temperature or does not.
    harm_limit : float
        Largest probability of harm. [1]
    """

    layout: Layout
    harm_limit: float

    def reason(
        self,
        choice: SensorModelChoice,
        judged: JudgedSensor,
        *,
        drift: float,
        offset_a: float,
        identifiable: bool,
        doubtful: bool,
    ) -> HeldBack | None:
        """Why a sensor is not corrected, or None.

        Parameters
        ----------
        choice : SensorModelChoice
            Its model.
        judged : JudgedSensor
            How sure its correction is.
        drift, offset_a : float
            Of its linear part. [1], [A]
        identifiable : bool
            Whether the branch moved enough for its gain to be told.
        doubtful : bool
            Whether the fleet reference is in doubt for it.

        Returns
        -------
        HeldBack or None
            The reason that weighs most.
        """
        told = sensor_parameters(choice, drift)
        needs_temperature = told is not None and isinstance(told[1], TemperatureDrift)
        within = judged.largest_drift <= self.layout.limits.drift and abs(offset_a) <= self.layout.offset_limit_a
        by_falling_weight: dict[HeldBack, bool] = {
            "not linear": told is None,
            "no temperature": needs_temperature and self.layout.temperature is None,
            "reference in doubt": doubtful,
            "moved too little": not identifiable,
            "harm limit": not judged.harm < self.harm_limit,
            "beyond the limits": not within,
        }
        return next((reason for reason, applies in by_falling_weight.items() if applies), None)


def with_sensor_models(
    deployment: Deployment,
    posterior: FleetPosterior,
    findings: SensorFindings,
    judged: Sequence[Mapping[int, JudgedSensor]],
    judge: ModelJudge,
) -> Deployment:
    """Decide on the sensors that are not linear, and take back what is not sure because of them.

    Parameters
    ----------
    deployment : Deployment
        Decision for the linear parts of N vehicles with K branches.
    posterior : FleetPosterior
        Of the linear parts.
    findings : SensorFindings
        Of the same vehicles.
    judged : sequence of N mappings of int to JudgedSensor
        Of each vehicle its sensors that are not linear, by branch.
    judge : ModelJudge
        Limits.

    Returns
    -------
    Deployment
        No branch of a vehicle with an undecided sensor is corrected. A vehicle that has a sensor that is not linear, or
        may have, has the verdict "corrected" if any of its branches is corrected, else "cannot tell".
    """
    corrected, held_back = deployment.corrected.copy(), deployment.held_back.copy()
    doubtful = () if posterior.health is None else posterior.health.doubtful
    for j, sensors in enumerate(judged):
        for k, sensor in sensors.items():
            reason = judge.reason(
                findings.choices[j][k],
                sensor,
                drift=float(posterior.faults.drift[j, k]),
                offset_a=float(posterior.faults.offset_a[j, k]),
                identifiable=bool(posterior.identifiable[j, k]),
                doubtful=k in doubtful,
            )
            held_back[j, k], corrected[j, k] = reason or "", reason is None
    undecided: Mask = np.any(findings.undecided, axis=1)
    taken_back = undecided[:, None] & (corrected | findings.not_linear)
    held_back[taken_back] = "not linear"
    corrected &= ~undecided[:, None]
    concerned: Mask = undecided | np.any(findings.not_linear, axis=1)
    verdicts = tuple(
        _verdict(any_corrected=bool(corrected[j].any())) if concerned[j] else verdict
        for j, verdict in enumerate(deployment.verdicts)
    )
    return replace(deployment, corrected=corrected, held_back=held_back, verdicts=verdicts)


def _verdict(*, any_corrected: bool) -> Verdict:
    return "corrected" if any_corrected else "cannot tell"
