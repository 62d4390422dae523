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

__all__ = [
    "NOTHING_EXPECTED",
    "ExpectedSum",
    "JunctionSums",
    "JunctionWatch",
    "Verdict",
    "aligned_currents",
    "simultaneous_currents",
]


_MOST_MARGINS = 10.0
"""More than so many margins nobody may expect the corrected sum to be worse."""
_LEAST_LOOKS = 10
"""Sums that a verdict needs."""
_MOST_LOOKS = 200
"""Parts of a window, each with the sums of its looks: a long window is to cost no more than a short one."""
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
    return simultaneous_currents([branch for branch in branches if branch.is_fitted], delays_s, now_s)


def simultaneous_currents(
    branches: Sequence[LiveBranch], delays_s: Mapping[str, float], now_s: float
) -> tuple[float, dict[str, tuple[float, float]]] | None:
    """Take the currents of just these branches, fitted or not; otherwise as :func:`aligned_currents`."""
    latest = [found for branch in branches if not branch.is_stale(now_s) and (found := branch.latest()) is not None]
    if not branches or len(latest) < len(branches):
        return None
    delays = [delays_s.get(branch.name, 0.0) for branch in branches]
    instant_s = min(seen_s - delay_s for delay_s, (seen_s, _) in zip(delays, latest, strict=True))
    currents = {
        branch.name: branch.currents_at(instant_s + delay_s) for branch, delay_s in zip(branches, delays, strict=True)
    }
    known = {name: pair for name, pair in currents.items() if pair is not None}
    return (instant_s, known) if len(known) == len(branches) else None


Verdict = tuple[Reason, tuple[str, ...]]
"""Why parameters must not be used any more, and the branches that explain it best, the best one first."""


class _Moment(NamedTuple):
    """One instant of the junction."""

    time_s: float
    residual_a: float
    deviations: float
    """The residual in standard deviations, signed."""
    directed: float
    """The same, with the sign of the largest current: a gain error keeps its sign in it."""
    currents_a: Mapping[str, float]


class Plausibility:
    """Whether the corrected sum may be what it is, whichever sensor is the reason.

    A gain error or an offset shows in the mean of the sum over some seconds. A jump shows within some frames: the sum,
    or one branch alone, has moved farther than all the others together. What a load does, another branch shows too.

    Parameters
    ----------
    branches : sequence of LiveBranch
        All branches of the layout.
    full_scale_a : float
        Nominal maximum current of the junction. [A]
    """

    def __init__(self, branches: Sequence[LiveBranch], full_scale_a: float) -> None:
        self._branches = {branch.name: branch for branch in branches}
        self._least_jump_a, self._rest_a = _JUMP_SHARE * full_scale_a, _REST_SHARE * full_scale_a
        self.restart(sd_a=0.0, sd_per_a=0.0)

    def restart(self, *, sd_a: float, sd_per_a: float) -> None:
        """Judge by these standard deviations from now on: sqrt(sd_a^2 + (sd_per_a * throughput)^2). [A, 1]"""
        self._sd_a, self._sd_per_a = sd_a, sd_per_a
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._moments: deque[_Moment] = deque()
        self._sum = self._directed = 0.0
        self._jump: tuple[float, int, Verdict] | None = None
        """Instant at which a jump began [s], instants since, and what it looked like then."""
        self.verdict: Verdict | None = None
        """Why the sum is not plausible; None while it is."""

    def look(self, instant_s: float, currents_a: Mapping[str, float], residual_a: float) -> None:
        """Take one instant: corrected currents of the fitted branches, and their sum less what is expected. [A]"""
        throughput_a = 0.5 * sum(map(abs, currents_a.values()))
        sd_a = math.hypot(self._sd_a, self._sd_per_a * throughput_a)
        largest = max(currents_a.values(), key=abs)
        deviations = min(max(residual_a / sd_a, -_LARGEST_DEVIATION), _LARGEST_DEVIATION)
        moment = _Moment(instant_s, residual_a, deviations, math.copysign(1.0, largest) * deviations, currents_a)
        self._moments.append(moment)
        self._sum += moment.deviations
        self._directed += moment.directed
        while instant_s - self._moments[0].time_s > _PLAUSIBILITY_WINDOW_S:
            old = self._moments.popleft()
            self._sum -= old.deviations
            self._directed -= old.directed
        if self._jumped(instant_s, residual_a, max(_JUMP_DEVIATIONS * sd_a, self._least_jump_a)):
            assert self._jump is not None
            self.verdict = self._jump[2]
        elif self._strays():
            self.verdict = self._explaining()

    def _strays(self) -> bool:
        moments = self._moments
        if len(moments) < _LEAST_LOOKS or moments[-1].time_s - moments[0].time_s < 0.5 * _PLAUSIBILITY_WINDOW_S:
            return False
        return max(abs(self._sum), abs(self._directed)) > _MOST_DEVIATIONS * len(moments)

    def _jumped(self, instant_s: float, residual_a: float, limit_a: float) -> bool:
        currents_a = self._moments[-1].currents_a
        moved = {name: self._branches[name].moved_a(instant_s, _MOVING_S, _MOVING_FRAMES) for name in currents_a}
        most = max(moved, key=lambda name: moved[name].distance_a)
        others_a = sum(movement.distance_a for movement in moved.values()) - moved[most].distance_a
        if max(abs(residual_a), moved[most].flicker_a) - others_a <= limit_a:
            self._jump = None
            return False
        if self._jump is None:
            still = [name for name, movement in moved.items() if movement.distance_a == 0.0]
            is_step = moved[most].step_a >= 0.5 * moved[most].distance_a
            frozen = () if is_step else self._frozen(still, currents_a, residual_a)
            self._jump = instant_s, 0, (Reason.BRANCH_STUCK, frozen) if frozen else (Reason.SUM_IMPLAUSIBLE, (most,))
        since_s, looks, verdict = self._jump
        self._jump = since_s, looks + 1, verdict
        return looks + 1 >= _JUMP_LOOKS and instant_s - since_s >= _JUMP_S

    def _frozen(self, still: Sequence[str], currents_a: Mapping[str, float], residual_a: float) -> tuple[str, ...]:
        """Those of the branches at a constant current that is no rest, and large enough to be what the sum lacks."""
        least_a = max(self._rest_a, 0.5 * abs(residual_a))
        return tuple(name for name in still if abs(currents_a[name]) > least_a)

    def _explaining(self) -> Verdict:
        """Which gain error explains the sums since they went wrong best; all branches, if an offset explains them."""
        moments = list(self._moments)
        good = (number for number, moment in enumerate(moments) if abs(moment.deviations) < 1.0)
        since = moments[max(good, default=-1) + 1 :]
        moments = since if len(since) >= _LEAST_LOOKS else moments
        residual = [moment.residual_a for moment in moments]
        rows = {name: [moment.currents_a.get(name, 0.0) for moment in moments] for name in self._moments[-1].currents_a}
        still = [name for name, row in rows.items() if min(row) == max(row)]
        if frozen := self._frozen(still, self._moments[-1].currents_a, 0.0):
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
    left: float
    """Variance around it."""
    variance: float
    """That of the points."""

    @property
    def explains(self) -> bool:
        """Whether little is left around it."""
        return self.left <= (1.0 - _EXPLAINS) * self.variance


