"""How well a signal fits a role in a layout: points for words, units, range, and for what a log shows of it."""

from collections.abc import Mapping
from dataclasses import dataclass

from calibrator.doctor.words import PLACES, word_set
from calibrator.proposal.signals import Candidate
from ecu_node.units import AMPERE, VOLT, WATT

__all__ = ["FITS", "POSITIONS", "Role", "branch_points", "position_of", "role_points", "seen_points"]

FITS = 3.0
"""Points from which on a signal is proposed: names, comments or sender say where it flows."""
POSITIONS = ("front", "rear", "left", "right")
"""Of branches that a vehicle has twice."""
NOT_MEASURED = word_set(
    "limit lim max maximum min minimum available avail target tgt request req requested command cmd soll grenze "
    "demand setpoint desired allowed budget capability predicted pred optimal regen reg error deviation "
    "phase peak history avg average corrected quality checksum counter waste dissipation heat qdot dbg debug rejection "
    "load limits"
)
"""Words of limits, demands and statistics, which are no measured flow."""
ELSEWHERE = word_set(
    "lv 12 v12 fan pump blower cell brick sleep seat mirror lock brake brk steering eps epb epbm liftgate "
    "window wiper tpms solenoid valve radar charge charger line evse ac1 fc trailer igbt gate bulkhead "
    "strut ibs"
)
"""Words of other circuits than the high-voltage junction."""
_ELSEWHERE = {
    "dcdc": frozenset({"output", "out", "secondary"}),  # its other side is not at the junction
    "battery": ELSEWHERE - {"charge"},  # it is charged and discharged
}
"""The same for places of which some of these words, or others, are said."""
_LOADS = ("heater", "aircon", "dcdc", "auxiliary")
LEAST_A, GREATEST_A = 30.0, 5000.0
"""Ranges that signals of battery and motor currents have. [A]"""
LEAST_W = 20e3
"""Range that powers of a motor have. [W]"""
SMOOTH = 0.5
"""Roughness above which values jump about as no current does. [1]"""


@dataclass(frozen=True, kw_only=True)
class Role:
    """What an input of the layout is known by.

    Attributes
    ----------
    name : str
        Of the input.
    quantities : frozenset of str
        It may have; empty: any.
    wanted : tuple of frozenset of str
        Of each set at least one word must be in its name or comment.
    helpful : mapping of str to float
        Points for other words, also of its message and sender; negative ones speak against it.
    """

    name: str
    quantities: frozenset[str]
    wanted: tuple[frozenset[str], ...]
    helpful: Mapping[str, float]


def branch_points(candidate: Candidate, place: str) -> float:
    """Points of a signal as the branch at some place of :data:`calibrator.doctor.words.PLACES`."""
    names = PLACES[place]
    own, around = set(candidate.own), set(candidate.words)
    elsewhere = _ELSEWHERE.get(place, ELSEWHERE)
    points = 2.0 * bool(own & names) + 2.5 * bool(around & names)
    points += 1.0 * bool(around & {"hv", "high", "dc"}) + 0.5 * bool(own & {"current", "curr", "power", "pwr", "amp"})
    points -= 4.0 * len(own & NOT_MEASURED) + 4.0 * bool(around & elsewhere) + 1.0 * ("raw" in own)
    points -= 1.0 * bool(candidate.signal.multiplexer_ids) + 0.02 * len(candidate.signal.name)
    points += 0.5 * (candidate.quantity == "current")
    if place not in _LOADS:
        points -= 3.0 * (not candidate.can_be_negative) + 4.0 * (not _is_large(candidate))
    return points + (seen_points(candidate) if place not in _LOADS else min(seen_points(candidate), 0.0))


def role_points(candidate: Candidate, role: Role) -> float:
    """Points of a signal as an input; below 0 if it cannot be."""
    if role.quantities and candidate.quantity not in role.quantities:
        return -1.0
    if not all(set(candidate.own) & words for words in role.wanted):
        return -1.0
    around = set(candidate.words)
    points = FITS + 1.0 + sum(points for word, points in role.helpful.items() if word in around)
    points -= 0.02 * len(candidate.signal.name) + 0.5 * bool(candidate.signal.multiplexer_ids)
    return points + seen_points(candidate)


def seen_points(candidate: Candidate) -> float:
    """Points for what a log shows of a signal; none without a log."""
    seen = candidate.seen
    if seen is None:
        return 0.0
    points = -4.0 * (seen.good_share < 0.5) - 3.0 * (seen.roughness > SMOOTH)
    return points + (1.0 if seen.spread > 0.0 else -2.0)


def position_of(candidate: Candidate) -> str:
    """Front, rear, left or right, as its name, comment or message says; empty if none."""
    for words in (candidate.own, candidate.words):
        found = [position for position in POSITIONS if position in words]
        if found:
            return found[0]
    return ""


def _is_large(candidate: Candidate) -> bool:
    """Whether its range is that of a battery or motor: of a current, power or voltage."""
    unit = candidate.signal.unit or ""
    if candidate.quantity == "current":
        return LEAST_A <= candidate.reach * AMPERE[unit] <= GREATEST_A
    if candidate.quantity == "power":
        return candidate.reach * WATT[unit] >= LEAST_W
    return candidate.reach * VOLT.get(unit, 1.0) > 0.0
