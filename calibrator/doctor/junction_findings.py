"""Findings from the junction sum: signs, units, delays, gains, and its mean."""

from collections.abc import Iterator, Mapping

import numpy as np

from calibrator.doctor.findings import Finding, Severity
from calibrator.doctor.junction import Gain, JunctionFacts
from calibrator.doctor.multipliers import LEAST_RATIO
from calibrator.drive import Array, Mask
from calibrator.drives.delays import MAX_DELAY_S
from ecu_node.layout import Branch, Layout

__all__ = ["junction_findings"]

LEAST_DELAY_S = 0.02
"""Shorter delays change no result: two frames of a fast message. [s]"""
LONG_DELAY_S = 0.1
"""300 ms bend the gains of the junction law by 3 %; a third of that is worth a warning. [s]"""
SURE = 3.0
"""Standard deviations. [1]"""
LEAST_GAIN, LARGEST_GAIN = 0.02, 0.25
"""Differences of gains that are worth a line, and those beyond what sensors drift. [1]"""
LEAST_SHARE = 0.05
"""Of the greatest branch's variation; a smaller branch's gain is drawn to 0 by its noise. [1]"""
LEAST_MEAN_A, LEAST_MEAN = 0.5, 0.001
"""Means of the sum below half an ampere, or this share of full scale, are not worth a line. [A], [1]"""
LARGE_MEAN = 0.05
"""Of full scale: more than loads without a sensor usually are. [1]"""
NO_SUM = 0.3
"""Share of the variation that is left in the sum, above which branches do not belong together. [1]"""


def junction_findings(facts: JunctionFacts, layout: Layout) -> list[Finding]:
    """Say what the junction sum tells.

    Parameters
    ----------
    facts : JunctionFacts
        Of the branches that were found.
    layout : Layout
        Theirs.

    Returns
    -------
    list of Finding
        Errors (signs, units) before warnings and hints.
    """
    if not len(facts.bands.block):
        return [_too_short(facts)]
    found = [*_wrong(facts, layout), *_rest(facts), *_untold(facts)]
    found += [*_delays(facts), *_gains(facts)]
    if not facts.best.changed:
        found += _mean(facts, layout)
    return found


def _too_short(facts: JunctionFacts) -> Finding:
    return Finding(
        severity=Severity.WARNING,
        kind="too short",
        subject="sum",
        text=f"signs, units and delays cannot be told: no 20 s in which {', '.join(facts.branches)} have no gap",
        remedy="record a minute of driving or more",
    )


def _wrong(facts: JunctionFacts, layout: Layout) -> Iterator[Finding]:
    multipliers = facts.best.multipliers
    if facts.best.changed and np.all(multipliers == -1.0):
        yield _all_turned()
        return
    for k in facts.best.changed:
        branch = layout.find_branch(facts.branches[k])
        if multipliers[k] < 0.0:
            yield _sign(facts, k, branch)
        if abs(multipliers[k]) != 1.0:
            yield _unit(facts, k, branch)


def _all_turned() -> Finding:
    return Finding(
        severity=Severity.ERROR,
        kind="sign",
        subject="all branches",
        text="all signs are inverted: the battery's voltage falls while energy would flow into it",
        remedy="turn the sign of every [[branch]]: currents are positive into the junction, so a battery that is "
        "discharged is positive",
    )


def _sign(facts: JunctionFacts, k: int, branch: Branch) -> Finding:
    before_a, after_a = _before_after(facts, k, -facts.best.multipliers[k])
    return Finding(
        severity=Severity.ERROR,
        kind="sign",
        subject=branch.name,
        text=f"its sign is inverted: the sum of all varies by {before_a:.3g} A (RMS about its mean), and by "
        f"{after_a:.3g} A with the other sign{_or_else(facts)}",
        remedy=f'set sign = {-branch.sign} in the [[branch]] "{branch.name}" of the layout',
        figures={"rms_before_a": before_a, "rms_after_a": after_a},
    )


