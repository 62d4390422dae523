"""Hyper-parameters of the posterior from the fleet itself, by expectation maximisation (empirical Bayes).

Expectation: the states of each vehicle under the present hyper-parameters. Maximisation: share of hardware faults and
numbers of faults from the weights of the states, magnitudes by a grid over the slab's bounds, mean and covariance of
the model spread from the residuals that the states leave, with what the fitted parameters hide of them.

The likelihood has several maxima (a cluster of faulty vehicles can stand for the reference), so it is climbed from
several starts and the highest is taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from calibrator.drive import Array, Mask
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows, constant_design, relative_design
from calibrator.posterior.cluster import densest_clusters
from calibrator.posterior.fault_prior import FaultPrior, ModelSpread
from calibrator.posterior.slab import Slab
from calibrator.posterior.states import States, enumerate_states
from calibrator.random_streams import Purpose, random_stream

__all__ = [
    "Hyperparameters",
    "estimate_hyperparameters",
    "initial_spreads",
    "resampled_hyperparameters",
    "trusted_spread",
]

WIDEST = Slab(0.002, 0.45)
"""Any fault that a sensor of a running vehicle can have. [1]"""
TRIAL_STEPS, STEPS = 4, 12
"""Steps of each start, and of the best one after that."""
CONVERGED = 0.01
"""Gain of log evidence per vehicle below which the climb ends."""
MOST_VEHICLES = 300
"""Vehicles that hyper-parameters are learnt from; more change them less than the faults themselves. [1]"""
MOST_RESAMPLED, RESAMPLINGS, RESAMPLED_STEPS = 200, 8, 4
"""Fleet size up to which hyper-parameters are resampled, how often, and how far each is climbed."""
USED_STATES = 24
PSEUDO_VEHICLES = 5.0
"""Weight of the guesses of the shares of faults, in vehicles."""
GUESSED_HARDWARE_SHARE = 0.3
"""Share of vehicles with a hardware fault before anything is known. [1]"""
DECAY = 0.7
SPREAD_VEHICLES = 5.0
"""Weight of the guess of the model spread, in vehicles."""
SPREAD_OVER_SAMPLING = 2.0
"""Guess of the model spread over the usual sampling deviation: a model errs alike over a whole drive. [1]"""
MOST_SPREAD = 0.02
"""Of a start; wider clusters are made of faults. [1]"""
LEAST_SPREAD = np.array([1e-5, 1e-6])
"""Least model spread of relative and constant rows: far below any sensor's resolution. [1]"""
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
    chosen = rows.take(np.linspace(0, len(rows) - 1, min(len(rows), MOST_VEHICLES)).astype(np.int64))
    centres = _free_centres(rows.branches) if free is None else free
    starts = [
        _climb(chosen, spread, _first_prior(rows.branches), given=given, free=centres, steps=TRIAL_STEPS)
        for spread in spreads
    ]
    best = max(starts, key=lambda climb: climb.log_evidence)
    return _climb(chosen, best.spread, best.prior, given=given, free=centres, steps=STEPS)


def resampled_hyperparameters(
    rows: FleetRows, best: Hyperparameters, *, given: FaultPrior | None = None, free: Array | None = None
) -> list[Hyperparameters]:
    """Hyper-parameters that fleets like this one would have given: climbs from the best on resampled vehicles.

    A small fleet does not fix them; the posterior is averaged over these, as taking one set for true would make it
    surer than it may be [1]_.

    Parameters
    ----------
    rows, given, free
        As in :func:`estimate_hyperparameters`.
    best : Hyperparameters
        Of the whole fleet.

    Returns
    -------
    list of Hyperparameters
        One per resampling; the best alone for a fleet of more than :data:`MOST_RESAMPLED` vehicles.

    References
    ----------
    .. [1] J. H. Huggins, J. W. Miller, "Robust inference and model criticism using bagged posteriors",
       arXiv:1912.07104.
    """
    if len(rows) > MOST_RESAMPLED:
        return [best]
    centres = _free_centres(rows.branches) if free is None else free
    rng = random_stream(Purpose.RESAMPLING, len(rows))
    samples = [rows.take(np.sort(rng.integers(len(rows), size=len(rows)))) for _ in range(RESAMPLINGS)]
    return [
        _climb(sample, best.spread, best.prior, given=given, free=centres, steps=RESAMPLED_STEPS) for sample in samples
    ]


