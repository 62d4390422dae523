"""Findings from single branches, inputs and logs: missing, late, spoilt, clipped, constant, stuck."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from calibrator.doctor.channel_facts import ChannelFacts
from calibrator.doctor.findings import Finding, Severity
from calibrator.doctor.read_logs import MOST_MINUTES, ReadLog
from calibrator.doctor.stuck import Stuck
from calibrator.drives.align import TIME_RESOLUTION_S
from ecu_node.layout import Layout

__all__ = ["branch_findings", "input_findings", "log_findings", "scale_findings", "stuck_finding"]

MANY_BAD, SOME_BAD = 0.05, 0.001
"""Shares of frames that cannot be used: worth a warning, worth a hint. [1]"""
TIMEOUT_PERIODS = 5.0
"""A time-out of this many periods bridges some lost frames. [1]"""
LEAST_OF_SCALE = 0.02
"""Greatest current seen, as a share of full scale, below which one of the two is probably wrong. [1]"""


def branch_findings(facts: ChannelFacts, layout: Layout) -> list[Finding]:
    """Say what is wrong with one branch by itself.

    Parameters
    ----------
    facts : ChannelFacts
        Of the branch.
    layout : Layout
        Its time-out and full scale.

    Returns
    -------
    list of Finding
        Empty if it is sound.
    """
    if not facts.frames:
        return [_absent(facts)]
    timeout_s = layout.find_branch(facts.name).timeout_s
    checks: Sequence[Callable[[ChannelFacts], Iterator[Finding]]] = (_bad, _clipped, _constant, _same_time)
    return [*_late(facts, timeout_s), *(finding for check in checks for finding in check(facts))]


def input_findings(facts: ChannelFacts, *, needed: bool) -> list[Finding]:
    """Say what is wrong with one input; `needed` if a model input is made of it."""
    if not facts.frames:
        return [
            Finding(
                severity=Severity.WARNING if needed else Severity.HINT,
                kind="not in log",
                subject=facts.name,
                text=f"no frame of {facts.signal} in the logs",
                remedy="record the bus that carries it"
                + (", or name other inputs: without it what is derived from it is left out" if needed else ""),
            )
        ]
    if not needed:
        return [replace(finding, severity=Severity.HINT) for finding in _bad(facts)]
    spoilt = [
        replace(finding, severity=max(finding.severity, Severity.WARNING, key=_MILDER)) for finding in _bad(facts)
    ]
    return [*spoilt, *_constant(facts)]


_MILDER = list(Severity).index
"""Of two severities the greater number is the milder one."""


def _absent(facts: ChannelFacts) -> Finding:
    return Finding(
        severity=Severity.WARNING,
        kind="not in log",
        subject=facts.name,
        text=f"no frame of {facts.signal} in the logs",
        remedy="record the bus that carries it; if the vehicle does not have it, it may stay in the layout",
    )


def _late(facts: ChannelFacts, timeout_s: float) -> Iterator[Finding]:
    if facts.period_s > timeout_s + TIME_RESOLUTION_S:
        yield Finding(
            severity=Severity.ERROR,
            kind="rate",
            subject=facts.name,
            text=f"its frames are {facts.period_s:.3g} s apart, and timeout_s is {timeout_s:g} s: it is always stale",
            remedy=f'set timeout_s = {TIMEOUT_PERIODS * facts.period_s:.1g} in the [[branch]] "{facts.name}"',
            figures={"period_s": facts.period_s, "timeout_s": timeout_s},
        )
    elif facts.late:
        yield Finding(
            severity=Severity.WARNING,
            kind="gap",
            subject=facts.name,
            text=f"{facts.late} gaps longer than timeout_s = {timeout_s:g} s, the longest of {facts.gap_s:.3g} s",
            remedy="instants in gaps are left out; record without loss, or raise timeout_s if its frames come rarely",
            figures={"gaps": facts.late, "longest_s": facts.gap_s},
        )


def _bad(facts: ChannelFacts) -> Iterator[Finding]:
    share = facts.bad_frames / facts.frames
    if share < SOME_BAD:
        return
    reasons = ", ".join(f"{reason} {count}" for reason, count in facts.bad.items())
    severity = Severity.WARNING if share >= MANY_BAD else Severity.HINT
    yield Finding(
        severity=severity if facts.good else Severity.ERROR,
        kind="bad frames",
        subject=facts.name,
        text=f"{100.0 * share:.3g} % of {facts.frames} frames cannot be used: {reasons}",
        remedy=_BAD_REMEDY[max(facts.bad, key=lambda reason: facts.bad[reason])],
        figures={"share": share},
    )


_BAD_REMEDY = {
    "E2E check failed": "check profile and data identifiers in [e2e] of the layout",
    "too short": "the frames are shorter than the DBC says: take the DBC of this vehicle",
    "not available": "its control unit says that it has no value: choose another signal, or record while it is awake",
    "out of range": "values lie outside [minimum|maximum] of the DBC: correct the range, or choose another signal",
    "no voltage": "there is no fresh voltage to divide by: choose another voltage, or raise timeout_s",
}


def _clipped(facts: ChannelFacts) -> Iterator[Finding]:
    if facts.clipped:
        yield Finding(
            severity=Severity.WARNING,
            kind="clipped",
            subject=facts.name,
            text=f"{facts.clipped} frames stand at the end of what {facts.signal} can show; its range is "
            f"{facts.low:.4g} to {facts.high:.4g} {facts.unit}",
            remedy="the true current was greater: choose a signal of a wider range, or correct the range in the DBC",
            figures={"frames": facts.clipped},
        )


def _constant(facts: ChannelFacts) -> Iterator[Finding]:
    if facts.good and not facts.moves:
        yield Finding(
            severity=Severity.WARNING,
            kind="constant",
            subject=facts.name,
            text=f"it never changes: {facts.low:.4g} {facts.unit} in all of {facts.good} frames",
            remedy="check that it is the right signal; nothing can be told of it from these logs",
            figures={"value": facts.low},
        )


def _same_time(facts: ChannelFacts) -> Iterator[Finding]:
    if facts.same_time:
        yield Finding(
            severity=Severity.HINT,
            kind="time",
            subject=facts.name,
            text=f"{facts.same_time} frames have the time stamp of the frame before",
            remedy="of several at one instant the last counts; is the log recorded twice, or its clock coarse?",
            figures={"frames": facts.same_time},
        )


def stuck_finding(stuck: Stuck) -> Finding:
    """Say that a branch stood still while the others moved."""
    return Finding(
        severity=Severity.WARNING,
        kind="stuck",
        subject=stuck.branch,
        text=f"it stands at {stuck.value_a:.4g} A for {stuck.duration_s:.0f} s from {stuck.start_s:.0f} s on, while "
        f"the others' sum varies by {stuck.others_a:.3g} A",
        remedy="a frozen sensor or control unit: leave that part of the log out",
        figures={"start_s": stuck.start_s, "duration_s": stuck.duration_s, "value_a": stuck.value_a},
    )


def scale_findings(facts: Sequence[ChannelFacts], layout: Layout) -> Iterator[Finding]:
    """Compare what was seen with the layout's full scale."""
    seen = {item.name: max(abs(item.low), abs(item.high)) for item in facts if item.good}
    for name, peak_a in seen.items():
        if peak_a > layout.full_scale_a:
            yield Finding(
                severity=Severity.WARNING,
                kind="full scale",
                subject=name,
                text=f"it reaches {peak_a:.4g} A, and full_scale_a is {layout.full_scale_a:g} A",
                remedy="raise full_scale_a in the layout to the nominal maximum of the junction, if the value is right",
                figures={"peak_a": peak_a},
            )
    if seen and max(seen.values()) < LEAST_OF_SCALE * layout.full_scale_a:
        yield Finding(
            severity=Severity.WARNING,
            kind="full scale",
            subject="all branches",
            text=f"no branch exceeds {max(seen.values()):.3g} A, and full_scale_a is {layout.full_scale_a:g} A",
            remedy="record a drive, or check units and full_scale_a",
            figures={"peak_a": float(np.max(list(seen.values())))},
        )


