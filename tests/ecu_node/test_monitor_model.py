"""What the monitor makes of frames: frames by cantools and autosar-e2e, without terminal, bus or clock."""

import dataclasses
from collections.abc import Callable

import pytest

from ecu_node.bus.guard import key_of
from ecu_node.core.status import Quality, Reason, State
from ecu_node.database import VehicleDatabase
from ecu_node.monitor import BranchView, BusMonitor, Sums, View
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT, protected


class Bus:
    """Frames of the project's DBC, each message with its own counter."""

    def __init__(self, database: VehicleDatabase, start_s: float = 0.0) -> None:
        self.database, self.monitor = database, BusMonitor(database, start_s)
        self.counters: dict[str, int] = {}

    def send(self, message: str, time_s: float, *, step: int = 1, spoilt: bool = False, **values: float) -> None:
        counter = (self.counters.get(message, -1) + step) % 15
        self.counters[message] = counter
        data = bytearray(protected(self.database, message, counter, **values))
        data[7] ^= spoilt
        self.monitor.take(key_of(self.database.message(message)), data, time_s)

    def battery(self, time_s: float, measured_a: float, corrected_a: float | None = None, quality: int = 2) -> None:
        self.send("HV_Battery", time_s, BatteryCurrent=measured_a)
        if corrected_a is not None:
            self.send(
                "HV_BatteryCorrected",
                time_s + 0.001,
                BatteryCurrentCorrected=corrected_a,
                BatteryCurrentQuality=quality,
            )

    def motor(self, time_s: float, measured_a: float, corrected_a: float | None = None) -> None:
        """In the direction of the signal: consumption positive."""
        self.send("HV_Motor", time_s, MotorCurrent=measured_a)
        if corrected_a is not None:
            self.send("HV_MotorCorrected", time_s + 0.001, MotorCurrentCorrected=corrected_a, MotorCurrentQuality=2)

    def look(self, now_s: float) -> View:
        return self.monitor.look(now_s)


@pytest.fixture
def bus(database: VehicleDatabase) -> Bus:
    return Bus(database)


def faults(corrupt: int = 0, repeated: int = 0, lost: int = 0) -> dict[str, int]:
    return {"corrupt": corrupt, "repeated": repeated, "lost": lost}


def of(view: View, name: str) -> BranchView:
    return next(branch for branch in view.branches if branch.name == name)


def test_a_branch_shows_what_was_measured_what_is_published_and_the_difference(bus: Bus) -> None:
    bus.battery(0.01, 100.0, 95.5)
    bus.motor(0.01, 80.0, 81.0)
    view = bus.look(0.05)
    battery, motor = of(view, "battery"), of(view, "motor")
    assert (battery.measured_a, battery.corrected_a, battery.correction_a) == pytest.approx((100.0, 95.5, -4.5))
    assert (motor.measured_a, motor.corrected_a, motor.correction_a) == pytest.approx((-80.0, -81.0, -1.0))
    assert battery.quality == "CORRECTED"
    assert battery.age_s == pytest.approx(0.04)
    assert view.publishes_corrected


def test_a_measured_frame_is_shown_with_its_own_answer(bus: Bus) -> None:
    bus.battery(0.01, 100.0, 95.0)
    bus.battery(0.03, 200.0)
    battery = of(bus.look(0.031), "battery")
    assert (battery.measured_a, battery.corrected_a, battery.correction_a) == pytest.approx((100.0, 95.0, -5.0))


def test_measured_frames_that_nobody_answers_any_more_are_shown_all_the_same(bus: Bus) -> None:
    bus.battery(0.01, 100.0, 95.0)
    for k in range(20):
        bus.battery(0.03 + 0.02 * k, 200.0)
    battery = of(bus.look(0.42), "battery")
    assert battery.measured_a == pytest.approx(200.0)
    assert (battery.is_stale, battery.corrected_is_stale) == (False, True)


