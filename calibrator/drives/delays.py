"""Estimate from raw frames how much later than the first branch each branch current of a vehicle is seen.

Sensors, filters and gateways delay the branch currents differently. The junction law shows only the differences. Let
x_k(t) be the band (:mod:`calibrator.drives.charge`) of the measured current of branch k, seen tau_k later than that of
the first branch, and g_k its gain ratio (1 + d_1) / (1 + d_k). Then, for each k > 1,

    e(t) = x_1(t) + sum over k > 1 of g_k x_k(t + tau_k),       sum over t of e x_k = 0,   sum over t of e f(x_k') = 0.

The last equation uses the slopes x_k'. The function f weakens slopes that are no larger than the branch's noise, as a
small branch shows its delay only in its few steps. Noise in x_k' would make the derivative of that equation by tau_k,
the sum of f(x_k') g_k x_k', and so the confidence, too large; that sum is therefore formed with g_k x_k' - e', the
slope that the other branches predict. The windows of x_k hold several samples of every branch: then the noise of a
sensor has nearly the same power in e whatever the phase of its frames, and does not bias tau. Huber's weights limit the
effect of wild samples.

A delay is a property of the vehicle. To avoid local minima it is first searched on a grid of lags, and then refined by
Newton steps, both in the few minutes in which the currents vary most. One or two steps on all drives make it exact, and
the spread between blocks of time gives its uncertainty. A branch that changes too little to show its delay is flagged.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled
from calibrator.drive import Array, Drive, Mask
from calibrator.drives.charge import Band, ChargeCurve, charge_curve, covered
from calibrator.errors import DriveError
from ecu_node.summary import MAD_TO_SD

__all__ = ["BranchDelays", "estimate_delays", "without_delays"]

MAX_DELAY_S = 0.5
"""Largest delay searched for: filters and gateways of real cars delay by tens to hundreds of milliseconds. [s]"""
MAX_SD_S = 0.005
"""Largest standard deviation of a delay that counts as known: half the period of a 100 Hz frame. [s]"""
SHORT_S = 0.2
"""Least half width w of the short windows: with it, sensor noise of some tenths of an ampere hides few steps of a small
branch. [s]"""
SHORT_PERIODS = 2.0
"""Least half width of the short windows in periods of the slowest branch, so that each holds at least four of its
samples. [1]"""
LONG_S = 5.0
"""Half width W of the long windows: slower changes of loads count as constant; auxiliaries still change within it.
[s]"""
INSTANTS_PER_WINDOW = 4.0
"""Instants evaluated per half width of the short windows; more add no information. [1]"""
BLOCK_S = 10.0
"""Length of a block. It is the whole width of a long window, so that blocks count as independent. [s]"""
FEWEST_BLOCKS = 6
"""Fewer blocks do not give a useful standard deviation. [1]"""
SEARCHED_BLOCKS = 60
"""Blocks in which delays are searched: ten minutes in which the currents vary most. [1]"""
HOPELESS = 3.0
"""If the standard deviation of a delay, in the searched blocks, exceeds the largest allowed this many times, the delay
is no longer estimated: it would wander and distort those of the other branches. [1]"""
GAIN_RANGE = (1.0 / 3.0, 3.0)
"""Plausible gain ratios of two sensors, with gains of 0.6 to 1.4 and some loss to noise. A ratio outside means that
another current than the branch's own was found. [1]"""

LAG_STEP_S = 0.05
"""Step of the grid of lags, a quarter of the least half width: the true delay is close to the best lag. [s]"""
SEARCHED_INSTANTS = 1200
"""Most instants used in the search for lags, and in the medians that set the scales of residuals and slopes. [1]"""
SWEEPS = 2
"""Rounds in which each pair of branches takes its best lags; in the first, the other lags are still guesses. [1]"""
SINGULAR = 1e-10
"""Unknowns do not change in directions with less curvature or power than this share of the largest. [1]"""

