"""Fleet model (M7): the ideal currents of identical vehicles as a function of their inputs, learnt from all of them.

    i_m,k of vehicle j at its inputs u  =  a_jk f_k(u) + b_jk + residual,     f_k(u) = w_k^T (u, 1)

The read-outs w are the fleet's, slopes a and intercepts b each vehicle's own (15) in [1]_: a factor model of rank one,
fitted by alternating least squares on second moments. Its scale and zero are those of the densest cluster (M15) of
slopes and intercepts: fault-free sensors agree with each other, faulty ones do not. Unlike in a model per vehicle,
simulated on a common unity drive (2), every vehicle is compared on its own drive, so that what its drive does not
excite need not be known.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from calibrator.drive import Array
from calibrator.estimator.moments import FleetMoments, VehicleRegressions, products, regress_vehicles

__all__ = ["Cluster", "FleetModel", "densest_clusters", "fit_fleet_model", "regress_on_fleet"]

ROUNDS = 12
"""Of alternating least squares; slopes change by less than 1e-4 after eight on all fleets tried. [1]"""
RIDGE = 1e-9
"""On the normalised moments of the inputs: an input that hardly varies gets no read-out."""
SLOPE_SD = 0.4
"""Prior deviation of a slope from 1: a branch that hardly moves counts as faultless. [1]"""
LEAST_SD = 1e-5
"""Of slopes and intercepts where a model fits exactly. [1], [A]"""
MOST_VARIATION = 100.0
"""Deviation of an input over the fleet's median deviation from which on a vehicle has another unit there. [1]"""
TINY_A2 = 1e-12
"""Of a fleet that stands still. [A^2]"""
MOST_CENTRES = 200
SPREADS = 12
SHARE_STEPS = 8
MARGIN = 0.1
"""The background reaches beyond the values by this share of their range. [1]"""
SD_OF_RANGE = 9.0
"""Range of the background over the deviation of its Gaussian half, where faults say how wide it is. [1]"""


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
        Of the N vehicles to learn from.

    Returns
    -------
    FleetModel
        With the scale and zero of the vehicles that agree.
    """
    M, K = fleet.inputs, fleet.branches
    u = [*range(M), M + K]  # columns of the inputs and the constant
    centred = fleet.mean - fleet.mean[:, :, -1:] * fleet.mean[:, -1:, :]
    variance = np.diagonal(centred, axis1=1, axis2=2)[:, :M]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # an input that varies in no vehicle has no median
        median = np.nanmedian(np.where(variance > 0.0, variance, np.nan), axis=0)
    usual = ~(variance > MOST_VARIATION**2 * median).any(axis=1)
    centred = centred[usual]
    slopes = np.ones((len(fleet), K))
    for _ in range(ROUNDS):
        # Read-outs by least squares about each vehicle's own means, as it has an intercept of its own; all vehicles
        # count alike, however long they drove. The constants stay zero.
        read_out = np.zeros((M + 1, K))
        for k, a in enumerate(slopes[usual].T):
            gram = np.einsum("n,npq->pq", a**2, centred[:, :M, :M])
            scale = np.where(np.diag(gram) > 0.0, np.sqrt(np.abs(np.diag(gram))), 1.0)
            normalised = gram / np.outer(scale, scale) + RIDGE * np.eye(M)
            read_out[:M, k] = np.linalg.solve(normalised, a @ centred[:, :M, M + k] / scale) / scale
        fits = regress_on_fleet(fleet, read_out)
        sd = [np.maximum(fit.sd, LEAST_SD) for fit in fits]
        scale, zero = (
            np.array([densest_clusters(fit.estimate[:, i], e[:, i])[0].centre for fit, e in zip(fits, sd, strict=True)])
            for i in (0, 1)
        )
        read_out = read_out * scale
        read_out[-1] += zero
        slopes = np.stack([fit.estimate[:, 0] for fit in fits], axis=1) / scale
    # Ideal currents sum to zero, whatever the inputs. The excess of an input is shared by the branches as their
    # currents' variance. The excess of the constants is the mean load that no branch measures: it is taken from the
    # source, as it does not grow with others.
    mean = fleet.mean.mean(axis=0)
    mean_a = mean[-1, u] @ read_out
    variance_a2 = np.diag(read_out.T @ mean[np.ix_(u, u)] @ read_out) - mean_a**2
    excess = read_out.sum(axis=1)
    read_out = read_out - np.outer(np.append(excess[:-1], 0.0), variance_a2 / max(variance_a2.sum(), TINY_A2))
    read_out[-1, int(np.argmax(mean_a))] -= excess[-1]
    return FleetModel(read_out=read_out)


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
    gram = np.ascontiguousarray(fleet.moments[:, u[:, None], u])
    fits = []
    for k in range(K):
        z = np.stack([read_out[:, k], np.append(np.zeros(M), 1.0)])  # modelled current and constant
        fits.append(
            regress_vehicles(
                z @ gram @ z.T,
                products(np.broadcast_to(z, (len(gram), 2, M + 1)), fleet.moments[:, u, M + k]),
                fleet.mean[:, M + k, M + k],
                fleet.blocks,
                prior_mean=np.array([1.0, 0.0]),
                prior_precision=np.array([SLOPE_SD**-2, 0.0]),
            )
        )
    return fits


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """One cluster.

    Attributes
    ----------
    centre, spread : float
        Mean and standard deviation of its members, sampling error apart.
    share : float
        Share of the values in it. [1]
    """

    centre: float
    spread: float
    share: float


def densest_clusters(
    values: Array, sd: Array, *, most: int = 1, farthest: float = np.inf, widest: float = 0.0
) -> list[Cluster]:
    """Find the most likely clusters (M15), the best first; later ones lie apart from those before.

    Values are taken as a mixture of one Gaussian cluster (centre c, spread s, each value with its own sampling error)
    and a broad background. The most likely of a grid of centres and spreads is chosen. Unlike the mean and the median
    the result does not need a symmetric fleet, nor that most vehicles are without faults.

    Parameters
    ----------
    values, sd : ndarray of shape (N,)
        Values, and standard deviations of their sampling errors, positive.
    most : int
        Number of clusters wanted.
    farthest : float
        Largest magnitude of a centre.
    widest : float
        Range of what faults can make of the values: the background is at least as wide, so that values that all agree
        are a cluster too.

    Returns
    -------
    list of Cluster
        At least one, unless no value is near enough; fewer than wanted if there are not so many.
    """
    near = values[np.abs(values) <= farthest]
    if not near.size:
        return []
    extent, narrowest = float(np.ptp(values)), float(np.median(sd))
    if extent <= narrowest:
        return [Cluster(centre=float(np.median(near)), spread=0.0, share=1.0)]
    centres = np.unique(np.quantile(near, np.linspace(0.0, 1.0, min(len(near), MOST_CENTRES)), method="nearest"))
    spreads = np.geomspace(narrowest / 4.0, max(extent / 4.0, narrowest), SPREADS)
    wide, sd_wide = max(extent * (1.0 + 2.0 * MARGIN), widest), max(values.std(), widest / SD_OF_RANGE)
    background = 0.5 * norm.pdf(values, values.mean(), sd_wide) + 0.5 / wide  # half Gaussian, half uniform
    gain, share = np.empty((2, SPREADS, len(centres)))
    for s, spread in enumerate(spreads):
        variance = sd**2 + spread**2
        density = np.exp(-0.5 * (values - centres[:, None]) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
        kappa = np.full((len(centres), 1), 0.5)  # share of the cluster, by expectation maximisation
        for _ in range(SHARE_STEPS):
            inside = kappa * density
            kappa = np.mean(inside / (inside + (1.0 - kappa) * background), axis=1, keepdims=True)
        gain[s] = np.sum(np.log(kappa * density / background + (1.0 - kappa)), axis=1)
        share[s] = kappa[:, 0]
    clusters: list[Cluster] = []
    while len(clusters) < most and np.isfinite(gain).any():
        s, c = divmod(int(np.argmax(gain)), len(centres))
        variance = sd**2 + spreads[s] ** 2
        members = np.abs(values - centres[c]) <= 3.0 * np.sqrt(variance)
        centre = float(np.average(values, weights=members / variance))
        clusters.append(Cluster(centre=centre, spread=float(spreads[s]), share=float(share[s, c])))
        gain[:, np.abs(centres - centre) <= 3.0 * (spreads[s] + narrowest)] = -np.inf
    return clusters
