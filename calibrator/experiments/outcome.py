"""Outcome of one method on a trial, vehicle by vehicle, and the figures of merit of many such outcomes together.

    recovery_rate, recovery_rate_25  share of vehicles recovered within 10 and 25 %
    confidence                       mean confidence
    sure                             share of vehicles above a confidence of 0.95
    sure_confidence, sure_recovered  their mean confidence, and the share of them that is recovered
    sure_wrong                       share of them that is not recovered, and how many they expect to be
    ece                              expected calibration error: mean over vehicles of |confidence - share recovered| of
                                     the tenth of the scale that their confidence lies in
    ece_by_chance                    what it is expected to be, with so many vehicles, if the confidence is exact
    f2, complexity                   of the hardware classification; share of vehicles held to have hardware faults
    corrected                        share of vehicles of which some branch is corrected
    deployed                         the same, of the vehicles with faulty sensors
    harmed                           share of the vehicles with a corrected branch of which some branch gets worse on an
                                     unseen drive
    worst_a                          largest worsening of a branch's root mean square error [A]
    named                            share of the vehicles attacked of which a finding names the cause
    misnamed                         share of the other vehicles of which a finding names any cause
    gain_within_1, gain_beyond_3     share of the gain errors that are deployed whose distance from the truth is within
                                     1, and beyond 3 standard deviations
    offset_within_1, offset_beyond_3 the same of the offsets
    failed                           share of vehicles whose optimisation failed
    delay_rmse_ms                    root mean square error of the estimated delays [ms]

The expected calibration error is that of [1]_.

.. [1] M. Naeini, G. Cooper, M. Hauskrecht, "Obtaining well calibrated probabilities using Bayesian binning", AAAI 2015.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.stats import norm

from calibrator.drive import Array, Mask
from calibrator.experiments.methods import Estimate
from calibrator.experiments.result import Bin, Figure, share
from calibrator.experiments.trial import Trial
from calibrator.score import f2_score, recovered

__all__ = ["Outcome", "calibration_figures", "confidence_bins", "figures_of", "judge", "pit_counts", "pooled"]

SURE = 0.95
BINS = 10
LEAST_GAIN = 1e-9
"""Corrections divide by 1 + d; nearer to zero there is none. [1]"""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of N vehicles; arrays are of shape (N,) if not said otherwise.

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
    worsening_a : ndarray
        Largest worsening of a branch, at least 0. [A]
    attacked, named : ndarray of bool
        Attacked; with a finding that names the cause, of the others any; of length 0 where nothing is to be named.
    failed : ndarray
        Share of vehicles whose optimisation failed, once per vehicle.
    delay_error_s : ndarray
        Errors of all estimated delays; of length 0 where none were. [s]
    gain_z, offset_z, pit : ndarray
        Of the parameters that are deployed: distances from the truth in standard deviations, and probability integral
        transforms of both together; of length 0 where the method states none. [1]
    """

    recovered: Mask
    recovered_25: Mask
    confidence: Array
    hardware_found: Mask
    hardware: Mask
    faulty: Mask
    corrected: Mask
    harmed: Mask
    worsening_a: Array
    attacked: Mask
    named: Mask
    failed: Array
    delay_error_s: Array
    gain_z: Array
    offset_z: Array
    pit: Array


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

    nothing, never, count = np.zeros(0), np.zeros(0, bool), len(trial.truth)
    worsening_a = _worsening_a(estimate, trial)
    named = never
    if trial.attacked is not None:
        causes = [set(found) for found in estimate.findings] or [set[str]()] * count
        pairs = zip(causes, trial.attacked.tolist(), strict=True)
        named = np.array([bool(found & set(trial.causes)) if attacked else bool(found) for found, attacked in pairs])
    gain_z, offset_z, pit = _deviations(estimate, trial)
    return Outcome(
        recovered=within(0.10),
        recovered_25=within(0.25),
        confidence=nothing if estimate.confidence is None else estimate.confidence,
        hardware_found=estimate.hardware,
        hardware=trial.truth.has_hardware_fault,
        faulty=trial.truth.has_sensor_fault,
        corrected=np.any(estimate.corrected, axis=1),
        harmed=np.any(worsening_a > 0.0, axis=1),
        worsening_a=worsening_a.max(axis=1, initial=0.0),
        attacked=never if trial.attacked is None or not trial.causes else trial.attacked,
        named=named if trial.causes else never,
        failed=np.full(count, estimate.failed / count),
        delay_error_s=nothing if trial.delay_error_s is None else trial.delay_error_s.ravel(),
        gain_z=gain_z,
        offset_z=offset_z,
        pit=pit,
    )


def pooled(outcomes: Sequence[Outcome]) -> Outcome:
    """Vehicles of several outcomes as one."""
    return Outcome(**{f.name: np.concatenate([getattr(o, f.name) for o in outcomes]) for f in fields(Outcome)})


