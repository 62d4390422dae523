"""What the doctor complains of: a list of checks, each a function from the facts to findings.

A new check is one function more in :data:`CHECKS`, or :data:`SUM_CHECKS`. A finding says what is wrong with its
figure, and what to do.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from itertools import combinations, pairwise

import numpy as np

from calibrator.doctor.facts import MOST_MINUTES, Facts
from calibrator.doctor.junction import JunctionFacts
from calibrator.doctor.words import POSITIONS, places_of, words_of
from calibrator.drive import Array, Mask
from calibrator.drives.align import TIME_RESOLUTION_S, base_inputs, choose_inputs
from calibrator.drives.delays import MAX_DELAY_S
from calibrator.errors import DriveError, LogError
from calibrator.estimator.junction import summarise_junction
from calibrator.kirchhoff.conditions import STILL_A
from calibrator.terminal.text import counted, figure
from ecu_node.bus.guard import Mode
from ecu_node.bus.in_force import InForce
from ecu_node.bus.wiring import wire
from ecu_node.errors import UserError

__all__ = ["CHECKS", "Diagnosis", "Severity", "findings_of", "readiness"]

MANY_BAD, SOME_BAD = 0.05, 0.001
"""Shares of frames that cannot be used: worth a warning, worth a hint. [1]"""
TIMEOUT_PERIODS = 5.0
"""A time-out of this many periods bridges some lost frames. [1]"""
LEAST_OF_SCALE = 0.02
"""Greatest current seen, as a share of full scale, below which one of the two is probably wrong. [1]"""
LEAST_DELAY_S, LONG_DELAY_S = 0.02, 0.1
"""Shorter delays change no result: two frames of a fast message. 300 ms bend the gains of the junction law by 3 %; a
third of that is worth a warning. [s]"""
SURE = 3.0
"""Standard deviations. [1]"""
LEAST_GAIN, LARGEST_GAIN = 0.02, 0.25
"""Differences of gains that are worth a line, and those beyond what sensors drift. [1]"""
LEAST_RATIO = 1e-4
"""A gain below this belongs to a branch that shows nothing. [1]"""
LEAST_SHARE = 0.05
"""Of the greatest branch's variation; a smaller branch's gain is drawn to 0 by its noise. [1]"""
LEAST_MEAN_A, LEAST_MEAN, LARGE_MEAN = 0.5, 0.001, 0.05
"""Means of the sum below half an ampere, or the first share of full scale, are not worth a line; beyond the second they
are more than loads without a sensor usually are. [A], [1]"""
NO_SUM = 0.3
"""Share of the variation that is left in the sum, above which branches do not belong together. [1]"""
SAME = 1.2
"""A sum that varies by less than so much more with the other sign of a branch does not tell it. [1]"""
CLEAR = 2.0
"""By so much less the sum must vary with branches in each other's place, to be sure. [1]"""
WELL_EXPLAINED = 0.5
"""Share of a current's variation that model inputs should explain at least. [1]"""
STUCK_S = 10.0
"""A current that is not zero holds its exact value for seconds at most. [s]"""
STUCK_RANGE = (0.1, 0.9)
"""Quantiles between which the others' sum must vary meanwhile."""
STUCK_MOVE, STUCK_VALUE, STUCK_ROUNDING = 0.02, 0.002, 1e-9
"""Of full scale: by which the others' sum must vary meanwhile; near nothing a branch may well stand; what interpolation
adds to values that are the same. [1]"""


class Severity(StrEnum):
    """How much a finding matters."""

    ERROR = "error"
    """Results would be wrong, or there would be none."""
    WARNING = "warning"
    """Results may be worse, or a branch be missing."""
    HINT = "hint"
    """Worth knowing; nothing has to be done."""


@dataclass(frozen=True)
class Diagnosis:
    """One thing that is wrong, or worth knowing.

    Attributes
    ----------
    severity : Severity
        How much it matters.
    kind : str
        What it is, in a word or two, for programs: ``sign``, ``unit``, ``delay``, ...
    subject : str
        Branch, input or log that it is about.
    text : str
        What, with its figure.
    remedy : str
        What to do: which line of the layout to change, where it is the layout; empty if the text says it.
    figures : dict
        The figures of the text, with their units in their names.
    """

    severity: Severity
    kind: str
    subject: str
    text: str
    remedy: str
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def line(self) -> str:
        """The finding as one line, without its severity."""
        return f"{self.subject}: {self.text}" + (f"; {self.remedy}" if self.remedy else "")


