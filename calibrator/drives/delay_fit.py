"""Delays between branches to a fraction of the sample period: Newton steps on the junction sum, errors by jackknife.

With x_k the band of the measured current of branch k (:mod:`calibrator.drives.charge`),

    e(t) = x_1(t) + sum over k > 1 of g_k x_k(t + tau_k),       sum over t of e x_k = 0,   sum over t of e f(x_k') = 0.

The last equation is that of the slopes x_k'. f weakens slopes that are no greater than the branch's noise: a small
branch tells its delay by its few steps. Noise in x_k' would make the sums of f(x_k') g_k x_k', and so the confidence,
too great; the slope g_k x_k' - e', which the other branches predict, stands in its place. The windows of x_k hold
several samples of every branch: noise of a sensor then has nearly the same power in e whatever the phase of its
frames, and pulls tau nowhere. Huber's weights defend against wild samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled
from calibrator.drive import Array
from calibrator.drives.charge import Band, ChargeCurve

__all__ = ["DelayFit", "Stretch", "fit_delays"]

MOST_STEPS = 15
"""Five are usual; the delay of a branch that tells nothing wanders for ever."""
CONVERGED_S = 1e-6
"""A shorter step is none: a thousandth of what matters. [s]"""
LONGEST_STEP_S = 0.02
"""A longer step would leave the neighbourhood that the search found. [s]"""
MAD_TO_SD = 1.4826
"""Standard deviation of a Gaussian over its median absolute value. [1]"""
SLOPE_NOISES = 3.0
"""Slopes of this many standard deviations of a branch's usual slope count by half. [1]"""
HUBER = 3.0
"""Residuals of more than this many standard deviations weigh less: wild samples only. [1]"""
LEAST_SCALE = 0.1
"""Of the residual's root mean square: at rest most residuals are nearly zero, and their median says nothing. [1]"""
SINGULAR = 1e-10
"""Directions with less curvature than this share of the greatest are left alone. [1]"""
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """What the fit uses of one drive.

    Attributes
    ----------
    curves : tuple of ChargeCurve
        Currents of the K branches.
    time_s : ndarray of shape (T,)
        Increasing instants around which all branches are known, whatever their delay. [s]
    starts : ndarray of int of shape (B,)
        Index of the first instant of each block, B >= 1.
    """

    curves: tuple[ChargeCurve, ...]
    time_s: Array
    starts: NDArray[np.intp]


@dataclass(frozen=True, kw_only=True)
class DelayFit:
    """Where the junction sum is smallest.

    Attributes
    ----------
    gain, delay_s : ndarray of shape (K-1,)
        g_k [1] and tau_k [s] of the branches after the first. Sensor noise draws the gains of small branches to zero.
    sd_s : ndarray of shape (K-1,)
        Standard deviations of the delays; infinite where a branch does not change at all. [s]
    """

    gain: Array
    delay_s: Array
    sd_s: Array


def fit_delays(stretches: Sequence[Stretch], band: Band, start_s: Array, max_delay_s: float) -> DelayFit:
    """Fit gains and delays, starting nearby.

    Parameters
    ----------
    stretches : sequence of Stretch
        Of one vehicle, at least one.
    band : Band
        Windows of the averages.
    start_s : ndarray of shape (K-1,)
        First guess of the delays. [s]
    max_delay_s : float
        Delays are kept within this, ahead or behind. [s]

    Returns
    -------
    DelayFit
        The solution, or where the last step led.
    """
    others = len(start_s)
    gain, delay_s = np.ones(others), start_s
    for _ in range(MOST_STEPS):
        step = -_solve(_block_moments(stretches, band, gain, delay_s).sum(axis=0)[None])[0]
        step[others:] = np.clip(step[others:], -LONGEST_STEP_S, LONGEST_STEP_S)
        gain, delay_s = gain + step[:others], np.clip(delay_s + step[others:], -max_delay_s, max_delay_s)
        if np.all(np.abs(step[others:]) < CONVERGED_S):
            break
    sd = _jackknife_sd(_block_moments(stretches, band, gain, delay_s))
    return DelayFit(gain=gain, delay_s=delay_s, sd_s=sd[others:])


