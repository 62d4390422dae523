"""Random frames of random vehicles through the node's core, each compared with the oracle.

``HV_FRAMES=10000000 pytest -n auto tests/ecu_node/test_random_vehicles.py`` tries ten million frames.
"""

import os
from itertools import product
from pathlib import Path
from random import Random

import pytest

from bench.c_core import frames
from ecu_node.bus.wiring import Mode
from ecu_node.core.corrector import Source
from tests.ecu_node.oracle import require_right
from tests.ecu_node.random_vehicles import draw_vehicle
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT, MakeDatabase, parameters_for

EACH, ALWAYS = 1_000, 3
"""Number of frames of each vehicle; number of vehicles that are tried in every run of the tests."""
VEHICLES = [
    number if number < ALWAYS else pytest.param(number, marks=pytest.mark.long)
    for number in range(-(-int(os.environ.get("HV_FRAMES", "40000")) // EACH))
]
MOTOR_ENTRY = '    { name = "motor", sign = -1, signal = "Pair.Motor", corrected = "PairOut.Motor" },\n'


@pytest.mark.parametrize("seed", VEHICLES)
def test_frames_of_random_vehicles_match_the_oracle_in_both_modes(seed: int, tmp_path: Path) -> None:
    rng = Random(seed)
    database, parameters = draw_vehicle(rng, tmp_path)
    drawn = [(identifier, data) for identifier, data in frames(database, rng, EACH) if data is not None]
    for mode in Mode:
        require_right(database, parameters, mode, drawn)


BYTES = [
    (SMALL_LAYOUT, "-", "0", "-128", -0.2),
    (SMALL_LAYOUT, "+", "-12.8", "255", -0.2),
    (SMALL_LAYOUT, "+", "-12.8", "255", 0.2),
    (SMALL_LAYOUT.replace(MOTOR_ENTRY, ""), "-", "0", "-128", 0.2),
]
BYTE_SIGNALS = ["signed, drift -0.2", "unsigned, drift -0.2", "unsigned, drift 0.2", "signed, battery alone"]


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize(("layout", "sign", "offset", "missing", "drift"), BYTES, ids=BYTE_SIGNALS)
def test_every_8_bit_code_matches_the_oracle_whatever_the_other_bits_are(
    make_database: MakeDatabase, mode: Mode, layout: str, sign: str, offset: str, missing: str, drift: float
) -> None:
    """With one branch in the frame or two: over the whole width results are rounded, and clipped at both ends."""
    dbc = SMALL_DBC
    for old, new in (
        ("|16@0-", f"|8@0{sign}"),
        ("16@1-", f"8@1{sign}"),
        ("-32768", missing),
        ("(0.1,0) [-3000|3000]", f"(0.1,{offset}) [0|0]"),
        ("(-0.05,0) [-1600|1600]", f"(-0.05,{-float(offset) / 2}) [0|0]"),
    ):
        dbc = dbc.replace(old, new)
    database = make_database(layout, dbc)
    parameters = parameters_for(database, battery=(drift, 0.43), motor=(-drift, -0.31))
    frames_of_pair = [
        bytes([battery, rest, motor, *5 * [rest]])
        for code, rest in product(range(256), (0x5A, 0xA5))
        for battery, motor in ((code, 77), (77, code))
    ]
    require_right(database, parameters, mode, [(256, data) for data in frames_of_pair])


@pytest.mark.parametrize(("mode", "method"), [(Mode.OVERLAY, "answer"), (Mode.GATEWAY, "forward")])
def test_oracle_detects_a_wrong_bit(monkeypatch: pytest.MonkeyPatch, mode: Mode, method: str, tmp_path: Path) -> None:
    right = getattr(Source, method)

    def damaged(source: Source, payload: bytearray, now_s: float) -> object:
        made = right(source, payload, now_s)
        for item in [made] if isinstance(made, bytearray) else [target.data for target in made or ()]:
            item[0] ^= 1
        return made

    monkeypatch.setattr(Source, method, damaged)
    database, parameters = draw_vehicle(Random(0), tmp_path)
    drawn = [(identifier, data) for identifier, data in frames(database, Random(0), 500) if data is not None]
    with pytest.raises(AssertionError, match=rf"{mode.name.lower()}, frame \d+: .* -> .*#.*: "):
        require_right(database, parameters, mode, drawn)
