"""The watch on a junction whose frames are made by hand: which verdict it gives, and on which branches."""

import math
import struct
from collections import deque
from collections.abc import Callable, Mapping
from fractions import Fraction

import pytest

from ecu_node.core.correction import AS_IT_IS, IntegerPlan, SensorFault
from ecu_node.core.junction import Frames, HeardSignal, JunctionWatch, LiveBranch, Movement
from ecu_node.core.signals import BitPlace, Codes, PlacedSignal
from ecu_node.core.status import Quality, Reason
from ecu_node.parameters import JunctionResidual

PLACE = BitPlace(first=0, end=2, order="little", shift=0, length=16, signed=True)
PERIOD_S = 1 / 32
Verdict = tuple[Reason, tuple[str, ...]] | None
BATTERY_WRONG, HEATER_STUCK = (Reason.SUM_IMPLAUSIBLE, ("battery",)), (Reason.BRANCH_STUCK, ("heater",))


def codes(scale: Fraction, *named: int) -> Codes:
    names = dict.fromkeys(named, "Reserved")
    return Codes(name="signal", place=PLACE, scale=scale, offset=Fraction(0), lowest=-32767, highest=32767, named=names)


def frame(time_s: float, code: int) -> tuple[float, bytearray]:
    return time_s, bytearray(struct.pack("<h", code))


def live(
    name: str, frames: Frames, fault: SensorFault, unit: Fraction, delay_s: float, voltage: HeardSignal | None = None
) -> LiveBranch:
    branch = LiveBranch(name=name, codes=codes(unit), sign=1, timeout_s=0.5, voltage=voltage)
    branch.follow(PlacedSignal(place=PLACE), frames)
    branch.take(fault, correcting=AS_IT_IS, passing=AS_IT_IS, delay_s=delay_s, expected_since_s=None)
    return branch


class Watched:
    """A junction of which each branch sends 32 frames a second, and its watch; all currents are into the junction.

    The battery is seen later by ``late_s``. The watch looks twice at each instant.
    """

    def __init__(
        self, *, margin_a: float = 1.0, faults: Mapping[str, SensorFault] = {}, late_s: float = 0.0, **expected: float
    ):
        self.frames: dict[str, Frames] = {name: deque() for name in ("battery", "motor", "heater")}
        branches = [
            live(name, frames, faults.get(name, SensorFault()), Fraction(1, 100), late_s * (name == "battery"))
            for name, frames in self.frames.items()
        ]
        self.watch = JunctionWatch(branches, window_s=8.0, margin_a=margin_a, full_scale_a=400.0)
        self.watch.restart(JunctionResidual(**{"measured_a": 0.0, "corrected_a": 0.0} | expected))

    def run(self, seconds: float, shown_a: Callable[[float], dict[str, float]], *, period_s: float = PERIOD_S) -> None:
        """Send what the sensors show until a time or a verdict; a branch that is not named is silent."""
        for step in range(round(seconds / period_s)):
            self.now_s = now_s = step * period_s
            for name, value in shown_a(now_s).items():
                self.frames[name].append(frame(now_s, round(100.0 * value)))
            self.watch.look(now_s)
            self.watch.look(now_s)
            if self.watch.verdict is not None:
                return


def test_value_is_used_up_to_its_timeout_and_not_if_an_unusable_frame_came_at_its_time_or_later() -> None:
    """A value is a code, and the code is published as it is."""
    branch = live("motor", deque([frame(1.0, 7)]), SensorFault(), Fraction(1), 0.0)
    for now_s, code, published in ((1.5, 7, (7, Quality.PASSED_THROUGH)), (1.51, None, (None, Quality.NOT_AVAILABLE))):
        assert (branch.code_at(now_s), branch.published(now_s)) == (code, published)
        assert branch.is_old(now_s) is branch.is_stale(now_s) is (code is None)
    assert (branch.code_at(0.99), branch.currents_at(0.5), branch.currents_at(0.49)) == (None, (7.0, 7.0), None)
    branch.spoil(0.99)
    assert (branch.code_at(1.0), branch.latest()) == (7, (1.0, 7))
    branch.spoil(1.0)
    assert (branch.code_at(1.0), branch.latest(), branch.published(1.0)) == (None, None, (None, Quality.INVALID))