MOST_STEPS, MOST_STEPS_ON_ALL = 10, 2
"""Most Newton steps in the searched minutes, where five are usual, and on all drives, where one is. The delay of a
branch without information would wander for ever. [1]"""
CONVERGED_S = 1e-3
"""Newton's method ends after a step shorter than this: its error is the step squared over the windows, 5 us. [s]"""
LONGEST_STEP_S = 0.02
"""Steps are limited to this; a longer one would leave the neighbourhood of the lag that the search found. [s]"""
SLOPE_NOISES = 3.0
"""Slopes of this many standard deviations of a branch's usual slope have weight one half in f. [1]"""
HUBER = 3.0
"""Residuals of more than this many standard deviations weigh less, which concerns wild samples only. [1]"""
LEAST_SCALE = 0.1
"""Least scale of the residuals, as a share of their root mean square: at rest most residuals are nearly zero, and their
median says nothing. [1]"""
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, kw_only=True)
class BranchDelays:
    """Delays of the branches of one vehicle.

    Attributes
    ----------
    branches : tuple of str
        Names of the K branches; the first is the reference.
    delay_s : ndarray of shape (K,)
        How much later than the reference's each current is seen; 0 for the reference and where not known. [s]
    sd_s : ndarray of shape (K,)
        Standard deviation of the delay; 0 for the reference, infinite where not known. [s]
    known : ndarray of bool, shape (K,)
        False if the delay cannot be estimated: the branch is too small or too quiet, or the drives are too short.
    """

    branches: tuple[str, ...]
    delay_s: Array
    sd_s: Array
    known: Mask

    def by_branch(self) -> dict[str, float]:
        """Return the delay of each branch by name, for :func:`without_delays`. [s]"""
        return dict(zip(self.branches, self.delay_s.tolist(), strict=True))


@dataclass(frozen=True, kw_only=True)
class _Stretch:
    """One drive: curves of its K branches, instants around which all are known, and the block number of each instant.

    Block numbers count on from drive to drive.
    """

    curves: tuple[ChargeCurve, ...]
    time_s: Array
    block: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """Gain ratios and delays of the branches after the first, shape (K-1,) each.

    `sd_s` are the standard deviations of the delays; a delay that is not `free` is no longer estimated.
    """

    gain: Array
    delay_s: Array
    sd_s: Array
    free: Mask

    @property
    def plausible(self) -> Mask:
        """Whether gain ratio and delay are within their bounds, so that the branch's own current was found."""
        gain = self.gain
        return np.asarray((gain > GAIN_RANGE[0]) & (gain < GAIN_RANGE[1]) & (np.abs(self.delay_s) < MAX_DELAY_S))