def test_sums_are_taken_in_one_instant(bus: Bus) -> None:
    """Currents that rise by 1000 A/s sum to 0 at every instant, though no two frames come at the same time."""
    for k in range(4):
        t = 0.02 * k
        bus.battery(t, 1000.0 * t, 500.0 * t)
        bus.motor(t + 0.01, 1000.0 * (t + 0.01), 500.0 * (t + 0.01))
    sums = bus.look(0.08).sums
    assert sums.measured_a == pytest.approx(0.0, abs=0.02)
    assert sums.corrected_a == pytest.approx(0.0, abs=0.02)


def test_while_the_node_passes_through_the_sum_after_is_the_sum_before_however_late_it_answers(bus: Bus) -> None:
    """Currents that rise by 1000 A/s with a sum of 5 A; the motor's frames are answered three at a time."""
    waiting: list[float] = []
    for k in range(30):
        t = 0.02 * k
        bus.battery(t, 1000.0 * t + 5.0)
        bus.motor(t + 0.003, 1000.0 * (t + 0.003))
        waiting.append(1000.0 * (t + 0.003))
        bus.send("HV_BatteryCorrected", t + 0.008, BatteryCurrentCorrected=1000.0 * t + 5.0, BatteryCurrentQuality=1)
        for motor_a in waiting if k % 3 == 2 else ():
            bus.send("HV_MotorCorrected", t + 0.012, MotorCurrentCorrected=motor_a, MotorCurrentQuality=1)
        waiting = waiting if k % 3 != 2 else []
        for look_s in (t + 0.001, t + 0.013):
            sums = bus.look(look_s).sums
            if sums.corrected_a is not None:
                assert (sums.measured_a, sums.corrected_a) == pytest.approx((5.0, 5.0), abs=0.03)
    assert sums.corrected_a is not None


MIXED_DBC = """VERSION ""
BU_: Node Corrector
BO_ 1 Fast: 2 Node
 SG_ Battery : 0|16@1- (0.1,0) [-3000|3000] "A" Node
BO_ 2 Middle: 2 Node
 SG_ Motor : 0|16@1- (0.1,0) [-3000|3000] "A" Node
BO_ 3 Slow: 2 Node
 SG_ Heater : 0|16@1- (0.1,0) [-3000|3000] "A" Node
BO_ 4 Out: 6 Corrector
 SG_ Battery : 0|16@1- (0.1,0) [-3000|3000] "A" Node
 SG_ Motor : 16|16@1- (0.1,0) [-3000|3000] "A" Node
 SG_ Heater : 32|16@1- (0.1,0) [-3000|3000] "A" Node
VAL_ 4 Battery -32768 "SNA";
VAL_ 4 Motor -32768 "SNA";
VAL_ 4 Heater -32768 "SNA";
"""
MIXED_LAYOUT = """
schema = 1
name = "small"
dbc = "small.dbc"
full_scale_a = 400.0
branch = [
    { name = "battery", sign = 1, signal = "Fast.Battery", corrected = "Out.Battery" },
    { name = "motor", sign = -1, signal = "Middle.Motor", corrected = "Out.Motor" },
    { name = "heater", sign = -1, signal = "Slow.Heater", corrected = "Out.Heater" },
]
"""


def test_a_message_that_answers_several_counts_for_each_at_its_own_frames(
    make_database: Callable[..., VehicleDatabase],
) -> None:
    """At 100, 50 and 10 Hz currents rise and sum to 0; every frame is answered by all three, as they were last."""
    monitor = BusMonitor(make_database(MIXED_LAYOUT, dbc=MIXED_DBC), 0.0)
    latest, seen = {1: bytes(2), 2: bytes(2), 3: bytes(2)}, 0
    for k in range(200):
        for identifier, every, late_s, codes_per_s in (
            (1, 1, 0.0, 4000.0),
            (2, 2, 0.003, 2000.0),
            (3, 10, 0.006, 2000.0),
        ):
            t = 0.01 * k + late_s
            if k % every == 0:
                latest[identifier] = round(codes_per_s * t).to_bytes(2, "little", signed=True)
                monitor.take((identifier, False), bytearray(latest[identifier]), t)
                monitor.take((4, False), bytearray(b"".join(latest.values())), t + 0.0005)
        sums = monitor.look(0.01 * k + 0.007).sums
        if k > 50 and sums.corrected_a is not None:
            seen += 1
            assert (sums.measured_a, sums.corrected_a) == pytest.approx((0.0, 0.0), abs=0.3)
    assert seen > 100


