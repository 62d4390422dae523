"""The node's core, frame by frame: answers, counters and status."""

import math
import re
from collections.abc import Callable, Collection
from functools import partial
from typing import Any
from weakref import ref

import pytest
from e2e.p01 import e2e_p01_check, e2e_p01_protect
from msgspec.structs import replace

from ecu_node.bus.wiring import InForce, Mode, put_in_force, wire
from ecu_node.core.corrector import Corrector
from ecu_node.core.junction import REMEMBERED_FRAMES
from ecu_node.core.signals import FrameKey
from ecu_node.core.status import Quality, Reason, State
from ecu_node.database import VehicleDatabase
from ecu_node.errors import DatabaseError, LayoutError
from ecu_node.parameters import JunctionResidual
from tests.ecu_node.vehicles import (
    BATTERY,
    HEATER,
    NET,
    PAIR,
    SMALL_DBC,
    SMALL_LAYOUT,
    Frame,
    MakeDatabase,
    answers,
    battery,
    corrector_for,
    damaged,
    decoded,
    drive,
    frame_of,
    motor,
    parameters_for,
    passed_on,
    protected,
    whole_vehicle,
)

STATUS, DCDC = FrameKey(0x5F0, False), FrameKey(0x140, False)
NO_VALUE_A = -655.36
"""What the code for no value would be as a current of the battery."""


def status_of(database: VehicleDatabase, corrector: Corrector, now_s: float) -> dict[str, Any]:
    corrector.look(now_s)
    status = corrector.status()
    assert status is not None
    assert status.key == STATUS
    assert e2e_p01_check(bytearray(status.data), 0x5F0)
    return decoded(database, "HV_CorrectionStatus", bytes(status.data))


def state_at(corrector: Corrector, now_s: float) -> tuple[State, Reason]:
    corrector.look(now_s)
    return corrector.state()


def sums_at(corrector: Corrector, now_s: float) -> tuple[float | None, float | None]:
    corrector.watch.look(now_s)
    sums = corrector.watch.sums
    return (None, None) if sums is None else (sums.measured_a, sums.corrected_a)


def published(
    database: VehicleDatabase, corrector: Corrector, frame: Frame, now_s: float, name: str = "battery"
) -> tuple[float, Quality | None]:
    """Current [A] and quality, if the DBC has one, in the answer to a frame of a branch."""
    branch = database.layout.find_branch(name)
    (answer,) = answers(corrector, frame, now_s)
    values = decoded(database, (branch.corrected or "").partition(".")[0], answer.data)
    current, quality = ((signal or "").partition(".")[2] for signal in (branch.corrected, branch.quality))
    return values[current], values.get(quality)


@pytest.mark.parametrize(("current", "quality"), [(-655.36, Quality.NOT_AVAILABLE), (655.0, Quality.INVALID)])
def test_codes_without_value_are_published_as_such(database: VehicleDatabase, current: float, quality: Quality) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0))
    assert published(database, corrector, battery(database, 3, current), 0.0) == (-655.36, quality)
    assert sums_at(corrector, 0.0) == (None, None)
    assert state_at(corrector, 0.0) == (State.PARTLY_CORRECTING, Reason.INPUT_MISSING)


def test_corrected_value_beyond_the_signal_range_is_clamped_and_counted(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(-0.2, 0.0))
    frames = [battery(database, counter, current) for counter, current in enumerate((520.0, 520.02, -640.0))]
    found = [published(database, corrector, frame, 0.0) for frame in frames]
    assert found == [(current, Quality.CORRECTED) for current in (650.0, 650.0, -650.0)]
    assert corrector.counters.saturated == 2
    assert corrector.counters.text().endswith(", saturated 2")


def test_status_is_starting_until_branches_arrive_then_correcting(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    before = status_of(database, corrector, 0.01)
    assert (before["State"], before["Reason"], before["ParameterSet"]) == (State.STARTING, Reason.NONE, 300 % 256)
    assert before["JunctionSumMeasured"] == before["JunctionSumCorrected"] == -3276.8
    answers(corrector, battery(database, 0, 80.06), 0.02)
    answers(corrector, motor(database, 0, 60.0), 0.03)
    after = status_of(database, corrector, 0.04)
    assert (after["State"], after["Reason"]) == (State.CORRECTING, Reason.NONE)
    assert after["JunctionSumMeasured"] == pytest.approx(20.1), "20.06, rounded"
    assert after["JunctionSumCorrected"] == pytest.approx((80.0 - 5.0) / 1.25 - 60.0)
    assert (before["AliveCounter"], after["AliveCounter"]) == (0, 1)


TAKE: dict[Mode, Callable[[Corrector, Frame, float], object]] = {Mode.OVERLAY: answers, Mode.GATEWAY: passed_on}
"""By mode, the function that gives a frame to the node."""
balanced = partial(drive, battery_a=100.0, motor_a=100.0)


STARTING, CORRECTING, ASLEEP = ((state, Reason.NONE) for state in (State.STARTING, State.CORRECTING, State.ASLEEP))
STALE = (State.PASSING_THROUGH, Reason.BRANCH_STALE)
BOTH, LATE = ("battery", "motor"), ("motor",)


DRIVEN = (1.0, (), CORRECTING)
PHASES = {
    "silent branch": [DRIVEN, (0.5, LATE, STALE), (1.5, (), STALE)],
    "tried again after bus sleep": [DRIVEN, (0.5, LATE, STALE), (1.5, BOTH, STALE), (6.0, BOTH, ASLEEP), DRIVEN],
    "branch never appears": [(2.9, LATE, STARTING), (0.4, LATE, STALE)],
    "sleep is not a fault": [(10.0, BOTH, STARTING), DRIVEN, (2.0, BOTH, ASLEEP), DRIVEN],
}


@pytest.mark.parametrize("phases", PHASES.values(), ids=PHASES)
def test_silent_branch_stops_the_correction_until_the_bus_has_slept(
    database: VehicleDatabase, phases: list[tuple[float, Collection[str], tuple[State, Reason]]]
) -> None:
    """Each phase has its duration [s], the silent branches, and the state of the node at its end."""
    corrector, now_s = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0)), 0.0
    for seconds, silent, expected in phases:
        drive(database, corrector, now_s, now_s + seconds, silent=silent)
        now_s += seconds
        assert corrector.state() == expected
        if expected == STALE:
            assert corrector.latched_branches == LATE
            assert (corrector.watch.sums is None) == bool(silent)
            assert {branch.quality for branch in corrector.branches} == {Quality.PASSED_THROUGH}


