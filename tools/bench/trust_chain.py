"""From a fleet to corrected vehicles: drives are calibrated, signed, activated and tried, and what comes out is judged.

    python -m bench.trust_chain --vehicles 500        (in tools/)

Vehicles with known faults drive; the calibrator learns from their drives, two people sign what it found, each vehicle's
node takes its signed file, tries it, and corrects a drive that nobody has seen. Beside each right set two wrong ones
are on trial: with signs turned, and of another vehicle. Prints how many vehicles came how far, as JSON.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from msgspec.structs import replace

from bench.published import Publisher
from bench.row import LAYOUT
from calibrator.fleet_truth import VehicleTruth, read_truth
from calibrator.processes.run_many import Workers, run_many
from calibrator.recordings.log_formats import read_frames
from calibrator.terminal.progress import shown
from ecu_node.bus.wiring import Mode, branch_signals, key_of, wire
from ecu_node.core.signals import Codes, FrameKey
from ecu_node.core.status import State
from ecu_node.database import read_database
from ecu_node.errors import UserError
from ecu_node.layout import read_layout, split_signal
from ecu_node.parameters import VehicleParameters, read_parameters
from ecu_node.update.client import provision, update
from ecu_node.update.store import ParameterStore
from ecu_node.update.trial import ParameterTrial

LEAST_DIFFERENCE_A = 0.02
"""Errors that differ by less are the same: rounding to the codes of the corrected signal. [A]"""
LOOK_EVERY_S = 0.1
"""As often the node looks at the junction. [s]"""
WRONG = ("signs_turned", "of_another_vehicle")
"""Kinds of wrong sets."""


def main() -> None:
    """Drive a fleet through the whole chain, and count what became of its vehicles."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--layout", type=Path, default=LAYOUT)
    parser.add_argument("--vehicles", type=int, default=500)
    parser.add_argument("--unmeasured", nargs=2, default=("0", "0"), help="as of calibrator simulate [A]")
    parser.add_argument("--minutes", type=float, default=10.0, help="least length of each trip to learn from [min]")
    parser.add_argument("--unseen-minutes", type=float, default=10.0, help="of each unseen trip, with trial [min]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    trial_s = read_layout(given.layout).activation.trial_s
    if 60.0 * given.unseen_minutes <= trial_s:
        parser.error(f"--unseen-minutes: the trial of {given.layout} alone takes {trial_s:g} s; give more")
    with tempfile.TemporaryDirectory(prefix="chain-") as name:
        print(json.dumps(score(driven_fleet(Path(name), given)), indent=2))


def driven_fleet(folder: Path, given: argparse.Namespace) -> pd.DataFrame:
    """What became of each vehicle of a fleet that is simulated, calibrated, published and driven."""
    fleet, result = folder / "fleet", folder / "result"
    common = ("--layout", given.layout, "--workers", given.workers)
    lengths = ("--minutes", given.minutes, "--unseen-minutes", given.unseen_minutes)
    faults = ("--currents", 3, "--sparsity", 80, "--magnitude", 0.02, 0.1, "--unmeasured", *given.unmeasured)
    some = ("--vehicles", given.vehicles, "--seed", given.seed, "--delay", 100)
    for words in (
        ("simulate", *some, *lengths, *faults, *common, "--out", fleet),
        ("calibrate", fleet, *common, "--out", result),
    ):
        command = [sys.executable, "-m", "calibrator", *map(str, words)]
        subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    files = sorted((result / "params").glob("*.json"))
    publisher = Publisher(folder / "repository", people=2)
    publisher.add(files)
    publisher.publish()
    names = [path.stem for path in files]
    pairs = zip(names, [*names[1:], names[0]], strict=True)
    driven = run_many(partial(drive, folder, given.layout), pairs, Workers(processes=given.workers))
    return pd.DataFrame(shown(driven, "drive, corrected", len(names), "vehicles"))


def score(outcomes: pd.DataFrame) -> dict[str, float]:
    """How many vehicles came how far, how many wrong sets passed; and the largest errors, median and worst. [A]"""
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
    outcome |= {f"{kind}: worse": _makes_worse(found, traces) for kind, found in sets.items()}
    outcome |= {"passed": in_force_s < float("inf"), "fell_back": corrector.state()[0] is not State.CORRECTING}
    if outcome["passed"]:
        after = {each: _errors_a(trace, in_force_s) for each, trace in traces.items()}
        outcome["worse"] = any(_is_worse(errors) for errors in after.values())
        outcome |= {f"{what}_a": max(after[each][what] for each in corrected) for what in ("measured", "published")}
    if not outcome["passed"] or outcome["fell_back"] or outcome["worse"]:
        print(f"{name}: {outcome}", file=sys.stderr)
    return outcome


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


if __name__ == "__main__":
    from bench import trust_chain  # processes of run_many find its functions by this name

    trust_chain.main()
