"""Which sensors are not linear: a model is chosen only where the evidence of the fleet prefers it.

The rows of vehicle j and family f are Gaussian, with the fleet's centre and spread (:mod:`.fleet_spread`):

    z ~ N(centre + X_S e_S, R_j + spread),    e_S ~ N(0, 1) for the branches S that are not linear,

so every set S of at most two branches has its evidence in closed form. The Bayes factor of branch k compares the sets
with k to those without it: it is large only if neither linear sensors nor another branch can explain the rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import expit, logsumexp

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.evidence.fleet_model import fit_fleet_model
from calibrator.evidence.fleet_moments import stack_summaries
from calibrator.sensor_models.families import Family
from calibrator.sensor_models.fleet_spread import FleetSpread, first_spread, next_spread
from calibrator.sensor_models.rows import ExcessRows, excess_rows
from calibrator.sensor_models.summary import SensorSummary

__all__ = ["LEAST_LOG_BAYES", "LEAST_VEHICLES", "LINEAR", "SensorModelChoice", "choose_sensor_models"]

LINEAR = "linear"
PRIOR_SHARE = 0.01
"""Share of sensors that are not linear, before anything is known: with balanced evidence sensors are linear. [1]"""
LEAST_LOG_BAYES = 9.2
"""Least logarithm of the Bayes factor with which a model is chosen: it turns 1 % into 99 %."""
LEAST_VEHICLES = 8
"""Of fewer vehicles it cannot be told what belongs to the fleet model."""
MOST_SIZES = 4.0
"""Excess over its usual size beyond which it is no sensor's, but a zero or a branch that was misunderstood. [1]"""
MOST_BRANCHES = 2
"""Branches of one vehicle that are not linear in the same way, at most. [1]"""
DESIGN_ERROR = 0.05
"""Relative error of the design: columns are computed from measured currents, to first order. [1]"""
STEPS = 10
"""Of expectation maximisation; the spread changes by less than 1 % after six on all fleets tried. [1]"""


@dataclass(frozen=True, kw_only=True)
class SensorModelChoice:
    """What is said of one branch of one vehicle.

    Attributes
    ----------
    model : str
        :data:`LINEAR`, or the name of the family that is preferred.
    excess, excess_sd : float
        Excess of that family and its standard deviation; 0 for linear. [1], or [1/K] for temperature
    reference : float
        Of the linear part, see :meth:`~calibrator.sensor_models.families.Family.linear_reference`.
    log_bayes_factor : float
        Natural logarithm of the Bayes factor of the likeliest family against everything else for this branch.
    rival_log_bayes_factor : float
        The same of the likeliest of the other families.
    undecided : bool
        Whether the vehicle has a sensor that is not linear, and this branch may be it, but others may be as well.
    """

    model: str = LINEAR
    excess: float = 0.0
    excess_sd: float = 0.0
    reference: float = 0.0
    log_bayes_factor: float
    rival_log_bayes_factor: float = -np.inf
    undecided: bool = False

    @property
    def probability(self) -> float:
        """Posterior probability of the likeliest family, against the linear sensor and the other families. [1]"""
        log_odds = np.logaddexp(self.rival_log_bayes_factor, np.log1p(-PRIOR_SHARE) - np.log(PRIOR_SHARE))
        return float(expit(self.log_bayes_factor - log_odds))


def choose_sensor_models(vehicles: Sequence[SensorSummary]) -> list[list[SensorModelChoice]]:
    """Choose the sensor model of every branch of every vehicle of a fleet.

    Parameters
    ----------
    vehicles : sequence of SensorSummary
        One per vehicle, with the same inputs, branches and families.

    Returns
    -------
    list of N lists of K SensorModelChoice
        All linear for a fleet of fewer than :data:`LEAST_VEHICLES` vehicles.

    Raises
    ------
    FleetError
        If the vehicles are not alike in branches, inputs or families.
    """
    if len({(v.families, v.summary.branches, v.summary.inputs) for v in vehicles}) > 1:
        raise FleetError("vehicles differ in branches, inputs or temperature signal; search those that are alike")
    if len(vehicles) < LEAST_VEHICLES:
        return [[SensorModelChoice(log_bayes_factor=0.0)] * v.summary.branches for v in vehicles]
    read_out = fit_fleet_model(stack_summaries([vehicle.summary for vehicle in vehicles])).read_out
    found = [_of_family(family, excess_rows(vehicles, read_out, family)) for family in vehicles[0].families]
    return [[_likeliest(branch) for branch in zip(*vehicle, strict=True)] for vehicle in zip(*found, strict=True)]