def estimate_delays(drives: Sequence[Drive], branches: Sequence[str], *, max_sd_s: float = MAX_SD_S) -> BranchDelays:
    """Estimate by how much the branch currents of one vehicle are seen later than the first one.

    Parameters
    ----------
    drives : sequence of Drive
        Drives of one vehicle; a drive with too few good samples of a branch adds nothing.
    branches : sequence of str
        Names of the K branches that meet at the junction; the current of the first, the reference, should vary most.
    max_sd_s : float
        Largest standard deviation of a delay that counts as known. [s]

    Returns
    -------
    BranchDelays
        Delays relative to the first branch, with standard deviations.

    Raises
    ------
    DriveError
        If there is no drive, a drive lacks a branch, or fewer than two branches are asked for.
    """
    if not drives:
        raise DriveError("no drive to estimate delays from; record at least one drive of the vehicle")
    for drive in drives:
        _require_branches(drive, branches)
    if len(branches) < 2:
        raise DriveError(
            f"vehicle {drives[0].vehicle}: a delay is a difference of two branches, and only "
            f"{', '.join(branches) or 'none'} was asked for; choose at least two"
        )
    reference = np.arange(len(branches)) == 0
    recorded = [[charge_curve(drive.branches[name]) for name in branches] for drive in drives]
    complete = [tuple(curve for curve in curves if curve is not None) for curves in recorded if None not in curves]
    slowest_s = max((curve.period_s for curves in complete for curve in curves), default=0.0)
    band = Band(short_s=max(SHORT_S, SHORT_PERIODS * slowest_s), long_s=LONG_S)
    stretches, blocks = _stretches(complete, band) if band.short_s < LONG_S else ([], 0)  # else frames are too rare
    if blocks < FEWEST_BLOCKS:
        sd_s = np.where(reference, 0.0, np.inf)
        return BranchDelays(branches=tuple(branches), delay_s=np.zeros(len(branches)), sd_s=sd_s, known=reference)
    telling = _most_telling(stretches, band, blocks)
    found = _Fit(
        gain=np.ones(len(branches) - 1),
        delay_s=_search_lags(telling, band),
        sd_s=np.zeros(len(branches) - 1),
        free=np.ones(len(branches) - 1, np.bool_),
    )
    while True:
        found = _newton(telling, band, found, MOST_STEPS)
        hopeless = found.free & ~(found.plausible & (found.sd_s <= HOPELESS * max_sd_s))
        if not hopeless.any():
            break
        worst = np.arange(len(hopeless)) == np.argmax(np.where(hopeless, found.sd_s, -1.0))
        found = replace(found, free=found.free & ~worst, delay_s=np.where(worst, 0.0, found.delay_s))
    if telling is not stretches:
        found = _newton(stretches, band, found, MOST_STEPS_ON_ALL)
    delay_s, sd_s = found.delay_s, found.sd_s
    known = np.concatenate([[True], found.free & found.plausible & (sd_s <= max_sd_s)])
    return BranchDelays(
        branches=tuple(branches),
        delay_s=np.where(known, np.concatenate([[0.0], delay_s]), 0.0),
        sd_s=np.where(known, np.concatenate([[0.0], sd_s]), np.inf),
        known=known,
    )


def without_delays(drive: Drive, delays: Mapping[str, float]) -> Drive:
    """Return a drive with known delays taken out.

    Parameters
    ----------
    drive : Drive
        The drive.
    delays : mapping of str to float
        How much later each branch is seen, by name; branches that are not named stay as they are. [s]

    Returns
    -------
    Drive
        The drive with the samples of each named branch moved to the instants at which these currents flowed. Inputs
        stay as they are.

    Raises
    ------
    DriveError
        If the drive lacks a named branch.
    """
    _require_branches(drive, list(delays))
    return replace(
        drive,
        branches={
            name: replace(channel, time_s=channel.time_s - delays.get(name, 0.0))
            for name, channel in drive.branches.items()
        },
    )


def _require_branches(drive: Drive, branches: Sequence[str]) -> None:
    missing = [name for name in branches if name not in drive.branches]
    if missing:
        raise DriveError(
            f"vehicle {drive.vehicle}, drive {drive.name}: no branch {', '.join(missing)}; it has "
            f"{', '.join(drive.branches) or 'none'}; choose branches that all drives have"
        )


def _stretches(complete: Sequence[tuple[ChargeCurve, ...]], band: Band) -> tuple[list[_Stretch], int]:
    """Return the drives with the instants to evaluate, and the number of blocks of all of them together."""
    stretches: list[_Stretch] = []
    blocks = 0
    for curves in complete:
        start_s, stop_s = max(curve.time_s[0] for curve in curves), min(curve.time_s[-1] for curve in curves)
        time_s = np.arange(start_s, stop_s, band.short_s / INSTANTS_PER_WINDOW)
        time_s = time_s[covered(curves, time_s, band.long_s + MAX_DELAY_S)]
        if time_s.size:
            number = np.floor((time_s - start_s) / BLOCK_S)
            block = np.cumsum(np.diff(number, prepend=-1.0) != 0.0) - 1
            stretches.append(_Stretch(curves=curves, time_s=time_s, block=blocks + block))
            blocks += int(block[-1]) + 1
    return stretches, blocks


