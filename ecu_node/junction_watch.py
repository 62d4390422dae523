"""Junction watch: the Kirchhoff sum before and after correction, and whether the correction makes it worse.

Branches are looked at in the same instant of the junction: each at the time of its frames less its calibrated delay,
in between by linear interpolation. The instant is the newest one that all branches have reached. Currents are positive
into the junction. [A]
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ecu_node.branch import LiveBranch

__all__ = ["JunctionSums", "JunctionWatch"]

_MOST_MARGINS = 10.0
"""More than so many margins nobody may expect the corrected sum to be worse."""
_LEAST_LOOKS = 10
"""Sums that a verdict needs."""
_MOST_LOOKS = 200
"""Sums that are kept of a window, at equal distances: a long window is to cost no more than a short one."""
_STUCK_SHARE = 0.02
"""Standard deviation of the measured sum, in shares of full scale, at which a code that never changes is suspicious."""
_REST_SHARE = 0.005
"""Up to this share of full scale a current that never changes is one at rest, as a motor's at standstill."""


@dataclass(frozen=True, kw_only=True)
class JunctionSums:
    """Sum of all fitted branches in one instant, measured and corrected. [A]"""

    measured_a: float
    corrected_a: float


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
        self._branches, self._is_whole = branches, is_whole
        self._window_s, self._margin_a = window_s, margin_a
        self._stuck_a, self._rest_a = _STUCK_SHARE * full_scale_a, _REST_SHARE * full_scale_a
        self.restart()

    def restart(self, *, predicted_worse_a: float = 0.0) -> None:
        """Forget what was seen.

        Parameters
        ----------
        predicted_worse_a : float
            By how much the calibrator itself expects the corrected sum to be worse, as where an offset hides a load
            that no sensor sees; added to the margin, up to ten times that. [A]
        """
        self._allowed_a = self._margin_a * (1.0 + min(max(predicted_worse_a / self._margin_a, 0.0), _MOST_MARGINS))
        self.forget()

    def forget(self) -> None:
        """Begin a new window."""
        self._past: deque[tuple[float, JunctionSums, dict[str, int]]] = deque()
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
        fitted = [branch for branch in self._branches if branch.is_fitted]
        self.sums = None
        latest = [found for branch in fitted if not branch.is_stale(now_s) and (found := branch.latest()) is not None]
        if not fitted or len(latest) < len(fitted):
            return None
        instant_s = min(seen_s - branch.delay_s for branch, (seen_s, _) in zip(fitted, latest, strict=True))
        currents = [branch.currents_at(instant_s + branch.delay_s) for branch in fitted]
        known = [pair for pair in currents if pair is not None]
        if len(known) < len(fitted):
            return None
        self.sums = JunctionSums(measured_a=sum(pair[0] for pair in known), corrected_a=sum(pair[1] for pair in known))
        if not self._is_whole():
            self._past.clear()
        elif instant_s > self._instant_s and not self._is_close(now_s):
            self._instant_s = instant_s
            codes = {branch.name: code for branch, (_, code) in zip(fitted, latest, strict=True)}
            self._past.append((now_s, self.sums, codes))
        while self._past and now_s - self._past[0][0] > self._window_s:
            self._past.popleft()
        return self.sums

    def is_worse(self) -> bool:
        """Whether the corrected sums of a whole window are worse than the measured ones."""
        if not self._is_full():
            return False
        measured = [sums.measured_a for _, sums, _ in self._past]
        corrected = [sums.corrected_a for _, sums, _ in self._past]
        return _rms(corrected) > _rms(measured) + self._allowed_a

    def stuck(self) -> list[LiveBranch]:
        """Branches whose code never changed in a whole window while the measured sum moved, which it must not."""
        if not self._is_full():
            return []
        measured = [sums.measured_a for _, sums, _ in self._past]
        mean = sum(measured) / len(measured)
        if _rms([value - mean for value in measured]) <= self._stuck_a:
            return []
        seen = {branch.name: {codes.get(branch.name) for _, _, codes in self._past} for branch in self._branches}
        return [branch for branch in self._branches if len(seen[branch.name]) == 1 and self._flows(branch)]

    def _is_close(self, now_s: float) -> bool:
        """Whether the last sums that were kept are those of a moment ago."""
        return bool(self._past) and now_s - self._past[-1][0] < self._window_s / _MOST_LOOKS

    def _flows(self, branch: LiveBranch) -> bool:
        currents = branch.currents_at(branch.time_s)
        return currents is not None and abs(currents[0]) > self._rest_a

    def _is_full(self) -> bool:
        past = self._past
        return len(past) >= _LEAST_LOOKS and past[-1][0] - past[0][0] > 0.9 * self._window_s


def _rms(values: Sequence[float]) -> float:
    return float((sum(value * value for value in values) / len(values)) ** 0.5)
