"""Evidence rows of a fleet from its drive summaries, with covariances earned from the spread between blocks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array
from calibrator.evidence.block_regression import products
from calibrator.evidence.fleet_model import FleetModel, regress_on_fleet
from calibrator.evidence.fleet_moments import FleetMoments
from calibrator.evidence.junction_law import junction_law
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows, LineMeans

__all__ = ["RawRows", "collect_rows"]

LEAST_GAIN = 0.3
"""Slopes and gain ratios below are no sensor's, but those of a branch that hardly moved. [1]"""
FEWEST_BLOCKS = 4
"""Of a vehicle; fewer tell no variance."""
FLEET_BLOCKS = 20.0
"""Weight of the fleet's usual correlation of rows against that of one vehicle, in blocks."""
LEAST_SD = np.array([5e-5, 1e-5])
"""Least deviation of relative and constant rows: resolution of the signals and of their interpolation. [1]"""


@dataclass(frozen=True, kw_only=True)
class RawRows:
    """Rows of N vehicles as their own blocks tell them.

    Attributes
    ----------
    values : ndarray of shape (N, 3K)
        a (K), -g (K - 1), b (K), c (1), the latter two in fractions of full scale. [1]
    means : LineMeans
        Of the fleet model's and of the measured currents.
    covariance : ndarray of shape (N, 3K, 3K)
        Of the ratios and of what the lines are at these means: b + a mean, and c and what the other currents make of
        it. At zero, ratios and constants are correlated by the distance of the means, and no average over vehicles
        would respect that. [1]
    blocks : ndarray of int of shape (N,)
        Number of blocks.
    """

    values: Array
    means: LineMeans
    covariance: Array
    blocks: NDArray[np.int64]

    def usual_correlation(self) -> Array:
        """Mean correlation of the rows over the vehicles, shape (3K, 3K). [1]"""
        return np.asarray(_correlations(self.covariance).mean(axis=0))

    def steadied(self, usual: Array) -> FleetRows:
        """Rows whose correlations lie between each vehicle's own and the fleet's: few blocks tell few of them.

        Parameters
        ----------
        usual : ndarray of shape (3K, 3K)
            Correlation of the rows that is usual in the fleet. [1]

        Returns
        -------
        FleetRows
            Without bench readings.
        """
        blocks = self.blocks[:, None, None]
        correlation = (blocks * _correlations(self.covariance) + FLEET_BLOCKS * usual) / (blocks + FLEET_BLOCKS)
        own = range(len(usual))
        correlation[:, own, own] = 1.0
        sd = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        return _rows(self.values, self.means, correlation * sd[:, :, None] * sd[:, None, :])


def collect_rows(fleet: FleetMoments, model: FleetModel, *, full_scale_a: float) -> RawRows:
    """Evidence of every vehicle of a fleet.

    Parameters
    ----------
    fleet : FleetMoments
        Of N vehicles.
    model : FleetModel
        Of the same fleet.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    RawRows
        Slopes and intercepts over the fleet model, and the junction law.
    """
    M, K, N = fleet.inputs, fleet.branches, len(fleet)
    fits = [*regress_on_fleet(fleet, model.read_out), junction_law(fleet)]
    influence = np.concatenate([fit.influence for fit in fits], axis=1)
    covariance = fleet.blocks.total(influence[:, :, None] * influence[:, None, :])
    for k, fit in enumerate(fits):
        part = slice(2 * k, 2 * k + fit.estimate.shape[1])
        covariance[:, part, part] += fit.prior_covariance
    order = np.array([*range(0, 2 * K, 2), *range(2 * K, 3 * K - 1), *range(1, 2 * K, 2), 3 * K - 1])
    unit = np.concatenate([np.ones(K), -np.ones(K - 1), np.full(K + 1, 1.0 / full_scale_a)])
    inputs = fleet.mean[:, -1, [*range(M), -1]]
    ideal_a = products(np.broadcast_to(model.read_out.T, (N, K, M + 1)), inputs)
    means = LineMeans(model=ideal_a / full_scale_a, measured=fleet.mean_a / full_scale_a)
    lever = np.zeros((N, K + 1, 2 * K - 1))
    lever[:, range(K), range(K)] = means.model
    lever[:, K, K:] = -means.measured[:, 1:]
    covariance = _turned(covariance[:, order[:, None], order] * np.outer(unit, unit), lever)
    covariance[fleet.blocks.count < FEWEST_BLOCKS] = UNKNOWN_VARIANCE * np.eye(3 * K)
    estimate = np.concatenate([fit.estimate for fit in fits], axis=1)
    return RawRows(values=estimate[:, order] * unit, means=means, covariance=covariance, blocks=fleet.blocks.count)


def _turned(covariance: Array, lever: Array) -> Array:
    """Covariance of ratios r and constants + lever r, from that of ratios and constants; (..., 3K, 3K)."""
    turn = np.zeros(covariance.shape)
    turn[..., :, :] = np.eye(covariance.shape[-1])
    turn[..., -lever.shape[-2] :, : lever.shape[-1]] = lever
    return np.asarray(turn @ covariance @ np.swapaxes(turn, -1, -2))


def _correlations(covariance: Array) -> Array:
    """Correlations of shape (N, p, p); zero where there is no variance."""
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    safe = np.where(sd > 0.0, sd, np.inf)
    return np.asarray(covariance / (safe[:, :, None] * safe[:, None, :]))


def _rows(values: Array, means: LineMeans, covariance: Array) -> FleetRows:
    """Logarithms of the ratios, constants as seen in true currents, and rows without bench readings.

    A ratio that says nothing becomes 1, and the constants turn with it.
    """
    N, K = len(values), values.shape[1] // 3
    ratios, constants = values[:, : 2 * K - 1], values[:, 2 * K - 1 :].copy()
    told = ratios > LEAST_GAIN
    safe = np.where(told, ratios, 1.0)
    constants[:, :K] += (ratios - safe)[:, :K] * means.model
    constants[:, K] -= np.sum((ratios - safe)[:, K:] * means.measured[:, 1:], axis=1)
    derivative = np.concatenate([1.0 / safe, 1.0 / safe[:, :K], 1.0 / safe[:, :1]], axis=1)
    covariance = covariance * derivative[:, :, None] * derivative[:, None, :]
    covariance += np.diag(np.repeat(LEAST_SD, [2 * K - 1, K + 1]) ** 2)
    vehicle, row = np.nonzero(~told)
    covariance[vehicle, row, :], covariance[vehicle, :, row] = 0.0, 0.0
    covariance[vehicle, row, row] = UNKNOWN_VARIANCE
    none = np.zeros((N, K))
    relative = np.concatenate([np.log(safe), none], axis=1)
    full = np.zeros((N, 5 * K, 5 * K))
    place = np.array([*range(2 * K - 1), *range(3 * K - 1, 4 * K)])
    full[:, place[:, None], place] = _turned(covariance, means.lever(relative))
    for readings in (range(2 * K - 1, 3 * K - 1), range(4 * K, 5 * K)):
        full[:, readings, readings] = UNKNOWN_VARIANCE
    return FleetRows(
        relative=relative, constant=np.concatenate([constants, none], axis=1), covariance=full, means=means
    )
