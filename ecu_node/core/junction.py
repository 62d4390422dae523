"""Junction watch: the Kirchhoff sum before and after correction, and whether it may be what it is.

Three questions: does the correction make the sum worse than it was measured; does the corrected sum leave what the
parameter file allows (a sensor broke); does a branch never change while the sum moves.

Branches are looked at in the same instant of the junction: each at the time of its frames less its calibrated delay,
in between by linear interpolation. The instant is the newest one that all branches have reached. Currents are positive
into the junction. [A]
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ecu_node.core.branch import LiveBranch
from ecu_node.core.status import Reason

_MOST_MARGINS = 10.0
"""More than so many margins nobody may expect the corrected sum to be worse."""
_LEAST_LOOKS = 10
"""Sums that a verdict needs."""
_STUCK_SHARE = 0.02
"""Standard deviation of the measured sum, in shares of full scale, at which a code that never changes is suspicious."""
_REST_SHARE = 0.005
"""Up to this share of full scale a current that never changes is one at rest, as a motor's at standstill."""
_MOST_DEVIATIONS = 4.0
"""Mean of the corrected sum over a window, in standard deviations of the single sum, that no right set reaches."""
_LARGEST_DEVIATION = 12.0
"""More standard deviations count as so many: steps of loads that sensors show one after the other are short."""
_PLAUSIBILITY_WINDOW_S = 4.0
"""Long enough that sensors of 0.1 s delay do not add up to an alarm, and within the 5 s that a receiver bears. [s]"""
_JUMP_DEVIATIONS, _JUMP_SHARE = 8.0, 0.05
"""A jump is beyond so many standard deviations of the sum, and beyond this share of full scale."""
_JUMP_LOOKS, _JUMP_S = 3, 0.03
"""A jump lasts for so many instants, and so long [s]: frames of one load step come one after the other."""
_MOVING_S, _MOVING_FRAMES = 0.25, 3
"""Over so long [s], and so many frames at least, it is seen how far each branch moved."""
_EXPLAINS, _LARGEST_SLOPE = 0.9, 0.8
"""A gain error of a branch that explains this share of the sum's variance is what is wrong, but for slopes near 1: then
the branch alone is right, and another one is stuck."""
_UNKNOWN_SD_SHARE, _UNKNOWN_SD_PER_A = 0.02, 0.05
"""Standard deviation of the corrected sum where the parameter file does not say it: share of full scale, and of the
throughput. [1]"""
_NEARLY_AS_GOOD = 1.25
"""Branches that leave so many times what the best one leaves of the sum explain it as well."""


@dataclass(frozen=True, kw_only=True)
class JunctionSums:
    """Sum of all fitted branches in one instant, measured and corrected. [A]"""

    measured_a: float
    corrected_a: float


def aligned_currents(
    branches: Sequence[LiveBranch], delays_s: Mapping[str, float], now_s: float
) -> tuple[float, dict[str, tuple[float, float]]] | None:
    """Currents of all fitted branches in the last instant of which all are known.

    Parameters
    ----------
    branches : sequence of LiveBranch
        All branches of the layout.
    delays_s : mapping of str to float
        How much later than the junction each is seen; 0 where not named. [s]
    now_s : float
        Now. [s]

    Returns
    -------
    instant_s : float
        When, at the junction. [s]
    currents : dict of str to (float, float)
        Measured, and as the parameters that are in force make it; positive into the junction. [A]
        None, instead of both, while a fitted branch is stale or has no value.
    """
    branches = [branch for branch in branches if branch.is_fitted]
    latest = [found for branch in branches if not branch.is_stale(now_s) and (found := branch.latest()) is not None]
    if not branches or len(latest) < len(branches):
        return None
    delays = [delays_s.get(branch.name, 0.0) for branch in branches]
    instant_s = min(seen_s - delay_s for delay_s, (seen_s, _) in zip(delays, latest, strict=True))
    currents = {
        branch.name: pair
        for branch, delay_s in zip(branches, delays, strict=True)
        if (pair := branch.currents_at(instant_s + delay_s)) is not None
    }
    return (instant_s, currents) if len(currents) == len(branches) else None


Verdict = tuple[Reason, tuple[str, ...]]
"""Why parameters must not be used any more, and the branches that explain it best, the best one first."""


