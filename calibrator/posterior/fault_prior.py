"""Prior of the faults, and of what vehicles without faults differ by: the hyper-parameters of the posterior."""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.posterior.slab import Slab
from calibrator.posterior.supports import log_support_counts

__all__ = ["FaultPrior", "ModelSpread"]


@dataclass(frozen=True, kw_only=True)
class FaultPrior:
    """How faults are distributed over a fleet.

    Attributes
    ----------
    hardware_share : float
        Share of vehicles with a hardware fault. [1]
    counts : ndarray of shape (2, 3K + 1)
        Distribution of the number of nonzero parameters of vehicles without and with a hardware fault; rows sum to 1.
        All supports of one number are equally likely.
    relative, constant : Slab
        Magnitudes of drifts, and of offsets in fractions of full scale.
    """

    hardware_share: float
    counts: Array
    relative: Slab
    constant: Slab

    @property
    def branches(self) -> int:
        """Number of branches K."""
        return int(self.counts.shape[1] - 1) // 3

    def log_supports(self) -> Array:
        """Logarithm of the probability of one support, shape (2, 3K + 1): by hardware fault, and by number."""
        share = np.array([[1.0 - self.hardware_share], [self.hardware_share]])
        possible = log_support_counts(self.branches)
        with np.errstate(divide="ignore"):
            log_probability = np.log(share * self.counts)
        return np.where(np.isneginf(possible), -np.inf, log_probability - np.where(np.isneginf(possible), 0, possible))


@dataclass(frozen=True, kw_only=True)
class ModelSpread:
    """What vehicles without any fault differ by in the rows of the evidence.

    Attributes
    ----------
    mean : ndarray of shape (5K,)
        Centre of the fleet in each row: what is left of the error of the reference, and the mean unmeasured load. [1]
    covariance : ndarray of shape (5K, 5K)
        Over vehicles. [1]
    """

    mean: Array
    covariance: Array
