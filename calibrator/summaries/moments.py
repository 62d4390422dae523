"""DriveSummary: all that the estimator needs of recorded drives, of a size that does not grow with their sampling rate.

Per block of :data:`BLOCK_S` the second moments of (columns of a filter bank, measured currents, 1). Summaries of drives
add up, and the spread between blocks tells how sure everything is that is computed from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.errors import DriveError
from calibrator.summaries.fit_sums import FitSums
from ecu_node.summary import BLOCK_S

__all__ = ["BLOCK_S", "DriveSummary", "common_bank"]


@dataclass(frozen=True, kw_only=True)
class DriveSummary:
    """Moments of the drives of one vehicle in B blocks.

    Attributes
    ----------
    moments : ndarray of shape (B, M + K + 1, M + K + 1)
        Sums over the samples of a block of the products of (inputs, measured currents [A], 1); the inputs are the M
        columns of the filter bank: those of the drive, and what the bank makes of them.
    noise_a2 : ndarray of shape (B, K)
        White noise of each measured current in a block; an upper bound where the current itself changes fast. [A^2]
    branches : int
        Number of branches K.
    period_s : float
        Distance of the samples. [s]
    bank : str
        Identity of the filter bank, see :class:`~calibrator.summaries.filter_bank.FilterBank`.
    fit : FitSums or None
        What the check of fit needs; None: moments that were not made of samples, nothing is checked.
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

    def __add__(self, other: "DriveSummary") -> "DriveSummary":
        """Return the summary of the drives of both: blocks one after the other.

        Raises
        ------
        DriveError
            If they were made with different banks, or with different branches or columns.
        """
        common_bank([self, other])
        shapes = [(part.branches, part.moments.shape[1:]) for part in (self, other)]
        if shapes[0] != shapes[1]:
            raise DriveError(
                f"summaries of {self.branches} and {other.branches} branches with moments of shape "
                f"{self.moments.shape[1:]} and {other.moments.shape[1:]} do not add up; summarise the drives alike"
            )
        return DriveSummary(
            moments=np.concatenate([self.moments, other.moments]),
            noise_a2=np.concatenate([self.noise_a2, other.noise_a2]),
            branches=self.branches,
            period_s=self.period_s,
            bank=self.bank,
            fit=None if self.fit is None or other.fit is None else self.fit + other.fit,
        )

    def take_branches(self, order: Sequence[int]) -> "DriveSummary":
        """Return the same summary for some branches, in another order."""
        columns = [*range(self.inputs), *(self.inputs + k for k in order), self.inputs + self.branches]
        return DriveSummary(
            moments=self.moments[:, columns][:, :, columns],
            noise_a2=self.noise_a2[:, list(order)],
            branches=len(order),
            period_s=self.period_s,
            bank=self.bank,
            fit=None if self.fit is None else self.fit.take_branches(order),
        )


def common_bank(summaries: Sequence[DriveSummary]) -> str:
    """Identity of the filter bank that all summaries were made with.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        At least one.

    Returns
    -------
    str
        Identity of the bank.

    Raises
    ------
    DriveError
        If there is more than one: their columns do not mean the same.
    """
    banks = dict.fromkeys(summary.bank for summary in summaries)
    if len(banks) > 1:
        raise DriveError(
            f"summaries of {len(summaries)} drives or vehicles made with {len(banks)} filter banks "
            f"({', '.join(banks)}); expected one, summarise all drives with the same bank"
        )
    return next(iter(banks))
