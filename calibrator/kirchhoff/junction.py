"""What recordings of one vehicle show about the sum of its currents: signs, units, delays, and whether currents move.

Signs and units are found first (:mod:`calibrator.kirchhoff.signs`). With these corrected, delays are estimated as the
calibrator does; with the delays taken out, signs and units are found once more.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibrator.drive import Array, Drive, good_values
from calibrator.drives.align import at_pace
from calibrator.drives.delays import BranchDelays, estimate_delays, without_delays
from calibrator.errors import DriveError
from calibrator.kirchhoff.signs import WELL_CORRELATED, Bands, bands_of, likely_multipliers, sag
from calibrator.kirchhoff.sums import VOLTAGE, Comparison, compare_kirchhoff, step_of
from calibrator.words import is_battery
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout

__all__ = ["RecordedJunction", "look_at_junction"]

CHANGE_PRICE, UNIT_PRICE = 0.7, 0.3
"""Prices are added to log (V / N), see :mod:`calibrator.kirchhoff.signs`. CHANGE_PRICE is that of each changed branch:
the change must halve V / N. UNIT_PRICE comes on top if its unit is changed: where sign or unit explain the same, the
sign is wrong. [1]"""
PLAUSIBLE_PRICE = 2.0
"""Price of each branch whose current would be beyond full scale, and of currents that would all be near zero. [1]"""
ORIENTATION_PRICE = 1.5
"""Price of signs by which energy flows into a battery while its voltage falls: more than that of one change. [1]"""
LARGEST_SHARE, LEAST_SHARE = 1.2, 0.002
"""Shares of full scale: a current above LARGEST_SHARE is beyond it; if all are below LEAST_SHARE, they are near
zero. [1]"""
PEAK_QUANTILE = 0.999
"""Quantile of the magnitudes that is taken as peak, so that a few wild samples do not count. [1]"""
SMALL_SHARE = 0.05
"""A branch that varies by less than this share of the greatest is small: noise draws its gain to 0. [1]"""
AVERAGED_S, FEWEST_AVERAGES = 2.0, 3
"""Currents are averaged so long, against noise, to see whether they move; fewer averages do not tell. [s], [1]"""
SHORT_S = 20.0
"""Shorter recordings do not show signs. [s]"""
STILL_A, STILL_SHARE, STILL_STEPS = 0.5, 0.01, 0.5
"""Currents stand still if they move by no more than this [A] or this share of full scale, whichever is less, or by no
more than this many of their steps. [1]"""
STILL_SPEED = 0.5
"""Below this speed, in whatever unit, a car stands."""
COARSEST = 0.01
"""Coarsest step of a signal as a share of full scale; a coarser one comes from a wrong unit. [1]"""
_SPEEDS, _SPEED_UNITS = ("speed", "velocity", "geschwindigkeit"), {"km/h", "kph", "kmh", "mph", "m/s", ""}
"""Words and units of a vehicle's speed. Columns of a table have no unit here; a motor's speed is never quite 0."""


@dataclass(frozen=True, kw_only=True)
class RecordedJunction:
    """Currents of the K branches with usable values in recordings of one vehicle, and what their sum shows.

    Attributes
    ----------
    database : VehicleDatabase
        DBC and layout with the voltages as inputs, see :func:`.with_voltages`; its period is the frame
        distance of the fastest branch if the layout's is far shorter.
    branches : tuple of str
        The K branches.
    drives : tuple of Drive
        Drives with all of these branches.
    comparisons : tuple of Comparison
        Currents of each of these drives on one time base; empty with fewer than two branches.
    steps_a : ndarray of shape (K,)
        Step of the signal of each branch, at most the share :data:`COARSEST` of full scale. [A]
    bands : Bands
        Filtered currents with signs and units of the layout, delays taken out; no instant if too little was recorded.
    multipliers : ndarray of shape (K,)
        Likely factors +-10^n by which the branches must be multiplied; 1 where sign and unit are right. [1]
    delays : BranchDelays or None
        Delays found with these signs and units; None if too little was recorded.
    """

    database: VehicleDatabase
    branches: tuple[str, ...]
    drives: tuple[Drive, ...]
    comparisons: tuple[Comparison, ...]
    steps_a: Array
    bands: Bands
    multipliers: Array
    delays: BranchDelays | None

    @property
    def rms_a(self) -> Array:
        """Root mean square of each branch's filtered current, with the layout's sign and unit, shape (K,). [A]"""
        return np.asarray(np.sqrt(np.mean(self.bands.current_a**2, axis=0)))

    @property
    def changed(self) -> list[int]:
        """Positions in ``branches`` of those whose sign or unit in the layout is wrong."""
        return [int(k) for k in np.flatnonzero(self.multipliers != 1.0)]

    def is_small(self, name: str) -> bool:
        """Check whether a branch varies too little, compared with the greatest, for the sum to tell much about it."""
        right_a = self.rms_a * np.abs(self.multipliers)
        return bool(right_a[self.branches.index(name)] < SMALL_SHARE * np.max(right_a))

    @cached_property
    def currents_a(self) -> list[Array]:
        """For each drive the currents of the branches, then their sum, at the valid instants, shape (T, K + 1). [A]"""
        return [comparison.stages["before"].dropna().to_numpy() for comparison in self.comparisons]

    @property
    def sum_a(self) -> Array:
        """Sum of the branches at all valid instants of all drives, one after the other, shape (T,). [A]"""
        return np.concatenate([np.zeros(0), *(part[:, -1] for part in self.currents_a)])

    @property
    def valid_s(self) -> float:
        """Time for which all branches have values. [s]"""
        return self.database.layout.period_s * len(self.sum_a)

    @property
    def is_short(self) -> bool:
        """Whether too little was recorded for signs, units and gains."""
        return self.valid_s < SHORT_S

    @cached_property
    def moves_a(self) -> Array:
        """Standard deviation of each branch's 2 s averages, shape (K,); empty if too little was recorded. [A]"""
        length = max(round(AVERAGED_S / self.database.layout.period_s), 1)
        whole = [part[: len(part) // length * length, :-1] for part in self.currents_a]
        means = [part.reshape(-1, length, part.shape[1]).mean(axis=1) for part in whole]
        return np.concatenate(means).std(axis=0) if sum(map(len, means)) >= FEWEST_AVERAGES else np.zeros(0)

    @property
    def mean_a(self) -> float:
        """Greatest magnitude that the mean current of any branch has in any drive. [A]"""
        return float(max((np.abs(part[:, :-1].mean(axis=0)).max() for part in self.currents_a), default=0.0))

    @cached_property
    def speed(self) -> float | None:
        """Greatest recorded speed, in its own unit; 0 if below :data:`STILL_SPEED`; None if no speed is recorded."""
        inputs = [
            item.name
            for item in self.database.layout.input
            if (self.database.signal(item.signal)[1].unit or "") in _SPEED_UNITS
            and any(word in f"{item.name} {item.signal}".lower() for word in _SPEEDS)
        ]
        seen = [float(np.abs(value).max()) for name in inputs if len(value := good_values(self.drives, name))]
        return None if not seen else max(seen) if max(seen) > STILL_SPEED else 0.0

    @cached_property
    def stands_still(self) -> bool:
        """Whether no current moves by more than the ``STILL_`` limits; False if the car moves or the data are few."""
        if self.speed or not len(self.moves_a):
            return False
        least_a = min(STILL_A, STILL_SHARE * self.database.layout.full_scale_a)
        return bool(np.all(self.moves_a <= np.maximum(least_a, STILL_STEPS * self.steps_a)))

    @property
    def moves(self) -> bool:
        """Whether currents move, and for long enough, to show signs, units, delays and gains."""
        return len(self.bands.block) > 0 and not self.stands_still


def look_at_junction(
    drives: Sequence[Drive], database: VehicleDatabase, *, full_scale_a: float | None = None
) -> RecordedJunction:
    """Find out what the sum of a vehicle's currents shows: signs, units and delays of its branches.

    Parameters
    ----------
    drives : sequence of Drive
        Drives of one vehicle; a drive that lacks a branch which another drive has is not used.
    database : VehicleDatabase
        DBC and layout with the voltages, see :func:`.with_voltages`.
    full_scale_a : float, optional
        Greatest plausible current, if it is not the full scale of the layout. [A]
    """
    layout = at_pace(database.layout, drives)
    database = replace(database, layout=layout)
    usable = {name for drive in drives for name, channel in drive.branches.items() if channel.good.any()}
    names = tuple(name for name in layout.branch_names if name in usable)
    whole = [drive for drive in drives if all(n in drive.branches and drive.branches[n].good.any() for n in names)]
    comparisons, delays = list[Comparison](), None
    bands = bands_of([])
    best: Array = np.ones(len(names))
    if len(names) > 1:
        for drive in whole:
            with suppress(DriveError):  # no instant at which all are fresh: there is no sum to look at
                comparisons.append(compare_kirchhoff(drive, database))
        bands = bands_of([[drive.branches[name] for name in names] for drive in whole])
    steps_a = np.array([max((step_of(database, name, drive) for drive in whole), default=0.0) for name in names])
    steps_a = np.minimum(steps_a, COARSEST * layout.full_scale_a)
    if len(bands.block):
        price = _price(drives, names, layout, full_scale_a or layout.full_scale_a)
        least_a = float(np.linalg.norm(steps_a))
        best = _multipliers(bands, price, least_a)
        order = np.argsort(-np.sum((bands.current_a * best) ** 2, axis=0), kind="stable")
        right = [_multiplied(drive, dict(zip(names, best.tolist(), strict=True))) for drive in whole]
        with suppress(DriveError):
            delays = estimate_delays(right, [names[k] for k in order])
            on_time = [without_delays(drive, delays.by_branch()) for drive in whole]
            bands = bands_of([[drive.branches[name] for name in names] for drive in on_time])
            best = _multipliers(bands, price, least_a)
    return RecordedJunction(
        database=database,
        branches=names,
        drives=tuple(whole),
        comparisons=tuple(comparisons),
        steps_a=steps_a,
        bands=bands,
        multipliers=best,
        delays=delays,
    )


def _multiplied(drive: Drive, multipliers: Mapping[str, float]) -> Drive:
    """Return a drive with its branch currents multiplied by the given numbers."""
    branches = {
        name: replace(drive.branches[name], value=m * drive.branches[name].value) for name, m in multipliers.items()
    }
    return replace(drive, branches=branches)


def _multipliers(bands: Bands, price: Callable[[Array], float], least_a: float) -> Array:
    """Return likely multipliers, shape (K,); all 1 if the sum varies by `least_a` (quantisation) or less."""
    ones = np.ones(bands.current_a.shape[1])
    return ones if bands.rms_a(ones) <= least_a else likely_multipliers(bands, price)


def _price(
    drives: Sequence[Drive], names: Sequence[str], layout: Layout, full_scale_a: float
) -> Callable[[Array], float]:
    """Return the function from multipliers (K,) to their price: for changes, implausible currents, battery's sign."""
    peak_share = (
        np.array([np.quantile(np.abs(good_values(drives, name)), PEAK_QUANTILE) for name in names]) / full_scale_a
    )
    battery = next((k for k, n in enumerate(names) if is_battery(n, layout.find_branch(n).source)), None)
    orientation = 0.0 if battery is None else _orientation(drives, names[battery])

    def price(multipliers: Array) -> float:
        share = np.abs(multipliers) * peak_share
        turned = 0.0 if battery is None else float(np.sign(multipliers[battery]))
        changes = min(np.sum(multipliers != 1.0), 1 + np.sum(multipliers != -1.0))  # all signs turned are one change
        return float(
            CHANGE_PRICE * changes
            + UNIT_PRICE * np.sum(np.abs(multipliers) != 1.0)
            + PLAUSIBLE_PRICE * (np.sum(share > LARGEST_SHARE) + (share.max() < LEAST_SHARE))
            + ORIENTATION_PRICE * max(-turned * orientation, 0.0)
        )

    return price


def _orientation(drives: Sequence[Drive], battery: str) -> float:
    """Tell from the battery's voltage whether its current is positive into the junction.

    Near 1 if the voltage falls when the current rises, near -1 if it rises. Without a voltage that follows the current
    the result is a third of the mean current over its root mean square, since driving takes energy out of a battery; 0
    if the current is 0, too.
    """
    both = [drive for drive in drives if battery in drive.branches and VOLTAGE in drive.inputs]
    correlation = sag([(drive.branches[battery], drive.inputs[VOLTAGE]) for drive in both])
    if abs(correlation) > WELL_CORRELATED:
        return -correlation
    value = good_values(drives, battery)
    spread = float(np.sqrt(np.mean(value**2)))
    return float(np.mean(value)) / spread / 3.0 if spread > 0.0 else 0.0
