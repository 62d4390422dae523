"""Densest cluster of numbers: fault-free sensors agree with each other, faulty ones do not.

Values are taken as a mixture of one Gaussian cluster (centre c, spread s, each value with its own sampling error) and a
broad background (half a Gaussian, half uniform). Of a grid of centres and spreads the most likely is chosen. Unlike the
mean and the median the result does not need a symmetric fleet, nor that most vehicles are without faults.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from calibrator.drive import Array

__all__ = ["Cluster", "densest_clusters"]

MOST_CENTRES = 200
SPREADS = 12
SHARE_STEPS = 8
MARGIN = 0.1
"""The background reaches beyond the values by this share of their range. [1]"""


SD_OF_RANGE = 9.0
"""Range of the background over the deviation of its Gaussian half, where faults say how wide it is. [1]"""


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """One cluster.

    Attributes
    ----------
    centre, spread : float
        Mean and standard deviation of its members, sampling error apart.
    share : float
        Share of the values in it. [1]
    gain : float
        Logarithm of its likelihood over that of the background alone.
    """

    centre: float
    spread: float
    share: float
    gain: float


def densest_clusters(
    values: Array, sd: Array, *, most: int = 1, farthest: float = np.inf, widest: float = 0.0
) -> list[Cluster]:
    """Find the most likely clusters, the best first; later ones lie apart from those before.

    Parameters
    ----------
    values, sd : ndarray of shape (N,)
        Values, and standard deviations of their sampling errors, positive.
    most : int
        Number of clusters wanted.
    farthest : float
        Largest magnitude of a centre.
    widest : float
        Range of what faults can make of the values: the background is at least as wide, so that values that all agree
        are a cluster too.

    Returns
    -------
    list of Cluster
        At least one, unless no value is near enough; fewer than wanted if there are not so many.
    """
    near = values[np.abs(values) <= farthest]
    if not near.size:
        return []
    centres = np.unique(np.quantile(near, np.linspace(0.0, 1.0, min(len(near), MOST_CENTRES)), method="nearest"))
    extent = float(np.ptp(values))
    narrowest = float(np.median(sd))
    if extent <= narrowest:
        return [Cluster(centre=float(np.median(near)), spread=0.0, share=1.0, gain=0.0)]
    spreads = np.geomspace(narrowest / 4.0, max(extent / 4.0, narrowest), SPREADS)
    wide, sd_wide = max(extent * (1.0 + 2.0 * MARGIN), widest), max(values.std(), widest / SD_OF_RANGE)
    background = 0.5 * norm.pdf(values, values.mean(), sd_wide) + 0.5 / wide
    found = [_at_spread(values, sd, centres, float(spread), background) for spread in spreads]
    gain = np.array([gain for gain, _ in found])
    share = np.array([share for _, share in found])
    clusters: list[Cluster] = []
    while len(clusters) < most and np.isfinite(gain).any():
        s, c = np.unravel_index(int(np.argmax(gain)), gain.shape)
        guess = Cluster(
            centre=float(centres[c]), spread=float(spreads[s]), share=float(share[s, c]), gain=float(gain[s, c])
        )
        clusters.append(_refined(guess, values, sd))
        apart = np.abs(centres - clusters[-1].centre) <= 3.0 * (spreads[s] + narrowest)
        gain[:, apart] = -np.inf
    return clusters


def _at_spread(values: Array, sd: Array, centres: Array, spread: float, background: Array) -> tuple[Array, Array]:
    """Gain and share of a cluster at each centre."""
    variance = sd**2 + spread**2
    density = np.exp(-0.5 * (values - centres[:, None]) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
    share = np.full((len(centres), 1), 0.5)
    for _ in range(SHARE_STEPS):
        inside = share * density
        share = np.mean(inside / (inside + (1.0 - share) * background), axis=1, keepdims=True)
    gain = np.sum(np.log(share * density / background + (1.0 - share)), axis=1)
    return gain, share[:, 0]


def _refined(cluster: Cluster, values: Array, sd: Array) -> Cluster:
    """The same cluster with the mean of its members as centre."""
    variance = sd**2 + cluster.spread**2
    weight = (np.abs(values - cluster.centre) <= 3.0 * np.sqrt(variance)) / variance
    return replace(cluster, centre=float(np.average(values, weights=weight)))
