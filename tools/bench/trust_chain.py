"""The whole chain from a fleet to corrected vehicles: calibrate, sign, activate and try parameters, and judge them.

    python -m bench.trust_chain --vehicles 500        (in tools/)

Vehicles with known faults drive; the calibrator learns from their drives, two people sign what it found, each vehicle's
node takes its signed file, tries it, and corrects an unseen drive. Beside each right set two wrong ones are on trial:
one with its signs turned, and that of another vehicle. Prints how many vehicles came how far, as JSON.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import can
import pandas as pd
import typer
from msgspec.structs import replace

from bench.fleets import calibrator
from bench.published import Publisher
from bench.row import LAYOUT, Row
from calibrator.fleet_truth import VehicleTruth, read_truth
from calibrator.processes.run_many import Workers, run_many
from calibrator.recordings.log_formats import read_frames
from calibrator.recordings.readers import Recording, read_recording
from calibrator.terminal.progress import shown
from ecu_node.bus.wiring import Mode, wire
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import State
from ecu_node.database import read_database
from ecu_node.errors import UserError
from ecu_node.layout import read_layout
from ecu_node.parameters import VehicleParameters, read_parameters
from ecu_node.update.client import provision, update
from ecu_node.update.store import ParameterStore
from ecu_node.update.trial import ParameterTrial

LEAST_DIFFERENCE_A = 0.02
"""Errors that differ by less count as equal, because of the rounding to codes of the corrected signal. [A]"""
LOOK_EVERY_S = 0.1
"""Time between two looks of the node at the junction. [s]"""
WRONG = ("signs_turned", "of_another_vehicle")
"""Kinds of wrong parameter sets: the own one with its signs turned, and that of another vehicle."""


def main(
    *,
    layout: Path = LAYOUT,
    vehicles: int = 500,
    unmeasured: tuple[float, float] = (0.0, 0.0),
    minutes: float = 10.0,
    unseen_minutes: float = 10.0,
    seed: int = 0,
    workers: int = 2,
) -> dict[str, float]:
    """Drive a fleet through the whole chain, and count what became of its vehicles; the counts are printed, too.

    Options are those of calibrator simulate: mean and standard deviation of the load without a sensor [A], least length
    [min] of the trips to learn from and of the unseen trips, on which the trial is made.
    """
    trial_s = read_layout(layout).activation.trial_s
    if 60.0 * unseen_minutes <= trial_s:
        raise typer.BadParameter(f"--unseen-minutes: the trial of {layout} alone takes {trial_s:g} s; give more")
    with tempfile.TemporaryDirectory(prefix="chain-") as name:
        folder = Path(name)
        fleet, result, common = folder / "fleet", folder / "result", ("--layout", layout, "--workers", workers)
        plan = ("--vehicles", vehicles, "--seed", seed, "--minutes", minutes, "--unseen-minutes", unseen_minutes)
        sensors = ("--currents", 3, "--delay", 100, "--unmeasured", *unmeasured)
        faults = ("--sparsity", 80, "--magnitude", 0.02, 0.1)
        simulate = calibrator("simulate", *plan, *sensors, *faults, *common, "--out", fleet)
        for words in (simulate, calibrator("calibrate", fleet, *common, "--out", result)):
            subprocess.run(words, stdout=subprocess.DEVNULL, check=True)
        files = sorted((result / "params").glob("*.json"))
        publisher = Publisher(folder / "repository", people=2)
        publisher.add(files)
        publisher.publish()
        names = [path.stem for path in files]
        pairs = zip(names, [*names[1:], names[0]], strict=True)
        driven = run_many(partial(drive, folder, layout), pairs, Workers(processes=workers))
        outcomes = pd.DataFrame(shown(driven, "drive, corrected", len(names), "vehicles"))
    found = score(outcomes)
    print(json.dumps(found, indent=2))
    return found


def rows(*, quick: bool) -> list[Row]:
    """Drive 100 vehicles through the chain, or few in a quick run."""
    found = main(vehicles=12 if quick else 100)
    share = found["deployed"] / max(found["with_corrections"], 1)
    return [
        Row(name="trial: share of corrections in force", value=share, unit="1"),
        Row(name="trial: corrected vehicles made worse", value=found["made_worse"], unit="1"),
    ]


def score(outcomes: pd.DataFrame) -> dict[str, float]:
    """Count how far vehicles came and how many wrong sets passed; add median and worst of their largest errors. [A]"""
    corrected = outcomes[outcomes["corrected"]]
    tried = corrected[corrected["passed"]]
    found: dict[str, float] = {
        "vehicles": len(outcomes),
        "with_corrections": len(corrected),
        "refused": int(corrected["refused"].sum()),
        "passed_their_trial": len(tried),
        "deployed": int((~tried["fell_back"]).sum()),
        "made_worse": int(corrected["worse"].sum()),
    }
    for kind in WRONG:
        bad = corrected[corrected[f"{kind}: worse"]]
        found[f"wrong_sets_on_trial_{kind}"] = len(bad)
        found[f"of_these_passed_{kind}"] = int(bad[f"{kind}: passed"].sum())
    for what in ("measured", "published") if len(tried) else ():
        found[f"error_median_{what}_a"] = float(tried[f"{what}_a"].median())
        found[f"error_worst_{what}_a"] = float(tried[f"{what}_a"].max())
    return found


def drive(folder: Path, layout: Path, names: tuple[str, str]) -> dict[str, Any]:
    """Update a vehicle, and let it drive with its own set on trial and two wrong ones beside it.

    Parameters
    ----------
    folder : Path
        Folder with fleet, result and repository, in which the state of the vehicle is kept, too.
    layout : Path
        Layout of the fleet.
    names : tuple of str
        Names of the vehicle, and of another one.

    Returns
    -------
    dict of str
        Name of the ``vehicle``; whether it is ``corrected``, its set was ``refused`` or ``passed`` its trial, the node
        ``fell_back``, and a branch got ``worse``; of each wrong set ``KIND: passed`` and ``KIND: worse``. Of a set that
        passed ``measured_a`` and ``published_a``: largest error over the corrected branches after the trial. [A]
    """
    name, database, now = names[0], read_database(read_layout(layout)), datetime.now(UTC)
    own, others = (read_parameters(folder / "result" / "params" / f"{each}.json") for each in names)
    repository, state = folder / "repository", folder / "states" / name
    corrected = [branch for branch, found in own.branches.items() if found.apply]
    outcome: dict[str, Any] = {"vehicle": name, "corrected": bool(corrected)}
    outcome |= dict.fromkeys(("refused", "passed", "fell_back", "worse"), False)
    outcome |= {f"{kind}: {what}": False for kind in WRONG for what in ("passed", "worse")}
    if not corrected:
        return outcome
    provision(state, name, repository / "metadata" / "1.root.json", now)
    try:
        update(state, str(repository), database, now)
    except UserError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return outcome | {"refused": True}
    store = ParameterStore(
        state,
        database,
        mode=Mode.OVERLAY,
        say=lambda _: None,
        now=lambda: datetime.now(UTC),
        background=ThreadPoolExecutor(1),
    )
    corrector = wire(database, store.in_force, 0.0)
    turned = {key: replace(b, drift=-b.drift, offset_a=-b.offset_a) for key, b in own.branches.items()}
    sets = dict(zip(WRONG, (replace(own, branches=turned), replace(others, vehicle=name)), strict=True))
    trials = {kind: ParameterTrial(found, database, corrector.branches) for kind, found in sets.items()}
    passed_s: dict[str, float] = {}
    """Instant at which the own set came into force, or a wrong one passed its trial. [s]"""

    def look(time_s: float) -> None:
        corrector.look(time_s)
        if store.look(corrector, time_s):
            passed_s.setdefault("own", time_s)
        for kind, trial in [*trials.items()]:
            if (result := trial.look(time_s)) is not None:
                del trials[kind]
                if result.passed:
                    passed_s[kind] = time_s

    unseen, driven = folder / "fleet" / "unseen" / name / "drive.log.gz", state / "driven.log"
    _replay(unseen, corrector, look, driven)
    truth = read_truth(folder / "fleet" / "truth.json").vehicles[name]
    traces = _traces(read_recording(driven, database, vehicle=name, name="unseen"), truth)
    driven.unlink()
    outcome |= {f"{kind}: passed": kind in passed_s for kind in WRONG}
    outcome |= {f"{kind}: worse": _makes_worse(found, traces) for kind, found in sets.items()}
    outcome |= {"passed": "own" in passed_s, "fell_back": corrector.state()[0] is not State.CORRECTING}
    if outcome["passed"]:
        after = {branch: _errors_a(trace, passed_s["own"]) for branch, trace in traces.items()}
        outcome["worse"] = any(_is_worse(errors) for errors in after.values())
        outcome |= {f"{what}_a": max(after[each][what] for each in corrected) for what in ("measured", "published")}
    if not outcome["passed"] or outcome["fell_back"] or outcome["worse"]:
        print(f"{name}: {outcome}", file=sys.stderr)
    return outcome


def _replay(drive: Path, corrector: Corrector, look: Callable[[float], None], out: Path) -> None:
    """Play a log to a node, which looks at the junction in between, and record it with the answers."""
    look_s, start_s = LOOK_EVERY_S, None
    with can.Logger(out) as log:
        for message in read_frames(drive).messages():
            start_s = message.timestamp if start_s is None else start_s
            time_s = message.timestamp - start_s
            while look_s <= time_s:
                look(look_s)
                look_s += LOOK_EVERY_S
            log(message)
            source = corrector.sources.get((message.arbitration_id, message.is_extended_id))
            for answer in source.answer(message.data, time_s) if source is not None else ():
                log(can.Message(message.timestamp, *answer.key, channel=message.channel, data=answer.data))


def _traces(driven: Recording, truth: VehicleTruth) -> dict[str, pd.DataFrame]:
    """Return each branch's measured, published and true current, the last by its known fault [A], over time [s]."""
    traces = {}
    for branch, measured in driven.drive.branches.items():
        both = {"measured": measured, "published": driven.corrected[branch]}
        trace = pd.DataFrame({what: pd.Series(one.value, one.time_s)[one.good] for what, one in both.items()})
        traces[branch] = trace.assign(true=(trace["measured"] - truth.offset_a[branch]) / (1.0 + truth.drift[branch]))
    return traces


def _errors_a(trace: pd.DataFrame, since_s: float = 0.0) -> dict[str, float]:
    """Return root mean square errors of means of one second, without the sensor's noise, from a time on [s]. [A]"""
    part = trace.loc[since_s:].dropna()
    means = part.groupby(part.index.astype(int)).mean()
    return {what: float(((means[what] - means["true"]) ** 2).mean() ** 0.5) for what in ("measured", "published")}


def _is_worse(errors_a: Mapping[str, float]) -> bool:
    """Check whether the published current is worse by more than the rounding to its codes."""
    return errors_a["published"] > errors_a["measured"] + LEAST_DIFFERENCE_A


def _makes_worse(parameters: VehicleParameters, traces: Mapping[str, pd.DataFrame]) -> bool:
    """Check whether a set would bring any branch that it corrects farther from its true current."""
    for name, trace in traces.items():
        fault = parameters.fault(name)
        published = (trace["measured"] - fault.offset_a) / (1.0 + fault.drift)
        if fault.applied and _is_worse(_errors_a(trace.assign(published=published))):
            return True
    return False


if __name__ == "__main__":
    from bench import trust_chain  # processes of run_many find its functions by this name

    typer.run(trust_chain.main)
