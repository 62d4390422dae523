"""One branch as the node sees it live, and the signals beside it: last code, what is made of it, and the recent past.

Currents are positive into the junction. Times are those of one steady clock, passed in. [s]
"""

from collections import deque
from collections.abc import Callable, Iterator
from itertools import pairwise, takewhile
from typing import NamedTuple

from ecu_node.core.correction import AS_IT_IS, NO_FAULT, IntegerPlan, SensorFault
from ecu_node.core.signals import Codes, PlacedSignal
from ecu_node.core.status import Counters, Quality

REMEMBERED_FRAMES = 1024
"""Frames of a message that are remembered: longer than branches lag each other."""

Frames = deque[tuple[float, bytearray]]
"""Times [s] and payloads of the last intact frames of a message."""


class Past:
    """A signal in the last frames of its message; read only when it is asked for.

    Parameters
    ----------
    signal : PlacedSignal, optional
        Where it stands.
    frames : deque
        Frames that the message's source goes on to add to.
    """

    def __init__(self, signal: PlacedSignal | None = None, frames: Frames | None = None) -> None:
        self._signal = signal
        self._frames: Frames = deque() if frames is None else frames
        self._read: tuple[float, bytearray] | None = None
        """The last frame that was read."""
        self._codes: deque[tuple[float, int]] = deque(maxlen=REMEMBERED_FRAMES)

    def newest_first(self) -> Iterator[tuple[float, int]]:
        """Times and codes, back from the last frame that has the signal; each frame is read once. [s]"""
        if self._signal is not None and self._frames and self._frames[-1] is not self._read:
            new = list(takewhile(lambda frame: frame is not self._read, reversed(self._frames)))
            self._read = new[0]
            for time_s, payload in reversed(new):
                code = self._signal.code(payload)
                if code is not None:
                    self._codes.append((time_s, code))
        return reversed(self._codes)


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
        self._codes, self._timeout_s = codes, timeout_s
        self._past = Past()

    def follow(self, signal: PlacedSignal, frames: Frames) -> None:
        """Look for the signal in these frames, when it is asked for."""
        self._past = Past(signal, frames)

    def code_at(self, time_s: float) -> int | None:
        """Code in the last frame up to a time [s]; None if there is none, it is no value, or too old."""
        for seen_s, code in self._past.newest_first():
            if seen_s <= time_s:
                return code if time_s - seen_s <= self._timeout_s and self._codes.is_value(code) else None
        return None

    def value_at(self, time_s: float) -> float | None:
        """The same as a value. [V]"""
        code = self.code_at(time_s)
        return None if code is None else float(self._codes.scale) * code + float(self._codes.offset)


_LEAST_VOLTAGE_V = 10.0
"""Below this the HV net is switched off, and power / voltage says nothing of the current. [V]"""


_FLICKER_STEPS = 4
"""So many steps of one size are no load that was switched."""


class Movement(NamedTuple):
    """How a current moved in its last frames. [A]"""

    distance_a: float
    """Largest less smallest."""
    step_a: float
    """Largest step between two frames."""
    flicker_a: float
    """Size of a step that it made to and fro, as where frames of somebody else stand between those of the sensor."""


