"""What the sum of the currents of some recordings tells, and what it complains of; the same for doctor and kirchhoff.

A new check is one function more in :data:`CHECKS`, or in :data:`CHECKS_OF_MOVING` if currents must move for it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations, pairwise

import numpy as np

from calibrator.drive import Array, Drive
from calibrator.drives.delays import MAX_DELAY_S
from calibrator.errors import DriveError
from calibrator.findings import Finding, Severity, worst_first
from calibrator.kirchhoff.signs import SURE, SumFacts, look_at_sum
from calibrator.kirchhoff.sums import Comparison, compare_kirchhoff, sensor_of
from calibrator.terminal.text import figure
from calibrator.words import POSITIONS, places_of, words_of
from ecu_node.database import VehicleDatabase

__all__ = ["CHECKS", "CHECKS_OF_MOVING", "RecordedJunction", "look_at_junction", "sum_findings", "times"]

AVERAGED_S, FEWEST_AVERAGES = 2.0, 3
"""Noise is averaged out over this long, to see whether currents move; fewer averages do not tell. [s], [1]"""
SHORT_S, ENOUGH_S = 20.0, 60.0
"""Shorter recordings tell no signs; shorter ones than the second neither delays nor gains. [s]"""
STILL_A, STILL_SHARE, STILL_STEPS = 0.5, 0.01, 0.5
"""Currents that move by less than this [A], this share of full scale, or this many of their steps stand still. [1]"""
STILL_SPEED, NEAR_ZERO = 0.5, 0.05
"""Below this speed, in whatever unit, a car stands; share of full scale below which a current is near zero. [1]"""
COARSEST = 0.01
"""Share of full scale; a coarser step is a slip of a unit. [1]"""
_SPEEDS, _SPEED_UNITS = {"speed", "velocity", "geschwindigkeit"}, {"km/h", "kph", "kmh", "mph", "m/s", ""}
"""Of the vehicle; columns of a table have no unit here, and a motor's speed never quite stands."""
LEAST_DELAY_S, LONG_DELAY_S = 0.02, 0.1
"""Shorter delays change no result: two frames of a fast message. 300 ms bend the gains of the junction law by 3 %; a
third of that is worth a warning. [s]"""
LEAST_GAIN, LARGEST_GAIN, LEAST_RATIO = 0.02, 0.25, 1e-4
"""Differences of gains that are worth a line, those beyond what sensors drift, and a gain that shows nothing. [1]"""
LEAST_MEAN_A, LEAST_MEAN, LARGE_MEAN = 0.5, 0.001, 0.05
"""Means of the sum below half an ampere, or the first share of full scale, are not worth a line; beyond the second they
are more than loads without a sensor usually are. [A], [1]"""
NO_SUM = 0.3
"""Share of the variation that is left in the sum, above which branches do not belong together. [1]"""
SAME, CLEAR = 1.2, 2.0
"""A sum that varies by less than so much more with the other sign of a branch does not tell it; by so much less it must
vary with branches in each other's place, to be sure. [1]"""
STUCK_S, STUCK_RANGE = 10.0, (0.1, 0.9)
"""A current that is not zero holds its exact value for seconds at most; between these quantiles the others' sum must
vary meanwhile. [s], [1]"""
STUCK_MOVE, STUCK_VALUE, STUCK_ROUNDING = 0.02, 0.002, 1e-9
"""Of full scale: by which the others' sum must vary meanwhile; near nothing a branch may well stand; what interpolation
adds to values that are the same. [1]"""


