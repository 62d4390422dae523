"""Methods that experiments compare: a trial in, estimated faults out."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calibrator.calibration_settings import HARM_LIMIT
from calibrator.drive import Array, Mask
from calibrator.experiments.trial import Trial
from calibrator.faults import Faults
from calibrator.posterior.estimate import FleetPosterior
from calibrator.published.classify import Classification, FaultTrees, classify_by_threshold, classify_by_truth
from calibrator.published.recovery import recover_fleet

__all__ = ["CEILING", "PERFECT", "POSTERIOR", "THRESHOLD", "TREE", "Estimate", "Method", "Posterior", "Published"]


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
    """

    faults: Faults
    hardware: Mask
    corrected: Mask
    confidence: Array | None
    failed: int


class Method(Protocol):
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
            corrected=_changed(recovery.faults),
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
    knows_law : bool
        Whether it is told how the faults were drawn, to show the ceiling; the default is told nothing.
    """

    name: str = "posterior"
    knows_law: bool = False

    def estimate(self, trial: Trial) -> Estimate:
        """Estimate, and correct the branches that are hardly ever made worse."""
        posterior = trial.posterior(trial.law if self.knows_law else None)
        return Estimate(
            faults=posterior.faults,
            hardware=posterior.hardware_fault > 0.5,
            corrected=_deployed(posterior),
            confidence=posterior.confidence,
            failed=0,
        )


def _deployed(posterior: FleetPosterior) -> Mask:
    """Branches that the default corrects, as the product does; the limits of a layout apart."""
    corrected = _changed(posterior.faults) & posterior.identifiable & (posterior.harm < HARM_LIMIT)
    if posterior.health is not None:
        corrected[:, list(posterior.health.doubtful)] = False
    return np.asarray(corrected)


def _changed(faults: Faults) -> Mask:
    changed: Mask = (faults.drift != 0.0) | (faults.offset_a != 0.0)
    return changed


def _by_threshold(trial: Trial) -> Classification:
    return classify_by_threshold(trial.evidence.features)


def _by_tree(trial: Trial) -> Classification:
    assert trial.training is not None
    evidence, faults = trial.training()
    return FaultTrees(evidence.features, faults).classify(trial.evidence.features)


def _by_truth(trial: Trial) -> Classification:
    return classify_by_truth(trial.truth)


THRESHOLD = Published(name="published/threshold", classify=_by_threshold)
TREE = Published(name="published/tree", classify=_by_tree)
PERFECT = Published(name="published/perfect", classify=_by_truth)
POSTERIOR = Posterior()
CEILING = Posterior(name="posterior/law known", knows_law=True)
