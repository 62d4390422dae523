"""The node's core, frame by frame: what is answered, what is counted, what the status says."""

from collections.abc import Callable
from typing import Any

import pytest
from e2e.p01 import e2e_p01_check

from ecu_node.corrector import Corrector, Frame, FrameKey
from ecu_node.database import VehicleDatabase
from ecu_node.errors import DatabaseError, LayoutError
from ecu_node.status import Quality, Reason, State
from ecu_node.wiring import InForce, wire
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT, decoded, parameters_for, protected

MakeDatabase = Callable[..., VehicleDatabase]
BATTERY, MOTOR, STATUS = FrameKey(0x110, False), FrameKey(0x120, False), FrameKey(0x5F0, False)
PAIR, HEATER, NET = FrameKey(256, False), FrameKey(512, True), FrameKey(258, False)


def corrector_for(database: VehicleDatabase, **faults: tuple[float, float]) -> Corrector:
    parameters = parameters_for(database, **faults) if faults else None
    reason = Reason.NONE if faults else Reason.NO_PARAMETERS
    return wire(database, InForce(parameters=parameters, reason=reason), start_s=0.0)


def battery(database: VehicleDatabase, counter: int, current: float = 100.0) -> Frame:
    return Frame(BATTERY, protected(database, "HV_Battery", counter, BatteryCurrent=current))


def motor(database: VehicleDatabase, counter: int, current: float = 100.0) -> Frame:
    return Frame(MOTOR, protected(database, "HV_Motor", counter, MotorCurrent=current))


def status_of(database: VehicleDatabase, corrector: Corrector, now_s: float) -> dict[str, Any]:
    frame = corrector.status(now_s)
    assert frame is not None
    assert frame.key == STATUS
    assert e2e_p01_check(bytearray(frame.data), 0x5F0)
    return decoded(database, "HV_CorrectionStatus", frame.data)


def test_a_branch_frame_is_answered_by_its_corrected_frame(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0))
    (answer,) = corrector.receive(battery(database, 3), 0.0)
    values = decoded(database, "HV_BatteryCorrected", answer.data)
    assert answer.key == FrameKey(1296, False)
    assert values["BatteryCurrentCorrected"] == pytest.approx((100.0 - 5.0) / 1.25)
    assert values["BatteryCurrentQuality"] == Quality.CORRECTED
    assert e2e_p01_check(bytearray(answer.data), 1296)


def test_a_consumer_is_corrected_with_its_offset_into_the_junction(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, motor=(0.25, 5.0))
    (answer,) = corrector.receive(motor(database, 0), 0.0)
    assert decoded(database, "HV_MotorCorrected", answer.data)["MotorCurrentCorrected"] == pytest.approx(
        -(-100.0 - 5.0) / 1.25
    )


def test_corrected_frames_count_on_their_own(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.1, 0.0))
    answers = [corrector.receive(battery(database, counter % 15), 0.0)[0] for counter in range(7, 27)]
    assert [decoded(database, "HV_BatteryCorrected", answer.data)["AliveCounter"] for answer in answers] == [
        *range(15),
        *range(5),
    ]


def test_without_parameters_every_branch_is_passed_through(database: VehicleDatabase) -> None:
    corrector = corrector_for(database)
    (answer,) = corrector.receive(battery(database, 3, 123.5), 0.0)
    values = decoded(database, "HV_BatteryCorrected", answer.data)
    assert (values["BatteryCurrentCorrected"], values["BatteryCurrentQuality"]) == (123.5, Quality.PASSED_THROUGH)


def test_a_branch_that_the_parameters_do_not_name_is_passed_through(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.1, 0.0))
    (answer,) = corrector.receive(motor(database, 0), 0.0)
    values = decoded(database, "HV_MotorCorrected", answer.data)
    assert (values["MotorCurrentCorrected"], values["MotorCurrentQuality"]) == (100.0, Quality.PASSED_THROUGH)


@pytest.mark.parametrize(("current", "quality"), [(-655.36, Quality.NOT_AVAILABLE), (655.0, Quality.INVALID)])
def test_codes_that_are_no_values_come_out_as_not_available(
    database: VehicleDatabase, current: float, quality: Quality
) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0))
    (answer,) = corrector.receive(battery(database, 3, current), 0.0)
    values = decoded(database, "HV_BatteryCorrected", answer.data)
    assert (values["BatteryCurrentCorrected"], values["BatteryCurrentQuality"]) == (-655.36, quality)
    assert corrector.junction_sums_a(0.0) == (None, None)


