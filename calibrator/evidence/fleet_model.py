"""Fleet model: the ideal currents of identical vehicles as a function of their inputs, learnt from all of them.

    i_m,k of vehicle j at its inputs u  =  a_jk f_k(u) + b_jk + residual,     f_k(u) = w_k^T (u, 1)

The read-outs w are the fleet's, slopes a and intercepts b each vehicle's own (15) in [1]_: a factor model of rank one,
fitted by alternating least squares on second moments. Its scale and zero are those of the densest cluster of slopes and
intercepts, that is of vehicles that agree with each other. Against a model per vehicle, simulated on a common unity
drive (2), every vehicle is compared on its own drive, so that what its drive does not excite need not be known.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import warnings
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.evidence.block_regression import VehicleRegressions, products, regress_vehicles
from calibrator.evidence.cluster import densest_clusters
from calibrator.evidence.fleet_moments import FleetMoments

__all__ = ["FleetModel", "fit_fleet_model", "regress_on_fleet"]

ROUNDS = 12
"""Of alternating least squares; slopes change by less than 1e-4 after eight on all fleets tried. [1]"""
RIDGE = 1e-9
"""On the normalised moments of the inputs: an input that hardly varies gets no read-out."""
SLOPE_SD = 0.4
"""Prior deviation of a slope from 1: a branch that hardly moves counts as faultless. [1]"""
LEAST_SD = 1e-5
"""Of slopes and intercepts where a model fits exactly. [1], [A]"""
MOST_VARIATION = 100.0
"""Deviation of an input over the fleet's median deviation from which on a vehicle does not tell the read-outs. [1]"""
TINY_A2 = 1e-12
"""Of a fleet that stands still. [A^2]"""


@dataclass(frozen=True, kw_only=True)
class FleetModel:
    """Read-outs of the fleet.

    Attributes
    ----------
    read_out : ndarray of shape (M + 1, K)
        Ideal currents per unit of each input, and the constant; each row sums to zero. [A]
    """

    read_out: Array


def fit_fleet_model(fleet: FleetMoments) -> FleetModel:
    """Learn the fleet model.

    Parameters
    ----------
    fleet : FleetMoments
        Of the vehicles to learn from.

    Returns
    -------
    FleetModel
        With the scale and zero of the vehicles that agree.
    """
    K = fleet.branches
    slopes = np.ones((len(fleet), K))
    for _ in range(ROUNDS):
        read_out = _fit_read_out(fleet.mean, slopes)
        fits = regress_on_fleet(fleet, read_out)
        values = np.stack([fit.estimate for fit in fits], axis=1)
        sd = np.maximum(np.stack([fit.sd for fit in fits], axis=1), LEAST_SD)
        centre = np.array(
            [[densest_clusters(values[:, k, i], sd[:, k, i])[0].centre for i in (0, 1)] for k in range(K)]
        )
        read_out = read_out * centre[:, 0]
        read_out[-1] += centre[:, 1]
        slopes = values[:, :, 0] / centre[:, 0]
    return FleetModel(read_out=_on_junction_law(read_out, fleet.mean))


def regress_on_fleet(fleet: FleetMoments, read_out: Array) -> list[VehicleRegressions]:
    """Slope and intercept (15) of each branch of each vehicle over the fleet model on its own drives.

    Parameters
    ----------
    fleet : FleetMoments
        Of N vehicles.
    read_out : ndarray of shape (M + 1, K)
        Of the fleet model. [A]

    Returns
    -------
    list of K VehicleRegressions
        Of (a_k [1], b_k [A]).
    """
    M, K = fleet.inputs, fleet.branches
    u = np.array([*range(M), M + K])
    gram_u = np.ascontiguousarray(fleet.moments[:, u[:, None], u])
    turn = np.zeros((len(gram_u), 2, M + 1))
    found = []
    for k in range(K):
        z = np.column_stack([read_out[:, k], np.append(np.zeros(M), 1.0)])
        turn[:] = z.T
        found.append(
            regress_vehicles(
                z.T @ gram_u @ z,
                products(turn, fleet.moments[:, u, M + k]),
                fleet.mean[:, M + k, M + k],
                fleet.blocks,
                prior_mean=np.array([1.0, 0.0]),
                prior_precision=np.array([SLOPE_SD**-2, 0.0]),
            )
        )
    return found


def _on_junction_law(read_out: Array, means: Array) -> Array:
    """Read-outs that sum to zero: ideal currents do, whatever the inputs.

    What is left over of the inputs is shared by the branches as their currents' variance. What is left over of the
    constants is the mean load that no branch measures: it is taken from the source, as it does not grow with others.
    """
    M = len(read_out) - 1
    mean = means.mean(axis=0)
    u = [*range(M), -1]
    mean_a = mean[-1, u] @ read_out
    variance_a2 = np.diag(read_out.T @ mean[np.ix_(u, u)] @ read_out) - mean_a**2
    source = int(np.argmax(mean_a))
    excess = read_out.sum(axis=1)
    projected = read_out - np.outer(np.append(excess[:-1], 0.0), variance_a2 / max(variance_a2.sum(), TINY_A2))
    projected[-1, source] -= excess[-1]
    return projected


def _fit_read_out(means: Array, slopes: Array) -> Array:
    """Least squares of the read-outs about each vehicle's own means, all vehicles alike however long they drove.

    As every vehicle has an intercept of its own, its means say nothing of the read-outs; the constants stay zero.
    """
    K = slopes.shape[1]
    M = means.shape[1] - 1 - K
    centred = means - means[:, :, -1:] * means[:, -1:, :]
    centred = centred[usual := _usual_inputs(np.diagonal(centred, axis1=1, axis2=2)[:, :M])]
    slopes = slopes[usual]
    read_out = np.zeros((M + 1, K))
    for k in range(K):
        gram = np.einsum("n,npq->pq", slopes[:, k] ** 2, centred[:, :M, :M])
        right = slopes[:, k] @ centred[:, :M, M + k]
        scale = np.where(np.diag(gram) > 0.0, np.sqrt(np.abs(np.diag(gram))), 1.0)
        normalised = gram / np.outer(scale, scale) + RIDGE * np.eye(M)
        read_out[:M, k] = np.linalg.solve(normalised, right / scale) / scale
    return read_out


def _usual_inputs(variance: Array) -> Mask:
    """Vehicles none of whose inputs (N, M) varies far more than in the rest of the fleet: it has another unit there."""
    varying = np.where(variance > 0.0, variance, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # an input that varies in no vehicle has no median
        usual = np.nanmedian(varying, axis=0)
    return np.asarray(~(variance > MOST_VARIATION**2 * usual).any(axis=1))
