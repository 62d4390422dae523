"""Run methods on many trials of many settings, and judge them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.errors import FleetError
from calibrator.experiments.methods import Estimate, Method
from calibrator.experiments.outcome import Outcome, confidence_bins, figures_of, judge, pit_counts, pooled
from calibrator.experiments.result import Row
from calibrator.experiments.trial import Trial
from calibrator.faults import Faults
from calibrator.processes.run_many import Workers, run_many
from calibrator.terminal.progress import shown

__all__ = ["Effort", "PaperFigures", "Setting", "require_estimate", "run_settings"]

SEE = "see Estimate of calibrator.experiments.methods"
ROUNDING = 1e-9
"""By which a probability may leave 0 to 1. [1]"""
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
    methods : sequence of Method or None
        What is run on its trials; None: what the experiment compares.
    """

    x: float
    series: str = ""
    make_trial: Callable[[int], Trial]
    methods: Sequence[Method] | None = None


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
    tasks = ((setting.make_trial, setting.methods or methods, seed) for setting in settings for seed in seeds)
    total = len(settings) * len(seeds)
    judged = iter(shown(run_many(_run_trial, tasks, Workers(processes=effort.jobs)), label, total, "trials"))
    rows = []
    for setting in settings:
        trials = [next(judged) for _ in seeds]
        for k, method in enumerate(setting.methods or methods):
            known = (paper or {}).get((setting.x, method.name), {})
            rows.append(_row(setting, method.name, [trial[k] for trial in trials], known))
    next(judged, None)  # the bar is done
    return tuple(rows)


def _run_trial(task: tuple[Callable[[int], Trial], Sequence[Method], int]) -> list[Outcome]:
    make_trial, methods, seed = task
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
    for name, figure in figures_of(together).items():
        values = [each[name].mean for each in singly if name in each]
        sd = float(np.std(values, ddof=1)) if len(values) > 1 and np.isfinite(values).all() else 0.0
        figures[name] = replace(figure, sd=sd, paper=paper.get(name))
    return Row(
        x=setting.x,
        series=setting.series,
        method=method,
        figures=figures,
        bins=confidence_bins(together),
        pit=pit_counts(together),
    )


def require_estimate(method: str, estimate: object, truth: Faults) -> Estimate:
    """Refuse what cannot be judged.

    Parameters
    ----------
    method : str
        Name of the method, for the message.
    estimate : object
        What it returned.
    truth : Faults
        Of the N vehicles with K branches that it was given.

    Returns
    -------
    Estimate
        The same.

    Raises
    ------
    FleetError
        If it is no estimate, or one of its arrays has another shape or type, or values that are not finite.
    """
    where = f"method '{method}'"
    if not isinstance(estimate, Estimate):
        raise FleetError(f"{where}: estimate() returned {_kind(estimate)}, expected an Estimate; {SEE}")
    faults = estimate.faults
    if not isinstance(faults, Faults):
        raise FleetError(f"{where}: faults are {_kind(faults)}, expected Faults of calibrator.faults; {SEE}")
    N, K = truth.drift.shape
    shapes = {"hardware_drift": (N,), "hardware_offset_a": (N, K), "drift": (N, K), "offset_a": (N, K)}
    for name, shape in shapes.items():
        values = getattr(faults, name)
        _require_array(f"{where}: faults.{name}", values, shape, "fiu")
        count = int(np.sum(~np.isfinite(values)))
        if count:
            text = f"{where}: faults.{name} has {count} values that are not finite; expected 0 where no fault is found"
            raise FleetError(f"{text}; {SEE}")
    _require_array(f"{where}: hardware", estimate.hardware, (N,), "b")
    _require_array(f"{where}: corrected", estimate.corrected, (N, K), "b")
    if estimate.confidence is not None:
        _require_array(f"{where}: confidence", estimate.confidence, (N,), "fiu")
        count = int(np.sum(~((estimate.confidence >= -ROUNDING) & (estimate.confidence <= 1.0 + ROUNDING))))
        if count:
            raise FleetError(f"{where}: confidence has {count} values that are no probability; expected 0 to 1; {SEE}")
    if not isinstance(estimate.failed, int | np.integer):
        raise FleetError(f"{where}: failed is {_kind(estimate.failed)}, expected a number of vehicles; {SEE}")
    return estimate


def _require_array(where: str, values: object, shape: tuple[int, ...], kinds: str) -> None:
    """FleetError if it is no array of that shape and of one of these kinds of numpy."""
    meant = f"expected an array of {'bool' if kinds == 'b' else 'numbers'} of shape {shape}: vehicles"
    meant += " and branches" if len(shape) > 1 else ""
    if not isinstance(values, np.ndarray):
        raise FleetError(f"{where} is {_kind(values)}, {meant}; {SEE}")
    if values.shape != shape or values.dtype.kind not in kinds:
        raise FleetError(f"{where} is an array of {values.dtype} of shape {values.shape}, {meant}; {SEE}")


def _kind(value: object) -> str:
    return "None" if value is None else f"an object of type {type(value).__name__}"