def initial_spreads(rows: FleetRows) -> list[ModelSpread]:
    """Starts of the climb: the densest cluster of each row (narrow, and as wide as it is), the second, and the mean.

    Parameters
    ----------
    rows : FleetRows
        Evidence of the fleet.

    Returns
    -------
    list of ModelSpread
        Four starts.
    """
    K, r = rows.branches, rows.relative.shape[1]
    values = np.concatenate([rows.relative, rows.constant], axis=1)
    sd = np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2))
    mean, second, spread = np.zeros(5 * K), np.zeros(5 * K), np.zeros(5 * K)
    for row in _informed_rows(K):
        told = sd[:, row] < np.sqrt(UNKNOWN_VARIANCE) / 2.0
        if not told.any():
            continue
        clusters = densest_clusters(values[told, row], sd[told, row], most=2)
        mean[row], spread[row] = clusters[0].centre, clusters[0].spread
        second[row] = clusters[1].centre if len(clusters) > 1 and row < K else mean[row]
    ratios = slice(K, 2 * K - 1)
    mean[ratios], second[ratios] = 0.0, 0.0
    average = mean.copy()
    average[:K], average[r : r + K] = rows.relative[:, :K].mean(axis=0), rows.constant[:, :K].mean(axis=0)
    narrow = _guessed_spread(rows) + np.diag(_least_spread(K) ** 2)
    wide = np.maximum(narrow, np.diag(np.minimum(spread, MOST_SPREAD) ** 2))
    return [
        ModelSpread(mean=mean, covariance=narrow),
        ModelSpread(mean=mean, covariance=wide),
        ModelSpread(mean=second, covariance=narrow),
        ModelSpread(mean=average, covariance=narrow),
    ]


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
    values = np.concatenate([rows.relative, rows.constant], axis=1)
    mean = np.where(_free_centres(rows.branches), np.median(values[trusted], axis=0), 0.0)
    return ModelSpread(mean=mean, covariance=_guessed_spread(rows) + np.diag(_least_spread(rows.branches) ** 2))


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
        spread = _next_spread(rows, states, prior, spread, free)
        if given is None:
            prior = _next_prior(states, prior)
    assert best is not None
    return best


def _first_prior(branches: int) -> FaultPrior:
    return FaultPrior(hardware_share=GUESSED_HARDWARE_SHARE, counts=_guess(branches), relative=WIDEST, constant=WIDEST)


def _guess(branches: int) -> Array:
    """Guess of the number of faults: few; none without hardware faults, one with, are the most likely."""
    number = np.arange(3 * branches + 1.0)
    counts = np.exp(-DECAY * np.stack([number, number]))
    counts[0, 2 * branches + 1 :] = 0.0
    counts[1, 0] = 0.0
    return np.asarray(counts / counts.sum(axis=1, keepdims=True))


def _next_prior(states: States, prior: FaultPrior) -> FaultPrior:
    hardware, count, weight = states.hardware, states.count, states.weight
    shares = np.stack(
        [np.bincount(count.ravel(), (weight * (hardware == h)).ravel(), prior.counts.shape[1]) for h in (0, 1)]
    )
    counts = shares + PSEUDO_VEHICLES * _guess(prior.branches)
    return FaultPrior(
        hardware_share=float(
            (shares[1].sum() + PSEUDO_VEHICLES * GUESSED_HARDWARE_SHARE) / (shares.sum() + PSEUDO_VEHICLES)
        ),
        counts=counts / counts.sum(axis=1, keepdims=True),
        relative=_next_slab(states.relative, states.relative_sd, weight, prior.relative),
        constant=_next_slab(states.constant, states.constant_sd, weight, prior.constant),
    )


def _next_slab(parameters: Array, sd: Array, weight: Array, slab: Slab) -> Slab:
    """Most likely bounds: each candidate weighs the states anew; first the lower bound, then the upper one.

    Both are then moved outwards by what the extremes of so many draws of a uniform distribution fall short of its ends.
    """
    parameters, sd, weight = parameters[:, :USED_STATES], sd[:, :USED_STATES], weight[:, :USED_STATES]
    told = parameters != 0.0
    faults = float(np.sum(weight[:, :, None] * told))
    if faults < 1.0:
        return slab
    before = np.where(told, slab.log_mass(parameters, sd), 0.0).sum(axis=2)
    others = np.log(np.maximum(weight, np.finfo(float).tiny)) - before

    def log_evidence(candidate: Slab) -> float:
        mass = np.logaddexp(candidate.log_mass(parameters[told], sd[told]), LOG_LEAST_DENSITY)
        after = np.zeros(parameters.shape)
        after[told] = mass
        return float(np.sum(logsumexp(others + after.sum(axis=2), axis=1)))

    for coarse in (True, False):
        lows, highs = (LOWS, HIGHS) if coarse else (slab.low * FINE, slab.high * FINE)
        slab = max([slab, *(Slab(float(x), slab.high) for x in lows if x < 0.7 * slab.high)], key=log_evidence)
        slab = max([slab, *(Slab(slab.low, float(x)) for x in highs if x > 1.4 * slab.low)], key=log_evidence)
    margin = (slab.high - slab.low) / (faults + 1.0)
    return Slab(max(slab.low - margin, WIDEST.low), min(slab.high + margin, WIDEST.high))