def test_branch_that_never_sent_is_stale_after_its_timeout_only_if_parameters_name_it() -> None:
    branch = LiveBranch(name="motor", codes=codes(Fraction(1)), sign=1, timeout_s=0.5)
    assert (branch.is_fitted, branch.is_stale(100.0), branch.is_old(100.0)) == (False, False, True)
    branch.take(SensorFault(), correcting=AS_IT_IS, passing=AS_IT_IS, delay_s=0.0, expected_since_s=2.0)
    assert (branch.is_fitted, branch.is_stale(2.5), branch.is_stale(2.51)) == (True, False, True)


def test_range_of_ordinary_codes_excludes_named_and_clipped_codes() -> None:
    branch = live("motor", deque(), SensorFault(), Fraction(1), 0.0)
    branch.codes = codes(Fraction(1), -32767, 32767)
    assert branch.ordinary_codes() == (-32766, 32766)
    none = 1, 0
    plans = ((3, 31, 2, (-144, 123)), (1, 0, 1, (-201, 200)), (0, 0, 1, none), (-2, 0, 1, none))
    for gain, bias, shift, codes_of in plans:
        branch.plan = IntegerPlan(gain=gain, bias=bias, shift=shift, lowest=-100, highest=100)
        assert branch.ordinary_codes() == codes_of
    for amid in (-5, 5):
        branch.codes, branch.plan = codes(Fraction(1), amid), AS_IT_IS
        assert branch.ordinary_codes() == none


def test_movement_of_a_power_branch_is_that_of_its_corrected_current() -> None:
    """In steps of 1/8 s; the sensor is one step late, and shows 25 % too much; one code is 100 W."""
    shown = enumerate([100, 0, 70, 10, 60, 65, 1000])
    voltage = HeardSignal(codes(Fraction(1)), 9.0)
    volts: Frames = deque([frame(0.25, 200)])
    voltage.follow(PlacedSignal(place=PLACE), volts)
    frames = deque(frame(1.0 + 0.125 * step, code) for step, code in shown)
    power = live("motor", frames, SensorFault(drift=0.25, offset_a=3.0), Fraction(100), 0.125, voltage)
    per_code_a = 100.0 / 200.0 / 1.25
    assert power.movement(1.375, 0.25, 3) == Movement(60 * per_code_a, 60 * per_code_a, 0.0)
    assert power.movement(1.375, 0.25, 5) == Movement(70 * per_code_a, 70 * per_code_a, 5 * per_code_a)
    volts.append(frame(0.375, 10))
    assert power.movement(1.375, 0.25, 3).distance_a == 60 * 100.0 / 10.0 / 1.25
    volts.append(frame(0.5, 9))
    assert power.movement(1.375, 0.25, 3) == Movement(0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("battery_a", "period_s", "at_s"),
    [(110.0, 1 / 32, 1.0625), (60.0, 1 / 32, 3.0), (60.0, 0.25, 3.25), (54.0, 1 / 32, 8.21875)],
    ids=["like a jump", "implausible after half a window", "after ten looks", "worse after nine tenths of a window"],
)
def test_sums_are_judged_from_part_of_a_window_and_ten_looks_on(battery_a: float, period_s: float, at_s: float) -> None:
    """The first frames come after a second; the motor is corrected by 3 A."""
    junction = Watched(faults={"motor": SensorFault(offset_a=-3.0)}, corrected_sd_a=1.0, corrected_sd_per_a=0.0)
    junction.run(9.0, lambda now_s: {"battery": battery_a, "motor": -53.0} if now_s >= 1.0 else {}, period_s=period_s)
    assert (junction.watch.verdict is not None, junction.now_s) == (True, at_s)


@pytest.mark.parametrize("load_a", [0.0, 30.0])
def test_watch_judges_sums_relative_to_the_load_that_parameters_expect(load_a: float) -> None:
    """Right sensors, one of which is corrected by 3 A: no deviation that could not be, but worse than as measured."""
    junction = Watched(faults={"motor": SensorFault(offset_a=-3.0)}, expected_a=load_a, corrected_sd_a=1.0)
    junction.run(9.0, lambda _: {"battery": 50.0 + load_a, "motor": -50.0})
    assert junction.watch.verdict == (Reason.CORRECTION_WORSE, ())


