"""Run an experiment by name: table on the console; page, JSON and picture in a folder."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from calibrator.errors import FleetError
from calibrator.experiments.common_drive import DURATION_S, CommonDrive, builtin_common_drive
from calibrator.experiments.paper_experiments import (
    classifier_experiment,
    snr_experiment,
    sparsity_experiment,
    statespace_experiment,
)
from calibrator.experiments.picture import write_picture
from calibrator.experiments.result import ExperimentResult
from calibrator.experiments.table import result_markdown, result_table
from calibrator.experiments.trial import FleetLaw
from ecu_node.parameters import write_atomically

__all__ = ["EXPERIMENTS", "run_experiment"]

REPETITIONS, QUICK_REPETITIONS = 10, 2
QUICK_DURATION_S = 300.0
JOBS = -1
"""One process per core; repetitions do not depend on each other."""


@dataclass(frozen=True, kw_only=True)
class _Experiment:
    """An experiment and the size at which the paper runs it."""

    run: Callable[..., ExperimentResult]
    vehicles: int = 1000
    duration_s: float = DURATION_S


EXPERIMENTS = {
    "classifier": _Experiment(run=classifier_experiment),
    "snr": _Experiment(run=snr_experiment),
    "sparsity": _Experiment(run=sparsity_experiment),
    # 20 minutes: models are exact there, so a longer drive shows the same and takes three times as long.
    "statespace": _Experiment(run=statespace_experiment, vehicles=500, duration_s=1200.0),
}
QUICK_LAW = FleetLaw(vehicles=40, training_vehicles=400)


def run_experiment(
    name: str,
    *,
    quick: bool = False,
    seed: int = 0,
    repetitions: int | None = None,
    out: Path | None = None,
    console: Console | None = None,
    drive: CommonDrive | None = None,
    jobs: int = JOBS,
) -> ExperimentResult:
    """Run one experiment.

    Parameters
    ----------
    name : str
        One of :data:`EXPERIMENTS`.
    quick : bool
        Small fleets, a short drive and two repetitions: shows that it runs, not the figures.
    seed : int
        Of the first repetition; the others follow.
    repetitions : int or None
        Trials per setting; None: 10, or 2 if quick.
    out : Path or None
        Folder for NAME.md, NAME.json and NAME.png, made if missing; None: nothing is written.
    console : rich.console.Console or None
        Where the table goes; None: nowhere.
    drive : CommonDrive or None
        The drive all vehicles make; None: of the built-in vehicle.
    jobs : int
        Processes; -1: one per core.

    Returns
    -------
    ExperimentResult
        All figures.

    Raises
    ------
    FleetError
        If there is no such experiment, or the number of repetitions is not positive.
    """
    if name not in EXPERIMENTS:
        raise FleetError(f"no experiment '{name}'; choose one of {', '.join(EXPERIMENTS)}")
    count = repetitions if repetitions is not None else (QUICK_REPETITIONS if quick else REPETITIONS)
    if count < 1:
        raise FleetError(f"an experiment needs at least 1 repetition, not {count}")
    experiment = EXPERIMENTS[name]
    if drive is None:
        drive = builtin_common_drive(duration_s=QUICK_DURATION_S if quick else experiment.duration_s)
    law = QUICK_LAW if quick else FleetLaw(vehicles=experiment.vehicles)
    result = experiment.run(drive=drive, law=law, repetitions=count, seed=seed, jobs=jobs)
    if console is not None:
        console.print(result_table(result))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(out / f"{name}.json", result.to_json())
        write_atomically(out / f"{name}.md", result_markdown(result).encode())
        write_picture(result, out / f"{name}.png")
    return result