Findings = Iterator[Diagnosis]
error, warning, hint = (partial(Diagnosis, severity) for severity in Severity)


def findings_of(facts: Facts) -> list[Diagnosis]:
    """All findings, errors first."""
    order, junction = list(Severity), _judged(facts)
    found = [item for check in CHECKS for item in check(facts)]
    found += [item for check in SUM_CHECKS if junction is not None for item in check(facts, junction)]
    return sorted(found, key=lambda item: order.index(item.severity))


# ---- layout, logs, single branches and inputs


def not_in_dbc(facts: Facts) -> Findings:
    """Signals that the DBC lacks."""
    for (what, name), why in facts.missing.items():
        remedy = f"correct the signal in the {what} {name}, or take the DBC that belongs to the layout"
        yield (warning if what == "input" else error)("not in DBC", name, why, remedy)


def logs_as_a_whole(facts: Facts) -> Findings:
    """Logs of another vehicle, times, damage."""
    for log in facts.logs:
        report, drive = log.report, log.drive
        if drive is None:
            say, why = warning if facts.drives else error, log.why or LogError("")
            what = why.what.removeprefix(f"{log.name}: ")
            yield say("no branch", log.name, what, why.remedy, {"count": 0})
        if log.cut:
            text = f"only its first {MOST_MINUTES:g} minutes were looked at"
            yield hint("length", log.name, text, "they tell enough of a layout", {"count": 0})
        if count := report.clock_steps:
            remedy = "each step becomes a gap; record with a steady clock"
            yield warning("time", log.name, f"its clock was set {counted(count, 'time')}", remedy, {"count": count})
        if report.unfit:
            what, remedy = report.unfit
            yield warning("unfit", log.name, what, remedy)
        nothing = "nothing has to be done"
        for count, kind, text, remedy in (
            (report.disordered, "time", f"of {report.frames:,} frames come with an earlier time stamp than one before "
             "them", f"they are sorted; {nothing}"),
            (report.damaged, "damage", "damaged lines or frames", f"they are left out; {nothing}"),
            (report.error_frames, "error frames", "error frames", "look at the wiring and bit rate of the logger"),
            (sum(report.ignored.values()), "other buses", f"frames of other buses ({', '.join(report.ignored)})",
             f"they are ignored; {nothing}"),
        ):  # fmt: skip
            if count:
                yield hint(kind, log.name, f"{count:,} {text}", remedy, {"count": count})


def absent(facts: Facts) -> Findings:
    """Branches and inputs that no log has."""
    is_table = not facts.layout.dbc_files
    what, where = (
        ("column of numbers", "name the column that has it")
        if is_table
        else ("frame of", "record the bus that carries it")
    )
    for item in (*facts.branches, *facts.inputs):
        if item.frames:
            continue
        text = f"no {what} {item.signal} in the logs"
        if item in facts.branches:
            remedy = f"{where}; if the vehicle does not have it, it may stay in the layout"
            yield warning("not in log", item.name, text, remedy)
        elif item.name in facts.needed:
            remedy = f"{where}, or name other inputs: without it what is derived from it is left out"
            yield warning("not in log", item.name, text, remedy)
        else:
            yield hint("not in log", item.name, text, where)


def late(facts: Facts) -> Findings:
    """Frames farther apart than the time-out of a branch."""
    for item in facts.branches:
        timeout_s = facts.layout.find_branch(item.name).timeout_s
        if item.period_s > timeout_s + TIME_RESOLUTION_S:
            text = (
                f"its frames are {figure(item.period_s)} s apart, and timeout_s is {timeout_s:g} s: it is always stale"
            )
            remedy = (
                f'set timeout_s = {float(f"{TIMEOUT_PERIODS * item.period_s:.1g}"):g} in the [[branch]] "{item.name}"'
            )
            yield error("rate", item.name, text, remedy, {"period_s": item.period_s, "timeout_s": timeout_s})
        elif item.late:
            gaps = "1 gap" if item.late == 1 else f"{item.late:,} gaps"
            text = f"{gaps} longer than timeout_s = {timeout_s:g} s, the longest of {figure(item.gap_s)} s"
            remedy = "instants in gaps are left out; record without loss, or raise timeout_s if its frames come rarely"
            yield warning("gap", item.name, text, remedy, {"gaps": item.late, "longest_s": item.gap_s})