@dataclass(frozen=True, kw_only=True)
class ExpectedSum:
    """What the parameter file says of the sum of right sensors.

    Attributes
    ----------
    expected_a : float
        The load that none of them sees. Sums are judged by how far they are from it. [A]
    predicted_worse_a : float
        By how much the calibrator itself expects the corrected sum to be worse, as where one of two offsets that cancel
        is corrected; added to the margin, up to ten times that. [A]
    corrected_a : float
        Root mean square of the corrected sum about that, as the calibrator saw it. [A]
    sd_a, sd_per_a : float or None
        Standard deviation of the corrected sum: at rest [A], and per ampere that flows through the junction [1]. Where
        not known, shares of full scale (or what the calibrator saw, if more) and of the throughput: then only gross
        faults show.
    """

    expected_a: float = 0.0
    predicted_worse_a: float = 0.0
    corrected_a: float = 0.0
    sd_a: float | None = None
    sd_per_a: float | None = None


class _Moment(NamedTuple):
    """One instant of the junction; sums are less what is expected."""

    time_s: float
    measured_a: float
    corrected_a: float
    deviations: float
    """The corrected sum in standard deviations, signed."""
    directed: float
    """The same, with the sign of the largest current: a gain error keeps its sign in it."""
    currents_a: Mapping[str, tuple[float, float]]
    """Measured and corrected, by branch."""
    codes: Mapping[str, int]
    """Last code of each branch."""


