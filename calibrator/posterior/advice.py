"""What would decide where the calibrator cannot tell, or holds a correction back: one sentence for the user."""

from collections.abc import Sequence

import numpy as np

from calibrator.drive import Mask
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.explain import FaultExplanation
from calibrator.posterior.spread_starts import FEWEST_TRUSTED
from calibrator.posterior.verdict import Deployment
from ecu_node.layout import Layout

__all__ = ["advise", "deciding_evidence"]

LEAST_RIVAL, LEAST_IN_THE_WAY = 0.02, 1e-4
"""Probability from which on another explanation is a rival, and from which on it can hold a correction back. [1]"""
TOLD_APART = 0.002
"""Smallest difference that a zero-current window or a bench check shows: drifts, offsets over full scale. [1]"""


def advise(
    posterior: FleetPosterior,
    decision: Deployment,
    vehicle: int,
    found: Sequence[FaultExplanation],
    *,
    branches: Sequence[str],
    layout: Layout,
) -> str:
    """Say what would decide on a vehicle.

    Parameters
    ----------
    posterior, decision : FleetPosterior, Deployment
        Of its fleet.
    vehicle : int
        Which vehicle.
    found : sequence of FaultExplanation
        Its explanations, branches in the order of the states.
    branches : sequence of str
        Names of the K branches in their own order.
    layout : Layout
        Holds full scale and limits.

    Returns
    -------
    str
        One sentence.
    """
    j, faults, held_back = vehicle, posterior.faults, decision.held_back[vehicle]
    beyond = np.flatnonzero(held_back == "beyond the limits")
    if len(beyond):
        k = int(beyond[0])
        return (
            f"the {branches[k]} sensor is off by {faults.drift[j, k]:+.1%} and {faults.offset_a[j, k]:+.1f} A, beyond "
            f"the limits of {layout.path.name}: replace the sensor"
        )
    doubtful = posterior.health.doubtful if posterior.health is not None else ()
    if doubtful and not (held_back == "harm limit").any():
        return (
            f"bench-checked vehicles would decide: the fleet's reference is in doubt for branch "
            f"{', '.join(branches[k] for k in doubtful)}; name at least {FEWEST_TRUSTED} with --trusted"
        )
    concerned = {posterior.order.index(int(k)) for k in np.flatnonzero(held_back != "")}
    ordered = [branches[k] for k in posterior.order]
    decisive = deciding_evidence(found, ordered, layout.full_scale_a, concerned=concerned)
    return decisive or _least_known(posterior, j, held_back != "", branches, layout.full_scale_a)


def deciding_evidence(
    found: Sequence[FaultExplanation],
    branches: Sequence[str],
    full_scale_a: float,
    *,
    concerned: set[int] | None = None,
) -> str:
    """Say what would tell the most probable explanation from the one that stands most in its way.

    Parameters
    ----------
    found : sequence of FaultExplanation
        By falling probability.
    branches : sequence of str
        Names of the K branches.
    full_scale_a : float
        Full scale of the junction. [A]
    concerned : set of int or None
        Branches whose correction is held back; None or empty: all.

    Returns
    -------
    str
        One sentence; empty if no other explanation is probable enough to matter.
    """
    first, least = found[0], LEAST_IN_THE_WAY if concerned else LEAST_RIVAL
    others = [other for other in found[1:] if other.probability >= least]
    if not others:
        return ""
    looked_at = sorted(concerned) if concerned else list(range(len(branches)))

    def in_the_way(other: FaultExplanation) -> float:
        apart = np.hypot(other.drift - first.drift, other.offset - first.offset)[looked_at]
        return other.probability * float(np.sum(np.where(apart > TOLD_APART, apart, 0.0)))

    other = max(others, key=in_the_way)
    if not in_the_way(other):
        return "" if concerned else "the explanations differ in the vehicle, not in its sensors: inspect the hardware"
    offset, drift = np.abs(first.offset - other.offset), np.abs(first.drift - other.drift)
    k = int(np.argmax(offset))
    if offset[k] > TOLD_APART:
        readings = f"{first.offset[k] * full_scale_a:+.1f} A or {other.offset[k] * full_scale_a:+.1f} A"
        return f"a zero-current window (contactors open) would decide: the {branches[k]} sensor then shows {readings}"
    k = int(np.argmax(drift))
    readings = f"{first.drift[k]:+.1%} or {other.drift[k]:+.1%}"
    return f"a check of the {branches[k]} sensor against a reference would decide: its gain is off by {readings}"


def _least_known(
    posterior: FleetPosterior, j: int, concerned: Mask, branches: Sequence[str], full_scale_a: float
) -> str:
    """Which sensor is known least, in parts of the faults found, where only one explanation is left.

    It is one of those concerned, or of all if none is.
    """
    faults = posterior.faults
    sd = (posterior.drift_sd[j], posterior.offset_sd_a[j] / full_scale_a)
    size = (np.linalg.norm(faults.drift[j]), np.linalg.norm(faults.offset_a[j]) / full_scale_a)
    doubt = np.max([each / norm if norm else each for each, norm in zip(sd, size, strict=True)], axis=0)
    k = int(np.argmax(np.where(concerned | ~concerned.any(), doubt, -np.inf)))
    return (
        f"more drives would decide: the {branches[k]} sensor's drift is known to +-{posterior.drift_sd[j, k]:.2%} and "
        f"its offset to +-{posterior.offset_sd_a[j, k]:.2f} A only; record drives in which that current varies"
    )