def test_answers_to_frames_that_came_before_the_monitor_do_not_count_in_the_sum(bus: Bus) -> None:
    bus.send("HV_BatteryCorrected", 0.001, BatteryCurrentCorrected=500.0)
    assert bus.look(0.002).sums == Sums()
    bus.battery(0.02, 100.0, 95.0)
    bus.motor(0.02, 80.0, 80.0)
    sums = bus.look(0.03).sums
    assert (sums.measured_a, sums.corrected_a) == pytest.approx((20.0, 15.0))


def test_answers_to_frames_without_the_current_do_not_count_in_the_sum(
    make_database: Callable[..., VehicleDatabase],
) -> None:
    """The battery's frames have its current every other time: 40 A, then 60 A, and the heater's of halfway 10 A."""
    dbc = SMALL_DBC.replace(
        " SG_ Battery : 7|16@0-", ' SG_ Page M : 32|8@1+ (1,0) [0|255] "" Node\n SG_ Battery m0 : 7|16@0-'
    )
    monitor = BusMonitor(make_database(dbc=dbc), 0.0)
    monitor.take((258, False), bytearray([*(40000).to_bytes(2, "little")]), 0.05)
    monitor.take((0x200, True), bytearray([*(4000).to_bytes(2, "little"), 0, 0]), 0.05)
    for k in range(7):
        code = 100 * (k - k % 2)
        pair = [*code.to_bytes(2, "big", signed=True), 0, 0, k % 2, 0, 0, 0]
        monitor.take((256, False), bytearray(pair), 0.01 * k)
        monitor.take((512, False), bytearray([*code.to_bytes(2, "little", signed=True), 0, 0, 2, 0, 0, 0]), 0.01 * k)
    sums = monitor.look(0.06).sums
    assert sums.measured_a == sums.corrected_a == pytest.approx(40.0)


def test_a_sum_is_not_known_while_a_branch_is_stale_or_unanswered(bus: Bus) -> None:
    bus.battery(0.0, 100.0, 90.0)
    bus.motor(0.0, 80.0)
    sums = bus.look(0.01).sums
    assert sums.measured_a == pytest.approx(20.0)
    assert sums.corrected_a is None
    bus.battery(0.3, 100.0, 90.0)
    view = bus.look(0.31)
    assert view.sums == Sums()
    assert of(view, "motor").is_stale


def test_frames_that_fail_their_check_are_counted_and_not_used(bus: Bus) -> None:
    bus.send("HV_Battery", 0.01, BatteryCurrent=100.0)
    bus.send("HV_Battery", 0.02, step=0, BatteryCurrent=200.0)
    bus.send("HV_Battery", 0.03, spoilt=True, BatteryCurrent=300.0)
    bus.send("HV_Battery", 0.04, step=7, BatteryCurrent=400.0)
    bus.monitor.take((0x110, False), bytearray(), 0.05)
    battery = of(bus.look(0.06), "battery")
    assert battery.faults == faults(corrupt=2, repeated=1, lost=1)
    assert battery.measured_a == pytest.approx(100.0)
    assert battery.age_s == pytest.approx(0.05)
    bus.send("HV_Battery", 0.07, step=2, BatteryCurrent=500.0)
    battery = of(bus.look(0.08), "battery")
    assert battery.faults == faults(corrupt=2, repeated=1, lost=2)
    assert battery.measured_a == pytest.approx(500.0)


