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

from calibrator.drive import Array, Mask
from calibrator.evidence.cluster import Cluster, densest_clusters
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows
from calibrator.posterior.slab import FAULTS_RANGE
from calibrator.posterior.spread_starts import FEWEST_TRUSTED
from calibrator.posterior.unmeasured_load import MOST_UNMEASURED, unmeasured_load
from ecu_node.layout import UnmeasuredLoad

__all__ = ["ReferenceHealth", "examine_reference"]

LEAST_AGREEING = 5
"""Vehicles that must agree for their centre to be trusted."""
LEAST_SHARE, LEAST_GAIN, MOST_SPREAD = 0.15, 3.0, 0.03
"""Share of the fleet and log likelihood over no cluster that a cluster of slopes needs, and its largest spread. [1]"""
SURE = 4.0
"""Standard deviations from which on a centre is off. [1]"""
LEAST_COMMON_GAIN, LEAST_COMMON_OFFSET = 0.003, 0.001
"""Smallest common error that matters: gains, offsets in fractions of full scale. [1]"""
HALF = 0.7
"""Size over that of the largest cluster from which on another one is about as large. [1]"""
ALIKE = 0.25
"""Relative difference up to which distances of second clusters count as one. [1]"""
SECOND_SHARE, SECOND_GAIN, SECOND_DISTANCE = 0.15, 5.0, 4.0
"""Share, gain, and distance over its spread, of a second cluster that is taken for another variant. [1]"""


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
    slopes = [_cluster(rows, k) for k in range(K)]
    share = [found[0].share if found else 0.0 for found in slopes]
    distance = [
        float(np.mean(rows.relative[:, k])) - (found[0].centre if found else 0.0) for k, found in enumerate(slopes)
    ]
    warnings, doubtful = _common_gains(rows, branches, advice)
    warnings += _no_cluster(slopes, branches, doubtful, len(rows), advice)
    warnings += _second_clusters(slopes, branches, len(rows))
    least = ceil(LEAST_AGREEING / max(min(share), 1.0 / 1000.0))
    if len(rows) < least:
        doubtful = set(range(K))
        warnings.append(
            f"{len(rows)} vehicles are few for a fleet in which {min(share):.0%} agree: at least {least} are needed "
            f"to trust its reference; {advice}"
        )
    warnings += _common_offset(rows, doubtful, full_scale_a, load, advice)
    texts, unmeasured_a = _load(rows, full_scale_a, load_in_use_a, carried=bool(carried))
    warnings += [] if load is not None else texts
    return ReferenceHealth(
        agreeing_share=tuple(found[0].share if found and found[0].spread <= MOST_SPREAD else 0.0 for found in slopes),
        mean_distance=tuple(distance),
        least_vehicles=least,
        unmeasured_a=unmeasured_a if load is None else load.mean_a,
        doubtful=tuple(sorted(doubtful - carried)),
        warnings=tuple(warnings),
    )


def _load(rows: FleetRows, full_scale_a: float, in_use_a: float | None, *, carried: bool) -> tuple[list[str], float]:
    """What most vehicles' currents sum to where a load without a sensor can make it, and the load that is taken. [A]"""
    sd = _sd(rows, 4 * rows.branches - 1)
    found = unmeasured_load(rows.constant[:, rows.branches], sd)
    most_a = found.centre * full_scale_a
    taken_a = most_a if in_use_a is None else in_use_a
    doubt_a = max(LEAST_COMMON_OFFSET, SURE * _uncertainty(found, sd)) * full_scale_a
    texts = []
    if carried and abs(most_a - taken_a) > doubt_a:
        texts.append(
            f"the currents of most vehicles sum to {most_a:+.1f} A, those of the trusted ones to {taken_a:+.1f} A: the "
            f"rest is an offset that most vehicles share"
        )
    elif abs(most_a) > doubt_a:
        texts.append(
            f"the currents of most vehicles sum to {most_a:+.1f} A: a load without a sensor, as is taken here, or an "
            f"offset that most vehicles share; if the load is known, declare it (docs/method.md)"
        )
    return texts, taken_a


def _carried(rows: FleetRows, trusted: Mask | None) -> set[int]:
    """Branches whose slope is told by enough trusted vehicles."""
    if trusted is None:
        return set()
    return {k for k in range(rows.branches) if np.count_nonzero(_told(rows, k)[trusted]) >= FEWEST_TRUSTED}


def _advice(carried: set[int], branches: int) -> str:
    if len(carried) == branches:
        return "the trusted vehicles carry the reference instead"
    more = "more " if carried else ""
    return f"name {more}bench-checked vehicles with --trusted, at least {FEWEST_TRUSTED} that use each branch"


