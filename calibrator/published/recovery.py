"""Recover the fault parameters of a whole fleet, by the four cases of [1]_, section III-B.

In case 1 (nothing is faulty) and 2 (only hardware) there are no sensor parameters. In case 3 (only sensors) they follow
directly from slopes and intercepts. In case 4 (both) quadratic basis pursuit (18) finds the sparsest faults that
explain slopes and intercepts, by lifting [2]_; numbers of equations are those of [1]_. With the unknowns
x = (d_h, o_h,1 .. o_h,K-1, D_m, o_m, 1) each equation of (15) is a quadratic form x' Q_i x = y_i, which is linear in
the matrix X = x x'. Without the condition that X has rank 1 this is a convex problem:

    min  trace X + lambda |X|_1    s.t.  sum_i (trace(Q_i X) - y_i)^2 <= epsilon,  X_nn = 1,  X positive semidefinite

Offsets are in fractions of full scale here, so that they weigh like drifts. As in footnote 1 of [1]_, o_h,K is minus
the sum of the others and is not in the norm. Least squares on the support that was found removes the shrinkage that
the norm causes.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
.. [2] H. Ohlsson, A. Y. Yang, R. Dong, S. S. Sastry, "Quadratic Basis Pursuit", arXiv:1301.7002 (2013).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cvxpy
import numpy as np

from calibrator.drive import Array
from calibrator.faults import Faults
from calibrator.published.classify import Classification
from calibrator.published.evidence import FleetEvidence

__all__ = ["BasisPursuit", "BasisPursuitError", "Recovery", "quadratic_forms", "recover_fleet"]

cp: Any = cvxpy  # its type hints leave out the atoms

L1_WEIGHT = 1.0
"""lambda, the weight of the L1 norm; the result is the same from 1 to 100, and wrong at 0. [1]"""
EPSILON_SHARE = 0.25
"""epsilon of equation (18) of the paper over the sum of the variances of slopes and intercepts; results hardly change
from 0.05 to 4. [1]"""
SMALLEST_RADIUS = 1e-6
"""Least bound on the norm of the residual: below it the solver's own accuracy decides. [1]"""
LEAST_DEVIATION = 1e-9
"""Least standard deviation of slopes and intercepts when they are weighted; without noise it would be 0. [1]"""
SMALLEST_PARAMETER = 0.02
"""Magnitude below which a parameter is taken as zero: noise that the norm leaves is smaller, faults are larger. [1]"""
STEPS = 8
"""Gauss-Newton steps; the model is bilinear and the start close, so 4 already reach rounding. [1]"""


class BasisPursuitError(Exception):
    """The solver gave no solution for one vehicle; the text says what it reported."""