@pytest.mark.parametrize(("last_s", "is_missed"), [(0.1, False), (0.11, True)])
def test_branch_is_missed_after_its_deadline(database: VehicleDatabase, last_s: float, is_missed: bool) -> None:
    """5 s after the look that first finds the bus silent, the node tries again."""
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    answers(corrector, motor(database, 0), 0.0)
    for counter, now_s in enumerate((0.0, last_s)):
        answers(corrector, battery(database, counter), now_s)
        corrector.look(now_s)
    missed = Reason.BRANCH_STALE if is_missed else Reason.NONE
    for now_s, latched in ((0.15, missed), (1.0, missed), (5.9, missed), (6.0, Reason.NONE)):
        corrector.look(now_s)
        assert corrector.latched is latched


@pytest.mark.parametrize(("fault", "state"), [((0.0, 0.0), State.PASSING_THROUGH), ((0.25, 5.0), State.CORRECTING)],
    ids=["battery has no fault", "battery is corrected"])  # fmt: skip
def test_node_does_not_wait_for_branches_without_parameters(
    database: VehicleDatabase, fault: tuple[float, float], state: State
) -> None:
    corrector = corrector_for(database, battery=fault)
    answers(corrector, battery(database, 0), 0.0)
    assert state_at(corrector, 0.05) == (state, Reason.NONE)
    assert sums_at(corrector, 0.05)[0] == pytest.approx(100.0)


TWO_SOURCES = (
    SMALL_LAYOUT.replace("Pair.Motor", "Other.Motor"),
    SMALL_DBC.replace(" SG_ Motor : 23", "BO_ 257 Other: 2 Node\n SG_ Motor : 7", 1),
)


def test_value_from_before_bus_sleep_or_reload_is_never_published(make_database: MakeDatabase) -> None:
    database = make_database(*TWO_SOURCES)
    faults = {"battery": (0.5, 3.0), "motor": (0.25, 0.0)}
    corrector = corrector_for(database, **faults)
    pair = frame_of(database, "Pair", Battery=153.0)
    answers(corrector, frame_of(database, "Other", Motor=50.0), 0.0)
    no_value = pytest.approx(0.05 * 32768)
    assert published(database, corrector, pair, 0.1, "motor")[0] == 40.0
    for now_s in (0.2, 3600.0, 3600.1):
        corrector.look(now_s)
    assert published(database, corrector, pair, 3600.2, "motor")[0] == no_value
    corrector.look(3600.2)
    in_force = InForce(parameters=parameters_for(database, **faults))
    put_in_force(corrector, database, in_force, 3600.4, mode=Mode.OVERLAY)
    assert published(database, corrector, pair, 3600.4, "motor")[0] == no_value


def test_branch_keeps_only_its_newest_frames(database: VehicleDatabase) -> None:
    class Payload(bytearray):
        """A bytearray to which there can be weak references."""

    source = corrector_for(database, battery=(0.25, 5.0)).sources[BATTERY]
    (branch,) = source.branches
    data = [battery(database, counter).data for counter in range(15)]
    first = Payload(data[0])
    is_kept = ref(first)
    source.answer(first, 0.0)
    del first
    assert is_kept()
    for k in range(1, 1 + REMEMBERED_FRAMES):
        assert branch.time_s == pytest.approx(0.01 * (k - 1))
        source.answer(bytearray(data[k % 15]), 0.01 * k)
    assert not is_kept()
    assert len([*branch.newest_first()]) == REMEMBERED_FRAMES


def test_branches_going_silent_one_after_another_are_not_a_fault(database: VehicleDatabase) -> None:
    """Battery and DC/DC fall silent at once, but their timeouts differ."""
    corrector = corrector_for(database, battery=(0.25, 5.0), dcdc=(0.0, 0.0))
    seen = set()
    for k in range(100):
        if k < 50:
            answers(corrector, battery(database, k % 15, 6.25), 0.02 * k)
            answers(corrector, Frame(DCDC, protected(database, "HV_Dcdc", k % 15, DcdcCurrent=1.0)), 0.02 * k)
        seen.add(state_at(corrector, 0.02 * k + 0.01))
    assert {reason for _, reason in seen} == {Reason.NONE}
    assert corrector.state() == ASLEEP