class JunctionWatch:
    """Sums of the junction, their recent past, and what is to be thought of them.

    A gain error or an offset shows in the mean of the corrected sum over some seconds. A jump shows within some frames:
    the sum, or one branch alone, has moved farther than all the others together. What a load does, another branch shows
    too. Whether the correction makes it worse, and which branch never changes, shows over a longer window.

    Parameters
    ----------
    branches : sequence of LiveBranch
        All branches of the layout.
    window_s : float
        Over this long measured and corrected sums are compared. [s]
    margin_a : float
        By how much the root mean square of the corrected ones must be above that of the measured ones. [A]
    full_scale_a : float
        Nominal maximum current of the junction. [A]

    Attributes
    ----------
    sums : JunctionSums or None
        Of the last look; None while a fitted branch is stale or has no value.
    currents_a : mapping of str to (float, float)
        Measured and corrected currents of the last instant that was known, by branch. [A]
    instant_s : float
        That instant. [s]
    is_whole : callable
        Whether all currents of the junction are measured now; sums of other times are published, but not judged.
    """

    def __init__(
        self, branches: Sequence[LiveBranch], *, window_s: float, margin_a: float, full_scale_a: float
    ) -> None:
        self._branches = {branch.name: branch for branch in branches}
        self._window_s, self._margin_a, self._full_scale_a = window_s, margin_a, full_scale_a
        self._rest_a = _REST_SHARE * full_scale_a
        self.is_whole: Callable[[float], bool] = lambda _: True
        self.restart(ExpectedSum())

    def restart(self, expected: ExpectedSum) -> None:
        """Forget what was seen, and judge by this from now on."""
        margins = min(max(expected.predicted_worse_a / self._margin_a, 0.0), _MOST_MARGINS)
        self._expected_a, self._allowed_a = expected.expected_a, self._margin_a * (1.0 + margins)
        sd_a, sd_per_a = expected.sd_a, expected.sd_per_a
        if sd_a is None:
            sd_a = max(_UNKNOWN_SD_SHARE * self._full_scale_a, expected.corrected_a)
        self._sd_a = max(sd_a, self._margin_a)
        self._sd_per_a = _UNKNOWN_SD_PER_A if sd_per_a is None else sd_per_a
        self.sums: JunctionSums | None = None
        self.currents_a: Mapping[str, tuple[float, float]] = {}
        self.instant_s = self._judged_s = float("-inf")
        self.forget()

    def forget(self) -> None:
        """Begin new windows."""
        self._window: deque[_Moment] = deque()
        self._recent: deque[_Moment] = deque()
        """The end of the window, over which the mean of the corrected sum is taken."""
        self._sum = self._directed = self._measured = self._measured2 = self._corrected2 = 0.0
        self._jump: tuple[float, int, Verdict] | None = None
        """Instant at which a jump began [s], instants since, and what it looked like then."""
        self._verdict: Verdict | None = None

    def look(self, now_s: float) -> JunctionSums | None:
        """Take the sums of now [s]; None while a fitted branch is stale or has no value."""
        self.sums = None
        branches = list(self._branches.values())
        found = aligned_currents(branches, {branch.name: branch.delay_s for branch in branches}, now_s)
        if found is None:
            return None
        self.instant_s, self.currents_a = found
        measured, corrected = zip(*self.currents_a.values(), strict=True)
        self.sums = JunctionSums(measured_a=sum(measured), corrected_a=sum(corrected))
        if not self.is_whole(now_s):
            self.forget()
        elif self.instant_s > self._judged_s and len(self.currents_a) > 1:  # of one branch alone nothing is known
            self._judged_s = self.instant_s
            self._remember(self.instant_s, self.sums, corrected)
            self._verdict = self._judge()
        return self.sums

    def _remember(self, instant_s: float, sums: JunctionSums, corrected: Sequence[float]) -> None:
        """Take one instant into the windows, and those that are too old out of them."""
        measured_a, corrected_a = sums.measured_a - self._expected_a, sums.corrected_a - self._expected_a
        deviations = corrected_a / self._sum_sd_a(corrected)
        deviations = min(max(deviations, -_LARGEST_DEVIATION), _LARGEST_DEVIATION)
        directed = math.copysign(1.0, max(corrected, key=abs)) * deviations
        latest = {name: self._branches[name].latest() for name in self.currents_a}
        codes = {name: seen[1] for name, seen in latest.items() if seen is not None}
        moment = _Moment(instant_s, measured_a, corrected_a, deviations, directed, self.currents_a, codes)
        self._window.append(moment)
        self._recent.append(moment)
        self._count(moment, 1)
        self._sum += deviations
        self._directed += directed
        while instant_s - self._window[0].time_s > self._window_s:
            self._count(self._window.popleft(), -1)
        while instant_s - self._recent[0].time_s > _PLAUSIBILITY_WINDOW_S:
            old = self._recent.popleft()
            self._sum -= old.deviations
            self._directed -= old.directed

    def _count(self, moment: _Moment, times: int) -> None:
        self._measured += times * moment.measured_a
        self._measured2 += times * moment.measured_a**2
        self._corrected2 += times * moment.corrected_a**2

    def _sum_sd_a(self, corrected: Sequence[float]) -> float:
        """Standard deviation that the sum of these currents may have. [A]"""
        return math.hypot(self._sd_a, self._sd_per_a * 0.5 * sum(map(abs, corrected)))

    def verdict(self) -> Verdict | None:
        """Why the parameters in force must not be used any more; None while they may."""
        return self._verdict

    def _judge(self) -> Verdict | None:
        recent, window = self._recent, self._window
        if (jump := self._jumped()) is not None:
            return jump
        is_recent = len(recent) >= _LEAST_LOOKS and recent[-1].time_s - recent[0].time_s >= 0.5 * _PLAUSIBILITY_WINDOW_S
        if is_recent and max(abs(self._sum), abs(self._directed)) > _MOST_DEVIATIONS * len(recent):
            return self._explaining()
        if len(window) < _LEAST_LOOKS or window[-1].time_s - window[0].time_s <= 0.9 * self._window_s:
            return None
        mean_a, mean2 = self._measured / len(window), self._measured2 / len(window)
        if mean2 - mean_a**2 > (_STUCK_SHARE * self._full_scale_a) ** 2 and (stuck := self._stuck()):
            return Reason.BRANCH_STUCK, stuck
        is_worse = math.sqrt(max(self._corrected2 / len(window), 0.0)) > math.sqrt(max(mean2, 0.0)) + self._allowed_a
        return (Reason.CORRECTION_WORSE, ()) if is_worse else None

    def _jumped(self) -> Verdict | None:
        """What a jump looked like when it began; None unless there is one, and it has lasted."""
        instant_s, residual_a = self._recent[-1].time_s, self._recent[-1].corrected_a
        currents_a = {name: pair[1] for name, pair in self.currents_a.items()}
        moved = {name: self._branches[name].moved_a(instant_s, _MOVING_S, _MOVING_FRAMES) for name in currents_a}
        most = max(moved, key=lambda name: moved[name].distance_a)
        others_a = sum(movement.distance_a for movement in moved.values()) - moved[most].distance_a
        limit_a = max(_JUMP_DEVIATIONS * self._sum_sd_a([*currents_a.values()]), _JUMP_SHARE * self._full_scale_a)
        if max(abs(residual_a), moved[most].flicker_a) - others_a <= limit_a:
            self._jump = None
            return None
        if self._jump is None:
            still = [name for name, movement in moved.items() if movement.distance_a == 0.0]
            is_step = moved[most].step_a >= 0.5 * moved[most].distance_a
            frozen = () if is_step else self._frozen(still, residual_a)
            self._jump = instant_s, 0, (Reason.BRANCH_STUCK, frozen) if frozen else (Reason.SUM_IMPLAUSIBLE, (most,))
        since_s, looks, verdict = self._jump
        self._jump = since_s, looks + 1, verdict
        return verdict if looks + 1 >= _JUMP_LOOKS and instant_s - since_s >= _JUMP_S else None

    def _frozen(self, still: Sequence[str], residual_a: float = 0.0) -> tuple[str, ...]:
        """Those of the branches at a constant current that is no rest, and large enough to be what the sum lacks."""
        least_a = max(self._rest_a, 0.5 * abs(residual_a))
        return tuple(name for name in still if abs(self.currents_a[name][1]) > least_a)

    def _stuck(self) -> tuple[str, ...]:
        """Branches whose code never changed in the window, unless a gain error of another one explains the sum."""
        window = self._window
        still = [name for name, code in window[-1].codes.items() if all(m.codes.get(name) == code for m in window)]
        measured_a = [moment.measured_a for moment in window]
        for name in self.currents_a.keys() - still:
            fit = _fit([moment.currents_a.get(name, (0.0, 0.0))[0] for moment in window], measured_a)
            if fit.explains and abs(fit.slope) < _LARGEST_SLOPE:
                return ()
        return self._frozen(still)

    def _explaining(self) -> Verdict:
        """Which gain error explains the sums since they went wrong best; all branches, if an offset explains them."""
        moments = list(self._recent)
        good = (number for number, moment in enumerate(moments) if abs(moment.deviations) < 1.0)
        since = moments[max(good, default=-1) + 1 :]
        moments = since if len(since) >= _LEAST_LOOKS else moments
        residual = [moment.corrected_a for moment in moments]
        rows = {name: [moment.currents_a.get(name, (0.0, 0.0))[1] for moment in moments] for name in self.currents_a}
        still = [name for name, row in rows.items() if min(row) == max(row)]
        if frozen := self._frozen(still):
            fits = [_fit(row, residual) for name, row in rows.items() if name not in still]
            if any(fit.explains and abs(fit.slope) >= _LARGEST_SLOPE for fit in fits):
                return Reason.BRANCH_STUCK, frozen
        left = {name: _left_of_gain(row, residual) for name, row in rows.items()}
        of_offset = _fit(residual, residual).variance * len(residual)
        best = min(left.values())
        near = [name for name in left if left[name] <= _NEARLY_AS_GOOD * best or of_offset <= best]
        return Reason.SUM_IMPLAUSIBLE, tuple(sorted(near, key=left.__getitem__))


def _left_of_gain(current: Sequence[float], residual: Sequence[float]) -> float:
    """What a gain error of a branch leaves of the squares of the sums."""
    own = math.fsum(value * value for value in current)
    both = math.fsum(a * b for a, b in zip(current, residual, strict=True))
    return math.fsum(value * value for value in residual) - (both * both / own if own else 0.0)


class _Fit(NamedTuple):
    """A straight line through points."""

    slope: float
    explains: bool
    """Whether little is left around it."""
    variance: float
    """That of the points."""


def _fit(x: Sequence[float], y: Sequence[float]) -> _Fit:
    count = len(x)
    mean_x, mean_y = math.fsum(x) / count, math.fsum(y) / count
    xx = math.fsum((value - mean_x) ** 2 for value in x) / count
    yy = math.fsum((value - mean_y) ** 2 for value in y) / count
    xy = math.fsum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / count
    slope = xy / xx if xx else 0.0
    return _Fit(slope, yy - slope * xy <= (1.0 - _EXPLAINS) * yy, yy)
