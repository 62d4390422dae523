"""Checks of the doctor, except those of the sum of the currents; each is a function from the facts to findings.

To add a check, add a function to :data:`CHECKS`; the counts and values that it needs are in :class:`.Facts`. Checks of
the sum are in :mod:`calibrator.kirchhoff.findings`.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from calibrator.doctor.facts import Facts
from calibrator.drive import Drive, good_values
from calibrator.drives.align import choose_inputs
from calibrator.drives.computed_inputs import why_computed
from calibrator.errors import LogError
from calibrator.estimator.junction_run import summarise_junction
from calibrator.findings import Finding, Findings, error, hint, warning, worst_first
from calibrator.kirchhoff.findings import sum_findings, times
from calibrator.kirchhoff.sums import VOLTAGE, compare_kirchhoff
from calibrator.summaries.vehicle_summary import LEAST_DURATION_S, too_slow
from calibrator.terminal.text import figure
from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.errors import UserError
from ecu_node.summary import TIME_RESOLUTION_S

__all__ = ["CHECKS", "findings_of", "readiness"]

MOST_BAD, MANY_BAD, SOME_BAD = 0.5, 0.05, 0.001
"""Shares of unusable frames that give an error (the rest is not enough for a current), a warning, and a hint. [1]"""
TIMEOUT_PERIODS = 5.0
"""A time-out of this many periods bridges some lost frames. [1]"""
LEAST_V, GREATEST_V, USUAL_V = 30.0, 1500.0, 400.0
"""Range of voltages from 48 V systems to the highest of road vehicles, and a usual one: a unit error is taken for the
power of ten that brings the voltage nearest to it. [V]"""
LEAST_OF_SCALE = 0.02
"""If no current exceeds this share of full scale, units or full scale are probably wrong. [1]"""


def findings_of(facts: Facts) -> list[Finding]:
    """Return all findings, errors first; if the voltage has a wrong unit, unit errors of branches are left out."""
    found, of_sum = [each for check in CHECKS for each in check(facts)], sum_findings(facts.junction)
    blamed = {each.code for each in found} & {"unit"}
    return worst_first([*found, *(each for each in of_sum if each.code not in blamed)])


def logs_as_a_whole(facts: Facts) -> Findings:
    """Report logs without a branch of the layout, and the notices that 'import' gives on a log, such as damage."""
    for log in facts.logs:
        if not isinstance(log.drive, Drive):
            what = log.drive.what.removeprefix(f"{log.name}: ")
            yield (warning if facts.drives else error)("no branch", log.name, what, log.drive.remedy)
        notices, unfit = [*map(str, log.report.log_notices())], "; ".join(log.report.unfit)
        for text in notices[1:] if log.report.found else notices:  # how a table was read is no finding
            yield (warning if text == unfit else hint)("log", log.name, text)


def counted_twice(facts: Facts) -> Findings:
    """Report logs with the same recording, as in two formats: with twice the samples, errors look too small."""
    for k, log in enumerate(facts.logs):
        if other := next((each.name for each in facts.logs[:k] if _same_recording(each.drive, log.drive)), None):
            yield warning("twice", log.name, f"the same recording as {other}, counted twice", "leave one of them out")


def _same_recording(one: Drive | LogError, other: Drive | LogError) -> bool:
    """Check whether two drives have the same branches and values; formats round times in different ways."""
    if isinstance(one, LogError) or isinstance(other, LogError) or one.branches.keys() != other.branches.keys():
        return False
    pairs = [(channel, other.branches[name]) for name, channel in one.branches.items()]
    return all(
        len(a.time_s) == len(b.time_s)
        and np.allclose(a.time_s, b.time_s, rtol=0.0, atol=TIME_RESOLUTION_S)
        and np.array_equal(a.value, b.value, equal_nan=True)
        for a, b in pairs
    )


def absent(facts: Facts) -> Findings:
    """Report branches and inputs that no log has, and branches that some logs lack."""
    what, where = "frame of", "record the bus that carries it"
    if not facts.database.layout.dbc_files:
        what, where = "column of numbers", "name the column that has it"
    for row in facts.channels[facts.channels.frames == 0].itertuples():
        say, advice = hint, where
        if row.is_branch:
            say, advice = warning, f"{where}; if the vehicle does not have it, it may stay in the layout"
        elif row.needed:
            say, advice = warning, f"{where}, or name other inputs: without it what is derived from it is left out"
        yield say("not in log", row.name, f"no {what} {row.signal} in the logs", row.elsewhere or advice)
    some = facts.channels.is_branch & facts.channels.in_logs.between(1, len(facts.drives) - 1)
    for row in facts.channels[some].itertuples():
        text = f"{row.in_logs} of {len(facts.drives)} logs have it; the others are not in the sum"
        advice = "leave out logs that lack it, or record it in all: 'calibrate' may take it as not fitted"
        yield warning("not in log", row.name, text, advice, row.in_logs)


def late(facts: Facts) -> Findings:
    """Report branches whose frames are farther apart than the time-out."""
    for row in facts.channels[facts.channels.is_branch & (facts.channels.late > 0)].itertuples():
        timeout_s = facts.database.layout.find_branch(row.name).timeout_s
        if row.period_s > timeout_s + TIME_RESOLUTION_S:
            apart = f"its frames are {figure(row.period_s)} s apart"
            wanted_s = float(f"{TIMEOUT_PERIODS * row.period_s:.1g}")
            text = f"{apart}, and timeout_s is {timeout_s:g} s: it is always stale"
            advice = f'set timeout_s = {wanted_s:g} in the [[branch]] "{row.name}"'
            yield error("rate", row.name, text, advice, wanted_s)
        else:
            gaps = "1 gap" if row.late == 1 else f"{row.late:,} gaps"
            text = f"{gaps} longer than timeout_s = {timeout_s:g} s, the longest of {figure(row.gap_s)} s"
            advice = "instants in gaps are left out; record without loss, or raise timeout_s if its frames come rarely"
            yield warning("gap", row.name, text, advice, row.gap_s)


BAD_ADVICE = {
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
    """Report branches and inputs with frames that cannot be used, and the reasons."""
    for row in facts.channels.itertuples():
        number = sum(row.bad.values())
        share = number / max(row.frames, 1)
        if share < SOME_BAD:
            continue
        say = error if share >= MOST_BAD else warning if share >= MANY_BAD else hint
        if not row.is_branch:
            say = hint if not row.needed or say is hint else warning
        reasons = ", ".join(f"{reason} {count:,}" for reason, count in row.bad.items())
        text = f"{number:,} of {row.frames:,} frames ({figure(100.0 * share, 2)} %) cannot be used: {reasons}"
        advice = BAD_ADVICE.get(max(row.bad, key=row.bad.__getitem__), "choose another signal")
        yield say("bad frames", row.name, text, advice, share)


def values(facts: Facts) -> Findings:
    """Report branches with values at an end of the signal's range, and branches and needed inputs that never change."""
    for row in facts.channels[facts.channels.is_branch & (facts.channels.clipped > 0)].itertuples():
        stand = f"{row.clipped:,} of {row.frames:,} frames stand at the end of what {row.signal} can show"
        text = f"{stand}; it goes from {figure(row.low)} to {figure(row.high)} A"
        advice = "the true current was greater: choose a signal of a wider range, or correct the range in the DBC"
        yield warning("clipped", row.name, text, advice, row.clipped)
    matters = facts.channels.is_branch | facts.channels.needed
    for row in facts.channels[matters & (facts.channels.low == facts.channels.high)].itertuples():
        if not facts.junction.stands_still:
            text = f"it never changes: {figure(row.low)} {row.unit} in all of {row.good:,} frames"
            advice = "check that it is the right signal; nothing can be told of it from these logs"
            yield warning("constant", row.name, text, advice, row.low)


