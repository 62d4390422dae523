"""Methods that experiments compare: a trial in, estimated faults out.

A method of your own is any object with a ``name`` and a function ``estimate(trial)`` that returns an :class:`Estimate`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.estimator.decision import RowsEstimate, estimate_rows
from calibrator.estimator.fleet_estimate import HARM_LIMIT, estimate_vehicles, learn_fleet
from calibrator.estimator.learning import learn_fault_models
from calibrator.estimator.prior import Prior, known_prior
from calibrator.experiments.trial import CommonEvidence, FaultDistribution, Trial
from calibrator.faults import Faults
from calibrator.published.classify import Classification, FaultTrees, classify_by_threshold, classify_by_truth
from calibrator.published.recovery import recover_fleet

__all__ = [
    "CEILING",
    "LEFT_IN",
    "PERFECT",
    "POSTERIOR",
    "THRESHOLD",
    "TREE",
    "ComparedMethod",
    "Estimate",
    "Posterior",
    "Published",
    "require_estimate",
]  # fmt: skip

ROUNDING = 1e-9
"""By which a probability may leave 0 to 1. [1]"""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What a method says of N vehicles with K branches.

    Attributes
    ----------
    faults : Faults
        Estimate.
    hardware : ndarray of bool of shape (N,)
        Vehicles held to have a hardware fault.
    corrected : ndarray of bool of shape (N, K)
        Branches that would be corrected in the vehicle; the others pass through.
    confidence : ndarray of shape (N,) or None
        Probability of being recovered; None: the method does not say.
    failed : int
        Vehicles whose optimisation failed.
    drift_sd, offset_sd_a : ndarray of shape (N, K) or None
        Standard deviations of the sensors' parameters, if the method states them. [1], [A]
    pit : callable or None
        Probability integral transform of true faults under the posterior, (drift, offset) each of shape (N, K); None:
        that of a normal distribution with these standard deviations.
    findings : sequence of N sequences of str
        Causes that the method names of each vehicle, besides faults; empty if it names none.
    redraw : callable or None
        Draws the faults of so many vehicles from the prior that the method has learnt.
    """

    faults: Faults
    hardware: Mask
    corrected: Mask
    confidence: Array | None
    failed: int
    drift_sd: Array | None = None
    offset_sd_a: Array | None = None
    pit: Callable[[Faults], tuple[Array, Array]] | None = None
    findings: Sequence[Sequence[str]] = ()
    redraw: Callable[[np.random.Generator, int], Faults] | None = None


class ComparedMethod(Protocol):
    """Anything that recovers a fleet."""

    @property
    def name(self) -> str:
        """Short name for tables."""

    def estimate(self, trial: Trial) -> Estimate:
        """Estimate the faults of all vehicles of a trial."""


@dataclass(frozen=True, kw_only=True)
class Published:
    """The published method with one of its classifiers; whatever it finds is corrected.

    Attributes
    ----------
    name : str
        Name of the classifier.
    classify : callable
        The classifier.
    """

    name: str
    classify: Callable[[Trial], Classification]

    def estimate(self, trial: Trial) -> Estimate:
        """Classify, then recover by the four cases."""
        recovery = recover_fleet(trial.evidence, self.classify(trial), full_scale_a=trial.full_scale_a)
        return Estimate(
            faults=recovery.faults,
            hardware=recovery.classification.hardware,
            corrected=(recovery.faults.drift != 0.0) | (recovery.faults.offset_a != 0.0),
            confidence=None,
            failed=len(recovery.failed),
        )


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """The default method.

    Attributes
    ----------
    name : str
        As on the command line.
    knows_distribution : bool
        Whether it is told how the faults were drawn, to show the ceiling; the default is told nothing.
    """

    name: str = "posterior"
    knows_distribution: bool = False

    def estimate(self, trial: Trial) -> Estimate:
        """Estimate, and correct the branches that are hardly ever made worse."""
        known = trial.drawn_from if self.knows_distribution else None
        prior = None if known is None else known_prior(known.counts, known.gain)
        if isinstance(trial.recorded, CommonEvidence):
            return _of_rows(trial.recorded, prior, trial.full_scale_a)
        names = [f"{k + 1}" for k in range(trial.truth.drift.shape[1])]
        reference = learn_fleet(trial.recorded, full_scale_a=trial.full_scale_a, branches=names, known=prior)
        found = estimate_vehicles(trial.recorded, reference)
        return replace(
            _estimated(found, found.corrected, reference.models[0].prior),
            pit=lambda truth: found.pit(truth.drift, truth.offset_a),
            findings=[[finding.cause for finding in findings] for findings in found.findings],
        )