def _most_telling(stretches: Sequence[_Stretch], band: Band, blocks: int) -> Sequence[_Stretch]:
    """Return the stretches with only those blocks in which the currents vary most.

    A branch's movement in a block counts as a share of its total, so that small branches count as much as large ones.
    """
    if blocks <= SEARCHED_BLOCKS:
        return stretches
    K = len(stretches[0].curves)
    _, slope = _bands(stretches, range(K), band, np.zeros(K))
    starts = np.flatnonzero(np.diff(np.concatenate([stretch.block for stretch in stretches]), prepend=-1))
    power = np.add.reduceat(slope**2, starts)
    share = power / np.maximum(power.sum(axis=0), _TINY)
    rank = np.full(blocks, -1)
    chosen = np.sort(np.argsort(-share.sum(axis=1), kind="stable")[:SEARCHED_BLOCKS])
    rank[chosen] = np.arange(SEARCHED_BLOCKS)
    return [
        replace(stretch, time_s=stretch.time_s[kept], block=rank[stretch.block[kept]])
        for stretch in stretches
        if (kept := rank[stretch.block] >= 0).any()
    ]


# ---- first guess


def _search_lags(parts: Sequence[_Stretch], band: Band) -> Array:
    """Search on a grid how much later than the first branch the others are seen, shape (K-1,). [s]

    These lags make the junction sum smallest, with free gains. The second moments of the bands of all branches at all
    lags are computed once; each combination of lags is then a small least-squares problem with some of these moments.
    Two branches at a time take their best lags, while those of the others are held: branches with similar currents,
    such as two motors, would distort each other's lag if they were searched one by one.
    """
    reach = int(MAX_DELAY_S / LAG_STEP_S)
    width, K = 2 * reach + 1, len(parts[0].curves)
    lags_s = LAG_STEP_S * np.arange(-reach, reach + 1)
    thinning = -(-sum(len(part.time_s) for part in parts) // SEARCHED_INSTANTS)
    moments = np.zeros((K * width, K * width))
    for part in parts:
        instants = (part.time_s[::thinning, None] + lags_s).ravel()
        z = np.hstack([curve.band(instants, band)[0].reshape(-1, width) for curve in part.curves])
        moments += z.T @ z
    column = reach + width * np.arange(K)
    for group in [*combinations(range(1, K), min(2, K - 1))] * SWEEPS:
        column[list(group)] = _best_columns(moments, column, group, width)
    return np.asarray((column[1:] % width - reach) * LAG_STEP_S)


def _best_columns(moments: Array, column: NDArray[np.intp], group: Sequence[int], width: int) -> NDArray[np.intp]:
    """Return columns of `moments` (lags), one per branch in `group`: with these, all others best explain the first."""
    choices = np.stack(np.meshgrid(*(width * k + np.arange(width) for k in group)), axis=-1).reshape(-1, len(group))
    tried = np.repeat(column[None, 1:], len(choices), axis=0)
    tried[:, np.array(group) - 1] = choices
    target = moments[tried, column[0]][:, :, None]
    power = moments[tried[:, :, None], tried[:, None, :]]
    floor = SINGULAR * np.trace(power, axis1=1, axis2=2).max() + _TINY
    gain = np.linalg.solve(power + floor * np.eye(len(column) - 1), target)
    return np.asarray(choices[np.argmax((gain * target).sum(axis=(1, 2)))])


# ---- Newton's steps


def _newton(stretches: Sequence[_Stretch], band: Band, start: _Fit, steps: int) -> _Fit:
    """Refine gains and free delays by at most `steps` Newton steps, from a first guess nearby."""
    others, gain, delay_s = len(start.gain), start.gain, start.delay_s
    block = np.concatenate([stretch.block for stretch in stretches])
    first = _bands(stretches, [0], band, np.zeros(1))
    some = slice(None, None, -(-len(block) // SEARCHED_INSTANTS))  # enough for exact medians
    for _ in range(steps):
        x, slope = _bands(stretches, range(1, others + 1), band, delay_s)
        e = first[0][:, 0] + x @ gain
        scale = max(MAD_TO_SD * float(np.median(np.abs(e[some]))), LEAST_SCALE * float(np.sqrt(np.mean(e**2))), _TINY)
        usual = SLOPE_NOISES * MAD_TO_SD * np.median(np.abs(slope[some]), axis=0)
        sums = np.zeros((int(block[-1]) + 1, 2 * others, 2 * others + 1))
        _add_products((x, slope), (e, first[1][:, 0] + slope @ gain), gain, usual, HUBER * scale, block, sums)
        rows = np.concatenate([np.ones(others, np.bool_), start.free])
        sums = sums[:, rows][:, :, np.append(rows, [True])]
        step = np.zeros(2 * others)
        step[rows] = -_solve(sums.sum(axis=0)[None])[0]
        step_s = np.clip(step[others:], -LONGEST_STEP_S, LONGEST_STEP_S)
        gain, delay_s = gain + step[:others], np.clip(delay_s + step_s, -MAX_DELAY_S, MAX_DELAY_S)
        if np.all(np.abs(step_s) < CONVERGED_S):
            break
    sd_s = np.full(others, np.inf)
    sd_s[start.free] = _jackknife_sd(sums)[others:]
    return _Fit(gain=gain, delay_s=delay_s, sd_s=sd_s, free=start.free)


def _bands(stretches: Sequence[_Stretch], which: Sequence[int], band: Band, delay_s: Array) -> tuple[Array, Array]:
    """Return bands and slopes of some branches, their delays taken out, shape (T, n) each."""
    parts = [
        [stretch.curves[k].band(stretch.time_s + lag_s, band) for k, lag_s in zip(which, delay_s, strict=True)]
        for stretch in stretches
    ]
    x, slope = (np.concatenate([np.stack([both[j] for both in part], axis=1) for part in parts]) for j in range(2))
    return x, slope


@compiled
def _add_products(  # noqa: PLR0917 (compiled: no keywords)
    branches: tuple[Array, Array],
    residual: tuple[Array, Array],
    gain: Array,
    usual: Array,
    limit: float,
    block: NDArray[np.int64],
    sums: Array,
) -> None:
    """Add the equations of each instant to those of its block in `sums`, shape (B, 2K-2, 2K-1).

    The rows are products with the instruments (x, f(x')), the columns the derivatives by (g, tau); the last column
    holds the values. `branches` are (x, x'), `residual` is (e, e'), `usual` the slope with weight one half in f,
    `limit` the residual from which on Huber's weights fall.
    """
    (x, slope), (e, e_slope), others = branches, residual, len(gain)
    column = np.empty(2 * others + 1)
    for t in range(len(x)):
        weight = limit / max(abs(e[t]), limit)
        for k in range(others):
            column[k], column[others + k] = x[t, k], gain[k] * slope[t, k]
        column[2 * others] = e[t]
        for k in range(others):
            square = slope[t, k] ** 2
            strong = weight * slope[t, k] * square / max(square + usual[k] ** 2, _TINY)
            for j in range(2 * others + 1):
                sums[block[t], k, j] += weight * x[t, k] * column[j]
                sums[block[t], others + k, j] += strong * column[j]
            sums[block[t], others + k, others + k] -= strong * e_slope[t]


def _solve(moments: Array) -> Array:
    """Solve n sets of equations A y = b, given as (A, b) of shape (n, p, p + 1).

    Returns y, shape (n, p), zero in directions without information.
    """
    matrix, value = moments[:, :, :-1], moments[:, :, -1]
    size = np.sqrt(np.abs(np.einsum("nii->ni", matrix)))
    size = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv(matrix / (size[:, :, None] * size[:, None, :]), rcond=SINGULAR)
    return np.asarray(np.einsum("nij,nj->ni", inverse, value / size) / size)


def _jackknife_sd(blocks: Array) -> Array:
    """Estimate the standard deviation of the solution by a jackknife: one Newton step without each block."""
    total, count = blocks.sum(axis=0), len(blocks)
    left_out = _solve(total - blocks)
    sd = np.sqrt((count - 1) / count * np.sum((left_out - left_out.mean(axis=0)) ** 2, axis=0))
    return np.where(np.diagonal(total) != 0.0, sd, np.inf)