def test_stray_frame_of_an_unfitted_branch_stops_the_correction_until_bus_sleep(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    drive(database, corrector, 0.0, 1.0)
    answers(corrector, Frame(DCDC, protected(database, "HV_Dcdc", 0, DcdcCurrent=1.0)), 1.0)
    drive(database, corrector, 1.0, 3.0)
    assert corrector.latched_branches == ("dcdc",)
    drive(database, corrector, 3.0, 10.0, silent=BOTH)
    drive(database, corrector, 10.0, 12.0)
    assert corrector.state() == (State.CORRECTING, Reason.NONE)


def test_correction_that_worsens_the_sum_stops_until_other_parameters_are_in_force(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.2, 0.0), motor=(0.0, 0.0))
    balanced(database, corrector, 0.0, 9.0)
    assert corrector.state() == (State.CORRECTING, Reason.NONE)
    balanced(database, corrector, 9.0, 12.0)
    assert corrector.state() == (State.PASSING_THROUGH, Reason.CORRECTION_WORSE)
    assert corrector.watch.sums is not None
    assert corrector.watch.sums.corrected_a == pytest.approx(100.0 / 1.2 - 100.0)
    parameters = parameters_for(database, battery=(0.0, 0.5), motor=(0.0, 0.0))
    put_in_force(corrector, database, InForce(parameters=parameters), 12.0, mode=Mode.OVERLAY)
    balanced(database, corrector, 12.0, 30.0)
    assert corrector.state() == (State.CORRECTING, Reason.NONE)


WATCHED = '\n[watch]\ninput = "contactor_state"\nvalid = [2]\n'


@pytest.mark.parametrize(("contactor", "reason"), [(1, Reason.NONE), (2, Reason.CORRECTION_WORSE)])
def test_sum_is_judged_only_in_valid_states(make_database: MakeDatabase, contactor: int, reason: Reason) -> None:
    own = whole_vehicle(make_database, WATCHED)
    corrector = corrector_for(own, battery=(0.2, 0.0), motor=(0.0, 0.0))
    balanced(own, corrector, 0.0, 12.0, ContactorState=contactor)
    assert corrector.state()[1] == reason
    assert corrector.watch.sums is not None


def test_missing_input_of_the_junction_watch_is_reported_in_the_state(make_database: MakeDatabase) -> None:
    own = whole_vehicle(make_database, '\n[watch]\ninput = "speed"\nvalid = [0]\n')
    corrector, motion = corrector_for(own, battery=(0.01, 0.0), motor=(0.0, 0.0)), FrameKey(0x200, extended=False)
    missing = (State.PARTLY_CORRECTING, Reason.INPUT_MISSING)
    for start_s, end_s, state in ((0.0, 1.0, missing), (1.0, 1.1, CORRECTING), (1.1, 3.0, missing)):
        if state is CORRECTING:
            answers(corrector, Frame(motion, protected(own, "VD_Motion", 0)), start_s)
        balanced(own, corrector, start_s, end_s)
        assert corrector.state() == state


IMPOSSIBLE = [("[watch] valid", "4"), ("[watch] valid", "-1"), ("[contactor] open", "0.5")]


@pytest.mark.parametrize(("key", "value"), IMPOSSIBLE)
def test_layout_with_an_impossible_input_value_is_refused(make_database: MakeDatabase, key: str, value: str) -> None:
    name = key.partition(" ")[2]
    words = rf"{re.escape(key)}: {value} is no value of HV_Battery\.ContactorState, which has 2 bits"
    with pytest.raises(LayoutError, match=words):
        whole_vehicle(make_database, WATCHED, (rf"{name} = \[.*\]", f"{name} = [2, {value}]"))


def test_layout_may_name_any_value_of_a_float_input(make_database: MakeDatabase) -> None:
    waiting = 'input = [{ name = "net", signal = "Net.Voltage" }]\ncontactor = { input = "net", open = [0.123] }\n'
    dbc = SMALL_DBC.replace("Net: 2", "Net: 4").replace("0|16@1+ (0.01,0) [0|650]", "0|32@1- (1,0) [0|650]")
    own = make_database(f"{SMALL_LAYOUT}{waiting}", f"{dbc}SIG_VALTYPE_ 258 Voltage : 1;\n")
    assert own.layout.contactor is not None


LOADED = JunctionResidual(measured_a=0.0, corrected_a=3.0, measured_mean_a=0.0, corrected_mean_a=-3.0, expected_a=-3.0)
"""Battery and motor sum to 0 A; with a load of 3 A that no branch measures right sensors would not."""


EXPECTED = [
    (1.5, JunctionResidual(measured_a=0.0, corrected_a=0.0), Reason.CORRECTION_WORSE),
    (0.5, JunctionResidual(measured_a=0.0, corrected_a=0.0), Reason.NONE),
    (3.0, JunctionResidual(measured_a=0.0, corrected_a=3.0), Reason.NONE),
    (3.0, LOADED, Reason.NONE),
    (-3.0, LOADED, Reason.CORRECTION_WORSE),
]


@pytest.mark.parametrize(
    ("offset_a", "sums", "reason"),
    EXPECTED,
    ids=["1.5 A more", "0.5 A more", "3 A, seen by the calibrator", "sum of 0 A at a load of 3 A", "-3 A at that load"],
)
def test_junction_sum_is_judged_relative_to_the_expected_sum(
    database: VehicleDatabase, offset_a: float, sums: JunctionResidual, reason: Reason
) -> None:
    parameters = parameters_for(database, battery=(0.0, offset_a), motor=(0.0, 0.0))
    corrector = wire(database, InForce(parameters=replace(parameters, junction_residual=sums)), start_s=0.0)
    balanced(database, corrector, 0.0, 12.0)
    assert corrector.state()[1] == reason


MOVING, AT_REST = (0.1, 100.0, 50.0, 60.0, ("motor",)), (-0.2, 0.0, 10.0, 0.0, ())


