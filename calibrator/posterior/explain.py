"""Competing explanations of a vehicle's recordings, and what further evidence would decide between them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.posterior.states import States

__all__ = ["FaultExplanation", "deciding_evidence", "explanations"]

MOST = 3
"""Explanations that are told."""
LEAST_PROBABILITY = 0.02
"""Of an explanation that is told. [1]"""
TOLD_APART = 0.002
"""Smallest difference that a zero-current window or a bench check shows: drifts, offsets over full scale. [1]"""


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
    """Most probable supports of one vehicle, signs told apart, each with its mean parameters.

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
    for g in np.argsort(-probability, kind="stable")[:MOST]:
        if found and probability[g] < LEAST_PROBABILITY:
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


def deciding_evidence(found: Sequence[FaultExplanation], branches: Sequence[str], full_scale_a: float) -> str:
    """Say what would tell the two most probable explanations apart.

    Parameters
    ----------
    found : sequence of FaultExplanation
        From :func:`explanations`.
    branches : sequence of str
        Names of the K branches.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    str
        One sentence; empty if there is one explanation.
    """
    if len(found) < 2:
        return ""
    first, second = found[0], found[1]
    offset, drift = np.abs(first.offset - second.offset), np.abs(first.drift - second.drift)
    k = int(np.argmax(offset))
    if offset[k] > TOLD_APART:
        readings = f"{first.offset[k] * full_scale_a:+.1f} A or {second.offset[k] * full_scale_a:+.1f} A"
        return f"a zero-current window (contactors open) would decide: the {branches[k]} sensor then shows {readings}"
    k = int(np.argmax(drift))
    if drift[k] > TOLD_APART:
        readings = f"{first.drift[k]:+.1%} or {second.drift[k]:+.1%}"
        return f"a check of the {branches[k]} sensor against a reference would decide: its gain is off by {readings}"
    return "the explanations differ in the vehicle, not in its sensors: inspect the hardware"