BAD_REMEDY = {
    "E2E check failed": "check profile and data identifiers in [e2e] of the layout",
    "too short": "the frames are shorter than the DBC says: take the DBC of this vehicle",
    "not available": "its control unit says that it has no value: choose another signal, or record while it is awake",
    "out of range": "values outside [minimum|maximum] of the DBC are left out: right for codes of 'no value', else "
    "correct the range",
    "no voltage": "there is no fresh voltage to divide by: choose another voltage, or raise timeout_s",
    "no number": "its column has texts: correct the table",
    "no value": "what its formula is made of is not fresh: look at the inputs",
}


def bad_frames(facts: Facts) -> Findings:
    """Frames that cannot be used."""
    for item in (*facts.branches, *facts.inputs):
        share = item.bad_frames / max(item.frames, 1)
        if share < SOME_BAD:
            continue
        say = error if not item.good else warning if share >= MANY_BAD else hint
        if item in facts.inputs:
            say = hint if item.name not in facts.needed else say if say is hint else warning
        reasons = ", ".join(f"{reason} {count:,}" for reason, count in item.bad.items())
        text = f"{item.bad_frames:,} of {item.frames:,} frames ({figure(100.0 * share, 2)} %) cannot be used: {reasons}"
        remedy = BAD_REMEDY.get(max(item.bad, key=lambda reason: item.bad[reason]), "choose another signal")
        yield say("bad frames", item.name, text, remedy, {"share": share})


def clipped(facts: Facts) -> Findings:
    """Values at the end of what a signal can show."""
    for item in facts.branches:
        if item.clipped:
            text = (
                f"{item.clipped:,} of {item.frames:,} frames stand at the end of what {item.signal} can show; it goes "
                f"from {figure(item.low)} to {figure(item.high)} A"
            )
            remedy = "the true current was greater: choose a signal of a wider range, or correct the range in the DBC"
            yield warning("clipped", item.name, text, remedy, {"frames": item.clipped})


def constant(facts: Facts) -> Findings:
    """Branches, and inputs of the model, that never change."""
    if facts.conditions.stands_still:
        return
    for item in (*facts.branches, *(item for item in facts.inputs if item.name in facts.needed)):
        if item.good and not item.moves:
            text = f"it never changes: {figure(item.low)} {item.unit} in all of {item.good:,} frames"
            remedy = "check that it is the right signal; nothing can be told of it from these logs"
            yield warning("constant", item.name, text, remedy, {"value": item.low})


def impossible_voltage(facts: Facts) -> Findings:
    """A voltage that powers are divided by and that no vehicle has: a slip of its unit is every such branch's."""
    if facts.slip is not None:
        signal, median_v, factor = facts.slip
        text = f"the voltage is {figure(median_v)} V in the median, probably {_times(factor)}"
        remedy = "correct its scale or unit in the DBC, or name another signal as the voltage"
        yield error("unit", signal, text, remedy, {"factor": factor, "median_v": median_v})


def _times(factor: float) -> str:
    return f"{1.0 / factor:g} times too large" if factor < 1.0 else f"{factor:g} times too small"


def full_scale(facts: Facts) -> Findings:
    """Currents beyond full scale, or far from it."""
    scale_a = facts.layout.full_scale_a
    seen = {item.name: max(abs(item.low), abs(item.high)) for item in facts.branches if item.good}
    for name, peak_a in seen.items():
        if peak_a > scale_a:
            text = f"it reaches {figure(peak_a)} A, and full_scale_a is {figure(scale_a)} A"
            remedy = "raise full_scale_a in the layout to the nominal maximum of the junction, if the value is right"
            yield warning("full scale", name, text, remedy, {"peak_a": peak_a})
    if seen and (most_a := max(seen.values())) < LEAST_OF_SCALE * scale_a and not facts.conditions.stands_still:
        text = f"no branch exceeds {figure(most_a)} A, and full_scale_a is {figure(scale_a)} A"
        yield warning(
            "full scale", "all branches", text, "record a drive, or check units and full_scale_a", {"peak_a": most_a}
        )