def _likeliest(families: Sequence[SensorModelChoice]) -> SensorModelChoice:
    """Of the choices between the linear sensor and each of the families."""
    *others, best = sorted(families, key=lambda choice: choice.log_bayes_factor)
    return replace(best, rival_log_bayes_factor=others[-1].log_bayes_factor) if others else best


def _of_family(family: Family, rows: Sequence[ExcessRows]) -> list[list[SensorModelChoice]]:
    """Choices between the linear sensor and one family."""
    values, covariance = np.stack([r.values for r in rows]), np.stack([r.covariance for r in rows])
    known, design = np.stack([r.known for r in rows]), np.stack([r.design for r in rows])
    sets = _sets(design.shape[2])
    spread = first_spread(values, covariance, known)
    for _ in range(STEPS):
        log_evidence = np.stack([_log_evidence(values, covariance, design, spread, s) for s in sets], axis=1)
        linear = np.exp(log_evidence[:, 0] - logsumexp(log_evidence, axis=1))
        spread = next_spread(values, covariance, known, linear, spread)
    return [_choices(family, rows[j], log_evidence[j], sets, spread) for j in range(len(rows))]


def _sets(branches: int) -> list[tuple[int, ...]]:
    """Sets of branches that are not linear; none first."""
    return [s for count in range(MOST_BRANCHES + 1) for s in combinations(range(branches), count)]


def _log_evidence(
    values: Array, covariance: Array, design: Array, spread: FleetSpread, active: tuple[int, ...]
) -> Array:
    """Logarithm of prior times evidence of one set for all vehicles, shape (N,)."""
    X = design[:, :, list(active)]
    C = covariance + spread.covariance + X @ np.swapaxes(X, 1, 2)
    C = C + DESIGN_ERROR**2 * np.einsum("nrk,rs->nrs", X**2, np.eye(X.shape[1]))
    left = values - spread.centre
    quadratic = np.einsum("na,na->n", left, np.linalg.solve(C, left[..., None])[..., 0])
    active_count, K = len(active), design.shape[2]
    log_prior = active_count * np.log(PRIOR_SHARE) + (K - active_count) * np.log1p(-PRIOR_SHARE)
    return np.asarray(log_prior - 0.5 * (quadratic + np.linalg.slogdet(C)[1]))


def _choices(
    family: Family, rows: ExcessRows, log_evidence: Array, sets: Sequence[tuple[int, ...]], spread: FleetSpread
) -> list[SensorModelChoice]:
    """Choices of one vehicle."""
    K = rows.design.shape[1]
    not_linear = _log_bayes_factor(log_evidence, np.array([bool(s) for s in sets])) >= LEAST_LOG_BAYES
    excess, sd = _excess(rows, sets[int(np.argmax(log_evidence))], spread)
    choices = []
    for k in range(K):
        log_factor = _log_bayes_factor(log_evidence, np.array([k in s for s in sets]))
        chosen = SensorModelChoice(
            model=family.name,
            excess=family.size * float(excess[k]),
            excess_sd=family.size * float(sd[k]),
            reference=float(rows.reference[k]),
            log_bayes_factor=log_factor,
        )
        linear = SensorModelChoice(log_bayes_factor=log_factor, undecided=not_linear and log_factor > 0.0)
        sensible = abs(excess[k]) <= MOST_SIZES
        choices.append(chosen if sensible and log_factor >= LEAST_LOG_BAYES else linear)
    return choices


def _log_bayes_factor(log_evidence: Array, among: Mask) -> float:
    """Logarithm of posterior over prior odds of some sets, as if they had the prior of a single branch."""
    log_prior_odds = np.log(PRIOR_SHARE) - np.log1p(-PRIOR_SHARE)
    return float(logsumexp(log_evidence[among]) - logsumexp(log_evidence[~among]) - log_prior_odds)


def _excess(rows: ExcessRows, active: tuple[int, ...], spread: FleetSpread) -> tuple[Array, Array]:
    """Posterior mean and deviation of the excesses of a set, in units of the usual size; 0 outside the set. (K,)"""
    place, K = list(active), rows.design.shape[1]
    X = rows.design[:, place]
    C = rows.covariance + spread.covariance + DESIGN_ERROR**2 * np.diag(np.sum(X**2, axis=1))
    posterior = np.linalg.inv(X.T @ np.linalg.solve(C, X) + np.eye(len(place)))
    mean, sd = np.zeros(K), np.zeros(K)
    mean[place] = posterior @ X.T @ np.linalg.solve(C, rows.values - spread.centre)
    sd[place] = np.sqrt(np.diag(posterior))
    return mean, sd
