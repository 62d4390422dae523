"""The junction live: its branches, their Kirchhoff sum before and after correction, and whether it is plausible.

The watch asks three questions: does the correction make the sum worse than it was measured; does the corrected sum
leave the range that the parameter file allows (a sensor broke); does a branch never change while the sum moves.

All branches are compared at the same instant of the junction: a frame counts at its time less the calibrated delay of
its branch, and between frames currents are interpolated linearly. The instant is the newest one that all branches have
reached. Currents are positive into the junction [A]; times are those of one steady clock, passed in [s].
"""

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise, takewhile
from operator import add, mul, sub
from typing import NamedTuple

from ecu_node.core.correction import AS_IT_IS, NO_FAULT, IntegerPlan, SensorFault
from ecu_node.core.signals import BitPlace, Codes, PlacedSignal
from ecu_node.core.status import Counters, Quality, Reason
from ecu_node.parameters import NOTHING_EXPECTED, JunctionResidual

REMEMBERED_FRAMES = 1024
"""Number of frames of a message that are remembered: they reach back further than branches lag each other."""

Frames = deque[tuple[float, bytearray]]
"""Times [s] and payloads of the last intact frames of a message."""
Currents = Mapping[str, tuple[float, float]]
"""Measured and corrected current, by branch. [A]"""


class HeardSignal:
    """A signal in the last frames of its message; read only when it is asked for.

    Such signals are the branches themselves (:class:`LiveBranch`), voltages, and the input of the watch.

    Parameters
    ----------
    codes : Codes
        Codes of the signal.
    timeout_s : float
        Without a frame for this long its value is not used any more. [s]
    """

    def __init__(self, codes: Codes, timeout_s: float) -> None:
        self.codes, self.timeout_s = codes, timeout_s
        self.signal: PlacedSignal
        """The signal in its message; only where :meth:`follow` said which."""
        self._frames: Frames = deque()
        self._read: tuple[float, bytearray] | None = None
        """The last frame that was read."""
        self._past: deque[tuple[float, int]] = deque(maxlen=REMEMBERED_FRAMES)
        self._spoilt_s = -math.inf

    def follow(self, signal: PlacedSignal, frames: Frames) -> None:
        """From now on take values from ``frames``, to which the caller adds each new frame of the signal's message."""
        self.signal, self._frames = signal, frames

    def newest_first(self) -> Iterator[tuple[float, int]]:
        """Return pairs of time [s] and code of the remembered frames with the signal, the newest first.

        Each frame is decoded only once, however often this is called.
        """
        if self._frames and self._frames[-1] is not self._read:
            new = list(takewhile(lambda frame: frame is not self._read, reversed(self._frames)))
            self._read = new[0]
            for time_s, payload in reversed(new):
                code = self.signal.code(payload)
                if code is not None:
                    self._past.append((time_s, code))
        return reversed(self._past)

    def spoil(self, now_s: float) -> None:
        """Note that a frame came that must not be used: there is no value until the next usable frame."""
        self._spoilt_s = now_s

    def code_at(self, time_s: float) -> int | None:
        """Return the code of the last frame up to a time [s]; None if there is none, or it is too old or no value.

        None, too, if a frame that must not be used came since.
        """
        for seen_s, code in self.newest_first():
            if seen_s <= time_s:
                is_usable = seen_s > self._spoilt_s and time_s - seen_s <= self.timeout_s
                return code if is_usable and self.codes.is_value(code) else None
        return None


_LEAST_VOLTAGE_V = 10.0
"""Below this the HV net is switched off, and power / voltage says nothing of the current. [V]"""
_FLICKER_STEPS = 4
"""A current that makes this many large steps in its last frames flickers; a load that is switched makes fewer."""


class Movement(NamedTuple):
    """How a current moved in its last frames. [A]"""

    distance_a: float
    """Largest less smallest value."""
    step_a: float
    """Largest step between two frames."""
    flicker_a: float
    """Its fourth largest step: large if it goes to and fro, as when another sender's frames are among the sensor's."""


