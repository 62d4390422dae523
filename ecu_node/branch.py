"""One branch as the node sees it live: its last code, what is made of it, and its recent past.

Currents are positive into the junction. Times are those of one steady clock, passed in. [s]
"""

from collections.abc import Callable

from ecu_node.auxiliary import Auxiliary
from ecu_node.bits import PlacedSignal
from ecu_node.codes import Codes
from ecu_node.correction import AS_IT_IS, IntegerPlan
from ecu_node.counters import Counters
from ecu_node.past import Frames, Past
from ecu_node.plan_function import plan_function
from ecu_node.sensor_fault import NO_FAULT, SensorFault
from ecu_node.status import Quality

__all__ = ["LiveBranch"]

_LEAST_VOLTAGE_V = 10.0
"""Below this the HV net is switched off, and power / voltage says nothing of the current. [V]"""


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
        self.out: int | None = None
        """The code to write; None where there is no value."""
        self.quality = Quality.PASSED_THROUGH
        """Of values; what is none is told by :meth:`why_no_value`."""
        self.when_changed: list[Callable[[], None]] = []
        """Called when :attr:`plan` or :attr:`quality` is another one."""
        self._past = Past()
        self._spoilt = False
        self._is_named = False
        self._time_s = self._awake_s = self._waited_s = float("-inf")
        self._scale, self._offset = float(sign * codes.scale), float(sign * codes.offset)
        self._passing = self._correcting = AS_IT_IS
        self._fix = plan_function(codes, AS_IT_IS, voltage, Counters())
        self.plan = AS_IT_IS
        """What is done now."""
        self.counters = Counters()
        """Where results beyond the ends are counted."""

    def put_in_force(
        self,
        *,
        fault: SensorFault,
        plan: IntegerPlan,
        passing: IntegerPlan,
        delay_s: float,
        expected_since_s: float | None,
        counters: Counters,
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
        counters : Counters
            Where results beyond the ends are counted.
        """
        self.fault, self.delay_s = fault, delay_s
        self._is_named = expected_since_s is not None
        if expected_since_s is not None:
            self._waited_s = max(self._waited_s, expected_since_s)
        self._passing, self._correcting, self.counters = passing, plan, counters
        self.activate(active=False)

    def activate(self, *, active: bool) -> None:
        """Correct, or pass through."""
        corrects = active and self.fault.applied
        self.plan = self._correcting if corrects else self._passing
        self.quality = Quality.CORRECTED if corrects else Quality.PASSED_THROUGH
        self._fix = plan_function(self.codes, self.plan, self.voltage, self.counters)
        latest = None if self._spoilt else self.latest()
        if latest is not None:  # what is published of the last code is to be of the quality that is told of it
            self.out = self._fix(latest[1])
        for react in self.when_changed:
            react()

    def follow(self, signal: PlacedSignal, frames: Frames) -> None:
        """Look for the signal in these frames, when its past is asked for."""
        self._past = Past(signal, frames)

    def take(self, code: int) -> int | None:
        """Take the code of an intact frame; the code to write, or None if it is no value."""
        self._spoilt = False
        out = self.out = self._fix(code)
        return out

    def spoil(self) -> None:
        """A frame came that must not be used: until the next one there is no value."""
        self.out, self._spoilt = None, True

    def fixed(self, code: int) -> int | None:
        """What would be written for a code; nothing is remembered."""
        return self._fix(code)

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

    @property
    def lacks_input(self) -> bool:
        """Whether a branch with a fault to correct is not corrected now: something that this needs is missing."""
        no_voltage = self.voltage is not None and self.plan.needs_voltage and self.voltage.code is None
        return self.quality is not Quality.CORRECTED or no_voltage or (self.seen and self.latest() is None)

    def why_no_value(self) -> Quality:
        """Why :attr:`out` is None: never seen, named "no value", a voltage missing; else its code was impossible."""
        found = next(self._past.newest_first(), None)
        if found is None:
            return Quality.NOT_AVAILABLE
        _, code = found
        known = not self._spoilt and (code in self.codes.named or self.codes.is_value(code))
        return Quality.NOT_AVAILABLE if known else Quality.INVALID

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
