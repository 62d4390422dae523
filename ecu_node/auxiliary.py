"""A voltage, a temperature or a state as the node sees it live. Times are those of one steady clock, passed in. [s]"""

from collections.abc import Callable

from ecu_node.bits import PlacedSignal
from ecu_node.codes import Codes
from ecu_node.past import Frames, Past

__all__ = ["Auxiliary"]


class Auxiliary:
    """A signal that corrections need beside the current: a voltage or a temperature.

    Parameters
    ----------
    codes : Codes
        Of the signal. [V or degC]
    timeout_s : float
        Without a frame for this long its value is not used any more. [s]
    """

    def __init__(self, codes: Codes, timeout_s: float) -> None:
        self.code: int | None = None
        """Last code that is a value."""
        self.when_changed: list[Callable[[int | None], None]] = []
        self.is_needed = True
        """Whether a plan that is in force, or the watch, depends on it."""
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
        self._set(code if self._codes.is_value(code) else None)

    def expire(self, now_s: float) -> None:
        """Forget a value that is too old."""
        if self.code is not None and now_s - self._time_s > self._timeout_s:
            self._set(None)

    def value(self) -> float | None:
        """Last value [V or degC]; None if there is none, or it is too old."""
        return None if self.code is None else self._value_of(self.code)

    def value_at(self, time_s: float) -> float | None:
        """Value in the last frame up to a time [V or degC]; None if there is none, it is no value, or too old."""
        for seen_s, code in self._past.newest_first():
            if seen_s <= time_s:
                is_known = time_s - seen_s <= self._timeout_s and self._codes.is_value(code)
                return self._value_of(code) if is_known else None
        return None

    def _value_of(self, code: int) -> float:
        return float(self._codes.scale) * code + float(self._codes.offset)

    def _set(self, code: int | None) -> None:
        if code != self.code:
            self.code = code
            for react in self.when_changed:
                react(code)
