"""Run any experiment, and pool the confidences of several.

Every setting is run with the same seeds; all methods of a setting see the same trials.
"""

import os
import platform
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from calibrator.errors import FleetError
from calibrator.estimator.vehicle_parameters import time_of_run
from calibrator.experiments.common_drive import CommonCase, CommonDrive, common_trial
from calibrator.experiments.experiments import CALIBRATION, KEYS, Experiment, ExperimentResult, Setting
from calibrator.experiments.figures import ALL, calibration_errors, figure_rows, judge, pool_figures, pool_tenths
from calibrator.experiments.methods import POSTERIOR, require_estimate
from calibrator.experiments.recorded_trips import RecordedCase, RecordedFleet, recorded_trial
from calibrator.experiments.trial import ComparedMethod
from calibrator.processes.run_many import Workers, run_many
from calibrator.terminal.progress import shown
from ecu_node import __version__

__all__ = ["made_now", "pool_confidences", "run_experiment"]


def run_experiment(
    experiment: Experiment,
    fleet: CommonDrive | RecordedFleet,
    *,
    methods: Sequence[ComparedMethod] | None = None,
    repetitions: int = 10,
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
        Methods to compare in settings that have none of their own; None: those of the experiment.
    repetitions, seed : int
        Trials per setting, and the seed of the first trial; each further one has the next seed.
    workers : int
        Processes; the figures do not depend on them.

    Returns
    -------
    ExperimentResult
        Figures by setting, then by method.

    Raises
    ------
    FleetError
        If there is no repetition, two methods share a name, two settings share a place in the table, or a method
        returns what cannot be judged.
    """
    if repetitions < 1:
        raise FleetError(f"an experiment needs at least 1 repetition, not {repetitions}")
    usual = tuple(experiment.methods if methods is None else methods)
    names = [method.name for method in usual]
    if twice := [name for name in names if names.count(name) > 1]:
        raise FleetError(f"{len(twice)} methods are called '{twice[0]}'; give each method a name of its own")
    for case in (setting.case for setting in experiment.settings):
        fleet.with_branches(case.branches)  # raises before anything is run if there are too few
    rows = [(setting, setting.methods or usual) for setting in experiment.settings]
    keys = [(setting.series, setting.x, method.name) for setting, own in rows for method in own]
    if not keys or len({*keys}) < len(keys):
        raise FleetError(f"{experiment.name}: expected a method, and settings that differ in x or series")
    tasks = [(setting.case, own, seed + number) for setting, own in rows for number in range(repetitions)]
    judged = run_many(partial(_run_trial, fleet), tasks, Workers(processes=workers))
    trials = list(shown(judged, experiment.name, len(tasks), "trials"))
    tables = [
        _keyed(figure_rows([trial[k] for trial in trials[first : first + repetitions]]), s.series, s.x, method.name)
        for first, (s, own) in zip(range(0, len(trials), repetitions), rows, strict=True)
        for k, method in enumerate(own)
    ]
    figures, tenths = (pd.concat(some, ignore_index=True) for some in zip(*tables, strict=True))
    return ExperimentResult(
        experiment=experiment,
        settings={"seed": seed, "repetitions": repetitions, **_common(experiment.settings), **fleet.record},
        figures=figures,
        tenths=tenths,
    )


def _run_trial(
    fleet: CommonDrive | RecordedFleet, task: tuple[CommonCase | RecordedCase, Sequence[ComparedMethod], int]
) -> list[dict[str, Any]]:
    case, methods, seed = task
    if isinstance(case, RecordedCase) and isinstance(fleet, RecordedFleet):
        trial = recorded_trial(fleet, case, seed)
    elif isinstance(case, CommonCase) and isinstance(fleet, CommonDrive):
        trial = common_trial(fleet, case, seed)
    else:
        raise FleetError(f"{type(case).__name__} cannot be run on a {type(fleet).__name__}; see fleet_for()")
    return [judge(require_estimate(method.name, method.estimate(trial), trial.truth), trial) for method in methods]


def _keyed(tables: Iterable[pd.DataFrame], series: str, x: float, method: str) -> list[pd.DataFrame]:
    """Return the tables with the columns :data:`KEYS` in front, which name setting and method."""
    keys = dict(zip(KEYS, (series, float(x), method), strict=True))
    return [table.assign(**keys)[[*KEYS, *table.columns]] for table in tables]


def _common(settings: Sequence[Setting]) -> dict[str, Any]:
    """Return the fields that are equal in the cases of all settings, by name, without empty ones; ranges as text."""
    cases = [vars(setting.case) for setting in settings]
    common = {key: value for key, value in cases[0].items() if all(case[key] == value for case in cases)}
    mean_and_sd = {"unmeasured_a"}  # the other pairs are ranges
    pairs = {
        key: ("{:g} +- {:g}" if key in mean_and_sd else "{:g} to {:g}").format(*value)
        for key, value in common.items()
        if isinstance(value, tuple)
    }
    shown = {key: getattr(value, "name", value) for key, value in (common | pairs).items()}
    return {key: value for key, value in shown.items() if value not in {None, ""}}


def pool_confidences(results: Sequence[ExperimentResult]) -> ExperimentResult:
    """Pool the confidences of the default method over experiments: is a confidence of 0.9 right in 0.9 of the cases?

    Experiments share settings, such as the paper's with S = 60, and with the same seed these are the same trials. "All
    together" counts them once: trials are taken for the same if drive, seed, repetitions and tenths are equal.

    Parameters
    ----------
    results : sequence of ExperimentResult
        Results of other experiments; those in which the default has no confidence add nothing.

    Returns
    -------
    ExperimentResult
        One row per experiment, and one of all together; x is the number of vehicles.

    Raises
    ------
    FleetError
        If no experiment has a confidence.
    """
    parts, used = [], []
    for result in results:
        own = [table[table["method"] == POSTERIOR.name] for table in (result.figures, result.tenths)]
        if result.experiment.pooled and own[1]["vehicles"].sum():
            used.append(result)
            drawn = " ".join(str(result.settings.get(name)) for name in ("drive", "seed", "repetitions"))
            parts.append([table.assign(experiment=result.experiment.name, drawn=drawn) for table in own])
    if not used:
        raise FleetError("no experiment has a confidence to check; run 'calibrator experiment all --out FOLDER' first")
    figures, tenths = (pd.concat(some, ignore_index=True) for some in zip(*parts, strict=True))
    keys = ["experiment", "series", "x"]
    by_setting = tenths.pivot_table(
        index=[*keys, "drawn"], columns="low", values=["vehicles", "confidence"], sort=False
    )
    once = by_setting.round(12).reset_index(level="drawn").drop_duplicates().index
    groups = {
        name: [table[table["experiment"] == name] for table in (figures, tenths)]
        for name in dict.fromkeys(figures["experiment"])
    }
    groups[ALL] = [table[table.set_index(keys).index.isin(once)] for table in (figures, tenths)]
    pooled = [_pooled(name, *tables) for name, tables in groups.items()]
    figures, tenths = (pd.concat(some, ignore_index=True) for some in zip(*pooled, strict=True))
    sources = {
        name: " or ".join(sorted({str(result.settings.get(name, "?")) for result in used}))
        for name in ("repetitions", "seed")
    }
    settings = {
        "experiments": ", ".join(result.experiment.name for result in used),
        **sources,
        "drive": "those of the experiments",
    }
    return ExperimentResult(experiment=CALIBRATION, settings=settings, figures=figures, tenths=tenths)


def _pooled(series: str, figures: pd.DataFrame, tenths: pd.DataFrame) -> list[pd.DataFrame]:
    """Return pooled figures and tenths of an experiment, which show whether its confidences are right."""
    pooled, means = pool_tenths(tenths), pool_figures(figures)
    kept = means[means["figure"].isin(["recovery_rate", "confidence"]) | means["figure"].str.startswith("sure")]
    vehicles = pooled["vehicles"].sum()
    errors = pd.DataFrame(
        {"figure": ["ece", "ece_by_chance"], "value": calibration_errors(pooled), "sd": 0.0, "of": vehicles}
    )
    return _keyed((pd.concat([kept, errors]), pooled), series, vehicles, POSTERIOR.name)


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
