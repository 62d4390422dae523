"""Second moments of drives, made of drives as a whole or of pieces as they come."""

from collections.abc import Sequence

import numpy as np

from calibrator.compiled import compiled
from calibrator.drive import Array, Mask
from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.summaries.filter_bank import FilterBank, plain_bank
from calibrator.summaries.moments import BLOCK_S, DriveSummary
from calibrator.summaries.white_noise import white_noise_a2

__all__ = ["Summariser", "summarise"]

BATCH_SAMPLES = 1500
"""Samples whose products are formed at a time: as many as the processor's cache holds. [1]"""
LEAST_SHARE = 0.2
"""Least share of valid samples of a block that is used. [1]"""


class Summariser:
    """Makes the summary of the drives of one vehicle from pieces of any length, in a memory of fixed size per block.

    Where a drive is cut into pieces makes no difference: blocks are counted from its start.

    Parameters
    ----------
    bank : FilterBank
        Makes the columns from the inputs.
    branches : int
        Number of branches K.
    extra : int
        Number of extra columns E.
    settling : int
        Samples after the start of a drive that are not used, if they are more than the bank needs.
    """

    def __init__(self, bank: FilterBank, *, branches: int, extra: int = 0, settling: int = 0) -> None:
        self.bank = bank
        self.branches = branches
        self._block = max(round(BLOCK_S / bank.period_s), 1)
        self._columns = bank.width + branches + 1
        rows = self._block * max(BATCH_SAMPLES // self._block, 1)
        self._table = np.zeros((rows, self._columns + extra))
        self._used = np.zeros(rows, np.bool_)
        self._currents = np.full((rows, branches), np.nan)
        self._filled = 0
        self._settling = settling
        self._state = bank.start(settling=settling)
        self._moments: list[Array] = []
        self._extra: list[Array] = []
        self._noise: list[Array] = []

    def add(self, inputs: Array, currents_a: Array, valid: Mask, *, extra: Array | None = None) -> None:
        """Take the next samples of a drive.

        Parameters
        ----------
        inputs : ndarray of shape (T, M)
            Inputs, finite where valid.
        currents_a : ndarray of shape (T, K)
            Measured branch currents, positive into the junction, finite where valid. [A]
        valid : ndarray of bool of shape (T,)
            Samples that may be used.
        extra : ndarray of shape (T, E) or None
            Extra columns, finite where valid.

        Raises
        ------
        DriveError
            If the arrays do not belong together, or are not of the bank's inputs.
        """
        self._require_shapes(inputs, currents_a, valid, extra)
        start = 0
        while start < len(inputs):
            stop = start + min(len(self._table) - self._filled, len(inputs) - start)
            part = slice(start, stop)
            self._take(inputs[part], currents_a[part], valid[part], None if extra is None else extra[part])
            if self._filled == len(self._table):
                self._close()
            start = stop

    def end_drive(self) -> None:
        """End a drive: its last block is closed, short as it may be, and the filters forget it."""
        self._close()
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
                f"no {BLOCK_S:.0f} s of drive in which {LEAST_SHARE:.0%} of the samples are valid{self._settled()}"
            )
        return DriveSummary(
            moments=moments,
            noise_a2=np.concatenate(self._noise),
            branches=self.branches,
            period_s=self.bank.period_s,
            bank=self.bank.identity,
            extra=np.concatenate(self._extra) if self._table.shape[1] > self._columns else None,
        )

    def _require_shapes(self, inputs: Array, currents_a: Array, valid: Mask, extra: Array | None) -> None:
        T, E = len(inputs), self._table.shape[1] - self._columns
        found = [inputs.shape, currents_a.shape, valid.shape, (T, 0) if extra is None else extra.shape]
        wanted = [(T, len(self.bank.input_names)), (T, self.branches), (T,), (T, E)]
        if found != wanted:
            raise DriveError(
                f"inputs, currents, mask and extra columns of shapes {', '.join(map(str, found))}; "
                f"expected {', '.join(map(str, wanted))}"
            )

    def _settled(self) -> str:
        settling_s = self._state.settling * self.bank.period_s
        return f" once its filter bank has settled, {settling_s:.0f} s after a start" if settling_s else ""

    def _take(self, inputs: Array, currents_a: Array, valid: Mask, extra: Array | None) -> None:
        rows = slice(self._filled, self._filled + len(inputs))
        table, used = self._table[rows], self._used[rows]
        self._state.run_into(table, used, inputs, valid)
        _put(np.ascontiguousarray(currents_a, np.float64), used, table, self.bank.width)
        if extra is not None:
            table[used, self._columns :] = extra[used]
        self._currents[rows] = currents_a
        self._filled = rows.stop

    def _close(self) -> None:
        """Sum the blocks of the table; the rest of the last one counts as not valid."""
        filled, length = self._filled, self._block
        if not filled:
            return
        blocks = -(-filled // length)
        self._table[filled : blocks * length] = 0.0
        self._used[filled : blocks * length] = False
        kept = self._used[: blocks * length].reshape(blocks, length).sum(axis=1) >= LEAST_SHARE * length
        table = self._table[: blocks * length].reshape(blocks, length, -1)
        table = table if kept.all() else table[kept]
        narrow = table[:, :, : self._columns]
        self._moments.append(np.swapaxes(narrow, 1, 2) @ narrow)
        self._extra.append(np.swapaxes(table[:, :, self._columns :], 1, 2) @ table)
        self._noise.append(white_noise_a2(self._currents[:filled], length)[kept])
        self._filled = 0


def summarise(
    drives: Sequence[Samples], *, period_s: float, bank: FilterBank | None = None, extra: Sequence[Array] | None = None
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
    extra : sequence of ndarray of shape (T, E), or None
        More columns of each drive, finite wherever its samples are valid.

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
    widths = [0] if extra is None else [part.shape[1] for part in extra]
    summariser = Summariser(used, branches=drives[0].currents_a.shape[1], extra=widths[0])
    for number, drive in enumerate(drives):
        more = None if extra is None else extra[number]
        summariser.add(drive.inputs, drive.currents_a, drive.valid, extra=more)
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
