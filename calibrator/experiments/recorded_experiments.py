"""Experiments in which every recorded trip is a vehicle: real drives, size of faults, and how much must be recorded."""

from collections.abc import Sequence
from functools import partial

from calibrator.experiments.joined_trial import joined_trial
from calibrator.experiments.judging import Effort, Setting, run_settings
from calibrator.experiments.methods import CEILING, PERFECT, POSTERIOR, Method
from calibrator.experiments.recorded_fleet import RecordedFleet
from calibrator.experiments.recorded_trial import NOISE, RecordedCase, recorded_trial
from calibrator.experiments.result import ExperimentResult, Settings

__all__ = ["data_experiment", "phase_experiment", "real_experiment", "recorded_settings"]

METHODS: Sequence[Method] = (PERFECT, POSTERIOR)
REAL_METHODS: Sequence[Method] = (PERFECT, POSTERIOR, CEILING)
LOAD_A = (3.0, 1.0)
"""Control units and the like take 1 to 4 A that no branch measures. [A]"""
REAL_CASES = (
    RecordedCase(branches=2, sparsity=80.0),
    RecordedCase(branches=2, sparsity=60.0),
    RecordedCase(branches=3, sparsity=80.0),
    RecordedCase(branches=3, sparsity=60.0),
    RecordedCase(magnitude=(0.02, 0.10)),
    RecordedCase(magnitude=(0.01, 0.05)),
    RecordedCase(magnitude=(0.005, 0.02)),
    RecordedCase(sparsity=80.0, unmeasured_a=LOAD_A),
    RecordedCase(sparsity=60.0, unmeasured_a=LOAD_A),
)
MAGNITUDES = ((0.005, 0.02), (0.01, 0.05), (0.02, 0.10), (0.05, 0.25))
SPARSITIES = (20.0, 40.0, 50.0, 60.0, 80.0)
"""With two branches 5, 4, 3, 2 and 1 of 6 parameters are not zero. [%]"""
MINUTES = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
FLEET_SIZES = (10, 30, 100)
DATA_CASE = RecordedCase(sparsity=60.0)
DEFAULT_EFFORT = Effort()
SPARSITY_LABEL = "sparsity S [%]"


def real_experiment(
    *,
    fleet: RecordedFleet,
    cases: Sequence[RecordedCase] = REAL_CASES,
    methods: Sequence[Method] = REAL_METHODS,
    effort: Effort = DEFAULT_EFFORT,
) -> ExperimentResult:
    """Real drives: faults injected into recorded trips, each a vehicle of its own.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips.
    cases : sequence of RecordedCase
        Branches, sparsity, sizes, unmeasured load.
    methods : sequence of Method
        What to compare.
    effort : Effort
        Repetitions, seed, processes.

    Returns
    -------
    ExperimentResult
        Rows by case and method.
    """
    settings = [
        Setting(x=case.sparsity, series=_text(case), make_trial=partial(recorded_trial, fleet, case)) for case in cases
    ]
    return ExperimentResult(
        name="real",
        title=f"{'Real' if fleet.recorded else 'Built-in'} drives, each trip a vehicle",
        x_label=SPARSITY_LABEL,
        series_label="branches, faults",
        settings=recorded_settings(fleet, effort),
        rows=run_settings(settings, methods, effort, label="real"),
    )


def phase_experiment(
    *,
    fleet: RecordedFleet,
    sparsities: Sequence[float] = SPARSITIES,
    magnitudes: Sequence[tuple[float, float]] = MAGNITUDES,
    methods: Sequence[Method] = METHODS,
    effort: Effort = DEFAULT_EFFORT,
) -> ExperimentResult:
    """Phase diagram: where recovery succeeds, over sparsity and size of the faults, with two branches.

    Parameters
    ----------
    sparsities : sequence of float
        Levels S. [%]
    magnitudes : sequence of tuple of float
        Ranges of drifts [1], and of offsets in fractions of full scale.
    fleet, methods, effort
        As in :func:`real_experiment`.

    Returns
    -------
    ExperimentResult
        Rows by size, sparsity and method.
    """
    settings = []
    for magnitude in magnitudes:
        for sparsity in sparsities:
            case = RecordedCase(sparsity=sparsity, magnitude=magnitude)
            trial = partial(recorded_trial, fleet, case)
            settings.append(Setting(x=sparsity, series=_sizes(magnitude), make_trial=trial))
    return ExperimentResult(
        name="phase",
        title="Phase diagram: success over sparsity and size of the faults",
        x_label=SPARSITY_LABEL,
        series_label="faults [% of full scale]",
        settings=recorded_settings(fleet, effort),
        rows=run_settings(settings, methods, effort, label="phase"),
    )


def data_experiment(
    *,
    fleet: RecordedFleet,
    minutes: Sequence[float] = MINUTES,
    fleet_sizes: Sequence[int] = FLEET_SIZES,
    methods: Sequence[Method] = METHODS,
    effort: Effort = DEFAULT_EFFORT,
) -> ExperimentResult:
    """How much must be recorded: minutes of driving per vehicle, and number of vehicles; K = 2, S = 60.

    Parameters
    ----------
    minutes : sequence of float
        Driving per vehicle, from a random instant of the trips on. [min]
    fleet_sizes : sequence of int
        Numbers of vehicles N.
    fleet, methods, effort
        As in :func:`real_experiment`.

    Returns
    -------
    ExperimentResult
        Rows by number of vehicles, minutes and method.
    """
    settings = []
    for size in fleet_sizes:
        for duration in minutes:
            trial = partial(joined_trial, fleet, DATA_CASE, vehicles=size, duration_s=60.0 * duration)
            settings.append(Setting(x=duration, series=str(size), make_trial=trial))
    return ExperimentResult(
        name="data",
        title="How much must be recorded",
        x_label="minutes per vehicle",
        series_label="vehicles",
        settings={**recorded_settings(fleet, effort), "vehicles": "as named", "sparsity": DATA_CASE.sparsity},
        rows=run_settings(settings, methods, effort, label="data"),
    )


def recorded_settings(fleet: RecordedFleet, effort: Effort) -> Settings:
    """What is needed to repeat an experiment on recorded trips, for its record."""
    return {
        "seed": effort.seed,
        "repetitions": effort.repetitions,
        "drive": fleet.name,
        "vehicles": len(fleet.trips),
        "driving_minutes": round(sum(len(trip) for trip in fleet.trips) * fleet.period_s / 60.0, 1),
        "full_scale_a": fleet.full_scale_a,
        "noise_a": NOISE * fleet.full_scale_a,
        "balance_branch": fleet.balance_branch,
        "balanced": True,
        "symmetric": False,
    }


def _text(case: RecordedCase) -> str:
    load = "" if not any(case.unmeasured_a) else ", load {:g}+-{:g} A".format(*case.unmeasured_a)
    return f"K={case.branches}, {_sizes(case.magnitude)} %{load}"


def _sizes(magnitude: tuple[float, float]) -> str:
    return f"{100.0 * magnitude[0]:g}-{100.0 * magnitude[1]:g}"
