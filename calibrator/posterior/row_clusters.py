"""Clusters of vehicles that agree in a row of the evidence, and what is said where there are none, or two."""

from collections.abc import Sequence

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.cluster import Cluster, densest_clusters
from calibrator.evidence.rows import FleetRows
from calibrator.posterior.slab import FAULTS_RANGE
from calibrator.posterior.spread_rows import told_rows

__all__ = [
    "LEAST_AGREEING",
    "LEAST_SHARE",
    "MOST_SPREAD",
    "agrees",
    "centre_sd",
    "no_cluster",
    "row_clusters",
    "row_sd",
    "second_clusters",
]

LEAST_AGREEING = 5
"""Vehicles that must agree for their centre to be trusted."""
LEAST_SHARE, LEAST_GAIN, MOST_SPREAD = 0.15, 3.0, 0.03
"""Share of the fleet and log likelihood over no cluster that a cluster of slopes needs, and its largest spread. [1]"""
ALIKE = 0.25
"""Relative difference up to which distances of second clusters count as one. [1]"""
SECOND_SHARE, SECOND_GAIN, SECOND_DISTANCE = 0.15, 5.0, 4.0
"""Share, gain, and distance over its spread, of a second cluster that is taken for another variant. [1]"""


def row_sd(rows: FleetRows, row: int) -> Array:
    """Standard deviation of a row, vehicle by vehicle, shape (N,)."""
    return np.sqrt(rows.covariance[:, row, row])


def row_clusters(rows: FleetRows, row: int) -> list[Cluster]:
    """The two densest clusters of a relative row among the vehicles that tell it."""
    told = told_rows(rows)[:, row]
    if not told.any():
        return []
    return densest_clusters(rows.relative[told, row], row_sd(rows, row)[told], most=2, widest=FAULTS_RANGE)


def centre_sd(cluster: Cluster, sd: Array) -> float:
    """Standard deviation of a cluster's centre."""
    members = max(cluster.share * len(sd), 1.0)
    return float(np.sqrt((cluster.spread**2 + np.median(sd) ** 2) / members))


def agrees(cluster: Cluster) -> bool:
    """Whether vehicles agree in a cluster of slopes, or merely lie near each other by chance."""
    if cluster.share >= 1.0 - LEAST_SHARE:
        return True
    return cluster.share >= LEAST_SHARE and cluster.gain >= LEAST_GAIN and cluster.spread <= MOST_SPREAD


def no_cluster(
    slopes: Sequence[Sequence[Cluster]], branches: Sequence[str], doubtful: set[int], vehicles: int, advice: str
) -> list[str]:
    """Branches in which no two vehicles agree."""
    texts = []
    for k, found in enumerate(slopes):
        if vehicles > LEAST_AGREEING and not (found and agrees(found[0])):
            doubtful.add(k)
            texts.append(
                f"no cluster of vehicles agrees in branch {branches[k]}: every sensor of it may be faulty, or its "
                f"inputs do not tell its current (model_inputs of the layout; a branch that hardly ran); {advice}"
            )
    return texts


def second_clusters(slopes: Sequence[Sequence[Cluster]], branches: Sequence[str], vehicles: int) -> list[str]:
    """A second cluster: another variant of the vehicle if it is in all branches, else a batch of sensors."""
    apart = {k: found for k, found in enumerate(slopes) if len(found) > 1 and _is_apart(found[0], found[1])}
    if not apart:
        return []
    distances = np.abs([second.centre - first.centre for first, second in apart.values()])
    count = round(min(second.share for _, second in apart.values()) * vehicles)
    if len(apart) == len(slopes) and np.ptp(distances) <= ALIKE * distances.max():
        return [
            f"about {count} vehicles form a second cluster, {distances.mean():.1%} apart in all currents: two variants "
            f"of the vehicle? calibrate them apart"
        ]
    names = ", ".join(branches[k] for k in apart)
    return [
        f"about {count} vehicles form a second cluster, {distances.mean():.1%} apart in branch {names}: a batch of "
        f"sensors, or a variant of the vehicle?"
    ]


def _is_apart(first: Cluster, second: Cluster) -> bool:
    """Whether a second cluster is one of its own, not the flank of the first or of the background."""
    distance = abs(second.centre - first.centre)
    return (
        second.share >= SECOND_SHARE
        and second.gain >= SECOND_GAIN
        and distance >= SECOND_DISTANCE * max(first.spread, second.spread)
    )
