"""Junction law on a vehicle's own measured currents: gain ratios and one constant, without any model.

sum_k (i_m,k - o_k) / (1 + d_k) = l holds at every instant, so the first measured current is

    i_m,1 = sum_k>1 g_k i_m,k + c,    g_k = -(1 + d_1) / (1 + d_k),    c = (1 + d_1) (sum_k o_k / (1 + d_k) + l).

Least squares would draw the g of a small branch towards zero, as its measured current holds noise (errors in
variables); the noise is therefore taken out of the second moments first. How much noise there is, is bounded by the
fast changes of each current; and all sensors' noise together by what the junction law leaves unexplained, which they
share equally as far as the first bound allows.
"""

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.block_regression import BlockRegression, regress_blocks
from calibrator.evidence.summary import DriveSummary

__all__ = ["junction_law"]

GAIN_SD = 0.4
"""Prior deviation of a gain ratio from -1: no running sensor is farther off. [1]"""
NOISE_ROUNDS = 3
"""The bound on the noise depends on the gains, and they on it; three rounds settle it. [1]"""
MOST_NOISE = 0.9
"""Largest share of a current's variance that is taken for noise. [1]"""
LEAST_WEIGHT = 0.1
"""Of a branch in the junction sum, where its share of the residual is bounded. [1]"""


def junction_law(summary: DriveSummary) -> BlockRegression:
    """Regress the first measured current on the others.

    Parameters
    ----------
    summary : DriveSummary
        Of one vehicle; its first branch should be the one that moves most.

    Returns
    -------
    BlockRegression
        Of (g_2 .. g_K [1], c [A]).
    """
    M, K = summary.inputs, summary.branches
    z = [*range(M + 1, M + K), -1]
    gram, right = summary.moments[:, z][:, :, z], summary.moments[:, z, M]
    samples, total = summary.moments[:, -1, -1], summary.total
    prior_mean = np.append(-np.ones(K - 1), 0.0)
    prior_precision = np.append(np.full(K - 1, GAIN_SD**-2), 0.0)
    bound = np.minimum(summary.noise_a2.mean(axis=0), MOST_NOISE * summary.variance_a2)
    noise: Array = np.zeros(K)
    for _ in range(NOISE_ROUNDS):
        clean = gram - samples[:, None, None] * np.diag(np.append(noise[1:], 0.0))
        power = float(total[M, M] / total[-1, -1])
        fit = regress_blocks(clean, right, power, prior_mean=prior_mean, prior_precision=prior_precision)
        noise = _shared(_residual_a2(total, M, K, fit.estimate), bound, _weights(fit.estimate))
    return fit


def _shared(residual_a2: float, bound_a2: Array, weights: Array) -> Array:
    """Noise of each current, equal up to its bound, that adds up to the residual at most. [A^2]"""
    order = np.argsort(bound_a2, kind="stable")
    bound, weight = bound_a2[order], weights[order]
    below = np.concatenate([[0.0], np.cumsum(weight * bound)[:-1]])
    level = (residual_a2 - below) / np.cumsum(weight[::-1])[::-1]
    reached = np.flatnonzero(level <= bound)
    return np.minimum(bound_a2, level[reached[0]]) if reached.size else bound_a2


def _weights(estimate: Array) -> Array:
    """Squares of the weights of each branch in the junction sum, first branch 1."""
    return np.asarray(np.maximum(np.append(1.0, estimate[:-1]) ** 2, LEAST_WEIGHT))


def _residual_a2(total: Array, first: int, branches: int, estimate: Array) -> float:
    """Mean square of what the junction law leaves of the first current. [A^2]"""
    columns = [*range(first, first + branches), -1]
    weights = np.concatenate([[1.0], -estimate])
    return max(float(weights @ total[np.ix_(columns, columns)] @ weights / total[-1, -1]), 0.0)
