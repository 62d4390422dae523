"""Densest cluster of numbers, (M15) of docs/method.md: fault-free sensors agree with each other, faulty ones do not.

Values are taken as a mixture of one Gaussian cluster (centre c, spread s, each value with its own sampling error) and a
broad background. The most likely of a grid of centres and spreads is chosen. Unlike the mean and the median the result
does not need a symmetric fleet, nor that most vehicles are without faults.
"""

from dataclasses import dataclass

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
    """

    centre: float
    spread: float
    share: float


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
    extent, narrowest = float(np.ptp(values)), float(np.median(sd))
    if extent <= narrowest:
        return [Cluster(centre=float(np.median(near)), spread=0.0, share=1.0)]
    centres = np.unique(np.quantile(near, np.linspace(0.0, 1.0, min(len(near), MOST_CENTRES)), method="nearest"))
    spreads = np.geomspace(narrowest / 4.0, max(extent / 4.0, narrowest), SPREADS)
    wide, sd_wide = max(extent * (1.0 + 2.0 * MARGIN), widest), max(values.std(), widest / SD_OF_RANGE)
    background = 0.5 * norm.pdf(values, values.mean(), sd_wide) + 0.5 / wide  # half Gaussian, half uniform
    gain, share = np.empty((2, SPREADS, len(centres)))
    for s, spread in enumerate(spreads):
        variance = sd**2 + spread**2
        density = np.exp(-0.5 * (values - centres[:, None]) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
        kappa = np.full((len(centres), 1), 0.5)  # share of the cluster, by expectation maximisation
        for _ in range(SHARE_STEPS):
            inside = kappa * density
            kappa = np.mean(inside / (inside + (1.0 - kappa) * background), axis=1, keepdims=True)
        gain[s] = np.sum(np.log(kappa * density / background + (1.0 - kappa)), axis=1)
        share[s] = kappa[:, 0]
    clusters: list[Cluster] = []
    while len(clusters) < most and np.isfinite(gain).any():
        s, c = divmod(int(np.argmax(gain)), len(centres))
        variance = sd**2 + spreads[s] ** 2
        members = np.abs(values - centres[c]) <= 3.0 * np.sqrt(variance)
        centre = float(np.average(values, weights=members / variance))
        clusters.append(Cluster(centre=centre, spread=float(spreads[s]), share=float(share[s, c])))
        gain[:, np.abs(centres - centre) <= 3.0 * (spreads[s] + narrowest)] = -np.inf
    return clusters
