"""Sums that tell whether linear sensors explain a drive: by level of each current, fast changes, spikes, temperature.

Second moments of whole drives cannot tell a bent sensor from a gain error. These sums can; they are small and add up as
the moments do, and :mod:`calibrator.estimator.checks` reads them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from calibrator.drive import Array, Mask
from ecu_node.summary import (
    FEWEST_FOR_GAINS,
    LEAST_EDGE,
    LEAST_SPIKE_A,
    LEVELS_A,
    MAD_TO_SD,
    OTHERS_MOVE,
    SPIKE_SDS,
    SPIKE_WINDOW,
    STEP_OF_SPIKE,
)

__all__ = ["LEVEL_EDGES_A", "LEVEL_OF_AMPERE", "FitSums", "find_spikes", "second_differences"]

LEVEL_EDGES_A: Array = np.array([*(-a for a in reversed(LEVELS_A)), *LEVELS_A], np.float64)
"""Edges of the L = 33 levels of a measured current: symmetric, denser near zero, whole amperes. [A]"""
LEVEL_OF_AMPERE: NDArray[np.int64] = np.searchsorted(LEVELS_A, np.arange(LEVELS_A[-1] + 1), side="right")
"""Distance of the level of so many whole amperes from the middle one."""


@dataclass(frozen=True, kw_only=True)
class FitSums:
    """Sums of the drives of one vehicle in B blocks with K branches, M inputs and L levels.

    Attributes
    ----------
    levels : ndarray of shape (K, L, M + K + 2)
        By level of branch k, see :data:`LEVEL_EDGES_A`: sums of (inputs, measured currents [A], 1) and of the square of
        the measured current k [A^2].
    fast_a2 : ndarray of shape (B, K, K)
        Sums of products of the second differences of the measured currents, see :func:`second_differences`. [A^2]
    spikes : ndarray of shape (B, K, 2)
        Samples left out of all sums as upward and downward spikes of one branch.
    temperature_c : ndarray of shape (B,)
        Mean temperature of the sensors; NaN where it is not known. [degC]
    starts : ndarray of bool of shape (B,)
        Whether a drive starts with the block.
    """

    levels: Array
    fast_a2: Array
    spikes: Array
    temperature_c: Array
    starts: Mask

    def __add__(self, other: "FitSums") -> "FitSums":
        """Return the sums of the drives of both: blocks one after the other."""
        return FitSums(
            levels=self.levels + other.levels,
            fast_a2=np.concatenate([self.fast_a2, other.fast_a2]),
            spikes=np.concatenate([self.spikes, other.spikes]),
            temperature_c=np.concatenate([self.temperature_c, other.temperature_c]),
            starts=np.concatenate([self.starts, other.starts]),
        )

    def take_branches(self, order: Sequence[int]) -> "FitSums":
        """Return the same sums for some branches, in another order."""
        chosen, K = list(order), self.fast_a2.shape[1]
        M = self.levels.shape[2] - K - 2
        columns = [*range(M), *(M + k for k in chosen), M + K, M + K + 1]
        return FitSums(
            levels=self.levels[chosen][:, :, columns],
            fast_a2=self.fast_a2[:, chosen][:, :, chosen],
            spikes=self.spikes[:, chosen],
            temperature_c=self.temperature_c,
            starts=self.starts,
        )

    def joined(self, first: NDArray[np.int64], samples: Array) -> "FitSums":
        """Return the same sums with neighbouring blocks added.

        Parameters
        ----------
        first : ndarray of int
            First of the blocks that become one.
        samples : ndarray of shape (B,)
            Samples of each block: temperatures are averaged by them.
        """
        mean_c = np.add.reduceat(self.temperature_c * samples, first) / np.add.reduceat(samples, first)
        return FitSums(
            levels=self.levels,
            fast_a2=np.add.reduceat(self.fast_a2, first),
            spikes=np.add.reduceat(self.spikes, first),
            temperature_c=mean_c,
            starts=np.logical_or.reduceat(self.starts, first),
        )


def second_differences(currents_a: Array, used: Mask) -> Array:
    """Distance of each sample from the mean of its neighbours; zero where one of the three is not used.

    Parameters
    ----------
    currents_a : ndarray of shape (..., T, K)
        Measured currents. [A]
    used : ndarray of bool of shape (..., T)
        Samples that may be used.

    Returns
    -------
    ndarray of shape (..., T - 2, K)
        White noise of variance s^2 has 1.5 s^2 here; currents that change slowly have nothing. [A]
    """
    inner = used[..., 1:-1] & used[..., :-2] & used[..., 2:]
    distance = currents_a[..., 1:-1, :] - 0.5 * (currents_a[..., :-2, :] + currents_a[..., 2:, :])
    return np.asarray(np.where(inner[..., None], distance, 0.0))


def find_spikes(currents_a: Array, used: Mask) -> NDArray[np.int8]:
    """Label spikes: samples at which one branch, and it alone, leaves the junction law and its own neighbours.

    Parameters
    ----------
    currents_a : ndarray of shape (T, K)
        Measured currents of neighbouring samples, zero where not used; some minutes. [A]
    used : ndarray of bool of shape (T,)
        Samples that may be used.

    Returns
    -------
    ndarray of int of shape (T, K)
        1 for an upward, -1 for a downward spike, 0 for none. A Hampel test of the residual of the junction law, whose
        gains are those of these samples.
    """
    found = np.zeros(currents_a.shape, np.int8)
    K = currents_a.shape[1]
    kept = used
    for _ in range(2):  # the second time with gains that the spikes did not bend
        if kept.sum() < FEWEST_FOR_GAINS * K:
            return found
        weights = _junction_weights(currents_a, kept)
        residual = currents_a @ weights
        change = np.abs(np.diff(residual))[used[1:] & used[:-1]]
        if not change.max(initial=0.0) > max(STEP_OF_SPIKE * float(np.median(change)), LEAST_SPIKE_A):
            return found  # mostly: what follows takes longer
        far = residual - median_filter(residual, SPIKE_WINDOW, mode="nearest")
        spread = MAD_TO_SD * float(np.median(np.abs(far[kept])))
        suspects = used & (np.abs(far) > max(SPIKE_SDS * spread, LEAST_SPIKE_A))
        kept = used & ~suspects
    at = np.flatnonzero(suspects)
    near = np.clip(at[:, None] + np.arange(-(SPIKE_WINDOW // 2), SPIKE_WINDOW // 2 + 1), 0, len(used) - 1)
    around = (currents_a * weights)[near]  # (spikes, window, K)
    moves = around - np.median(around, axis=1, keepdims=True)
    own, nearby = (
        moves[:, SPIKE_WINDOW // 2],
        np.abs(moves[:, SPIKE_WINDOW // 2 - 1 : SPIKE_WINDOW // 2 + 2]).max(axis=1),
    )
    steps = np.diff(moves, axis=1) * np.sign(own)[:, None]
    edge = np.minimum(steps[:, : SPIKE_WINDOW // 2].max(axis=1), -steps[:, SPIKE_WINDOW // 2 :].min(axis=1))
    for k in range(K):
        height = np.abs(own[:, k])
        alone = (nearby.sum(axis=1) - nearby[:, k] < OTHERS_MOVE * height) & (edge[:, k] > LEAST_EDGE * height)
        found[at[alone], k] = np.sign(own[alone, k] * weights[k])
    return found


def _junction_weights(currents_a: Array, kept: Mask) -> Array:
    """Weights of the branches in the junction law, that of the branch that moves most being one, by least squares."""
    x = currents_a if kept.all() else currents_a[kept]
    mean = x.mean(axis=0)
    gram = x.T @ x - len(x) * np.outer(mean, mean)
    first = int(np.argmax(np.diag(gram)))
    others = [k for k in range(len(gram)) if k != first]
    weights = np.zeros(len(gram))
    weights[first] = 1.0
    weights[others] = -np.linalg.lstsq(gram[np.ix_(others, others)], gram[others, first], rcond=1e-9)[0]
    return weights
