"""Model spread: what vehicles without faults differ by, estimated from what the explanations of a fleet leave.

A few vehicles differ more than the others (a stuck input, an odd trip). With a small probability the spread of a
vehicle has :data:`OUTLIER_VARIANCE` times the variance; so they neither widen the spread nor pass for faulty.
"""

from dataclasses import replace

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.evidence.cluster import Cluster, densest_clusters
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows, constant_design, relative_design
from calibrator.posterior.fault_prior import OUTLIER_VARIANCE, FaultPrior, ModelSpread
from calibrator.posterior.slab import FAULTS_RANGE
from calibrator.posterior.states import States

__all__ = [
    "FEWEST_TRUSTED",
    "MOST_UNMEASURED",
    "USED_STATES",
    "centre_covariance",
    "drawn_spread",
    "free_centres",
    "initial_spreads",
    "next_spread",
    "trusted_spread",
    "uncarried_centres",
    "unmeasured_load",
]

USED_STATES = 24
"""States of each vehicle that are looked at, the most probable ones. [1]"""
SPREAD_VEHICLES = 5.0
"""Weight of the guess of the model spread, in vehicles."""
GUESSED_DISPERSION, FIRST_DISPERSION = 2.0, 4.0
"""Guess of the variance of intercepts over what their blocks tell, and where the climb starts: it falls fast. [1]"""
SPREAD_OVER_SAMPLING = 2.0
"""Guess of the model spread over the usual sampling deviation: a model errs alike over a whole drive. [1]"""
MOST_SPREAD = 0.02
"""Of a start; wider clusters are made of faults. [1]"""
LEAST_SPREAD = np.array([1e-5, 1e-6])
"""Least model spread of relative and constant rows: far below any sensor's resolution. [1]"""
LAWFUL, LAWFUL_GAIN, LAWFUL_CONSTANT = 3.0, 0.001, 0.002
"""Deviations up to which a vehicle obeys the junction law, and the least one of a gain ratio and the constant. [1]"""
FEWEST_TRUSTED = 3
"""Trusted vehicles that carry the reference of a branch that they tell."""
FEWEST_LAWFUL = 3
"""Vehicles that make a cluster."""
LEAST_AGREEING_LOAD = 0.15
"""Share of the vehicles that must agree on a load without a sensor. [1]"""
MOST_UNMEASURED = 0.015
"""Largest load without a sensor that is looked for, over full scale; larger constants are offsets. [1]"""
OUTLIER_VEHICLES, GUESSED_OUTLIER_SHARE = 2.0, 0.05
"""Weight of the guess of the share of vehicles that differ more, in vehicles, and that guess. [1]"""


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
    narrow = _guessed_spread(rows) + np.diag(_least_spread(K) ** 2)
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
    for row in _informed_rows(K):
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


def unmeasured_load(constant: Array, sd: Array) -> Cluster:
    """Densest cluster of the junction's constant among those that a load without a sensor can make.

    Parameters
    ----------
    constant, sd : ndarray of shape (N,)
        Constants of N vehicles in fractions of full scale, and their standard deviations. [1]

    Returns
    -------
    Cluster
        At zero if too few vehicles agree for such a load to be taken for granted.
    """
    possible = constant > -LAWFUL_CONSTANT - LAWFUL * sd
    for found in densest_clusters(constant[possible], sd[possible], farthest=MOST_UNMEASURED, widest=FAULTS_RANGE):
        share = found.share * float(possible.mean())
        if share >= LEAST_AGREEING_LOAD and found.centre > -LAWFUL_CONSTANT:
            return replace(found, share=share)
    return Cluster(centre=0.0, spread=0.0, share=0.0, gain=0.0)


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
    values, told = np.concatenate([rows.relative, rows.constant], axis=1)[trusted], _told(rows)[trusted]
    mean = np.zeros(values.shape[1])
    for row in np.flatnonzero(np.asarray(free_centres(rows.branches), bool) & told.any(axis=0)):
        mean[row] = np.median(values[told[:, row], row])
    covariance = _guessed_spread(rows) + np.diag(_least_spread(rows.branches) ** 2)
    return ModelSpread(
        mean=mean, covariance=covariance, outlier_share=GUESSED_OUTLIER_SHARE, dispersion=FIRST_DISPERSION
    )


def uncarried_centres(rows: FleetRows, trusted: Mask) -> Mask:
    """Rows whose centre the fleet has to tell: too few trusted vehicles do; shape (5K,)."""
    return np.asarray(free_centres(rows.branches) & (_told(rows)[trusted].sum(axis=0) < FEWEST_TRUSTED))


def _told(rows: FleetRows) -> Mask:
    """Rows that say something, shape (N, 5K)."""
    return np.asarray(np.diagonal(rows.covariance, axis1=1, axis2=2) < UNKNOWN_VARIANCE / 2.0)


