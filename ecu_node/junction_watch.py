"""Junction watch: the Kirchhoff sum before and after correction, and whether the correction makes it worse.

Branches are looked at in the same instant of the junction: each at the time of its frames less its calibrated delay,
in between by linear interpolation. The instant is the newest one that all branches have reached. Currents are positive
into the junction. [A]
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from ecu_node.branch import LiveBranch

__all__ = ["JunctionSums", "JunctionWatch", "aligned_currents", "simultaneous_currents"]

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
        is_whole: Callable[[], bool] = lambda: True,
    ) -> None:
        self._branches, self.is_whole = branches, is_whole
        self._window_s, self._margin_a = window_s, margin_a
        self._stuck_a, self._rest_a = _STUCK_SHARE * full_scale_a, _REST_SHARE * full_scale_a
        self.restart()

    def restart(self, *, expected_a: float = 0.0, predicted_worse_a: float = 0.0) -> None:
        """Forget what was seen.

        Parameters
        ----------
        expected_a : float
            What right sensors would show: the load that none of them sees. Sums are judged by how far they are from
            it. [A]
        predicted_worse_a : float
            By how much the calibrator itself expects the corrected sum to be worse, as where one of two offsets that
            cancel is corrected; added to the margin, up to ten times that. [A]
        """
        self._expected_a = expected_a
        self._allowed_a = self._margin_a * (1.0 + min(max(predicted_worse_a / self._margin_a, 0.0), _MOST_MARGINS))
        self.forget()

    def forget(self) -> None:
        """Begin a new window."""
        self._past: deque[_Looks] = deque()
        self._instant_s = float("-inf")
        self.sums: JunctionSums | None = None

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
        self.sums = JunctionSums(
            measured_a=sum(pair[0] for pair in currents.values()),
            corrected_a=sum(pair[1] for pair in currents.values()),
        )
        if not self.is_whole():
            self._past.clear()
        elif instant_s > self._instant_s:
            self._instant_s = instant_s
            if not self._past or now_s - self._past[-1].time_s >= self._window_s / _MOST_LOOKS:
                self._past.append(_Looks(now_s))
            latest = {branch.name: branch.latest() for branch in self._branches if branch.name in currents}
            self._past[-1].add(
                self.sums.measured_a - self._expected_a,
                self.sums.corrected_a - self._expected_a,
                {name: found[1] for name, found in latest.items() if found is not None},
            )
        while self._past and now_s - self._past[0].time_s > self._window_s:
            self._past.popleft()
        return self.sums

    def is_worse(self) -> bool:
        """Whether the corrected sums of a whole window are worse than the measured ones."""
        if not self._is_full():
            return False
        count = sum(looks.count for looks in self._past)
        measured, corrected = (
            math.sqrt(sum(squares) / count)
            for squares in zip(*((looks.measured2, looks.corrected2) for looks in self._past), strict=True)
        )
        return corrected > measured + self._allowed_a

    def stuck(self) -> list[LiveBranch]:
        """Branches whose code never changed in a whole window while the measured sum moved, which it must not."""
        if not self._is_full():
            return []
        count = sum(looks.count for looks in self._past)
        mean = sum(looks.measured for looks in self._past) / count
        if sum(looks.measured2 for looks in self._past) / count - mean**2 <= self._stuck_a**2:
            return []
        seen = {branch.name: {looks.codes.get(branch.name) for looks in self._past} for branch in self._branches}
        still = [branch for branch in self._branches if len(seen[branch.name]) == 1 and seen[branch.name] != {None}]
        return [branch for branch in still if self._flows(branch)]

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

    def add(self, measured_a: float, corrected_a: float, codes: Mapping[str, int]) -> None:
        self.count += 1
        self.measured += measured_a
        self.measured2 += measured_a**2
        self.corrected2 += corrected_a**2
        before = self.codes
        self.codes = {name: code if before.get(name, code) == code else None for name, code in codes.items()}
