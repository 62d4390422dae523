#!/usr/bin/env python3
"""From a fleet to corrected vehicles: drives are calibrated, signed, activated and tried, and what comes out is judged.

Vehicles with known faults drive; the calibrator learns from their drives, two people sign what it found, each vehicle's
node takes its signed file, tries it, and corrects a drive that nobody has seen. Beside each right set two wrong ones
are on trial: with signs turned, and of another vehicle.
"""

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer
from msgspec.structs import replace

from calibrator.artificial.command import MAX_MINUTES, UnmeasuredOption
from calibrator.fleet_truth import VehicleTruth, read_truth
from calibrator.processes.run_many import Workers, run_many
from calibrator.recordings.frames import read_frames
from calibrator.terminal.command_line import command_app, run_tool
from calibrator.terminal.options import (
    MAX_VEHICLES,
    SeedOption,
    WorkersOption,
    number_option,
    whole_option,
)
from calibrator.terminal.progress import shown
from calibrator.terminal.text import dumps, table
from ecu_node.bus.wiring import Mode, branch_signals, key_of, wire
from ecu_node.core.signals import Codes, FrameKey
from ecu_node.core.status import State
from ecu_node.database import read_database
from ecu_node.errors import UserError
from ecu_node.layout import read_layout, split_signal
from ecu_node.parameters import VehicleParameters, read_parameters
from ecu_node.program import write_output
from ecu_node.update.client import provision, update
from ecu_node.update.store import ParameterStore
from ecu_node.update.trial import ParameterTrial

SIGNERS = ("anna", "ben")
LEAST_DIFFERENCE_A = 0.02
"""Errors that differ by less are the same: rounding to the codes of the corrected signal. [A]"""
LOOK_EVERY_S = 0.1
"""As often the node looks at the junction. [s]"""
WRONG = ("signs turned", "of another vehicle")
"""Kinds of wrong sets."""

app = command_app()


