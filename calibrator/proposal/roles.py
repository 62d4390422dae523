"""Inputs that drive a vehicle's currents, and how DBC files call them."""

from calibrator.doctor.words import word_set
from calibrator.proposal.rating import Role

__all__ = ["ROLES"]

_AGAINST = dict.fromkeys(
    word_set(
        "limit max min target setpoint set counter checksum quality valid error flags raw gps user map "
        "history window adaptive assist soll grenze gueltig fehler"
    ),
    -3.0,
)
_AGAINST_MEASURED = _AGAINST | dict.fromkeys(word_set("request req command cmd demand desired"), -2.0)
_DEMAND = word_set("demand request req requested command cmd power pwr watts setpoint target soll leistung leist")


ROLES = (
    Role(
        name="voltage",
        quantities=frozenset({"voltage"}),
        wanted=(word_set("voltage volt volts u uhv vdc hv spannung spg"),),
        helpful=_AGAINST_MEASURED
        | {"battery": 2.0, "batt": 2.0, "bms": 1.0, "pack": 2.0, "hv": 1.5, "link": 0.5, "12": -6.0, "lv": -6.0}
        | dict.fromkeys(
            word_set("cell brick line charge charger fc dcdc inverter motor heater ptc cmpd compressor"),
            -2.0,
        ),
    ),
    Role(
        name="torque",
        quantities=frozenset({"torque"}),
        wanted=(word_set("torque trq tq moment drehmoment mom"),),
        helpful=_AGAINST_MEASURED
        | {"motor": 1.0, "actual": 1.5, "axle": 0.5, "inverter": 0.5, "drive": 0.5}
        | dict.fromkeys(word_set("brake blower steering eps driver wheel old fan pump"), -4.0),
    ),
    Role(
        name="speed",
        quantities=frozenset({"speed"}),
        wanted=(word_set("speed velocity spd rpm geschwindigkeit drehzahl drehz"),),
        helpful=_AGAINST_MEASURED
        | {
            "vehicle": 2.0,
            "veh": 2.0,
            "axle": 0.5,
            "motor": 0.5,
            "ui": -0.5,
            "rpm": -1.0,
            "lead": -4.0,
            "rel": -4.0,
            "object": -4.0,
        }
        | dict.fromkeys(word_set("fan blower pump wiper steering compressor cmpd wheel limit lead rel object"), -4.0),
    ),
    Role(
        name="acceleration",
        quantities=frozenset({"acceleration"}),
        wanted=(word_set("acceleration accel acc ax beschleunigung"), word_set("longitudinal long lon ax x laengs")),
        helpful=_AGAINST_MEASURED | dict.fromkeys(["max", "min", "das", "target"], -3.0),
    ),
    Role(
        name="accelerator",
        quantities=frozenset({"share"}),
        wanted=(
            word_set("accelerator accel throttle gas app fahrpedal"),
            word_set("pedal position pos throttle accelerator fahrpedal"),
        ),
        helpful=_AGAINST_MEASURED | {"pedal": 0.5, "brake": -6.0},
    ),
    Role(
        name="heater_demand",
        quantities=frozenset({"power"}),
        wanted=(word_set("heater ptc heating htr heizer heizung hzg"), _DEMAND),
        helpful={"demand": 1.0, "request": 1.0, "limit": -4.0, "max": -4.0, "min": -4.0, "seat": -4.0, "radar": -4.0},
    ),
    Role(
        name="aircon_demand",
        quantities=frozenset({"power"}),
        wanted=(word_set("aircon compressor cmpd hvac evap ac klima kompressor komp"), _DEMAND),
        helpful={"demand": 1.0, "request": 1.0, "limit": -4.0, "max": -4.0, "min": -4.0, "budget": -4.0},
    ),
    Role(
        name="low_voltage_demand",
        quantities=frozenset({"power"}),
        wanted=(word_set("lv dcdc"), _DEMAND),
        helpful={"demand": 1.0, "limit": -4.0, "max": -4.0, "min": -4.0},
    ),
    Role(
        name="sensor_temperature",
        quantities=frozenset({"temperature"}),
        wanted=(word_set("temperature temp temperatur"), word_set("junction shunt sensor")),
        helpful=_AGAINST | {"current": 1.0, "box": 1.0, "cabin": -6.0, "ambient": -6.0, "coolant": -6.0, "cell": -4.0},
    ),
)
"""In the order in which a layout lists them; the voltage first."""