def _next_spread(rows: FleetRows, states: States, prior: FaultPrior, spread: ModelSpread, free: Array) -> ModelSpread:
    """Mean and covariance of what is left of the rows once the states are taken out."""
    K, S = rows.branches, min(USED_STATES, states.weight.shape[1])
    weight = states.weight[:, :S] / states.weight[:, :S].sum(axis=1, keepdims=True)
    residual = _residuals(rows, states, S)
    precision = np.linalg.inv(rows.covariance + spread.covariance)
    gain = spread.covariance @ precision
    left = spread.mean + np.einsum("nab,nsb->nsa", gain, residual - spread.mean)
    hidden = spread.covariance - gain @ spread.covariance
    hidden = hidden + np.einsum("ns,nsab->nab", weight, _hidden_by_parameters(states, S, prior, precision, gain))
    mean = np.where(free, np.einsum("ns,nsa->a", weight, left) / len(rows), spread.mean)
    deviation = left - mean
    covariance = (np.einsum("ns,nsa,nsb->ab", weight, deviation, deviation) + hidden.sum(axis=0)) / len(rows)
    share = SPREAD_VEHICLES / (SPREAD_VEHICLES + len(rows))
    covariance = (1.0 - share) * covariance + share * _guessed_spread(rows)
    return ModelSpread(mean=mean, covariance=covariance + np.diag(_least_spread(K) ** 2))


def _guessed_spread(rows: FleetRows) -> Array:
    """Covariance of the model spread before anything is known: a multiple of the usual sampling covariance."""
    informed = np.zeros(5 * rows.branches, bool)
    informed[_informed_rows(rows.branches)] = True
    told = np.diagonal(rows.covariance, axis1=1, axis2=2) < UNKNOWN_VARIANCE / 2.0
    variance = np.ones(len(informed))
    for row in np.flatnonzero(informed & told.any(axis=0)):
        variance[row] = np.median(rows.covariance[told[:, row], row, row])
    return np.diag(np.where(informed, SPREAD_OVER_SAMPLING**2 * variance, 0.0))


def _residuals(rows: FleetRows, states: States, used: int) -> Array:
    """Rows less what each state explains of them, shape (N, S, 5K)."""
    K = rows.branches
    relative, constant = states.relative[:, :used], states.constant[:, :used].copy()
    factor = 1.0 + relative[:, :, 1:]
    constant[:, :, K - 1 :] /= factor
    first = rows.relative[:, None] - np.log1p(relative) @ relative_design(K).T
    seen = rows.constant[:, None] / np.concatenate([factor, factor[..., :1], factor], axis=2)
    return np.concatenate([first, seen - constant @ constant_design(K).T], axis=2)


def _hidden_by_parameters(states: States, used: int, prior: FaultPrior, precision: Array, gain: Array) -> Array:
    """Covariance of the spread that the fitted parameters of each state hide, shape (N, S, 5K, 5K)."""
    K = states.branches
    design = np.zeros((5 * K, 3 * K))
    design[: 3 * K - 1, : K + 1] = relative_design(K)
    design[3 * K - 1 :, K + 1 :] = constant_design(K)
    active = np.concatenate([states.relative[:, :used] != 0.0, states.constant[:, :used] != 0.0], axis=2)
    slab = np.concatenate([np.full(K + 1, prior.relative.high), np.full(2 * K - 1, prior.constant.high)])
    information = np.einsum("ra,nrs,sb->nab", design, precision, design)[:, None] * (
        active[..., :, None] & active[..., None, :]
    )
    C = np.linalg.inv(information + np.eye(3 * K) / slab**2) * active[..., None, :]
    shown = (gain @ design)[:, None] * active[..., None, :]
    return np.asarray(shown @ C @ np.swapaxes(shown, 2, 3))


def _informed_rows(branches: int) -> list[int]:
    """Slopes, gain ratios, intercepts and junction constant; bench readings have no centre of the fleet."""
    K = branches
    return [*range(2 * K - 1), *range(3 * K - 1, 4 * K)]


def _free_centres(branches: int) -> Array:
    K = branches
    free = np.zeros(5 * K, bool)
    free[:K], free[3 * K - 1 : 4 * K] = True, True
    return free


def _least_spread(branches: int) -> Array:
    return np.repeat(LEAST_SPREAD, [3 * branches - 1, 2 * branches + 1])