def test_faults_of_corrected_messages_are_counted_apart(bus: Bus) -> None:
    bus.battery(0.01, 100.0, 95.0)
    bus.send("HV_BatteryCorrected", 0.02, spoilt=True)
    battery = of(bus.look(0.03), "battery")
    assert (battery.faults, battery.corrected_faults) == (faults(), faults(corrupt=1))


def test_a_code_that_is_no_value_is_not_shown_as_a_current(bus: Bus) -> None:
    sna_a = -32768 * 0.02
    bus.battery(0.01, sna_a, sna_a, quality=Quality.NOT_AVAILABLE)
    battery = of(bus.look(0.02), "battery")
    assert (battery.measured_a, battery.corrected_a, battery.correction_a) == (None, None, None)
    assert battery.quality == "NOT_AVAILABLE"
    assert battery.is_seen


def test_branches_that_were_never_seen_do_not_count_in_the_sum(bus: Bus) -> None:
    bus.battery(0.0, 100.0)
    bus.motor(0.0, 80.0)
    view = bus.look(0.01)
    assert [branch.name for branch in view.branches if branch.is_seen] == ["battery", "motor"]
    assert view.sums.measured_a == pytest.approx(20.0)
    assert (of(view, "dcdc").age_s, of(view, "dcdc").rate_hz) == (None, 0.0)


def test_without_corrected_messages_the_branches_are_shown_as_they_are(bus: Bus) -> None:
    bus.battery(0.0, 100.0)
    view = bus.look(0.01)
    assert (view.publishes_corrected, view.node, view.has_status) == (False, None, True)
    assert view.sums.measured_a == pytest.approx(100.0)
    assert view.sums.corrected_a is None
    assert of(view, "battery").quality is None


@pytest.mark.parametrize("looks_hz", [4, 1])
def test_rates_are_those_of_the_last_seconds(bus: Bus, looks_hz: int) -> None:
    """50 frames/s for 5 s, then 100 frames/s for 5 s, corrupt ones included."""
    times = [0.02 * k for k in range(250)] + [5.0 + 0.01 * k for k in range(500)]
    looks = [(k + 1) / looks_hz for k in range(10 * looks_hz)]
    rates = {}
    for look_s in looks:
        while times and times[0] < look_s:
            bus.send("HV_Battery", times.pop(0), spoilt=len(times) % 10 == 0)
        rates[look_s] = of(bus.look(look_s), "battery").rate_hz
    assert rates[5.0] == pytest.approx(50.0)
    assert rates[6.0] == pytest.approx(75.0)
    assert rates[10.0] == pytest.approx(100.0)


def test_the_status_is_read_as_the_node_wrote_it(bus: Bus) -> None:
    bus.send(
        "HV_CorrectionStatus",
        1.0,
        State=State.PASSING_THROUGH,
        Reason=Reason.BRANCH_STALE,
        ParameterSet=44,
        JunctionSumMeasured=-12.3,
        JunctionSumCorrected=0.4,
    )
    node = bus.look(1.25).node
    assert node is not None
    assert (node.state, node.reason, node.parameter_set) == ("PASSING_THROUGH", "BRANCH_STALE", 44)
    assert node.sums.measured_a == pytest.approx(-12.3)
    assert node.sums.corrected_a == pytest.approx(0.4)
    assert node.age_s == pytest.approx(0.25)
    assert not node.is_silent
    gone = bus.look(4.0).node
    assert gone is not None
    assert gone.is_silent


def test_sums_that_the_node_does_not_know_are_not_shown(bus: Bus) -> None:
    bus.send("HV_CorrectionStatus", 1.0, JunctionSumMeasured=-3276.8, JunctionSumCorrected=-3276.8)
    node = bus.look(1.0).node
    assert node is not None
    assert node.sums == Sums()