@pytest.mark.parametrize(("drift", "base_a", "swing_a", "motor_a", "stuck"), [MOVING, AT_REST])
def test_branch_is_stuck_if_it_stays_constant_while_the_sum_moves(
    database: VehicleDatabase, drift: float, base_a: float, swing_a: float, motor_a: float, stuck: tuple[str, ...]
) -> None:
    corrector = corrector_for(database, battery=(drift, 0.0), motor=(0.0, 0.0))
    drive(database, corrector, 0.0, 12.0, battery_a=lambda k: base_a + swing_a * math.sin(0.1 * k), motor_a=motor_a)
    assert (corrector.latched is Reason.BRANCH_STUCK) == bool(stuck)
    assert corrector.latched_branches == stuck


def test_branch_that_changes_occasionally_is_not_stuck(make_database: MakeDatabase) -> None:
    own = whole_vehicle(make_database, "\n[watch]\nwindow_s = 60.0\n")
    corrector = corrector_for(own, battery=(0.1, 0.0), motor=(0.0, 0.0))
    swinging = partial(drive, battery_a=lambda k: 100.0 + 50.0 * math.sin(0.1 * k), period_s=0.1)
    swinging(own, corrector, 0.0, 62.0, motor_a=lambda k: 60.0 if k % 30 < 28 else 80.0)
    assert corrector.latched is not Reason.BRANCH_STUCK


def test_shadow_mode_reports_the_corrected_sum_but_publishes_measured_values(database: VehicleDatabase) -> None:
    parameters = parameters_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    corrector = wire(database, InForce(parameters=parameters), start_s=0.0, shadow=True)
    assert published(database, corrector, battery(database, 0, 80.0), 0.0) == (80.0, Quality.PASSED_THROUGH)
    answers(corrector, motor(database, 0, 60.0), 0.0)
    status = status_of(database, corrector, 0.01)
    assert (status["State"], status["Reason"]) == (State.SHADOW, Reason.NONE)
    assert status["JunctionSumMeasured"] == pytest.approx(20.0)
    assert status["JunctionSumCorrected"] == pytest.approx((80.0 - 5.0) / 1.25 - 60.0)


@pytest.mark.parametrize("slope_a", [3.0, -3.0])
def test_delayed_branches_are_summed_at_the_same_instant(database: VehicleDatabase, slope_a: float) -> None:
    parameters = parameters_for(database, battery=(0.0, 0.0), motor=(0.0, 0.0))
    late = {**parameters.branches, "motor": replace(parameters.branches["motor"], delay_s=0.2)}
    corrector = wire(database, InForce(parameters=replace(parameters, branches=late)), start_s=100.0)
    sums_a = []
    for k in range(100):
        now_s = 100.0 + 0.05 * k
        answers(corrector, battery(database, k % 15, slope_a * k), now_s)
        answers(corrector, motor(database, k % 15, slope_a * (k - 4)), now_s)
        sums_a.append(sums_at(corrector, now_s + 0.01)[0])
    assert sums_a[0] is None, "the battery's first frame is of 0.2 s later, and its timeout is 0.1 s"
    assert None not in sums_a[3:]
    assert sums_a[11:] == pytest.approx([0.0] * 89, abs=0.03)


def test_junction_sum_is_not_interpolated_across_a_frame_without_value(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.0, 0.0), motor=(0.0, 0.0))
    for k, current_a in enumerate((80.0, NO_VALUE_A, 80.0)):
        answers(corrector, battery(database, k, current_a), 0.03 * k)
    answers(corrector, motor(database, 0), 0.02)
    assert sums_at(corrector, 0.07) == (None, None)
    answers(corrector, motor(database, 1), 0.06)
    assert sums_at(corrector, 0.07) == pytest.approx((-20.0, -20.0))


def test_value_after_a_frame_without_value_is_used_even_if_its_time_is_earlier(database: VehicleDatabase) -> None:
    """As after a clock step: the first frame has the time of its reading, the next one that of its arrival."""
    corrector = corrector_for(database, battery=(0.0, 0.0), motor=(0.0, 0.0))
    answers(corrector, battery(database, 0, NO_VALUE_A), 0.02)
    answers(corrector, battery(database, 1, 80.0), 0.01)
    answers(corrector, motor(database, 0), 0.01)
    assert sums_at(corrector, 0.02) == pytest.approx((-20.0, -20.0))
    assert corrector.watch.verdict is None


@pytest.mark.parametrize(("signal", "codes"), [("State", State), ("Reason", Reason)])
def test_dbc_names_all_status_codes(database: VehicleDatabase, signal: str, codes: type[State] | type[Reason]) -> None:
    choices: dict[int, Any] = dict(database.signal(f"HV_CorrectionStatus.{signal}")[1].choices or {})
    names = {code: str(name).upper() for code, name in choices.items()}
    assert names == {code.value: code.name.replace("_", "") for code in codes}


