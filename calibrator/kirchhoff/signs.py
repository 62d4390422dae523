"""Find wrong signs and units of some currents by their sum.

Means, slow changes and fast changes of the currents are filtered out first: otherwise offsets and loads without a
sensor would be taken for faults of a branch, and so would fast changes that come late. With x_k the filtered current
(band) of branch k and m_k = +-10^n, V = mean (sum_k m_k x_k)^2 should be small compared with
N = sum_k m_k^2 mean x_k^2. Both scale alike, so the ratio V / N shows neither a factor nor a sign that all branches
share; these must follow from something else that is known of the branches.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Channel
from calibrator.drives.charge import Band, charge_curve, covered

__all__ = ["SURE", "WELL_CORRELATED", "Bands", "bands_of", "likely_multipliers", "sag"]

BAND = Band(short_s=0.75, long_s=10.0)
"""Half widths of the moving averages: several times the delays of real cars, and as long as driving keeps its pace.
[s]"""
STEP_S = 0.25
"""Distance of the instants: a third of the shorter window. [s]"""
BLOCK_S = 10.0
"""Blocks count as independent: as long as the longer window reaches. [s]"""
FAST_S = 1.0
"""If frames are farther apart than this, all times above are longer by the same factor. [s]"""
FACTORS = (1.0, 1e-1, 1e-2, 1e-3, 1e1, 1e2, 1e3)
"""Factors by which units and scales may be wrong. [1]"""
LEAST_RATIO = 1e-4
"""V / N below this counts as this: sensors are not better than 1 %. [1]"""
SURE = 3.0
"""A change must make the sum smaller by this many standard errors, found from the blocks of time. [1]"""
OVERWHELMING = 3.0
"""A change that lowers the price by this (V / N to a twentieth) is made even if blocks differ, as where a rarely used
branch drowns all others. [1]"""
FEWEST_BLOCKS = 4
"""Fewer blocks, about half a minute, give no usable standard error."""
WELL_CORRELATED = 0.5
"""Correlation of battery current and voltage below which the sag of the voltage tells nothing. [1]"""


class Bands(NamedTuple):
    """Filtered currents of K branches [A], (T, K), positive into the junction; number of each instant's block, (T,)."""

    current_a: Array
    block: NDArray[np.intp]

    @property
    def moments(self) -> Array:
        """Sums of the products of the currents in each of B >= 1 blocks, shape (B, K, K). [A^2]"""
        parts = [self.current_a[self.block == b] for b in range(int(self.block.max(initial=0)) + 1)]
        return np.stack([part.T @ part for part in parts])

    def rms_a(self, multipliers: Array) -> float:
        """Return the root mean square of the sum of the branches times multipliers (K,); 0 without instants. [A]"""
        total = self.current_a @ multipliers
        return float(np.sqrt(np.mean(total**2))) if len(total) else 0.0


def bands_of(recordings: Sequence[Sequence[Channel]]) -> Bands:
    """Return the bands of the same K >= 1 channels of some recordings; no instants if no recording is long enough."""
    parts, blocks, count = [np.zeros((0, max(map(len, recordings), default=1)))], [np.zeros(0, np.intp)], 0
    for channels in recordings:
        curves = [curve for channel in channels if (curve := charge_curve(channel)) is not None]
        if len(curves) < len(channels):
            continue
        start_s, stop_s = max(curve.time_s[0] for curve in curves), min(curve.time_s[-1] for curve in curves)
        slow = max(1.0, *(curve.period_s / FAST_S for curve in curves))
        band = Band(short_s=slow * BAND.short_s, long_s=slow * BAND.long_s)
        time_s = np.arange(start_s, max(stop_s, start_s), slow * STEP_S)
        time_s = time_s[covered(curves, time_s, band.long_s)]
        if len(time_s):
            block = np.unique(np.floor(time_s / (slow * BLOCK_S)), return_inverse=True)[1]
            parts.append(np.stack([curve.band(time_s, band)[0] for curve in curves], axis=1))
            blocks.append(np.asarray(block, np.intp) + count)
            count = int(blocks[-1][-1]) + 1
    return Bands(np.concatenate(parts), np.concatenate(blocks))


def likely_multipliers(
    bands: Bands, price_besides: Callable[[Array], float], *, factors: Sequence[float] = FACTORS, sure: bool = True
) -> Array:
    """Return by what each branch should be multiplied, shape (K,), so that the currents cancel best.

    Least is log (V / N) plus `price_besides`; V is the mean square of the sum of the multiplied currents, N the sum of
    their mean squares.

    Parameters
    ----------
    bands : Bands
        Bands of the K currents.
    price_besides : callable
        From multipliers (K,) to what else speaks against them, as a number to add to log (V / N). [1]
    factors : sequence of float
        Magnitudes that are tried, for one branch or two at a time. [1]
    sure : bool
        Whether a change is made only if the sum becomes far smaller, or consistently smaller from block to block.
    """
    moments = bands.moments

    def price(multipliers: Array) -> float:
        return float(np.log(_ratios(moments.sum(axis=0, keepdims=True), multipliers)[0])) + price_besides(multipliers)

    def is_sure(before: Array, after: Array, fall: float) -> bool:
        if len(moments) < FEWEST_BLOCKS:
            return False
        gain = np.log(_ratios(moments, before) / _ratios(moments, after))
        return bool(fall > OVERWHELMING or gain.mean() > SURE * gain.std(ddof=1) / np.sqrt(len(gain)))

    best: Array = np.ones(moments.shape[1])
    while True:
        found = min(_neighbours(best, factors), key=price)
        fall = price(best) - price(found)
        only_turned = np.array_equal(found, -best)  # makes no difference to the sum
        if fall <= 1e-9 or not (not sure or only_turned or is_sure(best, found, fall)):
            return best
        best = found


def _ratios(moments: Array, multipliers: Array) -> Array:
    """Return V / N of each block for multipliers (K,), at least :data:`LEAST_RATIO`, shape (B,)."""
    power = np.einsum("bkk,k->b", moments, multipliers**2)
    values = np.einsum("bij,i,j->b", moments, multipliers, multipliers)
    return np.asarray(np.maximum(np.divide(values, power, out=np.ones(len(moments)), where=power > 0.0), LEAST_RATIO))


def _neighbours(multipliers: Array, factors: Sequence[float]) -> Iterator[Array]:
    """Yield multipliers that differ in one branch or two, and those with all signs turned."""
    yield -multipliers
    alternatives = [sign * factor for sign, factor in product((1.0, -1.0), factors)]
    for group in combinations(range(len(multipliers)), min(2, len(multipliers))):
        for values in product(alternatives, repeat=len(group)):
            tried = multipliers.copy()
            tried[list(group)] = values
            yield tried


def sag(pairs: Sequence[tuple[Channel, Channel]]) -> float:
    """Return the correlation of a battery's current and voltage: near -1 if it falls under load, 0 if unknown. [1]"""
    band = bands_of(pairs).current_a
    return float(np.corrcoef(band[:, 0], band[:, 1])[0, 1]) if len(band) and np.all(band.std(axis=0) > 0.0) else 0.0
