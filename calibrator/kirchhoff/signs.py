"""What the junction sum tells of the branches: signs, slips of units, delays, gains.

Signs and units come first, from currents without means and slow changes, and too smooth for a delay to matter: a load
that no sensor sees, and offsets, would be taken for faults of a branch; fast changes because of a delay, too. With x_k
such a band of the current of branch k and m_k = +-10^n, the sum V = mean (sum_k m_k x_k)^2 should be small beside
N = sum_k m_k^2 mean x_k^2. Both scale alike, so the ratio V / N tells nothing of a factor that all branches share, and
nothing of a sign that all share; what else is known of the branches must tell those. Then, with signs and units put
right, come the delays as the calibrator estimates them, and without the delays the gains.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Channel, Drive
from calibrator.drives.charge import Band, charge_curve, covered
from calibrator.drives.delays import BranchDelays, estimate_delays, without_delays
from calibrator.errors import DriveError
from calibrator.kirchhoff.sums import VOLTAGE
from calibrator.words import is_battery
from ecu_node.layout import Layout

__all__ = ["WELL_CORRELATED", "Bands", "SumFacts", "bands_of", "look_at_sum", "multiplied", "sag"]
__all__ += ["likely_multipliers"]

BAND = Band(short_s=0.75, long_s=10.0)
"""Half widths of the averages: several times the delays of real cars, and as long as driving keeps its pace. [s]"""
STEP_S = 0.25
"""Distance of the instants: a third of the shorter window. [s]"""
BLOCK_S = 10.0
"""Blocks count as independent: as long as the longer window reaches. [s]"""

FACTORS = (1.0, 1e-1, 1e-2, 1e-3, 1e1, 1e2, 1e3)
"""Slips of units and scales. [1]"""
LEAST_RATIO = 1e-4
"""V / N below this is as good as nothing: sensors are not better than 1 %. [1]"""
CHANGE_PRICE, UNIT_PRICE = 0.7, 0.3
"""Each branch that is changed must halve V / N: its variation must then be above that of the sum's rest. The second is
what a slip of a unit costs beyond a wrong sign: where both explain the same, the sign is wrong. [1]"""
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
WELL_CORRELATED = 0.5
"""Of battery current and voltage, below which the sag of the voltage tells nothing. [1]"""
PEAK_QUANTILE = 0.999
"""Of the magnitudes: a few wild samples are no peak. [1]"""


class Bands(NamedTuple):
    """Comparable currents of K branches [A], shape (T, K), positive into the junction, and each instant's block."""

    current_a: Array
    block: NDArray[np.intp]

    @property
    def moments(self) -> Array:
        """Second moments of each of B >= 1 blocks, shape (B, K, K). [A^2]"""
        parts = [self.current_a[self.block == b] for b in range(int(self.block.max(initial=0)) + 1)]
        return np.stack([part.T @ part for part in parts])

    def rms_a(self, multipliers: Array) -> float:
        """Root mean square of the sum with each branch multiplied by a number. [A]"""
        total = self.current_a @ multipliers
        return float(np.sqrt(np.mean(total**2))) if len(total) else 0.0


def bands_of(recordings: Sequence[Sequence[Channel]]) -> Bands:
    """Bands of the same K >= 1 channels in some recordings; of no instant where none is long enough."""
    parts, blocks, count = [np.zeros((0, max(map(len, recordings), default=1)))], [np.zeros(0, np.intp)], 0
    for channels in recordings:
        curves = [curve for channel in channels if (curve := charge_curve(channel)) is not None]
        if len(curves) < len(channels):
            continue
        start_s, stop_s = max(curve.time_s[0] for curve in curves), min(curve.time_s[-1] for curve in curves)
        time_s = np.arange(start_s, max(stop_s, start_s), STEP_S)
        time_s = time_s[covered(curves, time_s, BAND.long_s)]
        if len(time_s):
            _, block = np.unique(np.floor(time_s / BLOCK_S), return_inverse=True)
            parts.append(np.stack([curve.band(time_s, BAND)[0] for curve in curves], axis=1))
            blocks.append(np.asarray(block, np.intp) + count)
            count = int(blocks[-1][-1]) + 1
    return Bands(np.concatenate(parts), np.concatenate(blocks))


