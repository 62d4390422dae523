"""One trial: a fleet with known faults, what a method is given of it, and the truth that it is judged by.

A method of your own is any object with a ``name`` and a function ``estimate(trial)`` that returns an :class:`Estimate`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Protocol

import numpy as np

from calibrator.artificial.random_fleet import FaultSettings, nonzero_count
from calibrator.drive import Array, Mask
from calibrator.estimator.evidence import EvidenceRows
from calibrator.faults import Faults
from calibrator.published.evidence import FleetEvidence
from calibrator.score import UnseenDrive
from calibrator.summaries.moments import DriveSummary

__all__ = ["CommonEvidence", "ComparedMethod", "Estimate", "FaultDistribution", "Trial", "drawn_distribution"]


@dataclass(frozen=True, kw_only=True)
class FaultDistribution:
    """Distribution of a fleet's faults: what they were drawn from, or what an estimator has learnt.

    Attributes
    ----------
    counts : ndarray of shape (K + 1, 2K + 1)
        ``counts[h, s]``: probability that h hardware and s sensor parameters of a vehicle are not zero; all supports
        with these numbers are equally likely.
    gain, offset : tuple of float
        Range of the uniform magnitudes of gain errors [1], and of offsets in fractions of full scale; either sign.
    """

    counts: Array
    gain: tuple[float, float]
    offset: tuple[float, float]

    def draw(self, rng: np.random.Generator, vehicles: int, full_scale_a: float) -> Faults:
        """Draw the faults of N vehicles."""
        K = len(self.counts) - 1
        cell = rng.choice(self.counts.size, size=vehicles, p=self.counts.ravel() / self.counts.sum())
        numbers = np.stack(np.divmod(cell, 2 * K + 1), axis=1)
        rank = [np.argsort(rng.random((vehicles, size)), axis=1).argsort(axis=1) for size in (K, 2 * K)]
        active = np.hstack([r < n[:, None] for r, n in zip(rank, numbers.T, strict=True)])
        # columns: d_h, o_h (K - 1), d (K), o (K)
        relative = np.isin(np.arange(3 * K), [0, *range(K, 2 * K)])
        low, high = (np.where(relative, *pair) for pair in zip(self.gain, self.offset, strict=True))
        values = active * rng.choice([-1.0, 1.0], size=active.shape) * rng.uniform(low, high, size=active.shape)
        return Faults.of_parameters(values, full_scale_a)


def drawn_distribution(settings: FaultSettings, branches: int) -> FaultDistribution | None:
    """Return the distribution from which the settings draw the faults of a vehicle; None if one sign is preferred.

    An estimator that knows it shows the ceiling: its mean confidence is the most that any estimator recovers on average
    with the same evidence, provided that the stated errors of the evidence are right.
    """
    if settings.sign_bias:
        return None
    K, n = branches, nonzero_count(branches, settings.sparsity)
    counts = np.zeros((K + 1, 2 * K + 1))
    for hardware in range(max(n - 2 * K, 0), min(n, K) + 1):
        probability = comb(K, hardware) * comb(2 * K, n - hardware) / comb(3 * K, n)
        counts[hardware, n - hardware] += probability / (2.0 if settings.balanced else 1.0)
        counts[0, n - hardware] += probability / 2.0 if settings.balanced else 0.0
    return FaultDistribution(counts=counts, gain=settings.magnitude, offset=settings.magnitude)


@dataclass(frozen=True, kw_only=True)
class CommonEvidence:
    """Evidence that the default is given where all vehicles make one simulated drive, for which there are no summaries.

    Attributes
    ----------
    rows : EvidenceRows
        Evidence rows of N vehicles.
    mean_a, covariance_a2 : ndarray of shape (N, K) and (N, K, K)
        Moments of the measured currents. [A], [A^2]
    """

    rows: EvidenceRows
    mean_a: Array
    covariance_a2: Array


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What a method is given, and the truth it is judged by.

    Attributes
    ----------
    smallest_fault : float
        Smallest magnitude of a fault of the fleet. [1]
    full_scale_a : float
        Full scale of the junction. [A]
    truth : Faults
        Faults of N vehicles; only the perfect classifier may look at them.
    unseen : UnseenDrive
        Drive on which corrections are judged.
    record : callable
        Makes what the posterior method is given: drive summaries of the N vehicles, or evidence of their common drive.
    collect : callable
        Makes the evidence of the published method.
    drawn_from : FaultDistribution or None
        Distribution of the faults; only the method that is to show the ceiling may look at it.
    training : callable or None
        Makes evidence and truth of an artificial fleet that the published method's trees learn from; None: there is
        none, and trees cannot be used.
    delay_error_s : ndarray of shape (N, K - 1) or None
        Estimated minus true delay of each branch relative to the first; None: no delays were estimated. [s]
    attacked : ndarray of bool of shape (N,) or None
        Vehicles that the world of an attack affects; None: there is no attack.
    causes : tuple of str
        A finding is right if it names one of these causes for an attacked vehicle.
    """

    smallest_fault: float
    full_scale_a: float
    truth: Faults
    unseen: UnseenDrive
    record: Callable[[], Sequence[DriveSummary] | CommonEvidence]
    collect: Callable[[], FleetEvidence]
    drawn_from: FaultDistribution | None = None
    training: Callable[[], tuple[FleetEvidence, Faults]] | None = None
    delay_error_s: Array | None = None
    attacked: Mask | None = None
    causes: tuple[str, ...] = ()

    @cached_property
    def recorded(self) -> Sequence[DriveSummary] | CommonEvidence:
        """Summaries or evidence that the posterior method is given, made once."""
        return self.record()

    @cached_property
    def evidence(self) -> FleetEvidence:
        """Evidence of the published method, made once."""
        return self.collect()


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Result of a method for N vehicles with K branches.

    Attributes
    ----------
    faults : Faults
        Estimated faults.
    hardware : ndarray of bool of shape (N,)
        Vehicles held to have a hardware fault.
    corrected : ndarray of bool of shape (N, K)
        Branches that would be corrected in the vehicle; the others pass through.
    confidence : ndarray of shape (N,) or None
        Probability of being recovered; None: the method does not say.
    failed : int
        Number of vehicles whose optimisation failed.
    drift_sd, offset_sd_a : ndarray of shape (N, K) or None
        Standard deviations of the sensors' parameters, if the method states them. [1], [A]
    pit : callable or None
        From true faults to the probability integral transforms of their drifts and offsets under the posterior, two
        arrays (N, K); None: those of normal distributions with the standard deviations above.
    findings : sequence of N sequences of str
        Causes that the method names of each vehicle, besides faults; empty if it names none.
    learnt : FaultDistribution or None
        Prior that the method has learnt.
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
    learnt: FaultDistribution | None = None


class ComparedMethod(Protocol):
    """Any object with a name and a function that estimates the faults of a fleet."""

    @property
    def name(self) -> str:
        """Short name for tables."""

    @property
    def estimate(self) -> Callable[[Trial], Estimate]:
        """Function from a trial to the estimate for all its vehicles."""
