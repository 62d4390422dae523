"""Health of the fleet reference: can the vehicles that agree with each other be trusted to be right?

Vehicles without faults form a cluster. What would fool the reference shows elsewhere: a fault that most vehicles share
moves the clusters of the junction law, which needs no reference; two variants of a vehicle form two clusters; a branch
whose sensors are all faulty forms none.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Mask
from calibrator.evidence.rows import FleetRows
from calibrator.posterior.common_faults import common_gains, common_offset, load_told
from calibrator.posterior.row_clusters import LEAST_AGREEING, MOST_SPREAD, no_cluster, row_clusters, second_clusters
from calibrator.posterior.spread_rows import told_rows
from calibrator.posterior.spread_starts import FEWEST_TRUSTED
from ecu_node.layout import UnmeasuredLoad

__all__ = ["ReferenceHealth", "examine_reference"]


@dataclass(frozen=True, kw_only=True)
class ReferenceHealth:
    """What is known about the fleet reference.

    Attributes
    ----------
    agreeing_share : tuple of float
        Per branch: share of the vehicles in the densest cluster of slopes. [1]
    mean_distance : tuple of float
        Per branch: mean of the log slopes minus the cluster's; how far off the published reference (3) is. [1]
    least_vehicles : int
        Smallest fleet of this kind whose reference can be trusted.
    unmeasured_a : float
        Centre of the junction's constant: mean load that no branch measures. [A]
    doubtful : tuple of int
        Branches whose scale or zero the fleet may have wrong as a whole.
    warnings : tuple of str
        What would fool the reference, one text each.
    distrusted : mapping of int to str
        Vehicles that were called trusted and break the junction law, by position, and how.
    differing : tuple of int
        Trusted vehicles that differ from the others as by a hardware fault, and do not carry the reference.
    """

    agreeing_share: tuple[float, ...]
    mean_distance: tuple[float, ...]
    least_vehicles: int
    unmeasured_a: float
    doubtful: tuple[int, ...]
    warnings: tuple[str, ...]
    distrusted: Mapping[int, str] = field(default_factory=dict)
    differing: tuple[int, ...] = ()

    def of_positions(self, positions: NDArray[np.int64]) -> "ReferenceHealth":
        """Return the same for a fleet in which the vehicles learnt from have other positions."""
        return replace(
            self,
            distrusted={int(positions[j]): why for j, why in self.distrusted.items()},
            differing=tuple(positions[list(self.differing)].tolist()),
        )

    def in_order(self, place: NDArray[np.int64]) -> "ReferenceHealth":
        """Return the same for branches in another order: branch k is at position ``place[k]`` here."""
        return replace(
            self,
            agreeing_share=tuple(self.agreeing_share[p] for p in place),
            mean_distance=tuple(self.mean_distance[p] for p in place),
            doubtful=tuple(k for k, p in enumerate(place) if p in self.doubtful),
        )


def examine_reference(
    rows: FleetRows,
    branches: Sequence[str],
    *,
    full_scale_a: float,
    trusted: Mask | None = None,
    load: UnmeasuredLoad | None = None,
    load_in_use_a: float | None = None,
) -> ReferenceHealth:
    """Look for what would fool the reference.

    Parameters
    ----------
    rows : FleetRows
        Evidence of the fleet.
    branches : sequence of str
        Names of the K branches in the order of the rows.
    full_scale_a : float
        Full scale of the junction. [A]
    trusted : ndarray of bool of shape (N,) or None
        Vehicles that carry the reference of the branches that :data:`FEWEST_TRUSTED` of them tell.
    load : UnmeasuredLoad or None
        Load that no branch measures, if it is known.
    load_in_use_a : float or None
        Mean load that the posterior takes, as trusted vehicles may show another than most; None: that of most. [A]

    Returns
    -------
    ReferenceHealth
        With warnings in words.
    """
    K = rows.branches
    carried = _carried(rows, trusted)
    advice = _advice(carried, K)
    slopes = [row_clusters(rows, k) for k in range(K)]
    share = [found[0].share if found else 0.0 for found in slopes]
    distance = [
        float(np.mean(rows.relative[:, k])) - (found[0].centre if found else 0.0) for k, found in enumerate(slopes)
    ]
    warnings, doubtful = common_gains(rows, branches, advice)
    warnings += no_cluster(slopes, branches, doubtful, len(rows), advice)
    warnings += second_clusters(slopes, branches, len(rows))
    least = ceil(LEAST_AGREEING / max(min(share), 1.0 / 1000.0))
    if len(rows) < least:
        doubtful = set(range(K))
        warnings.append(
            f"{len(rows)} vehicles are few for a fleet in which {min(share):.0%} agree: at least {least} are needed "
            f"to trust its reference; {advice}"
        )
    warnings += common_offset(rows, doubtful, full_scale_a, load, advice)
    texts, unmeasured_a = load_told(rows, full_scale_a, load_in_use_a, carried=bool(carried))
    warnings += [] if load is not None else texts
    return ReferenceHealth(
        agreeing_share=tuple(found[0].share if found and found[0].spread <= MOST_SPREAD else 0.0 for found in slopes),
        mean_distance=tuple(distance),
        least_vehicles=least,
        unmeasured_a=unmeasured_a if load is None else load.mean_a,
        doubtful=tuple(sorted(doubtful - carried)),
        warnings=tuple(warnings),
    )


def _carried(rows: FleetRows, trusted: Mask | None) -> set[int]:
    """Branches whose slope is told by enough trusted vehicles."""
    if trusted is None:
        return set()
    return {k for k in range(rows.branches) if np.count_nonzero(told_rows(rows)[trusted, k]) >= FEWEST_TRUSTED}


def _advice(carried: set[int], branches: int) -> str:
    if len(carried) == branches:
        return "the trusted vehicles carry the reference instead"
    more = "more " if carried else ""
    return f"name {more}bench-checked vehicles with --trusted, at least {FEWEST_TRUSTED} that use each branch"
