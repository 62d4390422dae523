#!/usr/bin/env python3
"""From a fleet to corrected vehicles: drives are calibrated, signed, activated and tried, and what comes out is judged.

Vehicles with known faults drive; the calibrator learns from their drives, two people sign what it found, each vehicle's
node takes its signed file, tries it, and corrects a drive that nobody has seen. Beside each right set two wrong ones
are on trial: with signs turned, and of another vehicle.
"""

import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer
from msgspec.structs import replace

from calibrator.artificial.command import MAX_MINUTES, CurrentsOption, UnmeasuredOption
from calibrator.artificial.simulate import (
    FleetPlan,
    Vehicle,
    draw_vehicles,
    trip_of,
    vehicle_currents,
    vehicle_drive,
    vehicle_frames,
)
from calibrator.artificial.trips import GroundTruth, TripPurpose, TripSource, choose_branches, choose_trips
from calibrator.drive import Array
from calibrator.drives.store import write_drive
from calibrator.processes.run_many import Workers, run_many
from calibrator.random_streams import Purpose, random_stream
from calibrator.terminal.command_line import command_app, run_tool
from calibrator.terminal.options import (
    MAX_VEHICLES,
    SeedOption,
    SparsityOption,
    WorkersOption,
    number_option,
    whole_option,
)
from calibrator.terminal.progress import shown
from calibrator.terminal.text import dumps, table
from ecu_node.bus.wiring import InForce, Mode, branch_signals, key_of, sensor_fault, wire
from ecu_node.core.signals import Codes, FrameKey
from ecu_node.core.status import State
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import UserError
from ecu_node.layout import read_layout, split_signal
from ecu_node.parameters import VehicleParameters, read_parameters
from ecu_node.program import write_output
from ecu_node.update.client import provision, update
from ecu_node.update.store import ParameterStore
from ecu_node.update.trial import ParameterTrial

SIGNERS = ("anna", "ben")
UNSEEN_STREAM = 1
"""Second part of the seed of the frames of an unseen drive; those of the drive to learn from have none."""
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
    drives: Annotated[str, typer.Option(help="Drive store with the trips to drive, or 'builtin'.")] = "builtin",
    vehicles: Annotated[int, whole_option("--vehicles", 8, MAX_VEHICLES, "Vehicles of the fleet")] = 500,
    currents: CurrentsOption = 3,
    sparsity: SparsityOption = 80,
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
    database, unseen_s = read_database(read_layout(layout)), 60.0 * unseen_minutes
    if unseen_s <= (trial_s := database.layout.activation.trial_s):
        raise UserError(
            f"--unseen-minutes {unseen_minutes:g}: the trial of {layout} alone takes {trial_s:g} s; give more"
        )
    trips = choose_trips(
        drives,
        database.layout,
        vehicles=vehicles,
        seed=seed,
        duration_s=60.0 * minutes,
        unseen_s=unseen_s,
        common=False,
    )
    plan = FleetPlan(
        vehicles=vehicles,
        currents=currents,
        sparsity=sparsity,
        magnitude=(0.02, 0.1),
        delay_max_s=0.1,
        unmeasured_a=unmeasured,
        seed=seed,
    )
    drawn = draw_vehicles(plan, database.layout, choose_branches(database.layout, trips.branches, currents))
    with tempfile.TemporaryDirectory(prefix="chain-") as folder:
        chain = Chain(database=database, trips=trips, vehicles=drawn, unseen_s=unseen_s, seed=seed, folder=Path(folder))
        outcomes = pd.DataFrame(chain.run(workers))
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