def likely_multipliers(
    moments: Array,
    price_besides: Callable[[Array], float],
    *,
    factors: Sequence[float] = FACTORS,
    is_sure: Callable[[Array, Array, Array, float], bool] = lambda *_: True,
) -> Array:
    """Multipliers with the least price: the logarithm of V / N, and what else is held against them.

    Parameters
    ----------
    moments : ndarray of shape (B, K, K)
        Second moments of B blocks. [A^2]
    price_besides : callable
        What is held against multipliers of shape (K,). [1]
    factors : sequence of float
        Magnitudes that are tried, of one branch or two at a time. [1]
    is_sure : callable
        Whether a change, of multipliers, to others, with these moments, that lowers the price by so much, is none of
        chance.
    """

    def price(multipliers: Array) -> float:
        return float(np.log(_ratios(moments.sum(axis=0, keepdims=True), multipliers)[0])) + price_besides(multipliers)

    best: Array = np.ones(moments.shape[1])
    while True:
        found = min(_neighbours(best, factors), key=price)
        fall = price(best) - price(found)
        only_turned = np.array_equal(found, -best)  # of which the sum tells nothing
        if fall <= 1e-9 or not (only_turned or is_sure(best, found, moments, fall)):
            return best
        best = found


def _ratios(moments: Array, multipliers: Array) -> Array:
    """V / N of each block."""
    power = np.einsum("bkk,k->b", moments, multipliers**2)
    values = np.einsum("bij,i,j->b", moments, multipliers, multipliers)
    return np.asarray(np.maximum(np.divide(values, power, out=np.ones(len(moments)), where=power > 0.0), LEAST_RATIO))


def _neighbours(multipliers: Array, factors: Sequence[float]) -> Iterator[Array]:
    """Multipliers that differ in one branch or two, and those with all signs turned."""
    yield -multipliers
    alternatives = [sign * factor for sign, factor in product((1.0, -1.0), factors)]
    for group in combinations(range(len(multipliers)), min(2, len(multipliers))):
        for values in product(alternatives, repeat=len(group)):
            tried = multipliers.copy()
            tried[list(group)] = values
            yield tried


def _is_sure(before: Array, after: Array, moments: Array, fall: float) -> bool:
    """Whether the sum gets far smaller, or does so in one block of time after the other."""
    if len(moments) < FEWEST_BLOCKS:
        return False
    gain = np.log(_ratios(moments, before) / _ratios(moments, after))
    often = gain.mean() > SURE * gain.std(ddof=1) / np.sqrt(len(gain))
    return bool(often or fall > OVERWHELMING)


def sag(pairs: Sequence[tuple[Channel, Channel]]) -> float:
    """Correlation of a battery's currents with its voltages [1]: -1 where these fall under load; 0 if nothing tells."""
    band = bands_of(pairs).current_a
    return float(np.corrcoef(band[:, 0], band[:, 1])[0, 1]) if len(band) and np.all(band.std(axis=0) > 0.0) else 0.0


def _values(drives: Sequence[Drive], branch: str) -> Array:
    """Good values of a branch over all drives. [A]"""
    channels = [drive.branches[branch] for drive in drives if branch in drive.branches]
    return np.concatenate([np.zeros(0), *(channel.value[channel.good] for channel in channels)])


def _orientation(drives: Sequence[Drive], battery: str | None) -> float:
    """Tell from the battery's voltage whether its current is positive into the junction.

    Near 1 if the voltage falls when the current rises, near -1 if it rises; without a voltage that follows the current,
    a third of that by the sign of the mean current, since driving takes energy out of a battery; 0 if nothing tells.
    """
    if battery is None:
        return 0.0
    both = [drive for drive in drives if battery in drive.branches and VOLTAGE in drive.inputs]
    correlation = sag([(drive.branches[battery], drive.inputs[VOLTAGE]) for drive in both])
    if abs(correlation) > WELL_CORRELATED:
        return -correlation
    value = _values(drives, battery)
    spread = float(np.sqrt(np.mean(value**2))) if len(value) else 0.0
    return float(np.mean(value)) / spread / 3.0 if spread > 0.0 else 0.0


@dataclass(frozen=True, kw_only=True)
class SumFacts:
    """What the sum of some branches tells.

    Attributes
    ----------
    branches : tuple of str
        The K branches.
    rms_a : ndarray of shape (K,)
        How much each varies, as the layout has it. [A]
    bands : Bands
        As the layout has them, but for the delays.
    multipliers : ndarray of shape (K,)
        +-10^n with which the sum varies least; 1 where nothing is wrong. [1]
    delays : BranchDelays or None
        With these signs and units; None where too little was recorded.
    gains : mapping of str to (float, float)
        Number by which each branch must be multiplied so that the sum varies least, and its standard deviation; 1 and 0
        for the one that moves most; empty where too little was recorded. [1]
    """

    branches: tuple[str, ...]
    rms_a: Array
    bands: Bands
    multipliers: Array
    delays: BranchDelays | None
    gains: Mapping[str, tuple[float, float]]

    @property
    def changed(self) -> list[int]:
        """Numbers of the branches that are not as the layout has them."""
        return [int(k) for k in np.flatnonzero(self.multipliers != 1.0)]

    def is_small(self, name: str) -> bool:
        """Whether a branch varies too little beside the greatest for the sum to tell much of it."""
        right_a = self.rms_a * np.abs(self.multipliers)
        return bool(right_a[self.branches.index(name)] < SMALL_SHARE * np.max(right_a))