# ---- the junction sum


def enough(facts: Facts) -> Findings:
    """Whether there is a sum, whether it is long enough, and whether anything moves in it."""
    if len(facts.usable) < 2:
        text = f"usable frames of {', '.join(facts.usable) or 'no branch'} only, so there is no sum to look at"
        remedy = "a junction needs two branches: record the buses that carry them, or name other signals"
        yield error("too few branches", "sum", text, remedy)
        return
    seen = facts.conditions
    record, figures = "record a minute of driving or more", {"valid_s": seen.valid_s}
    if seen.short:
        yield warning("too short", "sum", seen.how_short, record, figures)
    elif facts.junction is not None and not len(facts.junction.bands.block):
        text = f"signs, units and delays cannot be told: no 20 s in which {', '.join(facts.usable)} have no gap"
        yield warning("too short", "sum", text, f"{record} without loss", figures)
    elif seen.how_short:
        yield hint("too short", "sum", seen.how_short, record, figures)
    if seen.stands_still:
        remedy = "record one in which they change; this one tells their ratio, if their offsets are known"
        if seen.near_zero:
            remedy = "record a drive; such a log tells offsets, where no current flows"
        figures = {"moves_a": max(seen.moves_a.values()), "mean_a": seen.mean_a}
        yield hint("stands still", "sum", seen.how_still, remedy, figures)


def _judged(facts: Facts) -> JunctionFacts | None:
    """What the sum tells, where currents move."""
    junction = facts.junction
    return None if junction is None or not len(junction.bands.block) or facts.conditions.stands_still else junction


def signs_and_units(facts: Facts, junction: JunctionFacts) -> Findings:
    """Branches with the wrong sign, or a slip of a unit."""
    multipliers, bands = junction.multipliers, junction.bands
    if _exchanged(facts):
        return
    if junction.changed and np.all(multipliers == -1.0):
        text = "all signs are inverted: the battery's voltage falls while energy would flow into it"
        remedy = "turn the sign of every [[branch]]: the current of a battery that is discharged is positive"
        yield warning("sign", "all branches", text, remedy)
        return
    after_a = bands.rms_a(multipliers)
    for k in junction.changed:
        branch, wanted = facts.layout.find_branch(junction.branches[k]), float(multipliers[k])
        factor, name = abs(wanted), branch.name
        turn = f'set sign = {-branch.sign} in the [[branch]] "{name}" of the layout'
        scale = f"correct scale or unit of {branch.source}" + (f", or of {branch.voltage}" if branch.voltage else "")
        for kind, wrong, what, change, remedy in (
            ("sign", -wanted if wanted < 0.0 else wanted, "its sign is inverted", "the other sign", turn),
            ("unit", wanted / factor, f"its current is {_times(factor)}", f"{name} times {factor:g}", scale),
        ):
            before_a = bands.rms_a(np.where(np.arange(len(multipliers)) == k, wrong, multipliers))
            if wrong != wanted:
                varies = (
                    f"varies by {figure(before_a)} A (RMS about its mean), and by {figure(after_a)} A with {change}"
                )
                figures = {"factor": factor, "rms_before_a": before_a, "rms_after_a": after_a}
                yield error(kind, name, f"{what}: the sum of all {varies}", remedy, figures)


def exchanged(facts: Facts) -> Findings:
    """Branches of which each has the signal that the other is named after."""
    junction, layout = _judged(facts), facts.layout
    for one, other in _exchanged(facts):
        first, second = layout.find_branch(one), layout.find_branch(other)
        text = f"it reads {first.source}, and {other} reads {second.source}, as if the two were exchanged"
        remedy = f'exchange what [[branch]] "{one}" and "{other}" read (signal or power and voltage), not their signs'
        say, figures = warning, dict[str, float]()
        if first.sign == second.sign:
            text += "; their sum is the same, but the parameters of each would be those of the other"
        elif junction is not None:
            right = np.array([-1.0 if name in {one, other} else 1.0 for name in junction.branches])
            before_a, after_a = junction.bands.rms_a(np.ones(len(right))), junction.bands.rms_a(right)
            text += f": the sum of all varies by {figure(before_a)} A, by {figure(after_a)} A with each in its place"
            figures = {"rms_before_a": before_a, "rms_after_a": after_a}
            say = error if before_a > CLEAR * after_a else warning
        yield say("exchanged", one, text, remedy, figures)


