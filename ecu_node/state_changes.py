"""What the log is told of the state: that the node falls back, and why, that the bus sleeps, and when that is over."""

from ecu_node.corrector import Corrector
from ecu_node.status import Reason

__all__ = ["StateChanges"]


class StateChanges:
    """Looks for changes of the state; those of the parameters are told by who reads them.

    Parameters
    ----------
    corrector : Corrector
        The core.
    """

    def __init__(self, corrector: Corrector) -> None:
        self._corrector = corrector
        self._before = corrector.latched, False

    def news(self) -> str | None:
        """One line on what has changed since the last time; None if nothing has."""
        corrector = self._corrector
        before = self._before
        latched, asleep = self._before = corrector.latched, corrector.is_asleep
        if self._before == before:
            return None
        if latched is not Reason.NONE:
            return f"passing measured values through until the bus has slept: {self._why()}"
        if asleep:
            return "the bus sleeps"
        if before[0] is not Reason.NONE:
            return "correcting again" if corrector.reason is Reason.NONE else None
        return "the bus is awake again"

    def _why(self) -> str:
        which = ", ".join(self._corrector.latched_branches)
        match self._corrector.latched:
            case Reason.BRANCH_STALE:
                return f"no frames of {which}"
            case Reason.BRANCH_STUCK:
                return f"{which} never changes"
        return "the corrected Kirchhoff sum is worse than the measured one"
