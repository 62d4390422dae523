"""Experiments in which every recorded trip is a vehicle: each a list of settings on the same fleet.

Real drives, size of faults, how much must be recorded, what the estimator does not expect, and its own figures of
uncertainty. Every experiment takes the fleet, the methods to compare, and repetitions, seed and processes; it returns
rows by what it varies and by method.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from calibrator.experiments.attacks import WORLDS
from calibrator.experiments.baselines import BASELINES
from calibrator.experiments.judging import Effort, Setting, run_settings
from calibrator.experiments.methods import CEILING, PERFECT, POSTERIOR, Method
from calibrator.experiments.recorded_fleet import RecordedFleet
from calibrator.experiments.recorded_trial import NOISE, RecordedCase, joined_trial, own_prior_trial, recorded_trial
from calibrator.experiments.result import ExperimentResult

__all__ = [
    "attacks_experiment", "coverage_experiment", "data_experiment", "phase_experiment", "real_experiment",
    "recorded_result",
]  # fmt: skip

Methods = Sequence[Method]
METHODS: Methods = (PERFECT, POSTERIOR)
REAL_METHODS: Methods = (PERFECT, *BASELINES, POSTERIOR, CEILING)
LOAD_A = (3.0, 1.0)
"""Control units and the like take 1 to 4 A that no branch measures. [A]"""
REAL_CASES = (
    *(
        RecordedCase(branches=branches, sparsity=sparsity, balanced=balanced)
        for balanced in (True, False)
        for branches in (2, 3)
        for sparsity in (80.0, 60.0)
    ),
    RecordedCase(magnitude=(0.02, 0.10)),
    RecordedCase(magnitude=(0.01, 0.05)),
    RecordedCase(magnitude=(0.005, 0.02)),
    RecordedCase(magnitude=(0.3, 0.6)),
    RecordedCase(magnitude=(0.3, 0.6), branches=3),
    RecordedCase(sparsity=80.0, unmeasured_a=LOAD_A),
    RecordedCase(sparsity=60.0, unmeasured_a=LOAD_A),
)
"""The four main settings, balanced and with hardware faults possible in any vehicle; sizes of faults; loads."""
MAGNITUDES = ((0.005, 0.02), (0.01, 0.05), (0.02, 0.10), (0.05, 0.25))
SPARSITIES = (20.0, 40.0, 50.0, 60.0, 80.0)
"""With two branches 5, 4, 3, 2 and 1 of 6 parameters are not zero. [%]"""
MINUTES = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
FLEET_SIZES = (10, 30, 100)
DATA_CASE = RecordedCase(sparsity=60.0)
EFFORT = Effort()
SPARSITY_LABEL = "sparsity S [%]"
BALANCED = "Half of the vehicles have no hardware fault; where 'any vehicle' is said, each may have one."


def real_experiment(
    *,
    fleet: RecordedFleet,
    cases: Sequence[RecordedCase] = REAL_CASES,
    methods: Methods = REAL_METHODS,
    effort: Effort = EFFORT,
) -> ExperimentResult:
    """Real drives: faults injected into recorded trips, each a vehicle of its own.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips.
    cases : sequence of RecordedCase
        Branches, sparsity, sizes, hardware faults, unmeasured load.
    methods : sequence of Method
        What to compare.
    effort : Effort
        Repetitions, seed, processes.

    Returns
    -------
    ExperimentResult
        Rows by case and method.
    """
    settings = [_setting(fleet, case) for case in cases]
    title = f"{'Real' if fleet.recorded else 'Built-in'} drives, each trip a vehicle"
    labels = (SPARSITY_LABEL, "branches, faults")
    return recorded_result(fleet, settings, methods, effort, name="real", title=title, labels=labels, note=BALANCED)


def phase_experiment(
    *,
    fleet: RecordedFleet,
    sparsities: Sequence[float] = SPARSITIES,
    effort: Effort = EFFORT,
    magnitudes: Sequence[tuple[float, float]] = MAGNITUDES,
    methods: Methods = METHODS,
) -> ExperimentResult:
    """Phase diagram: where recovery succeeds, over sparsity [%] and ranges of magnitudes, with two branches."""
    settings = []
    for magnitude in magnitudes:
        for sparsity in sparsities:
            trial = partial(recorded_trial, fleet, RecordedCase(sparsity=sparsity, magnitude=magnitude))
            settings.append(Setting(x=sparsity, series=_sizes(magnitude), make_trial=trial))
    labels = (SPARSITY_LABEL, "faults [% of full scale]")
    title = "Phase diagram: success over sparsity and size of the faults"
    return recorded_result(fleet, settings, methods, effort, name="phase", title=title, labels=labels)


def data_experiment(
    *,
    fleet: RecordedFleet,
    minutes: Sequence[float] = MINUTES,
    fleet_sizes: Sequence[int] = FLEET_SIZES,
    methods: Methods = METHODS,
    effort: Effort = EFFORT,
) -> ExperimentResult:
    """How much must be recorded: minutes of driving per vehicle, and number of vehicles; K = 2, S = 60.

    Vehicles drive from a random instant of the trips on.
    """
    settings = []
    for size in fleet_sizes:
        for duration in minutes:
            trial = partial(joined_trial, fleet, DATA_CASE, vehicles=size, duration_s=60.0 * duration)
            settings.append(Setting(x=duration, series=str(size), make_trial=trial))
    title, labels = "How much must be recorded", ("minutes per vehicle", "vehicles")
    result = recorded_result(fleet, settings, methods, effort, name="data", title=title, labels=labels)
    return replace(result, settings={**result.settings, "vehicles": "as named", "sparsity": DATA_CASE.sparsity})


def attacks_experiment(
    *,
    fleet: RecordedFleet,
    worlds: Sequence[str] = tuple(WORLDS),
    branches: Sequence[int] = (2, 3),
    methods: Methods = (POSTERIOR,),
    effort: Effort = EFFORT,
) -> ExperimentResult:
    """What the estimator does not expect: loads, batches of sensors, sensors that are not linear; S = 80."""
    cases = [RecordedCase(branches=K, world=world) for world in worlds for K in branches]
    settings = [Setting(x=c.branches, series=c.world, make_trial=partial(recorded_trial, fleet, c)) for c in cases]
    title, labels = "Attacks: what the estimator does not expect", ("K", "world")
    note = "S = 80; where no share is named, 30 % of the vehicles have what the world does."
    return recorded_result(fleet, settings, methods, effort, name="attacks", title=title, labels=labels, note=note)


def coverage_experiment(
    *,
    fleet: RecordedFleet,
    cases: Sequence[RecordedCase] = REAL_CASES,
    methods: Methods = (POSTERIOR,),
    effort: Effort = EFFORT,
) -> ExperimentResult:
    """Are the standard deviations right: z-scores and probability integral transform of what is deployed.

    With simulation-based calibration: faults drawn from the prior that the default has learnt of a balanced fleet are
    put on the same trips and estimated, so that the prior is right and what is left is the estimator's own error.
    """
    settings = [_setting(fleet, case) for case in cases]
    for case in cases:
        if case == RecordedCase(branches=case.branches, sparsity=case.sparsity):
            trial = partial(own_prior_trial, fleet, case, method=POSTERIOR)
            settings.append(Setting(x=case.sparsity, series=f"K={case.branches}, own prior", make_trial=trial))
    note = (
        f"Of a normal distribution 0.683 are within 1 standard deviation, and 0.0027 beyond 3. {BALANCED} 'own prior': "
        "faults drawn from what the default has learnt of the balanced fleet with this K and S."
    )
    title, labels = "Coverage: standard deviations of the parameters", (SPARSITY_LABEL, "branches, faults")
    return recorded_result(fleet, settings, methods, effort, name="coverage", title=title, labels=labels, note=note)


def recorded_result(
    fleet: RecordedFleet,
    settings: Sequence[Setting],
    methods: Methods,
    effort: Effort,
    *,
    name: str,
    title: str,
    labels: tuple[str, str],
    note: str = "",
) -> ExperimentResult:
    """Run an experiment on recorded trips.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips.
    settings, methods, effort
        What is run.
    name, title : str
        Of the experiment.
    labels : tuple of str
        Of x and of the series; an empty one: there are no series.
    note : str
        What is to be known of the settings.

    Returns
    -------
    ExperimentResult
        With what is needed to repeat it.
    """
    balance = (
        f"In every trip the current of {fleet.balance_branch} is minus the sum of the other branches: it is not "
        "independent of their sensors, and true currents sum to 0 A but for a load that is put in."
    )
    return ExperimentResult(
        name=name,
        title=title,
        x_label=labels[0],
        series_label=labels[1],
        settings={
            "seed": effort.seed,
            "repetitions": effort.repetitions,
            "drive": fleet.name,
            "vehicles": len(fleet.trips),
            "driving_minutes": round(sum(len(trip) for trip in fleet.trips) * fleet.period_s / 60.0, 1),
            "full_scale_a": fleet.full_scale_a,
            "noise_a": NOISE * fleet.full_scale_a,
            "balance_branch": fleet.balance_branch,
            "balanced": "as named" if BALANCED in note else True,
            "symmetric": False,
        },
        rows=run_settings(settings, methods, effort, label=name),
        note=f"{note} {balance}".strip(),
    )


def _setting(fleet: RecordedFleet, case: RecordedCase) -> Setting:
    load = "" if not any(case.unmeasured_a) else ", load {:g}+-{:g} A".format(*case.unmeasured_a)
    hardware = "" if case.balanced else ", any vehicle"
    series = f"K={case.branches}, {_sizes(case.magnitude)} %{hardware}{load}"
    return Setting(x=case.sparsity, series=series, make_trial=partial(recorded_trial, fleet, case))


def _sizes(magnitude: tuple[float, float]) -> str:
    return f"{100.0 * magnitude[0]:g}-{100.0 * magnitude[1]:g}"
