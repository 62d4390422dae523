"""Which candidates are inputs that drive the currents, what is derived from them, and a motor's computed current."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from calibrator.proposal.candidates import Candidate
from calibrator.words import PLACES, POSITIONS, VOCABULARY, word_set

__all__ = ["FOR_FLEETS", "computed_motor", "derive", "find_inputs"]

LEAST_V, GREATEST_V, LEAST_REACH_V = 30.0, 1500.0, 60.0
"""Of a junction's voltage: its median in a recording, and the range that a database gives it at least. [V]"""
RPM = 0.10472
"""Of 1/min. [rad/s]"""
SAME_MESSAGE = 2.0
"""Points of a voltage beside the battery's current."""
_AGAINST = word_set(VOCABULARY["not_an_input"])


class Role(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an input is known by.

    Attributes
    ----------
    quantity : str
        By its unit, or else by its name.
    wanted, also : str
        Words of which its own name or comment has one each; without `also` one of the first is enough.
    likely, against : str
        Words of its message and sender for it, and against it.
    """

    quantity: str
    wanted: str
    likely: str
    against: str
    also: str = ""


_ROLES = msgspec.convert(VOCABULARY["roles"], dict[str, Role])
"""In the order in which a layout lists inputs."""
_OF_TORQUE = {
    "driving_current": "positive({torque} * speed) / voltage",
    "recuperation_current": "negative({torque} * speed) / voltage",
    "copper_loss": "{torque} * {torque} / voltage",
    "stray_loss": "{torque} * {torque} * speed / voltage",
    "torque_current": "{torque} / voltage",
}
"""Mechanical power, losses of the motor, and a torque sensor at rest."""
_OF_SPEED = {"rotation_loss": "speed / voltage", "churning_loss": "speed * speed / voltage"}
FOR_FLEETS = ("stray_loss", "torque_current", *_OF_SPEED)
"""What the model of one vehicle cannot bear."""


def find_inputs(
    found: Sequence[Candidate],
    *,
    battery: Candidate | None = None,
    taken: Collection[str] = (),
    roles: Collection[str] = tuple(_ROLES),
) -> dict[str, Candidate]:
    """Choose inputs by name: at most one per role, and one torque per position of an axle (``torque_front``).

    Parameters
    ----------
    found : sequence of Candidate
        All.
    battery : Candidate, optional
        The battery's current: its voltage is probably beside it.
    taken : collection of str
        Names of those that are branches.
    roles : collection of str
        Which inputs are looked for: ``voltage``, ``torque``, ``speed``, ...
    """
    chosen: dict[str, Candidate] = {}
    for role in roles:
        points = {item.name: _points(item, role, battery) for item in found if item.name not in taken}
        fitting = sorted(
            (item for item in found if points.get(item.name, -1.0) >= 0.0), key=lambda item: -points[item.name]
        )
        for item in fitting if role == "torque" else fitting[:1]:
            position = next((f"_{p}" for p in POSITIONS if p in item.words), "")
            if item is fitting[0]:
                chosen[role], first = item, position
            elif position and position != first:
                chosen.setdefault(f"{role}{position}", item)
    return chosen


def _points(item: Candidate, role: str, battery: Candidate | None) -> float:
    known, own, near, value = _ROLES[role], set(item.own), set(item.words), item.good
    wanted, also = word_set(known.wanted), word_set(known.also or known.wanted)
    if item.quantity != known.quantity or not own & wanted or not own & also:
        return -1.0
    points = 1.0 + len(near & word_set(known.likely)) - 4.0 * len(near & word_set(known.against))
    points -= 3.0 * len(near & _AGAINST - wanted - also)
    points -= 0.02 * len(item.name) + 0.5 * ("rpm" in item.own)
    if item.channel is not None:
        points += 1.0 if len(value) and np.ptp(value) > 0.0 else -2.0
        points -= 4.0 * (len(value) < 0.5 * len(item.channel.value))
    if role == "voltage":
        at_home = LEAST_V <= abs(float(np.median(value))) <= GREATEST_V if len(value) else item.channel is None
        points += SAME_MESSAGE * (battery is not None and battery.message in {item.message} - {None})
        return points if at_home and item.reach >= LEAST_REACH_V else -1.0
    return points


def computed_motor(
    found: Sequence[Candidate], voltage: Candidate | None
) -> tuple[Candidate, dict[str, Candidate]] | None:
    """A motor's current by its torque, its speed and the voltage, and the inputs that its formula needs.

    None where one of them is not there. What it loses is not in it: some percent, more at small torques.
    """
    of_motor = [item for item in found if PLACES["motor"] & set(item.words)]
    turning = [item for item in of_motor if item.unit.lower().endswith(("rpm", "1/min"))]
    torques, speed = find_inputs(of_motor, roles=["torque"]), find_inputs(turning, roles=["speed"]).get("speed")
    if voltage is None or len(torques) != 1 or speed is None:
        return None
    torque, channel = torques["torque"], torques["torque"].channel
    if channel is not None:
        rpm, volts = speed.at(channel.time_s), voltage.at(channel.time_s)
        value = np.divide(channel.value * rpm * RPM, volts, out=np.full(len(rpm), np.nan), where=volts != 0.0)
        channel = replace(channel, value=value, good=channel.good & np.isfinite(value))
    motor = Candidate(
        name=f"{torque.name} x {speed.name.rpartition('.')[2]}",
        quantity="current",
        unit="A",
        comment="mechanical power over voltage, computed: a poor reference",
        own=("motor", "current"),
        words=("motor", "current"),
        channel=channel,
        formula=f"torque * motor_speed * {RPM} / voltage",
    )
    return motor, {"torque": torque, "motor_speed": speed, "voltage": voltage}


def derive(inputs: Mapping[str, Candidate]) -> dict[str, str]:
    """Formulas of currents that physics expects of the inputs: power over voltage, losses, demands over voltage."""
    if "voltage" not in inputs:
        return {}
    formulas = dict[str, str]()
    for torque in [name for name in inputs if name.startswith("torque") and "speed" in inputs]:
        end = torque.removeprefix("torque")
        formulas |= {f"{name}{end}": formula.format(torque=torque) for name, formula in _OF_TORQUE.items()}
    of_speed = _OF_SPEED if formulas else {}
    demands = [name.removesuffix("_demand") for name in inputs if name.endswith("_demand")]
    return formulas | {f"{name}_current": f"{name}_demand / voltage" for name in demands} | of_speed