class Written(NamedTuple):
    """Where a branch stands in an outgoing payload."""

    place: BitPlace
    not_available: int | None = None
    """Code for "no value"; None, as in a gateway: where there is no value, the payload stays as it is."""
    quality: BitPlace | None = None

    def put(self, payload: bytearray, out: int | None, quality: Quality) -> None:
        """Write a code (None: "no value") and its quality."""
        code = self.not_available if out is None else out
        if code is not None:
            self.place.put(payload, code)
        if self.quality is not None:
            self.quality.put(payload, min(quality, self.quality.highest))


class LiveBranch(HeardSignal):
    """One branch on the vehicle: its last frames, the fault of its sensor, and how it is corrected now.

    Parameters
    ----------
    name : str
        As in the layout.
    codes : Codes
        Codes of the measured signal. [A, or W with a voltage]
    sign : int
        +1 if the signal is positive into the junction.
    timeout_s : float
        Without a frame for this long the branch is stale. [s]
    start_s : float
        Time that its first frame may take after the bus has woken up, if longer than ``timeout_s``. [s]
    voltage : HeardSignal or None
        Voltage of a branch that is measured as a power; None for a current.

    Attributes
    ----------
    plan, quality :
        Plan by which its codes are corrected now, and the quality that is published with its values.
    """

    def __init__(
        self,
        *,
        name: str,
        codes: Codes,
        sign: int,
        timeout_s: float,
        start_s: float = 0.0,
        voltage: HeardSignal | None = None,
    ) -> None:
        super().__init__(codes, timeout_s)
        self.name, self.voltage, self._start_s = name, voltage, start_s
        self.fault = NO_FAULT
        self.delay_s: float
        """How much later its values are seen than they were at the junction, as :meth:`take` said. [s]"""
        self.plan = self._passing = self._correcting = AS_IT_IS
        self.quality = Quality.PASSED_THROUGH
        self._time_s = self._awake_s = self._waited_s = -math.inf
        self._is_named = False
        self._scale, self._offset = float(sign * codes.scale), float(sign * codes.offset)

    def take(
        self,
        fault: SensorFault,
        *,
        correcting: IntegerPlan,
        passing: IntegerPlan,
        delay_s: float,
        expected_since_s: float | None,
    ) -> None:
        """Take over what new parameters say about the branch; it is used from the next :meth:`activate` on.

        Parameters
        ----------
        fault : SensorFault
            Fault of its sensor.
        correcting, passing : IntegerPlan
            Plans by which it is written when it is corrected, and when it is passed through.
        delay_s : float
            How much later its values are seen than they were at the junction. [s]
        expected_since_s : float or None
            Time from which its frames are waited for [s]; None: from its first frame on (a vehicle may lack it).
        """
        self.fault, self.delay_s = fault, delay_s
        self._passing, self._correcting = passing, correcting
        self._is_named = expected_since_s is not None
        if expected_since_s is not None:
            self._waited_s = max(self._waited_s, expected_since_s)

    def activate(self, *, active: bool, doubted: bool) -> None:
        """Correct the branch from now on, if `active` and its parameters are to be applied; else pass it through.

        Passed through it has the quality IMPLAUSIBLE if `doubted`, else PASSED_THROUGH.
        """
        corrects = active and self.fault.applied
        self.plan = self._correcting if corrects else self._passing
        self.quality = Quality.CORRECTED if corrects else Quality.IMPLAUSIBLE if doubted else Quality.PASSED_THROUGH

    @property
    def time_s(self) -> float:
        """When the last frame with its signal came [s]; -infinity if none did."""
        self._time_s = next((seen_s for seen_s, _ in self.newest_first()), self._time_s)
        return self._time_s

    def latest(self) -> tuple[float, int] | None:
        """Return time [s] and code of its last frame; None if it is no value or must not be used, or none came."""
        found = next(self.newest_first(), None)
        return found if found is not None and found[0] > self._spoilt_s and self.codes.is_value(found[1]) else None

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
        """Instant by which the next frame of the branch is due; infinity if the vehicle has no such branch. [s]"""
        if self.seen:
            return self.time_s + self.timeout_s
        return self._waited_s + max(self.timeout_s, self._start_s) if self._is_named else math.inf

    def is_stale(self, now_s: float) -> bool:
        """Check whether the next frame of the branch is overdue."""
        return now_s > self.deadline_s

    def is_old(self, now_s: float) -> bool:
        """Check whether the last frame is older than the timeout; also true for a branch that never sent."""
        return now_s - self.time_s > self.timeout_s

    def expect(self, now_s: float) -> None:
        """Wait for frames from now on: the bus has woken up."""
        self._awake_s = self._waited_s = now_s

    def lacks_input(self, now_s: float) -> bool:
        """Check whether the branch is not corrected now: passed through, or without its value or its voltage."""
        no_value = self.seen and self.latest() is None
        return self.quality is not Quality.CORRECTED or no_value or self._voltage_code(now_s) is None

    def _voltage_code(self, time_s: float) -> int | None:
        """Return the raw code of the branch's voltage in the last frame up to a time [s], not interpolated.

        None if there is no such frame, it is too old, or its code is no value; 0 if the plan needs no voltage.
        """
        return self.voltage.code_at(time_s) if self.voltage is not None and self.plan.needs_voltage else 0

    def ordinary_codes(self) -> tuple[int, int]:
        """Return the range of codes that are values and whose results depend on the code alone, without clipping.

        Returns
        -------
        first, last : int
            Least and greatest code of the range; ``first`` is the greater one if there is no such range.
        """
        plan, (first, last) = self.plan, (self.codes.lowest, self.codes.highest)
        while first in self.codes.named:
            first += 1
        while last in self.codes.named:
            last -= 1
        if plan.needs_voltage or plan.gain <= 0 or any(code in range(first, last) for code in self.codes.named):
            return 1, 0
        least, beyond = plan.lowest << plan.shift, (plan.highest + 1) << plan.shift
        bias = plan.bias + (1 << (plan.shift - 1))
        return max(first, -((bias - least) // plan.gain)), min(last, (beyond - 1 - bias) // plan.gain)

    def convert(self, code: int, time_s: float, counters: Counters) -> tuple[int | None, Quality]:
        """Return code (None: no value) and quality to write for a code that came at a time; count a clamped result."""
        if not self.codes.is_value(code):
            return None, Quality.NOT_AVAILABLE if code in self.codes.named else Quality.INVALID
        voltage_code = self._voltage_code(time_s)
        if voltage_code is None:
            return None, Quality.NOT_AVAILABLE
        out = self.plan.apply(code, voltage_code)
        counters.saturated += out != self.plan.unbounded(code, voltage_code)
        return out, self.quality

    def published(self, now_s: float) -> tuple[int | None, Quality]:
        """Return code (None: no value) and quality to write for its last value, when a frame lacks the branch."""
        found = next(self.newest_first(), None)
        if found is None or now_s - found[0] > self.timeout_s:
            return None, Quality.NOT_AVAILABLE
        if found[0] <= self._spoilt_s:
            return None, Quality.INVALID
        return self.convert(found[1], found[0], Counters())

    def currents_at(self, time_s: float) -> tuple[float, float] | None:
        """Return its current as measured and as the parameters correct it, even while the node passes it through.

        Parameters
        ----------
        time_s : float
            Time as its frames have it, later than at the junction by its delay; between frames the current is
            interpolated linearly. [s]

        Returns
        -------
        measured_a, corrected_a : float
            Positive into the junction [A]; None if no value is known for that time.
        """
        code, volts = self._code_between(time_s), self._volts_at(time_s)
        if code is None or volts is None:
            return None
        measured_a = (self._scale * code + self._offset) / volts
        return measured_a, self.fault.true_current(measured_a)

    def movement(self, instant_s: float, since_s: float, frames: int) -> Movement:
        """Return how its corrected current moved in the frames before an instant of the junction.

        Parameters
        ----------
        instant_s : float
            The instant. [s]
        since_s : float
            How far to look back from it; further where that has fewer frames than wanted. [s]
        frames : int
            Least number of frames to look at.

        Returns
        -------
        Movement
            A power is turned into a current with the voltage of the instant; zeros if nothing is known.
        """
        end_s = instant_s + self.delay_s
        codes: list[int] = []
        for seen_s, code in self.newest_first():
            if seen_s > end_s:
                codes = []  # keeps only the first one after the instant, towards which it is interpolated
            elif seen_s < end_s - since_s and len(codes) >= frames:
                break
            if self.codes.is_value(code):
                codes.append(code)
        volts = self._volts_at(end_s)
        if not codes or volts is None:
            return Movement(0.0, 0.0, 0.0)
        per_code_a = abs(self._scale) / volts / (1.0 + self.fault.drift)
        steps = [per_code_a * abs(later - earlier) for later, earlier in pairwise(codes)]
        steps = [*sorted(steps, reverse=True), *[0.0] * _FLICKER_STEPS]
        return Movement(per_code_a * (max(codes) - min(codes)), steps[0], steps[_FLICKER_STEPS - 1])

    def _volts_at(self, time_s: float) -> float | None:
        """Return what its signal is divided by: 1 for a current, else the voltage; None if off or unknown. [V]"""
        if self.voltage is None:
            return 1.0
        code = self.voltage.code_at(time_s)
        if code is None:
            return None
        volts = float(self.voltage.codes.worth(code))
        return volts if volts >= _LEAST_VOLTAGE_V else None

    def _code_between(self, time_s: float) -> float | None:
        """Return the code at a time, interpolated between frames; None if it is not known."""
        later: tuple[float, int] | None = None
        for sample in self.newest_first():
            seen_s, code = sample
            if not self.codes.is_value(code):
                return None
            if seen_s <= time_s:
                if later is None:
                    return code
                return code + (time_s - seen_s) / (later[0] - seen_s) * (later[1] - code)
            later = sample
        return later[1] if later is not None and later[0] - time_s <= self.timeout_s else None


def aligned_currents(
    branches: Sequence[LiveBranch], delays_s: Mapping[str, float], now_s: float
) -> tuple[float, dict[str, tuple[float, float]]] | None:
    """Return the currents of all fitted branches at the last instant at which all are known.

    Parameters
    ----------
    branches : sequence of LiveBranch
        All branches of the layout.
    delays_s : mapping of str to float
        How much later than at the junction each branch is seen; 0 where not named. [s]
    now_s : float
        Now. [s]

    Returns
    -------
    instant_s : float
        The instant, in time of the junction. [s]
    currents : dict of str to (float, float)
        Each branch's current as measured and as the parameters in force correct it; positive into the junction. [A]
        None, instead of both, while a fitted branch is stale or has no value, or no branch is fitted.
    """
    fitted = [(branch, delays_s.get(branch.name, 0.0)) for branch in branches if branch.is_fitted]
    times_s = [branch.time_s - delay_s for branch, delay_s in fitted if not branch.is_stale(now_s) and branch.latest()]
    if not fitted or len(times_s) < len(fitted):
        return None
    instant_s = min(times_s)
    found = {branch.name: branch.currents_at(instant_s + delay_s) for branch, delay_s in fitted}
    currents = {name: pair for name, pair in found.items() if pair is not None}
    return (instant_s, currents) if len(currents) == len(fitted) else None


_MOST_MARGINS = 10.0
"""A parameter file may widen the margin for a worse corrected sum by at most this many margins."""
_LEAST_LOOKS = 10
"""Least number of sums on which a verdict is based."""
_STUCK_SHARE = 0.02
"""Standard deviation of the measured sum, in shares of full scale, above which a code that never changes is suspect."""
_REST_SHARE = 0.005
"""A current that never changes is at rest, not stuck, up to this share of full scale: a motor at standstill."""
_MOST_DEVIATIONS = 4.0
"""Mean of the corrected sum over a window that no right parameter set reaches. [standard deviations of a single sum]"""
_LARGEST_DEVIATION = 12.0
"""Larger deviations count as this many: load steps that sensors show one after the other are large, but short."""
_PLAUSIBILITY_WINDOW_S = 4.0
"""Long enough that sensor delays of 0.1 s raise no alarm, and within the 5 s that a receiver tolerates. [s]"""
_JUMP_DEVIATIONS, _JUMP_SHARE = 8.0, 0.05
"""A jump exceeds this many standard deviations of the sum, and this share of full scale."""
_JUMP_LOOKS, _JUMP_S = 3, 0.03
"""A jump lasts for this many instants and this long [s]; frames of one load step, one after the other, do not."""
_MOVING_S, _MOVING_FRAMES = 0.25, 3
"""How far a branch moved is seen over this long [s], and over at least this many frames."""
_EXPLAINS, _LARGEST_SLOPE = 0.9, 0.8
"""A gain error of one branch that explains this share of the sum's variance is the fault, unless its slope reaches the
second number: a slope near 1 means that only this branch is right, and that another one is stuck."""
_UNKNOWN_SD_SHARE, _UNKNOWN_SD_PER_A = 0.02, 0.05
"""Standard deviation of the corrected sum if the parameter file does not give it: share of full scale, and of the
throughput. [1]"""
_NEARLY_AS_GOOD = 1.25
"""Branches that leave at most this many times as much of the sum as the best one explain it equally well. [1]"""
_ROUNDING = 1e-9
"""Share of the squares of the sums that rounding may leave where a branch explains all of it. [1]"""


class JunctionSums(NamedTuple):
    """Sum of all fitted branches in one instant, measured and corrected. [A]"""

    measured_a: float
    corrected_a: float


_Verdict = tuple[Reason, tuple[str, ...]]
"""Why parameters must not be used any more, and the branches that explain it best, the best one first."""


class _Moment(NamedTuple):
    """One instant of the junction (no statistical moment); the expected sum is already subtracted from the sums."""

    time_s: float
    corrected_a: float
    deviations: float
    """The corrected sum in standard deviations, signed."""
    currents_a: Currents
    codes: Mapping[str, int]
    """Last code of each branch."""
    terms: tuple[float, float, float, float, float]
    """Terms of the means over a window: measured sum, its square, square of the corrected sum, deviations, and
    deviations times the sign of the largest current, in which a gain error keeps its sign."""


class _Window:
    """The moments of the last seconds, and means over them."""

    def __init__(self, length_s: float) -> None:
        self._length_s, self.moments, self._sums = length_s, deque[_Moment](), [0.0] * 5

    def add(self, moment: _Moment) -> None:
        self.moments.append(moment)
        self._sums = [*map(add, self._sums, moment.terms)]
        while moment.time_s - self.moments[0].time_s > self._length_s:
            self._sums = [*map(sub, self._sums, self.moments.popleft().terms)]

    def means(self, share: float) -> list[float] | None:
        """Return the mean of each of the moments' ``terms`` over the window.

        None while the window holds fewer than ten moments, or they span less than `share` of its length.
        """
        moments = self.moments
        if len(moments) < _LEAST_LOOKS or moments[-1].time_s - moments[0].time_s < share * self._length_s:
            return None
        return [total / len(moments) for total in self._sums]


class JunctionWatch:
    """Keeps the recent sums of the junction, and judges whether the parameters may still be used.

    A gain error or an offset shows in the mean of the corrected sum over some seconds. A jump shows within some frames:
    the sum, or one branch alone, has moved farther than all other branches together, which no load can do, as another
    branch shows its current too. A longer window shows whether the correction makes the sum worse, and which branch
    never changes.

    Parameters
    ----------
    branches : sequence of LiveBranch
        All branches of the layout.
    window_s : float
        Over this long measured and corrected sums are compared. [s]
    margin_a : float
        The correction is worse if the root mean square of corrected sums exceeds that of measured ones by this. [A]
    full_scale_a : float
        Nominal maximum current of the junction. [A]

    Attributes
    ----------
    sums : JunctionSums or None
        Sums of the last look; None while a fitted branch is stale or has no value.
    currents_a : mapping of str to (float, float)
        Measured and corrected currents of the last instant that was known, by branch. [A]
    instant_s : float
        That instant. [s]
    verdict : tuple or None
        Why the parameters in force must not be used any more; None while they may.
    """

    def __init__(
        self, branches: Sequence[LiveBranch], *, window_s: float, margin_a: float, full_scale_a: float
    ) -> None:
        self._branches = {branch.name: branch for branch in branches}
        self._window_s, self._margin_a, self._full_scale_a = window_s, margin_a, full_scale_a
        self._whole: tuple[HeardSignal, frozenset[int]] | None = None
        self.restart()

    def judge_only(self, state: HeardSignal, valid: frozenset[int]) -> None:
        """Judge sums only while signal ``state`` has a code of ``valid``: only then are all currents measured."""
        self._whole = state, valid

    def is_whole(self, now_s: float) -> bool:
        """Check whether all currents of the junction are measured now; other sums are published, but not judged."""
        return self._whole is None or self._whole[0].code_at(now_s) in self._whole[1]

    def is_blind(self, now_s: float) -> bool:
        """Check whether the state that tells when sums can be judged is unknown now."""
        return self._whole is not None and self._whole[0].code_at(now_s) is None

    def restart(self, expected: JunctionResidual = NOTHING_EXPECTED) -> None:
        """Forget what was seen, and judge from now on by what the parameter file expects of the sum of right sensors.

        If the calibrator itself saw the correction make the sum worse (as where one of two offsets that cancel is
        corrected), the difference is added to the margin, up to ten times the margin. If the file has no standard
        deviations, shares of full scale (or what the calibrator saw, if more) and of the throughput take their place:
        then only gross faults show.
        """
        measured_a, corrected_a = expected.about_expected()
        margins = min(max((corrected_a - measured_a) / self._margin_a, 0.0), _MOST_MARGINS)
        self._expected_a, self._allowed_a = expected.expected_a, self._margin_a * (1.0 + margins)
        sd_a, sd_per_a = expected.corrected_sd_a, expected.corrected_sd_per_a
        sd_a = max(_UNKNOWN_SD_SHARE * self._full_scale_a, corrected_a) if sd_a is None else sd_a
        self._sd_a, self._sd_per_a = max(sd_a, self._margin_a), _UNKNOWN_SD_PER_A if sd_per_a is None else sd_per_a
        self.sums: JunctionSums | None = None
        self.currents_a: Currents = {}
        self.instant_s = self._judged_s = -math.inf
        self.forget()

    def forget(self) -> None:
        """Begin new windows, and forget jump and verdict."""
        self._window, self._recent = _Window(self._window_s), _Window(_PLAUSIBILITY_WINDOW_S)
        self._jump: tuple[float, int, _Verdict] | None = None
        """Instant at which a jump began [s], number of instants since, and the verdict as it was then."""
        self.verdict: _Verdict | None = None

    def look(self, now_s: float) -> None:
        """Take the newest sums that are known at a time [s], and judge them."""
        self.sums = None
        branches = self._branches.values()
        found = aligned_currents([*branches], {branch.name: branch.delay_s for branch in branches}, now_s)
        if found is None:
            return
        self.instant_s, self.currents_a = found
        pairs = self.currents_a.values()
        self.sums = JunctionSums(sum(measured for measured, _ in pairs), sum(corrected for _, corrected in pairs))
        if not self.is_whole(now_s):
            self.forget()
        elif self.instant_s > self._judged_s and len(self.currents_a) > 1:  # the sum of a single branch says nothing
            self._judged_s = self.instant_s
            self._remember(self.sums)
            self.verdict = self._judge()

    def _remember(self, sums: JunctionSums) -> None:
        """Add one instant to the windows."""
        measured_a, corrected_a = sums.measured_a - self._expected_a, sums.corrected_a - self._expected_a
        deviations = corrected_a / self._sum_sd_a()
        deviations = min(max(deviations, -_LARGEST_DEVIATION), _LARGEST_DEVIATION)
        largest = max((corrected for _, corrected in self.currents_a.values()), key=abs)
        codes = {name: next(self._branches[name].newest_first())[1] for name in self.currents_a}
        terms = measured_a, measured_a**2, corrected_a**2, deviations, math.copysign(deviations, deviations * largest)
        moment = _Moment(self.instant_s, corrected_a, deviations, self.currents_a, codes, terms)
        self._window.add(moment)
        self._recent.add(moment)

    def _sum_sd_a(self) -> float:
        """Return the standard deviation of the corrected sum of right sensors at the currents of this instant. [A]"""
        throughput_a = 0.5 * sum(abs(corrected) for _, corrected in self.currents_a.values())
        return math.hypot(self._sd_a, self._sd_per_a * throughput_a)

    def _judge(self) -> _Verdict | None:
        """Return the verdict on the windows as they are; None while the parameters may be used."""
        if (jump := self._jumped()) is not None:
            return jump
        if recent := self._recent.means(0.5):
            *_, deviations, directed = recent
            if max(abs(deviations), abs(directed)) > _MOST_DEVIATIONS:
                return self._explaining()
        if not (means := self._window.means(0.9)):
            return None
        mean_a, measured2, corrected2, *_ = means
        if measured2 - mean_a**2 > (_STUCK_SHARE * self._full_scale_a) ** 2 and (stuck := self._stuck()):
            return Reason.BRANCH_STUCK, stuck
        is_worse = math.sqrt(max(corrected2, 0.0)) > math.sqrt(max(measured2, 0.0)) + self._allowed_a
        return (Reason.CORRECTION_WORSE, ()) if is_worse else None

    def _jumped(self) -> _Verdict | None:
        """Return the verdict on a jump as it was when it began; None unless there is a jump, and it has lasted."""
        instant_s, residual_a = self.instant_s, self._recent.moments[-1].corrected_a
        moved = {name: self._branches[name].movement(instant_s, _MOVING_S, _MOVING_FRAMES) for name in self.currents_a}
        most = max(moved, key=lambda name: moved[name].distance_a)
        others_a = sum(movement.distance_a for movement in moved.values()) - moved[most].distance_a
        limit_a = max(_JUMP_DEVIATIONS * self._sum_sd_a(), _JUMP_SHARE * self._full_scale_a)
        if max(abs(residual_a), moved[most].flicker_a) - others_a <= limit_a:
            self._jump = None
            return None
        if self._jump is None:
            half_a = 0.5 * abs(residual_a)
            still = [name for name in moved if moved[name].distance_a == 0.0 and abs(self.currents_a[name][1]) > half_a]
            is_step = moved[most].step_a >= 0.5 * moved[most].distance_a
            frozen = () if is_step else self._frozen(still)
            self._jump = instant_s, 0, (Reason.BRANCH_STUCK, frozen) if frozen else (Reason.SUM_IMPLAUSIBLE, (most,))
        since_s, looks, verdict = self._jump
        self._jump = since_s, looks + 1, verdict
        return verdict if looks + 1 >= _JUMP_LOOKS and instant_s - since_s >= _JUMP_S else None

    def _frozen(self, still: Sequence[str]) -> tuple[str, ...]:
        """Return which of these unchanging branches carry more than at rest."""
        rest_a = _REST_SHARE * self._full_scale_a
        return tuple(name for name in still if abs(self.currents_a[name][1]) > rest_a)

    def _stuck(self) -> tuple[str, ...]:
        """Return branches whose code never changed in the window; none if another's gain explains the sum."""
        moments = self._window.moments
        still = [name for name in self.currents_a if len({moment.codes.get(name) for moment in moments}) == 1]
        measured_a = [moment.terms[0] for moment in moments]
        rows = self._rows(moments, corrected=False)
        lines = [_line(row, measured_a) for name, row in rows.items() if name not in still]
        if any(explains and not is_steep for is_steep, explains in lines):
            return ()
        return self._frozen(still)

    def _rows(self, moments: Iterable[_Moment], *, corrected: bool = True) -> dict[str, list[float]]:
        """Return the current of each branch, corrected or measured, in these moments; 0 while it was not heard. [A]"""
        none = 0.0, 0.0
        return {name: [each.currents_a.get(name, none)[corrected] for each in moments] for name in self.currents_a}

    def _explaining(self) -> _Verdict:
        """Return the verdict on wrong sums: which branches are stuck, else whose gain error explains the sums best.

        The sums count since they went wrong. If an offset explains them, all branches are named: it may be any one's.
        """
        since = [*takewhile(lambda moment: abs(moment.deviations) >= 1.0, reversed(self._recent.moments))]
        moments = since if len(since) >= _LEAST_LOOKS else self._recent.moments
        residual = [moment.corrected_a for moment in moments]
        rows = self._rows(moments)
        still = [name for name, row in rows.items() if min(row) == max(row)]
        if frozen := self._frozen(still):  # a branch that moved in one step is left out: its own sensor may have jumped
            lines = [_line(row, residual) for name, row in rows.items() if name not in still and not _is_step(row)]
            if any(explains and is_steep for is_steep, explains in lines):
                return Reason.BRANCH_STUCK, frozen
        left = {name: _left_of_gain(row, residual) for name, row in rows.items()}
        of_offset, best = _common_change(residual, residual), min(left.values())
        enough = _NEARLY_AS_GOOD * best + _ROUNDING * math.fsum(map(mul, residual, residual))
        near = [name for name in left if left[name] <= enough or of_offset <= enough]
        return Reason.SUM_IMPLAUSIBLE, tuple(sorted(near, key=left.__getitem__))


def _is_step(current: Sequence[float]) -> bool:
    """Whether a single step makes up half of a current's range, or more."""
    return 2.0 * max(abs(b - a) for a, b in pairwise(current)) >= max(current) - min(current)


def _left_of_gain(current: Sequence[float], residual: Sequence[float]) -> float:
    """Return the sum of squares of the residual that the best gain error of a branch leaves. [A^2]"""
    own, both = math.fsum(map(mul, current, current)), math.fsum(map(mul, current, residual))
    return math.fsum(map(mul, residual, residual)) - both * both / (own or math.inf)  # no current explains nothing


def _common_change(x: Sequence[float], y: Sequence[float]) -> float:
    """Return the sum of products of two columns about their means; it is enough that one has its mean taken out."""
    mean_y = math.fsum(y) / len(y)
    return math.fsum(map(mul, x, (b - mean_y for b in y)))


def _line(x: Sequence[float], y: Sequence[float]) -> tuple[bool, bool]:
    """Return whether the line through points has a large slope, and explains them: y hardly scatters around it."""
    xx, xy, yy = _common_change(x, x), _common_change(x, y), _common_change(y, y)
    return abs(xy) >= _LARGEST_SLOPE * xx, xy * xy >= _EXPLAINS * xx * yy
