"""Prior of the faults of a fleet: how many a vehicle has, how large they are, and what several vehicles share.

Sizes are uniform between two bounds (a slab), with a log-uniform part over a far wider range, so that no size is
impossible. The number n of the 3K parameters that are not zero follows (20) of [1]_; in some vehicles all hardware
parameters are zero, (M13) of docs/method.md. Bounds, tail and numbers are learned from the fleet:
:mod:`calibrator.estimator.learning`. The feeding branch is the one with the largest mean current, mostly the battery.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass, field
from math import comb

import numpy as np

from calibrator.drive import Array

__all__ = ["GRID", "LARGEST_SHARED", "Prior", "Slab", "first_prior", "known_prior", "sparse_counts"]

GRID: Array = np.geomspace(1e-4, 4.0, 500)
"""Magnitudes at which densities are tabulated: drifts [1], offsets and loads in fractions of full scale."""
TAIL_RANGE = (0.002, 1.5)
"""Range of the log-uniform tail: from the resolution of sensors to faults that no layout would correct. [1]"""
LOAD_RANGE = (0.002, 0.04)
"""Range of a load without a sensor in one vehicle, in fractions of full scale: from the resolution of the junction's
sum to some kW, the largest consumer that is fitted to single vehicles. [1]"""
LARGEST_SHARED = 0.08
"""Largest offset or load that vehicles share, in fractions of full scale: larger ones stop a vehicle. It is more than
one vehicle's load (:data:`LOAD_RANGE`), as sensors of a batch can be off by more than such a consumer takes. [1]"""
EDGE = 0.03
"""Relative width of the edges of a slab, so that its evidence is smooth in its bounds. [1]"""
GUESSED_LOAD_SHARE = 0.01
"""Share of vehicles that have their own load without a sensor, before anything is known. [1]"""
GUESS_WEIGHT = 2.0
"""The guessed distribution of the number of faults counts as much as this many vehicles. [1]"""


@dataclass(frozen=True, kw_only=True)
class Slab:
    """Probability density of the size of a fault: uniform between two bounds, plus a log-uniform tail of any size.

    Attributes
    ----------
    low, high : float
        Most probable bounds: of drifts [1], or of offsets in fractions of full scale.
    tail : float
        Share of faults whose size is in the log-uniform tail. [1]
    density : ndarray of shape (G,)
        Density at each size of :data:`GRID`; may be a mean over the bounds and tails that the fleet leaves possible.
    """

    low: float
    high: float
    tail: float
    density: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not self.density.size:
            uniform = uniform_density(np.array([self.low]), np.array([self.high]))[:, 0]
            object.__setattr__(self, "density", (1.0 - self.tail) * uniform + self.tail * TAIL_DENSITY)

    @property
    def smallest(self) -> float:
        """Size that 97 % of the faults exceed."""
        return float(np.interp(0.03, np.cumsum(self.density * np.gradient(GRID)), GRID))


@dataclass(frozen=True, kw_only=True)
class Prior:
    """How faults are distributed over a fleet with K branches.

    Attributes
    ----------
    counts : ndarray of shape (K + 1, 2K + 1)
        Joint probability of how many of the K parameters of the hardware (rows) and of the 2K drifts and offsets of
        sensors (columns) are not zero; all choices (supports) of as many are equally likely.
    gain, offset : Slab
        Sizes of drifts, and of offsets.
    load_share : float
        Share of vehicles that have their own load without a sensor; its size is log-uniform in :data:`LOAD_RANGE`. [1]
    group_share, group_centre, group_sd : ndarray of shape (g,)
        Groups of vehicles that share a constant of the feeding branch, a load or an offset of its sensor: share of
        the fleet [1], centre and standard deviation in fractions of full scale.
    """

    counts: Array
    gain: Slab
    offset: Slab
    load_share: float = GUESSED_LOAD_SHARE
    group_share: Array = field(default_factory=lambda: np.zeros(0))
    group_centre: Array = field(default_factory=lambda: np.zeros(0))
    group_sd: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def branches(self) -> int:
        """Number of branches K."""
        return len(self.counts) - 1

    @property
    def log_density(self) -> Array:
        """Logarithm of the density of drifts, offsets and loads at :data:`GRID`, shape (3, G)."""
        return np.log(np.stack([self.gain.density, self.offset.density, LOAD_DENSITY]))

    @property
    def log_supports(self) -> Array:
        """Logarithm of the probability of one support with h hardware and s sensor faults at [h, s], as ``counts``."""
        K = self.branches
        ways = np.outer([comb(K, h) for h in range(K + 1)], [comb(2 * K, s) for s in range(2 * K + 1)])
        return np.asarray(np.log(np.maximum(self.counts / ways, 1e-300)))