@pytest.mark.parametrize("offset", ["0", "-20"], ids="offset in the DBC: {}".format)
def test_power_branch_enters_the_sum_as_power_over_voltage(make_database: MakeDatabase, offset: str) -> None:
    dbc = SMALL_DBC.replace("(0.01,0)", f"(0.01,{offset})").replace("(-0.05,0)", f"(-0.05,{offset})")
    database = make_database(dbc=dbc)
    corrector = corrector_for(database, battery=(0.0, 0.0), motor=(0.0, 0.0), heater=(0.25, 0.0))
    answers(corrector, frame_of(database, "Pair", Battery=50.0, Motor=40.0), 0.0)
    heater = frame_of(database, "Heater", Power=4000)
    answers(corrector, heater, 0.0)
    assert sums_at(corrector, 0.0) == (None, None)
    answers(corrector, frame_of(database, "Net", Voltage=400.0), 0.0)
    assert corrector.sources[NET].timeout_s == math.inf, "only frames of branches can be too old"
    assert answers(corrector, heater, 0.1) == []
    assert sums_at(corrector, 0.1) == pytest.approx((50.0 - 40.0 - 10.0, 50.0 - 40.0 - 8.0))
    answers(corrector, frame_of(database, "Net", Voltage=500.0), 0.2)
    assert corrector.branches[2].currents_at(0.1) == pytest.approx((-10.0, -8.0)), "each at its own voltage"
    answers(corrector, heater, 0.9)
    assert corrector.branches[2].currents_at(0.9) is None, "a voltage 0.7 s old is not divided by"
    answers(corrector, frame_of(database, "Net", Voltage=0.5), 0.9)
    assert corrector.branches[2].currents_at(0.9) is None, "nor one near zero"


@pytest.mark.parametrize(
    ("scale", "unit"), [("1", "50W/bit"), ("50", "50W/bit")], ids=["in the unit alone", "also as factor"]
)
def test_scale_of_a_power_in_its_unit_is_applied_once(make_database: MakeDatabase, scale: str, unit: str) -> None:
    dbc = SMALL_DBC.replace('(1,0) [0|60000] "W"', f'({scale},0) [0|60000] "{unit}"')
    corrector = corrector_for(make_database(SMALL_LAYOUT, dbc), heater=(0.0, 0.0))
    answers(corrector, Frame(HEATER, (80).to_bytes(4, "little")), 0.0)
    answers(corrector, Frame(NET, (40_000).to_bytes(2, "little")), 0.0)
    assert corrector.branches[2].currents_at(0.0) == pytest.approx((-10.0, -10.0))


POWER_OUT = (
    SMALL_LAYOUT.replace('"Net.Voltage"', '"Net.Voltage", corrected = "PairOut.Heater"'),
    SMALL_DBC.replace(" SG_ Quality", ' SG_ Heater : 40|16@1+ (1,0) [0|60000] "W" Node\n SG_ Quality')
    + 'VAL_ 512 Heater 65535 "SNA";\n',
)


def test_power_is_corrected_without_a_voltage_if_its_sensor_has_no_offset(make_database: MakeDatabase) -> None:
    database = make_database(*POWER_OUT)
    corrector = corrector_for(database, heater=(0.25, 0.0))
    assert published(database, corrector, frame_of(database, "Heater", Power=4000), 0.0, "heater")[0] == 3200.0


def test_published_power_is_corrected_at_the_voltage_of_its_own_frame(make_database: MakeDatabase) -> None:
    """Until it is stale, it is repeated in each answer to the other branches of its message."""
    database = make_database(*POWER_OUT)
    corrector = corrector_for(database, heater=(0.25, -2.0))
    pair = frame_of(database, "Pair", Battery=0.0, Motor=0.0)
    heater = frame_of(database, "Heater", Power=4000)

    def heater_w(frame: Frame, now_s: float) -> float:
        return published(database, corrector, frame, now_s, "heater")[0]

    def volts(volts: float, now_s: float) -> None:
        answers(corrector, frame_of(database, "Net", Voltage=volts), now_s)

    assert heater_w(heater, 0.0) == 65535, "no voltage yet"
    volts(400.0, 0.1)
    assert heater_w(pair, 0.15) == 65535, "nor one at the time of the last power"
    assert heater_w(heater, 0.2) == (4000.0 - 2.0 * 400.0) / 1.25
    volts(500.0, 0.3)
    assert heater_w(pair, 0.4) == (4000.0 - 2.0 * 400.0) / 1.25
    assert heater_w(heater, 0.5) == (4000.0 - 2.0 * 500.0) / 1.25
    assert state_at(corrector, 0.5) == (State.CORRECTING, Reason.NONE)
    assert heater_w(heater, 0.9) == 65535, "the voltage is stale"
    assert state_at(corrector, 0.9) == (State.PARTLY_CORRECTING, Reason.INPUT_MISSING)
    assert heater_w(pair, 1.5) == 65535, "stale"
    volts(500.0, 1.6)
    assert heater_w(heater, 1.7) == (4000.0 - 2.0 * 500.0) / 1.25
    answers(corrector, Frame(NET, b"\0"), 1.8)
    assert heater_w(heater, 1.9) == 65535, "a frame came that is too short for the voltage"
    assert corrector.counters.saturated == 0


def test_a_signal_beyond_the_end_of_its_frame_is_invalid(make_database: MakeDatabase) -> None:
    database = make_database()
    corrector = corrector_for(database, battery=(0.1, 0.0))
    answers(corrector, Frame(PAIR, b"\x00\x10\x00\x10\x00\x00\x00\x00"), 0.0)
    short = Frame(PAIR, b"\x00\x10\x00")
    assert published(database, corrector, short, 0.0)[0] == pytest.approx(1.6 / 1.1, abs=0.05)
    assert published(database, corrector, short, 0.0, "motor")[0] == pytest.approx(0.05 * 32768)
    assert corrector.counters.short == 2
    answers(corrector, frame_of(database, "Pair", Battery=1.6, Motor=0.0), 0.1)
    answers(corrector, Frame(PAIR, b"\0"), 0.2)
    assert state_at(corrector, 0.2) == (State.PARTLY_CORRECTING, Reason.INPUT_MISSING)


