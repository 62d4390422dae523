"""Second moments of drives, made of drives as a whole or of pieces as they come."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled
from calibrator.drive import Array, Mask
from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.summaries.filter_bank import FilterBank, plain_bank
from calibrator.summaries.fit_sums import LEVEL_EDGES_A, LEVEL_OF_AMPERE, FitSums, find_spikes, second_differences
from calibrator.summaries.moments import DriveSummary
from ecu_node.summary import (
    BATCH_SAMPLES,
    BLOCK_S,
    DIFFERENCE_GAIN,
    LEAST_SHARE,
    MEDIAN_EXCESS,
    NORMAL_MEDIAN,
)

__all__ = ["Summariser", "summarise_samples"]


class Summariser:
    """Makes the summary of the drives of one vehicle from pieces of any length, in a memory of fixed size per block.

    Where a drive is cut into pieces makes no difference: blocks are counted from its start.

    Parameters
    ----------
    bank : FilterBank
        Makes the columns from the inputs.
    branches : int
        Number of branches K.
    settling : int
        Samples after the start of a drive that are not used, if they are more than the bank needs.
    block_s : float
        Length of a block. [s]
    """

    def __init__(self, bank: FilterBank, *, branches: int, settling: int = 0, block_s: float = BLOCK_S) -> None:
        self.bank = bank
        self.branches = branches
        self._block_s = block_s
        self._block = max(round(block_s / bank.period_s), 1)
        self._columns = bank.width + branches + 1
        rows = self._block * max(BATCH_SAMPLES // self._block, 1)
        self._table = np.zeros((rows, self._columns))
        self._used = np.zeros(rows, np.bool_)
        self._currents = np.full((rows, branches), np.nan)
        self._temperature_c = np.full(rows, np.nan)
        self._filled = 0
        self._settling = settling
        self._state = bank.start(settling=settling)
        self._moments: list[Array] = []
        self._noise: list[Array] = []
        self._levels = np.zeros((branches, len(LEVEL_EDGES_A) + 1, self._columns + 1))
        self._fast: list[Array] = []
        self._spikes: list[Array] = []
        self._block_c: list[Array] = []
        self._starts: list[Mask] = []
        self._drive_starts = True

    def add(
        self,
        inputs: Array,
        currents_a: Array,
        valid: Mask,
        *,
        temperature_c: Array | None = None,
    ) -> None:
        """Take the next samples of a drive.

        Parameters
        ----------
        inputs : ndarray of shape (T, M)
            Inputs, finite where valid.
        currents_a : ndarray of shape (T, K)
            Measured branch currents, positive into the junction, finite where valid. [A]
        valid : ndarray of bool of shape (T,)
            Samples that may be used.
        temperature_c : ndarray of shape (T,) or None
            Temperature of the sensors; None: not known. [degC]

        Raises
        ------
        DriveError
            If the arrays do not belong together, or are not of the bank's inputs.
        """
        self._require_shapes(inputs, currents_a, valid)
        start = 0
        while start < len(inputs):
            stop = start + min(len(self._table) - self._filled, len(inputs) - start)
            part = slice(start, stop)
            rows = slice(self._filled, self._filled + stop - start)
            self._temperature_c[rows] = np.nan if temperature_c is None else temperature_c[part]
            self._take(inputs[part], currents_a[part], valid[part])
            if self._filled == len(self._table):
                self._close()
            start = stop

    def end_drive(self) -> None:
        """End a drive: its last block is closed, short as it may be, and the filters forget it."""
        self._close()
        self._drive_starts = True
        self._state = self.bank.start(settling=self._settling)

    def summary(self) -> DriveSummary:
        """Return the summary of the drives that ended.

        Raises
        ------
        DriveError
            If no block has enough valid samples.
        """
        moments = np.concatenate([np.zeros((0, self._columns, self._columns)), *self._moments])
        if not len(moments):
            raise DriveError(
                f"no {self._block_s:.0f} s of drive in which {LEAST_SHARE:.0%} of the samples are valid"
                f"{self._settled()}"
            )
        return DriveSummary(
            moments=moments,
            noise_a2=np.concatenate(self._noise),
            branches=self.branches,
            period_s=self.bank.period_s,
            bank=self.bank.identity,
            fit=FitSums(
                levels=self._levels.copy(),
                fast_a2=np.concatenate(self._fast),
                spikes=np.concatenate(self._spikes),
                temperature_c=np.concatenate(self._block_c),
                starts=np.concatenate(self._starts),
            ),
        )

    def _require_shapes(self, inputs: Array, currents_a: Array, valid: Mask) -> None:
        T = len(inputs)
        found = [inputs.shape, currents_a.shape, valid.shape]
        wanted = [(T, len(self.bank.input_names)), (T, self.branches), (T,)]
        if found != wanted:
            raise DriveError(
                f"inputs, currents and mask of shapes {', '.join(map(str, found))}; "
                f"expected {', '.join(map(str, wanted))}"
            )

    def _settled(self) -> str:
        settling_s = self._state.settling * self.bank.period_s
        return f" once its filter bank has settled, {settling_s:.0f} s after a start" if settling_s else ""

    def _take(self, inputs: Array, currents_a: Array, valid: Mask) -> None:
        rows = slice(self._filled, self._filled + len(inputs))
        table, used = self._table[rows], self._used[rows]
        self._state.run_into(table, used, inputs, valid)
        _put(np.ascontiguousarray(currents_a, np.float64), used, table, self.bank.width)
        self._currents[rows] = currents_a
        self._filled = rows.stop

    def _close(self) -> None:
        """Sum the blocks of the table without their spikes; the rest of the last one counts as not valid."""
        filled, length = self._filled, self._block
        if not filled:
            return
        blocks = -(-filled // length)
        self._table[filled : blocks * length] = 0.0
        self._used[filled : blocks * length] = False
        used, first = self._used[: blocks * length], self.bank.width
        currents = np.ascontiguousarray(self._table[: blocks * length, first : self._columns - 1])
        spikes = find_spikes(currents, used)
        marked = spikes.any(axis=1)
        if marked.any():
            self._table[: blocks * length][marked] = 0.0
            currents[marked] = 0.0
            used &= ~marked
        kept = self._used[: blocks * length].reshape(blocks, length).sum(axis=1) >= LEAST_SHARE * length
        table = self._table[: blocks * length].reshape(blocks, length, -1)
        table = table if kept.all() else table[kept]
        self._moments.append(np.swapaxes(table, 1, 2) @ table)
        self._noise.append(_white_noise_a2(self._currents[:filled], length)[kept])
        used = used.reshape(blocks, length)
        _add_levels(table, used[kept], first, LEVEL_OF_AMPERE, self._levels)
        fast = second_differences(currents.reshape(blocks, length, -1), used)[kept]
        self._fast.append(np.swapaxes(fast, 1, 2) @ fast)
        upward, downward = ((sign * spikes > 0).reshape(blocks, length, -1).sum(axis=1)[kept] for sign in (1, -1))
        self._spikes.append(np.stack([upward, downward], axis=2).astype(np.float64))
        self._sum_temperature(used, kept)
        self._starts.append(self._drive_starts & (np.arange(len(table)) == 0))
        self._drive_starts = self._drive_starts and not len(table)
        self._filled = 0

    def _sum_temperature(self, used: Mask, kept: Mask) -> None:
        """Mean temperature of each block that is kept."""
        warm = self._temperature_c[: used.size].reshape(used.shape)
        known = used & np.isfinite(warm)
        with np.errstate(invalid="ignore"):
            self._block_c.append((np.where(known, warm, 0.0).sum(axis=1) / known.sum(axis=1))[kept])


def summarise_samples(
    drives: Sequence[Samples],
    *,
    period_s: float,
    bank: FilterBank | None = None,
    temperatures_c: Sequence[Array] | None = None,
    block_s: float = BLOCK_S,
) -> DriveSummary:
    """Summarise the drives of one vehicle.

    Parameters
    ----------
    drives : sequence of Samples
        Aligned samples with the same branches and inputs.
    period_s : float
        Distance of the samples. [s]
    bank : FilterBank or None
        Filters of the inputs; None: the plain inputs.
    temperatures_c : sequence of ndarray of shape (T,), or None
        Temperature of the sensors in each drive, NaN where it is not known. [degC]
    block_s : float
        Length of a block. [s]

    Returns
    -------
    DriveSummary
        Blocks of all drives; those with too few valid samples are not among them.

    Raises
    ------
    DriveError
        If no block has enough valid samples, or the bank is of other inputs or of another period.
    """
    used = plain_bank(drives[0].input_names, period_s=period_s) if bank is None else bank
    _require_fitting(used, drives, period_s)
    summariser = Summariser(used, branches=drives[0].currents_a.shape[1], block_s=block_s)
    for number, drive in enumerate(drives):
        warm = None if temperatures_c is None else temperatures_c[number]
        summariser.add(drive.inputs, drive.currents_a, drive.valid, temperature_c=warm)
        summariser.end_drive()
    return summariser.summary()


def _require_fitting(bank: FilterBank, drives: Sequence[Samples], period_s: float) -> None:
    for drive in drives:
        if (drive.input_names, period_s) != (bank.input_names, bank.period_s):
            raise DriveError(
                f"a drive of the inputs {', '.join(drive.input_names)} every {period_s:g} s, a filter bank of "
                f"{', '.join(bank.input_names)} every {bank.period_s:g} s; align the drive with the bank's inputs, or "
                "make a bank for the fleet's"
            )


@compiled
def _put(currents: Array, used: Mask, table: Array, first: int) -> None:
    """Put currents and 1 into the rows that are used, from a column on."""
    for t in range(len(currents)):
        if used[t]:
            for k in range(currents.shape[1]):
                table[t, first + k] = currents[t, k]
            table[t, first + currents.shape[1]] = 1.0


@compiled
def _add_levels(table: Array, used: Mask, first: int, level_of_ampere: NDArray[np.int64], levels: Array) -> None:
    """Add the rows of blocks that are used to the sums of the level of each of their currents."""
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
    """Variance of white noise per block from the median third difference; gaps (NaN) take no part. [A^2]"""
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
