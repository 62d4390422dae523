"""Outcome of one method on a trial, vehicle by vehicle, and the figures of merit of many such outcomes together.

    recovery_rate, recovery_rate_25  share of vehicles recovered within 10 and 25 %
    confidence                       mean confidence
    sure                             share of vehicles above a confidence of 0.95
    sure_confidence, sure_recovered  their mean confidence, and the share of them that is recovered
    ece                              expected calibration error: mean over vehicles of |confidence - share recovered| of
                                     the tenth of the scale that their confidence lies in
    ece_by_chance                    what it is expected to be, with so many vehicles, if the confidence is exact
    f2, complexity                   of the hardware classification; share of vehicles held to have hardware faults
    deployed                         share of the vehicles with faulty sensors of which some branch is corrected
    harmed                           share of the vehicles with a corrected branch of which some branch gets worse on an
                                     unseen drive
    failed                           share of vehicles whose optimisation failed
    delay_rmse_ms                    root mean square error of the estimated delays [ms]

The expected calibration error is that of [1]_.

.. [1] M. Naeini, G. Cooper, M. Hauskrecht, "Obtaining well calibrated probabilities using Bayesian binning", AAAI 2015.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.experiments.methods import Estimate
from calibrator.experiments.result import Bin
from calibrator.experiments.trial import Trial
from calibrator.score import f2_score, harmed, recovered

__all__ = ["Outcome", "calibration_figures", "confidence_bins", "figures_of", "judge", "pooled"]

SURE = 0.95
BINS = 10


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of N vehicles; arrays are of shape (N,).

    Attributes
    ----------
    recovered, recovered_25 : ndarray of bool
        Within 10 and 25 %.
    confidence : ndarray
        Of the method; of length 0 where it does not say.
    hardware_found, hardware : ndarray of bool
        Held to have a hardware fault, and having one.
    faulty, corrected, harmed : ndarray of bool
        With a faulty sensor; with a corrected branch; with a branch that gets worse.
    failed : ndarray
        Share of vehicles whose optimisation failed, once per vehicle.
    delay_error_s : ndarray
        Errors of all estimated delays; of length 0 where none were. [s]
    """

    recovered: Mask
    recovered_25: Mask
    confidence: Array
    hardware_found: Mask
    hardware: Mask
    faulty: Mask
    corrected: Mask
    harmed: Mask
    failed: Array
    delay_error_s: Array


def judge(estimate: Estimate, trial: Trial) -> Outcome:
    """Compare an estimate with the truth.

    Parameters
    ----------
    estimate : Estimate
        What a method found.
    trial : Trial
        With the truth.

    Returns
    -------
    Outcome
        Vehicle by vehicle.
    """

    def within(tolerance: float) -> Mask:
        return recovered(
            estimate.faults,
            trial.truth,
            full_scale_a=trial.full_scale_a,
            smallest_fault=trial.smallest_fault,
            tolerance=tolerance,
        )

    nothing, count = np.zeros(0), len(trial.truth)
    return Outcome(
        recovered=within(0.10),
        recovered_25=within(0.25),
        confidence=nothing if estimate.confidence is None else estimate.confidence,
        hardware_found=estimate.hardware,
        hardware=trial.truth.has_hardware_fault,
        faulty=trial.truth.has_sensor_fault,
        corrected=np.any(estimate.corrected, axis=1),
        harmed=_harmed(estimate, trial),
        failed=np.full(count, estimate.failed / count),
        delay_error_s=nothing if trial.delay_error_s is None else trial.delay_error_s.ravel(),
    )


def pooled(outcomes: Sequence[Outcome]) -> Outcome:
    """Vehicles of several outcomes as one."""
    return Outcome(**{f.name: np.concatenate([getattr(o, f.name) for o in outcomes]) for f in fields(Outcome)})


def figures_of(outcome: Outcome) -> dict[str, float]:
    """Figures of merit; those that have no meaning for an outcome are not among them.

    Parameters
    ----------
    outcome : Outcome
        Of at least one vehicle.

    Returns
    -------
    dict of str to float
        By the names at the top of this module.
    """
    figures = {
        "recovery_rate": _share(outcome.recovered),
        "recovery_rate_25": _share(outcome.recovered_25),
        **_honesty(outcome),
        "f2": f2_score(outcome.hardware_found, outcome.hardware),
        "complexity": _share(outcome.hardware_found),
        "deployed": _share(outcome.corrected[outcome.faulty]),
        "harmed": _share(outcome.harmed[outcome.corrected]),
        "failed": float(outcome.failed.mean()),
        "delay_rmse_ms": 1e3 * float(np.sqrt(_share(outcome.delay_error_s**2))),
    }
    return {name: float(value) for name, value in figures.items() if np.isfinite(value)}


def confidence_bins(outcome: Outcome) -> tuple[Bin, ...]:
    """Vehicles by tenths of the confidence; empty tenths are left out, and all are where a method does not say."""
    number = np.minimum((outcome.confidence * BINS).astype(int), BINS - 1)
    bins = []
    for which in np.unique(number).tolist():
        inside = number == which
        bins.append(
            Bin(
                low=which / BINS,
                count=int(inside.sum()),
                confidence=float(outcome.confidence[inside].mean()),
                recovered=float(outcome.recovered[inside].mean()),
            )
        )
    return tuple(bins)


def calibration_figures(bins: Sequence[Bin]) -> dict[str, float]:
    """Expected calibration error of binned confidences, and what chance alone makes of it; NaN without vehicles."""
    count = sum(b.count for b in bins)
    if not count:
        return dict.fromkeys(("ece", "ece_by_chance"), float("nan"))
    error = sum(b.count * abs(b.confidence - b.recovered) for b in bins)
    chance = sum(np.sqrt(2.0 / np.pi * b.count * b.confidence * (1.0 - b.confidence)) for b in bins)
    return {"ece": float(error / count), "ece_by_chance": float(chance / count)}


def _honesty(outcome: Outcome) -> dict[str, float]:
    """Figures of the confidence."""
    if not outcome.confidence.size:
        return {}
    sure = outcome.confidence > SURE
    return {
        "confidence": float(outcome.confidence.mean()),
        "sure": _share(sure),
        "sure_confidence": _share(outcome.confidence[sure]),
        "sure_recovered": _share(outcome.recovered[sure]),
        **calibration_figures(confidence_bins(outcome)),
    }


def _share(values: Array | Mask) -> float:
    return float(values.mean()) if values.size else float("nan")


def _harmed(estimate: Estimate, trial: Trial) -> Mask:
    """Whether a branch gets worse, shape (N,); a drift of -1 or less, for which there is no correction, is harm."""
    absurd = estimate.corrected & (estimate.faults.drift <= -1.0)
    applied = estimate.corrected & ~absurd
    deployed = replace(
        estimate.faults,
        drift=np.where(applied, estimate.faults.drift, 0.0),
        offset_a=np.where(applied, estimate.faults.offset_a, 0.0),
    )
    unseen = trial.unseen
    worse = harmed(deployed, trial.truth, mean_a=unseen.mean_a, mean_square_a2=unseen.mean_square_a2)
    return np.asarray(worse | absurd.any(axis=1))
