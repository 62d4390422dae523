"""Hyper-parameters of the posterior from the fleet itself, by expectation maximisation (empirical Bayes).

Expectation: the states of each vehicle under the present hyper-parameters. Maximisation: share of hardware faults and
numbers of faults from the weights of the states, magnitudes by a grid over the slab's bounds, mean and covariance of
the model spread, and the dispersion of the intercepts, from the residuals that the states leave, with what the fitted
parameters hide of them.

The likelihood has several maxima (a cluster of faulty vehicles can stand for the reference), so it is climbed from
several starts and the highest is taken.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import in_place, inner
from calibrator.drive import Array
from calibrator.evidence.rows import FleetRows
from calibrator.posterior.fault_prior import FaultPrior, ModelSpread
from calibrator.posterior.model_spread import USED_STATES, next_spread
from calibrator.posterior.slab import WIDEST, Slab
from calibrator.posterior.small_matrices import log_mass
from calibrator.posterior.spread_doubt import centre_covariance, drawn_spread
from calibrator.posterior.spread_rows import free_centres
from calibrator.posterior.states import States, enumerate_states
from calibrator.random_streams import Purpose, random_stream

__all__ = [
    "Hyperparameters",
    "draw_hyperparameters",
    "estimate_hyperparameters",
]

TRIAL_STEPS, STEPS = 4, 12
"""Steps of each start, and of the best one after that."""
CONVERGED = 0.005
"""Gain of log evidence per vehicle below which the climb ends."""
MOST_VEHICLES = 300
"""Vehicles that hyper-parameters are learnt from; more change them less than the faults themselves. [1]"""
MOST_DRAWN, DRAWS = 200, 16
"""Fleet size up to which hyper-parameters are drawn, and how often."""
MEDIAN_SHARE = 2.0 / np.pi
"""Vehicles of a mean as sure as the median of one: efficiency of the median. [1]"""
PSEUDO_VEHICLES = 1.0
"""Weight of the guesses of the shares of faults, in vehicles."""
PSEUDO_FAULTS = 1.0
"""Weight of the guess of the share of smaller faults, in faults."""
GUESSED_HARDWARE_SHARE = 0.3
"""Share of vehicles with a hardware fault before anything is known. [1]"""
DECAY = 0.7
LOWS, HIGHS = np.geomspace(WIDEST.low, 0.2, 32), np.geomspace(0.01, WIDEST.high, 24)
"""Bounds of the slab that are tried."""
FINE = np.linspace(0.85, 1.18, 12)
"""Bounds tried around the best ones so far, relative to them. [1]"""
LOG_LEAST_DENSITY = float(np.log(1e-6))
"""Of a parameter under the slab: one outlier does not hold a bound."""


@dataclass(frozen=True, kw_only=True)
class Hyperparameters:
    """What the fleet says of its faults and of its model spread.

    Attributes
    ----------
    prior : FaultPrior
        Of the faults.
    spread : ModelSpread
        Of vehicles without fault.
    log_evidence : float
        Of the vehicles learnt from.
    """

    prior: FaultPrior
    spread: ModelSpread
    log_evidence: float


def estimate_hyperparameters(
    rows: FleetRows, spreads: Sequence[ModelSpread], *, given: FaultPrior | None = None, free: Array | None = None
) -> Hyperparameters:
    """Climb from each start and take the highest.

    Parameters
    ----------
    rows : FleetRows
        Evidence of the fleet.
    spreads : sequence of ModelSpread
        Starts.
    given : FaultPrior or None
        Prior of the faults, if it is known; None: estimated.
    free : ndarray of bool, shape (5K,), or None
        Rows whose centre is estimated; the others stay at their start. None: slopes, intercepts and junction constant.

    Returns
    -------
    Hyperparameters
        The most likely.
    """
    chosen = rows.take(_some(rows))
    centres = free_centres(rows.branches) if free is None else free
    starts = [
        _climb(chosen, spread, _first_prior(rows.branches), given=given, free=centres, steps=TRIAL_STEPS)
        for spread in spreads
    ]
    best = max(starts, key=lambda climb: climb.log_evidence)
    return _climb(chosen, best.spread, best.prior, given=given, free=centres, steps=STEPS)


def draw_hyperparameters(
    rows: FleetRows, best: Hyperparameters, *, given: FaultPrior | None = None, carriers: FleetRows | None = None
) -> list[Hyperparameters]:
    """Hyper-parameters that explain the fleet about as well as the best ones.

    A small fleet does not fix them; the posterior is averaged over these, as taking one set for true would make it
    surer than it may be. Shares are drawn from Dirichlet distributions, bounds of the slabs outwards by exponential
    ones, mean and covariance of the model spread from a normal and a Wishart distribution, each as so many vehicles
    tell them; the dispersion stays.

    Parameters
    ----------
    rows, given
        As in :func:`estimate_hyperparameters`.
    best : Hyperparameters
        Of the whole fleet.
    carriers : FleetRows or None
        Evidence of the trusted vehicles that alone tell the centres; None: all do.

    Returns
    -------
    list of Hyperparameters
        :data:`DRAWS` of them. For a fleet of more than :data:`MOST_DRAWN` vehicles the best alone, whose model spread
        then holds the uncertainty of the centre as well.
    """
    telling = rows if carriers is None else carriers
    states = enumerate_states(rows, best.prior, best.spread) if len(rows) <= MOST_DRAWN else None
    sound = 1.0 - best.prior.hardware_share
    doubt = centre_covariance(telling, best.spread, share=sound if carriers is None else MEDIAN_SHARE)
    if states is None:
        return [replace(best, spread=replace(best.spread, covariance=best.spread.covariance + doubt))]
    rng = random_stream(Purpose.HYPERPARAMETERS, len(rows))
    vehicles = float(np.sum(states.weight * ~states.hardware))
    return [
        Hyperparameters(
            prior=given if given is not None else _drawn_prior(rng, states, best.prior),
            spread=drawn_spread(rng, best.spread, vehicles, doubt),
            log_evidence=best.log_evidence,
        )
        for _ in range(DRAWS)
    ]


def _some(rows: FleetRows) -> NDArray[np.int64]:
    """At most :data:`MOST_VEHICLES`, evenly over the slopes of the first branch, in whatever order they are given."""
    order = np.lexsort(np.concatenate([rows.constant, rows.relative[:, ::-1]], axis=1).T)
    return np.asarray(order[np.linspace(0, len(rows) - 1, min(len(rows), MOST_VEHICLES)).astype(np.int64)])


def _climb(
    rows: FleetRows, spread: ModelSpread, prior: FaultPrior, *, given: FaultPrior | None, free: Array, steps: int
) -> Hyperparameters:
    prior = prior if given is None else given
    best: Hyperparameters | None = None
    for _ in range(steps):
        states = enumerate_states(rows, prior, spread)
        total = float(states.log_evidence.sum())
        if best is None or total > best.log_evidence:
            gain = np.inf if best is None else total - best.log_evidence
            best = Hyperparameters(prior=prior, spread=spread, log_evidence=total)
            if gain < CONVERGED * len(rows):
                break
        spread = next_spread(rows, states, prior, spread, free)
        if given is None:
            prior = _next_prior(states, prior)
    assert best is not None
    return best


def _first_prior(branches: int) -> FaultPrior:
    return FaultPrior(counts=_guess(branches), relative=WIDEST, constant=WIDEST)


def _guess(branches: int) -> Array:
    """Guess of the numbers of hardware and sensor faults, shape (K + 1, 2K + 1): few."""
    counts = np.exp(-DECAY * np.add.outer(np.arange(branches + 1.0), np.arange(2 * branches + 1.0)))
    counts[0] *= (1.0 - GUESSED_HARDWARE_SHARE) / counts[0].sum()
    counts[1:] *= GUESSED_HARDWARE_SHARE / counts[1:].sum()
    return np.asarray(counts)


def _next_prior(states: States, prior: FaultPrior) -> FaultPrior:
    counts = _tallies(states, prior)
    return FaultPrior(
        counts=counts / counts.sum(),
        relative=_next_slab(states.relative, states.relative_sd, states.weight, prior.relative, hardware=1),
        constant=_next_slab(
            states.constant, states.constant_sd, states.weight, prior.constant, hardware=states.branches - 1
        ),
    )


def _tallies(states: States, prior: FaultPrior) -> Array:
    """Vehicles by their numbers of hardware and sensor faults, shape (K + 1, 2K + 1); the guess counted in."""
    place = states.hardware_count * prior.counts.shape[1] + states.sensor_count
    tally = np.bincount(place.ravel(), states.weight.ravel(), prior.counts.size)
    return tally.reshape(prior.counts.shape) + PSEUDO_VEHICLES * _guess(prior.branches)


def _drawn_prior(rng: np.random.Generator, states: States, prior: FaultPrior) -> FaultPrior:
    """Prior of the faults as one of those that the fleet allows."""
    counts = _tallies(states, prior)
    return FaultPrior(
        counts=rng.dirichlet(counts.ravel()).reshape(counts.shape),
        relative=_drawn_slab(rng, prior.relative, _faults(states.relative, states.weight)),
        constant=_drawn_slab(rng, prior.constant, _faults(states.constant, states.weight)),
    )


def _drawn_slab(rng: np.random.Generator, slab: Slab, faults: float) -> Slab:
    """Bounds farther out, as far as so many draws of a uniform distribution may miss its ends by."""
    margin = (slab.high - slab.low) / (faults + 1.0)
    low, high = slab.low - margin * rng.exponential(), slab.high + margin * rng.exponential()
    return replace(slab, low=max(low, WIDEST.low), high=min(high, WIDEST.high))


def _faults(parameters: Array, weight: Array) -> float:
    """Expected number of nonzero parameters in the fleet."""
    return float(np.sum(weight[:, :, None] * (parameters != 0.0)))


def _next_slab(parameters: Array, sd: Array, weight: Array, slab: Slab, *, hardware: int) -> Slab:
    """Most likely bounds: each candidate weighs the states anew; first the lower bound, then the upper one.

    Both are then moved outwards by what the extremes of so many draws of a uniform distribution fall short of its ends.
    """
    parameters, sd, weight = parameters[:, :USED_STATES], sd[:, :USED_STATES], weight[:, :USED_STATES]
    faults = _faults(parameters, weight)
    if faults < 1.0:
        return slab
    smaller = np.where(np.arange(parameters.shape[2]) < hardware, 0.0, slab.smaller)
    within = np.where(smaller, slab.log_mass(parameters, sd), replace(slab, smaller=0.0).log_mass(parameters, sd))
    before = np.where(parameters != 0.0, within, 0.0).sum(axis=2)
    others = np.log(np.maximum(weight, np.finfo(float).tiny)) - before
    parameters, sd = np.ascontiguousarray(parameters), np.ascontiguousarray(sd)

    def log_evidence(candidate: Slab) -> float:
        return _log_evidence(others, parameters, sd, smaller, (candidate.low, candidate.high))

    for coarse in (True, False):
        lows, highs = (LOWS, HIGHS) if coarse else (slab.low * FINE, slab.high * FINE)
        slab = max([slab, *(replace(slab, low=float(x)) for x in lows if x < 0.7 * slab.high)], key=log_evidence)
        slab = max([slab, *(replace(slab, high=float(x)) for x in highs if x > 1.4 * slab.low)], key=log_evidence)
    margin = (slab.high - slab.low) / (faults + 1.0)
    return replace(
        slab,
        low=max(slab.low - margin, WIDEST.low),
        high=min(slab.high + margin, WIDEST.high),
        smaller=_share_below(parameters[:, :, hardware:], sd[:, :, hardware:], weight, slab),
    )


def _share_below(parameters: Array, sd: Array, weight: Array, slab: Slab) -> float:
    """Share of the sensors' faults that are smaller than the slab; the guess counted in."""
    inside = replace(slab, smaller=0.0).log_mass(parameters, sd) + np.log1p(-slab.smaller)
    below = 1.0 - np.exp(inside - slab.log_mass(parameters, sd))
    present = weight[:, :, None] * (parameters != 0.0)
    number = float(np.sum(present * below)) + PSEUDO_FAULTS * WIDEST.smaller
    return number / (float(np.sum(present)) + PSEUDO_FAULTS)


