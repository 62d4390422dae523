"""Fleet model: the ideal currents of identical vehicles as a function of their inputs, learnt from all of them.

    i_m,k of vehicle j at its inputs u  =  a_jk f_k(u) + b_jk + residual,     f_k(u) = w_k^T (u, 1)

The read-outs w are the fleet's, slopes a and intercepts b each vehicle's own (15) in [1]_: a factor model of rank one,
fitted by alternating least squares on second moments. Its scale and zero are those of the densest cluster of slopes and
intercepts, that is of vehicles that agree with each other. Against a model per vehicle, simulated on a common unity
drive (2), every vehicle is compared on its own drive, so that what its drive does not excite need not be known.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.block_regression import BlockRegression, regress_blocks
from calibrator.evidence.summary import DriveSummary, common_bank
from calibrator.posterior.cluster import densest_clusters

__all__ = ["FleetModel", "fit_fleet_model", "regress_on_fleet"]

ROUNDS = 12
"""Of alternating least squares; slopes change by less than 1e-4 after eight on all fleets tried. [1]"""
RIDGE = 1e-9
"""On the normalised moments of the inputs: an input that hardly varies gets no read-out."""
SLOPE_SD = 0.4
"""Prior deviation of a slope from 1: a branch that hardly moves counts as faultless. [1]"""
LEAST_SD = 1e-5
"""Of slopes and intercepts where a model fits exactly. [1], [A]"""
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


def fit_fleet_model(summaries: Sequence[DriveSummary]) -> FleetModel:
    """Learn the fleet model.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        One per vehicle, with the same inputs and branches.

    Returns
    -------
    FleetModel
        With the scale and zero of the vehicles that agree.

    Raises
    ------
    DriveError
        If the summaries were made with different filter banks.
    """
    common_bank(summaries)
    totals = [summary.total / summary.total[-1, -1] for summary in summaries]
    K = summaries[0].branches
    slopes = np.ones((len(totals), K))
    for _ in range(ROUNDS):
        read_out = _fit_read_out(totals, slopes)
        fits = [regress_on_fleet(summary, read_out) for summary in summaries]
        values = np.array([[fit.estimate for fit in branches] for branches in fits])
        sd = np.maximum([[fit.sd for fit in branches] for branches in fits], LEAST_SD)
        centre = np.array(
            [[densest_clusters(values[:, k, i], sd[:, k, i])[0].centre for i in (0, 1)] for k in range(K)]
        )
        read_out = read_out * centre[:, 0]
        read_out[-1] += centre[:, 1]
        slopes = values[:, :, 0] / centre[:, 0]
    return FleetModel(read_out=_on_junction_law(read_out, totals))


def regress_on_fleet(summary: DriveSummary, read_out: Array) -> list[BlockRegression]:
    """Slope and intercept (15) of each branch of one vehicle over the fleet model on its own drives.

    Parameters
    ----------
    summary : DriveSummary
        Of the vehicle.
    read_out : ndarray of shape (M + 1, K)
        Of the fleet model. [A]

    Returns
    -------
    list of K BlockRegression
        Of (a_k [1], b_k [A]).
    """
    M, K = summary.inputs, summary.branches
    u = [*range(M), -1]
    gram_u, total = summary.moments[:, u][:, :, u], summary.total
    found = []
    for k in range(K):
        z = np.column_stack([read_out[:, k], np.append(np.zeros(M), 1.0)])
        gram = z.T @ gram_u @ z
        right = summary.moments[:, u, M + k] @ z
        power = float(total[M + k, M + k] / total[-1, -1])
        prior = {"prior_mean": np.array([1.0, 0.0]), "prior_precision": np.array([SLOPE_SD**-2, 0.0])}
        found.append(regress_blocks(gram, right, power, **prior))
    return found


def _on_junction_law(read_out: Array, totals: Sequence[Array]) -> Array:
    """Read-outs that sum to zero: ideal currents do, whatever the inputs.

    What is left over of the inputs is shared by the branches as their currents' variance. What is left over of the
    constants is the mean load that no branch measures: it is taken from the source, as it does not grow with others.
    """
    M = len(read_out) - 1
    mean = np.mean(totals, axis=0)
    u = [*range(M), -1]
    mean_a = mean[-1, u] @ read_out
    variance_a2 = np.diag(read_out.T @ mean[np.ix_(u, u)] @ read_out) - mean_a**2
    source = int(np.argmax(mean_a))
    excess = read_out.sum(axis=1)
    projected = read_out - np.outer(np.append(excess[:-1], 0.0), variance_a2 / max(variance_a2.sum(), TINY_A2))
    projected[-1, source] -= excess[-1]
    return projected


def _fit_read_out(totals: Sequence[Array], slopes: Array) -> Array:
    """Least squares of the read-outs about each vehicle's own means, all vehicles alike however long they drove.

    As every vehicle has an intercept of its own, its means say nothing of the read-outs; the constants stay zero.
    """
    K = slopes.shape[1]
    M = len(totals[0]) - 1 - K
    centred = np.stack([total - np.outer(total[:, -1], total[-1]) for total in totals])
    read_out = np.zeros((M + 1, K))
    for k in range(K):
        gram = np.einsum("n,npq->pq", slopes[:, k] ** 2, centred[:, :M, :M])
        right = slopes[:, k] @ centred[:, :M, M + k]
        scale = np.where(np.diag(gram) > 0.0, np.sqrt(np.abs(np.diag(gram))), 1.0)
        normalised = gram / np.outer(scale, scale) + RIDGE * np.eye(M)
        read_out[:M, k] = np.linalg.solve(normalised, right / scale) / scale
    return read_out
