"""Verdict on each vehicle: which branches the node may correct, and what is said of the vehicle as a whole."""

from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.posterior.estimate import FleetPosterior
from ecu_node.layout import Layout
from ecu_node.parameters import HeldBack, Verdict

__all__ = ["CONFIDENT", "SUSPECTED", "Deployment", "decide"]

CONFIDENT = 0.95
"""Posterior probability from which on the calibrator says what it found. [1]"""
SUSPECTED = 0.5
"""Probability of a hardware fault from which on it is reported. [1]"""
LONGEST_REASON = max(map(len, get_args(HeldBack)))


@dataclass(frozen=True)
class Deployment:
    """Decision on N vehicles with K branches.

    Attributes
    ----------
    corrected : ndarray of bool of shape (N, K)
        Branches that the node is to correct.
    held_back : ndarray of str of shape (N, K)
        Why a branch in which a fault was found is not corrected, one of :data:`ecu_node.parameters.HeldBack`; empty
        where it is, or where none was found.
    verdicts : tuple of str
        Of each vehicle.
    hardware : ndarray of bool of shape (N,)
        Whether a hardware fault is suspected.
    """

    corrected: Mask
    held_back: NDArray[np.str_]
    verdicts: tuple[Verdict, ...]
    hardware: Mask


def decide(posterior: FleetPosterior, layout: Layout, *, harm_limit: float, doubtful: tuple[int, ...]) -> Deployment:
    """Decide what is deployed.

    A branch is corrected if its estimate is not zero, it moved enough for its gain to be told, the probability that
    correction makes it worse is below the limit, it is within the layout's limits, and the fleet reference is not in
    doubt for it.

    Parameters
    ----------
    posterior : FleetPosterior
        Of N vehicles.
    layout : Layout
        Holds the limits of drifts and offsets.
    harm_limit : float
        Largest probability of harm. [1]
    doubtful : tuple of int
        Branches for which the reference is in doubt.

    Returns
    -------
    Deployment
        The decision.
    """
    drift, offset_a = posterior.faults.drift, posterior.faults.offset_a
    faulty = (drift != 0.0) | (offset_a != 0.0)
    in_doubt = np.zeros_like(faulty)
    in_doubt[:, list(doubtful)] = True
    held_back = np.full(faulty.shape, "", f"<U{LONGEST_REASON}")
    within = (np.abs(drift) <= layout.limits.drift) & (np.abs(offset_a) <= layout.offset_limit_a)
    by_rising_weight: dict[HeldBack, Mask] = {
        "beyond the limits": ~within,
        "harm limit": ~(posterior.harm < harm_limit),
        "moved too little": ~posterior.identifiable,
        "reference in doubt": in_doubt,
    }
    for reason, applies in by_rising_weight.items():
        held_back[faulty & applies] = reason
    corrected = faulty & (held_back == "")
    verdicts = tuple(
        _verdict(corrected[j], faulty[j], float(posterior.confidence[j]), certain=not doubtful)
        for j in range(len(posterior))
    )
    hardware = np.asarray(posterior.hardware_fault > SUSPECTED) & (not doubtful)
    return Deployment(corrected, held_back, verdicts, hardware)


def _verdict(corrected: Array, faulty: Array, confidence: float, *, certain: bool) -> Verdict:
    if corrected.any():
        return "corrected"
    if certain and not faulty.any() and confidence >= CONFIDENT:
        return "no sensor fault"
    return "cannot tell"