def _common_offset(
    rows: FleetRows, doubtful: set[int], full_scale_a: float, load: UnmeasuredLoad | None, advice: str
) -> list[str]:
    """A constant of the junction law that most vehicles share and no load without a sensor makes."""
    K = rows.branches
    sd = _sd(rows, 4 * K - 1)
    found = densest_clusters(rows.constant[:, K], sd, widest=FAULTS_RANGE)[0]
    doubt = max(LEAST_COMMON_OFFSET, SURE * _uncertainty(found, sd))
    lowest, highest = (0.0, MOST_UNMEASURED) if load is None else (load.mean_a / full_scale_a,) * 2
    if lowest - doubt <= found.centre <= highest + doubt or not _agree(found):
        return []
    expected = (
        "no load without a sensor explains"
        if load is None
        else f"the declared load of {load.mean_a:g} A does not explain"
    )
    doubtful.update(range(K))
    return [
        f"the currents of most vehicles sum to {found.centre * full_scale_a:+.1f} A, which {expected}: an offset that "
        f"most vehicles share (a batch of sensors), in any branch; {advice}"
    ]


def _sd(rows: FleetRows, row: int) -> Array:
    return np.sqrt(rows.covariance[:, row, row])


def _told(rows: FleetRows, row: int) -> Array:
    return np.asarray(rows.covariance[:, row, row] < UNKNOWN_VARIANCE / 2.0)


def _cluster(rows: FleetRows, row: int) -> list[Cluster]:
    """The two densest clusters of a relative row among the vehicles that tell it."""
    told = _told(rows, row)
    if not told.any():
        return []
    return densest_clusters(rows.relative[told, row], _sd(rows, row)[told], most=2, widest=FAULTS_RANGE)


def _uncertainty(cluster: Cluster, sd: Array) -> float:
    """Standard deviation of a cluster's centre."""
    members = max(cluster.share * len(sd), 1.0)
    return float(np.sqrt((cluster.spread**2 + np.median(sd) ** 2) / members))


def _common_gains(rows: FleetRows, branches: Sequence[str], advice: str) -> tuple[list[str], set[int]]:
    """Gain ratios of the junction law whose cluster is not at 1: a gain fault that most vehicles share."""
    K = rows.branches
    off: dict[int, float] = {}
    for k in range(1, K):
        row = K + k - 1
        found = _cluster(rows, row)
        if found and found[0].share >= LEAST_SHARE and not _may_be_at_zero(found):
            doubt = SURE * _uncertainty(found[0], _sd(rows, row)[_told(rows, row)])
            if abs(found[0].centre) > max(LEAST_COMMON_GAIN, doubt):
                off[k] = found[0].centre
    if not off:
        return [], set()
    same = len(off) == K - 1 and np.ptp(list(off.values())) < LEAST_COMMON_GAIN + 0.1 * max(map(abs, off.values()))
    suspects = {0, *off} if K == 2 else {0} if same else set(off)
    names = " or ".join(branches[k] for k in sorted(suspects))
    size = max(off.values(), key=abs)
    text = (
        f"the reference breaks the junction law by {size:+.1%}: a gain fault that most vehicles share (a batch of "
        f"sensors), in branch {names}; {advice}"
    )
    return [text], suspects


def _may_be_at_zero(found: Sequence[Cluster]) -> bool:
    """Whether a second cluster obeys the junction law, and is about as large: then not most vehicles share a fault."""
    second = found[1] if len(found) > 1 else None
    return second is not None and abs(second.centre) <= LEAST_COMMON_GAIN and second.share >= HALF * found[0].share


def _no_cluster(
    slopes: Sequence[Sequence[Cluster]], branches: Sequence[str], doubtful: set[int], vehicles: int, advice: str
) -> list[str]:
    """Branches in which no two vehicles agree."""
    texts = []
    for k, found in enumerate(slopes):
        if vehicles > LEAST_AGREEING and not (found and _agree(found[0])):
            doubtful.add(k)
            texts.append(
                f"no cluster of vehicles agrees in branch {branches[k]}: every sensor of it may be faulty, or its "
                f"inputs do not tell its current (model_inputs of the layout; a branch that hardly ran); {advice}"
            )
    return texts


def _second_clusters(slopes: Sequence[Sequence[Cluster]], branches: Sequence[str], vehicles: int) -> list[str]:
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


def _agree(cluster: Cluster) -> bool:
    """Whether vehicles agree in a cluster of slopes, or merely lie near each other by chance."""
    if cluster.share >= 1.0 - LEAST_SHARE:
        return True
    return cluster.share >= LEAST_SHARE and cluster.gain >= LEAST_GAIN and cluster.spread <= MOST_SPREAD


def _is_apart(first: Cluster, second: Cluster) -> bool:
    """Whether a second cluster is one of its own, not the flank of the first or of the background."""
    distance = abs(second.centre - first.centre)
    return (
        second.share >= SECOND_SHARE
        and second.gain >= SECOND_GAIN
        and distance >= SECOND_DISTANCE * max(first.spread, second.spread)
    )
