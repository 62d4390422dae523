"""Choose the candidates that are inputs, derive formulas from them, and compute the current of a motor."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from calibrator.proposal.candidates import Candidate
from calibrator.words import PLACES, POSITIONS, VOCABULARY, word_set

__all__ = ["FOR_FLEETS", "computed_motor", "derive", "find_inputs"]

LEAST_V, GREATEST_V, LEAST_REACH_V = 30.0, 1500.0, 60.0
"""Bounds of the median of a junction's voltage in a recording, and what its range in a database must reach. [V]"""
RPM = 0.10472
"""One revolution per minute. [rad/s]"""
SAME_MESSAGE = 2.0
"""Points for a voltage in the message of the battery's current."""
_AGAINST = word_set(VOCABULARY["not_an_input"])


class Role(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the input of one role is recognised among the candidates.

    Attributes
    ----------
    quantity : str
        Quantity of the candidate, see :class:`.Candidate`.
    wanted, also : str
        Words with blanks between; name or comment must have one of `wanted`, and one of `also` unless `also` is empty.
    likely, against : str
        Words with blanks between, in name, comment, message or sender, that speak for a candidate, and against it.
    """

    quantity: str
    wanted: str
    likely: str
    against: str
    also: str = ""


_ROLES = msgspec.convert(VOCABULARY["roles"], dict[str, Role])
"""Roles by the name of the input, in the order in which a layout lists inputs."""
_OF_TORQUE = {
    "driving_current": "positive({torque} * speed) / voltage",
    "recuperation_current": "negative({torque} * speed) / voltage",
    "copper_loss": "{torque} * {torque} / voltage",
    "stray_loss": "{torque} * {torque} * speed / voltage",
    "torque_current": "{torque} / voltage",
}
"""Formulas made of a torque, by name: mechanical power, losses, and the torque alone, for its error at standstill."""
_OF_SPEED = {"rotation_loss": "speed / voltage", "churning_loss": "speed * speed / voltage"}
FOR_FLEETS = ("stray_loss", "torque_current", *_OF_SPEED)
"""Formulas whose names begin so are inputs of the fleet model alone: one vehicle has too little data for them."""


def find_inputs(
    found: Sequence[Candidate],
    *,
    battery: Candidate | None = None,
    taken: Collection[str] = (),
    roles: Collection[str] = tuple(_ROLES),
) -> dict[str, Candidate]:
    """Return the chosen inputs by name: at most one per role, but a torque per axle: ``torque``, ``torque_rear``.

    Parameters
    ----------
    found : sequence of Candidate
        Candidates to choose from.
    battery : Candidate, optional
        Current of the battery; the voltage is probably in the same message.
    taken : collection of str
        Names of candidates that are branches, and hence no inputs.
    roles : collection of str
        Inputs that are looked for: ``voltage``, ``torque``, ``speed``, ...
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
    """Return how well a candidate fits as the input of a role; negative if it does not."""
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
    """Compute a motor's current from torque, speed and voltage; return it with the inputs of its formula.

    None if one of these is missing, or if there are several torques. The losses of the motor are not included: some
    percent, more at small torques.
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
    """Return by name the formulas of the currents that inputs cause: powers, losses and demands over the voltage."""
    if "voltage" not in inputs:
        return {}
    formulas = dict[str, str]()
    for torque in [name for name in inputs if name.startswith("torque") and "speed" in inputs]:
        end = torque.removeprefix("torque")
        formulas |= {f"{name}{end}": formula.format(torque=torque) for name, formula in _OF_TORQUE.items()}
    of_speed = _OF_SPEED if formulas else {}
    demands = [name.removesuffix("_demand") for name in inputs if name.endswith("_demand")]
    return formulas | {f"{name}_current": f"{name}_demand / voltage" for name in demands} | of_speed
