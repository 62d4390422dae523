"""Experiments on one drive that all vehicles make: the four of section V of [1]_, and fleets that are not symmetric.

Every experiment takes the drive that all vehicles make, how fleets are drawn, the methods to compare, and repetitions,
seed and processes; it returns rows by what it varies and by method, with the paper's figures beside.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from calibrator.artificial.random_fleet import nonzero_count
from calibrator.experiments.common_drive import CommonDrive
from calibrator.experiments.common_trial import artificial_trial, state_space_trial
from calibrator.experiments.judging import Effort, PaperFigures, Setting, run_settings
from calibrator.experiments.methods import PERFECT, POSTERIOR, THRESHOLD, TREE, Method
from calibrator.experiments.result import ExperimentResult, Row, Settings
from calibrator.experiments.trial import FleetLaw, Trial

__all__ = [
    "asymmetry_experiment", "classifier_experiment", "snr_experiment", "sparsity_experiment", "statespace_experiment",
]  # fmt: skip

SPARSITIES = (20.0, 40.0, 60.0, 80.0)
SNRS_DB = (-20.0, -10.0, 0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0)
FLEET_SIZES = (20, 100, 400, 2000)
SIGN_BIASES = (0.0, 0.2, 0.4, 0.5)
LAW, EFFORT = FleetLaw(), Effort()
Methods = Sequence[Method]
SPARSITY_LABEL = "sparsity S [%]"
READING_LABEL = "reading of S"
TWO_READINGS = 60.0
"""Level at which the paper's figures are quoted, and can be read in two ways with two branches. [%]"""

TABLE_1: PaperFigures = {
    (60.0, THRESHOLD.name): {"f2": 0.68, "recovery_rate": 0.84, "complexity": 0.93},
    (60.0, TREE.name): {"f2": 0.84, "recovery_rate": 0.86, "complexity": 0.41},
    (60.0, PERFECT.name): {"f2": 1.00, "recovery_rate": 0.91, "complexity": 0.40},
}
FIGURE_7: PaperFigures = {(15.0, PERFECT.name): {"recovery_rate": 0.80}, (20.0, PERFECT.name): {"recovery_rate": 0.91}}
FIGURE_8: PaperFigures = {
    (20.0, TREE.name): {"recovery_rate": 0.47},
    (40.0, TREE.name): {"recovery_rate": 0.49},
    (60.0, TREE.name): {"recovery_rate": 0.86},
    (80.0, TREE.name): {"recovery_rate": 0.96},
}
TABLE_2: PaperFigures = {
    (20.0, TREE.name): {"f2": 0.76, "recovery_rate": 0.45, "recovery_rate_25": 0.63},
    (40.0, TREE.name): {"f2": 0.75, "recovery_rate": 0.49, "recovery_rate_25": 0.71},
    (60.0, TREE.name): {"f2": 0.91, "recovery_rate": 0.75, "recovery_rate_25": 0.85},
    (80.0, TREE.name): {"f2": 0.91, "recovery_rate": 0.96, "recovery_rate_25": 0.98},
}


def classifier_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = LAW,
    methods: Methods = (THRESHOLD, TREE, PERFECT, POSTERIOR),
    effort: Effort = EFFORT,
) -> ExperimentResult:
    """Effect of the classifier, table 1 of [1]_; the default method needs none.

    Parameters
    ----------
    drive : CommonDrive
        The drive all vehicles make.
    law : FleetLaw
        How fleets are drawn.
    methods : sequence of Method
        What to compare.
    effort : Effort
        Repetitions, seed, processes.

    Returns
    -------
    ExperimentResult
        A row per reading of the sparsity level and method.
    """
    settings, note = _by_sparsity(partial(artificial_trial, drive), drive, law, (law.sparsity,))
    rows = run_settings(settings, methods, effort, paper=TABLE_1, label="classifier")
    title, record = "Effect of the classifier (table 1)", _record(drive, law, effort)
    return _over_sparsity("classifier", title, rows, record, paper=TABLE_1, note=note)


def sparsity_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = LAW,
    methods: Methods = (TREE, PERFECT, POSTERIOR),
    sparsities: Sequence[float] = SPARSITIES,
    effort: Effort = EFFORT,
) -> ExperimentResult:
    """Effect of the sparsity level, figure 8 of [1]_: levels S [%]; the rest as in :func:`classifier_experiment`."""
    settings, note = _by_sparsity(partial(artificial_trial, drive), drive, law, sparsities)
    rows = run_settings(settings, methods, effort, paper=FIGURE_8, label="sparsity")
    title, record = "Effect of the sparsity level (figure 8)", _record(drive, law, effort, "sparsity")
    return _over_sparsity("sparsity", title, rows, record, paper=FIGURE_8, note=note)


def statespace_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = LAW,
    methods: Methods = (TREE, POSTERIOR),
    sparsities: Sequence[float] = SPARSITIES,
    effort: Effort = EFFORT,
) -> ExperimentResult:
    """End to end with state-space models, table 2 of [1]_; arguments as in :func:`sparsity_experiment`.

    Trees learn from artificial simulation; the paper takes 500 vehicles.
    """
    settings, note = _by_sparsity(partial(state_space_trial, drive), drive, law, sparsities)
    rows = run_settings(settings, methods, effort, paper=TABLE_2, label="statespace")
    title, record = "End to end with state-space models (table 2)", _record(drive, law, effort, "sparsity")
    return _over_sparsity("statespace", title, rows, record, paper=TABLE_2, note=note)


