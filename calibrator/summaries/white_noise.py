"""White noise of measured currents, from how they change from sample to sample; compiled."""

import numpy as np

from calibrator.compiled import compiled
from calibrator.drive import Array

__all__ = ["white_noise_a2"]

DIFFERENCE_GAIN = 20.0
"""Variance of the third difference of white noise of variance 1."""
NORMAL_MEDIAN = 0.6745
"""Median magnitude of a standard normal variable."""
MEDIAN_EXCESS = 3.8
"""The squared median of n third differences of white noise is too large by this over n (simulated, n = 9 to 300)."""


@compiled
def white_noise_a2(currents: Array, length: int) -> Array:
    """Variance of white noise per block from the median third difference; gaps (NaN) take no part. [A^2]"""
    T, K = currents.shape
    blocks = -(-T // length)
    noise, third = np.zeros((blocks, K)), np.empty((K, length))
    for block in range(blocks):
        n = 0
        for t in range(block * length, min((block + 1) * length, T) - 3):
            known = True
            for k in range(K):
                late, early = currents[t + 3, k] - currents[t, k], currents[t + 2, k] - currents[t + 1, k]
                third[k, n] = abs(late - 3.0 * early)
                known = known and np.isfinite(third[k, n])
            n += known
        for k in range(K if n else 0):
            scale = np.median(third[k, :n]) / NORMAL_MEDIAN
            noise[block, k] = scale**2 / DIFFERENCE_GAIN / (1.0 + MEDIAN_EXCESS / n)
    return noise
