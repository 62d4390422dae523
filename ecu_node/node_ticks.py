"""What both kinds of node do beside the frames: look at the junction, publish the status, and whatever else is due."""

from collections.abc import Callable

from ecu_node.clocks import TimeOfDay
from ecu_node.corrector import Corrector
from ecu_node.links import data_frame
from ecu_node.own_frames import OwnFrames
from ecu_node.steady_bus import SteadyBus

__all__ = ["LONGEST_WAIT_S", "OnTick", "Ticking"]

LONGEST_WAIT_S = 0.1
"""A wake-up at least this often, so that a request to stop is seen. [s]"""
_LOOK_EVERY_S = 0.1
"""The junction is looked at, and the watchdog fed, at least this often, however rare the status is. [s]"""

OnTick = Callable[[float, bool], None]
"""Takes the steady clock's time [s], and whether the whole node works."""


class Ticking:
    """Does each of these when it is due.

    Parameters
    ----------
    corrector : Corrector
        The core.
    period_s : float
        Between status messages. [s]
    on_tick : OnTick
        Called after each look.
    works : callable
        Whether all that works beside this does.
    """

    def __init__(
        self, corrector: Corrector, period_s: float, on_tick: OnTick, works: Callable[[], bool] = lambda: True
    ) -> None:
        self._corrector, self.period_s, self._on_tick, self._works = corrector, period_s, on_tick, works
        self._due_s = self._status_due_s = float("-inf")
        self.time_of_day = TimeOfDay(corrector.counters)

    def is_due(self, now_s: float) -> bool:
        """Whether there is something else to do than to receive."""
        return now_s >= self._due_s

    def wait_s(self, now_s: float) -> float:
        """How long there is nothing to do but to receive; 0 if it is time. [s]"""
        return min(LONGEST_WAIT_S, max(0.0, self._due_s - now_s))

    def tick(self, now_s: float, heard_s: float, bus: SteadyBus, own: OwnFrames) -> None:
        """Do it if it is due; no branch is stale for what has not been heard yet."""
        if now_s < self._due_s:
            return
        self._due_s = _next_s(self._due_s, min(self.period_s, _LOOK_EVERY_S), now_s)
        corrector = self._corrector
        corrector.look(heard_s)
        status = corrector.status() if now_s >= self._status_due_s else None
        if status is not None:
            self._status_due_s = _next_s(self._status_due_s, self.period_s, now_s)
            fields, data = status
            own.sent(fields.key, data)
            bus.send(data_frame(fields.key, data, fd=fields.fd))
            corrector.counters.send_errors += bus.flush()[1]
        self._on_tick(now_s, self._works())


def _next_s(due_s: float, period_s: float, now_s: float) -> float:
    """When something periodic is due again: in step, unless it is late by a whole period. [s]"""
    return due_s + period_s if due_s + period_s > now_s else now_s + period_s
