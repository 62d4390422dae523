"""Stretches of time in which one branch stands still though the others move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Drive
from calibrator.drives.align import align_channels
from calibrator.errors import DriveError
from ecu_node.layout import Layout

__all__ = ["Stuck", "stuck_parts"]

LEAST_S = 10.0
"""A current that is not zero holds its exact value for seconds at most. [s]"""
LEAST_MOVE = 0.02
"""Of full scale, by which the others' sum must vary meanwhile. [1]"""
ROUNDING = 1e-9
"""Of full scale: what interpolation adds to values that are the same. [1]"""
LEAST_VALUE = 0.002
"""Of full scale; a branch may well stand at nothing. [1]"""


@dataclass(frozen=True, kw_only=True)
class Stuck:
    """One such stretch: of which branch, from when, how long, at what value, and how much the others varied."""

    branch: str
    start_s: float
    duration_s: float
    value_a: float
    others_a: float


def stuck_parts(drives: Sequence[Drive], layout: Layout, branches: Sequence[str]) -> list[Stuck]:
    """Find the longest such stretch of each branch.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle.
    layout : Layout
        Says period, time-outs and full scale.
    branches : sequence of str
        Names of at least two branches.

    Returns
    -------
    list of Stuck
        At most one per branch.
    """
    longest: dict[str, Stuck] = {}
    for drive in drives:
        for found in _of_drive(drive, layout, [name for name in branches if name in drive.branches]):
            if found.branch not in longest or found.duration_s > longest[found.branch].duration_s:
                longest[found.branch] = found
    return list(longest.values())


def _of_drive(drive: Drive, layout: Layout, branches: Sequence[str]) -> list[Stuck]:
    if len(branches) < 2:
        return []
    limits_s = {branch.name: branch.timeout_s for branch in layout.branch}
    channels = {name: drive.branches[name] for name in branches}
    try:
        time_s, values, _ = align_channels(channels, limits_s, period_s=layout.period_s, where=drive.name)
    except DriveError:
        return []
    total = np.sum([values[name] for name in branches], axis=0)
    found = [_longest(name, time_s, values[name], total - values[name], layout.full_scale_a) for name in branches]
    return [item for item in found if item is not None]


def _longest(name: str, time_s: Array, value: Array, others: Array, full_scale_a: float) -> Stuck | None:
    """The longest run of one value, if it is long and the others vary in it."""
    edges = np.flatnonzero(np.concatenate([[True], np.abs(np.diff(value)) > ROUNDING * full_scale_a, [True]]))
    if len(edges) < 3:
        return None  # it never changes, which is told by itself
    k = int(np.argmax(np.diff(edges)))
    start, stop = int(edges[k]), int(edges[k + 1])
    duration_s = float(time_s[stop - 1] - time_s[start])
    others_a = float(others[start:stop].std())
    is_stuck = (
        duration_s >= LEAST_S
        and others_a > LEAST_MOVE * full_scale_a
        and abs(value[start]) > LEAST_VALUE * full_scale_a
    )
    if not is_stuck:
        return None
    return Stuck(
        branch=name, start_s=float(time_s[start]), duration_s=duration_s, value_a=float(value[start]), others_a=others_a
    )
