"""One trial: a fleet with known faults, what a method is given of it, and the truth that it is judged by."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import comb

import numpy as np

from calibrator.artificial.random_fleet import nonzero_count
from calibrator.drive import Array, Mask
from calibrator.estimator.evidence import EvidenceRows
from calibrator.faults import Faults
from calibrator.published.evidence import FleetEvidence
from calibrator.summaries.moments import DriveSummary

__all__ = ["CommonEvidence", "FaultDistribution", "Trial", "UnseenDrive", "drawn_distribution"]


@dataclass(frozen=True, kw_only=True)
class FaultDistribution:
    """Distribution of a fleet's faults: what they were drawn from, or what an estimator has learnt.

    Attributes
    ----------
    counts : ndarray of shape (K + 1, 2K + 1)
        Probability that a vehicle has so many hardware faults (rows) and sensor faults (columns); all supports with
        the same numbers are equally likely.
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
        hardware_offset = np.column_stack([values[:, 1:K], -values[:, 1:K].sum(axis=1)])
        return Faults(
            hardware_drift=values[:, 0],
            hardware_offset_a=hardware_offset * full_scale_a,
            drift=values[:, K : 2 * K],
            offset_a=values[:, 2 * K :] * full_scale_a,
        )


def drawn_distribution(
    branches: int, sparsity: float, magnitude: tuple[float, float], *, balanced: bool
) -> FaultDistribution:
    """Distribution that :func:`~calibrator.artificial.random_fleet.draw_faults` draws from.

    An estimator that knows it shows the ceiling: with the same evidence no estimator recovers more on average than its
    mean confidence says, as far as the errors of the evidence are stated rightly.

    Parameters
    ----------
    branches : int
        Number of branches K.
    sparsity : float
        Sparsity level S. [%]
    magnitude : tuple of float
        Range of gain errors [1] and of offsets in fractions of full scale.
    balanced : bool
        Whether the hardware faults of half of the vehicles are set to zero.
    """
    K, n = branches, nonzero_count(branches, sparsity)
    counts = np.zeros((K + 1, 2 * K + 1))
    for hardware in range(max(n - 2 * K, 0), min(n, K) + 1):
        probability = comb(K, hardware) * comb(2 * K, n - hardware) / comb(3 * K, n)
        counts[hardware, n - hardware] += probability / (2.0 if balanced else 1.0)
        counts[0, n - hardware] += probability / 2.0 if balanced else 0.0
    return FaultDistribution(counts=counts, gain=magnitude, offset=magnitude)


@dataclass(frozen=True, kw_only=True)
class CommonEvidence:
    """What the default is given where all vehicles make one simulated drive, of which there are no summaries.

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
class UnseenDrive:
    """Moments of the true currents i and of the sensors' errors e = i_m - i on a drive that no method has seen.

    Attributes
    ----------
    mean_a, mean_square_a2 : ndarray of shape (N, K)
        Of i. [A], [A^2]
    error_mean_a, error_mean_square_a2, error_product_a2 : ndarray of shape (N, K)
        E[e], E[e^2] and E[e i]. [A], [A^2], [A^2]
    """

    mean_a: Array
    mean_square_a2: Array
    error_mean_a: Array
    error_mean_square_a2: Array
    error_product_a2: Array

    @classmethod
    def of_samples(cls, drives: Sequence[tuple[Array, Array]]) -> "UnseenDrive":
        """Moments of the true and the measured currents, both of shape (T, K), of N vehicles. [A]"""
        pairs = [(i, i_m - i) for i, i_m in drives]
        return cls(
            mean_a=np.stack([i.mean(axis=0) for i, _ in pairs]),
            mean_square_a2=np.stack([np.mean(i**2, axis=0) for i, _ in pairs]),
            error_mean_a=np.stack([e.mean(axis=0) for _, e in pairs]),
            error_mean_square_a2=np.stack([np.mean(e**2, axis=0) for _, e in pairs]),
            error_product_a2=np.stack([np.mean(e * i, axis=0) for i, e in pairs]),
        )

    @classmethod
    def of_linear_sensors(cls, ideal_a: Array, truth: Faults) -> "UnseenDrive":
        """Moments of N vehicles with linear sensors that all make one drive of ideal currents (T, K), (11) and (13)."""
        gain, constant = 1.0 + truth.hardware_drift[:, None], truth.hardware_offset_a
        mean_a, mean_square_a2 = ideal_a.mean(axis=0), np.mean(ideal_a**2, axis=0)
        mean = gain * mean_a + constant
        square = gain**2 * mean_square_a2 + 2.0 * gain * constant * mean_a + constant**2
        d, o = truth.drift, truth.offset_a
        return cls(
            mean_a=mean,
            mean_square_a2=square,
            error_mean_a=d * mean + o,
            error_mean_square_a2=d**2 * square + 2.0 * d * o * mean + o**2,
            error_product_a2=d * square + o * mean,
        )

    def rms_a(self, drift: Array, offset_a: Array) -> Array:
        """Root mean square error of the currents corrected with these parameters (25), shape (N, K). [A]

        (i_m - o) / (1 + d) - i = (e - o - d i) / (1 + d); parameters of 0 give the error as measured.
        """
        square = (
            self.error_mean_square_a2
            + offset_a**2
            + drift**2 * self.mean_square_a2
            + 2.0 * (drift * offset_a * self.mean_a - offset_a * self.error_mean_a - drift * self.error_product_a2)
        )
        return np.asarray(np.sqrt(np.maximum(square, 0.0)) / np.abs(1.0 + drift))


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
        Of N vehicles; only the perfect classifier may look.
    unseen : UnseenDrive
        Where corrections are judged.
    record : callable
        Makes what the default is given: the drive summaries of the N vehicles, or the evidence of their common drive.
    collect : callable
        Makes the evidence of the published method.
    drawn_from : FaultDistribution or None
        What the faults were drawn from; only the method that is to show the ceiling may look.
    training : callable or None
        Makes evidence and truth of an artificial fleet that the published method's trees learn from; None: there is
        none, and trees cannot be used.
    delay_error_s : ndarray of shape (N, K - 1) or None
        Error of the delays that were estimated and taken out, if they were. [s]
    attacked : ndarray of bool of shape (N,) or None
        Vehicles that have what the world of an attack does to them; None: there is no attack.
    causes : tuple of str
        Names by which a finding may name this.
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
        """What the default is given, made once."""
        return self.record()

    @cached_property
    def evidence(self) -> FleetEvidence:
        """Evidence of the published method, made once."""
        return self.collect()
