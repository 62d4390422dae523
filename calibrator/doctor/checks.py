"""What the doctor complains of beside the sum of the currents: checks, each a function from the facts to findings.

A new check is one function more in :data:`CHECKS`; those of the sum are in :mod:`calibrator.kirchhoff.findings`.
"""

from collections.abc import Callable, Sequence

from calibrator.doctor.facts import MOST_MINUTES, Facts
from calibrator.drive import Drive
from calibrator.drives.align import base_inputs, choose_inputs
from calibrator.errors import DriveError
from calibrator.estimator.junction import summarise_junction
from calibrator.findings import Finding, worst_first
from calibrator.kirchhoff.findings import Findings, error, hint, sum_findings, times, warning
from calibrator.summaries.vehicle_summary import LEAST_DURATION_S
from calibrator.terminal.text import counted, figure
from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.errors import UserError
from ecu_node.summary import TIME_RESOLUTION_S

__all__ = ["CHECKS", "findings_of", "readiness"]

MANY_BAD, SOME_BAD = 0.05, 0.001
"""Shares of frames that cannot be used: worth a warning, worth a hint. [1]"""
TIMEOUT_PERIODS = 5.0
"""A time-out of this many periods bridges some lost frames. [1]"""
LEAST_OF_SCALE = 0.02
"""Greatest current seen, as a share of full scale, below which one of the two is probably wrong. [1]"""
WELL_EXPLAINED = 0.5
"""Share of a current's variation that model inputs should explain at least. [1]"""


def findings_of(facts: Facts) -> list[Finding]:
    """All findings, errors first."""
    return worst_first([*(each for check in CHECKS for each in check(facts)), *sum_findings(facts.junction)])


def not_in_dbc(facts: Facts) -> Findings:
    """Signals that the DBC lacks."""
    for (what, name), why in facts.missing.items():
        advice = f"correct the signal in the {what} {name}, or take the DBC that belongs to the layout"
        yield (warning if what == "input" else error)("not in DBC", name, why, advice)


def logs_as_a_whole(facts: Facts) -> Findings:
    """Logs of another vehicle, times, damage."""
    nothing = "nothing has to be done"
    for log in facts.logs:
        report = log.report
        if not isinstance(log.drive, Drive):
            what = log.drive.what.removeprefix(f"{log.name}: ")
            yield (warning if facts.drives else error)("no branch", log.name, what, log.drive.remedy)
        if log.cut:
            text = f"only its first {MOST_MINUTES:g} minutes were looked at"
            yield hint("length", log.name, text, "they tell enough of a layout", MOST_MINUTES)
        if count := report.clock_steps:
            text, advice = (
                f"its clock was set {counted(count, 'time')}",
                "each step becomes a gap; record with a steady clock",
            )
            yield warning("time", log.name, text, advice, count)
        if report.unfit:
            text, advice = report.unfit
            yield warning("unfit", log.name, text, advice)
        for number, code, text, advice in (
            (report.disordered, "time", f"of {report.frames:,} frames come with an earlier time stamp than one before "
             "them", f"they are sorted; {nothing}"),
            (report.damaged, "damage", "damaged lines or frames", f"they are left out; {nothing}"),
            (report.error_frames, "error frames", "error frames", "look at the wiring and bit rate of the logger"),
            (sum(report.ignored.values()), "other buses", f"frames of other buses ({', '.join(report.ignored)})",
             f"they are ignored; {nothing}"),
        ):  # fmt: skip
            if number:
                yield hint(code, log.name, f"{number:,} {text}", advice, number)


def absent(facts: Facts) -> Findings:
    """Branches and inputs that no log has."""
    what, where = "frame of", "record the bus that carries it"
    if not facts.layout.dbc_files:
        what, where = "column of numbers", "name the column that has it"
    for item in (*facts.branches, *facts.inputs):
        if item.frames:
            continue
        say, advice = hint, where
        if item in facts.branches:
            say, advice = warning, f"{where}; if the vehicle does not have it, it may stay in the layout"
        elif item.name in facts.needed:
            say, advice = warning, f"{where}, or name other inputs: without it what is derived from it is left out"
        yield say("not in log", item.name, f"no {what} {item.signal} in the logs", advice)


def late(facts: Facts) -> Findings:
    """Frames farther apart than the time-out of a branch."""
    for item in facts.branches:
        timeout_s = facts.layout.find_branch(item.name).timeout_s
        if item.period_s > timeout_s + TIME_RESOLUTION_S:
            apart = f"its frames are {figure(item.period_s)} s apart"
            wanted_s = float(f"{TIMEOUT_PERIODS * item.period_s:.1g}")
            text = f"{apart}, and timeout_s is {timeout_s:g} s: it is always stale"
            yield error(
                "rate", item.name, text, f'set timeout_s = {wanted_s:g} in the [[branch]] "{item.name}"', wanted_s
            )
        elif item.late:
            gaps = "1 gap" if item.late == 1 else f"{item.late:,} gaps"
            text = f"{gaps} longer than timeout_s = {timeout_s:g} s, the longest of {figure(item.gap_s)} s"
            advice = "instants in gaps are left out; record without loss, or raise timeout_s if its frames come rarely"
            yield warning("gap", item.name, text, advice, item.gap_s)


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
        advice = BAD_ADVICE.get(max(item.bad, key=lambda reason: item.bad[reason]), "choose another signal")
        yield say("bad frames", item.name, text, advice, share)