def log_findings(log: ReadLog, *, alone: bool) -> Iterator[Finding]:
    """Say what is wrong with one log as a whole; `alone` if no other log has a branch either."""

    def found(severity: Severity, kind: str, text: str, remedy: str, count: int) -> Finding:
        return Finding(
            severity=severity, kind=kind, subject=log.name, text=text, remedy=remedy, figures={"count": count}
        )

    if log.drive is None:
        why, _, remedy = log.why_no_drive.removeprefix(f"{log.name}: ").rpartition("; ")
        yield found(Severity.ERROR if alone else Severity.WARNING, "no branch", why, remedy, 0)
    if log.cut:
        text = f"only its first {MOST_MINUTES:g} minutes were looked at"
        yield found(Severity.HINT, "length", text, "they tell enough of a layout", 0)
    if steps := log.time.clock_steps:
        text = f"its clock was set {steps} times"
        yield found(Severity.WARNING, "time", text, "each step becomes a gap; record with a steady clock", steps)
    if count := log.time.disordered:
        text = f"{count} of {len(log.frames)} frames come with an earlier time stamp than one before them"
        yield found(Severity.HINT, "time", text, "they are sorted; nothing has to be done", count)
    if count := log.frames.damaged:
        text = f"{count} damaged lines or frames"
        yield found(Severity.HINT, "damage", text, "they are left out; nothing has to be done", count)
    if count := log.frames.error_frames:
        text = f"{count} error frames"
        yield found(Severity.HINT, "error frames", text, "look at the wiring and bit rate of the logger", count)