@in_place
def _log_evidence(others: Array, parameters: Array, sd: Array, smaller: Array, bounds: tuple[float, float]) -> float:
    """Logarithm of the evidence of N vehicles under a slab.

    ``others`` (N, S) is what the states owe to all else, ``parameters`` and ``sd`` (N, S, P) are zero where not active,
    ``smaller`` (P,) is the share of faults below the slab.
    """
    total = 0.0
    for j in range(len(others)):
        best, sum_ = -np.inf, 0.0
        for s in range(others.shape[1]):
            value = others[j, s]
            for p in range(parameters.shape[2]):
                if parameters[j, s, p] != 0.0:
                    value += _log_density(parameters[j, s, p], sd[j, s, p], *bounds, smaller[p])
            if value > best:
                best, sum_ = value, sum_ * math.exp(best - value) + 1.0
            else:
                sum_ += math.exp(value - best)
        total += best + math.log(sum_)
    return total


@inner
def _log_density(mean: float, sd: float, low: float, high: float, smaller: float) -> float:
    """Of one parameter under the slab; not below the least one."""
    mass = log_mass(mean, sd, low, high, smaller)
    return max(mass, LOG_LEAST_DENSITY) + math.log1p(math.exp(-abs(mass - LOG_LEAST_DENSITY)))
