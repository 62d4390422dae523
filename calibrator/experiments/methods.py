"""Methods that experiments compare: the default, the published one with its classifiers, and simpler ones.

A method is a row: a name, and a function from a trial to an estimate.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calibrator.drive import Mask
from calibrator.errors import FleetError
from calibrator.estimator import decision
from calibrator.estimator.fleet_estimate import HARM_LIMIT, estimate_vehicles, learn_fleet
from calibrator.estimator.learning import learn_fault_models
from calibrator.estimator.prior import Prior, known_prior
from calibrator.experiments.baselines import SOLVERS
from calibrator.experiments.trial import CommonEvidence, Estimate, FaultDistribution, Trial
from calibrator.faults import Faults
from calibrator.published.classify import Classification, classify_by_threshold, classify_by_trees, classify_by_truth
from calibrator.published.recovery import recover_fleet

__all__ = [
    "BASELINES", "CEILING", "PERFECT", "POSTERIOR", "THRESHOLD", "TREE", "MethodRow", "require_estimate",
]  # fmt: skip

ROUNDING = 1e-9
"""Amount by which a probability may lie outside 0 to 1. [1]"""


@dataclass(frozen=True)
class MethodRow:
    """A method that experiments compare.

    Attributes
    ----------
    name : str
        Short name for tables.
    estimate : callable
        Function from a trial to the estimate for all its vehicles.
    """

    name: str
    estimate: Callable[[Trial], Estimate]


def _posterior(trial: Trial, *, known: bool = False) -> Estimate:
    """Run the default method; if `known`, its prior is the distribution that the faults were drawn from."""
    prior = None
    if known:
        if trial.drawn_from is None:
            raise FleetError("posterior/prior known: nobody can say what the faults of these trials were drawn from")
        prior = known_prior(trial.drawn_from.counts, trial.drawn_from.gain)
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
    """Run the default for vehicles that all make one drive: from their evidence rows, without looking for findings."""
    feed = int(np.argmax(np.median(recorded.mean_a, axis=0)))
    models = learn_fault_models(recorded.rows, feed=feed, known=known)
    mean = recorded.mean_a / full_scale_a
    square = np.einsum("nkk->nk", recorded.covariance_a2) / full_scale_a**2 + mean**2
    usual = np.stack([np.median(mean, axis=0), np.median(square, axis=0)])
    found = decision.estimate_rows(
        recorded.rows, models, feed=feed, mean=mean, mean_square=square, usual=usual, full_scale_a=full_scale_a
    )
    return _estimated(found, found.faulty & found.identifiable & (found.harm_probability < HARM_LIMIT), models[0].prior)


def _estimated(found: decision.SensorEstimate, corrected: Mask, prior: Prior) -> Estimate:
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
        learnt=FaultDistribution(
            counts=prior.counts, gain=(prior.gain.low, prior.gain.high), offset=(prior.offset.low, prior.offset.high)
        ),
    )


def _all_corrected(faults: Faults, hardware: Mask, failed: int = 0) -> Estimate:
    """Return the estimate of a method that corrects each fault that it finds, and does not say how sure it is."""
    corrected = (faults.drift != 0.0) | (faults.offset_a != 0.0)
    return Estimate(faults=faults, hardware=hardware, corrected=corrected, confidence=None, failed=failed)


def _published(trial: Trial, *, classify: Callable[[Trial], Classification]) -> Estimate:
    """Run the published method: classify, then recover by the four cases."""
    recovery = recover_fleet(trial.evidence, classify(trial), full_scale_a=trial.full_scale_a)
    return _all_corrected(recovery.faults, recovery.classification.hardware, len(recovery.failed))


def _by_threshold(trial: Trial) -> Classification:
    return classify_by_threshold(trial.evidence.features)


def _by_truth(trial: Trial) -> Classification:
    return classify_by_truth(trial.truth)


def _by_tree(trial: Trial) -> Classification:
    if trial.training is None:
        raise FleetError("published/tree: these trials have no artificial fleet that its trees could learn from")
    evidence, faults = trial.training()
    return classify_by_trees(evidence.features, faults, trial.evidence.features)


def _baseline(trial: Trial, *, solve: Callable[[Trial], Faults]) -> Estimate:
    faults = solve(trial)
    return _all_corrected(faults, faults.has_hardware_fault)


THRESHOLD = MethodRow("published/threshold", partial(_published, classify=_by_threshold))
TREE = MethodRow("published/tree", partial(_published, classify=_by_tree))
PERFECT = MethodRow("published/perfect", partial(_published, classify=_by_truth))
POSTERIOR = MethodRow("posterior", _posterior)
CEILING = MethodRow("posterior/prior known", partial(_posterior, known=True))
BASELINES = tuple(MethodRow(name, partial(_baseline, solve=solve)) for name, solve in SOLVERS.items())


def require_estimate(method: str, estimate: Estimate, truth: Faults) -> Estimate:
    """Check that what a method returned for N vehicles with K branches can be judged, and return it.

    Raises
    ------
    FleetError
        If it is no :class:`Estimate`, its faults are no :class:`Faults`, an array has a wrong shape or type or values
        that are not finite, a confidence is outside 0 to 1, the number that failed is not 0 to N, or findings are
        given but not for exactly N vehicles.
    """
    if not isinstance(estimate, Estimate):
        raise FleetError(f"method '{method}': estimate() returned {type(estimate).__name__}, expected an Estimate")
    if not isinstance(estimate.faults, Faults):
        raise FleetError(f"method '{method}': faults is {type(estimate.faults).__name__}, expected Faults")
    N, K = truth.drift.shape
    optional = {name: getattr(estimate, name) for name in ("confidence", "drift_sd", "offset_sd_a")}
    arrays = {**vars(estimate.faults), "hardware": estimate.hardware, "corrected": estimate.corrected}
    arrays |= {name: values for name, values in optional.items() if values is not None}
    for name, given in arrays.items():
        if not isinstance(given, np.ndarray):
            raise FleetError(f"method '{method}': {name} is {type(given).__name__}, expected an array of numpy")
        shape = (N,) if name in {"hardware_drift", "hardware", "confidence"} else (N, K)
        kinds, elements = ("b", "bool") if name in {"hardware", "corrected"} else ("fiu", "finite numbers")
        if given.shape != shape or given.dtype.kind not in kinds or not np.isfinite(given).all():
            axes = "(vehicles, branches)" if len(shape) > 1 else "(vehicles)"
            where = ", 0 where no fault is found" if name in vars(estimate.faults) else ""
            raise FleetError(
                f"method '{method}': {name} is {given.dtype} of shape {given.shape}, expected {elements} of shape "
                f"{shape} {axes}{where}"
            )
    sure, found = optional["confidence"], len(estimate.findings)
    if sure is not None and (np.min(sure) < -ROUNDING or np.max(sure) > 1.0 + ROUNDING):
        raise FleetError(f"method '{method}': confidence is {np.min(sure):g} to {np.max(sure):g}, expected 0 to 1")
    if estimate.failed not in range(N + 1):
        raise FleetError(f"method '{method}': failed is {estimate.failed!r}, expected a number of vehicles, 0 to {N}")
    if found not in {0, N}:
        raise FleetError(f"method '{method}': findings of {found} vehicles, expected those of {N}, or none")
    return estimate
