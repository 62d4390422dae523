"""Evidence rows of a fleet from its drive summaries, with covariances earned from the spread between blocks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.evidence.fleet_model import FleetModel, regress_on_fleet
from calibrator.evidence.junction_law import junction_law
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows, LineMeans
from calibrator.evidence.summary import DriveSummary, common_bank

__all__ = ["collect_rows"]

LEAST_GAIN = 0.3
"""Slopes and gain ratios below are no sensor's, but those of a branch that hardly moved. [1]"""
FEWEST_BLOCKS = 4
"""Of a vehicle; fewer tell no variance."""
FLEET_BLOCKS = 20.0
"""Weight of the fleet's usual correlation of rows against that of one vehicle, in blocks."""
LEAST_SD = np.array([5e-5, 1e-5])
"""Least deviation of relative and constant rows: resolution of the signals and of their interpolation. [1]"""


@dataclass(frozen=True)
class _Raw:
    """Rows of one vehicle: a (K), -g (K - 1), b (K), c (1), the latter two over full scale.

    ``means`` (2, K) are those of the fleet model's and the measured currents over full scale. ``covariance`` is of the
    ratios and of what the lines are at these means: b + a mean, and c and what the other currents make of it. At zero,
    ratios and constants are correlated by the distance of the means, and no average over vehicles would respect that.
    """

    values: Array
    means: Array
    covariance: Array
    blocks: int


def collect_rows(
    summaries: Sequence[DriveSummary], model: FleetModel, *, full_scale_a: float, learning: Mask | None = None
) -> FleetRows:
    """Evidence of every vehicle of a fleet.

    Parameters
    ----------
    summaries : sequence of DriveSummary
        One per vehicle.
    model : FleetModel
        Of the same fleet.
    full_scale_a : float
        Full scale of the junction. [A]
    learning : ndarray of bool of shape (N,) or None
        Vehicles from which the fleet's usual correlation of the rows is learnt; None: all.

    Returns
    -------
    FleetRows
        Slopes and intercepts over the fleet model, and the junction law; no bench readings.

    Raises
    ------
    DriveError
        If the summaries were made with different filter banks.
    """
    common_bank(summaries)
    raw = [_of_vehicle(summary, model, full_scale_a) for summary in summaries]
    correlations = np.stack([_correlation(vehicle.covariance) for vehicle in raw])
    usual = correlations.mean(axis=0) if learning is None else correlations[learning].mean(axis=0)
    covariance = np.stack([_steadied(vehicle, usual) for vehicle in raw])
    means = LineMeans(
        model=np.stack([vehicle.means[0] for vehicle in raw]), measured=np.stack([vehicle.means[1] for vehicle in raw])
    )
    return _rows(np.stack([vehicle.values for vehicle in raw]), means, covariance)


def _of_vehicle(summary: DriveSummary, model: FleetModel, full_scale_a: float) -> _Raw:
    K = summary.branches
    slopes, law = regress_on_fleet(summary, model.read_out), junction_law(summary)
    estimate = np.concatenate([*(fit.estimate for fit in slopes), law.estimate])
    influence = np.concatenate([*(fit.influence for fit in slopes), law.influence], axis=1)
    covariance = influence.T @ influence
    for k, fit in enumerate([*slopes, law]):
        part = slice(2 * k, 2 * k + len(fit.estimate))
        covariance[part, part] += fit.prior_covariance
    order = [*range(0, 2 * K, 2), *range(2 * K, 3 * K - 1), *range(1, 2 * K, 2), 3 * K - 1]
    unit = np.concatenate([np.ones(K), -np.ones(K - 1), np.full(K + 1, 1.0 / full_scale_a)])
    inputs = summary.total[-1, : summary.inputs] / summary.total[-1, -1]
    means = np.stack([np.append(inputs, 1.0) @ model.read_out, summary.mean_a]) / full_scale_a
    lever = np.zeros((K + 1, 2 * K - 1))
    lever[:K, :K], lever[K, K:] = np.diag(means[0]), -means[1, 1:]
    covariance = _turned(covariance[order][:, order] * np.outer(unit, unit), lever)
    if len(influence) < FEWEST_BLOCKS:
        covariance = UNKNOWN_VARIANCE * np.eye(3 * K)
    return _Raw(estimate[order] * unit, means, covariance, len(influence))


def _turned(covariance: Array, lever: Array) -> Array:
    """Covariance of ratios r and constants + lever r, from that of ratios and constants; (..., 3K, 3K)."""
    turn = np.zeros(covariance.shape)
    turn[..., :, :] = np.eye(covariance.shape[-1])
    turn[..., -lever.shape[-2] :, : lever.shape[-1]] = lever
    return np.asarray(turn @ covariance @ np.swapaxes(turn, -1, -2))


def _correlation(covariance: Array) -> Array:
    sd = np.sqrt(np.diag(covariance))
    safe = np.where(sd > 0.0, sd, np.inf)
    return np.asarray(covariance / np.outer(safe, safe))


def _steadied(vehicle: _Raw, usual: Array) -> Array:
    """Covariance whose correlations lie between the vehicle's own and the fleet's: few blocks tell few of them."""
    own = _correlation(vehicle.covariance)
    correlation = (vehicle.blocks * own + FLEET_BLOCKS * usual) / (vehicle.blocks + FLEET_BLOCKS)
    np.fill_diagonal(correlation, 1.0)
    sd = np.sqrt(np.diag(vehicle.covariance))
    return np.asarray(correlation * np.outer(sd, sd))


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
