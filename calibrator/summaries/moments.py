"""DriveSummary: all that the estimator needs of recorded drives, in a size that does not grow with the sampling rate.

For each block of :data:`BLOCK_S` it holds the second moments of (columns of a filter bank, measured currents, 1).
Summaries of drives add up, and the spread between blocks shows the uncertainty of everything that is computed from
them. Second moments cannot tell a sensor with a bent characteristic from a gain error; the :class:`FitSums` beside them
can, and :mod:`calibrator.estimator.checks` reads them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.errors import DriveError
from ecu_node.summary import BLOCK_S, LEVELS_A

__all__ = ["BLOCK_S", "LEVEL_EDGES_A", "DriveSummary", "FitSums", "add_up", "common_bank"]

LEVEL_EDGES_A: Array = np.array([*(-a for a in reversed(LEVELS_A)), *LEVELS_A], np.float64)
"""The 32 edges between the L = 33 levels of a measured current: symmetric, denser near zero, whole amperes. [A]"""


@dataclass(frozen=True, kw_only=True)
class FitSums:
    """Sums that show whether linear sensors explain the drives: B blocks, K branches, M inputs, L levels.

    Attributes
    ----------
    levels : ndarray of shape (K, L, M + K + 2)
        Sums over the samples in which current k is in a level (see :data:`LEVEL_EDGES_A`): of (inputs, measured
        currents [A], 1), and of the square of the measured current k [A^2].
    fast_a2 : ndarray of shape (B, K, K)
        Sums of products of the second differences of the measured currents, which
        :func:`~calibrator.summaries.summariser.second_differences` returns. [A^2]
    spikes : ndarray of shape (B, K, 2)
        Number of upward and of downward spikes of each branch; samples with a spike are left out of all sums.
    temperature_c : ndarray of shape (B,)
        Mean temperature of the sensors; NaN where it is not known. [degC]
    starts : ndarray of bool of shape (B,)
        Whether a drive starts in the block.
    """

    levels: Array
    fast_a2: Array
    spikes: Array
    temperature_c: Array
    starts: Mask


@dataclass(frozen=True, kw_only=True)
class DriveSummary:
    """Second moments of the drives of one vehicle, in B blocks.

    Attributes
    ----------
    moments : ndarray of shape (B, M + K + 1, M + K + 1)
        Sums over the samples of a block of the products of (inputs, measured currents [A], 1). Inputs here are the M
        columns of the filter bank: the inputs of the drive and their filtered forms.
    noise_a2 : ndarray of shape (B, K)
        Variance of the white noise of each measured current in a block; an upper bound where the current itself changes
        fast. In summaries of vehicles it is at least that of rounding to the current's steps. [A^2]
    branches : int
        Number of branches K.
    period_s : float
        Time between samples. [s]
    bank : str
        Identity of the filter bank, see :class:`~calibrator.summaries.filter_bank.FilterBank`.
    fit : FitSums or None
        Sums for the check of fit; None if the moments were not made from samples: then nothing is checked.
    """

    moments: Array
    noise_a2: Array
    branches: int
    period_s: float
    bank: str
    fit: FitSums | None = None

    @property
    def inputs(self) -> int:
        """Number of inputs M, filtered ones included."""
        return int(self.moments.shape[1]) - self.branches - 1

    @property
    def total(self) -> Array:
        """Sum of the moments of all blocks, shape (M + K + 1, M + K + 1)."""
        return np.asarray(self.moments.sum(axis=0))

    @property
    def duration_s(self) -> float:
        """Duration of the samples summed up. [s]"""
        return float(self.moments[:, -1, -1].sum()) * self.period_s

    @property
    def mean_a(self) -> Array:
        """Mean measured currents, shape (K,). [A]"""
        total = self.total
        return np.asarray(total[-1, self.inputs : -1] / total[-1, -1])

    @property
    def mean_product_a2(self) -> Array:
        """Mean of the products of measured currents, shape (K, K). [A^2]"""
        total = self.total
        return np.asarray(total[self.inputs : -1, self.inputs : -1] / total[-1, -1])

    @property
    def variance_a2(self) -> Array:
        """Variance of the measured currents, which does not depend on their offsets, shape (K,). [A^2]"""
        return np.asarray(np.diag(self.mean_product_a2) - self.mean_a**2)

    def take_branches(self, order: Sequence[int], inputs: Sequence[int] | None = None) -> "DriveSummary":
        """Return the summary with only the branches of the indices `order`, and the inputs of the indices `inputs`.

        Both come in this order; None keeps all inputs.
        """
        chosen, M = list(order), self.inputs
        columns = [*(range(M) if inputs is None else inputs), *(M + k for k in chosen), M + self.branches]
        return replace(
            self,
            moments=np.ascontiguousarray(self.moments[:, columns][:, :, columns]),
            noise_a2=self.noise_a2[:, chosen],
            branches=len(chosen),
            fit=self.fit
            and replace(
                self.fit,
                levels=self.fit.levels[chosen][:, :, [*columns, -1]],
                fast_a2=self.fit.fast_a2[:, chosen][:, :, chosen],
                spikes=self.fit.spikes[:, chosen],
            ),
        )

    def shortened(self, most: int) -> "DriveSummary":
        """Return the summary with neighbouring blocks added up into at most `most`; means are weighted by samples."""
        count, samples, fit = len(self.moments), self.moments[:, -1, -1], self.fit
        if count <= most:
            return self
        first = np.arange(0, count, -(-count // most))

        def means(values: Array) -> Array:
            """Means of values (B, ...) over the blocks that are added up, NaN only where none of them is known."""
            weight = samples.reshape(-1, *[1] * (values.ndim - 1)) * np.isfinite(values)
            total = np.add.reduceat(weight, first)
            return np.add.reduceat(np.nan_to_num(values) * weight, first) / np.where(total > 0.0, total, np.nan)

        return replace(
            self,
            moments=np.add.reduceat(self.moments, first),
            noise_a2=means(self.noise_a2),
            fit=fit
            and FitSums(
                levels=fit.levels,
                fast_a2=np.add.reduceat(fit.fast_a2, first),
                spikes=np.add.reduceat(fit.spikes, first),
                temperature_c=means(fit.temperature_c),
                starts=np.logical_or.reduceat(fit.starts, first),
            ),
        )


def add_up(summaries: Sequence[DriveSummary]) -> DriveSummary:
    """Join one or more summaries with the same branches into one, which has their blocks one after the other.

    Raises
    ------
    DriveError
        If they were made with different banks.
    """
    common_bank(summaries)
    fits = [summary.fit for summary in summaries if summary.fit is not None]
    blocks = ("fast_a2", "spikes", "temperature_c", "starts")
    fit = None
    if len(fits) == len(summaries):
        joined = {name: np.concatenate([getattr(each, name) for each in fits]) for name in blocks}
        fit = FitSums(levels=np.sum([each.levels for each in fits], axis=0), **joined)
    return replace(
        summaries[0],
        moments=np.concatenate([summary.moments for summary in summaries]),
        noise_a2=np.concatenate([summary.noise_a2 for summary in summaries]),
        fit=fit,
    )


def common_bank(summaries: Sequence[DriveSummary]) -> str:
    """Return the identity of the filter bank with which these summaries, at least one, were made.

    Raises
    ------
    DriveError
        If they were made with different banks, so that their columns mean different things.
    """
    banks = dict.fromkeys(summary.bank for summary in summaries)
    if len(banks) > 1:
        raise DriveError(
            f"summaries of {len(summaries)} drives or vehicles made with {len(banks)} filter banks "
            f"({', '.join(banks)}); expected one, summarise all drives with the same bank"
        )
    return next(iter(banks))
