"""Times of frames on the steady clock, which nobody sets, from time stamps by the time of day, which may be set."""

import time

from ecu_node.counters import Counters

__all__ = ["TimeOfDay", "steady_time_s"]

_OLDEST_FRAME_S = 10.0
"""No frame waits for longer, unless the whole process pauses. [s]"""
_LARGEST_JITTER_S = 0.05
"""By more than this the time of day changes against the steady clock only if it is set. [s]"""


def steady_time_s(stamp_s: float, now_s: float, clock_ahead_s: float) -> float:
    """When a frame came, on the steady clock.

    Parameters
    ----------
    stamp_s : float
        Its time stamp by the kernel or the adapter; 0 if there is none. [s]
    now_s : float
        The steady clock now. [s]
    clock_ahead_s : float
        By how much the time of day is ahead of the steady clock; infinity if it was set a short while ago. [s]

    Returns
    -------
    float
        The stamp on the steady clock; now if there is none, it would be in the future, or the clock was set.
    """
    if stamp_s == 0.0 or clock_ahead_s == float("inf"):
        return now_s
    return min(stamp_s - clock_ahead_s, now_s)


class TimeOfDay:
    """By how much the time of day is ahead of the steady clock, and whether it was set.

    Parameters
    ----------
    counters : Counters
        Where it is counted how often it was set.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        while (ahead_s := _ahead_s()) is None:
            pass
        self._ahead_s = ahead_s
        self._set_s = float("-inf")

    def ahead_s(self) -> float:
        """By how much it is ahead now [s]; infinity while frames may be waiting that were stamped before it was set."""
        now_s = time.monotonic()
        ahead_s = _ahead_s()
        if ahead_s is None:
            ahead_s = self._ahead_s
        if abs(ahead_s - self._ahead_s) > _LARGEST_JITTER_S:
            self._set_s = now_s
            self._counters.clock_steps += 1
        self._ahead_s = ahead_s
        return ahead_s if now_s - self._set_s > _OLDEST_FRAME_S else float("inf")


def _ahead_s() -> float | None:
    """By how much the time of day is ahead [s]; None if the process was held up between reading the two clocks."""
    before_s = time.monotonic()
    ahead_s = time.time() - before_s
    return ahead_s if time.monotonic() - before_s < _LARGEST_JITTER_S else None
