"""Supports: which fault parameters are not zero.

Relative parameters are (d_h, d_1 .. d_K), constant ones (o_h,1 .. o_h,K-1, o_1 .. o_K).

There are 2^(K + 1) relative and 2^(2K - 1) constant supports. The former are always all looked at. The latter are up to
:data:`EXACT_BRANCHES`; with more branches those without hardware offsets and those of at most :data:`MOST_CONSTANT`
parameters are, and :mod:`calibrator.posterior.states` grows the best of them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain, combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "EXACT_BRANCHES",
    "MOST_CONSTANT",
    "Support",
    "constant_support",
    "constant_supports",
    "grown_supports",
    "log_support_counts",
    "relative_supports",
]

EXACT_BRANCHES = 3
"""Up to so many branches all supports are looked at."""
MOST_CONSTANT = 4
"""Nonzero constant parameters of the supports with hardware that are looked at, with more branches than that."""


@dataclass(frozen=True)
class Support:
    """One support of one kind of parameters.

    Attributes
    ----------
    active : tuple of int
        Positions of the parameters that are not zero, in rising order.
    hardware : bool
        Whether a hardware parameter is among them.
    """

    active: tuple[int, ...]
    hardware: bool


def relative_supports(branches: int) -> list[Support]:
    """All supports of (d_h, d_1 .. d_K), the smallest first."""
    size = branches + 1
    return [Support(active, 0 in active) for active in _subsets(range(size), range(size + 1))]


def constant_support(branches: int, active: Iterable[int]) -> Support:
    """Support of (o_h,1 .. o_h,K-1, o_1 .. o_K) with these parameters not zero."""
    chosen = tuple(sorted(active))
    return Support(chosen, any(i < branches - 1 for i in chosen))


def constant_supports(branches: int, *, most: int | None = None) -> list[Support]:
    """Supports of (o_h,1 .. o_h,K-1, o_1 .. o_K), the smallest first; with hardware, of at most so many parameters."""
    size = 2 * branches - 1
    limit = size if most is None else min(size, most)
    few = _subsets(range(size), range(limit + 1))
    sensors_only = _subsets(range(branches - 1, size), range(limit + 1, branches + 1))
    return [constant_support(branches, active) for active in chain(few, sensors_only)]


def grown_supports(branches: int, support: Iterable[int]) -> list[Support]:
    """Constant supports with one parameter more."""
    present = set(support)
    return [constant_support(branches, present | {i}) for i in range(2 * branches - 1) if i not in present]


def log_support_counts(branches: int) -> NDArray[np.float64]:
    """Logarithm of how many supports have so many hardware and sensor parameters, shape (K + 1, 2K + 1)."""
    hardware = [comb(branches, count) for count in range(branches + 1)]
    sensor = [comb(2 * branches, count) for count in range(2 * branches + 1)]
    return np.asarray(np.log(np.outer(hardware, sensor)))


def _subsets(items: Iterable[int], counts: Iterable[int]) -> Iterable[tuple[int, ...]]:
    pool = tuple(items)
    return chain.from_iterable(combinations(pool, count) for count in counts)