def snr_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = LAW,
    methods: Methods = (PERFECT, POSTERIOR),
    snrs_db: Sequence[float] = SNRS_DB,
    effort: Effort = EFFORT,
) -> ExperimentResult:
    """Effect of the simulation noise, figure 7 of [1]_: perfect classifier, signal-to-noise ratios (26) [dB].

    The other arguments are as in :func:`classifier_experiment`.
    """
    settings = [Setting(x=x, make_trial=partial(artificial_trial, drive, replace(law, snr_db=x))) for x in snrs_db]
    return ExperimentResult(
        name="snr",
        title="Effect of the simulation noise (figure 7)",
        x_label="SNR [dB]",
        settings=_record(drive, law, effort, "snr_db"),
        rows=run_settings(settings, methods, effort, paper=FIGURE_7, label="snr"),
        paper=_best(FIGURE_7),
    )


def asymmetry_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = LAW,
    methods: Methods = (PERFECT, POSTERIOR),
    fleet_sizes: Sequence[int] = FLEET_SIZES,
    sign_biases: Sequence[float] = SIGN_BIASES,
    effort: Effort = EFFORT,
) -> ExperimentResult:
    """Fleets of some sizes N that are not symmetric, whose mean is therefore not the ideal vehicle.

    Faults are positive with probability 0.5 + bias: a bias of 0 is no preference, 0.5 gives all faults one sign. The
    other arguments are as in :func:`classifier_experiment`.
    """
    settings = []
    for bias in sign_biases:
        for size in fleet_sizes:
            one = replace(law, vehicles=size, symmetric=False, sign_bias=bias)
            settings.append(Setting(x=size, series=f"{bias:g}", make_trial=partial(artificial_trial, drive, one)))
    return ExperimentResult(
        name="asymmetry",
        title="Fleets that are not symmetric",
        x_label="vehicles",
        series_label="sign bias",
        settings=_record(drive, replace(law, symmetric=False), effort, "vehicles"),
        rows=run_settings(settings, methods, effort, label="asymmetry"),
    )


def _by_sparsity(
    make_trial: Callable[[FleetLaw, int], Trial], drive: CommonDrive, law: FleetLaw, sparsities: Sequence[float]
) -> tuple[list[Setting], str]:
    """Settings by sparsity level, with both readings of the level at which the paper is quoted, and what they are.

    A share of the 3K parameters that are drawn, or of 3K + 1 as in the paper's example: 2 or 3 of 6 at S = 60.
    """
    settings, note, all_of = [], "", 3 * drive.branches
    for x in sparsities:
        settings.append(Setting(x=x, make_trial=partial(make_trial, replace(law, sparsity=x))))
        first, second = nonzero_count(drive.branches, x), round((1.0 - x / 100.0) * (all_of + 1))
        if x == TWO_READINGS and first != second:
            other, series = replace(law, sparsity=100.0 * (1.0 - second / all_of)), f"{second} of {all_of}"
            settings.append(Setting(x=x, series=series, make_trial=partial(make_trial, other)))
            note = (
                f"S = {x:g} can be read as {first} or {second} of {all_of} parameters that are not zero: {series} "
                f"where the table says so, else {first}. The paper's share of hardware faults fits {second}, its "
                f"recovery fits {first}; its figure stands beside both."
            )
    return settings, note


def _over_sparsity(
    name: str, title: str, rows: tuple[Row, ...], record: Settings, *, paper: PaperFigures, note: str
) -> ExperimentResult:
    return ExperimentResult(
        name=name,
        title=title,
        x_label=SPARSITY_LABEL,
        series_label=READING_LABEL if note else "",
        settings=record,
        rows=rows,
        paper=_best(paper),
        note=note,
    )


def _best(figures: PaperFigures) -> dict[float, float]:
    """Best recovery rate of the paper by x."""
    known = {x for x, _ in figures}
    return {x: max(each["recovery_rate"] for (at, _), each in figures.items() if at == x) for x in sorted(known)}


def _record(drive: CommonDrive, law: FleetLaw, effort: Effort, varied: str = "") -> Settings:
    """What is needed to repeat an experiment, without what it varies."""
    record: dict[str, bool | int | float | str] = {
        "seed": effort.seed,
        "repetitions": effort.repetitions,
        "drive": drive.name,
        "branches": drive.branches,
        "samples": len(drive.i_s),
        "unity_samples": len(drive.unity),
        "full_scale_a": drive.full_scale_a,
        "vehicles": law.vehicles,
        "training_vehicles": law.training_vehicles,
        "magnitude_lowest": law.magnitude[0],
        "magnitude_highest": law.magnitude[1],
        "snr_db": law.snr_db,
        "sparsity": law.sparsity,
        "balanced": law.balanced,
        "symmetric": law.symmetric,
    }
    return {name: value for name, value in record.items() if name != varied}