def values(facts: Facts) -> Findings:
    """Values at the end of what a signal can show, and those that never change."""
    for item in facts.branches:
        if item.clipped:
            stand = f"{item.clipped:,} of {item.frames:,} frames stand at the end of what {item.signal} can show"
            text = f"{stand}; it goes from {figure(item.low)} to {figure(item.high)} A"
            advice = "the true current was greater: choose a signal of a wider range, or correct the range in the DBC"
            yield warning("clipped", item.name, text, advice, item.clipped)
    for item in (*facts.branches, *(item for item in facts.inputs if item.name in facts.needed)):
        if item.good and item.low == item.high and not facts.junction.stands_still:
            text = f"it never changes: {figure(item.low)} {item.unit} in all of {item.good:,} frames"
            advice = "check that it is the right signal; nothing can be told of it from these logs"
            yield warning("constant", item.name, text, advice, item.low)


def impossible_voltage(facts: Facts) -> Findings:
    """A voltage that powers are divided by and that no vehicle has: a slip of its unit is every such branch's."""
    if facts.slip is not None:
        signal, median_v, factor = facts.slip
        text = f"the voltage is {figure(median_v)} V in the median, probably {times(factor)}"
        advice = "correct its scale or unit in the DBC, or name another signal as the voltage"
        yield error("unit", signal, text, advice, factor)


def full_scale(facts: Facts) -> Findings:
    """Currents beyond full scale, or far from it."""
    scale_a = facts.layout.full_scale_a
    seen = {item.name: max(abs(item.low), abs(item.high)) for item in facts.branches if item.good}
    for name, peak_a in seen.items():
        if peak_a > scale_a:
            text = f"it reaches {figure(peak_a)} A, and full_scale_a is {figure(scale_a)} A"
            advice = "raise full_scale_a in the layout to the nominal maximum of the junction, if the value is right"
            yield warning("full scale", name, text, advice, peak_a)
    if seen and (most_a := max(seen.values())) < LEAST_OF_SCALE * scale_a and not facts.junction.stands_still:
        text = f"no branch exceeds {figure(most_a)} A, and full_scale_a is {figure(scale_a)} A"
        yield warning("full scale", "all branches", text, "record a drive, or check units and full_scale_a", most_a)


def inputs_matter(facts: Facts) -> Findings:
    """Currents that the model inputs do not explain."""
    where = "(docs/layout.md, 'Inputs matter'): its torque times speed, its demand"
    for name, share in facts.explained.items():
        if share < WELL_EXPLAINED and not facts.junction.stands_still:
            text = f"the model inputs explain {100.0 * share:.0f} % of how its current varies"
            yield warning("inputs", name, text, f"give the model what drives this current {where}", share)


CHECKS: Sequence[Callable[[Facts], Findings]] = (
    not_in_dbc, logs_as_a_whole, absent, late, bad_frames, values, impossible_voltage, full_scale, inputs_matter,
)  # fmt: skip


# ---- what can be done next


def readiness(facts: Facts, findings: Sequence[Finding]) -> dict[str, str]:
    """Commands in the order in which they are used, and for each what is missing; empty where nothing is."""
    errors, names = [finding for finding in findings if finding.severity == "error"], facts.junction.branches
    wrong = f"of the errors above ({', '.join(dict.fromkeys(item.subject for item in errors))})" if errors else ""
    stale = ", ".join(finding.subject for finding in errors if finding.code == "rate")
    together = "" if len(facts.junction.sum_a) else f"at no instant all of {', '.join(names)} are fresh"
    if len(names) < 2:
        together = f"a sum needs two branches with usable frames, and there is {', '.join(names) or 'none'}"
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
        summarise_junction(facts.junction.drives, facts.junction.branches, facts.database)
    except DriveError as error_:
        return str(error_)
    return ""


def _for_fleet(facts: Facts) -> str:
    layout, available = facts.layout, {name for drive in facts.drives for name in drive.inputs}
    if not layout.model_inputs:
        return "the layout has no model_inputs ([[input]], [[derived]])"
    kept, lacking = choose_inputs(layout, available)
    if not kept:
        names = ", ".join(sorted(base_inputs(layout, lacking) - available))
        return f"none of the model_inputs is recorded ({names})"
    if facts.junction.valid_s < LEAST_DURATION_S:
        valid_s = figure(facts.junction.valid_s)
        return f"the logs of a vehicle of a fleet need {LEAST_DURATION_S:.0f} s together, and these have {valid_s} s"
    return ""


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