@pytest.mark.parametrize(("offset_a", "verdict"), [(2.5, None), (2.6, (Reason.CORRECTION_WORSE, ()))])
def test_margin_includes_the_worsening_that_parameters_state(offset_a: float, verdict: Verdict) -> None:
    """A margin of 0.5 A, and 2 A more in the parameter file."""
    fault = {"motor": SensorFault(offset_a=-offset_a)}
    junction = Watched(margin_a=0.5, faults=fault, measured_a=1.0, corrected_a=3.0, corrected_sd_a=1.0)
    junction.run(9.0, lambda _: {"battery": 50.0, "motor": -50.0})
    assert junction.watch.verdict == verdict


def test_sum_of_a_single_branch_is_published_but_not_judged() -> None:
    junction = Watched(corrected_sd_a=1.0)
    junction.run(3.0, lambda _: {"battery": 60.0})
    assert (junction.watch.sums, junction.watch.verdict) == ((60.0, 60.0), None)


def test_new_parameters_begin_without_sums_and_currents() -> None:
    junction = Watched()
    junction.run(1.0, lambda _: {"battery": 50.0, "motor": -50.0})
    junction.watch.restart()
    assert (junction.watch.sums, junction.watch.currents_a, junction.watch.instant_s) == (None, {}, -math.inf)


def test_sums_of_right_sensors_give_no_verdict() -> None:
    junction = Watched(margin_a=0.5)
    junction.run(9.0, lambda _: {"battery": 50.0, "motor": -50.0})
    assert junction.watch.verdict is None


GAIN_ERRORS = [
    (0.0, 10.0, 0.0, BATTERY_WRONG),
    (0.0, 10.0, 100.0, BATTERY_WRONG),
    (0.0, 0.0, 0.0, (Reason.SUM_IMPLAUSIBLE, ("battery", "motor"))),
    (0.1, 10.0, 0.0, None),
]


@pytest.mark.parametrize(("sd_per_a", "heater_a", "offset_a", "verdict"), GAIN_ERRORS)
def test_gain_error_beyond_chance_is_found(sd_per_a: float, heater_a: float, offset_a: float, verdict: Verdict) -> None:
    """The battery's offset is corrected."""

    def swinging(time_s: float) -> dict[str, float]:
        currents_a = {"motor": 100.0 * math.sin(3.0 * time_s), "heater": heater_a * math.sin(5.0 * time_s)}
        return currents_a | {"battery": offset_a - 1.1 * sum(currents_a.values())}

    faults = {"battery": SensorFault(offset_a=offset_a)}
    junction = Watched(faults=faults, corrected_sd_a=1.0, corrected_sd_per_a=sd_per_a)
    junction.run(7.0, swinging)
    assert junction.watch.verdict == verdict


def test_branches_that_explain_the_sum_nearly_as_well_as_the_best_are_also_named() -> None:
    """The heater is first heard after a second."""

    def noisy(time_s: float) -> dict[str, float]:
        step = round(time_s / PERIOD_S)
        motor_a, heater_a = 100.0 * math.sin(3.0 * time_s), (3.0, 3.0, -3.0, -3.0)[step % 4]
        noise_a = 3.0 * (-1) ** step
        shown = {"battery": -motor_a - heater_a, "motor": 1.1 * motor_a + noise_a}
        return shown | {"heater": heater_a} if time_s > 1.0 else shown

    junction = Watched(corrected_sd_a=1.0, corrected_sd_per_a=0.0)
    junction.run(7.0, noisy)
    assert junction.watch.verdict == (Reason.SUM_IMPLAUSIBLE, ("motor", "battery"))


@pytest.mark.parametrize(("drift", "verdict"), [(-0.25, (Reason.BRANCH_STUCK, ("battery",))), (0.9, None)])
def test_stuck_branch_is_found_beside_a_gain_error_and_a_steady_one_is_not(drift: float, verdict: Verdict) -> None:
    battery_is_stuck = verdict is not None

    def shown_a(now_s: float) -> dict[str, float]:
        motor_a = -50.0 + 20.0 * math.sin(2.0 * math.pi * now_s / 3.0)
        battery_a = 50.0 if battery_is_stuck else -motor_a - 20.0
        return {"battery": battery_a, "motor": motor_a * (1.0 + drift), "heater": 0.0 if battery_is_stuck else 20.0}

    junction = Watched(margin_a=5.0, faults={"motor": SensorFault(drift=drift)})
    junction.run(9.5, shown_a)
    assert junction.watch.verdict == verdict


