"""Average a branch current over short windows, at any instant, from its raw frames.

Between good samples the current i is taken as linear. Then its charge Q (the integral of i) and the integral P of Q are
exact, and so are the mean of i with triangular weight over +-w and the slope of this mean:

    m_w(t) = (P(t + w) - 2 P(t) + P(t - w)) / w^2          dm_w/dt = (Q(t + w) - 2 Q(t) + Q(t - w)) / w^2

The band (w, W) of the current is m_w - m_W. It is free of offsets and of slow changes, and smooth enough to be compared
between branches whose frames come at different instants. The band is a linear filter, the same for all branches, so the
junction law holds for it too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.compiled import compiled
from calibrator.drive import Array, Channel, Mask, good_samples

__all__ = ["Band", "ChargeCurve", "charge_curve", "covered"]

GAP_PERIODS = 3.5
"""Good samples that are more than this many median distances apart leave a gap; two lost frames in a row leave none.
[1]"""


@dataclass(frozen=True, kw_only=True)
class Band:
    """Windows over which currents are averaged.

    Attributes
    ----------
    short_s, long_s : float
        Half widths w and W of the triangles. [s]
    """

    short_s: float
    long_s: float


@dataclass(frozen=True, kw_only=True)
class ChargeCurve:
    """A branch current, linear between its good samples, with its integrals.

    Attributes
    ----------
    time_s : ndarray of shape (n,)
        Instants of the good samples, strictly increasing, n >= 2. [s]
    pieces : ndarray of shape (4, n) or wider
        Column k, at sample k: integral P of the charge [A s^2], charge Q since the first sample [A s], current i [A],
        and slope of the line to sample k + 1 [A/s].
    gap_s : ndarray of shape (n,)
        Total length of all gaps before each sample. [s]
    period_s : float
        Median distance of the samples. [s]
    """

    time_s: Array
    pieces: Array
    gap_s: Array
    period_s: float

    def band(self, time_s: Array, band: Band) -> tuple[Array, Array]:
        """Compute the band of the current and its slope.

        Parameters
        ----------
        time_s : ndarray of shape (T,)
            Increasing instants that the samples cover by at least W on both sides. [s]
        band : Band
            Windows w and W.

        Returns
        -------
        x, slope : ndarray of shape (T,)
            Band of the current [A] and its derivative by time [A/s].
        """
        w, W = band.short_s, band.long_s
        shift_s = np.array([0.0, w, -w, W, -W])
        weight = np.array([2.0 / W**2 - 2.0 / w**2, 1.0 / w**2, 1.0 / w**2, -1.0 / W**2, -1.0 / W**2])
        return _band(time_s, self.time_s, self.pieces, shift_s, weight)

    def covers(self, time_s: Array, margin_s: float) -> Mask:
        """Return for each instant whether the margin on both sides lies within the samples and touches no gap."""
        first, last = time_s - margin_s, time_s + margin_s
        inside = (first >= self.time_s[0]) & (last <= self.time_s[-1])
        gap_s = np.interp(last, self.time_s, self.gap_s) - np.interp(first, self.time_s, self.gap_s)
        return np.asarray(inside & (gap_s <= 0.0))


def covered(curves: Sequence[ChargeCurve], time_s: Array, margin_s: float) -> Mask:
    """Return at which instants all curves cover `margin_s` on both sides without a gap, shape (T,)."""
    return np.asarray(np.all([curve.covers(time_s, margin_s) for curve in curves], axis=0))


@compiled
def _band(time_s: Array, known_s: Array, pieces: Array, shift_s: Array, weight: Array) -> tuple[Array, Array]:
    """Compute a band and its slope, shape (T,) each, as weighted sums of P and Q at shifted instants.

    The instants must increase: the search for the line at an instant starts at the line of the instant before.
    """
    x, slope = np.zeros(len(time_s)), np.zeros(len(time_s))
    for place in range(len(shift_s)):
        k, last = 0, len(known_s) - 2
        for j in range(len(time_s)):
            t = time_s[j] + shift_s[place]
            while k < last and known_s[k + 1] <= t:
                k += 1
            while k > 0 and known_s[k] > t:
                k -= 1
            h = t - known_s[k]
            integral, charge, current, rise = pieces[0, k], pieces[1, k], pieces[2, k], pieces[3, k]
            x[j] += weight[place] * (integral + h * (charge + h * (current / 2.0 + h * rise / 6.0)))
            slope[j] += weight[place] * (charge + h * (current + h * rise / 2.0))
    return x, slope


def charge_curve(channel: Channel) -> ChargeCurve | None:
    """Integrate the good samples of a channel.

    Parameters
    ----------
    channel : Channel
        A branch current, positive into the junction. [A]

    Returns
    -------
    ChargeCurve or None
        The curve; None for fewer than two good samples at different instants. Of several at one instant the last
        counts.
    """
    time_s, value = good_samples(channel)
    if len(time_s) < 2:
        return None
    pieces = np.zeros((4, len(time_s)))
    pieces[2] = value
    _integrate(time_s, pieces)
    h = np.diff(time_s)
    period_s = float(np.median(h))
    gap_s = np.concatenate([[0.0], np.cumsum(np.where(h > GAP_PERIODS * period_s, h, 0.0))])
    return ChargeCurve(time_s=time_s, pieces=pieces, gap_s=gap_s, period_s=period_s)


@compiled
def _integrate(time_s: Array, pieces: Array) -> None:
    """Fill `pieces` of a :class:`ChargeCurve`, of which the current is given."""
    integral, charge, current, slope = pieces
    for k in range(len(time_s) - 1):
        h = time_s[k + 1] - time_s[k]
        slope[k] = (current[k + 1] - current[k]) / h
        charge[k + 1] = charge[k] + h * (current[k + 1] + current[k]) / 2.0
        integral[k + 1] = integral[k] + h * (charge[k] + h * (current[k] / 2.0 + h * slope[k] / 6.0))
