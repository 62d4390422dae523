"""Competing explanations of a vehicle's recordings."""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.posterior.states import States

__all__ = ["FaultExplanation", "explanations"]


@dataclass(frozen=True)
class FaultExplanation:
    """States of one support with the same signs together.

    Attributes
    ----------
    probability : float
        Posterior probability. [1]
    hardware_drift : float
        d_h. [1]
    hardware_offset, drift, offset : ndarray of shape (K,)
        o_h and o in fractions of full scale, d. [1]
    """

    probability: float
    hardware_drift: float
    hardware_offset: Array
    drift: Array
    offset: Array


def explanations(states: States, vehicle: int) -> list[FaultExplanation]:
    """Supports of one vehicle, signs told apart, each with its mean parameters.

    Parameters
    ----------
    states : States
        Of the fleet.
    vehicle : int
        Which vehicle.

    Returns
    -------
    list of FaultExplanation
        By falling probability; at least one.
    """
    K = states.branches
    parameters = np.concatenate([states.relative[vehicle], states.constant[vehicle]], axis=1)
    weight = states.weight[vehicle]
    supports, group = np.unique(np.sign(parameters), axis=0, return_inverse=True)
    probability = np.bincount(group.ravel(), weight, len(supports))
    found: list[FaultExplanation] = []
    for g in np.argsort(-probability, kind="stable"):
        if found and not probability[g]:
            break
        share = np.where(group.ravel() == g, weight, 0.0)
        mean = share @ parameters / share.sum()
        free = mean[K + 1 : 2 * K]
        found.append(
            FaultExplanation(
                float(probability[g]), float(mean[0]), np.append(free, -free.sum()), mean[1 : K + 1], mean[2 * K :]
            )
        )
    return found