MOTOR_SNA = '512 Motor -32768 "SNA"'
INIT, OFF = (MOTOR_SNA, f'{MOTOR_SNA} -1 "Init"'), (MOTOR_SNA, f'{MOTOR_SNA} 0 "Off"')
PAGE = (" SG_ Quality", ' SG_ Page M : 40|8@1+ (1,0) [0|1] "" Node\n SG_ Quality m1')
OWN_E2E = '\n[e2e]\nprofile = "P01"\nmessages = ["PairOut"]\n'
LOOP = ("PairOut.Motor", "Pair.Spare")
SPARE = (" SG_ Battery", ' SG_ Spare : 48|16@1- (1,0) [0|0] "A" Node\n SG_ Battery')
OWN_STATUS = '\n[status]\nmessage = "Own"\nstate = "State"\nreason = "Reason"\n'
OTHER_SENDER = (
    SMALL_DBC.replace("Node Corrector", "Node Corrector Other")
    + """BO_ 600 Own: 8 Other
 SG_ State : 0|8@1+ (1,0) [0|255] "" Node
 SG_ Reason : 8|8@1+ (1,0) [0|255] "" Node
"""
)
ONE_SIGNAL = OWN_STATUS.replace('"Reason"', '"State"')
OWN_SUM = OWN_STATUS + 'sum_measured = "Sum"\n'
WITH_SUM = OTHER_SENDER.replace("8 Other", "8 Corrector") + ' SG_ Sum : 16|16@1- (0.1,0) [0|0] "A" Node\n'
FLOATS = SMALL_DBC.replace("Net: 2", "Net: 4").replace("0|16@1+ (0.01", "0|32@1- (0.01")
FLOATS = FLOATS.replace("16|16@1-", "16|32@1-").replace("Quality : 32", "Quality : 48")
OWN_ALIVE = OWN_STATUS + 'alive_counter = "Alive"\n'
ALIVE = ' SG_ Alive : 32|4@1+ (1,0) [0|14] "" Node\n'

DISTURBING = [
    (SMALL_LAYOUT.replace(*LOOP), SMALL_DBC.replace(*SPARE), "Pair would be both received and sent"),
    (SMALL_LAYOUT, SMALL_DBC.replace("8 Corrector", "8 Node"), r"small\.dbc has PairOut by Node; all corrected"),
    (SMALL_LAYOUT + OWN_STATUS, OTHER_SENDER, "PairOut by Corrector, Own by Other; all corrected values and the"),
    (SMALL_LAYOUT, SMALL_DBC.replace("Motor : 16|16", "Motor : 15|16"), "PairOut.Battery overlaps Motor, which"),
    (SMALL_LAYOUT, SMALL_DBC.replace("Quality : 32|2", "Quality : 64|2"), "Quality ends in byte 9"),
    (SMALL_LAYOUT, SMALL_DBC.replace("Out: 8", "Out: 65"), r"small\.dbc: message PairOut, .* has 65 bytes; .* 64"),
    (SMALL_LAYOUT, SMALL_DBC.replace("Quality : 32|2", "Quality : 32|1"), "Quality holds at most 1; 3 must fit"),
    (SMALL_LAYOUT, FLOATS + "SIG_VALTYPE_ 258 Voltage : 1;\n", "heater: signal Voltage is a floating-point .*: name"),
    (SMALL_LAYOUT, FLOATS + "SIG_VALTYPE_ 512 Motor : 1;\n", "motor: signal PairOut.Motor is a floating-point"),
    (SMALL_LAYOUT, SMALL_DBC.replace("2@1+ (1,0)", "2@1+ (1,1)"), "Quality has factor 1 and offset 1; the node writes"),
    (SMALL_LAYOUT, SMALL_DBC.replace("2@1+ (1,0)", "2@1+ (2,0)"), "Quality has factor 2 and offset 0; the node writes"),
    (SMALL_LAYOUT, SMALL_DBC.replace("Quality : 32|2", "Quality : 32|3"), r"range \[0\|3\], .* codes 0 to 4;"),
    (SMALL_LAYOUT + OWN_ALIVE, WITH_SUM + ALIVE, r"Own\.Alive has the range \[0\|14\], but .* writes codes 0 to 15"),
    (SMALL_LAYOUT, SMALL_DBC.replace(*PAGE), "PairOut.Quality is multiplexed; what the node sends .* in every frame"),
    (SMALL_LAYOUT, SMALL_DBC.replace(MOTOR_SNA, '512 Motor 32767 "Max"'), "Motor needs a code named SNA"),
    (SMALL_LAYOUT + OWN_SUM, WITH_SUM, r"small\.toml: status: signal Sum needs a code named SNA in the DBC"),
    (SMALL_LAYOUT + OWN_SUM, WITH_SUM + 'VAL_ 600 Sum 3 "SNA";\n', "code 3 of signal Sum means 'SNA', .* beyond 0.2"),
    (SMALL_LAYOUT, SMALL_DBC.replace(*INIT), "motor: code -1 of signal Motor means 'Init', .* beyond 0 could be"),
    (SMALL_LAYOUT, SMALL_DBC.replace(*OFF), r"small\.toml: branch motor: the code of 0 of signal Motor is named 'Off'"),
    (SMALL_LAYOUT + OWN_E2E, SMALL_DBC, "PairOut.Battery overlaps the E2E header"),
    (SMALL_LAYOUT + ONE_SIGNAL, WITH_SUM, r"small\.toml: status: signal Own\.State is written twice; give each"),
]


@pytest.mark.parametrize(("layout", "dbc", "words"), DISTURBING)
def test_layout_disturbing_the_bus_is_refused(make_database: MakeDatabase, layout: str, dbc: str, words: str) -> None:
    with pytest.raises((LayoutError, DatabaseError), match=words):
        corrector_for(make_database(layout, dbc))