def _of_rows(recorded: CommonEvidence, known: Prior | None, full_scale_a: float) -> Estimate:
    """The same for vehicles that all make one drive: their rows are at hand, and nothing is checked."""
    feed = int(np.argmax(np.median(recorded.mean_a, axis=0)))
    models = learn_fault_models(recorded.rows, feed=feed, known=known)
    mean = recorded.mean_a / full_scale_a
    square = np.einsum("nkk->nk", recorded.covariance_a2) / full_scale_a**2 + mean**2
    usual = np.stack([np.median(mean, axis=0), np.median(square, axis=0)])
    found = estimate_rows(
        recorded.rows, models, feed=feed, mean=mean, mean_square=square, usual=usual, full_scale_a=full_scale_a
    )
    return _estimated(found, found.faulty & found.identifiable & (found.harm_probability < HARM_LIMIT), models[0].prior)


def _estimated(found: RowsEstimate, corrected: Mask, prior: Prior) -> Estimate:
    learnt = FaultDistribution(
        counts=prior.counts, gain=(prior.gain.low, prior.gain.high), offset=(prior.offset.low, prior.offset.high)
    )
    return Estimate(
        faults=Faults(
            hardware_drift=found.hardware_drift,
            hardware_offset_a=found.hardware_offset_a,
            drift=found.drift,
            offset_a=found.offset_a,
        ),
        hardware=found.hardware_probability > 0.5,
        corrected=corrected,
        confidence=found.confidence,
        failed=0,
        drift_sd=found.drift_sd,
        offset_sd_a=found.offset_sd_a,
        redraw=partial(learnt.draw, full_scale_a=found.full_scale_a),
    )


def _by_threshold(trial: Trial) -> Classification:
    return classify_by_threshold(trial.evidence.features)


def _by_truth(trial: Trial) -> Classification:
    return classify_by_truth(trial.truth)


def _by_tree(trial: Trial) -> Classification:
    if trial.training is None:
        raise FleetError("published/tree: these trials have no artificial fleet that its trees could learn from")
    evidence, faults = trial.training()
    return FaultTrees(evidence.features, faults).classify(trial.evidence.features)


THRESHOLD = Published(name="published/threshold", classify=_by_threshold)
TREE = Published(name="published/tree", classify=_by_tree)
PERFECT = Published(name="published/perfect", classify=_by_truth)
POSTERIOR = Posterior()
CEILING = Posterior(name="posterior/law known", knows_distribution=True)
LEFT_IN = Posterior(name="posterior, delays left in")


def require_estimate(method: str, estimate: object, truth: Faults) -> Estimate:
    """Return what a method gave for the N vehicles with K branches of a truth, if it can be judged.

    Raises
    ------
    FleetError
        If it is no estimate, or one of its arrays has another shape or type, or values that are not finite.
    """
    N, K = truth.drift.shape

    def wrong(what: str, given: object, expected: str) -> FleetError:
        kind = "None" if given is None else f"an object of type {type(given).__name__}"
        if isinstance(given, np.ndarray):
            kind = f"an array of {given.dtype} of shape {given.shape}"
        return FleetError(f"method '{method}': {what} {kind}, expected {expected}; see Estimate of {__name__}")

    if not isinstance(estimate, Estimate):
        raise wrong("estimate() returned", estimate, "an Estimate")
    if not isinstance(estimate.faults, Faults):
        raise wrong("faults are", estimate.faults, "Faults of calibrator.faults")
    arrays: dict[str, tuple[object, tuple[int, ...], str]] = {
        f"faults.{name}": (value, (N, K), "numbers") for name, value in vars(estimate.faults).items()
    }
    arrays["faults.hardware_drift"] = (estimate.faults.hardware_drift, (N,), "numbers")
    arrays |= {"hardware": (estimate.hardware, (N,), "bool"), "corrected": (estimate.corrected, (N, K), "bool")}
    if estimate.confidence is not None:
        arrays["confidence"] = (estimate.confidence, (N,), "numbers")
    for what, (given, shape, elements) in arrays.items():
        kinds, axes = "b" if elements == "bool" else "fiu", "vehicles and branches" if shape[1:] else "vehicles"
        if not (isinstance(given, np.ndarray) and given.shape == shape and given.dtype.kind in kinds):
            raise wrong(f"{what} is", given, f"an array of {elements} of shape {shape}: {axes}")
        bad, expected = ~np.isfinite(given), "finite ones, 0 where no fault is found"
        if what == "confidence":
            bad |= (given < -ROUNDING) | (given > 1.0 + ROUNDING)
            expected = "probabilities from 0 to 1"
        if bad.any():
            raise wrong(f"{what} has {np.sum(bad)} wrong values in", given, expected)
    if not isinstance(estimate.failed, int | np.integer):
        raise wrong("failed is", estimate.failed, "a number of vehicles")
    return estimate
