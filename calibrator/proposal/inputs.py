"""Which candidates are inputs that drive the currents, what is derived from them, and a motor's computed current."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.doctor.words import PLACES, word_set
from calibrator.drive import Channel
from calibrator.proposal.branches import POSITIONS, ROUGH
from calibrator.proposal.candidates import Candidate

__all__ = ["Derived", "Input", "computed_motor", "derive", "find_inputs", "find_voltage"]

FITS = 3.0
"""Points from which on a candidate is an input."""
LEAST_V, GREATEST_V, LEAST_REACH_V = 30.0, 1500.0, 60.0
"""Of a junction's voltage: its median in a recording, and the range that a database gives it at least. [V]"""
RPM = 0.10472
"""Of 1/min. [rad/s]"""
SAME_MESSAGE = 2.0
"""Points of a voltage beside the battery's current."""
_AGAINST = word_set(
    "limit max maximum min minimum target tgt setpoint set counter checksum quality valid error flags raw gps user map "
    "history window adaptive assist soll grenze gueltig fehler lim upper lower"
)
_ORDERED = "request req command cmd demand desired"
_DEMAND = f"{_ORDERED} requested power pwr watts setpoint target soll leistung leist"
_CAPS = "limit max min budget seat radar"


@dataclass(frozen=True)
class _Role:
    """What an input is known by: quantity, a word of each set in its own name or comment, words for and against it."""

    name: str
    quantity: str
    wanted: tuple[str, ...]
    likely: str
    against: str


_ROLES = (
    _Role(
        "voltage",
        "voltage",
        ("voltage volt volts vlt u v uhv vdc hv spannung spg tension total",),
        "battery batt bat pack hv bms link",
        f"{_ORDERED} 12 12v lv cell brick line charge charger fc dcdc inverter motor heater ptc cmpd compressor ref",
    ),
    _Role(
        "torque",
        "torque",
        ("torque trq tq moment drehmoment mom couple par",),
        "motor actual effective axle inverter drive",
        f"{_ORDERED} brake blower steering eps driver wheel old fan pump",
    ),
    _Role(
        "speed",
        "speed",
        ("speed velocity spd rpm geschwindigkeit drehzahl drehz vitesse velocidad revolution",),
        "vehicle veh axle motor",
        f"{_ORDERED} fan blower pump wiper steering compressor cmpd wheel lead rel object ui",
    ),
    _Role("heater_demand", "power", ("heater ptc heating htr heizer heizung hzg", _DEMAND), _ORDERED, _CAPS),
    _Role("aircon_demand", "power", ("aircon compressor cmpd hvac evap ac klima komp", _DEMAND), _ORDERED, _CAPS),
    _Role("low_voltage_demand", "power", ("lv dcdc", _DEMAND), _ORDERED, _CAPS),
    _Role(
        "sensor_temperature",
        "temperature",
        ("temperature temp temperatur", "junction shunt sensor"),
        "current box",
        "cabin ambient coolant cell",
    ),
)
"""In the order in which a layout lists them."""
_OF_TORQUE = {
    "driving_current": "positive({torque} * speed) / voltage",
    "recuperation_current": "negative({torque} * speed) / voltage",
    "copper_loss": "{torque} * {torque} / voltage",
    "stray_loss": "{torque} * {torque} * speed / voltage",
    "torque_current": "{torque} / voltage",
}
"""Mechanical power, losses of the motor, and a torque sensor at rest."""
_OF_SPEED = {"rotation_loss": "speed / voltage", "churning_loss": "speed * speed / voltage"}
_FOR_FLEETS = ("stray_loss", "torque_current", *_OF_SPEED)
"""What the model of one vehicle cannot bear."""


@dataclass(frozen=True, kw_only=True)
class Input:
    """An input of the layout and its signal."""

    name: str
    role: str
    candidate: Candidate


@dataclass(frozen=True, kw_only=True)
class Derived:
    """An input computed from others, and whether the model of one vehicle can bear it."""

    name: str
    formula: str
    for_vehicle: bool


def find_voltage(found: Sequence[Candidate], battery: Candidate | None = None) -> Candidate | None:
    """The voltage that powers are divided by: of the junction, if possible in the battery's own message."""
    inputs = find_inputs(found, battery=battery, roles=_ROLES[:1])
    return inputs[0].candidate if inputs else None


