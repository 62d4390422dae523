"""``calibrator doctor``: what can be used of a layout and of logs, what is wrong with them, and what to do."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibrator.files.layout_files import checked_layout
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import JsonOption, LayoutOption
from calibrator.terminal.text import counted, dumps, figure, table
from ecu_node.program import write_output

if TYPE_CHECKING:
    from calibrator.doctor.facts import Facts
    from calibrator.findings import Finding

__all__ = ["doctor", "doctor_json", "doctor_text"]


def doctor(
    layout: LayoutOption,
    log: Annotated[list[Path], typer.Option("--log", metavar="PATH", help="Log or table of the vehicle.")],
    json: JsonOption = False,
) -> None:
    """Tell what of a layout and of logs can be used, what is wrong with it, and what to do.

    Looks at frames, gaps and values of every branch and input, and at the sum of the currents: inverted signs, slips of
    units, delays. Exit code 1 if there is an error among the findings.
    """
    with importing():
        from calibrator.doctor.checks import findings_of, readiness
        from calibrator.doctor.facts import facts_of

    facts = facts_of(checked_layout(layout), log)
    findings = findings_of(facts)
    steps = readiness(facts, findings)
    if json:
        write_output(doctor_json(facts, findings, steps))
    else:
        write_output(doctor_text(facts, findings, steps))
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(1)


def doctor_text(facts: "Facts", findings: Sequence["Finding"], steps: Mapping[str, str]) -> str:
    """Return the report as text: tables of branches and inputs, findings, which commands are ready; lines may be long.

    `steps`, from :func:`.readiness`, maps each command to why it is not ready, or to an empty text if it is ready.
    """
    seconds, frames = sum(log.duration_s for log in facts.logs), sum(log.report.frames for log in facts.logs)
    reasons: dict[str, list[str]] = {}
    for name, why in steps.items():
        reasons.setdefault(why, []).append(name)
    ready = reasons.pop("", [])
    waits = "; ".join(f"{', '.join(names)} because {why}" for why, names in reasons.items())
    lines = [f"ready for: {', '.join(ready) or 'nothing'}"]
    lines += [f"not ready for: {waits}"] if waits else []
    parts = [
        f"{facts.database.layout.path.name}: {counted(len(facts.logs), 'log')}, {figure(seconds)} s, {frames:,} frames",
        _channels("branch", facts),
        _channels("input", facts),
        "\n".join(finding.line for finding in findings) or "nothing to complain of",
        "\n".join([*lines, *_next_commands(facts, ready)]),
    ]
    return "\n\n".join(part for part in parts if part)


def _next_commands(facts: "Facts", ready: Sequence[str]) -> list[str]:
    from calibrator.estimator.settings import FEWEST_VEHICLES

    layout = f"--layout {shlex.quote(str(facts.database.layout.path))} "
    branches = [facts.database.layout.find_branch(name) for name in facts.junction.branches]
    computed = ", ".join(branch.name for branch in branches if branch.signal is None)
    poor = f" ({computed}: computed from other signals, a poor reference)" if computed else ""
    trusted = next((branch.name for branch in branches if branch.signal is not None), "BRANCH")
    log = shlex.quote(facts.logs[0].name) if len(facts.logs) == 1 else "FOLDER"
    one = f"one vehicle and a sensor you trust{poor}; --load A:SD, what flows where nobody measures, tells offsets"
    many = f"{FEWEST_VEHICLES} vehicles or more"
    lines = {
        "calibrate --trusted": f"{one}: calibrator calibrate {log} {layout}--trusted {trusted} --out result",
        "calibrate": f"{many}: calibrator calibrate FOLDER_OF_VEHICLES {layout}--out result",
    }
    return [text for step, text in lines.items() if step in ready]


def doctor_json(facts: "Facts", findings: Sequence["Finding"], steps: Mapping[str, str]) -> str:
    """Return the report as JSON: branches, inputs, sum, findings, and which commands are ready.

    `steps`, from :func:`.readiness`, maps each command to why it is not ready, or to an empty text if it is ready.
    """
    sum_a, channels = facts.junction.sum_a, facts.channels
    rows = channels.drop(columns=["is_branch", "needed", "good", "elsewhere"]).set_index("name", drop=False)
    total = None
    if len(sum_a):
        instants = sum(len(comparison.valid) for comparison in facts.junction.comparisons)
        total = {"mean_a": float(sum_a.mean()), "sd_a": float(sum_a.std()), "instants": instants, "valid": len(sum_a)}
    report = {
        "layout": str(facts.database.layout.path),
        "logs": [log.name for log in facts.logs],
        "branches": rows[channels.is_branch.to_numpy()].to_dict("index"),
        "inputs": rows[~channels.is_branch.to_numpy()].to_dict("index"),
        "sum": total,
        "findings": findings,
        "ready": [name for name, why in steps.items() if not why],
        "not_ready": {name: why for name, why in steps.items() if why},
    }
    return dumps(report)


def _channels(what: str, facts: "Facts") -> str:
    """Return the table of the branches, or of the inputs with their units; empty if there are none."""
    header = [what, "frames", "Hz", "jitter ms", "gap s", "bad %", "least", "greatest", ""]
    channels, rows = facts.channels, []
    for row in channels[channels.is_branch == (what == "branch")].itertuples():
        rate = 1.0 / row.period_s if row.period_s > 0.0 else math.nan
        bad = 100.0 * sum(row.bad.values()) / max(row.frames, 1)
        values = (rate, 1e3 * row.jitter_s, row.gap_s, bad, row.low, row.high)
        cells = [figure(value) if row.frames else "" for value in values]
        rows.append([row.name, f"{row.frames:,}" if row.frames else "none", *cells, row.unit])
    if what == "input":  # names are longer, and their jitter does not matter
        header, *rows = ([*row[:3], *row[4:]] for row in (header, *rows))
    return table(header, rows) if rows else ""
