"""Drive summaries of many vehicles as one array of blocks, so that each step is done for all of them at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.block_regression import Blocks
from calibrator.summaries.moments import DriveSummary, common_bank

__all__ = ["FleetMoments", "stack_summaries"]


@dataclass(frozen=True, kw_only=True)
class FleetMoments:
    """Moments of N vehicles with M inputs and K branches in B blocks.

    Attributes
    ----------
    moments : ndarray of shape (B, M + K + 1, M + K + 1)
        As in a :class:`~calibrator.summaries.moments.DriveSummary`, the vehicles one after the other.
    noise_a2 : ndarray of shape (B, K)
        The same. [A^2]
    blocks : Blocks
        Whose blocks these are.
    branches : int
        Number of branches K.
    """

    moments: Array
    noise_a2: Array
    blocks: Blocks
    branches: int

    def __len__(self) -> int:
        return len(self.blocks.first)

    @property
    def inputs(self) -> int:
        """Number of inputs M."""
        return int(self.moments.shape[1]) - self.branches - 1

    @cached_property
    def mean(self) -> Array:
        """Mean products of (inputs, measured currents, 1) over all samples of a vehicle, shape (N, p, p)."""
        total = self.blocks.total(self.moments)
        return np.asarray(total / total[:, -1:, -1:])

    @property
    def mean_a(self) -> Array:
        """Mean measured currents, shape (N, K). [A]"""
        return self.mean[:, -1, self.inputs : -1]

    @property
    def mean_square_a2(self) -> Array:
        """Mean squares of the measured currents, shape (N, K). [A^2]"""
        return np.diagonal(self.mean, axis1=1, axis2=2)[:, self.inputs : -1]

    @property
    def variance_a2(self) -> Array:
        """Variance of the measured currents, which no offset changes, shape (N, K). [A^2]"""
        return np.asarray(self.mean_square_a2 - self.mean_a**2)


def stack_summaries(summaries: Sequence[DriveSummary], order: Sequence[int] | None = None) -> FleetMoments:
    """Put summaries one after the other.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        Of N vehicles, at least one, with the same inputs and branches.
    order : sequence of int or None
        Branches to take, in this order; None: all in theirs.

    Returns
    -------
    FleetMoments
        Without extra columns.

    Raises
    ------
    DriveError
        If the summaries were made with different filter banks.
    """
    common_bank(summaries)
    M, K = summaries[0].inputs, summaries[0].branches
    chosen = list(range(K)) if order is None else list(order)
    columns = np.array([*range(M), *(M + k for k in chosen), M + K])
    return FleetMoments(
        moments=np.concatenate([summary.moments for summary in summaries])[:, columns[:, None], columns],
        noise_a2=np.concatenate([summary.noise_a2 for summary in summaries])[:, chosen],
        blocks=Blocks.of_lengths([len(summary.moments) for summary in summaries]),
        branches=len(chosen),
    )
