"""Branch currents as the doctor compares them: without means and slow changes, and too smooth for a delay to matter.

Means are left out because a load that no sensor sees, and offsets, would be taken for faults of a branch; fast changes
because a delay between two branches would. What is left of all branches must still sum to nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Drive
from calibrator.drives.charge import Band, charge_curve
from calibrator.drives.delay_search import covered

__all__ = ["Bands", "branch_bands"]

BAND = Band(short_s=0.75, long_s=10.0)
"""Half widths of the averages: several times the delays of real cars, and as long as driving keeps its pace. [s]"""
STEP_S = 0.25
"""Distance of the instants: a third of the shorter window. [s]"""
BLOCK_S = 10.0
"""Blocks count as independent: as long as the longer window reaches. [s]"""


@dataclass(frozen=True, kw_only=True)
class Bands:
    """Comparable currents of the branches of one vehicle.

    Attributes
    ----------
    branches : tuple of str
        Names of the K branches.
    current_a : ndarray of shape (T, K)
        Band of each current, positive into the junction as the layout has it. [A]
    block : ndarray of int, shape (T,)
        Number of the block of time of each instant, from 0 on.
    """

    branches: tuple[str, ...]
    current_a: Array
    block: NDArray[np.intp]

    @property
    def moments(self) -> Array:
        """Second moments of each block, shape (B, K, K). [A^2]"""
        count = int(self.block[-1]) + 1 if len(self.block) else 0
        return np.stack(
            [self.current_a[self.block == b].T @ self.current_a[self.block == b] for b in range(count)]
            or [np.zeros((len(self.branches),) * 2)]
        )

    def multiplied(self, multipliers: Array) -> "Bands":
        """Return the same with each branch multiplied by a number."""
        return replace(self, current_a=self.current_a * multipliers)

    def in_order(self, branches: Sequence[str]) -> "Bands":
        """Return the same with the branches in another order."""
        columns = [self.branches.index(name) for name in branches]
        return replace(self, branches=tuple(branches), current_a=self.current_a[:, columns])

    def rms_a(self, multipliers: Array) -> float:
        """Root mean square of the sum with each branch multiplied by a number. [A]"""
        total = self.current_a @ multipliers
        return float(np.sqrt(np.mean(total**2))) if len(total) else 0.0


def branch_bands(drives: Sequence[Drive], branches: Sequence[str]) -> Bands:
    """Compute the bands of some branches over all drives of one vehicle.

    Parameters
    ----------
    drives : sequence of Drive
        A drive that lacks one of the branches adds nothing.
    branches : sequence of str
        Names of the K branches.

    Returns
    -------
    Bands
        Of no instant where no drive is long enough.
    """
    parts: list[Array] = []
    blocks: list[NDArray[np.intp]] = []
    count = 0
    for drive in drives:
        part, block = _of_drive(drive, branches)
        if len(part):
            parts.append(part)
            blocks.append(block + count)
            count += int(block[-1]) + 1
    return Bands(
        branches=tuple(branches),
        current_a=np.concatenate([np.zeros((0, len(branches))), *parts]),
        block=np.concatenate([np.zeros(0, np.intp), *blocks]),
    )


def _of_drive(drive: Drive, branches: Sequence[str]) -> tuple[Array, NDArray[np.intp]]:
    found = [charge_curve(drive.branches[name]) for name in branches if name in drive.branches]
    curves = [curve for curve in found if curve is not None]
    if len(curves) < len(branches):
        return np.zeros((0, len(branches))), np.zeros(0, np.intp)
    start_s, stop_s = max(curve.time_s[0] for curve in curves), min(curve.time_s[-1] for curve in curves)
    time_s = np.arange(start_s, max(stop_s, start_s), STEP_S)
    time_s = time_s[covered(curves, time_s, BAND.long_s)]
    current_a = np.stack([curve.band(time_s, BAND)[0] for curve in curves], axis=1)
    _, block = np.unique(np.floor(time_s / BLOCK_S), return_inverse=True)
    return current_a, np.asarray(block, np.intp)
