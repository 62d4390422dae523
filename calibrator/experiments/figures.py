"""Figures of merit, which compare a method's estimate of a trial with the truth, and the table of their meanings.

Every figure is one number made of many values, mostly their mean: :func:`judge` gives the values of one trial,
:func:`figure_rows` the figures of several trials together. The expected calibration error is that of [1]_, intervals
are those of [2]_, for which vehicles are independent.

.. [1] M. Naeini, G. Cooper, M. Hauskrecht, "Obtaining well calibrated probabilities using Bayesian binning", AAAI 2015.
.. [2] C. Clopper, E. Pearson, "The use of confidence or fiducial limits ...", Biometrika 26 (1934).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import binomtest, norm

from calibrator.drive import Array
from calibrator.experiments.trial import Estimate, Trial
from calibrator.score import f2_score, recovered

__all__ = ["FIGURES", "calibration_errors", "figure_rows", "judge", "tenths_of"]

SURE = 0.95
"""A vehicle counts as sure if its confidence is above this. [1]"""
LEAST_GAIN = 1e-9
"""Least magnitude of 1 + d, by which corrections divide; nearer to zero there is no correction. [1]"""
TENTHS = np.arange(10) / 10.0

Values = Mapping[str, NDArray[Any]]
"""Values of one or several trials, an array by name of the figure; those of a share are true or false."""


class FigureKind(NamedTuple):
    """Meaning of a figure, function that makes it from its values, and whether it is so rare that counts are shown."""

    meaning: str
    merged: Callable[[NDArray[Any]], Any] = np.mean
    rare: bool = False


def _error(which: int) -> Callable[[Array], float]:
    return lambda pairs: calibration_errors(tenths_of({"ece": pairs}))[which]


FIGURES = {
    "recovery_rate": FigureKind("share of vehicles recovered within 10 %"),
    "recovery_rate_25": FigureKind("the same within 25 %"),
    "f2": FigureKind("of the hardware classification", lambda pairs: f2_score(*pairs.T)),
    "complexity": FigureKind("share of vehicles held to have a hardware fault"),
    "confidence": FigureKind("mean confidence"),
    "sure": FigureKind("share of vehicles with a confidence above 0.95"),
    "sure_confidence": FigureKind("mean confidence of these"),
    "sure_recovered": FigureKind("share of these that is recovered"),
    "sure_wrong": FigureKind("share of these that is not", rare=True),
    "ece": FigureKind("expected calibration error, by tenths of the confidence", _error(0)),
    "ece_by_chance": FigureKind("what it is by chance if the confidence is exact", _error(1)),
    "corrected": FigureKind("share of the vehicles that is corrected in some branch"),
    "deployed": FigureKind("share of the vehicles with faulty sensors that is corrected in some branch"),
    "harmed": FigureKind(
        "share of the corrected vehicles of which some branch gets worse on an unseen drive, however little", rare=True
    ),
    "worst_a": FigureKind("largest worsening of a branch's root mean square error [A]", np.max),
    "named": FigureKind("share of the vehicles attacked of which a finding names the cause", rare=True),
    "misnamed": FigureKind("share of the others of which a finding names any cause", rare=True),
    "gain_within_1": FigureKind("share of the deployed gain errors within 1 standard deviation of the truth"),
    "gain_beyond_3": FigureKind("the same beyond 3", rare=True),
    "offset_within_1": FigureKind("share of the deployed offsets within 1 standard deviation of the truth"),
    "offset_beyond_3": FigureKind("the same beyond 3", rare=True),
    "delay_rmse_ms": FigureKind(
        "root mean square error of the estimated delays [ms]", lambda e: np.sqrt(np.mean(e**2))
    ),
    "failed": FigureKind("share of vehicles whose optimisation failed"),
}
"""Figures in the order of the columns of tables; pages of results explain them in these words."""


def judge(estimate: Estimate, trial: Trial) -> dict[str, NDArray[Any]]:
    """Compare an estimate with the truth, and return the values of which figures are made.

    Parameters
    ----------
    estimate : Estimate
        Estimate of a method.
    trial : Trial
        Trial, with the truth.

    Returns
    -------
    dict of str to ndarray
        By figure of :data:`FIGURES`, one value per vehicle, parameter or delay that counts in it. Those of ``f2`` are
        pairs (classified as faulty, truly faulty), those of ``ece`` pairs (confidence, recovered). ``pit`` holds the
        probability integral transforms of the deployed parameters. Figures that have no meaning here are left out.
    """
    truth, faults, N = trial.truth, estimate.faults, len(trial.truth)
    scales = {"full_scale_a": trial.full_scale_a, "smallest_fault": trial.smallest_fault}
    within, within_25 = (recovered(faults, truth, tolerance=t, **scales) for t in (0.10, 0.25))
    corrected, worsening_a = np.any(estimate.corrected, axis=1), _worsening_a(estimate, trial)
    values: dict[str, NDArray[Any]] = {
        "recovery_rate": within,
        "recovery_rate_25": within_25,
        "f2": np.column_stack([estimate.hardware, truth.has_hardware_fault]),
        "complexity": estimate.hardware,
        "corrected": corrected,
        "deployed": corrected[truth.has_sensor_fault],
        "harmed": np.any(worsening_a > 0.0, axis=1)[corrected],
        "worst_a": worsening_a.max(axis=1, initial=0.0),
        "failed": np.full(N, estimate.failed / N),
    }
    if estimate.confidence is not None:
        confidence, sure = estimate.confidence, estimate.confidence > SURE
        pairs = np.column_stack([confidence, within])
        values |= {"confidence": confidence, "sure": sure, "ece": pairs, "ece_by_chance": pairs}
        values |= {"sure_confidence": confidence[sure], "sure_recovered": within[sure], "sure_wrong": ~within[sure]}
    if trial.attacked is not None and trial.causes:
        causes = [set(found) for found in estimate.findings] or [set[str]()] * N
        values["named"] = np.array([not found.isdisjoint(trial.causes) for found in causes])[trial.attacked]
        values["misnamed"] = np.array([bool(found) for found in causes])[~trial.attacked]
    if trial.delay_error_s is not None:
        values["delay_rmse_ms"] = 1e3 * trial.delay_error_s.ravel()
    if estimate.drift_sd is not None and estimate.offset_sd_a is not None:
        true, found = (truth.drift, truth.offset_a), (faults.drift, faults.offset_a)
        sds, pits = (estimate.drift_sd, estimate.offset_sd_a), estimate.pit(truth) if estimate.pit else None
        transforms = []
        for k, name in enumerate(("gain", "offset")):
            deployed = estimate.corrected & (found[k] != 0.0)
            z = ((true[k] - found[k]) / np.where(deployed, sds[k], 1.0))[deployed]
            values[f"{name}_within_1"], values[f"{name}_beyond_3"] = np.abs(z) <= 1.0, np.abs(z) > 3.0
            transforms.append(norm.cdf(z) if pits is None else pits[k][deployed])
        values["pit"] = np.concatenate(transforms)
    return values


def _worsening_a(estimate: Estimate, trial: Trial) -> Array:
    """Return by how much correction raises the root mean square error of each branch on the unseen drive, (N, K). [A]

    It is negative where correction helps, 0 where nothing is corrected, and full scale where 1 + d is 0.
    """
    drift, offset_a = (np.where(estimate.corrected, x, 0.0) for x in (estimate.faults.drift, estimate.faults.offset_a))
    impossible = np.abs(1.0 + drift) < LEAST_GAIN
    worsening = trial.unseen.worsening_a(np.where(impossible, 0.0, drift), offset_a)
    return np.where(impossible, trial.full_scale_a, np.where(estimate.corrected, worsening, 0.0))


def figure_rows(trials: Sequence[Values]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the figures of one method over the trials of one setting.

    Parameters
    ----------
    trials : sequence of mapping
        Values of each trial, from :func:`judge`.

    Returns
    -------
    figures : DataFrame
        A row per figure: its name (``figure``), ``value``, standard deviation ``sd`` over the trials (0 for a single
        one), and ``of``, the number of its values; for a share also its 95 % interval, from ``low`` to ``high``.
    tenths : DataFrame
        Vehicles by tenths of their confidence, see :func:`tenths_of`.
    """
    names = dict.fromkeys(name for trial in trials for name in trial)
    parts = {name: [trial[name] for trial in trials if len(trial.get(name, ()))] for name in names}
    together = {name: np.concatenate(own) for name, own in parts.items() if own}
    rows = []
    for name, kind in FIGURES.items():
        if name in together:
            values, singly = together[name], [kind.merged(own) for own in parts[name]]
            sd = float(np.std(singly, ddof=1)) if len(singly) > 1 else 0.0
            rows.append((name, float(kind.merged(values)), sd, len(values), *_interval(values)))
    return pd.DataFrame(rows, columns=["figure", "value", "sd", "of", "low", "high"]), tenths_of(together)