def _exchanged(facts: Facts) -> list[tuple[str, str]]:
    said: dict[str, list[set[str]]] = {}
    for branch in facts.layout.branch:
        if branch.name in facts.usable and not branch.computed:
            name, signal = words_of(branch.name), words_of(branch.source)
            said[branch.name] = [places_of(words) | (set(POSITIONS) & set(words)) for words in (name, signal)]
    return [
        (one, other)
        for one, other in combinations(said, 2)
        if said[one][0] != said[one][1] and said[one] == said[other][::-1] and all(said[one])
    ]


def sum_cancels(facts: Facts, junction: JunctionFacts) -> Findings:
    """Branches that do not belong to one junction."""
    rest_a = junction.bands.rms_a(junction.multipliers)
    parts_a = junction.multipliers * junction.rms_a
    noise_a = np.abs(junction.multipliers) * [facts.conditions.steps_a[name] for name in junction.branches]
    all_a, least_a = float(np.linalg.norm(parts_a)), max(STILL_A, float(np.linalg.norm(noise_a)))
    if rest_a > least_a and (rest_a / all_a) ** 2 > NO_SUM:
        text = (
            f"the currents do not cancel: each for itself they vary by {figure(all_a)} A together, their sum by "
            f"{figure(rest_a)} A, and no other sign or unit helps"
        )
        remedy = (
            "check that the signals are direct currents of this junction (not phase currents, limits or demands), and "
            "that no large branch is missing"
        )
        yield error("sum", "sum", text, remedy, {"rms_parts_a": all_a, "rms_sum_a": rest_a})


def cannot_tell(_: Facts, junction: JunctionFacts) -> Findings:
    """Small branches of which another sign or unit would do nearly as well."""
    rest_a = junction.bands.rms_a(junction.multipliers)
    for k, name in enumerate(junction.branches):
        turned = np.where(np.arange(len(junction.branches)) == k, -1.0, 1.0) * junction.multipliers
        open_ = junction.bands.rms_a(turned) < SAME * rest_a
        if k not in junction.changed and junction.rms_a[k] > 0.0 and open_ and _is_small(junction, name):
            rms_a = float(junction.rms_a[k])
            text = (
                f"its sign and unit cannot be told: it varies by {figure(rms_a, 2)} A, and the sum of all by "
                f"{figure(rest_a, 2)} A"
            )
            remedy = "record a drive in which it carries more current"
            yield hint("cannot tell", name, text, remedy, {"rms_a": rms_a, "rms_sum_a": rest_a})


def _is_small(junction: JunctionFacts, name: str) -> bool:
    right_a = junction.rms_a * np.abs(junction.multipliers)
    return bool(right_a[junction.branches.index(name)] < LEAST_SHARE * np.max(right_a))


def delays(_: Facts, junction: JunctionFacts) -> Findings:
    """Branches that come late."""
    found = junction.delays
    if found is None:
        return
    apart = np.abs(found.delay_s[:, None] - found.delay_s[None, :]) < LEAST_DELAY_S
    usual = int(np.argmax(np.where(found.known, (apart & found.known).sum(axis=1), 0)))
    for k in np.flatnonzero(found.known):
        late_s = float(found.delay_s[k] - found.delay_s[usual])
        sd_s = float(np.hypot(found.sd_s[k], found.sd_s[usual]))
        if abs(late_s) < max(LEAST_DELAY_S, SURE * sd_s) or _is_small(junction, found.branches[k]):
            continue
        text = (
            f"its frames are {abs(1e3 * late_s):.0f} +- {figure(1e3 * sd_s, 1)} ms {'late' if late_s > 0 else 'early'} "
            f"against {found.branches[usual]}"
        )
        remedy = (
            f"'calibrate' estimates delays up to {1e3 * MAX_DELAY_S:.0f} ms and takes them out by itself; 'kirchhoff' "
            f"and the node's watch do not, so correct the time stamps if the logger made the delay"
        )
        say = warning if abs(late_s) >= LONG_DELAY_S else hint
        yield say("delay", found.branches[k], text, remedy, {"delay_s": late_s, "sd_s": sd_s})