def uniform_density(low: Array, high: Array) -> Array:
    """Return S densities at :data:`GRID`, each uniform from its low to its high with soft edges, shape (G, S)."""
    x = np.log(GRID)[:, None]
    rise, fall = np.clip((x - np.log(low)) / EDGE, -50.0, 50.0), np.clip((x - np.log(high)) / EDGE, -50.0, 50.0)
    density = 1.0 / (1.0 + np.exp(-rise)) / (1.0 + np.exp(fall))
    return np.asarray(density / np.trapezoid(density, GRID, axis=0))


def _log_uniform(low: float, high: float) -> Array:
    density = np.where((low < GRID) & (high > GRID), 1.0 / GRID, 1e-6)
    return np.asarray(density / np.trapezoid(density, GRID))


TAIL_DENSITY, LOAD_DENSITY = _log_uniform(*TAIL_RANGE), _log_uniform(*LOAD_RANGE)


def first_prior(branches: int) -> Prior:
    """Make the prior to begin with, before anything is known of a fleet: few faults, of any size."""
    n = np.arange(3 * branches + 1)
    total = np.array([comb(3 * branches, i) for i in n]) * 0.2**n * 0.8 ** (3 * branches - n)
    counts = np.einsum("n,znhs->hs", total, _sparse(branches)) / 2.0
    slab = Slab(low=0.01, high=0.6, tail=0.03)
    return Prior(counts=counts, gain=slab, offset=slab)


def known_prior(counts: Array, magnitude: tuple[float, float]) -> Prior:
    """Make the prior of a fleet whose faults were drawn at random in a known way.

    Parameters
    ----------
    counts : ndarray of shape (K + 1, 2K + 1)
        Probabilities of the numbers of faults, see :class:`Prior`. [1]
    magnitude : (float, float)
        Smallest and largest magnitude of a drift [1], and of an offset in fractions of full scale.
    """
    slab = Slab(low=magnitude[0], high=magnitude[1], tail=1e-6)
    return Prior(counts=counts + 1e-9, gain=slab, offset=slab, load_share=1e-9)


def _sparse(K: int) -> Array:
    """Return the probability of h hardware and s sensor faults if n parameters are drawn, at [z, n, h, s].

    With z = 0 all choices of n of the 3K parameters are equally likely; with z = 1, too, but hardware parameters that
    are drawn are then set to zero. Shape (2, 3K + 1, K + 1, 2K + 1).
    """
    given = np.zeros((2, 3 * K + 1, K + 1, 2 * K + 1))
    for h in range(K + 1):
        for s in range(2 * K + 1):
            given[0, h + s, h, s] = comb(K, h) * comb(2 * K, s) / comb(3 * K, h + s)
    given[1, :, 0] = given[0].sum(axis=1)
    return given


def sparse_counts(tally: Array) -> Array:
    """Fit the most probable distribution of sparse faults to a fleet by expectation maximisation.

    Equation (M13) of docs/method.md.

    Parameters
    ----------
    tally : ndarray of shape (K + 1, 2K + 1)
        Expected number of vehicles with each number of hardware faults (rows) and of sensor faults (columns).

    Returns
    -------
    ndarray of shape (K + 1, 2K + 1)
        Probabilities of these numbers. The distribution of the total number n of faults is free, but pulled towards a
        binomial one; a share of the vehicles has no hardware faults.
    """
    K, N = len(tally) - 1, float(tally.sum())
    given, n = _sparse(K), np.arange(3 * K + 1)
    ways = np.array([comb(3 * K, i) for i in n])
    total, sound, each = np.full(3 * K + 1, 1.0 / (3 * K + 1)), 0.5, 0.25
    for _ in range(30):
        joint = np.array([1.0 - sound, sound])[:, None, None, None] * total[:, None, None] * given
        share = joint / np.maximum(joint.sum(axis=(0, 1)), 1e-300) * tally
        guess = ways * each**n * (1.0 - each) ** (3 * K - n)
        total = (share.sum(axis=(0, 2, 3)) + GUESS_WEIGHT * guess) / (N + GUESS_WEIGHT)
        sound = (share[1].sum() + 0.5) / (N + 1.0)
        each = (N * float(total @ n) + 0.5 * K) / (3.0 * K * N + 2.0 * K)
    return np.asarray(np.array([1.0 - sound, sound]) @ np.einsum("n,znhs->zhs", total, given).reshape(2, -1)).reshape(
        tally.shape
    )