def test_messages_that_several_may_send_are_no_contradiction(make_database: MakeDatabase) -> None:
    """As where they stand under {SENDRECEIVE} in a SYM file."""
    several = "".join(f"BO_TX_BU_ {identifier} : Node,Corrector;\n" for identifier in (256, 512))
    corrector = corrector_for(make_database(dbc=SMALL_DBC + several), battery=(0.1, 0.0))
    assert state_at(corrector, 0.0) == (State.STARTING, Reason.NONE)


def test_answer_to_a_frame_without_the_current_repeats_its_last_value_until_stale(make_database: MakeDatabase) -> None:
    page = ' SG_ Page M : 48|8@1+ (1,0) [0|255] "" Node\n'
    database = make_database(dbc=SMALL_DBC.replace(" SG_ Battery : 7", f"{page} SG_ Battery m0 : 7", 1))
    corrector = corrector_for(database, battery=(0.5, 0.0))
    with_it, without = frame_of(database, "Pair", Page=0, Battery=150.0, Motor=0.0), Frame(PAIR, b"\0\0\0\0\0\0\1\0")
    frames = ((0.0, with_it), (0.1, without), (0.4, without), (0.6, without))
    found = [published(database, corrector, frame, time_s) for time_s, frame in frames]
    current = (100.0, Quality.CORRECTED)
    assert found == [current, current, current, (-3276.8, Quality.NOT_AVAILABLE)]


# Messages of which some frames fail their check


at_20_ms = partial(drive, period_s=0.02)


def test_message_with_half_of_its_frames_corrupt_is_not_used_at_all(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.02, 3.0))
    assert set(at_20_ms(database, corrector, 0.0, 0.6)) == {Quality.CORRECTED}
    found = at_20_ms(database, corrector, 0.6, 1.4, spoil=2)
    assert corrector.state() == (State.PARTLY_CORRECTING, Reason.E2E_INVALID)
    assert corrector.watch.sums is None
    assert set(found[5:]) == {Quality.INVALID}
    assert at_20_ms(database, corrector, 1.4, 2.0)[-1] == Quality.CORRECTED
    assert corrector.state() == CORRECTING


def test_branch_in_the_first_byte_of_an_invalid_message_is_not_used(make_database: MakeDatabase) -> None:
    one_byte = SMALL_DBC.replace("Battery : 7|16@0- (0.1,0) [-3000|3000]", "Battery : 0|8@1- (3,0) [-300|300]", 1)
    one_byte = one_byte.replace('VAL_ 256 Battery -32768 "SNA";\n', "")
    header = '\n[e2e]\nprofile = "P01"\nmessages = ["Pair"]\noffset = 4\n'
    database = make_database(SMALL_LAYOUT + header, one_byte)
    corrector = corrector_for(database, battery=(0.5, 0.0))
    found = []
    for number in range(20):
        frame = bytearray(database.message("Pair").encode({"Battery": 150.0, "Motor": 0.0}))
        frame[5] = number % 15
        e2e_p01_protect(frame, PAIR.identifier, offset=4, increment_counter=False)
        frame[-1] ^= number % 2
        found += answers(corrector, Frame(PAIR, bytes(frame)), 0.02 * number)
    values = decoded(database, "PairOut", found[-1].data)
    assert (values["Battery"], values["Quality"]) == (-3276.8, Quality.INVALID)


def test_message_with_a_tenth_of_its_frames_corrupt_loses_only_these(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.02, 3.0))
    assert at_20_ms(database, corrector, 0.0, 1.2, spoil=10) == [Quality.CORRECTED] * 54
    assert corrector.state() == CORRECTING


def test_first_two_frames_after_a_silence_are_not_used(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.02, 3.0))
    at_20_ms(database, corrector, 0.0, 0.4)
    assert at_20_ms(database, corrector, 3.0, 3.1) == [Quality.INVALID] * 2 + [Quality.CORRECTED] * 3


@pytest.mark.parametrize(("silence_s", "repeated"), [(1.0, 1), (1.01, 0)])
def test_any_counter_is_accepted_after_a_silence(database: VehicleDatabase, silence_s: float, repeated: int) -> None:
    corrector = corrector_for(database, battery=(0.02, 3.0))
    for now_s in (0.0, silence_s):
        answers(corrector, battery(database, 3), now_s)
    assert corrector.counters.repeated == repeated


@pytest.mark.parametrize("driven_s", [0.0, 1.0])
def test_vehicle_whose_frames_all_fail_their_check_does_not_sleep(database: VehicleDatabase, driven_s: float) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    drive(database, corrector, 0.0, driven_s)
    for number in range(200):
        for frame in (battery(database, number % 15), motor(database, number % 15)):
            answers(corrector, damaged(frame), driven_s + 0.02 * number)
        corrector.look(driven_s + 0.02 * number)
    assert corrector.state() == STALE


def test_waiting_frame_is_judged_by_the_least_timeout_of_its_branches(make_database: MakeDatabase) -> None:
    layout = SMALL_LAYOUT.replace('"battery", sign = 1,', '"battery", sign = 1, timeout_s = 0.1,')
    assert corrector_for(make_database(layout)).sources[PAIR].timeout_s == 0.1


def test_gateway_forwards_the_intact_frames_of_an_invalid_message(database: VehicleDatabase) -> None:
    source = corrector_for(database, Mode.GATEWAY, battery=(0.02, 3.0)).sources[BATTERY]
    for number in range(20):
        frame = bytearray(battery(database, number % 15).data)
        frame[-1] ^= number % 2
        out = source.forward(frame, 0.02 * number)
        assert (out is None) == bool(number % 2)
        assert out != frame
    assert source.is_invalid


