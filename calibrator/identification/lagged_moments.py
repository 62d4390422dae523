"""Second moments of lagged data: what a subspace identification needs of a recording.

Row t of the lagged data is (z(t), z(t+1), ..., z(t+L-1)). Its Gram matrix is block-Toeplitz but for the ends of the
recording: block (i+1, j+1) is block (i, j) plus one outer product at the end minus one at the start. So L products of
the data are formed instead of L^2, and a recording with gaps is the sum over its pieces.
"""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask

__all__ = ["LaggedMoments", "lagged_moments"]


@dataclass(frozen=True, kw_only=True)
class LaggedMoments:
    """Second moments of lagged data about their mean.

    Attributes
    ----------
    gram : ndarray of shape (L * p, L * p)
        Centred second moments, summed over the rows; lag-major.
    rows : int
        Number of rows of lagged data.
    """

    gram: Array
    rows: int

    def __add__(self, other: "LaggedMoments") -> "LaggedMoments":
        """Moments of both recordings, each about its own mean."""
        return LaggedMoments(gram=self.gram + other.gram, rows=self.rows + other.rows)


def lagged_moments(z: Array, lags: int, valid: Mask) -> LaggedMoments:
    """Sum the second moments of all rows of lagged data that hold valid samples only.

    Parameters
    ----------
    z : ndarray of shape (T, p)
        Data; finite where valid.
    lags : int
        Number of lags L.
    valid : ndarray of bool of shape (T,)
        Samples that may be used.

    Returns
    -------
    LaggedMoments
        Zero, with ``rows`` 0, if no L samples in a row are valid.
    """
    p = z.shape[1]
    gram, total, rows = np.zeros((lags, p, lags, p)), np.zeros((lags, p)), 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start >= lags:
            _add_piece(gram, total, z[start:stop])
            rows += int(stop - start) - lags + 1
    size = lags * p
    mean = total.ravel() / max(rows, 1)
    return LaggedMoments(gram=gram.reshape(size, size) - rows * np.outer(mean, mean), rows=rows)


def _add_piece(gram: Array, total: Array, z: Array) -> None:
    """Add the moments of one piece without gaps in place; gram of shape (L, p, L, p), total (L, p)."""
    lags = len(total)
    rows = len(z) - lags + 1
    first, last = z[: lags - 1], z[rows:]
    total += np.cumsum(np.vstack([z[:rows].sum(axis=0), last - first]), axis=0)
    for lag in range(lags):
        blocks = np.empty((lags - lag, z.shape[1], z.shape[1]))
        blocks[0] = z[:rows].T @ z[lag : lag + rows]
        blocks[1:] = last[: lags - 1 - lag, :, None] * last[lag:, None, :]
        blocks[1:] -= first[: lags - 1 - lag, :, None] * first[lag:, None, :]
        blocks = np.cumsum(blocks, axis=0)
        k = np.arange(lags - lag)
        gram[k, :, k + lag, :] += blocks
        if lag:
            gram[k + lag, :, k, :] += blocks.transpose(0, 2, 1)
