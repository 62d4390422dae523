#!/usr/bin/env python3
"""Measure again, on one commit, everything that was promised: one table of bar, figure, met or not.

Takes some hours. What a step has measured is kept in the folder, with the commit; the same command goes on from there.
A step that fails, or a figure that is missing, is a row that is not met.
"""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from acceptance.estimation import estimation_promises
from acceptance.row import MissingFigureError, Promise
from acceptance.speed import million_promises, speed_promises
from acceptance.tried import chain_promises, fuzz_promises, promises_of_tests
from calibrator.terminal.command_line import command_app, run_tool
from ecu_node.errors import UserError
from ecu_node.user_files import write_atomically

ROOT = Path(__file__).parents[1]
SHARED_TRIPS = ROOT.parent / "shared" / "data" / "bmw_i3_summer"
PYTHON = sys.executable
LAYOUT = "dbc/hv_powertrain.toml"

app = command_app()


@dataclass(frozen=True, kw_only=True)
class Step:
    """One command, and where its standard output goes."""

    name: str
    command: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict)


@app.command()
def main(
    *,
    out: Annotated[Path, typer.Option("--out", help="Folder of what is measured.")] = Path("build/release"),
    trips: Annotated[Path, typer.Option("--trips", help="Folder of the recorded BMW i3 trips.")] = SHARED_TRIPS,
    only: Annotated[list[str] | None, typer.Option("--only", help="Run only these steps.")] = None,
) -> None:
    """Run all steps that this commit has not run, and print the table; exit code 1 if a row is not met."""
    commit = _commit()
    out.mkdir(parents=True, exist_ok=True)
    steps = list(_steps(out, trips))
    unknown = set(only or ()) - {step.name for step in steps}
    if unknown:
        raise UserError(f"--only {', '.join(sorted(unknown))}: expected some of {', '.join(s.name for s in steps)}")
    for step in steps:
        if not only or step.name in only:
            _run(step, out, commit)
    promises = [promise for judge in _judges(out) for promise in _judged(judge)]
    text = _table(promises, commit)
    write_atomically(out / "release.md", text.encode())
    print(text)
    if not all(promise.met for promise in promises):
        raise typer.Exit(1)


def _steps(out: Path, recorded: Path) -> Iterator[Step]:
    """What measures, in an order that shows the most first."""
    tools = {"PYTHONPATH": "tools"}
    single = {**tools, "OMP_NUM_THREADS": "1"}
    pytest = (PYTHON, "-m", "pytest", "-q")
    yield Step(
        name="tests",
        command=(*pytest, "--numprocesses", "auto", "--dist", "worksteal", f"--junitxml={out / 'tests.xml'}"),
        environment={"HV_REQUIRE_ALL": "1"},
    )
    fleet = str(out / "vcan_fleet")
    yield Step(name="fleet of vcan", command=(PYTHON, "-m", "tests.vcan.calibrated_fleet", fleet))
    yield Step(
        name="vcan",
        command=("tools/with_vcan", *pytest, "tests/vcan", f"--junitxml={out / 'vcan.xml'}"),
        environment={"HV_REQUIRE_ALL": "1", "HV_CALIBRATED_FLEET": fleet},
    )
    yield Step(name="bench", command=(PYTHON, "-m", "bench.all", "--out", str(out / "bench.json")), environment=single)
    trips, layout = str(out / "i3"), ("--layout", LAYOUT)
    yield Step(
        name="trips",
        command=(PYTHON, "tools/import_bmw_i3.py", str(recorded), *layout, "--out", trips),
        environment=tools,
    )
    options = ("--drives", trips, *layout, "--out", str(out / "experiments"))
    yield Step(name="experiments", command=(PYTHON, "-m", "calibrator", "experiment", "all", *options))
    chain = ("--vehicles", "500", "--minutes", "5", "--unseen-minutes", "3", "--unmeasured", "2", "0.5", "--json")
    yield Step(name="chain", command=(PYTHON, "tools/trust_chain.py", *chain), environment=tools)
    yield Step(name="trust fuzz", command=(PYTHON, "-m", "bench.trust_fuzz", "--seed", "7"), environment=tools)
    for seed in ("31", "32"):
        fuzz = (PYTHON, "-m", "bench.node_fuzz", "--frames", "5000000", "--seed", seed)
        yield Step(name=f"node fuzz {seed}", command=fuzz, environment=tools)
    yield Step(name="million", command=(PYTHON, "-m", "bench.fleet_run"), environment=single)


def _judges(out: Path) -> Iterator[Callable[[], Iterator[Promise]]]:
    yield lambda: promises_of_tests(out / "tests.xml", out / "vcan.xml")
    yield lambda: estimation_promises(out / "experiments")
    yield lambda: speed_promises(out / "bench.json")
    yield lambda: million_promises(_output(out, "million"))
    yield lambda: fuzz_promises([_output(out, f"node fuzz {seed}") for seed in (31, 32)], _output(out, "trust fuzz"))
    yield lambda: chain_promises(_output(out, "chain"))


def _judged(judge: Callable[[], Iterator[Promise]]) -> Iterator[Promise]:
    """What a judge says; one more row, not met, if it lacks a figure."""
    try:
        yield from judge()
    except (MissingFigureError, OSError, ValueError) as error:
        yield Promise(what="a figure", bar="is measured", figure=f"missing: {error}", met=False)


def _run(step: Step, out: Path, commit: str) -> None:
    """Run a step unless this commit has; what it prints and how it ended is kept."""
    record = out / f"{step.name.replace(' ', '_')}.json"
    if record.exists() and json.loads(record.read_text(encoding="utf-8"))["commit"] == commit:
        return
    print(f"release check: {step.name}", file=sys.stderr, flush=True)
    start_s = time.monotonic()
    with _output(out, step.name).open("wb") as output:
        code = subprocess.run(
            step.command, cwd=ROOT, stdout=output, env={**os.environ, **step.environment}, check=False
        ).returncode
    found = {"commit": commit, "command": step.command, "code": code, "minutes": (time.monotonic() - start_s) / 60.0}
    write_atomically(record, json.dumps(found, indent=2).encode())


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
    """The table as Markdown, with commit, machine and date."""
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


if __name__ == "__main__":
    run_tool(app, "release_check")
