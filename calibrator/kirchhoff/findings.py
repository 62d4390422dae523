"""Checks of the sum of the currents, for the commands ``doctor`` and ``kirchhoff``.

To add a check, add a function to :data:`CHECKS`, or to :data:`CHECKS_OF_MOVING` if it needs currents that move.
"""

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np

from calibrator.drives.delays import MAX_DELAY_S
from calibrator.findings import Finding, Findings, error, hint, warning, worst_first
from calibrator.kirchhoff.junction import RecordedJunction
from calibrator.kirchhoff.signs import SURE
from calibrator.kirchhoff.sums import SUM
from calibrator.recordings.tables import bare_name
from calibrator.terminal.text import figure
from calibrator.words import POSITIONS, places_of, words_of
from ecu_node.core.signals import AMPERE

__all__ = ["CHECKS", "CHECKS_OF_MOVING", "sum_findings", "times"]

ENOUGH_S = 60.0
"""Shorter recordings show neither delays nor gains. [s]"""
NEAR_ZERO = 0.05
"""Share of full scale below which a current is near zero. [1]"""
LEAST_DELAY_S, LONG_DELAY_S = 0.02, 0.1
"""Delays from LEAST_DELAY_S on are a hint: shorter ones, two frames of a fast message, change no result. From
LONG_DELAY_S on they are a warning: 300 ms bend the gains of the junction law by 3 %; this is a third of that. [s]"""
LEAST_GAIN, LARGEST_GAIN, LEAST_SHARE = 0.02, 0.25, 0.5
"""Least gain error that is reported; largest one that sensors drift by; and least ratio of what gain errors explain of
the sum's variation to what remains unexplained, below which none is reported. [1]"""
LEAST_MEAN_A, LEAST_MEAN, LARGE_MEAN = 0.5, 0.001, 0.05
"""A mean of the sum is reported if it is beyond LEAST_MEAN_A and beyond LEAST_MEAN times full scale. Beyond LARGE_MEAN
times full scale it is a warning, as loads without a sensor usually draw less. [A], [1]"""
LEAST_SUM_A, NO_SUM = 0.5, 0.3
"""A sum that varies by less than LEAST_SUM_A is right. Branches do not belong together if the mean square of their sum
is more than NO_SUM times the sum of their mean squares. [A], [1]"""
SAME, CLEAR = 1.2, 1.4
"""The sign of a branch is unknown if with the other sign the sum varies less than SAME times as much. Two branches are
surely exchanged if the sum varies more than CLEAR times as much as with each in the other's place: its variance is
halved, as by the change of a sign. [1]"""
STUCK_S, STUCK_RANGE = 10.0, (0.1, 0.9)
"""A current other than zero is stuck if it holds its exact value for so long; how much the others' sum varies meanwhile
is taken between these quantiles. [s], [1]"""
STUCK_MOVE, STUCK_VALUE, STUCK_ROUNDING = 0.02, 0.002, 1e-9
"""Shares of full scale: a current is stuck only if it exceeds STUCK_VALUE while the others' sum varies by more than
STUCK_MOVE; interpolation makes equal values differ by up to STUCK_ROUNDING. [1]"""

UNITS = {factor_a: unit for unit, factor_a in AMPERE.items()}
"""Units of currents by the factor that turns their values into A."""


def sum_findings(junction: RecordedJunction) -> list[Finding]:
    """Return all findings about the sum of the currents, errors first."""
    checks = [*CHECKS, *(CHECKS_OF_MOVING if junction.moves else ())]
    return worst_first(each for check in checks for each in check(junction))


