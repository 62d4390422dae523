"""Summarise samples: filter inputs, leave spikes out, sum moments in blocks, and add the :class:`.FitSums`."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from calibrator.compiled import compiled
from calibrator.drive import Array, Mask, Samples
from calibrator.errors import DriveError
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.moments import BLOCK_S, LEVEL_EDGES_A, DriveSummary, FitSums
from ecu_node.summary import (
    BATCH_SAMPLES,
    DIFFERENCE_GAIN,
    FEWEST_FOR_GAINS,
    LEAST_EDGE,
    LEAST_SHARE,
    LEAST_SPIKE_A,
    LEVELS_A,
    MAD_TO_SD,
    MEDIAN_EXCESS,
    NORMAL_MEDIAN,
    OTHERS_MOVE,
    SPIKE_SDS,
    SPIKE_WINDOW,
    STEP_OF_SPIKE,
)

__all__ = ["find_spikes", "second_differences", "summarise_samples"]

LEVEL_OF_AMPERE: NDArray[np.int64] = np.searchsorted(LEVELS_A, np.arange(LEVELS_A[-1] + 1), side="right")
"""Element a: how many levels a current of magnitude a [A], in whole amperes, lies away from the middle level."""


def summarise_samples(
    drives: Sequence[Samples],
    *,
    period_s: float,
    bank: FilterBank | None = None,
    temperatures_c: Sequence[Array] | None = None,
    settling: int = 0,
    block_s: float = BLOCK_S,
) -> DriveSummary:
    """Summarise the drives of one vehicle.

    Parameters
    ----------
    drives : sequence of Samples
        Aligned samples with the same branches and inputs.
    period_s : float
        Time between samples. [s]
    bank : FilterBank or None
        Filters of the inputs; None: the plain inputs.
    temperatures_c : sequence of ndarray of shape (T,), or None
        Temperature of the sensors in each drive, NaN where it is not known. [degC]
    settling : int
        Number of samples not used after a start, if larger than the bank needs; see :meth:`.FilterBank.run`.
    block_s : float
        Length of a block. [s]

    Returns
    -------
    DriveSummary
        Blocks of all drives, without those that have too few valid samples.

    Raises
    ------
    DriveError
        If no block has enough valid samples, or the bank was made for other inputs or another period.
    """
    bank = FilterBank(input_names=drives[0].input_names, period_s=period_s) if bank is None else bank
    K, W = drives[0].currents_a.shape[1], bank.width
    length = max(round(block_s / period_s), 1)
    batch = length * max(BATCH_SAMPLES // length, 1)
    parts: list[tuple[Array, ...]] = []
    levels = np.zeros((K, len(LEVEL_EDGES_A) + 1, W + K + 2))
    for number, drive in enumerate(drives):
        if (drive.input_names, period_s) != (bank.input_names, bank.period_s):
            raise DriveError(
                f"a drive of the inputs {', '.join(drive.input_names)} every {period_s:g} s, a filter bank of "
                f"{', '.join(bank.input_names)} every {bank.period_s:g} s; align the drive with the bank's inputs, or "
                "make a bank for the fleet's"
            )
        T, blocks = len(drive.valid), -(-len(drive.valid) // length)
        table, used = np.zeros((blocks * length, W + K + 1)), np.zeros(blocks * length, np.bool_)
        table[:T, :W], used[:T] = bank.run(drive.inputs, drive.valid, settling=settling)
        table[:T, W:-1] = np.where(used[:T, None], drive.currents_a, 0.0)
        currents = np.ascontiguousarray(table[:, W:-1])
        spikes = np.zeros(currents.shape, np.int8)
        for start in range(0, len(used), batch):
            part = slice(start, start + batch)
            spikes[part] = find_spikes(currents[part], used[part])
        marked = spikes.any(axis=1)
        table[marked], currents[marked] = 0.0, 0.0
        used &= ~marked
        table[used, -1] = 1.0
        use = used.reshape(blocks, length)
        kept = use.sum(axis=1) >= LEAST_SHARE * length
        rows = table.reshape(blocks, length, -1)
        rows = rows if kept.all() else rows[kept]
        _add_levels(rows, use[kept], W, LEVEL_OF_AMPERE, levels)
        fast = second_differences(currents.reshape(blocks, length, K), use)[kept]
        upward, downward = ((sign * spikes > 0).reshape(blocks, length, K).sum(axis=1)[kept] for sign in (1, -1))
        warm_c = np.full(blocks * length, np.nan)
        if temperatures_c is not None:
            warm_c[:T] = temperatures_c[number]
        is_known = use & np.isfinite(warm_c.reshape(blocks, length))
        with np.errstate(invalid="ignore"):  # NaN if no temperature of a block is known
            mean_c = np.where(is_known, warm_c.reshape(blocks, length), 0.0).sum(axis=1) / is_known.sum(axis=1)
        parts.append(
            (
                np.swapaxes(rows, 1, 2) @ rows,
                _white_noise_a2(np.ascontiguousarray(drive.currents_a, np.float64), length)[kept],
                np.swapaxes(fast, 1, 2) @ fast,
                np.stack([upward, downward], axis=2).astype(np.float64),
                mean_c[kept],
                np.arange(len(rows)) == 0,
            )
        )
    moments, noise_a2, fast_a2, spikes_, temperature_c, starts = map(np.concatenate, zip(*parts, strict=True))
    if not len(moments):
        settling_s = max(settling, bank.settling) * period_s
        settled = f" once its filter bank has settled, {settling_s:.0f} s after a start" if settling_s else ""
        raise DriveError(f"no {block_s:.0f} s of drive in which {LEAST_SHARE:.0%} of the samples are valid{settled}")
    return DriveSummary(
        moments=moments,
        noise_a2=noise_a2,
        branches=K,
        period_s=period_s,
        bank=bank.identity,
        fit=FitSums(levels=levels, fast_a2=fast_a2, spikes=spikes_, temperature_c=temperature_c, starts=starts),
    )


@compiled
def _add_levels(table: Array, used: Mask, first: int, level_of_ampere: NDArray[np.int64], levels: Array) -> None:
    """Add each used sample, once per branch, to the sums of the level in which the current of that branch lies.

    `table` has the shape (blocks, samples, columns); its currents begin at column `first`.
    """
    K, L, wide = levels.shape
    for block in range(len(table)):
        for t in range(table.shape[1]):
            if used[block, t]:
                row = table[block, t]
                for k in range(K):
                    x = row[first + k]
                    away = level_of_ampere[min(int(abs(x)), len(level_of_ampere) - 1)]
                    sums = levels[k, L // 2 + (away if x > 0.0 else -away)]
                    for i in range(wide - 1):
                        sums[i] += row[i]
                    sums[wide - 1] += x * x


@compiled
def _white_noise_a2(currents: Array, length: int) -> Array:
    """Return the white noise variance of each block and branch, from the median third difference outside gaps (NaN).

    Shape (B, K); blocks of `length` samples. [A^2]
    """
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


def second_differences(currents_a: Array, used: Mask) -> Array:
    """Return each sample minus the mean of its two neighbours; zero where one of the three is not used.

    Parameters
    ----------
    currents_a : ndarray of shape (..., T, K)
        Measured currents. [A]
    used : ndarray of bool of shape (..., T)
        Samples that may be used.

    Returns
    -------
    ndarray of shape (..., T - 2, K)
        White noise of variance s^2 has variance 1.5 s^2 here; slow changes of a current hardly show. [A]
    """
    inner = used[..., 1:-1] & used[..., :-2] & used[..., 2:]
    distance = currents_a[..., 1:-1, :] - 0.5 * (currents_a[..., :-2, :] + currents_a[..., 2:, :])
    return np.asarray(np.where(inner[..., None], distance, 0.0))


def find_spikes(currents_a: Array, used: Mask) -> NDArray[np.int8]:
    """Label spikes: samples at which one branch alone breaks the junction law and stands out from its neighbours.

    Parameters
    ----------
    currents_a : ndarray of shape (T, K)
        Measured currents of some minutes of consecutive samples, zero where not used. [A]
    used : ndarray of bool of shape (T,)
        Samples that may be used.

    Returns
    -------
    ndarray of int of shape (T, K)
        1 for an upward, -1 for a downward spike, 0 for none. Spikes are found by a Hampel test of the residual of the
        junction law, with gains fitted to the same samples.
    """
    found = np.zeros(currents_a.shape, np.int8)
    K = currents_a.shape[1]
    kept = used
    for _ in range(2):  # the second time with gains that are fitted without the spikes
        if kept.sum() < FEWEST_FOR_GAINS * K:
            return found
        weights = _junction_weights(currents_a, kept)
        residual = currents_a @ weights
        change = np.abs(np.diff(residual))[used[1:] & used[:-1]]
        if not change.max(initial=0.0) > max(STEP_OF_SPIKE * float(np.median(change)), LEAST_SPIKE_A):
            return found  # the usual case; what follows takes longer
        far = residual - median_filter(residual, SPIKE_WINDOW, mode="nearest")
        spread = MAD_TO_SD * float(np.median(np.abs(far[kept])))
        suspects = used & (np.abs(far) > max(SPIKE_SDS * spread, LEAST_SPIKE_A))
        kept = used & ~suspects
    at, half = np.flatnonzero(suspects), SPIKE_WINDOW // 2
    near = np.clip(at[:, None] + np.arange(-half, half + 1), 0, len(used) - 1)
    around = (currents_a * weights)[near]  # (spikes, window, K)
    moves = around - np.median(around, axis=1, keepdims=True)
    own, nearby = moves[:, half], np.abs(moves[:, half - 1 : half + 2]).max(axis=1)
    steps = np.diff(moves, axis=1) * np.sign(own)[:, None]
    edge = np.minimum(steps[:, :half].max(axis=1), -steps[:, half:].min(axis=1))
    for k in range(K):
        height = np.abs(own[:, k])
        alone = (nearby.sum(axis=1) - nearby[:, k] < OTHERS_MOVE * height) & (edge[:, k] > LEAST_EDGE * height)
        found[at[alone], k] = np.sign(own[alone, k] * weights[k])
    return found


def _junction_weights(currents_a: Array, kept: Mask) -> Array:
    """Fit the weights of branches in the junction law by least squares; the branch that varies most has weight 1."""
    x = currents_a if kept.all() else currents_a[kept]
    mean = x.mean(axis=0)
    gram = x.T @ x - len(x) * np.outer(mean, mean)
    first = int(np.argmax(np.diag(gram)))
    others = [k for k in range(len(gram)) if k != first]
    weights = np.zeros(len(gram))
    weights[first] = 1.0
    weights[others] = -np.linalg.lstsq(gram[np.ix_(others, others)], gram[others, first], rcond=1e-9)[0]
    return weights
