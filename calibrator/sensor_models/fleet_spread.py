"""What the sensors of a fleet show of a nonlinearity without having one: centre and spread of the rows.

A nonlinearity that all vehicles show is an error of the fleet model, not of their sensors: it is the centre. What
vehicles differ by without any nonlinear sensor is the spread. Both are estimated by expectation maximisation, each
vehicle weighing by the probability that its sensors are linear; rows that say nothing take no part.
"""

from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.evidence.cluster import densest_clusters

__all__ = ["FleetSpread", "first_spread", "next_spread"]

GUESS_VEHICLES = 5.0
"""Weight of the guess of the spread, in vehicles."""
GUESS_OVER_SAMPLING = 0.5
"""Guess of the spread over the usual deviation of a row, which holds the misfit of each vehicle already. [1]"""


@dataclass(frozen=True, kw_only=True)
class FleetSpread:
    """Rows of vehicles whose sensors are linear.

    Attributes
    ----------
    centre : ndarray of shape (R,)
        Mean. [1]
    covariance : ndarray of shape (R, R)
        Over vehicles, sampling errors apart. [1]
    """

    centre: Array
    covariance: Array


def first_spread(values: Array, covariance: Array, known: Mask) -> FleetSpread:
    """Start: the densest cluster of each row, and the guess of the spread.

    Parameters
    ----------
    values : ndarray of shape (N, R)
        Rows. [1]
    covariance : ndarray of shape (N, R, R)
        Of their sampling errors. [1]
    known : ndarray of bool, shape (N, R)
        Rows that say something.

    Returns
    -------
    FleetSpread
        The start.
    """
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    centre = np.zeros(values.shape[1])
    for row in np.flatnonzero(known.any(axis=0)):
        told = known[:, row]
        centre[row] = densest_clusters(values[told, row], sd[told, row])[0].centre
    return FleetSpread(centre=centre, covariance=_guess(sd, known))


def next_spread(values: Array, covariance: Array, known: Mask, weight: Array, spread: FleetSpread) -> FleetSpread:
    """One step of expectation maximisation.

    Parameters
    ----------
    values, covariance, known
        As in :func:`first_spread`.
    weight : ndarray of shape (N,)
        Probability that all sensors of a vehicle are linear. [1]
    spread : FleetSpread
        Of the step before.

    Returns
    -------
    FleetSpread
        More likely than the one before.
    """
    gain = spread.covariance @ np.linalg.inv(covariance + spread.covariance)
    own = spread.centre + np.einsum("nab,nb->na", gain, values - spread.centre)
    vehicles = weight @ known
    centre = np.where(vehicles > 0.0, weight @ (own * known) / np.maximum(vehicles, 1.0), spread.centre)
    deviation = own - centre
    hidden = spread.covariance - gain @ spread.covariance
    found = np.einsum("n,na,nb->ab", weight, deviation, deviation) + np.einsum("n,nab->ab", weight, hidden)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    share = GUESS_VEHICLES / (GUESS_VEHICLES + weight.sum())
    return FleetSpread(
        centre=centre, covariance=(1.0 - share) * found / max(weight.sum(), 1.0) + share * _guess(sd, known)
    )


def _guess(sd: Array, known: Mask) -> Array:
    """Diagonal covariance from the median sampling deviation of the rows that say something; else 1."""
    usual = [float(np.median(sd[told, row])) if told.any() else 1.0 for row, told in enumerate(known.T)]
    return np.diag((GUESS_OVER_SAMPLING * np.array(usual)) ** 2)
