"""Where the climb to the model spread starts: clusters of the evidence, or trusted vehicles."""

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.evidence.cluster import densest_clusters
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows
from calibrator.posterior.fault_prior import ModelSpread
from calibrator.posterior.spread_rows import (
    GUESSED_OUTLIER_SHARE,
    free_centres,
    guessed_spread,
    informed_rows,
    least_spread,
    told_rows,
)
from calibrator.posterior.unmeasured_load import LAWFUL, LAWFUL_CONSTANT, LAWFUL_GAIN, unmeasured_load

__all__ = ["FEWEST_TRUSTED", "initial_spreads", "trusted_spread", "uncarried_centres"]

FIRST_DISPERSION = 4.0
"""Where the climb starts: it falls fast. [1]"""
MOST_SPREAD = 0.02
"""Of a start; wider clusters are made of faults. [1]"""
FEWEST_TRUSTED = 3
"""Trusted vehicles that carry the reference of a branch that they tell."""
FEWEST_LAWFUL = 3
"""Vehicles that make a cluster."""


def initial_spreads(rows: FleetRows) -> list[ModelSpread]:
    """Starts of the climb: clusters of each row, of all vehicles and of those that obey the junction law, and the mean.

    Parameters
    ----------
    rows : FleetRows
        Evidence of the fleet.

    Returns
    -------
    list of ModelSpread
        Six starts.
    """
    K, r = rows.branches, rows.relative.shape[1]
    mean, second, spread = _clusters(rows, np.ones(len(rows), bool))
    lawful = _lawful(rows, mean[4 * K - 1])
    lawful_mean, lawful_second, _ = _clusters(rows, lawful) if lawful.sum() >= FEWEST_LAWFUL else (mean, second, spread)
    average = mean.copy()
    average[:K], average[r : r + K] = rows.relative[:, :K].mean(axis=0), rows.constant[:, :K].mean(axis=0)
    narrow = guessed_spread(rows) + np.diag(least_spread(K) ** 2)
    wide = np.maximum(narrow, np.diag(np.minimum(spread, MOST_SPREAD) ** 2))
    starts = [(mean, wide), *((centre, narrow) for centre in (mean, lawful_mean, lawful_second, second, average))]
    return [
        ModelSpread(
            mean=centre,
            covariance=covariance,
            outlier_share=GUESSED_OUTLIER_SHARE,
            dispersion=FIRST_DISPERSION,
        )
        for centre, covariance in starts
    ]


def _clusters(rows: FleetRows, chosen: Mask) -> tuple[Array, Array, Array]:
    """Densest and second densest centre of each row, and spread of the densest, among some vehicles; shape (5K,)."""
    K = rows.branches
    values = np.concatenate([rows.relative, rows.constant], axis=1)
    sd = np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2))
    mean, second, spread = np.zeros(5 * K), np.zeros(5 * K), np.zeros(5 * K)
    for row in informed_rows(K):
        told = chosen & (sd[:, row] < np.sqrt(UNKNOWN_VARIANCE) / 2.0)
        if row == 4 * K - 1:
            load = unmeasured_load(values[told, row], sd[told, row])
            mean[row], second[row], spread[row] = load.centre, load.centre, load.spread
            continue
        if not told.any():
            continue
        clusters = densest_clusters(values[told, row], sd[told, row], most=2)
        mean[row], spread[row] = clusters[0].centre, clusters[0].spread
        second[row] = clusters[1].centre if len(clusters) > 1 and row < K else mean[row]
    ratios = slice(K, 2 * K - 1)
    mean[ratios], second[ratios] = 0.0, 0.0
    return mean, second, spread


def _lawful(rows: FleetRows, constant: float) -> Mask:
    """Vehicles whose measured currents obey the junction law: their sensors are hardly faulty, whatever they carry."""
    K = rows.branches
    sd = np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2))
    ratios = np.abs(rows.relative[:, K : 2 * K - 1]) < LAWFUL * np.maximum(sd[:, K : 2 * K - 1], LAWFUL_GAIN)
    usual = np.abs(rows.constant[:, K] - constant) < LAWFUL * np.maximum(sd[:, 4 * K - 1], LAWFUL_CONSTANT)
    return np.asarray(ratios.all(axis=1) & usual)


def trusted_spread(rows: FleetRows, trusted: Mask) -> ModelSpread:
    """Start of the climb whose centre is that of trusted vehicles.

    Parameters
    ----------
    rows : FleetRows
        Evidence of the fleet.
    trusted : ndarray of bool of shape (N,)
        Vehicles without sensor faults.

    Returns
    -------
    ModelSpread
        Centres of slopes, intercepts and junction constant are the trusted vehicles'.
    """
    values, told = np.concatenate([rows.relative, rows.constant], axis=1)[trusted], told_rows(rows)[trusted]
    mean = np.zeros(values.shape[1])
    for row in np.flatnonzero(np.asarray(free_centres(rows.branches), bool) & told.any(axis=0)):
        mean[row] = np.median(values[told[:, row], row])
    covariance = guessed_spread(rows) + np.diag(least_spread(rows.branches) ** 2)
    return ModelSpread(
        mean=mean, covariance=covariance, outlier_share=GUESSED_OUTLIER_SHARE, dispersion=FIRST_DISPERSION
    )


def uncarried_centres(rows: FleetRows, trusted: Mask) -> Mask:
    """Rows whose centre the fleet has to tell: too few trusted vehicles do; shape (5K,)."""
    return np.asarray(free_centres(rows.branches) & (told_rows(rows)[trusted].sum(axis=0) < FEWEST_TRUSTED))
