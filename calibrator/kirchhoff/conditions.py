"""What recordings can tell at all: how long they are, whether a current moves; the same for doctor and kirchhoff."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Drive
from calibrator.kirchhoff.sums import Comparison, sensor_of
from calibrator.terminal.text import figure
from ecu_node.database import VehicleDatabase

__all__ = ["STILL_A", "Conditions", "conditions_of"]

AVERAGED_S, FEWEST_AVERAGES = 2.0, 3
"""Noise is averaged out over this long, to see whether currents move; fewer averages do not tell. [s], [1]"""
SHORT_S, ENOUGH_S = 20.0, 60.0
"""Shorter recordings tell no signs; shorter ones than the second neither delays nor gains. [s]"""
STILL_A, STILL_SHARE, STILL_STEPS = 0.5, 0.01, 0.5
"""Currents that move by less than this [A], this share of full scale, or this many of their steps stand still. [1]"""
STILL_SPEED = 0.5
"""Below this a car stands. [km/h, or whatever the unit is]"""
NEAR_ZERO = 0.05
"""Share of full scale below which a current that stands still is near zero. [1]"""
COARSEST = 0.01
"""Share of full scale; a coarser step is a slip of a unit. [1]"""
_SPEEDS, _SPEED_UNITS = {"speed", "velocity", "geschwindigkeit"}, {"km/h", "kph", "kmh", "mph", "m/s", ""}
"""Of the vehicle; columns of a table have no unit here, and a motor's speed never quite stands."""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What recordings can tell at all: how long they are, and whether a current moves.

    Attributes
    ----------
    full_scale_a : float
        Of the junction. [A]
    valid_s : float
        How long the branches of the sum have values together. [s]
    steps_a : mapping of str to float
        Step of the signal of each branch, at most :data:`COARSEST`. [A]
    moves_a : mapping of str to float
        Standard deviation of each branch, noise averaged out; empty where too little was recorded to tell. [A]
    mean_a : float
        Greatest magnitude of the mean of a branch. [A]
    speed : float or None
        Greatest speed [in its unit], 0 for none; None where it is not recorded.
    """

    full_scale_a: float
    valid_s: float
    steps_a: Mapping[str, float]
    moves_a: Mapping[str, float]
    mean_a: float
    speed: float | None

    @property
    def short(self) -> bool:
        """Whether too little was recorded for signs, units and gains."""
        return self.valid_s < SHORT_S

    @property
    def stands_still(self) -> bool:
        """Whether no current moves by more than its sensor can show; a speed that moves says otherwise."""
        least_a = min(STILL_A, STILL_SHARE * self.full_scale_a)
        still = all(moves_a <= max(least_a, STILL_STEPS * self.steps_a[name]) for name, moves_a in self.moves_a.items())
        return bool(self.moves_a) and still and not self.speed

    @property
    def how_short(self) -> str:
        """What a short recording does not tell, for a message; empty if it is long enough."""
        if self.short:
            where = "in which all branches have values: signs, units and gains cannot be told"
            return f"only {figure(self.valid_s)} s {where}"
        if self.valid_s < ENOUGH_S:
            return f"{figure(self.valid_s)} s are short: delays cannot be told, and gains hardly"
        return ""

    @property
    def near_zero(self) -> bool:
        """Whether all currents are small."""
        return self.mean_a < NEAR_ZERO * self.full_scale_a

    @property
    def how_still(self) -> str:
        """What stands still, for a message; empty if something moves."""
        if not self.stands_still:
            return ""
        what = f"the currents stand still, the greatest at {figure(self.mean_a)} A"
        speed = ", and its speed is 0" if self.speed == 0.0 else ""
        return (
            f"{'the car stands still' if self.near_zero else what}: no current varies by more than "
            f"{figure(max(self.moves_a.values()), 2)} A{speed}; signs and gains cannot be told"
        )


def conditions_of(drives: Sequence[Drive], comparisons: Sequence[Comparison], database: VehicleDatabase) -> Conditions:
    """Look at how long some drives are, and whether a current moves in them.

    Parameters
    ----------
    drives, comparisons : sequence of Drive, sequence of Comparison
        Of one vehicle, all with the same branches.
    database : VehicleDatabase
        DBC and layout, with the voltages of powers (:func:`.with_voltages`).

    Returns
    -------
    Conditions
        Of what is valid for the sum.
    """
    layout, names = database.layout, comparisons[0].branches if comparisons else ()
    parts = [comparison.currents_a["before"][comparison.valid] for comparison in comparisons]
    length = max(round(AVERAGED_S / layout.period_s), 1)
    averages = [part[: len(part) // length * length].reshape(-1, length, len(names)).mean(axis=1) for part in parts]
    average = np.concatenate([np.zeros((0, len(names))), *averages])
    moves_a = average.std(axis=0).tolist() if len(average) >= FEWEST_AVERAGES else []
    steps_a = {name: max(sensor_of(database, name, drive).step_a for drive in drives) for name in names}
    return Conditions(
        full_scale_a=layout.full_scale_a,
        valid_s=layout.period_s * sum(map(len, parts)),
        steps_a={name: min(step_a, COARSEST * layout.full_scale_a) for name, step_a in steps_a.items()},
        moves_a=dict(zip(names, moves_a, strict=False)),
        mean_a=max((float(np.abs(part.mean(axis=0)).max()) for part in parts), default=0.0),
        speed=_greatest_speed(drives, database),
    )


def _greatest_speed(drives: Sequence[Drive], database: VehicleDatabase) -> float | None:
    values = [np.zeros(0)]
    for item in database.layout.input:
        unit = database.signal(item.signal)[1].unit or ""
        if any(word in f"{item.name} {item.signal}".lower() for word in _SPEEDS) and unit in _SPEED_UNITS:
            found = [drive.inputs[item.name] for drive in drives if item.name in drive.inputs]
            values += [np.abs(channel.value[channel.good]) for channel in found]
    greatest = float(np.concatenate(values).max(initial=-1.0))
    return None if greatest < 0.0 else greatest if greatest > STILL_SPEED else 0.0
