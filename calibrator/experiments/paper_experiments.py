"""The four experiments of section V of [1]_, each a function of keyword arguments only.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import replace

from calibrator.experiments.common_drive import CommonDrive
from calibrator.experiments.judging import PaperFigures, law_settings, run_laws, with_sparsity
from calibrator.experiments.methods import PERFECT, THRESHOLD, TREE, Method
from calibrator.experiments.result import ExperimentResult
from calibrator.experiments.trial import FleetLaw, Trial, artificial_trial, state_space_trial

__all__ = ["classifier_experiment", "snr_experiment", "sparsity_experiment", "statespace_experiment"]

SPARSITIES = (20.0, 40.0, 60.0, 80.0)
SNRS_DB = (-20.0, -10.0, 0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0)
DEFAULT_LAW = FleetLaw()

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
    methods: Sequence[Method] = (THRESHOLD, TREE, PERFECT),
    repetitions: int = 10,
    seed: int = 0,
    jobs: int = 1,
) -> ExperimentResult:
    """Effect of the classifier, table 1 of [1]_.

    Parameters
    ----------
    drive : CommonDrive
        The drive all vehicles make.
    law : FleetLaw
        How fleets are drawn.
    methods : sequence of Method
        What to compare.
    repetitions, seed, jobs : int
        Trials, seed of the first, processes.

    Returns
    -------
    ExperimentResult
        One row per method.
    """
    rows = run_laws(
        drive,
        {law.sparsity: law},
        methods,
        make_trial=_artificial,
        repetitions=repetitions,
        seed=seed,
        jobs=jobs,
        paper=TABLE_1,
    )
    return ExperimentResult(
        name="classifier",
        title="Effect of the classifier (table 1)",
        x_label="sparsity S [%]",
        settings=law_settings(drive, law, repetitions=repetitions, seed=seed),
        rows=rows,
    )


def snr_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = DEFAULT_LAW,
    methods: Sequence[Method] = (PERFECT,),
    snrs_db: Sequence[float] = SNRS_DB,
    repetitions: int = 10,
    seed: int = 0,
    jobs: int = 1,
) -> ExperimentResult:
    """Effect of the simulation noise, figure 7 of [1]_: perfect classifier, SNR from -20 to 60 dB.

    Parameters
    ----------
    snrs_db : sequence of float
        Signal-to-noise ratios (26). [dB]
    drive, law, methods, repetitions, seed, jobs
        As in :func:`classifier_experiment`.

    Returns
    -------
    ExperimentResult
        Rows by SNR and method.
    """
    rows = run_laws(
        drive,
        {snr: replace(law, snr_db=snr) for snr in snrs_db},
        methods,
        make_trial=_artificial,
        repetitions=repetitions,
        seed=seed,
        jobs=jobs,
        paper=FIGURE_7,
    )
    return ExperimentResult(
        name="snr",
        title="Effect of the simulation noise (figure 7)",
        x_label="SNR [dB]",
        settings=law_settings(drive, law, repetitions=repetitions, seed=seed),
        rows=rows,
    )


def sparsity_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = DEFAULT_LAW,
    methods: Sequence[Method] = (TREE,),
    sparsities: Sequence[float] = SPARSITIES,
    repetitions: int = 10,
    seed: int = 0,
    jobs: int = 1,
) -> ExperimentResult:
    """Effect of the sparsity level, figure 8 of [1]_.

    Parameters
    ----------
    sparsities : sequence of float
        Levels S. [%]
    drive, law, methods, repetitions, seed, jobs
        As in :func:`classifier_experiment`.

    Returns
    -------
    ExperimentResult
        Rows by sparsity and method.
    """
    rows = run_laws(
        drive,
        with_sparsity(law, sparsities),
        methods,
        make_trial=_artificial,
        repetitions=repetitions,
        seed=seed,
        jobs=jobs,
        paper=FIGURE_8,
    )
    return ExperimentResult(
        name="sparsity",
        title="Effect of the sparsity level (figure 8)",
        x_label="sparsity S [%]",
        settings=law_settings(drive, law, repetitions=repetitions, seed=seed),
        rows=rows,
    )


def statespace_experiment(
    *,
    drive: CommonDrive,
    law: FleetLaw = DEFAULT_LAW,
    methods: Sequence[Method] = (TREE,),
    sparsities: Sequence[float] = SPARSITIES,
    repetitions: int = 10,
    seed: int = 0,
    jobs: int = 1,
) -> ExperimentResult:
    """End to end with state-space models, table 2 of [1]_; trees learn from artificial simulation.

    Parameters
    ----------
    sparsities : sequence of float
        Levels S. [%]
    drive, law, methods, repetitions, seed, jobs
        As in :func:`classifier_experiment`; the paper takes 500 vehicles.

    Returns
    -------
    ExperimentResult
        Rows by sparsity and method.
    """
    rows = run_laws(
        drive,
        with_sparsity(law, sparsities),
        methods,
        make_trial=_state_space,
        repetitions=repetitions,
        seed=seed,
        jobs=jobs,
        paper=TABLE_2,
    )
    return ExperimentResult(
        name="statespace",
        title="End to end with state-space models (table 2)",
        x_label="sparsity S [%]",
        settings=law_settings(drive, law, repetitions=repetitions, seed=seed),
        rows=rows,
    )


def _artificial(drive: CommonDrive, law: FleetLaw, seed: int) -> Trial:
    return artificial_trial(drive, law, seed=seed)


def _state_space(drive: CommonDrive, law: FleetLaw, seed: int) -> Trial:
    return state_space_trial(drive, law, seed=seed)
