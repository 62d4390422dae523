"""Methods that experiments compare: evidence in, estimated faults and classification out."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from calibrator.experiments.trial import Trial
from calibrator.published.classify import Classification, FaultTrees, classify_by_threshold, classify_by_truth
from calibrator.published.recovery import Recovery, recover_fleet

__all__ = ["PERFECT", "THRESHOLD", "TREE", "Method", "Published"]


class Method(Protocol):
    """Anything that recovers a fleet."""

    @property
    def name(self) -> str:
        """Short name for tables."""

    def recover(self, trial: Trial) -> Recovery:
        """Estimate the faults of all vehicles of a trial."""


@dataclass(frozen=True, kw_only=True)
class Published:
    """The published method with one of its classifiers.

    Attributes
    ----------
    name : str
        Name of the classifier.
    classify : callable
        The classifier.
    """

    name: str
    classify: Callable[[Trial], Classification]

    def recover(self, trial: Trial) -> Recovery:
        """Classify, then recover by the four cases."""
        return recover_fleet(trial.evidence, self.classify(trial), full_scale_a=trial.full_scale_a)


def _by_threshold(trial: Trial) -> Classification:
    return classify_by_threshold(trial.evidence.features)


def _by_tree(trial: Trial) -> Classification:
    evidence, faults = trial.training()
    return FaultTrees(evidence.features, faults).classify(trial.evidence.features)


def _by_truth(trial: Trial) -> Classification:
    return classify_by_truth(trial.truth)


THRESHOLD = Published(name="published/threshold", classify=_by_threshold)
TREE = Published(name="published/tree", classify=_by_tree)
PERFECT = Published(name="published/perfect", classify=_by_truth)