def enough(junction: RecordedJunction) -> Findings:
    """Report that there are too few branches for a sum, that the recording is too short, or that no current moves."""
    names, record, valid_s = junction.branches, "record a minute of driving or more", junction.valid_s
    if len(names) < 2:
        text = f"usable frames of {', '.join(names) or 'no branch'} only, so there is no sum to look at"
        advice = "a junction needs two branches: record the buses that carry them, or name other signals"
        yield error("too few branches", SUM, text, advice)
        return
    if junction.is_short:
        text = f"only {figure(valid_s)} s in which all branches have values: signs, units and gains cannot be told"
        yield warning("too short", SUM, text, record, valid_s)
    elif not len(junction.bands.block):
        text = f"signs, units and delays cannot be told: no 20 s in which {', '.join(names)} have no gap"
        yield warning("too short", SUM, text, f"{record} without loss", valid_s)
    elif valid_s < ENOUGH_S:
        text = f"{figure(valid_s)} s are short: delays cannot be told, and gains hardly"
        yield hint("too short", SUM, text, record, valid_s)
    if junction.stands_still:
        what = f"the currents stand still, the greatest at {figure(junction.mean_a)} A"
        advice = "record one in which they change; this one tells their ratio, if their offsets are known"
        if junction.mean_a < NEAR_ZERO * junction.database.layout.full_scale_a:
            what, advice = "the car stands still", "record a drive; such a log tells offsets, where no current flows"
        most_a, speed = float(junction.moves_a.max()), ", and its speed is 0" if junction.speed == 0.0 else ""
        text = f"{what}: no current varies by more than {figure(most_a, 2)} A{speed}; signs and gains cannot be told"
        yield hint("stands still", SUM, text, advice, most_a)


def times(factor: float) -> str:
    """Say how wrong a value is that must be multiplied by a power of ten: ``1000 times too large`` for 0.001."""
    return f"{1.0 / factor:g} times too large" if factor < 1.0 else f"{factor:g} times too small"


def signs_and_units(junction: RecordedJunction) -> Findings:
    """Report branches with a wrong sign or unit."""
    multipliers, bands, layout = junction.multipliers, junction.bands, junction.database.layout
    exchanges = list(exchanged(junction))
    if any(each.severity == "error" for each in exchanges) or (exchanges and np.all(multipliers == -1.0)):
        return  # the signs follow from the exchange
    if np.all(multipliers == -1.0):
        text = "all signs are inverted: the battery's voltage falls while energy would flow into it"
        advice = "turn the sign of every [[branch]]: the current of a battery that is discharged is positive"
        yield warning("sign", "all branches", text, advice)
        return
    after_a = bands.rms_a(multipliers)
    for k in junction.changed:
        branch, wanted = layout.find_branch(junction.branches[k]), float(multipliers[k])
        factor, name, source = abs(wanted), branch.name, branch.source
        turn = f'set sign = {-branch.sign} in the [[branch]] "{name}" of the layout'
        scale = f"correct scale or unit of {source}{f', or of {branch.voltage}' if branch.voltage else ''}"
        if layout.path.name == "--branches":
            turn = f"leave the minus before {name} out in --branches"
            turn = turn if branch.sign < 0 else f"write a minus before {name} in --branches"
            scale = f"multiply {source} by {factor:g}, in the table or in --branches"
            if factor in UNITS and not branch.computed:
                scale = f"write the unit into the header of column {source}: '{bare_name(source)} [{UNITS[factor]}]'"
        for code, wrong, what, change, advice in (
            ("sign", abs(wanted) if wanted < 0.0 else wanted, "its sign is inverted", "the other sign", turn),
            ("unit", wanted / factor, f"its current is {times(factor)}", f"{name} times {factor:g}", scale),
        ):
            if wrong != wanted:
                before_a = bands.rms_a(np.where(np.arange(len(multipliers)) == k, wrong, multipliers))
                varies = f"{figure(before_a)} A (RMS about its mean), and by {figure(after_a)} A with {change}"
                text = f"{what}: the sum of all varies by {varies}"
                yield error(code, name, text, advice, factor if code == "unit" else before_a / max(after_a, 1e-9))


