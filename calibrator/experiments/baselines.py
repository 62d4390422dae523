"""Baselines: what an engineer tries in an afternoon, beside the published method and the default.

Best subset and LASSO [1]_ work on the evidence rows of the default, the regression on the fleet's median on its slopes
and intercepts, total least squares [2]_ and reconciliation [3]_ on the moments of each vehicle's measured currents
alone. Whatever they find is corrected.

.. [1] H. Zou, T. Hastie, R. Tibshirani, "On the degrees of freedom of the lasso", Ann. Statist. 35 (2007).
.. [2] S. Van Huffel, J. Vandewalle, "The Total Least Squares Problem", SIAM 1991.
.. [3] VDI 2048 part 1, "Control and quality improvement of process data and their uncertainties", 2017.
"""

import itertools
import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LassoLarsIC

from calibrator.drive import Array, Mask
from calibrator.estimator.evidence import (
    EvidenceRows,
    ParameterPlaces,
    collect_rows,
    densest_clusters,
    fit_fleet_model,
    row_design,
    stack_summaries,
)
from calibrator.estimator.posterior import evidence_of, row_residuals
from calibrator.experiments.trial import CommonEvidence, Trial
from calibrator.faults import Faults

__all__ = ["SOLVERS"]

PENALTY = float(np.log(10_000.0))
"""Price of a parameter in the Bayesian information criterion: log of the samples of a quarter of an hour at 10 Hz."""
WIDER = 3.0
"""Factor on the variance of the rows and of their densest cluster: the best subset recovers most with it. [1]"""
ROUNDS = 4
"""Rounds of least squares: the constant rows depend on the gains of the sensors, so both are solved in turn. [1]"""
BEYOND = 3.0
"""A slope or an intercept is faulty if it is this many robust standard deviations from the median. [1]"""
ACCURACY = 0.01
"""Standard deviation that the class of a current sensor promises, in fractions of full scale. [1]"""
LEAST_WEIGHT = 0.2
"""Weight of a branch in the junction law below which total least squares says nothing of its gain. [1]"""


def best_subset(trial: Trial) -> Faults:
    """Return for each vehicle the faults of the support with the least Bayesian information criterion.

    All supports are tried but the one with all parameters.
    """
    linear = _LeastSquares(trial)
    P = linear.design.shape[1]
    supports = np.array([bits for bits in itertools.product((False, True), repeat=P) if sum(bits) < P], bool)
    fits = [linear.fit(support) for support in supports]
    price = np.stack([chi2 + PENALTY * support.sum() for (_, chi2), support in zip(fits, supports, strict=True)])
    return linear.faults(np.array([fits[number][0][j] for j, number in enumerate(np.argmin(price, axis=0))]))