def test_a_branch_without_a_fault_is_passed_through(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    (answer,) = corrector.receive(motor(database, 0), 0.0)
    values = decoded(database, "HV_MotorCorrected", answer.data)
    assert (values["MotorCurrentCorrected"], values["MotorCurrentQuality"]) == (100.0, Quality.PASSED_THROUGH)


def test_parameters_without_any_fault_pass_everything_through(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.0, 0.0))
    corrector.receive(battery(database, 0), 0.0)
    assert corrector.state(0.01) == (State.PASSING_THROUGH, Reason.NONE)


def test_a_result_beyond_the_signal_is_clamped_and_counted(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(-0.2, 0.0))
    frames = [battery(database, counter, current) for counter, current in enumerate((520.0, 520.02, -640.0))]
    answers = [corrector.receive(frame, 0.0)[0] for frame in frames]
    values = [decoded(database, "HV_BatteryCorrected", answer.data) for answer in answers]
    assert [value["BatteryCurrentCorrected"] for value in values] == [650.0, 650.0, -650.0]
    assert {value["BatteryCurrentQuality"] for value in values} == {Quality.CORRECTED}
    assert corrector.counters.saturated == 2
    assert corrector.counters.text().endswith(", saturated 2")


def test_nothing_is_made_of_a_corrupt_frame(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.1, 0.0))
    good = battery(database, 3)
    for bit in range(64):
        damaged = (int.from_bytes(good.data, "little") ^ 1 << bit).to_bytes(8, "little")
        assert corrector.receive(Frame(BATTERY, damaged), 0.0) == []
    assert corrector.receive(Frame(BATTERY, b""), 0.0) == []
    assert (corrector.counters.corrupt, corrector.counters.corrected) == (65, 0)
    assert len(corrector.receive(good, 0.0)) == 1


def test_a_repeated_frame_is_counted_and_not_answered_and_a_gap_is_counted(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.1, 0.0))
    answers = [len(corrector.receive(battery(database, counter), 0.0)) for counter in (1, 1, 2, 9)]
    assert answers == [1, 0, 1, 1]
    assert (corrector.counters.repeated, corrector.counters.gaps) == (1, 1)


def test_foreign_frames_and_own_output_are_not_looked_at(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.1, 0.0))
    (own,) = corrector.receive(battery(database, 0), 0.0)
    for frame in (own, Frame(FrameKey(0x110, True), own.data), Frame(FrameKey(0x7FF, False), b"x")):
        assert corrector.receive(frame, 0.0) == []
    assert corrector.counters.frames_in == 1


def test_the_status_says_starting_then_correcting(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    before = status_of(database, corrector, 0.01)
    assert (before["State"], before["Reason"], before["ParameterSet"]) == (State.STARTING, Reason.NONE, 300 % 256)
    assert before["JunctionSumMeasured"] == before["JunctionSumCorrected"] == -3276.8
    corrector.receive(battery(database, 0, 80.0), 0.02)
    corrector.receive(motor(database, 0, 60.0), 0.03)
    after = status_of(database, corrector, 0.04)
    assert (after["State"], after["Reason"]) == (State.CORRECTING, Reason.NONE)
    assert after["JunctionSumMeasured"] == pytest.approx(80.0 - 60.0)
    assert after["JunctionSumCorrected"] == pytest.approx((80.0 - 5.0) / 1.25 - 60.0)
    assert (before["AliveCounter"], after["AliveCounter"]) == (0, 1)


def test_a_silent_branch_is_stale_and_the_others_go_on(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    corrector.receive(battery(database, 0), 0.0)
    corrector.receive(motor(database, 0), 0.0)
    (answer,) = corrector.receive(battery(database, 1), 0.15)
    assert decoded(database, "HV_BatteryCorrected", answer.data)["BatteryCurrentQuality"] == Quality.CORRECTED
    status = status_of(database, corrector, 0.15)
    assert (status["State"], status["Reason"]) == (State.CORRECTING, Reason.BRANCH_STALE)
    assert status["JunctionSumCorrected"] == -3276.8
    corrector.receive(motor(database, 1), 0.16)
    assert status_of(database, corrector, 0.17)["Reason"] == Reason.NONE


def test_a_branch_of_the_parameters_that_never_appears_is_stale_after_its_timeout(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    corrector.receive(battery(database, 0), 0.05)
    assert corrector.state(0.09) == (State.STARTING, Reason.NONE)
    assert corrector.state(0.11) == (State.CORRECTING, Reason.BRANCH_STALE)


def test_the_node_does_not_say_that_it_corrects_when_every_branch_is_stale(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.1, 0.0))
    corrector.receive(battery(database, 0), 0.0)
    corrector.receive(motor(database, 0), 0.05)
    assert corrector.state(0.12) == (State.CORRECTING, Reason.BRANCH_STALE)
    assert corrector.state(0.2) == (State.PASSING_THROUGH, Reason.BRANCH_STALE)
    corrector.receive(motor(database, 1), 0.21)
    assert corrector.state(0.22) == (State.CORRECTING, Reason.BRANCH_STALE)


def test_the_node_does_not_say_that_it_corrects_when_only_branches_passed_through_are_alive(
    database: VehicleDatabase,
) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0))
    corrector.receive(motor(database, 0), 0.2)
    assert corrector.state(0.21) == (State.PASSING_THROUGH, Reason.BRANCH_STALE)