def exchanged(junction: RecordedJunction) -> Findings:
    """Report pairs of branches that each read the signal that the other is named after."""
    layout, bands = junction.database.layout, junction.bands
    for one, other in _exchanged(junction):
        first, second = layout.find_branch(one), layout.find_branch(other)
        text = f"it reads {first.source}, and {other} reads {second.source}, as if the two were exchanged"
        advice = f'exchange what [[branch]] "{one}" and "{other}" read (signal or power and voltage), not their signs'
        ratio = None
        if first.sign == second.sign:
            text += "; their sum is the same, but the parameters of each would be those of the other"
        elif junction.moves:
            right = np.array([-1.0 if name in {one, other} else 1.0 for name in junction.branches])
            before_a, after_a = bands.rms_a(np.ones(len(right))), bands.rms_a(right)
            text += f": the sum of all varies by {figure(before_a)} A, by {figure(after_a)} A with each in its place"
            ratio = before_a / max(after_a, 1e-9)
        yield (error if (ratio or 0.0) > CLEAR else warning)("exchanged", one, text, advice, ratio)


def _exchanged(junction: RecordedJunction) -> list[tuple[str, str]]:
    """Return the pairs of branches of which each reads what the other is named after."""
    named, reads = dict[str, list[set[str]]](), dict[str, list[set[str]]]()
    for branch in junction.database.layout.branch:
        if branch.name in junction.branches and not branch.computed:
            signal = branch.source.rpartition(".")[2]
            named[branch.name] = _place_and_position(branch.name)
            # the signal tells more than its message, which may carry several branches
            told = zip(_place_and_position(signal), _place_and_position(branch.source), strict=True)
            reads[branch.name] = [of_signal or of_all for of_signal, of_all in told]
    return [
        (one, other)
        for one, other in combinations(named, 2)
        if named[one] == reads[other] != named[other] == reads[one] and any(named[one]) and any(named[other])
    ]


def _place_and_position(name: str) -> list[set[str]]:
    """Return what a name says: places, as the battery, and positions, as front."""
    words = words_of(name)
    return [places_of(words), set(POSITIONS).intersection(words)]


def sum_cancels(junction: RecordedJunction) -> Findings:
    """Report that the currents do not cancel, so that the branches do not belong to one junction."""
    rest_a = junction.bands.rms_a(junction.multipliers)
    all_a, least_a = (float(np.linalg.norm(junction.multipliers * a)) for a in (junction.rms_a, junction.steps_a))
    if rest_a > max(LEAST_SUM_A, least_a) and (rest_a / all_a) ** 2 > NO_SUM:
        text = (
            f"the currents do not cancel: each for itself they vary by {figure(all_a)} A together, their sum by "
            f"{figure(rest_a)} A, and no other sign or unit helps"
        )
        advice = (
            "check that the signals are direct currents of this junction (not phase currents, limits or demands), and "
            "that no large branch is missing"
        )
        yield error("sum", SUM, text, advice, rest_a)


def cannot_tell(junction: RecordedJunction) -> Findings:
    """Report small branches for which the sum varies hardly more with the other sign."""
    rest_a = junction.bands.rms_a(junction.multipliers)
    for k, (name, rms_a) in enumerate(zip(junction.branches, junction.rms_a.tolist(), strict=True)):
        turned = np.where(np.arange(len(junction.branches)) == k, -1.0, 1.0) * junction.multipliers
        open_ = junction.bands.rms_a(turned) < SAME * rest_a
        if k not in junction.changed and rms_a > 0.0 and open_ and junction.is_small(name):
            varies = f"{figure(rms_a, 2)} A, and the sum of all by {figure(rest_a, 2)} A"
            text = f"its sign and unit cannot be told: it varies by {varies}"
            yield hint("cannot tell", name, text, "record a drive in which it carries more current", rms_a)


def delays(junction: RecordedJunction) -> Findings:
    """Report branches whose frames come late or early, compared with those of most other branches."""
    found = junction.delays
    if found is None:
        return
    together = np.abs(found.delay_s[:, None] - found.delay_s[None, :]) < LEAST_DELAY_S
    usual = int(np.argmax(np.where(found.known, (together & found.known).sum(axis=1), 0)))
    advice = (
        f"'calibrate' estimates delays up to {1e3 * MAX_DELAY_S:.0f} ms and takes them out by itself; 'kirchhoff' and "
        f"the node's watch do not, so correct the time stamps if the logger made the delay"
    )
    for k in np.flatnonzero(found.known):
        late_s = float(found.delay_s[k] - found.delay_s[usual])
        sd_s = float(np.hypot(found.sd_s[k], found.sd_s[usual]))
        sd_ms = figure(1e3 * sd_s, 1)
        if abs(late_s) >= max(LEAST_DELAY_S, SURE * sd_s) and not junction.is_small(found.branches[k]):
            late_ms = f"{abs(1e3 * late_s):.{len(sd_ms.partition('.')[2])}f}"
            late = f"{late_ms} +- {sd_ms} ms {'late' if late_s > 0 else 'early'}"
            say, text = warning if abs(late_s) >= LONG_DELAY_S else hint, f"its frames are {late} against "
            yield say("delay", found.branches[k], text + found.branches[usual], advice, late_s)


