"""The law by which an experiment draws its faults, as a prior: what a method could know of a fleet at best.

With it, and the same evidence, no estimator recovers more on average than the posterior states as its mean confidence,
so far as the errors of the evidence are as they are said to be: a ceiling to hold the default against.
"""

from math import comb

import numpy as np

from calibrator.artificial.random_fleet import nonzero_count
from calibrator.posterior.fault_prior import FaultPrior
from calibrator.posterior.slab import Slab

__all__ = ["balanced_law"]


def balanced_law(branches: int, sparsity: float, magnitude: tuple[float, float]) -> FaultPrior:
    """Prior of a balanced fleet, section IV-B of the paper.

    Parameters
    ----------
    branches : int
        Number of branches K.
    sparsity : float
        Sparsity level S. [%]
    magnitude : tuple of float
        Range of drifts [1] and of offsets in fractions of full scale.

    Returns
    -------
    FaultPrior
        So many of the 3K parameters are not zero; in half of the vehicles those of the hardware are set to zero.
    """
    K, n = branches, nonzero_count(branches, sparsity)
    counts = np.zeros((K + 1, 2 * K + 1))
    for hardware in range(max(n - 2 * K, 0), min(n, K) + 1):
        share = comb(K, hardware) * comb(2 * K, n - hardware) / comb(3 * K, n) / 2.0
        counts[0, n - hardware] += share
        counts[hardware, n - hardware] += share
    slab = Slab(*magnitude)
    return FaultPrior(counts=counts, relative=slab, constant=slab)
