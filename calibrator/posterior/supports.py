"""Supports: which fault parameters are not zero, and which of them the rows leave open.

Relative parameters are (d_h, d_1 .. d_K), constant ones (o_h,1 .. o_h,K-1, o_1 .. o_K). If all relative parameters are
there, a common factor can move from d_h to the drifts unseen. If o_h,k and o_k are there, an offset can move from one
to the other unseen, as long as the hardware offsets still sum to zero. One hardware parameter of each such direction is
the pivot: its value is taken from the nodes of the slab, the others follow.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

__all__ = ["EXACT_BRANCHES", "Support", "constant_supports", "log_support_counts", "relative_supports"]

EXACT_BRANCHES = 3
"""Up to so many branches all supports are looked at."""
MOST_ACTIVE = {4: 4, 5: 3}
"""Most nonzero parameters of each kind that are looked at, by number of branches above that."""
MOST_ACTIVE_BEYOND = 2


@dataclass(frozen=True)
class Support:
    """One support of one kind of parameters.

    Attributes
    ----------
    active : tuple of int
        Positions of the parameters that are not zero.
    pivots : tuple of int
        Those of them whose value the rows leave open.
    hardware : bool
        Whether a hardware parameter is among them.
    """

    active: tuple[int, ...]
    pivots: tuple[int, ...]
    hardware: bool

    @property
    def fitted(self) -> tuple[int, ...]:
        """Active parameters that the rows determine."""
        return tuple(i for i in self.active if i not in self.pivots)


def relative_supports(branches: int) -> list[Support]:
    """Supports of (d_h, d_1 .. d_K)."""
    found = []
    for active in _subsets(branches + 1, _most_active(branches)):
        everything = len(active) == branches + 1
        found.append(Support(active, (0,) if everything else (), 0 in active))
    return found


def constant_supports(branches: int) -> list[Support]:
    """Supports of (o_h,1 .. o_h,K-1, o_1 .. o_K)."""
    K = branches
    found = []
    for active in _subsets(2 * K - 1, _most_active(K)):
        both = [k for k in range(K - 1) if k in active and K - 1 + k in active]
        last_sensor = 2 * K - 2 in active
        pivots = both if last_sensor else both[1:]
        found.append(Support(active, tuple(pivots), any(i < K - 1 for i in active)))
    return found


def log_support_counts(branches: int) -> NDArray[np.float64]:
    """Logarithm of how many supports there are, shape (2, 3K + 1): by hardware fault, and number of parameters."""
    counts = np.zeros((2, 3 * branches + 1))
    constants = constant_supports(branches)
    for relative in relative_supports(branches):
        for constant in constants:
            hardware = relative.hardware or constant.hardware
            counts[int(hardware), len(relative.active) + len(constant.active)] += 1
    with np.errstate(divide="ignore"):
        return np.log(counts)


def _most_active(branches: int) -> int:
    if branches <= EXACT_BRANCHES:
        return 2 * branches
    return MOST_ACTIVE.get(branches, MOST_ACTIVE_BEYOND)


def _subsets(size: int, most: int) -> Iterator[tuple[int, ...]]:
    for count in range(min(size, most) + 1):
        yield from combinations(range(size), count)