def inputs_of_sensors(facts: Facts) -> Findings:
    """Report inputs that carry the noise of a current sensor, and so its faults."""
    for name, branch in facts.computed_inputs.items():
        text = f"carries the noise of current sensors, as if computed from the current of {branch}"
        yield warning(
            "computed input", name, text, "a fleet is calibrated without it; name what the currents follow from"
        )


def impossible_voltage(facts: Facts) -> Findings:
    """Report a junction voltage that no vehicle has: the error of its unit shows in every power divided by it."""
    value_v = np.abs(good_values(facts.drives, VOLTAGE))
    signal = next((item.signal for item in facts.junction.database.layout.input if item.name == VOLTAGE), "")
    if not value_v.any() or facts.logs[0].source.unit(signal) != "V":
        return
    median_v = float(np.median(value_v))  # 0 is possible: contactors are open
    if median_v > 0.0 and not LEAST_V <= median_v <= GREATEST_V:
        factor = 10.0 ** float(np.rint(np.log10(USUAL_V / median_v)))
        text = f"the voltage is {figure(median_v)} V in the median, probably {times(factor)}"
        advice = "correct its scale or unit, or name another signal as the voltage"
        yield error("unit", signal, text, advice, factor)


def full_scale(facts: Facts) -> Findings:
    """Report currents beyond full scale or far below it, after wrong units have been corrected."""
    scale_a, junction = facts.database.layout.full_scale_a, facts.junction
    right = dict(zip(junction.branches, np.abs(junction.multipliers).tolist(), strict=True))
    names = facts.database.layout.branch_names
    values_a = {name: right.get(name, 1.0) * np.abs(good_values(facts.drives, name)) for name in names}
    peaks_a = {name: float(value_a.max(initial=0.0)) for name, value_a in values_a.items()}
    for name, peak_a in peaks_a.items():
        if peak_a > scale_a:
            beyond = f"{np.sum(values_a[name] > scale_a):,} of {len(values_a[name]):,} values"
            text = f"it reaches {figure(peak_a)} A: {beyond} are beyond full_scale_a = {figure(scale_a)} A"
            advice = "raise that to the nominal maximum of the junction, or take wild values out of the recording"
            yield warning("full scale", name, text, advice, peak_a)
    greatest_a = max(peaks_a.values())
    if 0.0 < greatest_a < LEAST_OF_SCALE * scale_a and not junction.stands_still:
        text = f"no branch exceeds {figure(greatest_a)} A, and full_scale_a is {figure(scale_a)} A"
        yield warning("full scale", "all branches", text, "record a drive, or check units and full_scale_a", greatest_a)


