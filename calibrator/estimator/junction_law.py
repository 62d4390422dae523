"""Junction law (M8) on a vehicle's own measured currents: gain ratios and one constant, without any model.

sum_k (i_m,k - o_k) / (1 + d_k) = l holds at every instant, so the first measured current is

    i_m,1 = sum_k>1 g_k i_m,k + c,    g_k = -(1 + d_1) / (1 + d_k),    c = (1 + d_1) (sum_k o_k / (1 + d_k) + l).

Least squares would draw the g of a small branch towards zero, as its measured current holds noise (errors in
variables); the noise is therefore taken out of the second moments first. How much noise there is, is bounded by the
fast changes of each current; and all sensors' noise together by what the junction law leaves unexplained, which they
share equally as far as the first bound allows.
"""

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.estimator.moments import FleetMoments, VehicleRegressions, products, regress_vehicles

__all__ = ["junction_law"]

GAIN_SD = 0.4
"""Prior deviation of a gain ratio from -1: no running sensor is farther off. [1]"""
NOISE_ROUNDS = 3
"""The bound on the noise depends on the gains, and they on it; three rounds settle it. [1]"""
MOST_NOISE = 0.9
"""Largest share of a current's variance that is taken for noise. [1]"""
LEAST_WEIGHT = 0.1
"""Of a branch in the junction sum, where its share of the residual is bounded. [1]"""


def junction_law(fleet: FleetMoments) -> VehicleRegressions:
    """Regress the first measured current on the others.

    Parameters
    ----------
    fleet : FleetMoments
        Of N vehicles; the first branch should be the one that moves most.

    Returns
    -------
    VehicleRegressions
        Of (g_2 .. g_K [1], c [A]).
    """
    M, K, N = fleet.inputs, fleet.branches, len(fleet)
    z = np.array([*range(M + 1, M + K), M + K])
    gram, right = fleet.moments[:, z[:, None], z], fleet.moments[:, z, M]
    samples, currents = fleet.moments[:, -1, -1], fleet.mean[:, M:, M:]
    bound_a2 = fleet.blocks.total(fleet.noise_a2) / fleet.blocks.count[:, None]
    bound_a2 = np.minimum(bound_a2, MOST_NOISE * fleet.variance_a2)
    noise_a2, others = np.zeros_like(bound_a2), range(K - 1)
    for _ in range(NOISE_ROUNDS):
        clean = gram.copy()
        clean[:, others, others] -= samples[:, None] * noise_a2[fleet.blocks.vehicle, 1:]
        fit = regress_vehicles(
            clean,
            right,
            currents[:, 0, 0],
            fleet.blocks,
            prior_mean=np.append(-np.ones(K - 1), 0.0),
            prior_precision=np.append(np.full(K - 1, GAIN_SD**-2), 0.0),
        )
        sums = np.concatenate([np.ones((N, 1)), -fit.estimate], axis=1)  # i_m,1 - sum g_k i_m,k - c, as weights
        residual_a2 = np.maximum(np.sum(sums * products(currents, sums), axis=1), 0.0)
        noise_a2 = _shared_noise_a2(residual_a2, bound_a2, np.maximum(sums[:, :K] ** 2, LEAST_WEIGHT))
    return fit


def _shared_noise_a2(residual_a2: Array, bound_a2: Array, weight: Array) -> Array:
    """Noise of each current (N, K), equal up to its bound, whose weighted sum is the residual (N,) at most. [A^2]"""
    order = np.argsort(bound_a2, axis=1, kind="stable")
    bound, weight = np.take_along_axis(bound_a2, order, axis=1), np.take_along_axis(weight, order, axis=1)
    # level: noise of the currents from here on, if all before are at their bounds (water filling)
    below = np.cumsum(weight * bound, axis=1) - weight * bound
    level = (residual_a2[:, None] - below) / np.cumsum(weight[:, ::-1], axis=1)[:, ::-1]
    reached: Mask = np.less_equal(level, bound)
    first = np.take_along_axis(level, np.argmax(reached, axis=1)[:, None], axis=1)
    return np.asarray(np.where(reached.any(axis=1, keepdims=True), np.minimum(bound_a2, first), bound_a2))
