"""Whether a sensor that is not linear is corrected: what its parameters may be, and how probable harm is.

The excess and the linear part come from the same drives. Another excess goes with another drift and another offset of
the linear part, which are therefore estimated anew for excesses up to three standard deviations away; so their
covariance with the excess is in what follows.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.posterior.decision import NORMAL_STEPS
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.fault_prior import FaultPrior
from calibrator.posterior.model_harm import EXCESS_NODES, NODE_OF_STEP, model_harm
from calibrator.posterior.states import States
from calibrator.sensor_models.modelled import ModelledSensor, ModelledVehicle
from calibrator.sensor_models.sections import Sections
from calibrator.summaries.moments import DriveSummary

__all__ = ["JudgedSensor", "judge_sensor", "with_free_drift"]


@dataclass(frozen=True, kw_only=True)
class JudgedSensor:
    """What is known of one sensor that is not linear.

    Attributes
    ----------
    harm : float
        Probability that correcting makes the branch worse, on the vehicle's own drives or the fleet's usual one; that
        the sensor is linear, or of another family, counts as harm. [1]
    drift_sd : float
        Root mean square of the posterior's distance from the drift, which is the mean over the sections of the
        vehicle's own drives. [1]
    offset_sd_a : float
        The same of the offset. [A]
    largest_drift : float
        Largest magnitude of the drift in any section of these drives. [1]
    """

    harm: float
    drift_sd: float
    offset_sd_a: float
    largest_drift: float


@dataclass(frozen=True, kw_only=True)
class _States:
    """Weights (Q, S), and means and deviations (Q, S, 2) of drift and offset over full scale of one branch. [1]"""

    weight: Array
    mean: Array
    sd: Array


def judge_sensor(
    vehicle: ModelledVehicle,
    sensor: ModelledSensor,
    estimate: Callable[[Sequence[DriveSummary]], FleetPosterior],
    *,
    drift: float,
    offset_a: float,
    full_scale_a: float,
) -> JudgedSensor:
    """Find out how sure the correction of a sensor is.

    Parameters
    ----------
    vehicle : ModelledVehicle
        The vehicle.
    sensor : ModelledSensor
        One of its sensors.
    estimate : callable
        Estimates the vehicle from other linear parts.
    drift, offset_a : float
        Of the linear part, as they were estimated. [1], [A]
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    JudgedSensor
        The sensor with its probability of harm.
    """
    nodes = sensor.choice.excess + sensor.choice.excess_sd * EXCESS_NODES
    posterior = estimate([vehicle.with_excess({sensor.branch: excess}) for excess in nodes.tolist()])
    states = _states(posterior, sensor.branch)
    found = np.array([drift, offset_a / full_scale_a])
    drift_sd, offset_sd = _deviations(sensor, nodes, states, found)
    return JudgedSensor(
        harm=min(_harm(sensor, states, found, full_scale_a) + 1.0 - sensor.choice.probability, 1.0),
        drift_sd=drift_sd,
        offset_sd_a=offset_sd * full_scale_a,
        largest_drift=float(np.abs(_divided_by(sensor, sensor.own, drift) - 1.0).max()),
    )


def _states(posterior: FleetPosterior, branch: int) -> _States:
    states, k, K = posterior.states, posterior.order.index(branch), posterior.states.branches
    return _States(
        weight=with_free_drift(states, posterior.hyperparameters.prior, k),
        mean=np.stack([states.drift[:, :, k], states.offset[:, :, k]], axis=2),
        sd=np.stack([states.relative_sd[:, :, 1 + k], states.constant_sd[:, :, K - 1 + k]], axis=2),
    )


def with_free_drift(states: States, prior: FaultPrior, k: int) -> Array:
    """Weigh states anew for a branch whose drift may be anything.

    The law of the fleet's faults is that of linear sensors, most of which have no drift. A sensor that is not linear is
    faulty: a drift of its linear part is as likely as none, and counts among no faults of the law. Otherwise a drift
    that another fault happens to hide would be taken for none.

    Parameters
    ----------
    states : States
        Of Q vehicles, S each.
    prior : FaultPrior
        The law they were weighed with.
    k : int
        The branch, in the order of the states.

    Returns
    -------
    ndarray of shape (Q, S)
        Weights, with the sum of each vehicle as before. [1]
    """
    log_support, free = prior.log_supports(), (states.drift[:, :, k] != 0.0) & (states.weight > 0.0)
    hardware, sensors = states.hardware_count, states.sensor_count
    gained = np.zeros(free.shape)
    gained[free] = (log_support[hardware, np.maximum(sensors - 1, 0)] - log_support[hardware, sensors])[free]
    told = states.weight.sum(axis=1, keepdims=True)
    weight = states.weight * np.exp(gained - gained.max(axis=1, keepdims=True))
    return np.ascontiguousarray(weight * told / weight.sum(axis=1, keepdims=True))


def _harm(sensor: ModelledSensor, states: _States, found: Array, full_scale_a: float) -> float:
    """Probability of harm on the vehicle's own drives or the fleet's usual one, on whichever it is larger."""
    excess = sensor.choice.excess + sensor.choice.excess_sd * NORMAL_STEPS[:, :1]
    drives = (
        (sensor.own, _own_moments(sensor, found, full_scale_a)),
        (sensor.usual, _moments(sensor.usual.share, sensor.usual.sum_a, sensor.usual.sum_a2, full_scale_a)),
    )
    return max(
        model_harm(
            states.weight,
            states.mean,
            states.sd,
            gain=sensor.family.gain(excess, sections.at),
            estimate=found,
            corrected_gain=_divided_by(sensor, sections, float(found[0])),
            moments=moments,
        )
        for sections, moments in drives
    )


def _divided_by(sensor: ModelledSensor, sections: Sections, drift: float) -> Array:
    """Gain that the correction divides by, shape (2,). [1]"""
    return np.asarray((1.0 + drift) * sensor.family.gain(np.array(sensor.choice.excess), sections.at))


def _own_moments(sensor: ModelledSensor, found: Array, full_scale_a: float) -> Array:
    """Moments of the true currents on the vehicle's own drives, if the estimate is right; shape (2, 3). [1]"""
    own, beyond_a = sensor.own, sensor.zero_a - float(found[1]) * full_scale_a
    gain = _divided_by(sensor, own, float(found[0]))
    sum_a2 = own.sum_a2 + 2.0 * beyond_a * own.sum_a + beyond_a**2 * own.share
    return _moments(own.share, (own.sum_a + beyond_a * own.share) / gain, sum_a2 / gain**2, full_scale_a)


def _moments(share: Array, sum_a: Array, sum_a2: Array, full_scale_a: float) -> Array:
    return np.column_stack([share, sum_a / full_scale_a, sum_a2 / full_scale_a**2])


def _deviations(sensor: ModelledSensor, nodes: Array, states: _States, found: Array) -> tuple[float, float]:
    """Root mean square distance from the drift that is told, and from the offset over full scale. [1]"""
    gain = sensor.family.gain(nodes[:, None], sensor.own.at).mean(axis=1)[:, None]
    told = _divided_by(sensor, sensor.own, float(found[0])).mean()
    drift, drift_sd = gain * (1.0 + states.mean[:, :, 0]) - told, gain * states.sd[:, :, 0]
    offset, offset_sd = states.mean[:, :, 1] - found[1], states.sd[:, :, 1]
    share = np.bincount(NODE_OF_STEP, weights=NORMAL_STEPS[:, 1])[:, None] * states.weight
    return (
        float(np.sqrt(np.sum(share * (drift**2 + drift_sd**2)))),
        float(np.sqrt(np.sum(share * (offset**2 + offset_sd**2)))),
    )
