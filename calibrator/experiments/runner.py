"""Run any experiment.

Every setting is run with the same seeds; all methods of a setting see the same trials.
"""

import os
import platform
import shutil
import subprocess
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from calibrator.errors import FleetError
from calibrator.estimator.settings import time_of_run
from calibrator.experiments.common_drive import CommonDrive, common_trial
from calibrator.experiments.experiments import ALL, KEYS, Experiment, ExperimentResult
from calibrator.experiments.figures import Values, figure_rows, judge
from calibrator.experiments.methods import require_estimate
from calibrator.experiments.recorded_trips import RecordedCase, RecordedFleet, recorded_trial
from calibrator.experiments.trial import ComparedMethod, Trial
from calibrator.processes.run_many import Workers, run_many
from calibrator.terminal.progress import shown
from ecu_node import __version__

__all__ = ["made_now", "run_experiment"]


def run_experiment(
    experiment: Experiment,
    fleet: CommonDrive | RecordedFleet,
    *,
    methods: Sequence[ComparedMethod] | None = None,
    repetitions: int | None = None,
    seed: int = 0,
    workers: int = 1,
) -> ExperimentResult:
    """Run every method on the same trials of every setting.

    Parameters
    ----------
    experiment : Experiment
        A row of :data:`~calibrator.experiments.experiments.EXPERIMENTS`, or one like them.
    fleet : CommonDrive or RecordedFleet
        What the vehicles drive, see :func:`~calibrator.experiments.experiments.fleet_for`.
    methods : sequence of ComparedMethod or None
        Methods to compare; None: those of the experiment.
    repetitions : int or None
        Trials per setting; None: those of the experiment.
    seed : int
        Seed of the first trial; each further one has the next seed.
    workers : int
        Processes; the figures do not depend on them.

    Returns
    -------
    ExperimentResult
        Figures by setting, then by method; after them, by method, those of all settings together.

    Raises
    ------
    FleetError
        If there are no methods or settings, or two have the same name or place in a table; the fleet has too few
        branches, or is not what the experiment needs (common drive or recorded trips); there are no repetitions; or a
        method returns what cannot be judged.
    """
    methods, settings = tuple(experiment.methods if methods is None else methods), experiment.settings
    names, places = [method.name for method in methods], [(setting.series, setting.x) for setting in settings]
    if not names or not places or len({*names}) < len(names) or len({*places}) < len(places):
        raise FleetError(
            f"{experiment.name}: methods {', '.join(names) or 'none'}; expected methods with names of their own, and "
            "settings that differ in x or series"
        )
    if experiment.recorded != isinstance(fleet, RecordedFleet):
        raise FleetError(f"{experiment.name}: cannot be run on a {type(fleet).__name__}; see fleet_for()")
    if isinstance(fleet, RecordedFleet):  # before anything is run
        fleet.with_branches(max(each.case.branches for each in settings if isinstance(each.case, RecordedCase)))
    repetitions = experiment.repetitions if repetitions is None else repetitions
    if not isinstance(repetitions, int) or repetitions < 1:
        raise FleetError(f"{experiment.name}: {repetitions!r} repetitions; expected a whole number, 1 or more")
    tasks = [(setting.case, seed + number) for setting in settings for number in range(repetitions)]
    judged = run_many(partial(_run_trial, fleet, methods), tasks, Workers(processes=workers))
    trials = list(shown(judged, experiment.name, len(tasks), "trials"))
    of_setting = range(0, len(trials), repetitions)
    parts = [(*place, trials[k : k + repetitions]) for place, k in zip(places, of_setting, strict=True)]
    if len(parts) > 1:
        parts.append((ALL, float("nan"), trials))
    tables = []
    for series, x, some in parts:
        for k, name in enumerate(names):
            keys = dict(zip(KEYS, (series, float(x), name), strict=True))
            tables.append([pd.DataFrame(keys, table.index).join(table) for table in figure_rows([t[k] for t in some])])
    figures, tenths = (pd.concat(tables_of, ignore_index=True) for tables_of in zip(*tables, strict=True))
    record = {"seed": seed, "repetitions": repetitions, **fleet.record}
    return ExperimentResult(experiment=experiment, settings=record, figures=figures, tenths=tenths)


def _run_trial(
    fleet: CommonDrive | RecordedFleet, methods: Sequence[ComparedMethod], task: tuple[Any, int]
) -> list[Values]:
    """Make the trial of a case and a seed; return what :func:`judge` says of each method.

    Each method has its own copy of the trial, as it may write into arrays.
    """
    trial = recorded_trial(fleet, *task) if isinstance(fleet, RecordedFleet) else common_trial(fleet, *task)

    def copied() -> Trial:
        return replace(
            trial,
            truth=deepcopy(trial.truth),
            unseen=deepcopy(trial.unseen),
            record=lambda: deepcopy(trial.recorded),
            collect=lambda: deepcopy(trial.evidence),
        )

    return [judge(require_estimate(method.name, method.estimate(copied()), trial.truth), trial) for method in methods]


def made_now() -> str:
    """Return version of the calibrator, commit (of a checkout), Python, machine and day as one text."""
    return (
        f"calibrator {__version__}{_commit()}, Python {platform.python_version()} on {platform.machine()} with "
        f"{os.cpu_count()} cores, {time_of_run()[:10]}"
    )


def _commit() -> str:
    root, git = Path(__file__).parents[2], shutil.which("git")
    if git is None or not (root / ".git").exists():
        return ""
    command = [git, "-C", str(root), "describe", "--always", "--exclude=*", "--abbrev=12", "--dirty"]
    described = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - no input of a user in it
    return f" of commit {described.stdout.strip()}" if described.returncode == 0 else ""