def lasso(trial: Trial) -> Faults:
    """Return the faults of that support on the LASSO path whose Bayesian information criterion is least.

    Their values are those of least squares in this support, not shrunk.
    """
    linear = _LeastSquares(trial)
    y = linear.whitened(np.zeros((len(linear.whiten), linear.design.shape[1])))
    support = np.zeros(y.shape, bool)
    for j, design in enumerate(linear.whiten @ linear.design):
        path = LassoLarsIC(criterion="bic", fit_intercept=False, noise_variance=1.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a common factor of gains is open
            support[j] = path.fit(design, y[j]).coef_ != 0.0
    return linear.faults(linear.fit(support)[0])


def fleet_median(trial: Trial) -> Faults:
    """Return as sensor faults the slopes and intercepts that are far from the fleet's median, less that median.

    Far is more than :data:`BEYOND` robust standard deviations. Slopes and intercepts are those of equation (15) of the
    paper, here over the fleet model.
    """
    rows, order = _evidence_rows(trial)

    def apart(values: Array) -> Array:
        deviation = values - np.median(values, axis=0)
        known = np.abs(deviation) > BEYOND * median_abs_deviation(values, scale="normal")
        return np.where(known, deviation, 0.0)[:, np.argsort(order)]

    drift, offset = apart(np.exp(rows.values[:, rows.places.slopes])), apart(rows.values[:, rows.places.intercepts])
    return _sensors_alone(drift, offset * trial.full_scale_a)


def total_least_squares(trial: Trial) -> Faults:
    """Return sensor faults from the weighted sum of the currents that varies least.

    Its weights, scaled to median 1, are taken as 1 / (1 + d); offsets are the smallest that make its mean 0.
    """
    mean_a, covariance_a2 = _measured_moments(trial)
    w = np.linalg.eigh(covariance_a2)[1][:, :, 0]
    w = w / np.median(w, axis=1, keepdims=True)
    w = np.where(w > LEAST_WEIGHT, w, 1.0)
    # sum_k w_k (mean_k - o_k) = 0 leaves the offsets open: take the smallest ones
    offset_a = w * (np.sum(w * mean_a, axis=1) / np.sum(w**2, axis=1))[:, None]
    return _sensors_alone(1.0 / w - 1.0, offset_a)


def reconciliation(trial: Trial) -> Faults:
    """Return as sensor faults the lines of measured over reconciled currents, which are the nearest that sum to zero.

    All sensors count as equally accurate; a sum that their :data:`ACCURACY` explains gives no faults.
    """
    mean_a, covariance_a2 = _measured_moments(trial)
    K = mean_a.shape[1]
    project = np.eye(K) - 1.0 / K
    variance_a2 = np.maximum(np.einsum("ik,nkl,il->ni", project, covariance_a2, project), 1e-12)
    slope = np.einsum("ik,nki->ni", project, covariance_a2) / variance_a2
    offset_a = mean_a - slope * (mean_a @ project)
    # the global test: a sum within what the sensors promise asks for no correction
    sum_a2 = covariance_a2.sum(axis=(1, 2)) + mean_a.sum(axis=1) ** 2
    wrong = sum_a2 > K * (ACCURACY * trial.full_scale_a) ** 2
    return _sensors_alone((slope - 1.0) * wrong[:, None], offset_a * wrong[:, None])


SOLVERS = {
    "best subset": best_subset,
    "LASSO": lasso,
    "fleet median": fleet_median,
    "total least squares": total_least_squares,
    "VDI 2048": reconciliation,
}
"""Baselines by name; each function returns the faults that it finds in the vehicles of a trial."""


def _sensors_alone(drift: Array, offset_a: Array) -> Faults:
    """Return faults of the sensors alone, without hardware faults."""
    nothing = np.zeros_like(drift)
    return Faults(hardware_drift=nothing[:, 0], hardware_offset_a=nothing, drift=drift, offset_a=offset_a)


def _measured_moments(trial: Trial) -> tuple[Array, Array]:
    """Return mean (N, K) [A] and covariance (N, K, K) [A^2] of each vehicle's measured currents."""
    if isinstance(trial.recorded, CommonEvidence):
        return trial.recorded.mean_a, trial.recorded.covariance_a2
    mean_a = np.stack([summary.mean_a for summary in trial.recorded])
    product_a2 = np.stack([summary.mean_product_a2 for summary in trial.recorded])
    return mean_a, product_a2 - mean_a[:, :, None] * mean_a[:, None, :]


def _evidence_rows(trial: Trial) -> tuple[EvidenceRows, NDArray[np.int64]]:
    """Return the evidence rows, and order (K,): branch k of the rows is branch order[k] of the vehicles."""
    if isinstance(trial.recorded, CommonEvidence):
        return trial.recorded.rows, np.arange(trial.recorded.rows.branches)
    order = np.argsort(-np.median(stack_summaries(trial.recorded).variance_a2, axis=0), kind="stable")
    fleet = stack_summaries(trial.recorded, order.tolist())
    rows, _ = collect_rows(fleet, fit_fleet_model(fleet), full_scale_a=trial.full_scale_a)
    return rows, order


class _LeastSquares:
    """Measured evidence rows as a linear model: 3K rows over the 3K parameters without a load, see docs/method.md.

    The densest cluster of each row over the fleet says what vehicles without faults show, and how much they differ.
    """

    def __init__(self, trial: Trial) -> None:
        rows, self.order = _evidence_rows(trial)
        self.full_scale_a = trial.full_scale_a
        K, self.measured = rows.branches, rows.places.measured
        self.design = row_design(K, feed=0)[self.measured, : ParameterPlaces(K).load]
        covariance = rows.covariance[:, self.measured[:, None], self.measured]
        sd = np.sqrt(np.einsum("nii->ni", covariance))
        clusters = [densest_clusters(rows.values[:, row], sd[:, i])[0] for i, row in enumerate(self.measured)]
        centre = np.zeros(5 * K)
        centre[self.measured] = [cluster.centre for cluster in clusters]
        self.evidence = evidence_of(
            rows.values, rows.covariance, rows.means, centre=centre, shared=np.zeros(2 * K + 1), feed=0
        )
        self.whiten = np.linalg.inv(
            np.linalg.cholesky(WIDER * (covariance + np.diag([cluster.spread**2 for cluster in clusters])))
        )

    def fit(self, support: Mask) -> tuple[Array, Array]:
        """Fit the parameters in a support (3K,) or (N, 3K); return them (N, 3K), exactly 0 elsewhere, and chi2 (N,)."""
        design = (self.whiten @ self.design) * np.atleast_2d(support)[:, None, :]
        solve, theta = np.linalg.pinv(design, rcond=1e-9), np.zeros(design.shape[::2])
        for _ in range(ROUNDS):
            theta = np.clip(np.einsum("npi,ni->np", solve, self.whitened(theta)), -2.0, 2.0) * support
        return theta, np.sum((self.whitened(theta) - np.einsum("nip,np->ni", design, theta)) ** 2, axis=1)

    def whitened(self, theta: Array) -> Array:
        """Return whitened rows minus their centre (N, 3K); their constants depend on the gains in theta (N, 3K)."""
        without_load = np.pad(theta, ((0, 0), (0, 1)))
        left = row_residuals(self.evidence, without_load[:, None])[:, 0, self.measured]
        return np.asarray(np.einsum("nij,nj->ni", self.whiten, left + theta @ self.design.T))

    def faults(self, theta: Array) -> Faults:
        """Return the faults of parameters (N, 3K), branches in the vehicles' own order."""
        at, own = ParameterPlaces(len(self.order)), np.argsort(self.order)
        gain, hardware = np.exp(theta[:, at.gains]), theta[:, at.hardware_offsets]
        hardware = np.column_stack([hardware, -hardware.sum(axis=1)])
        return Faults(
            hardware_drift=np.expm1(theta[:, at.eta]),
            hardware_offset_a=hardware[:, own] * self.full_scale_a,
            drift=gain[:, own] - 1.0,
            offset_a=(theta[:, at.offsets] * gain)[:, own] * self.full_scale_a,
        )