def gains(_: Facts, junction: JunctionFacts) -> Findings:
    """Branches whose gains differ."""
    if not junction.gains or junction.delays is None:
        return
    first = junction.delays.branches[0]
    large = {
        name: gain
        for name, gain in junction.gains.items()
        if name == first or (not _is_small(junction, name) and gain[0] > LEAST_RATIO)
    }
    usual = min(large, key=lambda name: len(_off(large, name)))
    for name, (ratio, ratio_sd) in _off(large, usual).items():
        percent, sd = 100.0 * (1.0 / ratio - 1.0), 100.0 * ratio_sd / ratio**2
        far = abs(ratio - 1.0) > LARGEST_GAIN
        text = (
            f"it shows {abs(percent):.1f} +- {figure(sd, 2)} % {'more' if percent > 0.0 else 'less'} current than "
            f"{usual} leaves for it"
        )
        remedy = (
            "more than sensors drift: check the scales of both, and that no branch is missing"
            if far
            else "which of the two is off, 'calibrate' finds by a sensor you trust, or by comparing vehicles"
        )
        yield (warning if far else hint)("gain", name, text, remedy, {"percent": percent, "sd_percent": sd})


def _off(gains: Mapping[str, tuple[float, float]], reference: str) -> dict[str, tuple[float, float]]:
    """Branches whose gain differs surely from that of one of them, with their gain beside it."""
    by, by_sd = gains[reference]
    beside = {
        name: (gain / by, float(np.hypot(sd, by_sd)) / by) for name, (gain, sd) in gains.items() if name != reference
    }
    return {name: (gain, sd) for name, (gain, sd) in beside.items() if abs(gain - 1.0) > max(LEAST_GAIN, SURE * sd)}


def mean_of_sum(facts: Facts) -> Findings:
    """What flows where no branch measures it."""
    load, scale_a = facts.layout.unmeasured_load, facts.layout.full_scale_a
    if not len(facts.sum_a) or ((junction := _judged(facts)) is not None and junction.changed):
        return
    mean_a, sd_a = float(facts.sum_a.mean()), float(facts.sum_a.std())
    unexplained_a = abs(mean_a - (load.mean_a if load is not None else 0.0))
    if unexplained_a < max(LEAST_MEAN_A, LEAST_MEAN * scale_a, SURE * load.sd_a if load is not None else 0.0):
        return
    beside = f" ({load.mean_a:g} A are declared as a load)" if load is not None else ""
    text = f"it is {figure(mean_a, 2)} A in the mean{beside}, and varies by {figure(sd_a, 2)} A about it"
    known = "look at the load declared in [unmeasured_load]" if load else "if it is known, say so in [unmeasured_load]"
    remedy = (
        f"loads that no branch measures, or offsets of sensors: 'calibrate' tells them apart by what is known; {known}"
    )
    say = warning if unexplained_a > LARGE_MEAN * scale_a else hint
    yield say("mean", "sum", text, remedy, {"mean_a": mean_a, "sd_a": sd_a})


def stuck(facts: Facts) -> Findings:
    """The longest stretch of each branch in which it stands still though the others move."""
    scale_a, longest = facts.layout.full_scale_a, dict[str, Diagnosis]()
    for comparison in facts.comparisons:
        time_s, currents_a = comparison.time_s, comparison.currents_a["before"]
        for k, name in enumerate(comparison.branches):
            value, others = currents_a[:, k], np.delete(currents_a, k, axis=1).sum(axis=1)
            run = _longest_run(value, comparison.valid, STUCK_ROUNDING * scale_a)
            duration_s = float(time_s[run][-1] - time_s[run][0])
            others_a = float(np.ptp(np.quantile(others[run], STUCK_RANGE)))  # not of a step at the end
            shown_a, start_s = float(value[run][0]), float(time_s[run][0])
            moves = others_a > STUCK_MOVE * scale_a and abs(shown_a) > STUCK_VALUE * scale_a
            if not moves or duration_s < STUCK_S or len(value[run]) == len(value):  # the last is told by itself
                continue
            if name not in longest or duration_s > longest[name].figures["duration_s"]:
                text = (
                    f"it stands at {figure(shown_a)} A for {duration_s:.0f} s from {start_s:.0f} s on, while the "
                    f"others' sum varies by {figure(others_a)} A"
                )
                figures = {"start_s": start_s, "duration_s": duration_s, "value_a": shown_a}
                remedy = "a frozen sensor or control unit: leave that part of the log out"
                longest[name] = warning("stuck", name, text, remedy, figures)
    yield from longest.values()