@dataclass(frozen=True, kw_only=True)
class RecordedJunction:
    """The sum of some branches, over recordings of one vehicle.

    Attributes
    ----------
    database : VehicleDatabase
        With the voltages, see :func:`.with_voltages`.
    branches : tuple of str
        Those with usable values.
    drives : tuple of Drive
        Those with all of these branches.
    comparisons : tuple of Comparison
        Their currents, each on one time base.
    facts : SumFacts or None
        What the sum tells; None with fewer than two branches.
    """

    database: VehicleDatabase
    branches: tuple[str, ...]
    drives: tuple[Drive, ...]
    comparisons: tuple[Comparison, ...]
    facts: SumFacts | None

    @cached_property
    def sum_a(self) -> Array:
        """Sum of the branches at all valid instants. [A]"""
        return np.concatenate([np.zeros(0), *(c.sums_a["before"][c.valid] for c in self.comparisons)])

    @property
    def valid_s(self) -> float:
        """How long the branches have values together. [s]"""
        return self.database.layout.period_s * len(self.sum_a)

    @property
    def is_short(self) -> bool:
        """Whether too little was recorded for signs, units and gains."""
        return self.valid_s < SHORT_S

    @cached_property
    def steps_a(self) -> dict[str, float]:
        """Step of the signal of each branch. [A]"""
        return steps_of(self.database, self.branches, self.drives)

    @cached_property
    def moves_a(self) -> dict[str, float]:
        """Standard deviation of each branch, noise averaged out; empty where too little was recorded to tell. [A]"""
        length = max(round(AVERAGED_S / self.database.layout.period_s), 1)
        parts = [c.currents_a["before"][c.valid] for c in self.comparisons]
        means = [part[: len(part) // length * length].reshape(-1, length, part.shape[1]).mean(axis=1) for part in parts]
        if sum(map(len, means)) < FEWEST_AVERAGES:
            return {}
        return dict(zip(self.comparisons[0].branches, np.concatenate(means).std(axis=0).tolist(), strict=True))

    @cached_property
    def mean_a(self) -> float:
        """Greatest magnitude of the mean of a branch. [A]"""
        means = [np.abs(c.currents_a["before"][c.valid].mean(axis=0)).max() for c in self.comparisons]
        return float(max(means, default=0.0))

    @cached_property
    def speed(self) -> float | None:
        """Greatest speed [in its unit], 0 for none; None where it is not recorded."""
        greatest = -1.0
        for item in self.database.layout.input:
            unit = self.database.signal(item.signal)[1].unit or ""
            if unit in _SPEED_UNITS and any(word in f"{item.name} {item.signal}".lower() for word in _SPEEDS):
                for channel in (drive.inputs[item.name] for drive in self.drives if item.name in drive.inputs):
                    greatest = max(greatest, float(np.abs(channel.value[channel.good]).max(initial=-1.0)))
        return None if greatest < 0.0 else greatest if greatest > STILL_SPEED else 0.0

    @cached_property
    def stands_still(self) -> bool:
        """Whether no current moves by more than its sensor can show; a speed that moves says otherwise."""
        least_a = min(STILL_A, STILL_SHARE * self.database.layout.full_scale_a)
        still = all(moves_a <= max(least_a, STILL_STEPS * self.steps_a[name]) for name, moves_a in self.moves_a.items())
        return bool(self.moves_a) and still and not self.speed


def steps_of(database: VehicleDatabase, branches: Sequence[str], drives: Sequence[Drive]) -> dict[str, float]:
    """Step of the signal of each branch, at most :data:`COARSEST`. [A]"""
    coarsest_a = COARSEST * database.layout.full_scale_a
    return {
        name: min(max((sensor_of(database, name, drive).step_a for drive in drives), default=0.0), coarsest_a)
        for name in branches
    }


def look_at_junction(
    drives: Sequence[Drive], database: VehicleDatabase, *, full_scale_a: float | None = None
) -> RecordedJunction:
    """Look at the sum of the branches that have usable values in some drives of one vehicle.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle; those that lack a branch that others have do not count.
    database : VehicleDatabase
        With the voltages, see :func:`.with_voltages`.
    full_scale_a : float, optional
        What currents are plausible up to, if it is not that of the layout. [A]
    """
    layout = database.layout
    usable = {name for drive in drives for name, channel in drive.branches.items() if channel.good.any()}
    names = tuple(name for name in layout.branch_names if name in usable)
    whole = [drive for drive in drives if all(n in drive.branches and drive.branches[n].good.any() for n in names)]
    comparisons, facts = list[Comparison](), None
    if len(names) > 1:
        for drive in whole:
            with suppress(DriveError):  # no instant at which all are fresh: there is no sum to look at
                comparisons.append(compare_kirchhoff(drive, database))
        least_a = float(np.linalg.norm([*steps_of(database, names, whole).values()]))
        facts = look_at_sum(drives, names, layout, least_a=least_a, full_scale_a=full_scale_a or layout.full_scale_a)
    return RecordedJunction(
        database=database, branches=names, drives=tuple(whole), comparisons=tuple(comparisons), facts=facts
    )


Findings = Iterator[Finding]
error, warning, hint = (partial(Finding, severity) for severity in Severity)


def sum_findings(junction: RecordedJunction) -> list[Finding]:
    """All findings of the sum, errors first."""
    facts = junction.facts
    found = [each for check in CHECKS for each in check(junction)]
    if facts is not None and len(facts.bands.block) and not junction.stands_still:
        found += [each for check in CHECKS_OF_MOVING for each in check(junction, facts)]
    return worst_first(found)


def enough(junction: RecordedJunction) -> Findings:
    """Whether there is a sum, whether it is long enough, and whether anything moves in it."""
    names, record = junction.branches, "record a minute of driving or more"
    if len(names) < 2:
        text = f"usable frames of {', '.join(names) or 'no branch'} only, so there is no sum to look at"
        advice = "a junction needs two branches: record the buses that carry them, or name other signals"
        yield error("too few branches", "sum", text, advice)
        return
    valid_s = junction.valid_s
    if junction.is_short:
        text = f"only {figure(valid_s)} s in which all branches have values: signs, units and gains cannot be told"
        yield warning("too short", "sum", text, record, valid_s)
    elif junction.facts is not None and not len(junction.facts.bands.block):
        text = f"signs, units and delays cannot be told: no 20 s in which {', '.join(names)} have no gap"
        yield warning("too short", "sum", text, f"{record} without loss", valid_s)
    elif valid_s < ENOUGH_S:
        text = f"{figure(valid_s)} s are short: delays cannot be told, and gains hardly"
        yield hint("too short", "sum", text, record, valid_s)
    if junction.stands_still:
        what = f"the currents stand still, the greatest at {figure(junction.mean_a)} A"
        advice = "record one in which they change; this one tells their ratio, if their offsets are known"
        if junction.mean_a < NEAR_ZERO * junction.database.layout.full_scale_a:
            what, advice = "the car stands still", "record a drive; such a log tells offsets, where no current flows"
        most_a, speed = max(junction.moves_a.values()), ", and its speed is 0" if junction.speed == 0.0 else ""
        text = f"{what}: no current varies by more than {figure(most_a, 2)} A{speed}; signs and gains cannot be told"
        yield hint("stands still", "sum", text, advice, most_a)


def times(factor: float) -> str:
    """How a value is wrong that must be multiplied by a power of ten."""
    return f"{1.0 / factor:g} times too large" if factor < 1.0 else f"{factor:g} times too small"


def signs_and_units(junction: RecordedJunction, facts: SumFacts) -> Findings:
    """Branches with the wrong sign, or a slip of a unit."""
    multipliers, bands, layout = facts.multipliers, facts.bands, junction.database.layout
    if _exchanged(junction):
        return
    if facts.changed and np.all(multipliers == -1.0):
        text = "all signs are inverted: the battery's voltage falls while energy would flow into it"
        advice = "turn the sign of every [[branch]]: the current of a battery that is discharged is positive"
        yield warning("sign", "all branches", text, advice)
        return
    after_a, of_option = bands.rms_a(multipliers), layout.path.name == "--branches"
    for k in facts.changed:
        branch, wanted = layout.find_branch(facts.branches[k]), float(multipliers[k])
        factor, name = abs(wanted), branch.name
        minus = "leave the minus before" if branch.sign < 0 else "write a minus before"
        out = " out" if branch.sign < 0 else ""
        turn = f"{minus} {name}{out} in --branches"
        scale = f"write the unit into the header of column {branch.source}, such as '{branch.source} [mA]'"
        if not of_option:
            turn = f'set sign = {-branch.sign} in the [[branch]] "{name}" of the layout'
            scale = f"correct scale or unit of {branch.source}{f', or of {branch.voltage}' if branch.voltage else ''}"
        for code, wrong, what, change, advice in (
            ("sign", -wanted if wanted < 0.0 else wanted, "its sign is inverted", "the other sign", turn),
            ("unit", wanted / factor, f"its current is {times(factor)}", f"{name} times {factor:g}", scale),
        ):
            before_a = bands.rms_a(np.where(np.arange(len(multipliers)) == k, wrong, multipliers))
            if wrong != wanted:
                varies = f"{figure(before_a)} A (RMS about its mean), and by {figure(after_a)} A with {change}"
                text = f"{what}: the sum of all varies by {varies}"
                yield error(code, name, text, advice, factor if code == "unit" else before_a / max(after_a, 1e-9))


def exchanged(junction: RecordedJunction) -> Findings:
    """Branches of which each has the signal that the other is named after."""
    facts, layout = junction.facts, junction.database.layout
    for one, other in _exchanged(junction):
        first, second = layout.find_branch(one), layout.find_branch(other)
        text = f"it reads {first.source}, and {other} reads {second.source}, as if the two were exchanged"
        advice = f'exchange what [[branch]] "{one}" and "{other}" read (signal or power and voltage), not their signs'
        say, ratio = warning, None
        if first.sign == second.sign:
            text += "; their sum is the same, but the parameters of each would be those of the other"
        elif facts is not None and len(facts.bands.block) and not junction.stands_still:
            right = np.array([-1.0 if name in {one, other} else 1.0 for name in facts.branches])
            before_a, after_a = facts.bands.rms_a(np.ones(len(right))), facts.bands.rms_a(right)
            text += f": the sum of all varies by {figure(before_a)} A, by {figure(after_a)} A with each in its place"
            ratio = before_a / max(after_a, 1e-9)
            say = error if ratio > CLEAR else warning
        yield say("exchanged", one, text, advice, ratio)


def _exchanged(junction: RecordedJunction) -> list[tuple[str, str]]:
    said: dict[str, list[set[str]]] = {}
    for branch in junction.database.layout.branch:
        if branch.name in junction.branches and not branch.computed:
            name, signal = words_of(branch.name), words_of(branch.source)
            said[branch.name] = [places_of(words) | (set(POSITIONS) & set(words)) for words in (name, signal)]
    return [
        (one, other)
        for one, other in combinations(said, 2)
        if said[one][0] != said[one][1] and said[one] == said[other][::-1] and all(said[one])
    ]


def sum_cancels(junction: RecordedJunction, facts: SumFacts) -> Findings:
    """Branches that do not belong to one junction."""
    rest_a = facts.bands.rms_a(facts.multipliers)
    all_a = float(np.linalg.norm(facts.multipliers * facts.rms_a))
    steps_a = np.abs(facts.multipliers) * [junction.steps_a[name] for name in facts.branches]
    if rest_a > max(STILL_A, float(np.linalg.norm(steps_a))) and (rest_a / all_a) ** 2 > NO_SUM:
        text = (
            f"the currents do not cancel: each for itself they vary by {figure(all_a)} A together, their sum by "
            f"{figure(rest_a)} A, and no other sign or unit helps"
        )
        advice = (
            "check that the signals are direct currents of this junction (not phase currents, limits or demands), and "
            "that no large branch is missing"
        )
        yield error("sum", "sum", text, advice, rest_a)


def cannot_tell(_: RecordedJunction, facts: SumFacts) -> Findings:
    """Small branches of which another sign or unit would do nearly as well."""
    rest_a = facts.bands.rms_a(facts.multipliers)
    for k, name in enumerate(facts.branches):
        turned = np.where(np.arange(len(facts.branches)) == k, -1.0, 1.0) * facts.multipliers
        open_ = facts.bands.rms_a(turned) < SAME * rest_a
        if k not in facts.changed and facts.rms_a[k] > 0.0 and open_ and facts.is_small(name):
            rms_a = float(facts.rms_a[k])
            varies = f"{figure(rms_a, 2)} A, and the sum of all by {figure(rest_a, 2)} A"
            text = f"its sign and unit cannot be told: it varies by {varies}"
            yield hint("cannot tell", name, text, "record a drive in which it carries more current", rms_a)


def delays(_: RecordedJunction, facts: SumFacts) -> Findings:
    """Branches that come late."""
    found = facts.delays
    if found is None:
        return
    apart = np.abs(found.delay_s[:, None] - found.delay_s[None, :]) < LEAST_DELAY_S
    usual = int(np.argmax(np.where(found.known, (apart & found.known).sum(axis=1), 0)))
    for k in np.flatnonzero(found.known):
        late_s = float(found.delay_s[k] - found.delay_s[usual])
        sd_s = float(np.hypot(found.sd_s[k], found.sd_s[usual]))
        if abs(late_s) < max(LEAST_DELAY_S, SURE * sd_s) or facts.is_small(found.branches[k]):
            continue
        text = (
            f"its frames are {abs(1e3 * late_s):.0f} +- {figure(1e3 * sd_s, 1)} ms {'late' if late_s > 0 else 'early'} "
            f"against {found.branches[usual]}"
        )
        advice = (
            f"'calibrate' estimates delays up to {1e3 * MAX_DELAY_S:.0f} ms and takes them out by itself; 'kirchhoff' "
            f"and the node's watch do not, so correct the time stamps if the logger made the delay"
        )
        say = warning if abs(late_s) >= LONG_DELAY_S else hint
        yield say("delay", found.branches[k], text, advice, late_s)


def gains(_: RecordedJunction, facts: SumFacts) -> Findings:
    """Branches whose gains differ."""
    if not facts.gains or facts.delays is None:
        return
    first = facts.delays.branches[0]
    large = {
        name: gain
        for name, gain in facts.gains.items()
        if name == first or (not facts.is_small(name) and gain[0] > LEAST_RATIO)
    }
    usual = min(large, key=lambda name: len(_off(large, name)))
    for name, (ratio, ratio_sd) in _off(large, usual).items():
        error_, sd = 1.0 / ratio - 1.0, ratio_sd / ratio**2
        far = abs(ratio - 1.0) > LARGEST_GAIN
        more = f"{abs(100.0 * error_):.1f} +- {figure(100.0 * sd, 2)} % {'more' if error_ > 0.0 else 'less'}"
        advice = (
            "more than sensors drift: check the scales of both, and that no branch is missing"
            if far
            else "which of the two is off, 'calibrate' finds by a sensor you trust, or by comparing vehicles"
        )
        say = warning if far else hint
        yield say("gain", name, f"it shows {more} current than {usual} leaves for it", advice, error_)


def _off(gains: Mapping[str, tuple[float, float]], reference: str) -> dict[str, tuple[float, float]]:
    """Branches whose gain differs surely from that of one of them, with their gain beside it."""
    by, by_sd = gains[reference]
    beside = {
        name: (gain / by, float(np.hypot(sd, by_sd)) / by) for name, (gain, sd) in gains.items() if name != reference
    }
    return {name: (gain, sd) for name, (gain, sd) in beside.items() if abs(gain - 1.0) > max(LEAST_GAIN, SURE * sd)}


def mean_of_sum(junction: RecordedJunction) -> Findings:
    """What flows where no branch measures it."""
    load, scale_a = junction.database.layout.unmeasured_load, junction.database.layout.full_scale_a
    facts, moves = junction.facts, not junction.stands_still
    if not len(junction.sum_a) or (facts is not None and len(facts.bands.block) and moves and facts.changed):
        return
    mean_a, sd_a = float(junction.sum_a.mean()), float(junction.sum_a.std())
    unexplained_a = abs(mean_a - (load.mean_a if load is not None else 0.0))
    if unexplained_a < max(LEAST_MEAN_A, LEAST_MEAN * scale_a, SURE * load.sd_a if load is not None else 0.0):
        return
    beside = f" ({load.mean_a:g} A are declared as a load)" if load is not None else ""
    text = f"it is {figure(mean_a, 2)} A in the mean{beside}, and varies by {figure(sd_a, 2)} A about it"
    known = "look at the load declared in [unmeasured_load]" if load else "if it is known, say so in [unmeasured_load]"
    advice = (
        f"loads that no branch measures, or offsets of sensors: 'calibrate' tells them apart by what is known; {known}"
    )
    yield (warning if unexplained_a > LARGE_MEAN * scale_a else hint)("mean", "sum", text, advice, mean_a)


def stuck(junction: RecordedJunction) -> Findings:
    """The longest stretch of each branch in which it stands still though the others move."""
    scale_a, longest = junction.database.layout.full_scale_a, dict[str, Finding]()
    for comparison in junction.comparisons:
        time_s, currents_a, valid = comparison.time_s, comparison.currents_a["before"], comparison.valid
        for k, name in enumerate(comparison.branches):
            value, others = currents_a[:, k], np.delete(currents_a, k, axis=1).sum(axis=1)
            ends = (np.abs(np.diff(value)) > STUCK_ROUNDING * scale_a) | ~valid[1:] | ~valid[:-1]
            edges = np.flatnonzero(np.concatenate([[True], ends, [True]])).tolist()
            run = slice(*max(pairwise(edges), key=lambda edge: edge[1] - edge[0]))
            duration_s = float(time_s[run][-1] - time_s[run][0])
            others_a = float(np.ptp(np.quantile(others[run], STUCK_RANGE)))  # not of a step at the end
            moves = others_a > STUCK_MOVE * scale_a and abs(value[run][0]) > STUCK_VALUE * scale_a
            if not moves or duration_s < STUCK_S or len(value[run]) == len(value):  # the last is told by itself
                continue
            if name not in longest or duration_s > (longest[name].number or 0.0):
                text = (
                    f"it stands at {figure(float(value[run][0]))} A for {duration_s:.0f} s from "
                    f"{time_s[run][0]:.0f} s on, while the others' sum varies by {figure(others_a)} A"
                )
                advice = "a frozen sensor or control unit: leave that part of the log out"
                longest[name] = warning("stuck", name, text, advice, duration_s)
    yield from longest.values()


CHECKS: Sequence[Callable[[RecordedJunction], Findings]] = (enough, exchanged, mean_of_sum, stuck)
CHECKS_OF_MOVING: Sequence[Callable[[RecordedJunction, SumFacts], Findings]] = (
    signs_and_units, sum_cancels, cannot_tell, delays, gains,
)  # fmt: skip
"""What can be told only where currents move long enough."""
