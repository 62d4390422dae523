"""First guess of the delays between branches: the lags on a grid that make the junction sum smallest.

The second moments of the bands of all branches at all lags are gathered once; every combination of lags is then a
small least-squares problem made of some of them. Two branches at a time take their best lags with those of the others
held: branches that do much the same, as two motors, pull each other's lag off when they are searched one by one.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.drives.charge import Band, ChargeCurve

__all__ = ["covered", "search_lags"]

LAG_STEP_S = 0.02
"""Grid of the search, far finer than the windows: the true delay lies in the neighbourhood of the best lag. [s]"""
THINNING = 5
"""The sum is looked at on every fifth grid instant, ten times a second."""
SWEEPS = 2
"""How many times each pair of branches takes its best lags: the first time those of the rest are still guesses."""
SINGULAR = 1e-10
"""Combinations of branches with less than this share of the greatest power count as none. [1]"""


def search_lags(drives: Sequence[Sequence[ChargeCurve]], band: Band, max_delay_s: float) -> Array:
    """Find the lags that make the junction sum smallest, gains free.

    Parameters
    ----------
    drives : sequence of sequence of ChargeCurve
        Currents of the K branches on each drive of one vehicle.
    band : Band
        Windows of the averages.
    max_delay_s : float
        Longest lag to try, ahead or behind. [s]

    Returns
    -------
    ndarray of shape (K-1,)
        How much later than the first branch the others are seen, in whole steps of the grid. [s]
    """
    reach = int(max_delay_s / LAG_STEP_S)
    width = 2 * reach + 1
    moments = np.sum([_lagged_moments(curves, band, reach) for curves in drives], axis=0)
    branches = len(drives[0])
    column = reach + width * np.arange(branches)
    groups = list(combinations(range(1, branches), min(2, branches - 1)))
    for group in groups * SWEEPS:
        column[list(group)] = _best_columns(moments, column, group, width)
    return np.asarray((column[1:] % width - reach) * LAG_STEP_S)


def covered(curves: Sequence[ChargeCurve], time_s: Array, margin_s: float) -> Mask:
    """Whether all curves cover this much time on both sides of each instant."""
    return np.asarray(np.all([curve.covers(time_s, margin_s) for curve in curves], axis=0))


def _lagged_moments(curves: Sequence[ChargeCurve], band: Band, reach: int) -> Array:
    """Second moments of the bands of all branches at all lags, shape (K * width, K * width), branch by branch."""
    start_s, stop_s = max(curve.time_s[0] for curve in curves), min(curve.time_s[-1] for curve in curves)
    grid_s = np.arange(start_s, stop_s, LAG_STEP_S)
    usable = covered(curves, grid_s, band.long_s + reach * LAG_STEP_S)
    centres = np.flatnonzero(usable[reach : len(grid_s) - reach])[::THINNING]
    lagged = [sliding_window_view(curve.band(grid_s, band)[0], 2 * reach + 1)[centres] for curve in curves]
    z = np.concatenate(lagged, axis=1)
    return z.T @ z


def _best_columns(moments: Array, column: NDArray[np.intp], group: Sequence[int], width: int) -> NDArray[np.intp]:
    """Columns (lags) of some branches with which all together explain most of the first one."""
    choices = np.stack(np.meshgrid(*(width * k + np.arange(width) for k in group)), axis=-1).reshape(-1, len(group))
    tried = np.repeat(column[None, 1:], len(choices), axis=0)
    tried[:, np.array(group) - 1] = choices
    target = moments[tried, column[0]][:, :, None]
    gain = np.linalg.pinv(moments[tried[:, :, None], tried[:, None, :]], rcond=SINGULAR, hermitian=True) @ target
    return np.asarray(choices[np.argmax((gain * target).sum(axis=(1, 2)))])