def test_the_view_depends_on_time_differences_alone(database: VehicleDatabase) -> None:
    views = []
    for start_s in (0.0, 4096.0):
        bus = Bus(database, start_s)
        bus.battery(start_s + 0.5, 100.0, 95.0)
        bus.motor(start_s + 0.75, 80.0, 81.0)
        bus.send("HV_CorrectionStatus", start_s + 0.75, State=1)
        views.append(bus.look(start_s + 1.0))
    assert views[0] == views[1]


def test_frames_of_others_change_nothing(bus: Bus) -> None:
    bus.battery(0.0, 100.0, 95.0)
    before = bus.look(0.01)
    bus.monitor.take((0x3AB, False), bytearray(8), 0.01)
    bus.monitor.take((0x110, True), bytearray(8), 0.01)
    after = bus.look(0.01)
    assert dataclasses.asdict(after)["branches"] == dataclasses.asdict(before)["branches"]


class SmallBus:
    """Frames of the small vehicle, by raw codes."""

    def __init__(self, database: VehicleDatabase) -> None:
        self.database, self.monitor = database, BusMonitor(database, 0.0)

    def send(self, message: str, time_s: float, **codes: int) -> None:
        definition = self.database.message(message)
        data = definition.encode({signal.name: 0 for signal in definition.signals} | codes, scaling=False, strict=False)
        self.monitor.take(key_of(definition), bytearray(data), time_s)


def test_a_power_branch_is_shown_as_a_current(make_database: Callable[..., VehicleDatabase]) -> None:
    bus = SmallBus(make_database())
    bus.send("Heater", 0.0, Power=4000)
    assert of(bus.monitor.look(0.01), "heater").measured_a is None
    bus.send("Net", 0.02, Voltage=40000)
    for k in range(2):
        bus.send("Heater", 0.03 + 0.01 * k, Power=4000)
        bus.send("Pair", 0.03 + 0.01 * k, Battery=150, Motor=-100)
        bus.send("PairOut", 0.031 + 0.01 * k, Battery=140, Motor=-100, Quality=2)
    view = bus.monitor.look(0.05)
    assert of(view, "heater").measured_a == pytest.approx(-10.0)
    assert of(view, "heater").corrected_a is None
    assert view.sums.measured_a == pytest.approx(0.0)
    assert view.sums.corrected_a == pytest.approx(-1.0)
    assert view.has_status is False


def test_a_multiplexed_branch_keeps_its_value_between_its_frames(
    make_database: Callable[..., VehicleDatabase],
) -> None:
    dbc = SMALL_DBC.replace(
        ' SG_ Battery : 7|16@0- (0.1,0) [-3000|3000] "A" Node\n SG_ Motor : 23|16@0-',
        ' SG_ Page M : 32|8@1+ (1,0) [0|255] "" Node\n SG_ Battery m0 : 7|16@0- (0.1,0) [-3000|3000] "A" Node\n'
        " SG_ Motor m1 : 7|16@0-",
    )
    monitor = BusMonitor(make_database(dbc=dbc), 0.0)
    for page, code in ((0, 150), (1, -100), (1, -120)):
        monitor.take((256, False), bytearray([*code.to_bytes(2, "big", signed=True), 0, 0, page, 0, 0, 0]), 0.01)
    view = monitor.look(0.02)
    assert of(view, "battery").measured_a == pytest.approx(15.0)
    assert of(view, "motor").measured_a == pytest.approx(-6.0)


def test_a_layout_that_publishes_nothing_can_be_watched(make_database: Callable[..., VehicleDatabase]) -> None:
    layout = SMALL_LAYOUT.replace(', corrected = "PairOut.Battery", quality = "PairOut.Quality"', "").replace(
        ', corrected = "PairOut.Motor"', ""
    )
    bus = SmallBus(make_database(layout=layout))
    bus.send("Pair", 0.0, Battery=150, Motor=-100)
    view = bus.monitor.look(0.01)
    assert not view.publishes_corrected
    assert view.sums.measured_a == pytest.approx(10.0)