@pytest.mark.parametrize(("signal", "codes"), [("State", State), ("Reason", Reason)])
def test_the_dbc_names_the_codes_of_the_status(
    database: VehicleDatabase, signal: str, codes: type[State] | type[Reason]
) -> None:
    choices: dict[int, Any] = dict(database.signal(f"HV_CorrectionStatus.{signal}")[1].choices or {})
    names = {code: str(name).upper() for code, name in choices.items()}
    assert names == {code.value: code.name.replace("_", "") for code in codes}


def test_a_branch_that_is_neither_named_nor_seen_is_not_fitted(database: VehicleDatabase) -> None:
    corrector = corrector_for(database, battery=(0.25, 5.0))
    corrector.receive(battery(database, 0), 0.0)
    assert corrector.state(0.05) == (State.CORRECTING, Reason.NONE)
    assert corrector.junction_sums_a(0.05)[0] == pytest.approx(100.0)


def test_the_reason_for_passing_through_comes_before_a_stale_branch(database: VehicleDatabase) -> None:
    corrector = corrector_for(database)
    corrector.receive(battery(database, 0), 0.0)
    status = status_of(database, corrector, 9.0)
    assert (status["State"], status["Reason"]) == (State.PASSING_THROUGH, Reason.NO_PARAMETERS)
    assert status["ParameterSet"] == 0


def test_two_branches_share_source_and_target(make_database: MakeDatabase) -> None:
    database = make_database()
    corrector = corrector_for(database, battery=(0.5, 3.0), motor=(0.0, -2.0))
    data = database.message("Pair").encode({"Battery": 153.0, "Motor": 40.0})
    (answer,) = corrector.receive(Frame(PAIR, data), 0.0)
    assert decoded(database, "PairOut", answer.data) == {"Battery": 100.0, "Motor": 38.0, "Quality": Quality.CORRECTED}


def test_a_power_counts_in_the_sum_as_power_over_voltage(make_database: MakeDatabase) -> None:
    database = make_database()
    corrector = corrector_for(database, battery=(0.0, 0.0), motor=(0.0, 0.0), heater=(0.25, 0.0))
    corrector.receive(Frame(PAIR, database.message("Pair").encode({"Battery": 50.0, "Motor": 40.0})), 0.0)
    heater = Frame(HEATER, database.message("Heater").encode({"Power": 4000}))
    corrector.receive(heater, 0.0)
    assert corrector.junction_sums_a(0.0) == (None, None)
    corrector.receive(Frame(NET, database.message("Net").encode({"Voltage": 400.0})), 0.0)
    assert corrector.receive(heater, 0.1) == []
    assert corrector.junction_sums_a(0.1) == pytest.approx((50.0 - 40.0 - 10.0, 50.0 - 40.0 - 8.0))
    corrector.receive(heater, 0.7)
    assert corrector.branches[2].measured_a(0.7) is None, "a voltage 0.7 s old is not divided by"


def test_a_voltage_near_zero_is_not_divided_by(make_database: MakeDatabase) -> None:
    database = make_database()
    corrector = corrector_for(database, heater=(0.0, 0.0))
    corrector.receive(Frame(NET, database.message("Net").encode({"Voltage": 0.5})), 0.0)
    corrector.receive(Frame(HEATER, database.message("Heater").encode({"Power": 4000})), 0.0)
    assert corrector.junction_sums_a(0.0) == (None, None)


def test_a_frame_shorter_than_its_signal_is_invalid(make_database: MakeDatabase) -> None:
    database = make_database()
    corrector = corrector_for(database, battery=(0.1, 0.0))
    (answer,) = corrector.receive(Frame(PAIR, b"\x00\x10\x00"), 0.0)
    values = decoded(database, "PairOut", answer.data)
    assert values["Battery"] == pytest.approx(1.6 / 1.1, abs=0.05)
    assert values["Motor"] == pytest.approx(0.05 * 32768)


