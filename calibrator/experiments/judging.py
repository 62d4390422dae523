"""Run methods on many trials of many settings, and judge them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from joblib import delayed

from calibrator.errors import FleetError
from calibrator.experiments.estimate_check import require_estimate
from calibrator.experiments.methods import Method
from calibrator.experiments.outcome import Outcome, confidence_bins, figures_of, judge, pooled
from calibrator.experiments.result import Figure, Row
from calibrator.experiments.trial import Trial
from calibrator.processes.computing import in_processes
from calibrator.terminal.progress import shown

__all__ = ["Effort", "PaperFigures", "Setting", "run_settings"]

PaperFigures = Mapping[tuple[float, str], Mapping[str, float]]
"""Figures of the paper by (x, method) and name."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One point of an experiment.

    Attributes
    ----------
    x : float
        Value of what the experiment varies.
    series : str
        What else it varies.
    make_trial : callable
        Makes the trial of a seed; it goes to other processes.
    """

    x: float
    series: str = ""
    make_trial: Callable[[int], Trial]


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much is run.

    Attributes
    ----------
    repetitions, seed : int
        Trials per setting, and the seed of the first; the others follow.
    jobs : int
        Processes.
    """

    repetitions: int = 10
    seed: int = 0
    jobs: int = 1


def run_settings(
    settings: Sequence[Setting],
    methods: Sequence[Method],
    effort: Effort,
    *,
    label: str,
    paper: PaperFigures | None = None,
) -> tuple[Row, ...]:
    """Run every method on the same trials of every setting.

    Parameters
    ----------
    settings : sequence of Setting
        What is varied.
    methods : sequence of Method
        What to compare.
    effort : Effort
        How many trials.
    label : str
        What stands beside the bar of its progress.
    paper : mapping or None
        Figures of the paper.

    Returns
    -------
    tuple of Row
        By setting, then method.

    Raises
    ------
    FleetError
        If methods share a name, or what one of them returns is no estimate of the fleet.
    """
    _require_distinct_names(methods)
    seeds = range(effort.seed, effort.seed + effort.repetitions)
    tasks = (delayed(_run_trial)(setting.make_trial, methods, seed) for setting in settings for seed in seeds)
    total = len(settings) * len(seeds)
    judged = iter(shown(in_processes(tasks, workers=effort.jobs), label, total, "trials"))
    rows = []
    for setting in settings:
        trials = [next(judged) for _ in seeds]
        for k, method in enumerate(methods):
            known = (paper or {}).get((setting.x, method.name), {})
            rows.append(_row(setting, method.name, [trial[k] for trial in trials], known))
    next(judged, None)  # the bar is done
    return tuple(rows)


def _run_trial(make_trial: Callable[[int], Trial], methods: Sequence[Method], seed: int) -> list[Outcome]:
    trial = make_trial(seed)
    estimates = (require_estimate(method.name, method.estimate(trial), trial.truth) for method in methods)
    return [judge(estimate, trial) for estimate in estimates]


def _require_distinct_names(methods: Sequence[Method]) -> None:
    """FleetError if two methods share a name, by which tables and records tell them apart."""
    names = [method.name for method in methods]
    for name in names:
        if names.count(name) > 1:
            raise FleetError(f"{names.count(name)} methods are called '{name}'; give each method a name of its own")


def _row(setting: Setting, method: str, trials: Sequence[Outcome], paper: Mapping[str, float]) -> Row:
    together = pooled(trials)
    singly = [figures_of(trial) for trial in trials]
    figures = {}
    for name, mean in figures_of(together).items():
        values = [each[name] for each in singly if name in each]
        sd = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
        figures[name] = Figure(mean=mean, sd=sd, paper=paper.get(name))
    return Row(x=setting.x, series=setting.series, method=method, figures=figures, bins=confidence_bins(together))