SMALL_SHARE = 0.05
"""Of the greatest branch's variation; a smaller branch's gain is drawn to 0 by its noise. [1]"""


def look_at_sum(
    drives: Sequence[Drive], branches: Sequence[str], layout: Layout, *, least_a: float, full_scale_a: float
) -> SumFacts:
    """Look at the sum of some branches.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle, with :data:`VOLTAGE` where it is recorded; one that lacks a branch adds nothing.
    branches : sequence of str
        At least two, with good samples.
    layout : Layout
        Whose names tell the battery.
    least_a, full_scale_a : float
        A sum that varies by no more than the first is right: it is what quantisation leaves. Currents beyond the
        second, or far below it, are not plausible. [A]
    """
    peaks_a = [np.quantile(np.abs(_values(drives, name)), PEAK_QUANTILE) for name in branches]
    peak_share = np.array(peaks_a) / full_scale_a
    battery = next((name for name in branches if is_battery(name, layout.find_branch(name).source)), None)
    orientation = _orientation(drives, battery)
    whole = [drive for drive in drives if set(branches) <= drive.branches.keys()]

    def price(multipliers: Array) -> float:
        share = np.abs(multipliers) * peak_share
        turned = 0.0 if battery is None else float(np.sign(multipliers[branches.index(battery)]))
        changes = min(np.sum(multipliers != 1.0), 1 + np.sum(multipliers != -1.0))  # all signs turned are one change
        return float(
            CHANGE_PRICE * changes
            + UNIT_PRICE * np.sum(np.abs(multipliers) != 1.0)
            + PLAUSIBLE_PRICE * (np.sum(share > LARGEST_SHARE) + (share.max() < LEAST_SHARE))
            + ORIENTATION_PRICE * max(-turned * orientation, 0.0)
        )

    def explained(delays: BranchDelays | None) -> tuple[Bands, Array]:
        on_time = whole if delays is None else [without_delays(drive, delays.by_branch()) for drive in whole]
        bands = bands_of([[drive.branches[name] for name in branches] for drive in on_time])
        if bands.rms_a(np.ones(len(branches))) <= least_a:
            return bands, np.ones(len(branches))
        return bands, likely_multipliers(bands.moments, price, is_sure=_is_sure)

    (bands, best), delays = explained(None), None
    if len(bands.block):
        right = [multiplied(drive, dict(zip(branches, best.tolist(), strict=True))) for drive in whole]
        order = np.argsort(-np.sum((bands.current_a * best) ** 2, axis=0), kind="stable")
        try:
            delays = estimate_delays(right, [branches[k] for k in order])
        except DriveError:
            pass
        else:
            bands, best = explained(delays)
    return SumFacts(
        branches=tuple(branches),
        rms_a=np.sqrt(np.mean(bands.current_a**2, axis=0)) if len(bands.block) else np.zeros(len(branches)),
        bands=bands,
        multipliers=best,
        delays=delays,
        gains={} if delays is None else _gains(bands, best, branches, branches.index(delays.branches[0])),
    )


def multiplied(drive: Drive, multipliers: Mapping[str, float]) -> Drive:
    """A drive with some of its branch currents multiplied by a number."""
    branches = {
        name: replace(channel, value=multipliers.get(name, 1.0) * channel.value)
        for name, channel in drive.branches.items()
    }
    return replace(drive, branches=branches)


def _gains(bands: Bands, multipliers: Array, branches: Sequence[str], first: int) -> dict[str, tuple[float, float]]:
    """Least squares of one branch on the others, standard deviations from blocks left out."""
    moments = bands.moments * np.outer(multipliers, multipliers)
    total, count = moments.sum(axis=0), len(moments)
    if count < 2 or np.any(np.diagonal(total) <= 0.0):
        return {}
    others = [k for k in range(len(multipliers)) if k != first]
    cases = np.concatenate([total[None], total - moments])
    ratio = -np.linalg.pinv(cases[:, others][:, :, others]) @ cases[:, others, first, None]
    sd = np.sqrt((count - 1) * np.var(ratio[1:, :, 0], axis=0))
    found = {branches[k]: (float(ratio[0, j, 0]), float(sd[j])) for j, k in enumerate(others)}
    return {branches[first]: (1.0, 0.0)} | found