def quadratic_forms(branches: int) -> Array:
    """Build the matrices Q_i of equation (16) of the paper: those of the slopes, then those of the intercepts.

    Parameters
    ----------
    branches : int
        Number of branches K.

    Returns
    -------
    ndarray of shape (2K, 3K + 1, 3K + 1)
        Symmetric; x' Q_i x is the i-th slope or intercept, equation (15) of the paper, for
        x = (d_h, o_h,1 .. o_h,K-1, D_m, o_m, 1).
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
    """Quadratic basis pursuit, equation (18) of the paper, for K branches: built once, solved for many vehicles.

    Parameters
    ----------
    branches : int
        Number of branches K.
    """

    def __init__(self, branches: int) -> None:
        self.forms = quadratic_forms(branches)
        self._y = cp.Parameter(2 * branches)
        self._radius = cp.Parameter(nonneg=True)
        self._X = cp.Variable(self.forms.shape[1:], PSD=True)
        residual = self.forms.reshape(2 * branches, -1) @ cp.vec(self._X, order="C") - self._y
        objective = cp.trace(self._X) + L1_WEIGHT * cp.sum(cp.abs(self._X))
        constraints = [cp.norm(residual) <= self._radius, self._X[-1, -1] == 1.0]
        self._problem = cp.Problem(cp.Minimize(objective), constraints)

    def solve(self, y: Array, *, epsilon: float) -> Array:
        """Return the sparsest fault parameters that explain slopes and intercepts of one vehicle.

        Parameters
        ----------
        y : ndarray of shape (2K,)
            Slopes a [1], then intercepts b in fractions of full scale [1].
        epsilon : float
            Sum of squared residuals of equation (15) of the paper that is allowed. [1]

        Returns
        -------
        ndarray of shape (3K,)
            (d_h, o_h,1 .. o_h,K-1, D_m, o_m), offsets in fractions of full scale; shrunken by the norm.

        Raises
        ------
        BasisPursuitError
            If slopes or intercepts are not finite, or the solver reports anything but an optimum.
        """
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


def _refit(forms: Array, x: Array, y: Array, deviations: Array) -> Array:
    """Fit the nonzero parameters of one vehicle to its slopes and intercepts by Gauss-Newton, without shrinkage.

    Parameters
    ----------
    forms : ndarray of shape (2K, 3K + 1, 3K + 1)
        The matrices Q_i.
    x : ndarray of shape (3K,)
        Start values. Those of magnitude above :data:`SMALLEST_PARAMETER`, at most the 2K largest, are refitted.
    y, deviations : ndarray of shape (2K,)
        Slopes and intercepts as in :meth:`BasisPursuit.solve`, and their standard deviations, positive. [1]

    Returns
    -------
    ndarray of shape (3K,)
        Refitted parameters; if the refit diverges (a magnitude exceeds 1), their start values; zeros for the others.
    """
    largest = np.argsort(np.argsort(-np.abs(x), kind="stable")) < len(y)  # there are 2K equations
    support = largest & (np.abs(x) > SMALLEST_PARAMETER)
    start = np.where(support, x, 0.0)
    fitted = start.copy()
    for _ in range(STEPS):
        with_one = np.append(fitted, 1.0)
        half_gradients = forms @ with_one  # of x' Q_i x, which is symmetric
        jacobian = 2.0 * half_gradients[:, :-1][:, support] / deviations[:, None]
        fitted[support] += np.linalg.lstsq(jacobian, (y - half_gradients @ with_one) / deviations, rcond=None)[0]
        if not np.isfinite(fitted).all() or np.abs(fitted).max() > 1.0:
            return start
    return fitted


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """What the published method found for N vehicles.

    Attributes
    ----------
    faults : Faults
        Estimated faults.
    classification : Classification
        Class that each vehicle was put in; ``classification.hardware`` tells where a hardware fault is suspected.
    failed : mapping of int to str
        Vehicles, by position, whose optimisation failed, and why; they have no sensor parameters (zero).
    """

    faults: Faults
    classification: Classification
    failed: Mapping[int, str]


def recover_fleet(evidence: FleetEvidence, classification: Classification, *, full_scale_a: float) -> Recovery:
    """Recover the fault parameters of a fleet.

    Parameters
    ----------
    evidence : FleetEvidence
        Evidence of N vehicles.
    classification : Classification
        Classes of the same vehicles, which choose the case of each.
    full_scale_a : float
        Full scale of the junction; offsets are compared with drifts in fractions of it. [A]

    Returns
    -------
    Recovery
        Estimates of all vehicles; those whose optimisation failed are listed in it and do not stop the others.
    """
    N, K = evidence.slopes.shape
    y = np.hstack([evidence.slopes, evidence.intercepts_a / full_scale_a])
    variances = np.hstack([evidence.slope_variances, evidence.intercept_variances_a2 / full_scale_a**2])
    x = np.zeros((N, 3 * K))
    regressed = classification.sensor & ~classification.hardware
    x[regressed, K:] = y[regressed] - np.repeat([1.0, 0.0], K)
    failed: dict[int, str] = {}
    pursuit = BasisPursuit(K)
    for j in np.flatnonzero(classification.sensor & classification.hardware).tolist():
        try:
            sparse = pursuit.solve(y[j], epsilon=EPSILON_SHARE * float(variances[j].sum()))
            x[j] = _refit(pursuit.forms, sparse, y[j], np.maximum(np.sqrt(variances[j]), LEAST_DEVIATION))
        except BasisPursuitError as error:
            failed[j] = str(error)
    return Recovery(faults=Faults.of_parameters(x, full_scale_a), classification=classification, failed=failed)
