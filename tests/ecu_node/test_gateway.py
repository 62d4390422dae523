"""The gateway's core: branch frames rewritten in place, bit by bit, and nothing else."""

import pytest
from e2e.p01 import e2e_p01_protect

from ecu_node.bus.wiring import Mode
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Reason, State
from ecu_node.database import VehicleDatabase
from ecu_node.errors import DatabaseError, LayoutError
from tests.ecu_node.vehicles import (
    NET,
    SMALL_DBC,
    SMALL_LAYOUT,
    Frame,
    MakeDatabase,
    battery,
    corrector_for,
    decoded,
    frame_of,
    passed_on,
)


def gateway_for(database: VehicleDatabase, **faults: tuple[float, float]) -> Corrector:
    return corrector_for(database, Mode.GATEWAY, **faults)


def test_frames_passed_unchanged_are_not_counted_as_rewritten(database: VehicleDatabase) -> None:
    corrector = gateway_for(database, battery=(0.25, 5.0))
    for counter, current_a in enumerate((100.0, 90.0, -655.36)):
        passed_on(corrector, battery(database, counter, current_a), 0.0)
    assert (corrector.counters.frames_in, corrector.counters.rewritten, corrector.counters.answers) == (3, 2, 0)


def test_status_reason_is_foreign_frames_for_10_s_after_such_a_frame(database: VehicleDatabase) -> None:
    corrector, found = gateway_for(database, battery=(0.25, 5.0)), []
    for k in range(720):
        passed_on(corrector, battery(database, k % 15), k / 64)
        corrector.counters.foreign += k == 64
        corrector.look(k / 64)
        found.append(corrector.state()[1])
    is_told = [reason is Reason.FOREIGN_FRAMES for reason in found]
    assert [is_told[k] for k in (63, 64, 703, 704)] == [False, True, True, False]


@pytest.mark.parametrize("code", [-32768, 32501, -32501])
def test_codes_for_no_value_are_forwarded_unchanged(database: VehicleDatabase, code: int) -> None:
    corrector = gateway_for(database, battery=(0.25, 5.0))
    frame = battery(database, 3, code * 0.02)
    assert passed_on(corrector, frame, 0.0) == frame.data


def test_no_value_code_beyond_the_range_of_its_signal_is_refused(make_database: MakeDatabase) -> None:
    layout = SMALL_LAYOUT.replace('signal = "Pair.Motor"', 'signal = "Pair.Motor", no_value = [32768, -8500]')
    words = r"branch motor: no_value: Pair\.Motor has no code 32768; it has -32768 to 32767"
    with pytest.raises(LayoutError, match=words):
        gateway_for(make_database(layout))


def test_gateway_writes_a_corrected_power_as_power(make_database: MakeDatabase) -> None:
    database = make_database()
    corrector = gateway_for(database, heater=(0.25, -2.0))
    heater = frame_of(database, "Heater", Power=4000)
    assert passed_on(corrector, heater, 0.0) == heater.data, "without a voltage it is passed through"
    missing = State.PARTLY_CORRECTING, Reason.INPUT_MISSING
    corrector.look(0.0)
    assert corrector.state() == missing
    passed_on(corrector, frame_of(database, "Net", Voltage=400.0), 0.0)
    out = passed_on(corrector, heater, 0.1)
    assert out is not None
    current_a = (-4000 / 400 + 2.0) / 1.25
    assert decoded(database, "Heater", out)["Power"] == round(-current_a * 400)
    corrector.look(0.4)
    assert corrector.state() == (State.CORRECTING, Reason.NONE)
    assert passed_on(corrector, heater, 0.7) == heater.data, "the voltage is too old"
    corrector.look(0.7)
    assert corrector.state() == missing


HEADERS = [
    ("P01", 0, "battery"),
    ("P04", 0, "battery"),
    ("P06", 1, "battery"),
    ("P07", 3, "motor"),
    ("P11", 2, "motor"),
]


@pytest.mark.parametrize(("profile", "offset", "branch"), HEADERS)
def test_branch_in_e2e_header_is_refused(make_database: MakeDatabase, profile: str, offset: int, branch: str) -> None:
    layout = f'{SMALL_LAYOUT}\n[e2e]\nprofile = "{profile}"\nmessages = ["Pair"]\noffset = {offset}\n'
    with pytest.raises(LayoutError, match=rf"branch {branch}: signal Pair\.{branch.title()} overlaps the E2E header"):
        gateway_for(make_database(layout, SMALL_DBC.replace("Pair: 8", "Pair: 24")))