def _longest_run(value: Array, valid: Mask, rounding: float) -> slice:
    """Where the longest run of one value is, all of it valid."""
    ends = (np.abs(np.diff(value)) > rounding) | ~valid[1:] | ~valid[:-1]
    edges = np.flatnonzero(np.concatenate([[True], ends, [True]]))
    start, stop = max(pairwise(edges.tolist()), key=lambda run: run[1] - run[0])
    return slice(start, stop)


def inputs_matter(facts: Facts) -> Findings:
    """Currents that the model inputs do not explain."""
    remedy = (
        "give the model what drives this current (docs/layout.md, 'Inputs matter'): its torque times speed, its demand"
    )
    for name, share in facts.explained.items():
        if share < WELL_EXPLAINED and not facts.conditions.stands_still:
            text = f"the model inputs explain {100.0 * share:.0f} % of how its current varies"
            yield warning("inputs", name, text, remedy, {"share": share})


CHECKS: Sequence[Callable[[Facts], Findings]] = (
    not_in_dbc, logs_as_a_whole, absent, late, bad_frames, clipped, constant, impossible_voltage, enough, exchanged,
    mean_of_sum, stuck, full_scale, inputs_matter,
)  # fmt: skip
SUM_CHECKS: Sequence[Callable[[Facts, JunctionFacts], Findings]] = (
    signs_and_units, sum_cancels, cannot_tell, delays, gains,
)  # fmt: skip
"""What can be told only where currents move long enough."""


# ---- what can be done next


def readiness(facts: Facts, findings: Sequence[Diagnosis]) -> dict[str, str]:
    """Commands in the order in which they are used, and for each what is missing; empty where nothing is."""
    errors = [finding for finding in findings if finding.severity is Severity.ERROR]
    wrong = f"of the errors above ({', '.join(dict.fromkeys(item.subject for item in errors))})" if errors else ""
    stale = ", ".join(finding.subject for finding in errors if finding.kind == "rate")
    together = "" if len(facts.sum_a) else f"at no instant all of {', '.join(facts.usable)} are fresh"
    if len(facts.usable) < 2:
        together = f"a sum needs two branches with usable frames, and there is {', '.join(facts.usable) or 'none'}"
    return {
        "kirchhoff": f"{stale} is always stale" if stale else together,
        "import": wrong if facts.drives else "no log has a branch",
        "calibrate --trusted": wrong or together or _for_junction(facts),
        "calibrate": wrong or together or _for_fleet(facts),
        "ecu-node": wrong or _for_node(facts, Mode.OVERLAY),
        "ecu-node --gateway": wrong or _for_node(facts, Mode.GATEWAY),
    }


def _for_junction(facts: Facts) -> str:
    """What calibrate says of these drives."""
    try:
        summarise_junction(facts.whole_drives, facts.usable, facts.database)
    except DriveError as error_:
        return str(error_)
    return ""


def _for_fleet(facts: Facts) -> str:
    layout = facts.layout
    if not layout.model_inputs:
        return "the layout has no model_inputs ([[input]], [[derived]])"
    kept, lacking = choose_inputs(layout, facts.available)
    names = ", ".join(sorted(base_inputs(layout, lacking) - facts.available))
    return "" if kept else f"none of the model_inputs is recorded ({names})"


def _for_node(facts: Facts, mode: Mode) -> str:
    layout = facts.layout
    computed = ", ".join(branch.name for branch in layout.branch if branch.computed)
    if len(layout.dbc_files) != 1 or computed:
        lacks = {0: "the layout names no DBC", 1: f"branch {computed} is computed"}
        return lacks.get(len(layout.dbc_files), "the layout names several buses") + ": it corrects signals of one bus"
    try:
        wire(facts.database, InForce(parameters=None), 0.0, mode=mode)
    except UserError as error_:
        return str(error_).removeprefix(f"{facts.layout.path}: ")
    return ""