def next_spread(rows: FleetRows, states: States, prior: FaultPrior, spread: ModelSpread, free: Array) -> ModelSpread:
    """Mean and covariance of what is left of the rows once the states are taken out.

    Parameters
    ----------
    rows : FleetRows
        Evidence of N vehicles.
    states : States
        Their explanations under the present hyper-parameters.
    prior, spread : FaultPrior, ModelSpread
        The present hyper-parameters.
    free : ndarray of bool, shape (5K,)
        Rows whose centre is estimated.

    Returns
    -------
    ModelSpread
        The next one.
    """
    used = min(USED_STATES, states.weight.shape[1])
    every = states.weight[:, :used] / states.weight[:, :used].sum(axis=1, keepdims=True)
    residual = _residuals(rows, states, used, spread.mean)
    parts = []
    for wide, scale in ((False, 1.0), (True, OUTLIER_VARIANCE)):
        weight = every * (states.outlier[:, :used] == wide)
        if weight.sum() > 0.0:
            scaled = replace(spread, covariance=scale * spread.covariance)
            parts.append((weight / scale, *_left(rows, states, prior, scaled, residual)))
    told = sum(float(weight.sum()) for weight, _, _ in parts)
    centre = sum(np.einsum("ns,nsa->a", weight, left) for weight, left, _ in parts) / told
    mean = np.where(free, centre, spread.mean)
    scatter = np.zeros_like(spread.covariance)
    for weight, left, hidden in parts:
        deviation = left - mean
        scatter += np.einsum("ns,nsa,nsb->ab", weight, deviation, deviation) + np.einsum("ns,nsab->ab", weight, hidden)
    share = SPREAD_VEHICLES / (SPREAD_VEHICLES + len(rows))
    covariance = (1.0 - share) * scatter / len(rows) + share * _guessed_spread(rows)
    outliers = float(np.sum(every * states.outlier[:, :used]))
    return ModelSpread(
        mean=mean,
        covariance=covariance + np.diag(_least_spread(rows.branches) ** 2),
        dispersion=_next_dispersion(rows, states, prior, replace(spread, mean=mean), residual),
        outlier_share=(outliers + OUTLIER_VEHICLES * GUESSED_OUTLIER_SHARE) / (len(rows) + OUTLIER_VEHICLES),
    )


def _left(
    rows: FleetRows, states: States, prior: FaultPrior, spread: ModelSpread, residual: Array
) -> tuple[Array, Array]:
    """Expected deviation of each vehicle (N, S, 5K), and its covariance (N, S, 5K, 5K)."""
    covariance = spread.covariance
    precision = np.linalg.inv(rows.dispersed(spread.dispersion)[0] + covariance)
    gain = covariance @ precision
    left = spread.mean + np.einsum("nab,nsb->nsa", gain, residual - spread.mean)
    hidden = covariance - gain @ covariance
    return left, hidden[:, None] + _hidden_by_parameters(states, residual.shape[1], prior, precision, gain)


def _next_dispersion(rows: FleetRows, states: States, prior: FaultPrior, spread: ModelSpread, residual: Array) -> Array:
    """1 and the expected square of what intercepts err more than blocks tell, over what these tell; usual vehicles."""
    K, used = rows.branches, residual.shape[1]
    b = slice(3 * K - 1, 4 * K - 1)
    weight = states.weight[:, :used] * ~states.outlier[:, :used]
    whole, added = rows.dispersed(spread.dispersion)
    precision = np.linalg.inv(whole + spread.covariance)
    gain = added @ precision[:, b]
    error = np.einsum("nab,nsb->nsa", gain, residual - spread.mean)
    hidden = (added - gain[:, :, b] @ added)[:, None] + _hidden_by_parameters(states, used, prior, precision, gain)
    stated = np.diagonal(rows.intercept_covariance(), axis1=1, axis2=2)[:, None]
    more = (error**2 + np.diagonal(hidden, axis1=2, axis2=3)) / stated
    guess = SPREAD_VEHICLES * (GUESSED_DISPERSION - 1.0)
    return np.asarray(1.0 + (np.einsum("ns,nsk->k", weight, more) + guess) / (weight.sum() + SPREAD_VEHICLES))


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


def _guessed_spread(rows: FleetRows) -> Array:
    """Covariance of the model spread before anything is known: a multiple of the usual sampling covariance."""
    informed = np.zeros(5 * rows.branches, bool)
    informed[_informed_rows(rows.branches)] = True
    told = np.diagonal(rows.covariance, axis1=1, axis2=2) < UNKNOWN_VARIANCE / 2.0
    variance = np.ones(len(informed))
    sharp = rows.covariance.copy()
    intercepts = slice(3 * rows.branches - 1, 4 * rows.branches - 1)
    sharp[:, intercepts, intercepts] = rows.intercept_covariance()
    for row in np.flatnonzero(informed & told.any(axis=0)):
        variance[row] = np.median(sharp[told[:, row], row, row])
    return np.diag(np.where(informed, SPREAD_OVER_SAMPLING**2 * variance, 0.0))


def _residuals(rows: FleetRows, states: States, used: int, mean: Array) -> Array:
    """Rows less what each state explains of them, shape (N, S, 5K); ``mean`` is the fleet's centre so far."""
    K = rows.branches
    relative, constant = states.relative[:, :used], states.constant[:, :used].copy()
    factor = 1.0 + relative[:, :, 1:]
    constant[:, :, K - 1 :] /= factor
    first = rows.relative[:, None] - np.log1p(relative) @ relative_design(K).T
    seen = rows.constant_seen(relative, first - mean[: first.shape[2]])
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


def free_centres(branches: int) -> Array:
    """Rows whose centre the fleet tells, shape (5K,): slopes, intercepts and junction constant."""
    K = branches
    free = np.zeros(5 * K, bool)
    free[:K], free[3 * K - 1 : 4 * K] = True, True
    return free


def _least_spread(branches: int) -> Array:
    return np.repeat(LEAST_SPREAD, [3 * branches - 1, 2 * branches + 1])
