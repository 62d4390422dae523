"""Prior of the faults, and of what vehicles without faults differ by: the hyper-parameters of the posterior."""

from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array
from calibrator.posterior.slab import Slab
from calibrator.posterior.supports import log_support_counts

__all__ = ["OUTLIER_VARIANCE", "FaultPrior", "ModelSpread"]

OUTLIER_VARIANCE = 100.0
"""Variance of vehicles that differ more than the others, over theirs. [1]"""


@dataclass(frozen=True, kw_only=True)
class FaultPrior:
    """How faults are distributed over a fleet.

    Attributes
    ----------
    counts : ndarray of shape (K + 1, 2K + 1)
        Distribution of the numbers of nonzero hardware (rows) and sensor (columns) parameters of a vehicle; sums to 1.
        All supports with the same numbers are equally likely.
    relative, constant : Slab
        Magnitudes of drifts, and of offsets in fractions of full scale.
    """

    counts: Array
    relative: Slab
    constant: Slab

    @property
    def branches(self) -> int:
        """Number of branches K."""
        return int(self.counts.shape[0]) - 1

    @property
    def hardware_share(self) -> float:
        """Share of vehicles with a hardware fault. [1]"""
        return float(self.counts[1:].sum())

    def log_supports(self) -> Array:
        """Logarithm of the probability of one support, shape (K + 1, 2K + 1), by the numbers of its parameters."""
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(self.counts) - log_support_counts(self.branches))


@dataclass(frozen=True, kw_only=True)
class ModelSpread:
    """What vehicles without any fault differ by in the rows of the evidence.

    Attributes
    ----------
    mean : ndarray of shape (5K,)
        Centre of the fleet in each row: what is left of the error of the reference, and the mean unmeasured load. [1]
    covariance : ndarray of shape (5K, 5K)
        Over vehicles. [1]
    outlier_share : float
        Share of vehicles whose spread has :data:`OUTLIER_VARIANCE` times the variance. [1]
    dispersion : ndarray of shape (K,), or float
        Variance of each intercept over what its drives' blocks tell, at least 1: a model errs alike for longer than a
        block. [1]
    """

    mean: Array
    covariance: Array
    outlier_share: float = 0.0
    dispersion: Array | float = 1.0

    def with_load(self, load: float) -> "ModelSpread":
        """Return the same with a known mean of the load that no branch measures, in fractions of full scale."""
        mean = self.mean.copy()
        mean[4 * len(mean) // 5 - 1] = load
        return replace(self, mean=mean)