CHECKS: Sequence[Callable[[Facts], Findings]] = (
    logs_as_a_whole, counted_twice, absent, late, bad_frames, values, inputs_of_sensors, impossible_voltage,
    full_scale,
)  # fmt: skip


# ---- what can be done next


def readiness(facts: Facts, findings: Sequence[Finding]) -> dict[str, str]:
    """Return for each command, in the order of use, why it is not ready; an empty text if it is ready."""
    errors, junction = [finding.subject for finding in findings if finding.severity == "error"], facts.junction
    wrong = f"of the errors above ({', '.join(dict.fromkeys(errors))})" if errors else ""
    single = () if junction.comparisons else facts.drives  # no drive has all branches, but one may have enough
    refusals = [_refusal(partial(compare_kirchhoff, drive, junction.database)) for drive in single]
    together = "" if junction.comparisons or "" in refusals else next(iter(refusals), "no log has a branch")
    alone = partial(summarise_junction, junction.drives, junction.branches, facts.database)
    return {
        "kirchhoff": together,
        "import": wrong if facts.drives else "no log has a branch",
        "calibrate --trusted": wrong or together or _refusal(alone),
        "calibrate": wrong or together or _for_fleet(facts),
        "ecu-node": wrong or _for_node(facts, Mode.OVERLAY),
        "ecu-node --gateway": wrong or _for_node(facts, Mode.GATEWAY),
    }


def _refusal(command: Callable[[], object]) -> str:
    """Return the message of the error that a command ends with; empty if it succeeds."""
    try:
        command()
    except UserError as error_:
        return str(error_)
    return ""


def _for_fleet(facts: Facts) -> str:
    layout, available = facts.database.layout, {name for drive in facts.drives for name in drive.inputs}
    if not layout.model_inputs:
        return "the layout has no model_inputs ([[input]], [[derived]])"
    kept, lacking = choose_inputs(layout, available)
    if kept and not choose_inputs(layout, available - facts.computed_inputs.keys())[0]:
        return f"model_inputs {why_computed(facts.computed_inputs)}"
    if not kept:
        names = ", ".join(sorted(layout.base_inputs(lacking) - available))
        return f"none of the model_inputs is recorded ({names})"
    if problem := too_slow(facts.junction.database.layout.period_s):
        return problem
    if facts.junction.valid_s < LEAST_DURATION_S:
        has = f"{facts.junction.valid_s:.1f} s"
        return f"the logs of a vehicle of a fleet need {LEAST_DURATION_S:.0f} s together, and these have {has}"
    return ""


def _for_node(facts: Facts, mode: Mode) -> str:
    layout = facts.database.layout
    computed = ", ".join(branch.name for branch in layout.branch if branch.computed)
    if len(layout.dbc_files) != 1 or computed:
        lacks = {0: "the layout names no DBC", 1: f"branch {computed} is computed"}
        return lacks.get(len(layout.dbc_files), "the layout names several buses") + ": it corrects signals of one bus"
    refusal = _refusal(partial(wire, facts.database, InForce(parameters=None), 0.0, mode=mode))
    return refusal.removeprefix(f"{layout.path}: ")
