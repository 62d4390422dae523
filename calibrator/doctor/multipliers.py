"""Which sign or unit of which branch is wrong: the multipliers that make the junction sum least.

With x_k the band of the current of branch k and m_k = +-10^n, the sum V = mean (sum_k m_k x_k)^2 should be small
beside N = sum_k m_k^2 mean x_k^2. Both scale alike, so the ratio V / N tells nothing of a factor that all branches
share, and nothing of a sign that all share; what else is known of the branches must tell those. The search tries to
change one branch, or two at a time, as long as V / N falls by much more than chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from calibrator.doctor.bands import Bands
from calibrator.drive import Array

__all__ = ["Explanation", "Known", "explanations"]

FACTORS = (1.0, 1e-1, 1e-2, 1e-3, 1e1, 1e2, 1e3)
"""Slips of units and scales. [1]"""
LEAST_RATIO = 1e-4
"""V / N below this is as good as nothing: sensors are not better than 1 %. [1]"""
CHANGE_PRICE = 0.7
"""Each branch that is changed must halve V / N: its variation must then be above that of the sum's rest. [1]"""
UNIT_PRICE = 0.3
"""What a slip of a unit costs beyond a wrong sign: where both explain the same, the sign is wrong. [1]"""
RIVAL_PRICE = 1.5 * CHANGE_PRICE
"""An explanation that costs less than this beyond the best one is a rival: one change for next to nothing. [1]"""
PLAUSIBLE_PRICE = 2.0
"""For each branch whose current would be beyond what the layout calls full scale, or almost nothing of it. [1]"""
ORIENTATION_PRICE = 1.5
"""For energy that would flow into a battery while its voltage falls: more than for one more change. [1]"""
LARGEST_SHARE, LEAST_SHARE = 1.2, 0.002
"""Of full scale: beyond it, and almost nothing of it for the greatest current. [1]"""
SURE = 3.0
"""So many standard errors, from block to block of time, a change must make the sum smaller. [1]"""
OVERWHELMING = 3.0
"""A price lower by this: V / N falls twentyfold, as where a branch that is rarely used drowns all others. [1]"""
FEWEST_BLOCKS = 4
"""Fewer give no standard error worth the name: half a minute."""


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """One set of multipliers.

    Attributes
    ----------
    multipliers : ndarray of shape (K,)
        +-10^n per branch; 1 where nothing is wrong. [1]
    price : float
        Logarithm of V / N, and what is held against these multipliers. [1]
    """

    multipliers: Array
    price: float

    @property
    def changed(self) -> tuple[int, ...]:
        """Numbers of the branches that are not as the layout has them."""
        return tuple(int(k) for k in np.flatnonzero(self.multipliers != 1.0))


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known of the branches besides their sum.

    Attributes
    ----------
    peak_share : ndarray of shape (K,)
        Greatest magnitude of each current, as a share of full scale. [1]
    source : int or None
        Number of the branch that feeds the others: the battery.
    orientation : float
        Evidence, from -1 to 1, that its sign is right as the layout has it (1) or inverted (-1). [1]
    """

    peak_share: Array
    source: int | None = None
    orientation: float = 0.0


@dataclass(frozen=True, kw_only=True)
class _Evidence:
    moments: Array
    known: Known

    def price(self, multipliers: Array) -> float:
        total = self.moments.sum(axis=0)
        power = float(multipliers**2 @ np.diagonal(total))
        ratio = float(multipliers @ total @ multipliers) / power if power > 0.0 else 1.0
        share = np.abs(multipliers) * self.known.peak_share
        implausible = int(np.sum(share > LARGEST_SHARE)) + int(share.max() < LEAST_SHARE)
        against = 0.0
        if self.known.source is not None:
            against = max(-float(np.sign(multipliers[self.known.source])) * self.known.orientation, 0.0)
        return (
            float(np.log(max(ratio, LEAST_RATIO)))
            + CHANGE_PRICE * _changes(multipliers)
            + UNIT_PRICE * int(np.sum(np.abs(multipliers) != 1.0))
            + PLAUSIBLE_PRICE * implausible
            + ORIENTATION_PRICE * against
        )

    def is_sure(self, before: Array, after: Array) -> bool:
        """Whether the sum gets far smaller, or does so in one block of time after the other."""
        if len(self.moments) >= FEWEST_BLOCKS and self.price(before) - self.price(after) > OVERWHELMING:
            return True
        gain = np.log(_ratios(self.moments, before) / _ratios(self.moments, after))
        if len(gain) < FEWEST_BLOCKS:
            return False
        return bool(gain.mean() > SURE * gain.std(ddof=1) / np.sqrt(len(gain)))


def explanations(bands: Bands, known: Known, *, factors: Sequence[float] = FACTORS) -> list[Explanation]:
    """Find what would explain the junction sum best, and what else would as well.

    Parameters
    ----------
    bands : Bands
        Currents of the K branches.
    known : Known
        What else is known of them.
    factors : sequence of float
        Magnitudes to try, 1 first; (1,) looks for signs alone. [1]

    Returns
    -------
    list of Explanation
        The best one first, and after it those of one more or less changed branch that are nearly as good.
    """
    count = len(bands.branches)
    evidence = _Evidence(moments=bands.moments, known=known)
    best = _rated(evidence, np.ones(count))
    while True:
        found = min((_rated(evidence, tried) for tried in _neighbours(best.multipliers, factors)), key=_price)
        if found.price >= best.price - 1e-9 or not (
            evidence.is_sure(best.multipliers, found.multipliers) or _only_turned(best, found)
        ):
            break
        best = found
    rivals = [_rated(evidence, tried) for tried in _neighbours(best.multipliers, factors)]
    rivals.append(_rated(evidence, -best.multipliers))
    near = sorted((r for r in rivals if r.price < best.price + RIVAL_PRICE), key=_price)
    different = {tuple(r.multipliers.tolist()): r for r in reversed(near)}
    different.pop(tuple(best.multipliers.tolist()), None)
    return [best, *sorted(different.values(), key=_price)]


def _rated(evidence: _Evidence, multipliers: Array) -> Explanation:
    return Explanation(multipliers=multipliers, price=evidence.price(multipliers))


def _price(explanation: Explanation) -> float:
    return explanation.price


def _neighbours(multipliers: Array, factors: Sequence[float]) -> list[Array]:
    """Multipliers that differ in one branch or two, and those with all signs turned."""
    alternatives = [sign * factor for sign, factor in product((1.0, -1.0), factors)]
    found: list[Array] = [-multipliers]
    for size in (1, 2):
        for group in combinations(range(len(multipliers)), min(size, len(multipliers))):
            for values in product(alternatives, repeat=len(group)):
                tried = multipliers.copy()
                tried[list(group)] = values
                found.append(tried)
    return found


def _changes(multipliers: Array) -> int:
    """How many branches are changed; all signs turned together count as one change."""
    return int(min(np.sum(multipliers != 1.0), 1 + np.sum(multipliers != -1.0)))


def _only_turned(before: Explanation, after: Explanation) -> bool:
    """Whether two explanations differ in one common sign, of which the sum tells nothing."""
    return bool(np.allclose(before.multipliers, -after.multipliers))


def _ratios(moments: Array, multipliers: Array) -> Array:
    """V / N of each block."""
    power = np.einsum("bkk,k->b", moments, multipliers**2)
    values = np.einsum("bij,i,j->b", moments, multipliers, multipliers)
    ratio = np.divide(values, power, out=np.ones(len(moments)), where=power > 0.0)
    return np.asarray(np.maximum(ratio, LEAST_RATIO))