@app.command()
def main(
    *,
    layout: Annotated[Path, typer.Option(help="Layout of the vehicles.")] = Path("dbc/hv_powertrain.toml"),
    vehicles: Annotated[int, whole_option("--vehicles", 8, MAX_VEHICLES, "Vehicles of the fleet")] = 500,
    unmeasured: UnmeasuredOption = (0.0, 0.0),
    minutes: Annotated[
        float, number_option("--minutes", 2, MAX_MINUTES, "Least length of each trip to learn from [min]")
    ] = 10.0,
    unseen_minutes: Annotated[
        float, number_option("--unseen-minutes", 2, MAX_MINUTES, "Length of each unseen trip, with trial [min]")
    ] = 10.0,
    seed: SeedOption = 0,
    workers: WorkersOption = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Drive a fleet through the whole chain, and count what became of its vehicles."""
    trial_s = read_layout(layout).activation.trial_s
    if 60.0 * unseen_minutes <= trial_s:
        raise UserError(
            f"--unseen-minutes {unseen_minutes:g}: the trial of {layout} alone takes {trial_s:g} s; give more"
        )
    drawn: dict[str, float] = {
        "vehicles": vehicles,
        "currents": 3,
        "sparsity": 80,
        "seed": seed,
        "delay": 100,
        "workers": workers,
    }
    drawn |= {"minutes": minutes, "unseen-minutes": unseen_minutes}
    with tempfile.TemporaryDirectory(prefix="chain-") as name:
        folder, where = Path(name), ("--layout", layout)
        options = [word for option, value in drawn.items() for word in (f"--{option}", value)]
        pairs = ("--magnitude", 0.02, 0.1, "--unmeasured", *unmeasured)
        _run("simulate", *where, *options, *pairs, "--out", folder / "fleet")
        _run("calibrate", folder / "fleet", *where, "--out", folder / "result", "--workers", workers)
        names = [path.stem for path in sorted((folder / "result" / "params").glob("*.json"))]
        publish(folder)
        driven = run_many(
            partial(drive, folder, layout), zip(names, [*names[1:], names[0]], strict=True), Workers(processes=workers)
        )
        outcomes = pd.DataFrame(shown(driven, "drive, corrected", len(names), "vehicles"))
    counts, errors_a = score(outcomes)
    if as_json:
        figures = {**counts, **{f"{name} a": value for name, value in errors_a.items()}}
        write_output(dumps({name.replace(",", "").replace(" ", "_"): value for name, value in figures.items()}))
        return
    rows = [(name, f"{count}") for name, count in counts.items()]
    rows += [(f"{name} [A]", f"{value:.2f}") for name, value in errors_a.items()]
    ends = [f"{found.vehicle}: {found.end}" for found in outcomes.itertuples() if found.end]
    write_output("\n".join([table(("", ""), rows), *ends]))


def score(outcomes: pd.DataFrame) -> tuple[dict[str, int], dict[str, float]]:
    """How many vehicles came how far, how many wrong sets passed; and the largest errors, median and worst. [A]"""
    corrected = outcomes[outcomes["corrected"]]
    masks = {
        "refused": corrected["refused"],
        "passed their trial": corrected["passed"],
        "deployed": corrected["passed"] & ~corrected["fell_back"],
        "made worse": corrected["worse"],
    }
    for kind in WRONG:
        bad = corrected[f"{kind}: worse"]
        masks |= {f"wrong sets on trial, {kind}": bad, f"of these passed, {kind}": bad & corrected[f"{kind}: passed"]}
    counts = {"vehicles": len(outcomes), "with corrections": len(corrected)}
    tried = corrected[corrected["passed"]]
    errors_a = {
        f"error, {name}, {what}": float(getattr(tried[f"{what}_a"], method)())
        for name, method in (("median", "median"), ("worst", "max"))
        for what in ("measured", "published")
    }
    return counts | {name: int(mask.sum()) for name, mask in masks.items()}, errors_a if len(tried) else {}


def publish(folder: Path) -> None:
    """Two signers make their keys, and publish all parameter files."""
    keys, repository = folder / "keys", folder / "repository"
    for name in SIGNERS:
        _run("repository", "key", name, "--no-passphrase", "--out", keys)
    roles = [(role, name) for role in ("root", "targets", "snapshot", "timestamp") for name in SIGNERS]
    _run("repository", "init", repository, *(w for r, name in roles for w in (f"--{r}", keys / f"{name}.pub")))
    _run("repository", "add", repository, folder / "result" / "params")
    _run("repository", "publish", repository, *(w for name in SIGNERS for w in ("--key", keys / f"{name}.key")))


def drive(folder: Path, layout: Path, names: tuple[str, str]) -> dict[str, Any]:
    """Update a vehicle, and let it drive with its set on trial, and with those that are wrong for it beside it.

    Parameters
    ----------
    folder : Path
        With fleet, result and repository; for the state of the vehicle.
    layout : Path
        Of the fleet.
    names : tuple of str
        Of the vehicle, and of another one.

    Returns
    -------
    dict of str
        What became of it; errors are the largest of its branches on the drive after the trial. [A]
    """
    name, database, now = names[0], read_database(read_layout(layout)), datetime.now(UTC)
    own, others = (read_parameters(folder / "result" / "params" / f"{each}.json") for each in names)
    repository, state = folder / "repository", folder / "states" / name
    corrected = [branch for branch, found in own.branches.items() if found.apply]
    outcome: dict[str, Any] = {"vehicle": name, "corrected": bool(corrected), "end": ""}
    outcome |= dict.fromkeys(("refused", "passed", "fell_back", "worse"), False)
    outcome |= {f"{kind}: {what}": False for kind in WRONG for what in ("passed", "worse")}
    if not corrected:
        return outcome
    provision(state, name, repository / "metadata" / "1.root.json", now)
    try:
        update(state, str(repository), database, now)
    except UserError as error:
        return outcome | {"refused": True, "end": str(error)}
    said: list[str] = []
    store = ParameterStore(state, database, mode=Mode.OVERLAY, say=said.append, now=lambda: datetime.now(UTC))
    corrector = wire(database, store.in_force, 0.0)
    turned = {key: replace(b, drift=-b.drift, offset_a=-b.offset_a) for key, b in own.branches.items()}
    sets = dict(zip(WRONG, (replace(own, branches=turned), replace(others, vehicle=name)), strict=True))
    trials = {kind: ParameterTrial(found, database, corrector.branches) for kind, found in sets.items()}
    branches = {each: database.layout.find_branch(each) for each in own.branches}
    signals = {each: branch_signals(database, branch, Mode.OVERLAY) for each, branch in branches.items()}
    seen: dict[str, list[tuple[float, float, float]]] = {each: [] for each in branches}
    in_force_s, look_s, start_s = float("inf"), LOOK_EVERY_S, None
    for message in read_frames(folder / "fleet" / "unseen" / name / "drive.log.gz").messages():
        start_s = message.timestamp if start_s is None else start_s
        time_s, key = message.timestamp - start_s, FrameKey(message.arbitration_id, message.is_extended_id)
        while look_s <= time_s:
            corrector.look(look_s)
            if store.look(corrector, look_s):
                in_force_s = min(in_force_s, look_s)
            for kind, trial in [*trials.items()]:
                if (result := trial.look(look_s)) is not None:
                    outcome[f"{kind}: passed"] = result.passed
                    del trials[kind]
            look_s += LOOK_EVERY_S
        if key in corrector.sources:
            made = {target.key: target.data for target in corrector.sources[key].answer(message.data, time_s)}
            for each, branch in branches.items():
                if key_of(database.message(split_signal(branch.source)[0])) == key:
                    answer = made[key_of(database.message(split_signal(branch.corrected or branch.source)[0]))]
                    measured_a = _current_a(signals[each].source, message.data)
                    published_a = _current_a(signals[each].target, answer)
                    seen[each].append((time_s, branch.sign * measured_a, branch.sign * published_a))
    truth = read_truth(folder / "fleet" / "truth.json").vehicles[name]
    traces = {each: _trace(rows, truth, each) for each, rows in seen.items()}
    for kind, found in sets.items():
        outcome[f"{kind}: worse"] = _makes_worse(found, traces)
    outcome["passed"], outcome["end"] = in_force_s < float("inf"), next((x for x in said if "its trial" in x), "")
    outcome["fell_back"] = corrector.state()[0] is not State.CORRECTING
    if not outcome["passed"]:
        return outcome | {"end": outcome["end"] or "the trial did not end"}
    after = {each: _errors_a(trace, in_force_s) for each, trace in traces.items()}
    worse = [each for each, errors in after.items() if _is_worse(errors)]
    outcome |= {f"{what}_a": max(after[each][what] for each in corrected) for what in ("measured", "published")}
    fell_back = "passing measured values through after all" if outcome["fell_back"] else ""
    return outcome | {"worse": bool(worse), "end": f"worse: {', '.join(worse)}" if worse else fell_back}


def _current_a(codes: Codes, payload: bytes | bytearray) -> float:
    """Current in a payload in the sensor's sign, NaN where there is none. [A]"""
    code = codes.place.extract(payload)
    is_there = code is not None and codes.is_value(code)
    return float(codes.scale) * code + float(codes.offset) if is_there and code is not None else float("nan")


def _trace(rows: list[tuple[float, float, float]], truth: VehicleTruth, branch: str) -> pd.DataFrame:
    """A branch in each of its frames: time [s], measured, published and true current, that of its known fault. [A]"""
    trace = pd.DataFrame(rows, columns=["second", "measured", "published"])
    return trace.assign(true=(trace["measured"] - truth.offset_a[branch]) / (1.0 + truth.drift[branch]))


def _errors_a(trace: pd.DataFrame, since_s: float = 0.0) -> dict[str, float]:
    """Root mean square errors of means of one second, from a time on [s]; the sensor's noise apart. [A]"""
    part = trace[trace["second"] >= since_s].dropna()
    means = part.groupby(part["second"].astype(int)).mean()
    return {what: float(((means[what] - means["true"]) ** 2).mean() ** 0.5) for what in ("measured", "published")}


def _is_worse(errors_a: Mapping[str, float]) -> bool:
    """Whether what is published is worse, by more than the rounding to its codes."""
    return errors_a["published"] > errors_a["measured"] + LEAST_DIFFERENCE_A


def _makes_worse(parameters: VehicleParameters, traces: Mapping[str, pd.DataFrame]) -> bool:
    """Whether a set would make a branch worse."""
    for name, trace in traces.items():
        fault = parameters.fault(name)
        published = (trace["measured"] - fault.offset_a) / (1.0 + fault.drift)
        if fault.applied and _is_worse(_errors_a(trace.assign(published=published))):
            return True
    return False


def _run(*words: object) -> None:
    """Run a command of the calibrator, with its own progress if it calibrates; its last line if it fails."""
    errors = None if words[0] == "calibrate" else subprocess.PIPE
    command = [sys.executable, "-m", "calibrator", *map(str, words)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=errors, text=True, check=False)
    if done.returncode:
        last = ((done.stderr or "").strip() or done.stdout.strip() or "it said why").splitlines()[-1]
        raise UserError(f"calibrator {words[0]}: ended with {done.returncode}: {last}")


if __name__ == "__main__":
    import trust_chain  # processes of run_many find its functions by this name

    run_tool(trust_chain.app, "trust_chain")
