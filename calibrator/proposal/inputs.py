"""Which signals of a DBC are probably the inputs that drive the currents, and what is derived from them."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.proposal.rating import FITS, Role, position_of, role_points
from calibrator.proposal.roles import ROLES
from calibrator.proposal.signals import Candidate
from ecu_node.units import VOLT

__all__ = ["ProposedDerived", "ProposedInput", "propose_derived", "propose_inputs"]

LEAST_V, GREATEST_V = 30.0, 1500.0
"""Seen in the middle: of a high-voltage system. [V]"""
LEAST_REACH_V = 100.0
"""Range that its signals have at least. [V]"""
SAME_MESSAGE = 2.0
"""Points of a voltage beside the battery's current."""
POSITIONED = ("torque",)
"""Roles that a vehicle may have at several axles."""


@dataclass(frozen=True, kw_only=True)
class ProposedInput:
    """An input by name and role, with its signal."""

    name: str
    role: str
    signal: Candidate


@dataclass(frozen=True, kw_only=True)
class ProposedDerived:
    """An input made of others, and whether one vehicle's model can bear it."""

    name: str
    formula: str
    remark: str
    for_vehicle: bool


def propose_inputs(
    found: Sequence[Candidate], *, battery: Candidate | None, taken: Collection[str]
) -> list[ProposedInput]:
    """Choose inputs among signals.

    Parameters
    ----------
    found : sequence of Candidate
        Of the DBC; with a log those that are in it.
    battery : Candidate or None
        The battery's current: its voltage is probably beside it.
    taken : collection of str
        Signals (``Message.Signal``) that are branches.

    Returns
    -------
    list of ProposedInput
        At most one per role, and one per position of an axle.
    """
    proposed: list[ProposedInput] = []
    free = [item for item in found if item.name not in taken]
    for role in ROLES:
        rated = [(_points(item, role, battery), item) for item in free]
        fitting = sorted((pair for pair in rated if pair[0] >= FITS), key=lambda pair: -pair[0])
        proposed += _chosen(role, [item for _, item in fitting])
    return proposed


def propose_derived(inputs: Sequence[ProposedInput]) -> list[ProposedDerived]:
    """Currents that physics expects of the inputs: mechanical power over voltage, losses, demands over voltage."""
    names = {item.name for item in inputs}
    if "voltage" not in names:
        return []
    derived: list[ProposedDerived] = []
    for item in inputs:
        if item.role == "torque" and "speed" in names:
            derived += _of_torque(item.name, item.name.removeprefix("torque"))
    for item in inputs:
        if item.role.endswith("_demand"):
            name = item.name.removesuffix("_demand")
            derived.append(_derived(f"{name}_current", f"{item.name} / voltage", "", for_vehicle=True))
    if any(item.role == "torque" for item in inputs) and "speed" in names:
        derived.append(_derived("rotation_loss", "speed / voltage", "friction and iron", for_vehicle=False))
        derived.append(_derived("churning_loss", "speed * speed / voltage", "iron and oil", for_vehicle=False))
    return derived


def _of_torque(torque: str, suffix: str) -> list[ProposedDerived]:
    power = f"{torque} * speed"
    return [
        _derived(
            f"driving_current{suffix}",
            f"positive({power}) / voltage",
            "mechanical",
            for_vehicle=True,
        ),
        _derived(
            f"recuperation_current{suffix}", f"negative({power}) / voltage", "apart from driving", for_vehicle=True
        ),
        _derived(f"copper_loss{suffix}", f"{torque} * {torque} / voltage", "", for_vehicle=True),
        _derived(f"stray_loss{suffix}", f"{torque} * {torque} * speed / voltage", "", for_vehicle=False),
        _derived(f"torque_current{suffix}", f"{torque} / voltage", "torque sensor at rest", for_vehicle=False),
    ]


def _derived(name: str, formula: str, remark: str, *, for_vehicle: bool) -> ProposedDerived:
    return ProposedDerived(name=name, formula=formula, remark=remark, for_vehicle=for_vehicle)


def _points(candidate: Candidate, role: Role, battery: Candidate | None) -> float:
    points = role_points(candidate, role)
    if role.name != "voltage" or points < 0.0:
        return points
    factor = VOLT[candidate.signal.unit or ""]
    if candidate.reach * factor < LEAST_REACH_V:
        return -1.0
    if candidate.seen is not None:
        good = candidate.seen.channel.value[candidate.seen.channel.good]
        if not len(good) or not LEAST_V <= factor * abs(float(np.median(good))) <= GREATEST_V:
            return -1.0
    return points + SAME_MESSAGE * (battery is not None and battery.message.name == candidate.message.name)


def _chosen(role: Role, fitting: Sequence[Candidate]) -> list[ProposedInput]:
    if not fitting:
        return []
    best = fitting[0]
    chosen = [ProposedInput(name=role.name, role=role.name, signal=best)]
    if role.name in POSITIONED:
        other: dict[str, Candidate] = {}
        for item in fitting:
            position = position_of(item)
            if position and position != position_of(best):
                other.setdefault(position, item)
        chosen += [
            ProposedInput(name=f"{role.name}_{position}", role=role.name, signal=item)
            for position, item in other.items()
        ]
    return chosen