PAGE = ' SG_ Page M : 48|8@1+ (1,0) [0|255] "" Node\n'
FLAG = ' SG_ Flag : 8|1@1+ (1,0) [0|1] "" Node\n'
PAIR_E2E = '\n[e2e]\nprofile = "P01"\nmessages = ["Pair"]\n'


def on_page(code: int, place: str = "7|16", page: str = PAGE) -> str:
    """The DBC whose battery is multiplexed, with this code and place, and whose motor is so with code 1."""
    battery, motor = f"{page} SG_ Battery m{code} : {place}@0", " SG_ Motor m1 : 23|16@0"
    return SMALL_DBC.replace(" SG_ Battery : 7|16@0", battery).replace(" SG_ Motor : 23|16@0", motor)


OVERLAPPING = [
    (PAIR_E2E, on_page(0), "the E2E header"),
    ("", on_page(0, page=PAGE.replace("48|8", "12|4")), "Page"),
    ("", on_page(1, "15|16"), "Motor"),
    ("", SMALL_DBC.replace(" SG_ Battery", FLAG + " SG_ Battery"), "Flag"),
]


@pytest.mark.parametrize(("more", "dbc", "others"), OVERLAPPING)
def test_current_over_other_bits_of_its_frame_is_refused(
    make_database: MakeDatabase, more: str, dbc: str, others: str
) -> None:
    with pytest.raises(LayoutError, match=f"battery: signal Pair.Battery overlaps {others}, which must keep"):
        gateway_for(make_database(SMALL_LAYOUT + more, dbc))


def test_currents_of_different_multiplexer_codes_may_share_bits(make_database: MakeDatabase) -> None:
    database = make_database(dbc=on_page(0, "23|16"))
    frame = frame_of(database, "Pair", Page=0, Battery=100.0)
    out = passed_on(gateway_for(database, battery=(0.25, 0.0)), frame, 0.0)
    assert out == frame_of(database, "Pair", Page=0, Battery=80.0).data


NET_WITH_CRC = (
    f'{SMALL_LAYOUT}\n[e2e]\nprofile = "P01"\nmessages = ["Net"]\n',
    SMALL_DBC.replace("Net: 2", "Net: 4").replace("0|16@1+ (0.01", "16|16@1+ (0.01"),
)


def test_message_without_branches_is_forwarded_even_if_corrupt(make_database: MakeDatabase) -> None:
    corrector = gateway_for(make_database(*NET_WITH_CRC), heater=(0.25, -2.0))
    spoilt = Frame(NET, b"\x00\x01\x40\x9c")
    assert passed_on(corrector, spoilt, 0.0) == spoilt.data
    assert (corrector.counters.corrupt, corrector.counters.not_passed_on) == (1, 0)


def test_power_is_not_corrected_with_the_voltage_of_an_invalid_message(make_database: MakeDatabase) -> None:
    database = make_database(*NET_WITH_CRC)
    corrector, heater = gateway_for(database, heater=(0.25, -2.0)), frame_of(database, "Heater", Power=4000)

    def is_corrected(counter: int, now_s: float, *, spoilt: bool = False) -> bool:
        net = bytearray(frame_of(database, "Net", Voltage=400.0).data)
        net[1] = counter
        e2e_p01_protect(net, NET.identifier, increment_counter=False)
        net[2] ^= spoilt
        passed_on(corrector, Frame(NET, bytes(net)), now_s)
        return passed_on(corrector, heater, now_s) != heater.data

    assert [is_corrected(k, 0.1 * k) for k in range(4)] == [True] * 4
    found = [is_corrected(k, 0.1 * k, spoilt=bool(k % 2)) for k in range(4, 15)]
    assert found == [True] * 7 + [False] * 4, "from the fourth error of ten on"
    after_silence = [is_corrected(k, 9.0 + 0.1 * k) for k in range(4)]
    assert after_silence == [False, False, True, True]
    frozen = [is_corrected(3, 9.4 + 0.01 * k) for k in range(12)]
    assert frozen == [True] * 9 + [False] * 3


def test_gateway_refuses_a_named_code_within_the_range_of_a_branch(make_database: MakeDatabase) -> None:
    database = make_database(dbc=SMALL_DBC + 'VAL_ 2147484160 Power 100 "Limit";\n')
    corrector_for(database, battery=(0.1, 0.0))
    words = r"branch heater: code 100 of signal Power means 'Limit', .* beyond 99 could be .* full scale is 260000"
    with pytest.raises(DatabaseError, match=words):
        gateway_for(database, battery=(0.1, 0.0))
