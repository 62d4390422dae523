"""The whole chain for a fleet: drives, calibration, signatures, activation, trial, and the drive after it."""

import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from calibrator.processes.run_many import Workers, run_many
from calibrator.terminal.progress import shown
from calibrator.terminal.text import dumps, table
from chain.fleet import ChainFleet
from chain.one_vehicle import VehicleOutcome, drive_vehicle
from ecu_node.errors import UserError
from ecu_node.parameters import read_parameters

__all__ = ["ChainScore", "drive_chain"]

SIGNERS = ("anna", "ben")


@dataclass(frozen=True)
class ChainScore:
    """What became of all vehicles."""

    outcomes: Sequence[VehicleOutcome]

    def counts(self) -> dict[str, int]:
        """How many vehicles came how far, and how many wrong sets passed a trial."""
        corrected = [found for found in self.outcomes if found.corrected]
        counts = {
            "vehicles": len(self.outcomes),
            "with corrections": len(corrected),
            "refused": sum(bool(found.refused) for found in corrected),
            "passed their trial": sum(found.passed for found in corrected),
            "deployed": sum(found.passed and not found.fell_back for found in corrected),
            "made worse": sum(bool(found.worse) for found in corrected),
        }
        for kind in dict.fromkeys(kind for found in corrected for kind in found.wrong):
            wrong = [found.wrong[kind] for found in corrected if kind in found.wrong and found.wrong[kind].worse]
            counts[f"wrong sets on trial, {kind}"] = len(wrong)
            counts[f"of these passed, {kind}"] = sum(found.passed for found in wrong)
        return counts

    def errors_a(self) -> Mapping[str, float]:
        """Largest error of the corrected branches of a vehicle after its trial, median and worst. [A]"""
        found = sorted(outcome.measured_a for outcome in self.outcomes if outcome.passed)
        after = sorted(outcome.published_a for outcome in self.outcomes if outcome.passed)
        if not found:
            return {}
        middle = len(found) // 2
        return {
            "error, median, measured": found[middle],
            "error, median, published": after[middle],
            "error, worst, measured": found[-1],
            "error, worst, published": after[-1],
        }

    def as_json(self) -> str:
        """Return the score as JSON: the same names, in one word."""
        counts = {_key(name): count for name, count in self.counts().items()}
        return dumps({**counts, **{f"{_key(name)}_a": value for name, value in self.errors_a().items()}})

    def as_text(self) -> str:
        """Return the score for people, with a line for each vehicle that did not come to its end."""
        rows = [(name, f"{count}") for name, count in self.counts().items()]
        rows += [(f"{name} [A]", f"{value:.2f}") for name, value in self.errors_a().items()]
        ends = [f"{found.vehicle}: {_end(found)}" for found in self.outcomes if _end(found)]
        return "\n".join([table(("", ""), rows), *ends])


def _key(name: str) -> str:
    return name.replace(",", "").replace(" ", "_")


def _end(found: VehicleOutcome) -> str:
    """What kept a vehicle's corrections from being in force, or what they made worse; empty if all is well."""
    if not found.corrected:
        return ""
    if found.refused or not found.passed:
        return found.refused or found.text
    if found.worse:
        return f"worse: {', '.join(found.worse)}"
    return "passing measured values through after all" if found.fell_back else ""


def drive_chain(fleet: ChainFleet, folder: Path, *, workers: int) -> ChainScore:
    """Take a fleet from its drives to corrected vehicles.

    Parameters
    ----------
    fleet : ChainFleet
        The fleet.
    folder : Path
        Empty; for drives, parameters, keys, repository and the states of the vehicles.
    workers : int
        Number of processes.

    Returns
    -------
    ChainScore
        What became of them.

    Raises
    ------
    UserError
        If a command of the chain fails.
    """
    layout = fleet.database.layout.path
    fleet.write_drives(folder / "drives", workers=workers)
    _run(
        *("calibrator", "calibrate", folder / "drives", "--layout", layout),
        *("--out", folder / "result", "--workers", workers),
        progress=True,
    )
    files = [folder / "result" / "params" / f"{vehicle.name}.json" for vehicle in fleet.vehicles]
    _publish(folder, [path for path in files if path.exists()])
    calibrated = [number for number, path in enumerate(files) if path.exists()]
    tasks = ((number, calibrated[(place + 1) % len(calibrated)]) for place, number in enumerate(calibrated))
    driven = run_many(partial(_drive, fleet, folder), tasks, Workers(processes=workers))
    return ChainScore(list(shown(driven, "drive, corrected", len(calibrated), "vehicles")))


def _publish(folder: Path, files: Sequence[Path]) -> None:
    """Two signers make their keys, and publish all files."""
    for name in SIGNERS:
        _run("calibrator", "repository", "key", name, "--no-passphrase", "--out", folder / "keys")
    repository = folder / "repository"
    public = [
        word
        for role in ("root", "targets", "snapshot", "timestamp")
        for name in SIGNERS
        for word in (f"--{role}", folder / "keys" / f"{name}.pub")
    ]
    _run("calibrator", "repository", "init", repository, *public)
    _run("calibrator", "repository", "add", repository, *files)
    private = [part for name in SIGNERS for part in ("--key", folder / "keys" / f"{name}.key")]
    _run("calibrator", "repository", "publish", repository, *private)


def _drive(fleet: ChainFleet, folder: Path, task: tuple[int, int]) -> VehicleOutcome:
    number, other = task
    name = fleet.vehicles[number].name
    params = folder / "result" / "params"
    own = read_parameters(params / f"{name}.json")
    others = read_parameters(params / f"{fleet.vehicles[other].name}.json")
    return drive_vehicle(fleet, number, own, others, repository=folder / "repository", state=folder / "states" / name)


def _run(*words: object, progress: bool = False) -> None:
    """Run a command of the project, perhaps with its own progress; its last line if it fails."""
    command = [sys.executable, "-m", *map(str, words)]
    errors = None if progress else subprocess.PIPE
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=errors, text=True, check=False)
    if done.returncode:
        last = ((done.stderr or "").strip() or done.stdout.strip() or "it said why").splitlines()[-1]
        raise UserError(f"{words[0]} {words[1]}: ended with {done.returncode}: {last}")