class LiveBranch:
    """One branch: state of its sensor, and what is made of it.

    Parameters
    ----------
    name : str
        As in the layout.
    codes : Codes
        Of the measured signal. [A, or W with a voltage]
    sign : int
        +1 if the signal is positive into the junction.
    timeout_s : float
        Without a frame for this long the branch is stale. [s]
    start_s : float
        So long after the bus has woken up its first frame may come, if that is longer. [s]
    voltage : Auxiliary or None
        Of a branch that is a power.
    """

    def __init__(
        self,
        *,
        name: str,
        codes: Codes,
        sign: int,
        timeout_s: float,
        start_s: float = 0.0,
        voltage: Auxiliary | None = None,
    ) -> None:
        self.name, self.codes, self.timeout_s, self._start_s = name, codes, timeout_s, start_s
        self.voltage = voltage
        self.fault = NO_FAULT
        self.delay_s = 0.0
        self.quality = Quality.PASSED_THROUGH
        """Of values."""
        self._past = Past()
        self._spoilt_s = float("-inf")
        self._is_named = False
        self._time_s = self._awake_s = self._waited_s = float("-inf")
        self._scale, self._offset = float(sign * codes.scale), float(sign * codes.offset)
        self._passing = self._correcting = self.plan = AS_IT_IS
        """What is done now to its codes."""
        self.when_changed: list[Callable[[], None]] = []
        """Called when :attr:`plan` has changed."""

    def put_in_force(
        self,
        *,
        fault: SensorFault,
        plan: IntegerPlan,
        passing: IntegerPlan,
        delay_s: float,
        expected_since_s: float | None,
    ) -> None:
        """Take a correction; it is used once :meth:`activate` says so.

        Parameters
        ----------
        fault : SensorFault
            What is corrected.
        plan : IntegerPlan
            The same in integers.
        passing : IntegerPlan
            What is written where nothing is corrected.
        delay_s : float
            How much later than the junction it is seen. [s]
        expected_since_s : float or None
            Since when its frames are waited for; None: not before the first one (a vehicle may lack the branch).
        """
        self.fault, self.delay_s = fault, delay_s
        self._is_named = expected_since_s is not None
        if expected_since_s is not None:
            self._waited_s = max(self._waited_s, expected_since_s)
        self._passing, self._correcting = passing, plan
        self.activate(active=False)

    def activate(self, *, active: bool, doubted: bool = False) -> None:
        """Correct, or pass through; a sensor that is in doubt is never said to be right."""
        corrects = active and self.fault.applied
        self.plan = self._correcting if corrects else self._passing
        self.quality = Quality.CORRECTED if corrects else Quality.IMPLAUSIBLE if doubted else Quality.PASSED_THROUGH
        for react in self.when_changed:
            react()

    def follow(self, signal: PlacedSignal, frames: Frames) -> None:
        """Look for the signal in these frames, when its past is asked for."""
        self._past = Past(signal, frames)

    def spoil(self, now_s: float) -> None:
        """A frame came that must not be used: until the next one there is no value."""
        self._spoilt_s = now_s

    @property
    def time_s(self) -> float:
        """When its last frame came [s]; -infinity if none did."""
        self._time_s = next((seen_s for seen_s, _ in self._past.newest_first()), self._time_s)
        return self._time_s

    def latest(self) -> tuple[float, int] | None:
        """When its last frame came, and its code; None if that is no value."""
        found = next(self._past.newest_first(), None)
        return found if found is not None and self.codes.is_value(found[1]) else None

    @property
    def seen(self) -> bool:
        """Whether a frame came since the bus was last asleep."""
        return self.time_s > self._awake_s

    @property
    def is_fitted(self) -> bool:
        """Whether the vehicle has this branch: the parameters name it, or it was seen in this drive."""
        return self._is_named or self.seen

    @property
    def deadline_s(self) -> float:
        """Until when its next frame must have come; infinity for a branch that is not fitted. [s]"""
        if self.seen:
            return self.time_s + self.timeout_s
        if self._is_named:
            return self._waited_s + max(self.timeout_s, self._start_s)
        return float("inf")

    def is_stale(self, now_s: float) -> bool:
        """Whether its next frame is overdue."""
        return now_s > self.deadline_s

    def is_old(self, now_s: float) -> bool:
        """Whether its last value is older than the timeout, whatever is waited for."""
        return now_s - self.time_s > self.timeout_s

    def expect(self, now_s: float) -> None:
        """Wait for frames from now on: the bus has woken up."""
        self._awake_s = self._waited_s = now_s

    def lacks_input(self, now_s: float) -> bool:
        """Whether a branch with a fault to correct is not corrected now: something that this needs is missing."""
        no_value = self.seen and self.latest() is None
        return self.quality is not Quality.CORRECTED or no_value or self._voltage_code(now_s) is None

    def _voltage_code(self, time_s: float) -> int | None:
        """Code of the voltage that the plan needs at a time; 0 where it needs none."""
        return self.voltage.code_at(time_s) if self.voltage is not None and self.plan.needs_voltage else 0

    def ordinary_codes(self) -> tuple[int, int]:
        """Least and greatest code of a range in which each is a value with a result that only the code decides.

        Returns
        -------
        first, last : int
            The first one is greater where there is no such range. Results beyond the ends of the signal are none.
        """
        plan, (first, last) = self.plan, (self.codes.lowest, self.codes.highest)
        while first in self.codes.named:
            first += 1
        while last in self.codes.named:
            last -= 1
        if plan.needs_voltage or plan.gain <= 0 or any(first <= code <= last for code in self.codes.named):
            return 1, 0
        least, beyond = plan.lowest << plan.shift, (plan.highest + 1) << plan.shift
        bias = plan.bias + (1 << (plan.shift - 1))
        return max(first, -((bias - least) // plan.gain)), min(last, (beyond - 1 - bias) // plan.gain)

    def convert(self, code: int, time_s: float, counters: Counters) -> tuple[int | None, Quality]:
        """What is written of a code that came at a time: None where it is no value; saturation is counted."""
        if not self.codes.is_value(code):
            return None, Quality.NOT_AVAILABLE if code in self.codes.named else Quality.INVALID
        voltage_code = self._voltage_code(time_s)
        if voltage_code is None:
            return None, Quality.NOT_AVAILABLE
        out = self.plan.apply(code, voltage_code)
        counters.saturated += out != self.plan.unbounded(code, voltage_code)
        return out, self.quality

    def published(self, now_s: float) -> tuple[int | None, Quality]:
        """What is written of it where no frame of it just came."""
        found = next(self._past.newest_first(), None)
        if found is None or now_s - found[0] > self.timeout_s:
            return None, Quality.NOT_AVAILABLE
        if found[0] <= self._spoilt_s:
            return None, Quality.INVALID
        return self.convert(found[1], found[0], Counters())

    def currents_at(self, time_s: float) -> tuple[float, float] | None:
        """Measured current and what the parameters make of it, whether or not they are in force.

        Parameters
        ----------
        time_s : float
            When, by the times of its frames; in between by linear interpolation. [s]

        Returns
        -------
        measured_a, corrected_a : float
            Positive into the junction [A]; None if no value is known of then.
        """
        code = self._code_at(time_s)
        if code is None:
            return None
        measured = self._scale * code + self._offset
        if self.voltage is not None:
            volts = self.voltage.value_at(time_s)
            if volts is None or volts < _LEAST_VOLTAGE_V:
                return None
            measured /= volts
        return measured, self.fault.true_current(measured)

    def moved_a(self, instant_s: float, since_s: float, frames: int) -> Movement:
        """How its corrected current moved in the frames before an instant of the junction.

        Parameters
        ----------
        instant_s : float
            The instant. [s]
        since_s : float
            Over so long before it; longer, where there are fewer frames than wanted. [s]
        frames : int
            So many are looked at, at least.

        Returns
        -------
        Movement
            That of a power at the voltage of the instant.
        """
        end_s = instant_s + self.delay_s
        codes: list[int] = []
        for seen_s, code in self._past.newest_first():
            if seen_s > end_s:
                codes = []  # but for the first one after the instant, towards which it is interpolated
            elif seen_s < end_s - since_s and len(codes) >= frames:
                break
            if self.codes.is_value(code):
                codes.append(code)
        volts = self.voltage.value_at(end_s) if self.voltage is not None else 1.0
        if not codes or volts is None or volts < (_LEAST_VOLTAGE_V if self.voltage is not None else 0.0):
            return Movement(0.0, 0.0, 0.0)
        per_code_a = abs(self._scale) / volts / (1.0 + self.fault.drift)
        steps = sorted((abs(later - earlier) for later, earlier in pairwise(codes)), reverse=True)
        return Movement(
            distance_a=per_code_a * (max(codes) - min(codes)),
            step_a=per_code_a * steps[0] if steps else 0.0,
            flicker_a=per_code_a * steps[_FLICKER_STEPS - 1] if len(steps) >= _FLICKER_STEPS else 0.0,
        )

    def _code_at(self, time_s: float) -> float | None:
        """Code at a time, between codes too; None if it is not known."""
        later: tuple[float, int] | None = None
        for sample in self._past.newest_first():
            seen_s, code = sample
            if not self.codes.is_value(code):
                return None
            if seen_s <= time_s:
                if later is None or later[0] <= seen_s:
                    return code
                return code + (time_s - seen_s) / (later[0] - seen_s) * (later[1] - code)
            later = sample
        return later[1] if later is not None and later[0] - time_s <= self.timeout_s else None
