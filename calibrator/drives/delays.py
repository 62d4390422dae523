"""How much later than the first branch each branch current of one vehicle is seen, from raw frames.

Sensors, filters and gateways delay the branch currents differently. Only the differences can be seen in the junction
law: with x_k(t) the measured current of branch k, seen tau_k later than that of the first, and g_k its gain ratio
(1 + d_1) / (1 + d_k),

    x_1(t) + sum over k > 1 of g_k x_k(t + tau_k) = constant.

The sum is made small over all drives of the vehicle, on currents of which offsets, and loads that no branch measures
and that change slowly, have been taken out (:mod:`calibrator.drives.charge`): first on a grid of lags, so that no local
minimum traps (:mod:`calibrator.drives.delay_search`), then to a fraction of the sample period, with gains and
confidence (:mod:`calibrator.drives.delay_fit`). No noise level is assumed: the spread between blocks of time gives the
standard deviation. A branch that changes too little to tell its delay is flagged.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array, Drive, Mask
from calibrator.drives.charge import Band, ChargeCurve, charge_curve
from calibrator.drives.delay_fit import Stretch, fit_delays
from calibrator.drives.delay_search import covered, search_lags
from calibrator.errors import DriveError

__all__ = ["BranchDelays", "estimate_delays", "without_delays"]

MAX_DELAY_S = 0.5
"""Filters and gateways of real cars delay by tens to hundreds of milliseconds. [s]"""
MAX_SD_S = 0.005
"""Of a delay that counts as known: half the period of a 100 Hz frame. [s]"""
SHORT_S = 0.2
"""Least half width of the averages: sensor noise of some tenths of an ampere hides few of a small branch's steps.
[s]"""
SHORT_PERIODS = 2.0
"""Each window holds at least four samples of the slowest branch. [1]"""
LONG_S = 5.0
"""Loads that change more slowly count as constant; auxiliaries still change within it. [s]"""
INSTANTS_PER_WINDOW = 4.0
"""Instants looked at in each SHORT_S; more tell nothing new. [1]"""
BLOCK_S = 10.0
"""As long as the long windows reach: blocks count as independent. [s]"""
FEWEST_BLOCKS = 6
"""Fewer do not give a standard deviation worth the name."""
GAIN_RANGE = (1.0 / 3.0, 3.0)
"""Ratios of two sensors' gains, each within 0.6 to 1.4, and some loss to noise; outside, it is not the branch's own
current that was found. [1]"""


@dataclass(frozen=True, kw_only=True)
class BranchDelays:
    """Delays of the branches of one vehicle.

    Attributes
    ----------
    branches : tuple of str
        Names of the K branches; the first is the reference.
    delay_s : ndarray of shape (K,)
        How much later than the reference's each current is seen; 0 for the reference and where not known. [s]
    sd_s : ndarray of shape (K,)
        Standard deviation of the delay; 0 for the reference, infinite where not known. [s]
    known : ndarray of bool, shape (K,)
        False where the branch is too small or too quiet, or the drives too short, to tell.
    """

    branches: tuple[str, ...]
    delay_s: Array
    sd_s: Array
    known: Mask

    def by_branch(self) -> dict[str, float]:
        """Delay of each branch, for :func:`without_delays`. [s]"""
        return dict(zip(self.branches, self.delay_s.tolist(), strict=True))


def estimate_delays(
    drives: Sequence[Drive],
    branches: Sequence[str],
    *,
    max_delay_s: float = MAX_DELAY_S,
    max_sd_s: float = MAX_SD_S,
) -> BranchDelays:
    """Estimate by how much the branch currents of one vehicle are seen later than the first one.

    Parameters
    ----------
    drives : sequence of Drive
        Drives of one vehicle; a drive with too few good samples of a branch adds nothing.
    branches : sequence of str
        Names of the K branches that meet at the junction; the first, the reference, should be the one that moves most.
    max_delay_s : float
        Longest difference to look for. [s]
    max_sd_s : float
        Largest standard deviation of a delay that counts as known. [s]

    Returns
    -------
    BranchDelays
        Delays relative to the first branch, with standard deviations.

    Raises
    ------
    DriveError
        If there is no drive, a drive lacks a branch, or fewer than two branches are asked for.
    """
    _require(drives, branches)
    recorded = [_curves(drive, branches) for drive in drives]
    complete = [curves for curves in recorded if len(curves) == len(branches)]
    slowest_s = max((curve.period_s for curves in complete for curve in curves), default=0.0)
    band = Band(short_s=max(SHORT_S, SHORT_PERIODS * slowest_s), long_s=LONG_S)
    found = [_stretch(curves, band, max_delay_s) for curves in complete]
    stretches = [stretch for stretch in found if stretch.time_s.size]
    if sum(len(stretch.starts) for stretch in stretches) < FEWEST_BLOCKS:
        return _nothing_known(branches)
    start_s = search_lags([stretch.curves for stretch in stretches], band, max_delay_s)
    fit = fit_delays(stretches, band, start_s, max_delay_s)
    plausible = (fit.gain > GAIN_RANGE[0]) & (fit.gain < GAIN_RANGE[1]) & (np.abs(fit.delay_s) < max_delay_s)
    known = np.concatenate([[True], plausible & (fit.sd_s <= max_sd_s)])
    return BranchDelays(
        branches=tuple(branches),
        delay_s=np.where(known, np.concatenate([[0.0], fit.delay_s]), 0.0),
        sd_s=np.where(known, np.concatenate([[0.0], fit.sd_s]), np.inf),
        known=known,
    )


def without_delays(drive: Drive, delays: Mapping[str, float]) -> Drive:
    """Take known delays out of a drive.

    Parameters
    ----------
    drive : Drive
        The drive.
    delays : mapping of str to float
        How much later each branch is seen, by name; branches that are not named stay as they are. [s]

    Returns
    -------
    Drive
        The same samples, those of each named branch at the instants at which they were true. Inputs stay as they are.

    Raises
    ------
    DriveError
        If the drive lacks a named branch.
    """
    _require_branches(drive, list(delays))
    return replace(
        drive,
        branches={
            name: replace(channel, time_s=channel.time_s - delays.get(name, 0.0))
            for name, channel in drive.branches.items()
        },
    )


def _curves(drive: Drive, branches: Sequence[str]) -> tuple[ChargeCurve, ...]:
    """Currents of the branches; fewer if one has too few good samples."""
    curves = (charge_curve(drive.branches[name]) for name in branches)
    return tuple(curve for curve in curves if curve is not None)


def _stretch(curves: tuple[ChargeCurve, ...], band: Band, max_delay_s: float) -> Stretch:
    """Instants in blocks, and the currents around them."""
    start_s, stop_s = max(curve.time_s[0] for curve in curves), min(curve.time_s[-1] for curve in curves)
    time_s = np.arange(start_s, stop_s, band.short_s / INSTANTS_PER_WINDOW)
    time_s = time_s[covered(curves, time_s, band.long_s + max_delay_s)]
    block = np.floor((time_s - start_s) / BLOCK_S)
    return Stretch(curves=curves, time_s=time_s, starts=np.flatnonzero(np.diff(block, prepend=-1.0)))


def _nothing_known(branches: Sequence[str]) -> BranchDelays:
    known = np.arange(len(branches)) == 0
    sd_s = np.where(known, 0.0, np.inf)
    return BranchDelays(branches=tuple(branches), delay_s=np.zeros(len(branches)), sd_s=sd_s, known=known)


def _require(drives: Sequence[Drive], branches: Sequence[str]) -> None:
    if not drives:
        raise DriveError("no drive to estimate delays from; record at least one drive of the vehicle")
    for drive in drives:
        _require_branches(drive, branches)
    if len(branches) < 2:
        raise DriveError(
            f"vehicle {drives[0].vehicle}: a delay is a difference of two branches, and only "
            f"{', '.join(branches) or 'none'} was asked for; choose at least two"
        )


def _require_branches(drive: Drive, branches: Sequence[str]) -> None:
    missing = [name for name in branches if name not in drive.branches]
    if missing:
        raise DriveError(
            f"vehicle {drive.vehicle}, drive {drive.name}: no branch {', '.join(missing)}; it has "
            f"{', '.join(drive.branches) or 'none'}; choose branches that all drives have"
        )