@pytest.mark.parametrize("mode", Mode)
def test_branch_of_a_frozen_control_unit_becomes_stale(make_database: MakeDatabase, mode: Mode) -> None:
    own = whole_vehicle(make_database, "", ("timeout_s = .*", "timeout_s = 2.0"))
    corrector = corrector_for(own, mode, battery=(0.02, 3.0), motor=(0.0, 0.0))
    take = TAKE[mode]
    used = 0
    for k in range(400):
        used += bool(take(corrector, battery(own, min(k, 50) % 15), 0.02 * k))
        take(corrector, motor(own, k % 15, 100.0 + k % 2), 0.02 * k)
        corrector.look(0.02 * k)
    assert (used, corrector.latched, corrector.latched_branches) == (51, Reason.BRANCH_STALE, ("battery",))


ANSWERS = [
    ("battery", "battery", (100.0 - 5.0) / 1.25, Quality.CORRECTED),
    ("motor", "motor", -(-100.0 - 5.0) / 1.25, Quality.CORRECTED),
    ("battery", "motor", 100.0, Quality.PASSED_THROUGH),
]


@pytest.mark.parametrize(("faulty", "name", "corrected_a", "quality"), ANSWERS)
def test_answer_is_corrected_if_parameters_apply_a_fault(
    database: VehicleDatabase, faulty: str, name: str, corrected_a: float, quality: Quality
) -> None:
    """Offsets are positive into the junction, the motor's signal is positive out of it."""
    corrector = corrector_for(database, **{faulty: (0.25, 5.0)})
    frame = battery(database, 3) if name == "battery" else motor(database, 3)
    assert published(database, corrector, frame, 0.0, name) == (corrected_a, quality)
    ((key, data),) = [(answer.key, answer.data) for answer in corrector.sources[frame.key].targets]
    assert key == FrameKey(frame.key.identifier + 0x400, False)
    assert e2e_p01_check(bytearray(data), key.identifier)


@pytest.mark.parametrize("window_s", [1.0, 60.0])
def test_watch_window_of_any_length_works_at_ten_looks_per_second(make_database: MakeDatabase, window_s: float) -> None:
    own = whole_vehicle(make_database, f"\n[watch]\nwindow_s = {window_s}\n")
    corrector = corrector_for(own, battery=(0.2, 0.0), motor=(0.0, 0.0))
    balanced(own, corrector, 0.0, 0.85 * window_s, period_s=0.1)
    assert corrector.state()[1] == Reason.NONE
    balanced(own, corrector, 0.85 * window_s, window_s + 0.5, period_s=0.1)
    assert corrector.state()[1] == Reason.CORRECTION_WORSE


@pytest.mark.parametrize(("old", "new"), [("8 Corrector", "8 Vector__XXX"), ("8 Other", "8 Corrector")])
def test_node_may_send_messages_of_one_dbc_sender_or_of_none(make_database: MakeDatabase, old: str, new: str) -> None:
    database = make_database(SMALL_LAYOUT + OWN_STATUS, OTHER_SENDER.replace(old, new))
    assert corrector_for(database).status() is not None


def test_alive_counter_of_the_status_starts_at_0_and_wraps_at_its_width(make_database: MakeDatabase) -> None:
    dbc = OTHER_SENDER.replace("8 Other", "8 Corrector") + ' SG_ Alive : 16|2@1+ (1,0) [0|3] "" Node\n'
    database = make_database(SMALL_LAYOUT + OWN_ALIVE, dbc)
    corrector = corrector_for(database)
    sent = [bytes(message.data) for _ in range(5) if (message := corrector.status()) is not None]
    found = [decoded(database, "Own", data)["Alive"] for data in sent]
    assert found == [0, 1, 2, 3, 0]


# Frames that are lost, repeated or damaged, in both modes


COUNTERS = [((0, 1, 3, 4, 7), None, "gaps 2"), ((0, 1, 1, 2), 2, "repeated 1"), ((0, 1, 9, 10), 2, "jumped 1")]


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize(("sent", "unused", "counted"), COUNTERS)
def test_frame_with_repeated_or_jumped_counter_is_not_used(
    database: VehicleDatabase, mode: Mode, sent: tuple[int, ...], unused: int | None, counted: str
) -> None:
    corrector, take = corrector_for(database, mode, battery=(0.25, 5.0)), TAKE[mode]
    found = [bool(take(corrector, battery(database, counter), 0.02 * k)) for k, counter in enumerate(sent)]
    assert found == [number != unused for number in range(len(sent))]
    stopped = "not passed on 1, " if mode is Mode.GATEWAY and unused is not None else ""
    assert corrector.counters.text().endswith(f", {stopped}{counted}")


@pytest.mark.parametrize("mode", Mode)
def test_frame_with_wrong_crc_is_counted_and_otherwise_ignored(database: VehicleDatabase, mode: Mode) -> None:
    corrector, take = corrector_for(database, mode, battery=(0.25, 5.0)), TAKE[mode]
    first, second, third = (battery(database, counter) for counter in range(3))
    frames = (first, damaged(second), second, third, Frame(BATTERY, b""))
    used = [bool(take(corrector, frame, 0.02 * k)) for k, frame in enumerate(frames)]
    assert used == [True, False, True, True, False]
    used_as = "answers 3" if mode is Mode.OVERLAY else "rewritten 3, not passed on 2"
    assert corrector.counters.text() == f"frames in 5, {used_as}, corrupt 2"