def _unit(facts: JunctionFacts, k: int, branch: Branch) -> Finding:
    factor = abs(float(facts.best.multipliers[k]))
    before_a, after_a = _before_after(facts, k, np.sign(facts.best.multipliers[k]))
    size = f"{1.0 / factor:g} times too large" if factor < 1.0 else f"{factor:g} times too small"
    return Finding(
        severity=Severity.ERROR,
        kind="unit",
        subject=branch.name,
        text=f"its current is {size}: the sum of all varies by {before_a:.3g} A (RMS about its mean), and by "
        f"{after_a:.3g} A with {branch.name} times {factor:g}{_or_else(facts)}",
        remedy=f"correct scale or unit of {branch.source} in the DBC"
        + (f", or of {branch.voltage}" if branch.voltage else ""),
        figures={"factor": factor, "rms_before_a": before_a, "rms_after_a": after_a},
    )


def _before_after(facts: JunctionFacts, k: int, before: float) -> tuple[float, float]:
    """Variation of the sum with all put right but one branch, and with all put right."""
    wrong = facts.best.multipliers.copy()
    wrong[k] = before
    return facts.bands.rms_a(wrong), facts.bands.rms_a(facts.best.multipliers)


def _or_else(facts: JunctionFacts) -> str:
    """The next best explanation that changes other branches, if there is one."""
    for rival in facts.rivals:
        if rival.changed and not set(rival.changed) & set(facts.best.changed):
            return f" (less likely instead: {_in_words(facts, rival.multipliers)})"
    return ""


def _in_words(facts: JunctionFacts, multipliers: Array) -> str:
    changes = zip(facts.branches, multipliers.tolist(), strict=True)
    return " and ".join(f"{name} times {number:g}" for name, number in changes if number != 1.0)


def _rest(facts: JunctionFacts) -> Iterator[Finding]:
    rest_a = facts.bands.rms_a(facts.best.multipliers)
    all_a = float(np.sqrt(np.sum((facts.best.multipliers * facts.rms_a) ** 2)))
    if all_a > 0.0 and (rest_a / all_a) ** 2 > NO_SUM:
        yield Finding(
            severity=Severity.ERROR,
            kind="sum",
            subject="sum",
            text=f"the currents do not cancel: each for itself they vary by {all_a:.3g} A together, their sum by "
            f"{rest_a:.3g} A, and no other sign or unit helps",
            remedy="check that the signals are direct currents of this junction (not phase currents, limits or "
            "demands), and that no large branch is missing",
            figures={"rms_parts_a": all_a, "rms_sum_a": rest_a},
        )


def _untold(facts: JunctionFacts) -> Iterator[Finding]:
    """Branches of which another sign or unit would do nearly as well."""
    rest_a = facts.bands.rms_a(facts.best.multipliers)
    for k, name in enumerate(facts.branches):
        if k in facts.best.changed or not facts.rms_a[k] > 0.0:
            continue
        if any(set(rival.changed) - set(facts.best.changed) == {k} for rival in facts.rivals) and _is_small(facts, k):
            yield Finding(
                severity=Severity.HINT,
                kind="cannot tell",
                subject=name,
                text=f"its sign and unit cannot be told: it varies by {facts.rms_a[k]:.2g} A, and the sum of all by "
                f"{rest_a:.2g} A",
                remedy="record a drive in which it carries more current",
                figures={"rms_a": float(facts.rms_a[k]), "rms_sum_a": rest_a},
            )


def _is_small(facts: JunctionFacts, k: int) -> bool:
    right_a = facts.rms_a * np.abs(facts.best.multipliers)
    return bool(right_a[k] < LEAST_SHARE * np.max(right_a))


