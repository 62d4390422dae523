"""The one runner of all experiments, and the record of a result.

Every setting is run with the same seeds; all methods of a setting see the same trials.
"""

import json
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pandas as pd

from calibrator.errors import FleetError
from calibrator.experiments.common_drive import CommonCase, CommonDrive, common_trial
from calibrator.experiments.experiments import CALIBRATION, EXPERIMENTS, Experiment, Setting
from calibrator.experiments.figures import (
    TENTH_COLUMNS,
    calibration_errors,
    figure_rows,
    judge,
    pool_figures,
    pool_tenths,
)
from calibrator.experiments.methods import POSTERIOR, ComparedMethod, require_estimate
from calibrator.experiments.recorded_trips import RecordedCase, RecordedFleet, recorded_trial
from calibrator.processes.run_many import Workers, run_many
from calibrator.terminal.progress import shown
from calibrator.time_of_run import time_of_run
from ecu_node import __version__

__all__ = ["ALL", "ExperimentResult", "made_now", "pool_confidences", "read_records", "run_experiment"]

ALL = "all together"
NOT_POOLED = (CALIBRATION.name, "attacks")
"""Attacks are worlds that the estimator does not expect; what becomes of confidences there is in their own table."""
KEYS = ["series", "x", "method"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ExperimentResult:
    """What was found, and what is needed to repeat it.

    Attributes
    ----------
    experiment : Experiment
        The row that was run.
    settings : mapping
        Seed, repetitions, drive, and what all settings have in common.
    figures : DataFrame
        A row per setting (columns ``series``, ``x``), ``method`` and ``figure``, with the columns of
        :func:`~calibrator.experiments.figures.figure_rows`.
    tenths : DataFrame
        By setting and method, from :func:`~calibrator.experiments.figures.tenths_of`.
    made : str
        Version, machine and day, as :func:`made_now` says; empty for an experiment that was called as a function.
    """

    experiment: Experiment
    settings: Mapping[str, bool | int | float | str]
    figures: pd.DataFrame
    tenths: pd.DataFrame
    made: str = ""

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods in the order of their first rows."""
        return tuple(dict.fromkeys(self.figures["method"]))

    def value(self, figure: str, *, x: float, method: str, series: str = "") -> float:
        """Return a figure of a method under a setting; KeyError if there is none."""
        return float(self.figures.set_index([*KEYS, "figure"])["value"].to_dict()[series, x, method, figure])

    def to_json(self) -> str:
        """Encode as JSON."""
        tables = {
            name: json.loads(table.to_json(orient="records", double_precision=15))
            for name, table in (("figures", self.figures), ("tenths", self.tenths))
        }
        named = {name: getattr(self.experiment, name) for name in ("name", "title", "x_label", "series_label")}
        return json.dumps({**named, "settings": dict(self.settings), "made": self.made, **tables}, ensure_ascii=False)


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
        What to compare; None: what the row says.
    repetitions, seed : int
        Trials per setting, and the seed of the first; the others follow.
    workers : int
        Processes; the figures do not depend on them.

    Returns
    -------
    ExperimentResult
        By setting, then method.

    Raises
    ------
    FleetError
        If there is no repetition, methods share a name, or one returns what cannot be judged.
    """
    if repetitions < 1:
        raise FleetError(f"an experiment needs at least 1 repetition, not {repetitions}")
    usual = tuple(experiment.methods if methods is None else methods)
    names = [method.name for method in usual]
    for called in names:
        if names.count(called) > 1:
            raise FleetError(f"{names.count(called)} methods are called '{called}'; give each method a name of its own")
    seeds = range(seed, seed + repetitions)
    tasks = ((setting.case, setting.methods or usual, each) for setting in experiment.settings for each in seeds)
    judged = run_many(partial(_run_trial, fleet), tasks, Workers(processes=workers))
    trials = list(shown(judged, experiment.name, len(experiment.settings) * repetitions, "trials"))
    tables = []
    for number, setting in enumerate(experiment.settings):
        own = trials[number * repetitions : (number + 1) * repetitions]
        for k, method in enumerate(setting.methods or usual):
            tables.append(_keyed(figure_rows([trial[k] for trial in own]), setting.series, setting.x, method.name))
    figures, tenths = (pd.concat(rows, ignore_index=True) for rows in zip(*tables, strict=True))
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
    if isinstance(fleet, CommonDrive) and isinstance(case, CommonCase):
        trial = common_trial(fleet, case, seed)
    elif isinstance(fleet, RecordedFleet) and isinstance(case, RecordedCase):
        trial = recorded_trial(fleet, case, seed)
    else:
        raise FleetError(f"{type(case).__name__} cannot be run on a {type(fleet).__name__}; see fleet_for()")
    return [judge(require_estimate(method.name, method.estimate(trial), trial.truth), trial) for method in methods]


def _keyed(tables: Iterable[pd.DataFrame], series: str, x: float, method: str) -> list[pd.DataFrame]:
    """Tables of one method under one setting, with columns that say so in front."""
    keys = dict(zip(KEYS, (series, float(x), method), strict=True))
    return [table.assign(**keys)[[*KEYS, *table.columns]] for table in tables]


def _common(settings: Sequence[Setting]) -> dict[str, Any]:
    """What all cases have in common, without what is not used."""
    cases = [asdict(setting.case) for setting in settings]
    common = {key: value for key, value in cases[0].items() if all(case[key] == value for case in cases)}
    pairs = {key: "{:g} to {:g}".format(*value) for key, value in common.items() if isinstance(value, tuple)}
    return {key: value for key, value in (common | pairs).items() if value not in {None, ""}}


def pool_confidences(results: Sequence[ExperimentResult]) -> ExperimentResult:
    """Pool the confidences of the default method over experiments: is a confidence of 0.9 right in 0.9 of the cases?

    Experiments share settings, such as the paper's with S = 60, and with the same seed these are the same trials. "All
    together" counts them once: trials are taken for the same if drive, seed, repetitions, tenths and figures are.

    Parameters
    ----------
    results : sequence of ExperimentResult
        Of other experiments; those in which the default has no confidence add nothing.

    Returns
    -------
    ExperimentResult
        One row per experiment, and one of all together; x is the number of vehicles.

    Raises
    ------
    FleetError
        If no experiment has a confidence.
    """
    used, together, tables = [], dict[Any, Any](), []
    for result in results:
        figures, tenths = (t[t["method"] == POSTERIOR.name] for t in (result.figures, result.tenths))
        if result.experiment.name in NOT_POOLED or not tenths["vehicles"].sum():
            continue
        used.append(result)
        drawn = tuple(result.settings.get(name) for name in ("drive", "seed", "repetitions"))
        settings = list(tenths.groupby(KEYS, sort=False))
        for (series, x, _), found in settings:
            own = figures[(figures["series"] == series) & (figures["x"] == x)]
            same = (drawn, *(table.drop(columns=KEYS).to_json(double_precision=12) for table in (found, own)))
            together[same] = own, found
        tables.append(_pooled(result.experiment.name, figures, tenths))
    if not used:
        raise FleetError("no experiment has a confidence to check; run 'calibrator experiment all --out FOLDER' first")
    tables.append(_pooled(ALL, *(pd.concat(rows) for rows in zip(*together.values(), strict=True))))
    figures, tenths = (pd.concat(rows, ignore_index=True) for rows in zip(*tables, strict=True))

    def settings_of(name: str) -> str:
        return " or ".join(sorted({str(result.settings.get(name, "?")) for result in used}))

    return ExperimentResult(
        experiment=CALIBRATION,
        settings={
            "experiments": ", ".join(result.experiment.name for result in used),
            "repetitions": settings_of("repetitions"),
            "seed": settings_of("seed"),
            "drive": "those of the experiments",
        },
        figures=figures,
        tenths=tenths,
    )


def _pooled(series: str, figures: pd.DataFrame, tenths: pd.DataFrame) -> list[pd.DataFrame]:
    """Row of an experiment: what tells whether its confidences are right."""
    pooled = pool_tenths(tenths)
    means = pool_figures(figures)
    kept = means[means["figure"].isin(["recovery_rate", "confidence"]) | means["figure"].str.startswith("sure")]
    errors = zip(("ece", "ece_by_chance"), calibration_errors(pooled), strict=True)
    vehicles = pooled["vehicles"].sum()
    rows = [{"figure": name, "value": value, "sd": 0.0, "of": vehicles} for name, value in errors]
    return _keyed((pd.concat([kept, pd.DataFrame(rows)]), pooled), series, vehicles, POSTERIOR.name)


class _Record(msgspec.Struct):
    """What is read back of NAME.json; titles and labels stand in it for other readers."""

    settings: dict[str, bool | int | float | str]
    made: str
    figures: list[dict[str, str | float | None]]
    tenths: list[dict[str, str | float | None]]


def made_now() -> str:
    """Version of the calibrator, machine and day, in words."""
    return (
        f"calibrator {__version__}, Python {platform.python_version()} on {platform.machine()} with "
        f"{os.cpu_count()} cores, {time_of_run()[:10]}"
    )


def read_records(folder: Path, names: Iterable[str]) -> list[ExperimentResult]:
    """Read the records ``NAME.json`` of a folder in the given order; those that are not there are left out.

    Raises
    ------
    FleetError
        If one is no record of an experiment.
    """
    found = []
    for name in names:
        path = folder / f"{name}.json"
        if not path.is_file():
            continue
        try:
            record = msgspec.json.decode(path.read_bytes(), type=_Record)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise FleetError(
                f"{path}: not a record of an experiment: {error}; expected what 'calibrator experiment --out' writes; "
                "remove it, or run the experiment again"
            ) from None
        result = ExperimentResult(
            experiment=EXPERIMENTS[name],
            settings=record.settings,
            figures=pd.DataFrame(record.figures).astype({"value": float, "low": float, "high": float}),
            tenths=pd.DataFrame(record.tenths, columns=[*KEYS, *TENTH_COLUMNS]),
            made=record.made,
        )
        found.append(result)
    return found