def _interval(values: NDArray[Any]) -> tuple[float, float]:
    """Return the ends of the 95 % interval of a share, whose values are true or false; NaN for other figures."""
    if values.dtype != bool or values.ndim > 1:
        return float("nan"), float("nan")
    interval = binomtest(int(values.sum()), len(values)).proportion_ci(0.95, method="exact")
    return float(interval.low), float(interval.high)


def tenths_of(values: Values) -> pd.DataFrame:
    """Count vehicles by tenths of confidence, deployed parameters by tenths of their probability integral transform.

    Returns a row per tenth: its lower end ``low``; number of ``vehicles`` in it, their mean ``confidence`` and the
    share of them that is ``recovered`` (NaN of none); number of parameters whose transform is in it, ``pit``.
    """
    pairs, pit = (values.get(name, np.zeros((0, 2))) for name in ("ece", "pit"))
    number = np.minimum((pairs[:, 0] * len(TENTHS)).astype(int), len(TENTHS) - 1)
    grouped = pd.DataFrame(pairs, columns=["confidence", "recovered"], dtype=float).groupby(number)
    tenths = grouped.mean().assign(vehicles=grouped.size()).reindex(range(len(TENTHS)))
    counts, _ = np.histogram(pit, bins=len(TENTHS), range=(0.0, 1.0))
    tenths = tenths.assign(low=TENTHS, pit=counts).fillna({"vehicles": 0})
    return tenths[["low", "vehicles", "confidence", "recovered", "pit"]]


def calibration_errors(tenths: pd.DataFrame) -> tuple[float, float]:
    """Return the expected calibration error by tenths of confidence, and what exact confidences give by chance. [1]"""
    vehicles, confidence = tenths["vehicles"].to_numpy(float), tenths["confidence"].to_numpy(float)
    error = vehicles * np.abs(confidence - tenths["recovered"].to_numpy(float))
    chance = np.sqrt(2.0 / np.pi * vehicles * confidence * (1.0 - confidence))
    return float(np.nansum(error) / vehicles.sum()), float(np.nansum(chance) / vehicles.sum())
