"""Which signals of a DBC are probably the branches of the junction."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.doctor.bands import branch_bands
from calibrator.drive import Channel, Drive
from calibrator.proposal.rating import FITS, branch_points, position_of
from calibrator.proposal.signals import Candidate
from ecu_node.units import AMPERE, WATT

__all__ = ["PLACES_OF_BRANCHES", "ProposedBranch", "propose_branches"]

PLACES_OF_BRANCHES = ("battery", "motor", "auxiliary", "heater", "aircon", "dcdc")
"""In the order in which a layout lists them."""
MOST_ALTERNATIVES = 2
"""Per branch: a layout is to be read."""
FOLLOWS = 3.0
"""Points of a motor whose current is that of the battery turned round. [1]"""
CLEARLY = 0.8
"""Correlation above which a reason tells of it. [1]"""
NEARLY = 3.0
"""Fewer points than the best one by which another signal is worth naming."""


@dataclass(frozen=True, kw_only=True)
class ProposedBranch:
    """One branch as it is guessed.

    Attributes
    ----------
    name : str
        In the layout.
    place : str
        Of :data:`PLACES_OF_BRANCHES`.
    signal : Candidate
        Its current or power.
    reason : str
        Why it was taken.
    alternatives : tuple of Candidate
        Others that it could be, the best first.
    """

    name: str
    place: str
    signal: Candidate
    reason: str
    alternatives: tuple[Candidate, ...]


def propose_branches(found: Sequence[Candidate]) -> list[ProposedBranch]:
    """Choose branches among signals.

    Parameters
    ----------
    found : sequence of Candidate
        Of the DBC; with a log those that are in it.

    Returns
    -------
    list of ProposedBranch
        Empty if nothing looks like a branch.
    """
    flows = [item for item in found if item.quantity in {"current", "power"}]
    rated: dict[str, list[tuple[float, Candidate]]] = {place: [] for place in PLACES_OF_BRANCHES}
    for item in flows:
        points = {place: branch_points(item, place) for place in PLACES_OF_BRANCHES}
        place = max(points, key=lambda name: points[name])
        if points[place] >= FITS - NEARLY:
            rated[place].append((points[place], item))
    batteries = _best_first(rated["battery"], 0.0)
    if batteries:
        following = [(p + FOLLOWS * _follows(item, batteries[0][1]), item) for p, item in rated["motor"]]
        rated["motor"] = following
    return [branch for place in PLACES_OF_BRANCHES for branch in _of_place(place, rated[place], batteries)]


def _of_place(
    place: str, rated: Sequence[tuple[float, Candidate]], batteries: Sequence[tuple[float, Candidate]]
) -> list[ProposedBranch]:
    """The best signal for each position that is named at a place."""
    groups: dict[str, list[tuple[float, Candidate]]] = {}
    for points, item in _best_first(rated, -np.inf):
        groups.setdefault("" if place == "battery" else position_of(item), []).append((points, item))
    positions = [position for position, group in groups.items() if group[0][0] >= FITS]
    if len([position for position in positions if position]) > 1 and "" in positions:
        positions.remove("")  # one for both
    proposed = []
    for position in positions:
        (_, best), *others = groups[position]
        near = [item for points, item in others if points >= groups[position][0][0] - NEARLY]
        reference = batteries[0][1] if batteries and place == "motor" else None
        proposed.append(
            ProposedBranch(
                name=f"{place}_{position}" if position else place,
                place=place,
                signal=best,
                reason=_reason(best, reference),
                alternatives=tuple(near[:MOST_ALTERNATIVES]),
            )
        )
    return proposed


def _best_first(rated: Sequence[tuple[float, Candidate]], least: float) -> list[tuple[float, Candidate]]:
    return sorted((pair for pair in rated if pair[0] >= least), key=lambda pair: -pair[0])


def _reason(candidate: Candidate, battery: Candidate | None) -> str:
    reasons = [candidate.about]
    if candidate.seen is not None:
        scale = 1e-3 if candidate.quantity == "power" else 1.0
        unit = {"current": "A", "power": "kW"}[candidate.quantity]
        factor = scale * {**AMPERE, **WATT}[candidate.signal.unit or ""]
        reasons.append(f"{factor * candidate.seen.low:.4g} to {factor * candidate.seen.high:.4g} {unit} in the log")
    if battery is not None and _follows(candidate, battery) > CLEARLY:
        reasons.append("follows the battery's current")
    return ", ".join(reasons)


def _follows(candidate: Candidate, battery: Candidate) -> float:
    """Magnitude of the correlation with the battery's current; 0 without a log."""
    if candidate.seen is None or battery.seen is None or candidate is battery:
        return 0.0
    channels: dict[str, Channel] = {"battery": battery.seen.channel, "other": candidate.seen.channel}
    drive = Drive(vehicle="", name="", branches=channels, inputs={})
    band = branch_bands([drive], ("battery", "other")).current_a
    if not len(band) or not np.all(band.std(axis=0) > 0.0):
        return 0.0
    return abs(float(np.corrcoef(band[:, 0], band[:, 1])[0, 1]))
