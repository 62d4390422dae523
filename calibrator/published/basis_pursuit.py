"""Quadratic basis pursuit (18) of [1]_: the sparsest faults that explain slopes and intercepts, by lifting [2]_.

With the unknowns x = (d_h, o_h,1 .. o_h,K-1, D_m, o_m, 1) each of (15) is a quadratic form x' Q_i x = y_i, linear in
the matrix X = x x'. Dropping the rank leaves a convex problem:

    min  trace X + lambda |X|_1    s.t.  sum_i (trace(Q_i X) - y_i)^2 <= epsilon,  X_nn = 1,  X positive semidefinite

Offsets are in fractions of full scale here, so that they weigh like drifts. As in footnote 1 of [1]_, o_h,K is minus
the sum of the others and is not in the norm.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
.. [2] H. Ohlsson, A. Y. Yang, R. Dong, S. S. Sastry, "Quadratic Basis Pursuit", arXiv:1301.7002 (2013).
"""

from typing import Any

import cvxpy
import numpy as np

from calibrator.drive import Array

__all__ = ["BasisPursuit", "BasisPursuitError", "quadratic_forms"]

cp: Any = cvxpy  # its type hints leave out the atoms

L1_WEIGHT = 1.0
"""lambda; the result is the same from 1 to 100, and wrong at 0. [1]"""
SMALLEST_RADIUS = 1e-6
"""Residual norm below which the solver's own accuracy rules. [1]"""


class BasisPursuitError(Exception):
    """The solver gave no solution for one vehicle; the text says what it reported."""


def quadratic_forms(branches: int) -> Array:
    """Matrices Q_i of (16): slopes, then intercepts.

    Parameters
    ----------
    branches : int
        Number of branches K.

    Returns
    -------
    ndarray of shape (2K, 3K + 1, 3K + 1)
        Symmetric; x' Q_i x is the i-th of (15) for x = (d_h, o_h,1 .. o_h,K-1, D_m, o_m, 1).
    """
    K, one = branches, 3 * branches
    Q = np.zeros((2 * K, one + 1, one + 1))
    for k in range(K):
        drift, offset, slope, intercept = K + k, 2 * K + k, Q[k], Q[K + k]
        slope[one, one] = slope[drift, one] = slope[0, one] = slope[drift, 0] = 1.0
        intercept[offset, one] = 1.0
        free = slice(1 + k, 2 + k) if k < K - 1 else slice(1, K)
        sign = 1.0 if k < K - 1 else -1.0
        intercept[free, one] = intercept[drift, free] = sign
    return (Q + Q.transpose(0, 2, 1)) / 2.0


class BasisPursuit:
    """The problem for K branches, built once and solved for many vehicles.

    Parameters
    ----------
    branches : int
        Number of branches K.
    """

    def __init__(self, branches: int) -> None:
        size = 3 * branches + 1
        forms = quadratic_forms(branches).reshape(2 * branches, -1)
        self._y = cp.Parameter(2 * branches)
        self._radius = cp.Parameter(nonneg=True)
        self._X = cp.Variable((size, size), PSD=True)
        residual = forms @ cp.vec(self._X, order="C") - self._y
        objective = cp.trace(self._X) + L1_WEIGHT * cp.sum(cp.abs(self._X))
        constraints = [cp.norm(residual) <= self._radius, self._X[-1, -1] == 1.0]
        self._problem = cp.Problem(cp.Minimize(objective), constraints)

    def solve(self, slopes: Array, intercepts: Array, *, epsilon: float) -> Array:
        """Solve for one vehicle.

        Parameters
        ----------
        slopes, intercepts : ndarray of shape (K,)
            a [1], and b in fractions of full scale [1].
        epsilon : float
            Sum of squared residuals of (15) that is allowed. [1]

        Returns
        -------
        ndarray of shape (3K,)
            (d_h, o_h,1 .. o_h,K-1, D_m, o_m), offsets in fractions of full scale; shrunken by the norm.

        Raises
        ------
        BasisPursuitError
            If slopes or intercepts are not finite, or the solver reports anything but an optimum.
        """
        y = np.concatenate([slopes, intercepts])
        if not np.isfinite(y).all():
            raise BasisPursuitError("basis pursuit has nothing to solve: slopes or intercepts are not finite")
        self._y.value = y
        self._radius.value = max(float(np.sqrt(epsilon)), SMALLEST_RADIUS)
        try:
            self._problem.solve(solver=cp.CLARABEL)
        except cp.error.SolverError as error:
            raise BasisPursuitError(f"basis pursuit failed: {error}") from None
        if self._problem.status != cp.OPTIMAL:
            raise BasisPursuitError(f"basis pursuit ended with status '{self._problem.status}'")
        return np.asarray(self._X.value[:-1, -1], np.float64)