def figures_of(outcome: Outcome) -> dict[str, Figure]:
    """Figures of merit; those that have no meaning for an outcome are not among them.

    Parameters
    ----------
    outcome : Outcome
        Of at least one vehicle.

    Returns
    -------
    dict of str to Figure
        By the names at the top of this module.
    """
    figures = {
        "recovery_rate": _share(outcome.recovered),
        "recovery_rate_25": _share(outcome.recovered_25),
        **_honesty(outcome),
        "f2": Figure(mean=f2_score(outcome.hardware_found, outcome.hardware)),
        "complexity": _share(outcome.hardware_found),
        "corrected": _share(outcome.corrected),
        "deployed": _share(outcome.corrected[outcome.faulty]),
        "harmed": _share(outcome.harmed[outcome.corrected]),
        "worst_a": Figure(mean=float(outcome.worsening_a.max(initial=0.0))),
        "named": _share(outcome.named[outcome.attacked]),
        "misnamed": _share(outcome.named[~outcome.attacked]),
        "gain_within_1": _share(np.abs(outcome.gain_z) <= 1.0),
        "gain_beyond_3": _share(np.abs(outcome.gain_z) > 3.0),
        "offset_within_1": _share(np.abs(outcome.offset_z) <= 1.0),
        "offset_beyond_3": _share(np.abs(outcome.offset_z) > 3.0),
        "failed": Figure(mean=_mean(outcome.failed)),
        "delay_rmse_ms": Figure(mean=1e3 * float(np.sqrt(_mean(outcome.delay_error_s**2)))),
    }
    return {name: figure for name, figure in figures.items() if np.isfinite(figure.mean)}


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


def pit_counts(outcome: Outcome) -> tuple[int, ...]:
    """Deployed parameters by tenths of their probability integral transform; empty where there is none."""
    counts, _ = np.histogram(outcome.pit, bins=BINS, range=(0.0, 1.0))
    return tuple(counts.tolist()) if outcome.pit.size else ()


def calibration_figures(bins: Sequence[Bin]) -> dict[str, Figure]:
    """Expected calibration error of binned confidences, and what chance alone makes of it; NaN without vehicles."""
    count = sum(b.count for b in bins)
    if not count:
        return dict.fromkeys(("ece", "ece_by_chance"), Figure(mean=float("nan")))
    error = sum(b.count * abs(b.confidence - b.recovered) for b in bins)
    chance = sum(np.sqrt(2.0 / np.pi * b.count * b.confidence * (1.0 - b.confidence)) for b in bins)
    return {"ece": Figure(mean=float(error / count)), "ece_by_chance": Figure(mean=float(chance / count))}


def _honesty(outcome: Outcome) -> dict[str, Figure]:
    """Figures of the confidence."""
    if not outcome.confidence.size:
        return {}
    sure = outcome.confidence > SURE
    expected = float(np.sum(1.0 - outcome.confidence[sure]))
    return {
        "confidence": Figure(mean=_mean(outcome.confidence)),
        "sure": _share(sure),
        "sure_confidence": Figure(mean=_mean(outcome.confidence[sure])),
        "sure_recovered": _share(outcome.recovered[sure]),
        "sure_wrong": share(int(np.sum(sure & ~outcome.recovered)), int(sure.sum()), expected=expected),
        **calibration_figures(confidence_bins(outcome)),
    }


def _share(mask: Mask) -> Figure:
    return share(int(np.sum(mask)), mask.size)


def _mean(values: Array) -> float:
    return float(values.mean()) if values.size else float("nan")


def _worsening_a(estimate: Estimate, trial: Trial) -> Array:
    """By how much the corrected branches (N, K) get worse; full scale where the gain is 0, which has no inverse. [A]"""
    drift, offset_a = (np.where(estimate.corrected, x, 0.0) for x in (estimate.faults.drift, estimate.faults.offset_a))
    impossible = np.abs(1.0 + drift) < LEAST_GAIN
    zero = np.zeros_like(drift)
    worsening = trial.unseen.rms_a(np.where(impossible, 0.0, drift), offset_a) - trial.unseen.rms_a(zero, zero)
    return np.where(impossible, trial.full_scale_a, np.where(estimate.corrected, worsening, 0.0))


def _deviations(estimate: Estimate, trial: Trial) -> tuple[Array, Array, Array]:
    """Z of the deployed gain errors and offsets, and the PIT of both."""
    if estimate.drift_sd is None or estimate.offset_sd_a is None:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    deployed = [estimate.corrected & (x != 0.0) for x in (estimate.faults.drift, estimate.faults.offset_a)]
    with np.errstate(divide="ignore", invalid="ignore"):  # a parameter that is not deployed may have no deviation
        gain_z = ((trial.truth.drift - estimate.faults.drift) / estimate.drift_sd)[deployed[0]]
        offset_z = ((trial.truth.offset_a - estimate.faults.offset_a) / estimate.offset_sd_a)[deployed[1]]
    if estimate.pit is None:
        return gain_z, offset_z, norm.cdf(np.concatenate([gain_z, offset_z]))
    pits = estimate.pit(trial.truth)
    return gain_z, offset_z, np.concatenate([pit[mask] for pit, mask in zip(pits, deployed, strict=True)])
