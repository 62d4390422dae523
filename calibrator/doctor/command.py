"""``calibrator doctor``: what of a user's layout and logs can be used, what is wrong with it, and what to do."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibrator.files.layout_files import chosen_layout
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import DbcOption, JsonOption, LayoutOption
from calibrator.terminal.text import counted, dumps, figure, table
from ecu_node.program import write_output

if TYPE_CHECKING:
    from calibrator.doctor.facts import ChannelFacts, Facts
    from calibrator.findings import Finding

__all__ = ["doctor", "doctor_json", "doctor_text"]

_SEVERITY_WIDTH = 9


def doctor(
    layout: LayoutOption,
    log: Annotated[
        list[Path],
        typer.Option("--log", metavar="PATH", help="Log or table of the vehicle."),
    ],
    dbc: DbcOption = None,
    json: JsonOption = False,
) -> None:
    """Tell what of a layout and of logs can be used, what is wrong with it, and what to do.

    Looks at frames, gaps and values of every branch and input, and at the sum of the currents: inverted signs, slips of
    units, delays. Exit code 1 if there is an error among the findings.
    """
    with importing():
        from calibrator.doctor.checks import findings_of, readiness
        from calibrator.doctor.facts import facts_of

    facts = facts_of(chosen_layout(layout, dbc), log)
    findings = findings_of(facts)
    steps = readiness(facts, findings)
    if json:
        write_output(doctor_json(facts, findings, steps))
    else:
        write_output(doctor_text(facts, findings, steps))
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(1)


def doctor_text(facts: "Facts", findings: Sequence["Finding"], steps: Mapping[str, str]) -> str:
    """Tables of branches and inputs, findings, and what can be done next; long lines are for the terminal to fold."""
    seconds, frames = sum(log.duration_s for log in facts.logs), sum(log.report.frames for log in facts.logs)
    shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in facts.explained.items())
    reasons: dict[str, list[str]] = {}
    for name, why in steps.items():
        reasons.setdefault(why, []).append(name)
    ready = reasons.pop("", [])
    waits = "; ".join(f"{', '.join(names)} because {why}" for why, names in reasons.items())
    lines = [f"ready for: {', '.join(ready) or 'nothing'}"]
    lines += [f"not ready for: {waits}"] if waits else []
    parts = [
        f"{facts.layout.path.name}: {counted(len(facts.logs), 'log')}, {figure(seconds)} s, {frames:,} frames",
        _channels("branch", facts.branches),
        _channels("input", facts.inputs) if facts.inputs else "",
        f"of the currents' variation the model inputs explain: {shares}" if shares else "",
        "\n".join(f"{item.severity.value:<{_SEVERITY_WIDTH}}{item.line}" for item in findings)
        or "nothing to complain of",
        "\n".join([*lines, *_next_commands(facts, ready)]),
    ]
    return "\n\n".join(part for part in parts if part)


def _next_commands(facts: "Facts", ready: Sequence[str]) -> list[str]:
    from calibrator.estimator.settings import FEWEST_VEHICLES

    layout = f"--layout {shlex.quote(str(facts.layout.path))}"
    branches = [facts.layout.find_branch(name) for name in facts.junction.branches]
    computed = ", ".join(branch.name for branch in branches if branch.signal is None)
    poor = f" ({computed}: computed from other signals, a poor reference)" if computed else ""
    trusted = next((branch.name for branch in branches if branch.signal is not None), "BRANCH")
    log = shlex.quote(facts.logs[0].name) if len(facts.logs) == 1 else "FOLDER"
    offsets = "--load A:SD, what flows where nobody measures, tells offsets"
    lines = {
        "calibrate --trusted": f"one vehicle and a sensor you trust{poor}; {offsets}: calibrator calibrate {log} "
        f"{layout} --trusted {trusted} --out result",
        "calibrate": f"{FEWEST_VEHICLES} vehicles or more: calibrator calibrate FOLDER_OF_VEHICLES {layout} "
        f"--out result",
    }
    return [text for step, text in lines.items() if step in ready]


def doctor_json(facts: "Facts", findings: Sequence["Finding"], steps: Mapping[str, str]) -> str:
    """The report for programs: facts by branch and input, findings with their figures, next steps."""
    sum_a, comparisons = facts.junction.sum_a, facts.junction.comparisons
    return dumps(
        {
            "layout": str(facts.layout.path),
            "logs": [log.name for log in facts.logs],
            "branches": {item.name: item for item in facts.branches},
            "inputs": {item.name: item for item in facts.inputs},
            "explained": facts.explained,
            "sum": {
                "mean_a": float(sum_a.mean()),
                "sd_a": float(sum_a.std()),
                "instants": sum(len(comparison.valid) for comparison in comparisons),
                "valid": len(sum_a),
            }
            if len(sum_a)
            else None,
            "findings": findings,
            "ready": [name for name, why in steps.items() if not why],
            "not_ready": {name: why for name, why in steps.items() if why},
        }
    )


def _channels(what: str, facts: Sequence["ChannelFacts"]) -> str:
    """Table of branches, or of inputs with their units."""
    header = [what, "frames", "Hz", "jitter ms", "gap s", "bad %", "least", "greatest", ""]
    rows = [header]
    for item in facts:
        values = (
            1.0 / item.period_s if item.period_s > 0.0 else math.nan,
            1e3 * item.jitter_s,
            item.gap_s,
            100.0 * item.bad_frames / max(item.frames, 1),
            item.low,
            item.high,
        )
        cells = [figure(value) for value in values] if item.frames else [""] * len(values)
        rows.append([item.name, f"{item.frames:,}" if item.frames else "none", *cells, item.unit])
    if what == "input":  # names are longer, and their jitter does not matter
        rows = [[*row[:3], *row[4:]] for row in rows]
    return table(rows[0], rows[1:])
