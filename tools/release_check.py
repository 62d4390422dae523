#!/usr/bin/env python3
"""Measure again, on one commit, everything that was promised: one table of bar, figure, met or not.

Takes some hours. What a step has measured is kept in the folder, and holds as long as the files that it ran say the
same: the same command goes on from there, and a commit that changes documents runs the tests again, and measures
nothing anew. A step that fails is run again the next time; a figure that is missing is a row that is not met.
"""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from acceptance.estimation import estimation_promises
from acceptance.inputs import digest
from acceptance.row import MissingFigureError, Promise
from acceptance.speed import million_promises, speed_promises
from acceptance.steps import BENCHES, Step, bench_file, steps
from acceptance.tried import chain_promises, coverage_promises, fuzz_promises, promises_of_tests
from calibrator.terminal.command_line import command_app, run_tool
from ecu_node.documents import write_atomically
from ecu_node.errors import UserError

ROOT = Path(__file__).parents[1]
SHARED_TRIPS = ROOT.parent / "shared" / "data" / "bmw_i3_summer"

app = command_app()


@app.command()
def main(
    *,
    out: Annotated[Path, typer.Option("--out", help="Folder of what is measured.")] = Path("build/release"),
    trips: Annotated[Path, typer.Option("--trips", help="Folder of the recorded BMW i3 trips.")] = SHARED_TRIPS,
    only: Annotated[list[str] | None, typer.Option("--only", help="Run only these steps.")] = None,
) -> None:
    """Run all steps whose figures this commit does not have, and print the table; exit code 1 if a row is not met."""
    commit = _commit()
    out.mkdir(parents=True, exist_ok=True)
    wanted = list(steps(out, trips))
    unknown = set(only or ()) - {step.name for step in wanted}
    if unknown:
        raise UserError(f"--only {', '.join(sorted(unknown))}: expected some of {', '.join(s.name for s in wanted)}")
    for step in wanted:
        if not only or step.name in only:
            run_step(step, out, commit)
    promises = [promise for judge in _judges(out) for promise in _judged(judge)]
    promises += [
        Promise(what=f"step {step.name!r}", bar="was run on these files", figure="was not", met=False)
        for step in wanted
        if not holds(step, out)
    ]
    text = _table(promises, commit) + steps_table([step for step in wanted if holds(step, out)], out)
    write_atomically(out / "release.md", text.encode())
    print(text)
    if not all(promise.met for promise in promises):
        raise typer.Exit(1)


def _judges(out: Path) -> Iterator[Callable[[], Iterator[Promise]]]:
    yield lambda: promises_of_tests(out / "tests.xml", out / "vcan.xml")
    yield lambda: coverage_promises(out / "coverage.json")
    yield lambda: estimation_promises(out / "experiments")
    yield lambda: speed_promises(*(bench_file(out, name) for name in BENCHES))
    yield lambda: million_promises(_output(out, "million"))
    yield lambda: fuzz_promises([_output(out, f"node fuzz {seed}") for seed in (31, 32)], _output(out, "update fuzz"))
    yield lambda: chain_promises(_output(out, "chain"))


def _judged(judge: Callable[[], Iterator[Promise]]) -> Iterator[Promise]:
    """What a judge says; one more row, not met, if it lacks a figure."""
    try:
        yield from judge()
    except (MissingFigureError, OSError, ValueError, LookupError, TypeError) as error:
        yield Promise(what="a figure", bar="is measured", figure=f"missing: {error}", met=False)


def run_step(step: Step, out: Path, commit: str) -> None:
    """Run a step unless its figures hold; what it prints and how it ended is kept."""
    if holds(step, out):
        return
    print(f"release check: {step.name}", file=sys.stderr, flush=True)
    for name in (step.name, *step.feeds):
        _record(name, out).unlink(missing_ok=True)
    inputs = digest(ROOT, step.runs)
    start_s = time.monotonic()
    with _output(out, step.name).open("wb") as output:
        code = subprocess.run(
            step.command, cwd=ROOT, stdout=output, env={**os.environ, **step.environment}, check=False
        ).returncode
    minutes = (time.monotonic() - start_s) / 60.0
    found = {"commit": commit, "inputs": inputs, "command": step.command, "code": code}
    if digest(ROOT, step.runs) != inputs:
        raise UserError(f"{ROOT}: files of step {step.name!r} changed while it ran; run it again on one commit")
    write_atomically(_record(step.name, out), json.dumps({**found, "minutes": minutes}, indent=2).encode())


def holds(step: Step, out: Path) -> bool:
    """Whether a step did what it was to do, on files like those of this commit."""
    if not _record(step.name, out).exists():
        return False
    found = json.loads(_record(step.name, out).read_bytes())
    return bool(
        found["code"] == 0 and found["command"] == [*step.command] and found["inputs"] == digest(ROOT, step.runs)
    )


def _record(name: str, out: Path) -> Path:
    return out / f"{name.replace(' ', '_')}.step.json"


def _output(out: Path, name: str) -> Path:
    return out / f"{name.replace(' ', '_')}.txt"


def _commit() -> str:
    """The commit that is checked out; UserError if there are changes beside it."""
    changed = subprocess.run(
        ("git", "status", "--porcelain"), cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    if changed:
        raise UserError(f"{ROOT}: changes that are not committed; figures are of one commit: commit them first")
    return subprocess.run(
        ("git", "rev-parse", "HEAD"), cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.strip()


def _table(promises: list[Promise], commit: str) -> str:
    """The promises as Markdown, with commit, machine and date."""
    met = sum(promise.met for promise in promises)
    cells = [(promise.what, promise.bar, promise.figure, "yes" if promise.met else "**no**") for promise in promises]
    lines = [
        f"Commit {commit[:12]}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"{datetime.now(UTC):%Y-%m-%d}: {met} of {len(promises)} met.",
        "",
        "| what | bar | figure | met |",
        "|---|---|---|---|",
        *(f"| {' | '.join(row)} |" for row in cells),
        "",
    ]
    return "\n".join(lines)


def steps_table(measured: list[Step], out: Path) -> str:
    """How long each step took, and at which commit; an earlier one has files that are the same."""
    records = [(step.name, json.loads(_record(step.name, out).read_bytes())) for step in measured]
    lines = [
        "",
        "| step | minutes | measured at commit |",
        "|---|---:|---|",
        *(f"| {name} | {record['minutes']:.1f} | {record['commit'][:12]} |" for name, record in records),
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    run_tool(app, "release_check")
