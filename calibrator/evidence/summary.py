"""DriveSummary: all that the estimator needs of recorded drives, of a size that does not grow with their sampling rate.

Per block of :data:`BLOCK_S` the second moments of (inputs, measured currents, 1). Summaries of drives add up, and the
spread between blocks tells how sure everything is that is computed from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.errors import DriveError

__all__ = ["BLOCK_S", "DriveSummary", "summarise"]

BLOCK_S = 30.0
"""Length of a block: model errors of different blocks hardly depend on each other. [s]"""
LEAST_SHARE = 0.2
"""Least share of valid samples of a block that is used. [1]"""
DIFFERENCE_GAIN = 20.0
"""Variance of the third difference of white noise of variance 1."""
NORMAL_MEDIAN = 0.6745
"""Median magnitude of a standard normal variable."""
MEDIAN_EXCESS = 3.8
"""The squared median of n third differences of white noise is too large by this over n (simulated, n = 9 to 300)."""


@dataclass(frozen=True, kw_only=True)
class DriveSummary:
    """Moments of the drives of one vehicle in B blocks.

    Attributes
    ----------
    moments : ndarray of shape (B, M + K + 1, M + K + 1)
        Sums over the samples of a block of the products of (inputs, measured currents [A], 1).
    noise_a2 : ndarray of shape (B, K)
        White noise of each measured current in a block; an upper bound where the current itself changes fast. [A^2]
    branches : int
        Number of branches K.
    period_s : float
        Distance of the samples. [s]
    extra : ndarray of shape (B, E, M + K + 1 + E), or None
        Sums of the products of E extra columns with (inputs, measured currents [A], 1, extra columns).
    """

    moments: Array
    noise_a2: Array
    branches: int
    period_s: float
    extra: Array | None = None

    @property
    def inputs(self) -> int:
        """Number of inputs M."""
        return int(self.moments.shape[1]) - self.branches - 1

    @property
    def total(self) -> Array:
        """Moments of all blocks together."""
        return np.asarray(self.moments.sum(axis=0))

    @property
    def duration_s(self) -> float:
        """Time summarised. [s]"""
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
        """Variance of the measured currents, which no offset changes, shape (K,). [A^2]"""
        return np.asarray(np.diag(self.mean_product_a2) - self.mean_a**2)

    def take_branches(self, order: Sequence[int]) -> "DriveSummary":
        """Return the same summary for some branches, in another order, without extra columns."""
        columns = [*range(self.inputs), *(self.inputs + k for k in order), self.inputs + self.branches]
        return DriveSummary(
            moments=self.moments[:, columns][:, :, columns],
            noise_a2=self.noise_a2[:, list(order)],
            branches=len(order),
            period_s=self.period_s,
        )


def summarise(drives: Sequence[Samples], *, period_s: float, extra: Sequence[Array] | None = None) -> DriveSummary:
    """Summarise the drives of one vehicle.

    Parameters
    ----------
    drives : sequence of Samples
        Aligned samples with the same branches and inputs.
    period_s : float
        Distance of the samples. [s]
    extra : sequence of ndarray of shape (T, E), or None
        More columns of each drive, finite wherever its samples are valid.

    Returns
    -------
    DriveSummary
        Blocks of all drives; those with too few valid samples are not among them.

    Raises
    ------
    DriveError
        If no block has enough valid samples.
    """
    length = max(round(BLOCK_S / period_s), 1)
    moments, noise, products = [], [], []
    for number, drive in enumerate(drives):
        for start in range(0, len(drive.time_s), length):
            part = slice(start, start + length)
            valid = drive.valid[part]
            if valid.sum() < LEAST_SHARE * length:
                continue
            currents = drive.currents_a[part]
            columns = np.column_stack([drive.inputs[part], currents, np.ones(len(valid))])[valid]
            moments.append(columns.T @ columns)
            if extra is not None:
                more = extra[number][part][valid]
                products.append(more.T @ np.column_stack([columns, more]))
            noise.append(_noise_a2(currents))
    if not moments:
        raise DriveError(f"no {BLOCK_S:.0f} s of drive in which {LEAST_SHARE:.0%} of the samples are valid")
    return DriveSummary(
        moments=np.stack(moments),
        noise_a2=np.stack(noise),
        branches=drives[0].currents_a.shape[1],
        period_s=period_s,
        extra=np.stack(products) if extra is not None else None,
    )


def _noise_a2(currents: Array) -> Array:
    """Variance of white noise from the median third difference; gaps (NaN) take no part. [A^2]"""
    third = np.abs(np.diff(currents, n=3, axis=0))
    known = np.isfinite(third).all(axis=1)
    if not known.any():
        return np.zeros(currents.shape[1])
    squared = (np.median(third[known], axis=0) / NORMAL_MEDIAN) ** 2 / DIFFERENCE_GAIN
    return np.asarray(squared / (1.0 + MEDIAN_EXCESS / known.sum()))
