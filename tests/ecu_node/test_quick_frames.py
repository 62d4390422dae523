"""The quick functions do exactly what those for frames of any kind do."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.e2e_profiles import protection_of
from ecu_node.frames import Source
from ecu_node.guard import Mode
from ecu_node.in_force import InForce
from ecu_node.layout import read_layout
from ecu_node.wiring import wire
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT, parameters_for

HEADER = ' SG_ Crc : 0|8@1+ (1,0) [0|255] "" Node\n SG_ Alive : 8|4@1+ (1,0) [0|14] "" Node\n'
PROTECTED = SMALL_LAYOUT + '\n[e2e]\nprofile = "P01"\nmessages = ["Pair", "PairOut"]\n'
LITTLE = (
    SMALL_DBC.replace(" SG_ Battery", HEADER + " SG_ Battery", 1)
    .replace("Battery : 7|16@0-", "Battery : 16|16@1-")
    .replace("Motor : 23|16@0-", "Motor : 37|13@1-")
    .replace("Battery : 0|16@1-", "Battery : 16|16@1-")
    .replace("Motor : 16|16@1-", "Motor : 33|15@1-")
    .replace("32|2", "12|2")
    .replace('512 Motor -32768 "SNA"', '512 Motor -16384 "SNA"')
)
CASES = {
    "protected": (PROTECTED, LITTLE),
    "big": (
        SMALL_LAYOUT,
        SMALL_DBC.replace("Battery : 0|16@1-", "Battery : 7|16@0-")
        .replace("Motor : 16|16@1-", "Motor : 23|16@0-")
        .replace("32|2@1", "39|2@0"),
    ),
}


@pytest.fixture(scope="module", params=list(CASES))
def vehicle(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> VehicleDatabase:
    folder: Path = tmp_path_factory.mktemp(request.param)
    layout, dbc = CASES[request.param]
    (folder / "small.toml").write_text(layout)
    (folder / "small.dbc").write_text(dbc)
    return read_database(read_layout(folder / "small.toml"))


def twins(database: VehicleDatabase, mode: Mode, **faults: tuple[float, float]) -> list[tuple[Source, Any]]:
    """The source of the pair twice: as it is, and without its quick functions."""
    found = []
    for quick in (True, False):
        corrector = wire(database, InForce(parameters=parameters_for(database, **faults)), 0.0, mode=mode)
        source = corrector.sources[(256, False)]
        if not quick:
            assert source.forward != source._forward, "there is a quick one"
            assert source.answer != source._answer or mode is Mode.GATEWAY
            source.forward, source.answer = source._forward, source._answer
        found.append((source, corrector))
    return found


FRAMES = st.lists(
    st.tuples(st.binary(min_size=8, max_size=8) | st.binary(max_size=12), st.integers(0, 5), st.booleans()),
    min_size=1,
    max_size=12,
)


def stream(database: VehicleDatabase, drawn: Sequence[tuple[bytes, int, bool]]) -> list[bytearray]:
    """Frames of which most are intact and in order."""
    protection = protection_of(database, database.message("Pair"))
    frames, counter = [], 0
    for data, damage, big in drawn:
        payload = bytearray(data)
        if not big and len(payload) == 8:  # small currents, which do not saturate
            payload[2:8] = bytes(b // 16 if k % 2 else b for k, b in enumerate(payload[2:8]))
        if protection is not None and len(payload) >= 2:
            counter += 1 if damage < 4 else damage
            payload[1] = payload[1] & 0xF0 | counter % 15
            protection.seal(payload)
            if damage == 5:
                payload[-1] ^= 1
        frames.append(payload)
    return frames


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(drawn=FRAMES, drift=st.floats(-0.3, 0.3), offset=st.floats(-100, 100))
def test_a_gateway_sends_the_same(
    vehicle: VehicleDatabase, drawn: Sequence[tuple[bytes, int, bool]], drift: float, offset: float
) -> None:
    (quick, one), (plain, other) = twins(vehicle, Mode.GATEWAY, battery=(drift, offset), motor=(0.0, -offset))
    for number, payload in enumerate(stream(vehicle, drawn)):
        before = bytes(payload)
        assert quick.forward(payload, float(number)) == plain.forward(payload, float(number))
        assert payload == before, "what came in is not changed"
    assert asdict(one.counters) == asdict(other.counters)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(drawn=FRAMES, drift=st.floats(-0.3, 0.3), offset=st.floats(-100, 100))
def test_an_overlay_node_sends_the_same(
    vehicle: VehicleDatabase, drawn: Sequence[tuple[bytes, int, bool]], drift: float, offset: float
) -> None:
    (quick, one), (plain, other) = twins(vehicle, Mode.OVERLAY, battery=(drift, offset), motor=(0.0, -offset))
    for number, payload in enumerate(stream(vehicle, drawn)):
        found = [[target.data for target in source.answer(payload, float(number))] for source in (quick, plain)]
        assert found[0] == found[1]
    assert asdict(one.counters) == asdict(other.counters)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Motor : 23|16@0-", "Motor : 16|16@1-"),
        ('VAL_ 256 Battery -32768 "SNA"', 'VAL_ 256 Battery -32768 "SNA" 7 "Odd"'),  # a name amid the values
    ],
)
def test_a_message_that_is_not_ordinary_has_no_quick_functions(
    make_database: Callable[..., VehicleDatabase], old: str, new: str
) -> None:
    database = make_database(dbc=SMALL_DBC.replace(old, new))
    source = wire(database, InForce(parameters=parameters_for(database, battery=(0.1, 0.0))), 0.0).sources[(256, False)]
    assert source.forward == source._forward
    assert source.answer == source._answer


def test_an_answer_in_two_byte_orders_is_not_ordinary(make_database: Callable[..., VehicleDatabase]) -> None:
    database = make_database(dbc=SMALL_DBC.replace("Battery : 0|16@1-", "Battery : 7|16@0-"))
    source = wire(database, InForce(parameters=parameters_for(database, battery=(0.1, 0.0))), 0.0).sources[(256, False)]
    assert source.forward != source._forward
    assert source.answer == source._answer
