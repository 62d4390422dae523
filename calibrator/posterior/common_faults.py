"""Faults that most vehicles of a fleet share: they break the junction law, which needs no reference."""

from collections.abc import Sequence

import numpy as np

from calibrator.evidence.cluster import Cluster, densest_clusters
from calibrator.evidence.rows import FleetRows
from calibrator.posterior.row_clusters import LEAST_SHARE, agrees, centre_sd, row_clusters, row_sd
from calibrator.posterior.slab import FAULTS_RANGE
from calibrator.posterior.spread_rows import told_rows
from calibrator.posterior.unmeasured_load import MOST_UNMEASURED, unmeasured_load
from ecu_node.layout import UnmeasuredLoad

__all__ = ["common_gains", "common_offset", "load_told"]

SURE = 4.0
"""Standard deviations from which on a centre is off. [1]"""
LEAST_COMMON_GAIN, LEAST_COMMON_OFFSET = 0.003, 0.001
"""Smallest common error that matters: gains, offsets in fractions of full scale. [1]"""
HALF = 0.7
"""Size over that of the largest cluster from which on another one is about as large. [1]"""


def common_gains(rows: FleetRows, branches: Sequence[str], advice: str) -> tuple[list[str], set[int]]:
    """Gain ratios of the junction law whose cluster is not at 1: a gain fault that most vehicles share."""
    K = rows.branches
    off: dict[int, float] = {}
    for k in range(1, K):
        row = K + k - 1
        found = row_clusters(rows, row)
        if found and found[0].share >= LEAST_SHARE and not _may_be_at_zero(found):
            doubt = SURE * centre_sd(found[0], row_sd(rows, row)[told_rows(rows)[:, row]])
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


def common_offset(
    rows: FleetRows, doubtful: set[int], full_scale_a: float, load: UnmeasuredLoad | None, advice: str
) -> list[str]:
    """A constant of the junction law that most vehicles share and no load without a sensor makes."""
    K = rows.branches
    sd = row_sd(rows, 4 * K - 1)
    found = densest_clusters(rows.constant[:, K], sd, widest=FAULTS_RANGE)[0]
    doubt = max(LEAST_COMMON_OFFSET, SURE * centre_sd(found, sd))
    lowest, highest = (0.0, MOST_UNMEASURED) if load is None else (load.mean_a / full_scale_a,) * 2
    if lowest - doubt <= found.centre <= highest + doubt or not agrees(found):
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


def load_told(
    rows: FleetRows, full_scale_a: float, in_use_a: float | None, *, carried: bool
) -> tuple[list[str], float]:
    """What most vehicles' currents sum to where a load without a sensor can make it, and the load that is taken. [A]"""
    sd = row_sd(rows, 4 * rows.branches - 1)
    found = unmeasured_load(rows.constant[:, rows.branches], sd)
    most_a = found.centre * full_scale_a
    taken_a = most_a if in_use_a is None else in_use_a
    doubt_a = max(LEAST_COMMON_OFFSET, SURE * centre_sd(found, sd)) * full_scale_a
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
