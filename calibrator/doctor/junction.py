"""What the junction sum tells of the branches: signs, slips of units, delays, gains, and what no branch measures.

Signs and units first, on currents in which neither a mean nor a delay matters; then, with these put right, the delays
between the branches as the calibrator estimates them; then, without the delays, gains and the mean of the sum.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.doctor.bands import Bands, branch_bands
from calibrator.doctor.multipliers import Explanation, Known, explanations
from calibrator.drive import Array, Drive
from calibrator.drives.align import align_channels
from calibrator.drives.delays import BranchDelays, estimate_delays, without_delays
from calibrator.errors import DriveError
from ecu_node.layout import Layout

__all__ = ["Gain", "JunctionFacts", "SumFigures", "junction_facts", "multiplied", "orientation_of", "peaks"]

WELL_CORRELATED = 0.5
"""Of battery current and voltage, below which the sag of the voltage tells nothing. [1]"""
PEAK_QUANTILE = 0.999
"""Of the magnitudes: a few wild samples are no peak. [1]"""


@dataclass(frozen=True, kw_only=True)
class Gain:
    """Of one branch relative to the first one.

    Attributes
    ----------
    ratio, sd : float
        By which its current must be multiplied so that the sum varies least, and the standard deviation. [1]
    """

    ratio: float
    sd: float


@dataclass(frozen=True, kw_only=True)
class SumFigures:
    """Of the sum of all branches as the layout has them, means included. [A]"""

    mean_a: float
    sd_a: float
    instants: int
    valid: int


@dataclass(frozen=True, kw_only=True)
class JunctionFacts:
    """What the sum of some branches tells.

    Attributes
    ----------
    branches : tuple of str
        The K branches, the one that moves most first.
    rms_a : ndarray of shape (K,)
        How much each varies, as the layout has it. [A]
    bands : Bands
        As the layout has them, but for the delays.
    best : Explanation
        Multipliers with which the sum varies least, in the order of `branches`.
    rivals : tuple of Explanation
        What would explain the sum nearly as well.
    delays : BranchDelays or None
        With the signs and units of `best`; None without a usable stretch of time.
    gains : mapping of str to Gain
        Of the branches after the first, with all that taken into account; empty without a usable stretch.
    total : SumFigures or None
        None if no instant is valid for all.
    """

    branches: tuple[str, ...]
    rms_a: Array
    bands: Bands
    best: Explanation
    rivals: tuple[Explanation, ...]
    delays: BranchDelays | None
    gains: Mapping[str, Gain]
    total: SumFigures | None


def junction_facts(
    drives: Sequence[Drive], layout: Layout, branches: Sequence[str], *, battery: str | None, voltage: str
) -> JunctionFacts:
    """Look at the sum of some branches.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle.
    layout : Layout
        Says full scale, period and time-outs.
    branches : sequence of str
        At least two, with good samples.
    battery : str or None
        The branch that feeds the others, if it is known.
    voltage : str
        Input that is its voltage; drives may lack it.

    Returns
    -------
    JunctionFacts
        What was found.
    """
    known = Known(
        peak_share=peaks(drives, branches) / layout.full_scale_a,
        source=branches.index(battery) if battery is not None else None,
        orientation=orientation_of(drives, battery, voltage),
    )
    bands = branch_bands(drives, branches)
    best = explanations(bands, known)[0]
    right = [multiplied(drive, dict(zip(branches, best.multipliers.tolist(), strict=True))) for drive in drives]
    delays = _delays(right, bands, best)
    gains: Mapping[str, Gain] = {}
    if delays is not None:
        aligned = [without_delays(drive, delays.by_branch()) for drive in drives if _has(drive, branches)]
        bands = branch_bands(aligned, branches)
    found = explanations(bands, known)
    if delays is not None:
        gains = _gains(bands.multiplied(found[0].multipliers).in_order(delays.branches))
    return JunctionFacts(
        branches=tuple(branches),
        rms_a=np.sqrt(np.mean(bands.current_a**2, axis=0)) if len(bands.block) else np.zeros(len(branches)),
        bands=bands,
        best=found[0],
        rivals=tuple(found[1:]),
        delays=delays,
        gains=gains,
        total=_sum_figures(drives, layout, branches),
    )


def multiplied(drive: Drive, multipliers: Mapping[str, float]) -> Drive:
    """A drive with some of its branch currents multiplied by a number."""
    branches = {
        name: replace(channel, value=multipliers.get(name, 1.0) * channel.value)
        for name, channel in drive.branches.items()
    }
    return replace(drive, branches=branches)


def peaks(drives: Sequence[Drive], branches: Sequence[str]) -> Array:
    """Greatest magnitude of each current but for wild samples, shape (K,). [A]"""
    return np.array([_peak(drives, name) for name in branches])


def _peak(drives: Sequence[Drive], name: str) -> float:
    channels = [drive.branches[name] for drive in drives if name in drive.branches]
    value = np.concatenate([np.zeros(0), *(channel.value[channel.good] for channel in channels)])
    return float(np.quantile(np.abs(value), PEAK_QUANTILE)) if len(value) else 0.0


def orientation_of(drives: Sequence[Drive], battery: str | None, voltage: str) -> float:
    """Tell from the battery's voltage whether its current is positive into the junction.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle.
    battery : str or None
        The branch.
    voltage : str
        Input that is its voltage.

    Returns
    -------
    float
        Near 1 if the voltage falls when the current rises, near -1 if it rises; without a voltage that follows the
        current, a third of that by the sign of the mean current, since driving takes energy out of a battery; 0 if
        nothing can be told.
    """
    if battery is None:
        return 0.0
    together = [
        replace(drive, branches={"i": drive.branches[battery], "u": drive.inputs[voltage]})
        for drive in drives
        if battery in drive.branches and voltage in drive.inputs
    ]
    band = branch_bands(together, ("i", "u")).current_a
    if len(band) and np.all(band.std(axis=0) > 0.0):
        correlation = float(np.corrcoef(band[:, 0], band[:, 1])[0, 1])
        if abs(correlation) > WELL_CORRELATED:
            return -correlation
    values = [drive.branches[battery] for drive in drives if battery in drive.branches]
    value = np.concatenate([np.zeros(0), *(channel.value[channel.good] for channel in values)])
    spread = float(np.sqrt(np.mean(value**2))) if len(value) else 0.0
    return float(np.mean(value)) / spread / 3.0 if spread > 0.0 else 0.0


def _has(drive: Drive, branches: Sequence[str]) -> bool:
    return set(branches) <= drive.branches.keys()


def _delays(drives: Sequence[Drive], bands: Bands, best: Explanation) -> BranchDelays | None:
    """Delays with the branch that moves most as the reference; None where too little was recorded."""
    whole = [drive for drive in drives if _has(drive, bands.branches)]
    if not whole or not len(bands.block):
        return None
    power = np.mean((bands.current_a * best.multipliers) ** 2, axis=0)
    order = [bands.branches[k] for k in np.argsort(-power, kind="stable")]
    try:
        return estimate_delays(whole, order)
    except DriveError:
        return None


def _gains(bands: Bands) -> dict[str, Gain]:
    """Least squares of the first branch on the others, standard deviations from blocks left out."""
    moments = bands.moments
    total = moments.sum(axis=0)
    if len(moments) < 2 or np.any(np.diagonal(total) <= 0.0):
        return {}
    rest = np.stack([_regression(total - block) for block in moments])
    count = len(moments)
    sd = np.sqrt((count - 1) / count * np.sum((rest - rest.mean(axis=0)) ** 2, axis=0))
    ratio = _regression(total)
    return {name: Gain(ratio=float(ratio[k]), sd=float(sd[k])) for k, name in enumerate(bands.branches[1:])}


def _regression(moments: Array) -> Array:
    return np.asarray(-np.linalg.pinv(moments[1:, 1:]) @ moments[1:, 0])


def _sum_figures(drives: Sequence[Drive], layout: Layout, branches: Sequence[str]) -> SumFigures | None:
    limits_s = {branch.name: branch.timeout_s for branch in layout.branch if branch.name in branches}
    sums: list[Array] = []
    instants = 0
    for drive in drives:
        channels = {name: drive.branches[name] for name in branches if name in drive.branches}
        if len(channels) < len(branches):
            continue
        try:
            _, values, reasons = align_channels(channels, limits_s, period_s=layout.period_s, where=drive.name)
        except DriveError:
            continue
        valid = ~np.any(list(reasons.values()), axis=0)
        instants += len(valid)
        sums.append(np.sum([values[name] for name in branches], axis=0)[valid])
    total = np.concatenate([np.zeros(0), *sums])
    if not len(total):
        return None
    return SumFigures(mean_a=float(total.mean()), sd_a=float(total.std()), instants=instants, valid=len(total))
