"""Run methods on many trials, judge them and average."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from joblib import Parallel, delayed

from calibrator.experiments.common_drive import CommonDrive
from calibrator.experiments.methods import Method
from calibrator.experiments.result import Figure, Row
from calibrator.experiments.trial import FleetLaw, Trial
from calibrator.published.recovery import Recovery
from calibrator.score import f2_score, recovery_rate

__all__ = ["PaperFigures", "judge", "law_settings", "run_laws", "with_sparsity"]

PaperFigures = Mapping[tuple[float, str], Mapping[str, float]]
"""Figures of the paper by (x, method) and name."""
MakeTrial = Callable[[CommonDrive, FleetLaw, int], Trial]


def judge(recovery: Recovery, trial: Trial) -> dict[str, float]:
    """Figures of merit of one trial.

    Parameters
    ----------
    recovery : Recovery
        What the method found.
    trial : Trial
        With the truth.

    Returns
    -------
    dict
        recovery_rate, recovery_rate_25, f2 of the hardware classification, complexity (share of vehicles held to
        have hardware faults), failed (share of vehicles whose optimisation failed).
    """

    def rate(tolerance: float) -> float:
        return recovery_rate(
            recovery.faults,
            trial.truth,
            full_scale_a=trial.full_scale_a,
            smallest_fault=trial.law.magnitude[0],
            tolerance=tolerance,
        )

    hardware = recovery.classification.hardware
    return {
        "recovery_rate": rate(0.10),
        "recovery_rate_25": rate(0.25),
        "f2": f2_score(hardware, trial.truth.has_hardware_fault),
        "complexity": float(hardware.mean()),
        "failed": len(recovery.failed) / len(recovery),
    }


def run_laws(
    drive: CommonDrive,
    laws: Mapping[float, FleetLaw],
    methods: Sequence[Method],
    *,
    make_trial: MakeTrial,
    repetitions: int,
    seed: int,
    jobs: int,
    paper: PaperFigures,
) -> tuple[Row, ...]:
    """Run every method on the same trials of every law.

    Parameters
    ----------
    drive : CommonDrive
        The drive all vehicles make.
    laws : mapping of float to FleetLaw
        Law by the value of what the experiment varies.
    methods : sequence of Method
        What to compare.
    make_trial : callable
        Makes the trial of a drive, a law and a seed; of module level, as it goes to other processes.
    repetitions, seed : int
        Trials per law, and the seed of the first.
    jobs : int
        Processes.
    paper : mapping
        Figures of the paper.

    Returns
    -------
    tuple of Row
        By law, then method.
    """
    tasks = [(x, seed + repetition) for x in laws for repetition in range(repetitions)]
    judged = Parallel(n_jobs=jobs)(delayed(_run_trial)(drive, laws[x], methods, make_trial, s) for x, s in tasks)
    rows = []
    for x in laws:
        for k, method in enumerate(methods):
            trials = [figures[k] for (task_x, _), figures in zip(tasks, judged, strict=True) if task_x == x]
            rows.append(_row(x, method.name, trials, paper.get((x, method.name), {})))
    return tuple(rows)


def law_settings(drive: CommonDrive, law: FleetLaw, *, repetitions: int, seed: int) -> dict[str, float | int | str]:
    """What is needed to repeat an experiment, for its record."""
    return {
        "seed": seed,
        "repetitions": repetitions,
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
        "balanced": str(law.balanced).lower(),
        "symmetric": str(law.symmetric).lower(),
    }


def with_sparsity(law: FleetLaw, levels: Sequence[float]) -> dict[float, FleetLaw]:
    """Laws by sparsity level."""
    return {level: replace(law, sparsity=level) for level in levels}


def _run_trial(
    drive: CommonDrive, law: FleetLaw, methods: Sequence[Method], make_trial: MakeTrial, seed: int
) -> list[dict[str, float]]:
    trial = make_trial(drive, law, seed)
    return [judge(method.recover(trial), trial) for method in methods]


def _row(x: float, method: str, trials: list[dict[str, float]], paper: Mapping[str, float]) -> Row:
    figures = {}
    for name in trials[0]:
        values = np.array([trial[name] for trial in trials])
        sd = float(values.std(ddof=1)) if len(values) > 1 else 0.0
        figures[name] = Figure(mean=float(values.mean()), sd=sd, paper=paper.get(name))
    return Row(x=x, method=method, figures=figures)
