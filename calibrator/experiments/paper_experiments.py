"""Experiments on one drive that all vehicles make: the four of section V of [1]_, and fleets that are not symmetric.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from calibrator.experiments.common_drive import CommonDrive
from calibrator.experiments.common_trial import artificial_trial, state_space_trial
from calibrator.experiments.judging import Effort, PaperFigures, Setting, run_settings
from calibrator.experiments.methods import PERFECT, POSTERIOR, THRESHOLD, TREE, Method
from calibrator.experiments.result import ExperimentResult, Settings
from calibrator.experiments.trial import FleetLaw

__all__ = [
    "asymmetry_experiment",
    "classifier_experiment",
    "snr_experiment",
    "sparsity_experiment",
    "statespace_experiment",
]

SPARSITIES = (20.0, 40.0, 60.0, 80.0)
SNRS_DB = (-20.0, -10.0, 0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0)
FLEET_SIZES = (20, 100, 400, 2000)
SIGN_BIASES = (0.0, 0.2, 0.4, 0.5)
DEFAULT_LAW = FleetLaw()
DEFAULT_EFFORT = Effort()
SPARSITY_LABEL = "sparsity S [%]"

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
    law: FleetLaw = DEFAULT_LAW,
    methods: Sequence[Method] = (THRESHOLD, TREE, PERFECT, POSTERIOR),
    effort: Effort = DEFAULT_EFFORT,
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
        One row per method.
    """
    setting = Setting(x=law.sparsity, make_trial=partial(artificial_trial, drive, law))
    return ExperimentResult(
        name="classifier",
        title="Effect of the classifier (table 1)",
        x_label=SPARSITY_LABEL,
        settings=_record(drive, law, effort),
        rows=run_settings([setting], methods, effort, paper=TABLE_1, label="classifier"),
        paper=_best(TABLE_1),
    )


def snr_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = DEFAULT_LAW,
    methods: Sequence[Method] = (PERFECT, POSTERIOR),
    snrs_db: Sequence[float] = SNRS_DB,
    effort: Effort = DEFAULT_EFFORT,
) -> ExperimentResult:
    """Effect of the simulation noise, figure 7 of [1]_: perfect classifier, SNR from -20 to 60 dB.

    Parameters
    ----------
    snrs_db : sequence of float
        Signal-to-noise ratios (26). [dB]
    drive, law, methods, effort
        As in :func:`classifier_experiment`.

    Returns
    -------
    ExperimentResult
        Rows by SNR and method.
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


def sparsity_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = DEFAULT_LAW,
    methods: Sequence[Method] = (TREE, PERFECT, POSTERIOR),
    sparsities: Sequence[float] = SPARSITIES,
    effort: Effort = DEFAULT_EFFORT,
) -> ExperimentResult:
    """Effect of the sparsity level, figure 8 of [1]_.

    Parameters
    ----------
    sparsities : sequence of float
        Levels S. [%]
    drive, law, methods, effort
        As in :func:`classifier_experiment`.

    Returns
    -------
    ExperimentResult
        Rows by sparsity and method.
    """
    settings = [Setting(x=x, make_trial=partial(artificial_trial, drive, replace(law, sparsity=x))) for x in sparsities]
    return ExperimentResult(
        name="sparsity",
        title="Effect of the sparsity level (figure 8)",
        x_label=SPARSITY_LABEL,
        settings=_record(drive, law, effort, "sparsity"),
        rows=run_settings(settings, methods, effort, paper=FIGURE_8, label="sparsity"),
        paper=_best(FIGURE_8),
    )


def statespace_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = DEFAULT_LAW,
    methods: Sequence[Method] = (TREE, POSTERIOR),
    sparsities: Sequence[float] = SPARSITIES,
    effort: Effort = DEFAULT_EFFORT,
) -> ExperimentResult:
    """End to end with state-space models, table 2 of [1]_; trees learn from artificial simulation.

    Parameters
    ----------
    sparsities : sequence of float
        Levels S. [%]
    drive, law, methods, effort
        As in :func:`classifier_experiment`; the paper takes 500 vehicles.

    Returns
    -------
    ExperimentResult
        Rows by sparsity and method.
    """
    settings = [
        Setting(x=x, make_trial=partial(state_space_trial, drive, replace(law, sparsity=x))) for x in sparsities
    ]
    return ExperimentResult(
        name="statespace",
        title="End to end with state-space models (table 2)",
        x_label=SPARSITY_LABEL,
        settings=_record(drive, law, effort, "sparsity"),
        rows=run_settings(settings, methods, effort, paper=TABLE_2, label="statespace"),
        paper=_best(TABLE_2),
    )


def asymmetry_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = DEFAULT_LAW,
    methods: Sequence[Method] = (PERFECT, POSTERIOR),
    fleet_sizes: Sequence[int] = FLEET_SIZES,
    sign_biases: Sequence[float] = SIGN_BIASES,
    effort: Effort = DEFAULT_EFFORT,
) -> ExperimentResult:
    """Fleets that are not symmetric, whose mean is therefore not the ideal vehicle.

    Parameters
    ----------
    fleet_sizes : sequence of int
        Sizes N.
    sign_biases : sequence of float
        Faults are positive with probability 0.5 + bias: 0 is no preference, 0.5 gives all faults one sign. [1]
    drive, law, methods, effort
        As in :func:`classifier_experiment`.

    Returns
    -------
    ExperimentResult
        Rows by bias, size and method.
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