@dataclass(frozen=True, kw_only=True)
class Chain:
    """A fleet, what it drives, and the folder in which all of it is made.

    Attributes
    ----------
    database : VehicleDatabase
        DBC and layout.
    trips : TripSource
        What the vehicles drive.
    vehicles : sequence of Vehicle
        With what is wrong with each.
    unseen_s : float
        Length of an unseen trip. [s]
    seed : int
        Of everything.
    folder : Path
        Empty; for drives, parameters, keys, repository and the states of the vehicles.
    """

    database: VehicleDatabase
    trips: TripSource
    vehicles: Sequence[Vehicle]
    unseen_s: float
    seed: int
    folder: Path

    def run(self, workers: int) -> list[dict[str, Any]]:
        """Take the fleet from its drives to corrected vehicles; what became of each."""
        count, pool = len(self.vehicles), Workers(processes=workers)
        for _ in shown(run_many(self.write_drive, range(count), pool), "drive, to learn from", count, "vehicles"):
            pass
        result, layout = self.folder / "result", self.database.layout.path
        _run("calibrate", self.folder / "drives", "--layout", layout, "--out", result, "--workers", workers)
        files = [result / "params" / f"{vehicle.name}.json" for vehicle in self.vehicles]
        calibrated = [number for number, path in enumerate(files) if path.exists()]
        keys, repository = self.folder / "keys", self.folder / "repository"
        for name in SIGNERS:
            _run("repository", "key", name, "--no-passphrase", "--out", keys)
        roles = [(role, name) for role in ("root", "targets", "snapshot", "timestamp") for name in SIGNERS]
        _run("repository", "init", repository, *(w for r, name in roles for w in (f"--{r}", keys / f"{name}.pub")))
        _run("repository", "add", repository, *(files[number] for number in calibrated))
        _run("repository", "publish", repository, *(w for name in SIGNERS for w in ("--key", keys / f"{name}.key")))
        others = [*calibrated[1:], *calibrated[:1]]
        driven = run_many(self.drive, zip(calibrated, others, strict=True), pool)
        return list(shown(driven, "drive, corrected", len(calibrated), "vehicles"))

    def trip(self, number: int, purpose: TripPurpose) -> GroundTruth:
        """Trip of a vehicle, with its branches alone; an unseen one ends when it is long enough."""
        whole = trip_of(self.trips, self.vehicles[number], number, purpose, self.database.layout)
        return whole.part(0, round(self.unseen_s / whole.period_s)) if purpose == "unseen" else whole

    def write_drive(self, number: int) -> None:
        """Write the drive that is learnt from of one vehicle."""
        rng, trip = random_stream(Purpose.FRAMES, self.seed, number), self.trip(number, "calibration")
        drive = vehicle_drive(rng, self.database, self.vehicles[number], trip)
        write_drive(self.folder / "drives", drive, self.database.layout)

    def drive(self, numbers: tuple[int, int]) -> dict[str, Any]:
        """Update a vehicle, and let it drive with its set on trial, and with those that are wrong for it beside it.

        Parameters
        ----------
        numbers : tuple of int
            Of the vehicle, and of another one.

        Returns
        -------
        dict of str
            What became of it; errors are the largest of its branches on the drive after the trial. [A]
        """
        (number, other), database, now = numbers, self.database, datetime.now(UTC)
        own, others = (self._parameters(each) for each in (number, other))
        name, repository, state = own.vehicle, self.folder / "repository", self.folder / "states" / own.vehicle
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
        in_force_s = float("inf")
        vehicle, trip = self.vehicles[number], self.trip(number, "unseen")
        rng = random_stream(Purpose.FRAMES, self.seed, number, UNSEEN_STREAM)
        series = {FrameKey(item.arbitration_id, item.extended): item
                  for item in vehicle_frames(rng, database, vehicle, trip)}  # fmt: skip
        frames = sorted(
            (time_s, key, payload.tobytes())
            for key, item in series.items()
            if key in corrector.sources
            for time_s, payload in zip(item.time_s.tolist(), item.data, strict=True)
        )
        published: dict[FrameKey, list[bytes]] = {key: [] for key in series}
        look_s = LOOK_EVERY_S
        for time_s, key, payload in frames:
            while look_s <= time_s:
                corrector.look(look_s)
                if store.look(corrector, look_s):
                    in_force_s = min(in_force_s, look_s)
                for kind, trial in [*trials.items()]:
                    if (result := trial.look(look_s)) is not None:
                        outcome[f"{kind}: passed"] = result.passed
                        del trials[kind]
                look_s += LOOK_EVERY_S
            answers = corrector.sources[key].answer(bytearray(payload), time_s)
            published[key] += [bytes(target.data) for target in answers]
        traces = {}
        for k, branch in enumerate(map(database.layout.find_branch, vehicle.branches)):
            key, signals = (
                key_of(database.message(split_signal(branch.source)[0])),
                branch_signals(database, branch, Mode.OVERLAY),
            )
            seen_s = series[key].time_s - vehicle.delay_s[k]
            traces[branch.name] = pd.DataFrame({
                "second": series[key].time_s,
                "true": np.interp(seen_s, trip.time_s, vehicle_currents(vehicle, trip)[:, k]),
                "measured": _currents_a(signals.source, branch.sign, [row.tobytes() for row in series[key].data]),
                "published": _currents_a(signals.target, branch.sign, published[key]),
            })  # fmt: skip
        for kind, found in sets.items():
            outcome[f"{kind}: worse"] = _makes_worse(found, traces)
        outcome["passed"], outcome["end"] = in_force_s < float("inf"), next((x for x in said if "its trial" in x), "")
        outcome["fell_back"] = corrector.state()[0] is not State.CORRECTING
        if not outcome["passed"]:
            return outcome | {"end": outcome["end"] or "the trial did not end"}
        after = {name: _errors_a(trace, in_force_s) for name, trace in traces.items()}
        worse = [name for name, errors in after.items() if _is_worse(errors)]
        outcome |= {"worse": bool(worse), **{f"{what}_a": max(after[name][what] for name in corrected)
                                            for what in ("measured", "published")}}  # fmt: skip
        fell_back = "passing measured values through after all" if outcome["fell_back"] else ""
        return outcome | {"end": f"worse: {', '.join(worse)}" if worse else fell_back}

    def _parameters(self, number: int) -> VehicleParameters:
        return read_parameters(self.folder / "result" / "params" / f"{self.vehicles[number].name}.json")


def _currents_a(codes: Codes, sign: int, payloads: Sequence[bytes]) -> Array:
    """Currents into the junction in the frames of one message, NaN where there is none. [A]"""
    found = [codes.place.extract(payload) for payload in payloads]
    scale, offset = float(codes.scale), float(codes.offset)
    good = [code is not None and codes.is_value(code) for code in found]
    return np.where(good, sign * (scale * np.array(found, dtype=float) + offset), np.nan)


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
        fault = sensor_fault(InForce(parameters=parameters), name)
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
    run_tool(app, "trust_chain")