@pytest.mark.parametrize(("still_a", "verdict"), [(2.0, None), (3.0, HEATER_STUCK)])
def test_constant_current_is_stuck_unless_small(still_a: float, verdict: Verdict) -> None:
    """The sum varies by what no gain error explains; the motor is first heard after half a second.

    When the heater changes at last, its new code is known one instant before its new current.
    """

    def varying(time_s: float) -> dict[str, float]:
        motor_a = 100.0 * math.sin(3.0 * time_s) if time_s > 0.5 else 0.0
        shown = {"battery": -motor_a + 15.0 * math.sin(11.0 * time_s), "heater": still_a + (time_s >= 8.0)}
        return shown | {"motor": motor_a} if time_s > 0.5 else shown

    junction = Watched(late_s=PERIOD_S, corrected_sd_a=15.0)
    junction.run(9.0, varying)
    assert junction.watch.verdict == verdict


JUMPS = [
    (50.0, 1.0, 1 / 32, 3),
    (50.0, 1.0, 1 / 128, 5),
    (50.0, 0.0, 0.015, 3),
    (-21.0, 1.0, 1 / 32, 3),
    (-20.0, 1.0, 1 / 32, None),
]


@pytest.mark.parametrize(("jump_a", "since_s", "period_s", "looks"), JUMPS)
def test_jump_counts_if_large_and_lasting(jump_a: float, since_s: float, period_s: float, looks: int | None) -> None:
    junction = Watched(corrected_sd_a=1.0)

    def shown_a(now_s: float) -> dict[str, float]:
        return {"battery": 50.0 + jump_a * (now_s >= since_s), "motor": -45.0, "heater": -5.0}

    junction.run(2.0, shown_a, period_s=period_s)
    assert junction.watch.verdict == (None if looks is None else BATTERY_WRONG)
    assert looks is None or junction.now_s == since_s + (looks - 1) * period_s


@pytest.mark.parametrize(("still_a", "verdict"), [(10.5, BATTERY_WRONG), (10.6, HEATER_STUCK)])
def test_still_branch_with_more_than_half_of_the_sum_is_stuck(still_a: float, verdict: Verdict) -> None:
    """The sum has jumped once it is 21 A."""
    junction = Watched(corrected_sd_a=1.0)
    junction.run(2.0, lambda now_s: {"battery": still_a + 96.0 * max(now_s - 1.0, 0.0), "heater": -still_a})
    assert junction.watch.verdict == verdict


@pytest.mark.parametrize(("rises", "verdict"), [(2, BATTERY_WRONG), (3, HEATER_STUCK)])
def test_still_branch_is_stuck_if_another_jumps_in_several_steps(rises: int, verdict: Verdict) -> None:
    """The battery rises by 24 A in frames one after the other."""

    def rising(now_s: float) -> dict[str, float]:
        level = min(max(round((now_s - 1.0) / PERIOD_S), 0), rises)
        return {"battery": 20.0 + 24.0 * level / rises, "heater": -20.0}

    junction = Watched(corrected_sd_a=1.0, corrected_sd_per_a=0.0)
    junction.run(2.0, rising)
    assert junction.watch.verdict == verdict


@pytest.mark.parametrize(("rises", "verdict"), [(3, BATTERY_WRONG), (4, HEATER_STUCK)])
def test_still_branch_is_stuck_if_another_moves_as_the_sum_does_in_several_steps(rises: int, verdict: Verdict) -> None:
    """The battery rises by 1 A, which makes the sum wrong, and then by 4 A each time: half of 8 A, a third of 12 A."""

    def rising(now_s: float) -> dict[str, float]:
        level = min(max(math.floor(10.0 * now_s) - 9, 0), rises)
        return {"battery": 20.0 + max(4.0 * level - 3.0, 0.0), "heater": -20.0}

    junction = Watched(corrected_sd_a=1.0, corrected_sd_per_a=0.0)
    junction.run(4.0, rising)
    assert junction.watch.verdict == verdict
