"""A frame's way through the node beside the same written plainly: one signal after the other, by the plan's formula."""

from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ecu_node.bus.wiring import InForce, Mode, branch_plan, wire
from ecu_node.core.correction import AS_IT_IS
from ecu_node.core.e2e import Check, Receiver, protection_of
from ecu_node.core.signals import AMPERE, placed_signal, read_codes
from ecu_node.core.status import Quality
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout, split_signal
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


def stream(database: VehicleDatabase, drawn: Sequence[tuple[bytes, int, bool]]) -> list[bytearray]:
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
        frames.append(payload)
    return frames


class Plain:
    """What comes of the frames of the message Pair."""

    def __init__(self, database: VehicleDatabase, in_force: InForce, mode: Mode) -> None:
        message = database.message("Pair")
        protection = protection_of(database, message)
        self.receiver = Receiver(protection) if protection is not None else None
        self.seal = protection.seal if protection is not None else None
        self.branches = []
        for branch in database.layout.branch[:2]:
            signal = database.signal(branch.source)[1]
            fault = in_force.fault(branch.name)
            corrects = fault.applied
            is_in_place = mode is Mode.GATEWAY or branch.corrected is None
            plan = AS_IT_IS if is_in_place and not corrects else branch_plan(database, branch, fault, mode)
            codes = read_codes(signal, AMPERE, branch.name)
            self.branches.append((branch, placed_signal(message, signal), codes, plan))

    def is_usable(self, payload: bytearray) -> bool:
        return self.receiver is None or self.receiver.check(payload) in {Check.OK, Check.LOST}

    def results(self, payload: bytearray) -> dict[str, tuple[int, int | None]]:
        """Measured and corrected code per branch in the frame; a code that is no value has none."""
        found = {}
        for branch, signal, codes, plan in self.branches:
            code = signal.code(payload) if len(payload) >= signal.end else None
            if code is not None:
                found[branch.name] = code, plan.apply(code) if codes.is_value(code) else None
        return found

    def forwarded(self, payload: bytearray) -> bytearray | None:
        if not self.is_usable(payload):
            return None
        made = bytearray(payload)
        results = self.results(payload)
        for branch, signal, _, _ in self.branches:
            if branch.name in results and results[branch.name][1] is not None:
                signal.place.put(made, results[branch.name][1] or 0)
        if made != payload and self.seal is not None:
            self.seal(made)
        return made


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(drawn=FRAMES, drift=st.floats(-0.3, 0.3), offset=st.floats(-100, 100))
def test_gateway_changes_nothing_else(
    database: VehicleDatabase, drawn: Sequence[tuple[bytes, int, bool]], drift: float, offset: float
) -> None:
    in_force = InForce(parameters=parameters_for(database, battery=(drift, offset), motor=(0.0, -offset)))
    source = wire(database, in_force, 0.0, mode=Mode.GATEWAY).sources[256, False]
    plain = Plain(database, in_force, Mode.GATEWAY)
    for number, payload in enumerate(stream(database, drawn)):
        before = bytes(payload)
        assert source.forward(payload, 0.01 * number) == plain.forwarded(payload)
        assert payload == before, "what came in is not changed"


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(drawn=FRAMES, drift=st.floats(-0.3, 0.3), offset=st.floats(-100, 100))
def test_overlay_answers_with_every_current(
    database: VehicleDatabase, drawn: Sequence[tuple[bytes, int, bool]], drift: float, offset: float
) -> None:
    in_force = InForce(parameters=parameters_for(database, battery=(drift, offset), motor=(0.01, -offset)))
    source = wire(database, in_force, 0.0).sources[256, False]
    plain = Plain(database, in_force, Mode.OVERLAY)
    protection = protection_of(database, database.message("PairOut"))
    last: dict[str, int | None] = {}
    answers = 0
    for number, payload in enumerate(stream(database, drawn)):
        found = source.answer(payload, 0.01 * number)
        if not plain.is_usable(payload):
            assert not found
            continue
        results = plain.results(payload)
        (target,) = found
        if protection is not None:
            assert protection.is_sound(target.data)
            assert target.data[1] & 0xF == answers % 15
        answers += 1
        signals = database.message("PairOut").decode_simple(bytes(target.data), scaling=False, decode_choices=False)
        for branch, signal, _, _ in plain.branches:
            if branch.name in results:
                last[branch.name] = results[branch.name][1]
            elif len(payload) < signal.end:
                last[branch.name] = None
            assert branch.corrected is not None
            target_signal = database.signal(branch.corrected)[1]
            value = last.get(branch.name)
            missing = next(int(code) for code, name in (target_signal.choices or {}).items() if name == "SNA")
            assert signals[split_signal(branch.corrected)[1]] == (missing if value is None else value)
            if branch.name == "battery":
                assert (signals["Quality"] == Quality.CORRECTED) == (value is not None and bool(drift or offset))
