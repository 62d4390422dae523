"""The doctor's report as text for people and as JSON for programs."""

import math
import textwrap
from collections.abc import Sequence
from typing import Any

from calibrator.doctor.channel_facts import ChannelFacts
from calibrator.doctor.examine import Examination
from calibrator.doctor.findings import Finding
from calibrator.terminal.text import counted, dumps, table

__all__ = ["examination_json", "examination_text"]

_SEVERITY_WIDTH = 9
_JITTER = 3
"""Column of the jitter."""


def examination_text(found: Examination, width: int | None) -> str:
    """The report for people.

    Parameters
    ----------
    found : Examination
        What was found.
    width : int or None
        Columns of the terminal, into which long lines are folded; None: one line per finding.

    Returns
    -------
    str
        Tables of branches and inputs, findings, and what can be done next.
    """
    parts = [
        _heading(found),
        _channels("branch", found.branches, found.layout.full_scale_a),
        _channels("input", found.inputs, None) if found.inputs else "",
        _explained(found, width),
        "\n".join(_finding(finding, width) for finding in found.findings) or "nothing to complain of",
        "\n".join(_folded(line, width, "  ") for line in found.steps.lines),
    ]
    return "\n\n".join(part for part in parts if part)


def examination_json(found: Examination) -> str:
    """The report for programs: facts by branch and input, findings with their figures, next steps."""
    junction = found.junction
    document: dict[str, Any] = {
        "layout": str(found.layout.path),
        "logs": [log.name for log in found.logs],
        "branches": {facts.name: facts.as_json() for facts in found.branches},
        "inputs": {facts.name: facts.as_json() for facts in found.inputs},
        "explained": found.explained,
        "sum": vars(junction.total) if junction is not None and junction.total is not None else None,
        "findings": [
            {
                "severity": finding.severity.value,
                "kind": finding.kind,
                "subject": finding.subject,
                "text": finding.text,
                "remedy": finding.remedy,
                "figures": finding.figures,
            }
            for finding in found.findings
        ],
        "ready": list(found.steps.ready),
        "not_ready": dict(found.steps.not_ready),
    }
    return dumps(document)


def _heading(found: Examination) -> str:
    seconds = sum(float(log.time.time_s[-1]) for log in found.logs)
    frames = sum(len(log.frames) for log in found.logs)
    return f"{found.layout.path.name}: {counted(len(found.logs), 'log')}, {seconds:.1f} s, {frames} frames"


def _channels(what: str, facts: Sequence[ChannelFacts], full_scale_a: float | None) -> str:
    """Table of branches, or of inputs without jitter and with their units."""
    last = "% of scale" if full_scale_a is not None else "unit"
    header = (what, "frames", "Hz", "jitter ms", "gap s", "bad %", "least", "greatest", last)
    rows = [header, *(_row(item, full_scale_a) for item in facts)]
    if full_scale_a is None:
        rows = [(*row[:_JITTER], *row[_JITTER + 1 :]) for row in rows]
    return table(rows[0], rows[1:])


def _row(facts: ChannelFacts, full_scale_a: float | None) -> tuple[str, ...]:
    if not facts.frames:
        return (facts.name, "none", *[""] * 7)
    last = facts.unit
    if full_scale_a is not None:
        last = _number(100.0 * max(abs(facts.low), abs(facts.high)) / full_scale_a, ".0f")
    return (
        facts.name,
        str(facts.frames),
        _number(1.0 / facts.period_s if facts.period_s > 0.0 else math.nan, ".3g"),
        _number(1e3 * facts.jitter_s, ".1f"),
        _number(facts.gap_s, ".2f"),
        _number(100.0 * facts.bad_frames / facts.frames, ".3g"),
        _number(facts.low, ".4g"),
        _number(facts.high, ".4g"),
        last,
    )


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"


def _explained(found: Examination, width: int | None) -> str:
    if not found.explained:
        return ""
    shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in found.explained.items())
    return _folded(f"of the currents' variation the model inputs explain: {shares}", width, "  ")


def _finding(finding: Finding, width: int | None) -> str:
    return _folded(f"{finding.severity.value:<{_SEVERITY_WIDTH}}{finding.line}", width, " " * _SEVERITY_WIDTH)


def _folded(line: str, width: int | None, indent: str) -> str:
    if width is None:
        return line
    return textwrap.fill(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