def _fit(x: Sequence[float], y: Sequence[float]) -> _Fit:
    count = len(x)
    mean_x, mean_y = math.fsum(x) / count, math.fsum(y) / count
    xx = math.fsum((value - mean_x) ** 2 for value in x) / count
    yy = math.fsum((value - mean_y) ** 2 for value in y) / count
    xy = math.fsum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / count
    slope = xy / xx if xx else 0.0
    return _Fit(slope, max(yy - slope * xy, 0.0), yy)


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


NOTHING_EXPECTED = ExpectedSum()
"""Right sensors sum to 0 A, and nothing more is known."""


class JunctionWatch:
    """Sums of the junction, and their recent past.

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
    is_whole : callable
        Whether all currents of the junction are measured now; sums of other times are published, but not judged.
    """

    def __init__(
        self,
        branches: Sequence[LiveBranch],
        *,
        window_s: float,
        margin_a: float,
        full_scale_a: float,
        is_whole: Callable[[float], bool] = lambda _: True,
    ) -> None:
        self._branches, self.is_whole = branches, is_whole
        self._window_s, self._margin_a = window_s, margin_a
        self._stuck_a, self._rest_a = _STUCK_SHARE * full_scale_a, _REST_SHARE * full_scale_a
        self._full_scale_a = full_scale_a
        self._plausibility = Plausibility(branches, full_scale_a)
        self.restart()

    def restart(self, expected: ExpectedSum = NOTHING_EXPECTED) -> None:
        """Forget what was seen, and judge by this from now on."""
        worse_a, sd_a, sd_per_a = expected.predicted_worse_a, expected.sd_a, expected.sd_per_a
        self._expected_a = expected.expected_a
        self._allowed_a = self._margin_a * (1.0 + min(max(worse_a / self._margin_a, 0.0), _MOST_MARGINS))
        if sd_a is None:
            sd_a = max(_UNKNOWN_SD_SHARE * self._full_scale_a, expected.corrected_a)
        self._plausibility.restart(
            sd_a=max(sd_a, self._margin_a), sd_per_a=_UNKNOWN_SD_PER_A if sd_per_a is None else sd_per_a
        )
        self.forget()

    def forget(self) -> None:
        """Begin a new window."""
        self._plausibility.forget()
        self._past: deque[_Looks] = deque()
        self._instant_s = float("-inf")
        self.sums: JunctionSums | None = None
        self.currents_a: Mapping[str, tuple[float, float]] = {}
        """Measured and corrected currents of the last instant that was known, by branch. [A]"""

    def look(self, now_s: float) -> JunctionSums | None:
        """Take the sums of now.

        Parameters
        ----------
        now_s : float
            Now. [s]

        Returns
        -------
        JunctionSums or None
            None while a fitted branch is stale or has no value.
        """
        self.sums = None
        found = aligned_currents(self._branches, {branch.name: branch.delay_s for branch in self._branches}, now_s)
        if found is None:
            return None
        instant_s, currents = found
        self.currents_a = currents
        self.sums = JunctionSums(
            measured_a=sum(pair[0] for pair in currents.values()),
            corrected_a=sum(pair[1] for pair in currents.values()),
        )
        if not self.is_whole(now_s):
            self._past.clear()
            self._plausibility.forget()
        elif instant_s > self._instant_s:
            self._instant_s = instant_s
            if not self._past or now_s - self._past[-1].time_s >= self._window_s / _MOST_LOOKS:
                self._past.append(_Looks(now_s))
            latest = {branch.name: branch.latest() for branch in self._branches if branch.name in currents}
            measured_a = self.sums.measured_a - self._expected_a
            corrected_a = self.sums.corrected_a - self._expected_a
            self._past[-1].add(
                measured_a,
                corrected_a,
                {name: found[1] for name, found in latest.items() if found is not None},
                {name: pair[0] for name, pair in currents.items()},
            )
            if len(currents) > 1:  # of one branch alone nothing is known
                self._plausibility.look(instant_s, {name: pair[1] for name, pair in currents.items()}, corrected_a)
        while self._past and now_s - self._past[0].time_s > self._window_s:
            self._past.popleft()
        return self.sums

    def verdict(self) -> Verdict | None:
        """Why the parameters in force must not be used any more; None while they may."""
        if self._plausibility.verdict is not None:
            return self._plausibility.verdict
        if stuck := self._stuck():
            return Reason.BRANCH_STUCK, tuple(branch.name for branch in stuck)
        return (Reason.CORRECTION_WORSE, ()) if self._is_worse() else None

    def _is_worse(self) -> bool:
        """Whether the corrected sums of a whole window are worse than the measured ones."""
        if not self._is_full():
            return False
        count = sum(looks.count for looks in self._past)
        measured, corrected = (
            math.sqrt(sum(squares) / count)
            for squares in zip(*((looks.measured2, looks.corrected2) for looks in self._past), strict=True)
        )
        return corrected > measured + self._allowed_a

    def _stuck(self) -> list[LiveBranch]:
        """Branches whose code never changed in a whole window while the measured sum moved, which it must not."""
        if not self._is_full():
            return []
        count = sum(looks.count for looks in self._past)
        mean = sum(looks.measured for looks in self._past) / count
        if sum(looks.measured2 for looks in self._past) / count - mean**2 <= self._stuck_a**2:
            return []
        seen = {branch.name: {looks.codes.get(branch.name) for looks in self._past} for branch in self._branches}
        still = [branch for branch in self._branches if len(seen[branch.name]) == 1 and seen[branch.name] != {None}]
        if any(self._explains(branch) for branch in self._branches if branch not in still):
            return []
        return [branch for branch in still if self._flows(branch)]

    def _explains(self, branch: LiveBranch) -> bool:
        """Whether a gain error of a branch explains how the measured sum moves."""
        pairs = [
            (looks.currents_a[branch.name], looks.latest_a) for looks in self._past if branch.name in looks.currents_a
        ]
        if len(pairs) < _LEAST_LOOKS:
            return False
        fit = _fit([pair[0] for pair in pairs], [pair[1] for pair in pairs])
        return fit.explains and abs(fit.slope) < _LARGEST_SLOPE

    def _flows(self, branch: LiveBranch) -> bool:
        currents = branch.currents_at(branch.time_s)
        return currents is not None and abs(currents[0]) > self._rest_a

    def _is_full(self) -> bool:
        past = self._past
        return len(past) >= _LEAST_LOOKS and past[-1].time_s - past[0].time_s > 0.9 * self._window_s


class _Looks:
    """Sums, less what is expected, and codes of some looks at the junction, one after the other."""

    def __init__(self, time_s: float) -> None:
        self.time_s, self.count = time_s, 0
        self.measured = self.measured2 = self.corrected2 = 0.0
        self.codes: dict[str, int | None] = {}
        """By branch, the code of all of them; None if there were several."""
        self.latest_a = 0.0
        """The last measured sum [A], and the measured currents of that instant, by branch."""
        self.currents_a: Mapping[str, float] = {}

    def add(
        self, measured_a: float, corrected_a: float, codes: Mapping[str, int], currents_a: Mapping[str, float]
    ) -> None:
        self.count += 1
        self.latest_a, self.currents_a = measured_a, currents_a
        self.measured += measured_a
        self.measured2 += measured_a**2
        self.corrected2 += corrected_a**2
        before = self.codes
        self.codes = {name: code if before.get(name, code) == code else None for name, code in codes.items()}
