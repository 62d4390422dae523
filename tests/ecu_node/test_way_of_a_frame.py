"""A frame's way through the node beside what must come of it, for layouts that take each way in the core."""

from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ecu_node.bus.wiring import Mode
from ecu_node.core.e2e import protection_of
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from tests.ecu_node.oracle import require_right
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT, parameters_for

HEADER = ' SG_ Crc : 0|8@1+ (1,0) [0|255] "" Node\n SG_ Alive : 8|4@1+ (1,0) [0|14] "" Node\n'
E2E = '\n[e2e]\nprofile = "P01"\nmessages = ["Pair", "PairOut"]\nvalid = { window = 1, min_ok = 0, max_error = 1 }\n'
PROTECTED = SMALL_LAYOUT + E2E  # each frame is judged by itself
LITTLE = (
    SMALL_DBC.replace(" SG_ Battery", HEADER + " SG_ Battery", 1)
    .replace("Battery : 7|16@0-", "Battery : 16|16@1-")
    .replace("Motor : 23|16@0-", "Motor : 37|13@1-")
    .replace("Battery : 0|16@1-", "Battery : 16|16@1-")
    .replace("Motor : 16|16@1-", "Motor : 33|15@1-")
    .replace("32|2", "12|2")
    .replace('512 Motor -32768 "SNA"', '512 Motor -16384 "SNA"')
)
BIG_OUT = SMALL_DBC.replace("Battery : 0|16@1-", "Battery : 7|16@0-").replace("Motor : 16|16@1-", "Motor : 23|16@0-")
PAGE = ' SG_ Page M : 63|8@0+ (1,0) [0|255] "" Node\n'
CASES = {
    "protected": (PROTECTED, LITTLE),
    "big": (SMALL_LAYOUT, BIG_OUT.replace("32|2@1", "39|2@0")),
    "two byte orders": (SMALL_LAYOUT, SMALL_DBC.replace("Motor : 23|16@0-", "Motor : 16|16@1-")),
    "answer in two byte orders": (SMALL_LAYOUT, SMALL_DBC.replace("Battery : 0|16@1-", "Battery : 7|16@0-")),
    "quality in the other byte order": (SMALL_LAYOUT, SMALL_DBC.replace("Quality : 32|2@1+", "Quality : 39|12@0+")),
    "a name amid the values": (SMALL_LAYOUT, SMALL_DBC.replace('256 Battery -32768 "SNA"', '256 Battery 9000 "Odd"')),
    "pages that overlap": (
        SMALL_LAYOUT,
        SMALL_DBC.replace(" SG_ Battery : 7|16@0-", PAGE + " SG_ Battery m1 : 7|16@0-").replace(
            "Motor : 23|16@0-", "Motor m2 : 5|12@0-"
        ),
    ),
}


@pytest.fixture(scope="module", params=list(CASES))
def database(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> VehicleDatabase:
    folder: Path = tmp_path_factory.mktemp("vehicle")
    layout, dbc = CASES[request.param]
    (folder / "small.toml").write_text(layout)
    (folder / "small.dbc").write_text(dbc)
    return read_database(read_layout(folder / "small.toml"))


FRAMES = st.lists(
    st.tuples(st.binary(min_size=8, max_size=8) | st.binary(max_size=12), st.integers(0, 5), st.booleans()),
    min_size=1,
    max_size=12,
)


def stream(database: VehicleDatabase, drawn: Sequence[tuple[bytes, int, bool]]) -> list[bytes]:
    """Frames of which most are intact and in order."""
    protection = protection_of(database, database.message("Pair"))
    frames, counter = [], 0
    for data, damage, big in drawn:
        payload = bytearray(data)
        if not big and len(payload) == 8:  # small currents, which do not saturate
            payload[2:7] = bytes(b // 16 if k % 2 else b for k, b in enumerate(payload[2:7]))
            payload[7] %= 4
        if protection is not None and len(payload) >= 2:
            counter += 1 if damage < 4 else damage
            payload[1] = payload[1] & 0xF0 | counter % 15
            protection.seal(payload)
            if damage == 5:
                payload[-1] ^= 1
        frames.append(bytes(payload))
    return frames


@pytest.mark.parametrize("mode", list(Mode))
@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(drawn=FRAMES, drift=st.floats(-0.3, 0.3), offset=st.floats(-100, 100))
def test_each_current_is_corrected_and_nothing_else_changed(
    database: VehicleDatabase, mode: Mode, drawn: Sequence[tuple[bytes, int, bool]], drift: float, offset: float
) -> None:
    parameters = parameters_for(database, battery=(drift, offset), motor=(0.0, -offset))
    require_right(database, parameters, mode, [(256, payload) for payload in stream(database, drawn)])