def _block_moments(stretches: Sequence[Stretch], band: Band, gain: Array, delay_s: Array) -> Array:
    """Equations of each block: their derivatives by (g, tau) and, last column, their values; (B, 2K-2, 2K-1)."""
    parts = [_bands(stretch, band, delay_s) for stretch in stretches]
    x, slope = (np.concatenate(part, axis=0) for part in zip(*parts, strict=True))
    gains = np.concatenate([[1.0], gain])
    e, e_slope = x @ gains, slope @ gains
    x, slope = x[:, 1:], slope[:, 1:]
    instrument = _huber_weight(e)[:, None] * np.hstack([x, _strong(slope)])
    columns = np.column_stack([x, gain * slope, e, e_slope])
    sums = _block_sums(instrument, columns, _all_starts(stretches))
    own = np.arange(len(gain), 2 * len(gain))
    sums[:, own, own] -= sums[:, own, -1]
    return sums[:, :, :-1]


@compiled
def _block_sums(instrument: Array, columns: Array, starts: NDArray[np.intp]) -> Array:
    """Sums over each block of the products of instruments (T, p) and columns (T, c), shape (B, p, c)."""
    instants, size = instrument.shape
    sums = np.zeros((len(starts), size, columns.shape[1]))
    for b in range(len(starts)):
        for t in range(starts[b], starts[b + 1] if b + 1 < len(starts) else instants):
            for i in range(size):
                for j in range(columns.shape[1]):
                    sums[b, i, j] += instrument[t, i] * columns[t, j]
    return sums


def _bands(stretch: Stretch, band: Band, delay_s: Array) -> tuple[Array, Array]:
    """Bands and slopes of all branches, shape (T, K) each, the delays taken out."""
    lags_s = [0.0, *delay_s]
    both = [curve.band(stretch.time_s + lag_s, band) for curve, lag_s in zip(stretch.curves, lags_s, strict=True)]
    return np.stack([x for x, _ in both], axis=1), np.stack([slope for _, slope in both], axis=1)


def _all_starts(stretches: Sequence[Stretch]) -> NDArray[np.intp]:
    before = np.cumsum([0, *(len(stretch.time_s) for stretch in stretches)])
    return np.concatenate([stretch.starts + n for stretch, n in zip(stretches, before, strict=False)])


def _strong(slope: Array) -> Array:
    """Slopes, weakened where they are no greater than each branch's usual ones."""
    usual = SLOPE_NOISES * MAD_TO_SD * np.median(np.abs(slope), axis=0)
    square = slope * slope
    return np.asarray(slope * (square / np.maximum(square + usual**2, _TINY)))


def _huber_weight(e: Array) -> Array:
    scale = max(MAD_TO_SD * float(np.median(np.abs(e))), LEAST_SCALE * float(np.sqrt(np.mean(e**2))), _TINY)
    return HUBER * scale / np.maximum(np.abs(e), HUBER * scale)


def _solve(moments: Array) -> Array:
    """Solutions of n sets of equations (n, p, p+1), shape (n, p); nothing moves where nothing is known."""
    matrix, value = moments[:, :, :-1], moments[:, :, -1]
    size = np.sqrt(np.abs(np.einsum("nii->ni", matrix)))
    size = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv(matrix / (size[:, :, None] * size[:, None, :]), rcond=SINGULAR)
    return np.asarray(np.einsum("nij,nj->ni", inverse, value / size) / size)


def _jackknife_sd(blocks: Array) -> Array:
    """Standard deviation of the solution from leaving out one block at a time, one step each."""
    total, count = blocks.sum(axis=0), len(blocks)
    left_out = _solve(total - blocks)
    sd = np.sqrt((count - 1) / count * np.sum((left_out - left_out.mean(axis=0)) ** 2, axis=0))
    return np.where(np.diagonal(total) != 0.0, sd, np.inf)