def _delays(facts: JunctionFacts) -> Iterator[Finding]:
    delays = facts.delays
    if delays is None:
        return
    reference = _usual(delays.delay_s, delays.known)
    for k in np.flatnonzero(delays.known):
        late_s = float(delays.delay_s[k] - delays.delay_s[reference])
        sd_s = float(np.hypot(delays.sd_s[k], delays.sd_s[reference]))
        if abs(late_s) < max(LEAST_DELAY_S, SURE * sd_s) or _is_small(facts, facts.branches.index(delays.branches[k])):
            continue
        yield Finding(
            severity=Severity.WARNING if abs(late_s) >= LONG_DELAY_S else Severity.HINT,
            kind="delay",
            subject=delays.branches[k],
            text=f"its frames are {abs(1e3 * late_s):.0f} +- {1e3 * sd_s:.0f} ms {'late' if late_s > 0 else 'early'} "
            f"against {delays.branches[reference]}",
            remedy=f"'calibrate' estimates delays up to {1e3 * MAX_DELAY_S:.0f} ms and takes them out by itself; "
            f"'kirchhoff' and the node's watch do not, so correct the time stamps if the logger made the delay",
            figures={"delay_s": late_s, "sd_s": sd_s},
        )


def _usual(delay_s: Array, known: Mask) -> int:
    """Number of the branch whose delay most of the others share; the first of several."""
    shared = [
        int(np.sum(known & (np.abs(delay_s - delay_s[k]) < LEAST_DELAY_S))) if known[k] else 0
        for k in range(len(delay_s))
    ]
    return int(np.argmax(shared))


def _gains(facts: JunctionFacts) -> Iterator[Finding]:
    if facts.delays is None or not facts.gains:
        return
    first = facts.delays.branches[0]
    large = {
        name: gain
        for name, gain in facts.gains.items()
        if not _is_small(facts, facts.branches.index(name)) and gain.ratio > LEAST_RATIO
    }
    all_gains = {first: Gain(ratio=1.0, sd=0.0)} | large
    usual = min(all_gains, key=lambda name: len(_off(all_gains, name)))
    for name, gain in _off(all_gains, usual).items():
        percent, sd = 100.0 * (1.0 / gain.ratio - 1.0), 100.0 * gain.sd / gain.ratio**2
        far = abs(gain.ratio - 1.0) > LARGEST_GAIN
        yield Finding(
            severity=Severity.WARNING if far else Severity.HINT,
            kind="gain",
            subject=name,
            text=f"it shows {abs(percent):.1f} +- {sd:.2g} % {'more' if percent > 0.0 else 'less'} current "
            f"than {usual} leaves for it",
            remedy="more than sensors drift: check the scales of both in the DBC, and that no branch is missing"
            if far
            else "which of the two is off, 'calibrate' finds by comparing the vehicle with its fleet",
            figures={"percent": percent, "sd_percent": sd},
        )


def _off(gains: Mapping[str, Gain], reference: str) -> dict[str, Gain]:
    """Branches whose gain differs surely from that of one of them, with their gain beside it."""
    by = gains[reference]
    beside = {
        name: Gain(ratio=gain.ratio / by.ratio, sd=float(np.hypot(gain.sd, by.sd)) / by.ratio)
        for name, gain in gains.items()
        if name != reference
    }
    return {name: g for name, g in beside.items() if abs(g.ratio - 1.0) > max(LEAST_GAIN, SURE * g.sd)}


def _mean(facts: JunctionFacts, layout: Layout) -> Iterator[Finding]:
    total, load = facts.total, layout.unmeasured_load
    if total is None:
        return
    declared_a = load.mean_a if load is not None else 0.0
    unexplained_a = abs(total.mean_a - declared_a)
    spread_a = SURE * load.sd_a if load is not None else 0.0
    if unexplained_a < max(LEAST_MEAN_A, LEAST_MEAN * layout.full_scale_a, spread_a):
        return
    beside = f" ({declared_a:g} A are declared as a load)" if load is not None else ""
    yield Finding(
        severity=Severity.WARNING if unexplained_a > LARGE_MEAN * layout.full_scale_a else Severity.HINT,
        kind="mean",
        subject="sum",
        text=f"it is {total.mean_a:.1f} A in the mean{beside}, and varies by {total.sd_a:.1f} A about it",
        remedy="loads that no branch measures, or offsets of sensors: 'calibrate' tells them apart by the fleet; "
        + ("look at the load declared in [unmeasured_load]" if load else "if it is known, say so in [unmeasured_load]"),
        figures={"mean_a": total.mean_a, "sd_a": total.sd_a},
    )