def find_inputs(
    found: Sequence[Candidate],
    *,
    battery: Candidate | None = None,
    taken: Collection[str] = (),
    roles: Sequence[_Role] = _ROLES,
) -> list[Input]:
    """Choose inputs: at most one per role, and one torque per position of an axle.

    Parameters
    ----------
    found : sequence of Candidate
        All.
    battery : Candidate, optional
        The battery's current: its voltage is probably beside it.
    taken : collection of str
        Names of those that are branches.
    """
    chosen: list[Input] = []
    for role in roles:
        rated = [(_points(item, role, battery), item) for item in found if item.name not in taken]
        fitting = [item for points, item in sorted(rated, key=lambda pair: -pair[0]) if points >= FITS]
        by_position: dict[str, Candidate] = {}
        for item in fitting if role.name == "torque" else fitting[:1]:
            by_position.setdefault(next((p for p in POSITIONS if p in item.words), ""), item)
        for position, item in by_position.items():
            if item is fitting[0] or position:
                name = role.name if item is fitting[0] else f"{role.name}_{position}"
                chosen.append(Input(name=name, role=role.name, candidate=item))
    return chosen


def _points(item: Candidate, role: _Role, battery: Candidate | None) -> float:
    if item.quantity != role.quantity or not all(set(item.own) & word_set(words) for words in role.wanted):
        return -1.0
    near, value = set(item.words), item.good
    points = FITS + 1.0 + len(near & word_set(role.likely)) - 4.0 * len(near & word_set(role.against))
    points -= 3.0 * len(near & _AGAINST - word_set(" ".join(role.wanted)))
    points -= 0.02 * len(item.name) + 0.5 * item.multiplexed + 0.5 * ("rpm" in item.own)
    if item.channel is not None:
        points += 1.0 if len(value) and np.ptp(value) > 0.0 else -2.0
        points -= 4.0 * (len(value) < 0.5 * len(item.channel.value)) + 3.0 * (item.roughness > ROUGH)
    if role.name == "voltage":
        at_home = LEAST_V <= abs(float(np.median(value))) <= GREATEST_V if len(value) else item.channel is None
        if not at_home or max(abs(item.low), abs(item.high)) < LEAST_REACH_V:
            return -1.0
        points += SAME_MESSAGE * (battery is not None and battery.message in {item.message} - {None})
    return points


def computed_motor(found: Sequence[Candidate], voltage: Candidate | None) -> tuple[Candidate, list[Input]] | None:
    """A motor's current by its torque, its speed and the voltage, and the inputs that its formula needs.

    None where one of them is not there. What it loses is not in it: some percent, more at small torques.
    """
    of_motor = [item for item in found if PLACES["motor"] & set(item.words)]
    torque = find_inputs(of_motor, roles=_ROLES[1:2])
    speed = find_inputs([item for item in of_motor if item.unit.lower().endswith(("rpm", "1/min"))], roles=_ROLES[2:3])
    if voltage is None or len(torque) != 1 or not speed:
        return None
    inputs = [
        torque[0],
        replace(speed[0], name="motor_speed"),
        Input(name="voltage", role="voltage", candidate=voltage),
    ]
    channel, *others = (item.candidate.channel for item in inputs)
    if channel is not None:
        rpm, volts = (np.interp(channel.time_s, c.time_s[c.good], c.value[c.good]) for c in others if c is not None)
        value = np.divide(channel.value * rpm * RPM, volts, out=np.full(len(rpm), np.nan), where=volts != 0.0)
        channel = Channel(time_s=channel.time_s, value=value, good=channel.good & np.isfinite(value))
    motor = Candidate(
        name=f"{torque[0].candidate.name} x {speed[0].candidate.name.rpartition('.')[2]}",
        quantity="current",
        unit="A",
        comment="mechanical power over voltage, computed: a poor reference",
        own=("motor", "current"),
        words=("motor", "current"),
        channel=channel,
        formula=f"torque * motor_speed * {RPM} / voltage",
    )
    return motor, inputs


def derive(inputs: Sequence[Input]) -> list[Derived]:
    """Currents that physics expects of the inputs: mechanical power over voltage, losses, demands over voltage."""
    names = {item.name for item in inputs}
    if "voltage" not in names:
        return []
    torques = [item.name for item in inputs if item.role == "torque" and "speed" in names]
    formulas = {
        f"{name}{torque.removeprefix('torque')}": formula.format(torque=torque)
        for torque in torques
        for name, formula in _OF_TORQUE.items()
    }
    demands = [item.name for item in inputs if item.role.endswith("_demand")]
    formulas |= {f"{name.removesuffix('_demand')}_current": f"{name} / voltage" for name in demands}
    formulas |= _OF_SPEED if torques else {}
    return [
        Derived(name=name, formula=formula, for_vehicle=not name.startswith(_FOR_FLEETS))
        for name, formula in formulas.items()
    ]