def test_the_answer_is_can_fd_where_the_source_is(make_database: MakeDatabase) -> None:
    corrector = corrector_for(make_database(), battery=(0.1, 0.0))
    (answer,) = corrector.receive(Frame(PAIR, bytes(8), fd=True, bitrate_switch=True), 0.0)
    assert (answer.fd, answer.bitrate_switch) == (True, True)


LOOP = ("PairOut.Motor", "Pair.Spare")
SPARE = (" SG_ Battery", ' SG_ Spare : 48|16@1- (1,0) [0|0] "A" Node\n SG_ Battery')
INPUT = '\ninput = [{ name = "x", signal = "PairOut.Spare" }]\n'
OWN_STATUS = '\n[status]\nmessage = "Own"\nstate = "State"\nreason = "Reason"\n'
OTHER_SENDER = (
    SMALL_DBC.replace("Node Corrector", "Node Corrector Other")
    + """BO_ 600 Own: 8 Other
 SG_ State : 0|8@1+ (1,0) [0|255] "" Node
 SG_ Reason : 8|8@1+ (1,0) [0|255] "" Node
"""
)
STATUS_TABLE = '\n[status]\nmessage = "PairOut"\nstate = "Quality"\nreason = "Battery"\n'


@pytest.mark.parametrize(
    ("layout", "dbc", "words"),
    [
        (SMALL_LAYOUT.replace(*LOOP), SMALL_DBC.replace(*SPARE), "Pair would be both received and sent"),
        (SMALL_LAYOUT + INPUT, SMALL_DBC.replace(*SPARE), "PairOut would be both received and sent"),
        (SMALL_LAYOUT, SMALL_DBC.replace("8 Corrector", "8 Node"), r"small\.dbc has PairOut by Node; all corrected"),
        (SMALL_LAYOUT, SMALL_DBC + "BO_TX_BU_ 512 : Corrector,Node;\n", "PairOut by Corrector, PairOut by Node; all"),
        (SMALL_LAYOUT + OWN_STATUS, OTHER_SENDER, "PairOut by Corrector, Own by Other; all corrected values and the"),
        (SMALL_LAYOUT.replace("PairOut.Motor", "PairOut.Battery"), SMALL_DBC, "PairOut.Battery is written twice"),
        (SMALL_LAYOUT, SMALL_DBC.replace("Motor : 16|16", "Motor : 15|16"), "PairOut.Motor is written twice"),
        (SMALL_LAYOUT, SMALL_DBC.replace("Quality : 32|2", "Quality : 64|2"), "Quality ends in byte 9"),
        (SMALL_LAYOUT, SMALL_DBC.replace("Quality : 32|2", "Quality : 32|1"), "Quality holds at most 1; 3 must fit"),
        (
            SMALL_LAYOUT,
            SMALL_DBC.replace('512 Motor -32768 "SNA"', '512 Motor 32767 "Max"'),
            "Motor needs a code named SNA",
        ),
        (SMALL_LAYOUT + STATUS_TABLE, SMALL_DBC, "status: PairOut.Quality is written twice"),
        (
            SMALL_LAYOUT + '\n[e2e]\nprofile = "P01"\nmessages = ["PairOut"]\n',
            SMALL_DBC,
            "PairOut.Battery is written twice, or overlaps another signal that is written, or the E2E header",
        ),
    ],
)
def test_a_layout_that_would_disturb_the_bus_is_refused(
    make_database: MakeDatabase, layout: str, dbc: str, words: str
) -> None:
    with pytest.raises((LayoutError, DatabaseError), match=words):
        corrector_for(make_database(layout, dbc))


@pytest.mark.parametrize(("old", "new"), [("8 Corrector", "8 Vector__XXX"), ("8 Other", "8 Corrector")])
def test_messages_of_one_control_unit_or_of_none_may_be_sent(make_database: MakeDatabase, old: str, new: str) -> None:
    database = make_database(SMALL_LAYOUT + OWN_STATUS, OTHER_SENDER.replace(old, new))
    assert corrector_for(database).status_fields is not None


def test_a_layout_that_publishes_nothing_is_refused(make_database: MakeDatabase) -> None:
    lines = [
        line.partition(", corrected")[0] + " }," if "corrected" in line else line for line in SMALL_LAYOUT.split("\n")
    ]
    with pytest.raises(LayoutError, match="nothing to publish"):
        corrector_for(make_database("\n".join(lines)))