def gains(junction: RecordedJunction) -> Findings:
    """Report the branch whose gain error alone explains most of the sum's variation in the longest recording."""
    by_length = sorted(junction.comparisons, key=lambda each: each.valid.sum())
    for residual in filter(None, (comparison.residual["before"] for comparison in by_length[-1:])):
        alone: dict[str, dict[str, float]] = residual["alone"]
        if junction.changed or not alone or residual["gains"] < max(residual["delays"], LEAST_SHARE * residual["rest"]):
            return
        name = max(alone, key=lambda each: alone[each]["gain_share"])
        own = alone[name]
        error_, far = own["gain_error"], abs(own["gain_error"]) > LARGEST_GAIN
        advice = "which branch is off, 'calibrate' finds by a sensor you trust, or by comparing vehicles"
        if far:
            advice = "more than sensors drift: check the scales of all, and that no branch is missing"
        more = f"{abs(100.0 * error_):.1f} % {'more' if error_ > 0.0 else 'less'} current than the others leave for it"
        text = f"it shows {more}, which explains {100.0 * own['gain_share']:.0f} % of how the sum varies"
        if LEAST_GAIN < abs(error_) < np.inf:
            yield (warning if far else hint)("gain", name, text, advice, error_)


def mean_of_sum(junction: RecordedJunction) -> Findings:
    """Report a mean of the sum beyond the declared load: other loads without a sensor, or offsets of sensors."""
    load, scale_a = junction.database.layout.unmeasured_load, junction.database.layout.full_scale_a
    if not len(junction.sum_a) or (junction.moves and junction.changed):
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
    yield (warning if unexplained_a > LARGE_MEAN * scale_a else hint)("mean", SUM, text, advice, mean_a)


def stuck(junction: RecordedJunction) -> Findings:
    """Report for each branch the longest stretch, if any, in which it holds its value though the others move."""
    scale_a, longest = junction.database.layout.full_scale_a, dict[str, Finding]()
    for currents_a in (comparison.stages["before"] for comparison in junction.comparisons):
        for name in junction.branches:
            ends = ~(currents_a[name].diff().abs() <= STUCK_ROUNDING * scale_a)  # also where it is not valid
            run = ends.cumsum()
            part = currents_a[run == run.mode()[0]]
            start_s, value_a = part.index[0], float(part[name].iloc[0])
            duration_s = float(part.index[-1] - start_s)
            low_a, high_a = (part[SUM] - part[name]).quantile(STUCK_RANGE)  # a step at the end does not count
            others_a = float(high_a - low_a)
            moves = others_a > STUCK_MOVE * scale_a and abs(value_a) > STUCK_VALUE * scale_a
            if not moves or duration_s < STUCK_S or len(part) == len(currents_a):  # never changes: found elsewhere
                continue
            if name not in longest or duration_s > (longest[name].number or 0.0):
                where = f"{figure(value_a)} A for {duration_s:.0f} s from {start_s:.0f} s on"
                text = f"it stands at {where}, while the others' sum varies by {figure(others_a)} A"
                advice = "a frozen sensor or control unit: leave that part of the log out"
                longest[name] = warning("stuck", name, text, advice, duration_s)
    yield from longest.values()


CHECKS: Sequence[Callable[[RecordedJunction], Findings]] = (enough, exchanged, mean_of_sum, stuck)
CHECKS_OF_MOVING = (signs_and_units, sum_cancels, cannot_tell, delays, gains)
"""Checks that need currents that move for long enough, beside :data:`CHECKS`, which are always made."""
