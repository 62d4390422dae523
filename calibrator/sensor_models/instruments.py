"""Regression with instruments (two-stage least squares) on second moments in blocks.

A column of a measured current holds that current's noise and what the model misses, so that ordinary least squares
would find nonlinearities in linear sensors. The regressors x are therefore replaced by what the instruments tell of
them, x^ = P x; the instruments are functions of the inputs alone [1]_.

.. [1] J. M. Wooldridge, "Econometric Analysis of Cross Section and Panel Data", 2nd ed., MIT Press 2010, chapter 5.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.block_regression import regress_blocks

__all__ = ["InstrumentedFit", "Instruments"]

RANK = 1e-9
"""Instruments that add less than this share of their own mean square count as combinations of the others. [1]"""


@dataclass(frozen=True, kw_only=True)
class InstrumentedFit:
    """The last coefficient of one regression, and what moves it.

    Attributes
    ----------
    estimate : float
        The coefficient.
    influence : ndarray of shape (B,)
        What each block moves it by.
    misfit : ndarray of shape (Q,)
        Combination of instruments that the regression should have explained and did not: were the model exact, only
        noise would be left of it.
    lever : ndarray of shape (Q,)
        Combination of instruments whose mean product with a residual moves the coefficient by as much.
    freedom : float
        Number of instruments beyond the regressors.
    """

    estimate: float
    influence: Array
    misfit: Array
    lever: Array
    freedom: float


@dataclass(frozen=True, kw_only=True)
class Instruments:
    """Columns of one vehicle, in means of products, and what the instruments among them tell of each.

    Attributes
    ----------
    products : ndarray of shape (B, Q, Q)
        Products of the columns, summed per block and divided by the number of all samples.
    total : ndarray of shape (Q, Q)
        The same of all blocks together.
    projection : ndarray of shape (Q, Q)
        Turns a combination of columns into the combination of instruments that tells most of it.
    """

    products: Array
    total: Array
    projection: Array

    @classmethod
    def of(cls, products: Array, instruments: Sequence[int], *, constant: int) -> "Instruments":
        """Prepare the first stage.

        Parameters
        ----------
        products : ndarray of shape (B, Q, Q)
            Sums of products of the columns per block.
        instruments : sequence of int
            Positions of the instruments among the columns.
        constant : int
            Position of the column of ones.

        Returns
        -------
        Instruments
            For any regression with these instruments.
        """
        means = products / products[:, constant, constant].sum()
        total = means.sum(axis=0)
        projection = np.zeros(total.shape)
        projection[list(instruments)] = _solve(total[np.ix_(instruments, instruments)], total[list(instruments)])
        return cls(products=means, total=total, projection=projection)

    def coefficients(self, y: Array, x: Array) -> Array:
        """Coefficients of one combination of columns, shape (Q,), over others, shape (Q, p); shape (p,)."""
        z = self.projection @ x
        return _solve(z.T @ self.total @ z, z.T @ self.total @ y)

    def regress(self, y: Array, x: Array) -> InstrumentedFit:
        """Regress one combination of columns, shape (Q,), on others, shape (Q, p), with all that moves the result.

        Returns
        -------
        InstrumentedFit
            Of the last regressor.
        """
        z = self.projection @ x
        nothing = np.zeros(x.shape[1])
        power = float(y @ self.total @ y)
        fit = regress_blocks(
            z.T @ self.products @ x, (self.products @ y) @ z, power, prior_mean=nothing, prior_precision=nothing
        )
        return InstrumentedFit(
            estimate=float(fit.estimate[-1]),
            influence=fit.influence[:, -1],
            misfit=self.projection @ (y - x @ fit.estimate),
            lever=z @ _solve(z.T @ self.total @ z, np.eye(x.shape[1]))[:, -1],
            freedom=max(float(np.trace(self.projection)) - x.shape[1], 1.0),
        )

    def strength(self, column: Array, x: Array) -> float:
        """Root mean square of what the instruments tell of a column, shape (Q,), beyond x, shape (Q, p)."""
        left = self.projection @ (column - x @ self.coefficients(column, x))
        return float(np.sqrt(np.maximum(left @ self.total @ left, 0.0)))


def _solve(gram: Array, right: Array) -> Array:
    """Least-squares solution where columns may be combinations of each other."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    inverse = np.linalg.pinv(gram * np.outer(scale, scale), rcond=RANK, hermitian=True) * np.outer(scale, scale)
    return np.asarray(inverse @ right)
