"""How sure the model spread is of a fleet is: covariance of its centre, and draws of what the fleet leaves open."""

from dataclasses import replace

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.rows import FleetRows
from calibrator.posterior.fault_prior import ModelSpread
from calibrator.posterior.model_spread import SPREAD_VEHICLES
from calibrator.posterior.spread_rows import free_centres

__all__ = ["centre_covariance", "drawn_spread"]


def centre_covariance(rows: FleetRows, spread: ModelSpread, *, share: float = 1.0) -> Array:
    """Covariance of the centre that vehicles tell.

    Parameters
    ----------
    rows : FleetRows
        Evidence of these vehicles.
    spread : ModelSpread
        Of vehicles without fault.
    share : float
        Of the vehicles without hardware faults, which tell it. [1]

    Returns
    -------
    ndarray of shape (5K, 5K)
        Model spread and sampling errors together; zero in rows that have no centre.
    """
    precision = np.linalg.inv(rows.dispersed(spread.dispersion)[0] + spread.covariance)
    free = free_centres(rows.branches)
    covariance = np.linalg.inv(precision.sum(axis=0)) / max(share, 1.0 / len(rows))
    return np.asarray(np.where(np.outer(free, free), covariance, 0.0))


def drawn_spread(
    rng: np.random.Generator, spread: ModelSpread, vehicles: float, centre_covariance: Array
) -> ModelSpread:
    """Mean and covariance as a fleet leaves them open.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of chance.
    spread : ModelSpread
        The most likely one.
    vehicles : float
        Vehicles that tell the covariance.
    centre_covariance : ndarray of shape (5K, 5K)
        Of the mean.

    Returns
    -------
    ModelSpread
        One of those that the fleet allows.
    """
    degrees = int(np.ceil(vehicles + SPREAD_VEHICLES))
    root = np.linalg.cholesky(spread.covariance)
    normal = root @ rng.standard_normal((len(root), degrees))
    covariance = normal @ normal.T / degrees + np.diag(np.diag(spread.covariance)) / degrees
    values, vectors = np.linalg.eigh(centre_covariance)
    error = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
    return replace(spread, mean=spread.mean + error, covariance=covariance)
