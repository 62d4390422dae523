"""A voltage or a state as the node sees it live. Times are those of one steady clock, passed in. [s]"""

from ecu_node.bits import PlacedSignal
from ecu_node.codes import Codes
from ecu_node.past import Frames, Past

__all__ = ["Auxiliary"]


class Auxiliary:
    """A signal that the node needs beside the currents: a voltage, or the state that the watch depends on.

    Parameters
    ----------
    codes : Codes
        Of the signal. [V, or of the state]
    timeout_s : float
        Without a frame for this long its value is not used any more. [s]
    """

    def __init__(self, codes: Codes, timeout_s: float) -> None:
        self.code: int | None = None
        """Last code that is a value."""
        self._codes = codes
        self._timeout_s = timeout_s
        self._time_s = 0.0
        self._past = Past()

    def follow(self, signal: PlacedSignal, frames: Frames) -> None:
        """Look for the signal in these frames, when its past is asked for."""
        self._past = Past(signal, frames)

    def take(self, code: int, now_s: float) -> None:
        """Take the code of a new frame."""
        self._time_s = now_s
        self.code = code if self._codes.is_value(code) else None

    def expire(self, now_s: float) -> None:
        """Forget a value that is too old."""
        if self.code is not None and now_s - self._time_s > self._timeout_s:
            self.code = None

    def value_at(self, time_s: float) -> float | None:
        """Value in the last frame up to a time [V]; None if there is none, it is no value, or too old."""
        for seen_s, code in self._past.newest_first():
            if seen_s <= time_s:
                is_known = time_s - seen_s <= self._timeout_s and self._codes.is_value(code)
                return float(self._codes.scale) * code + float(self._codes.offset) if is_known else None
        return None
