"""The exported C rewrites frames as the node does as a gateway, bit by bit."""

from pathlib import Path
from random import Random

from bench.c99_driver import CompiledExport
from bench.node_fuzz_vehicles import FuzzVehicle, draw_vehicle
from calibrator.errors import ExportError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from tests.calibrator.export.exports import (
    MakeDatabase,
    assert_same,
    by_the_node,
    compiled,
    gateway,
    held_back,
    needs_compiler,
    parameters_for,
    unprotected,
)
from tests.ecu_node.vehicles import SMALL_DBC, decoded, protected

pytestmark = needs_compiler

FAULTS = {"battery": (0.05, 2.3), "motor": (-0.031, -1.234567890123), "auxiliary": (0.0, 0.5), "dcdc": (0.11, 0.0)}
MESSAGES = ("HV_Battery", "HV_Motor", "HV_Auxiliary", "HV_Dcdc", "HV_MotorRear")


def demo_parameters(database: VehicleDatabase) -> VehicleParameters:
    return held_back(parameters_for(database, **FAULTS), "motor_rear")


def random_frames(rng: Random, names: tuple[str, ...], count: int, size: int = 8) -> list[tuple[str, bytes]]:
    return [(rng.choice(names), rng.randbytes(size)) for _ in range(count)]


def test_a_million_random_frames_of_the_demo_are_the_same(tmp_path: Path) -> None:
    database = unprotected(tmp_path)
    frames = random_frames(Random(1), MESSAGES, 1_000_000)
    changed = assert_same(compiled(database, demo_parameters(database), tmp_path), frames)
    assert 700_000 < changed < 900_000, "four of five messages carry a corrected current"


def test_all_codes_of_all_branches_of_the_demo_are_the_same(tmp_path: Path) -> None:
    database = unprotected(tmp_path)
    frames = [
        (name, b"\xa5\x5a" + code.to_bytes(2, "little") + b"\x12\x34\x56\x78")
        for name in MESSAGES
        for code in range(1 << 16)
    ]
    assert assert_same(compiled(database, demo_parameters(database), tmp_path), frames) > 200_000


def test_frames_of_any_length_are_the_same(tmp_path: Path) -> None:
    database, rng = unprotected(tmp_path), Random(2)
    frames = [(rng.choice(MESSAGES), rng.randbytes(rng.randint(0, 12))) for _ in range(5_000)]
    assert_same(compiled(database, demo_parameters(database), tmp_path), frames)


def test_of_protected_frames_only_the_crc_is_left_to_the_control_unit(
    tmp_path: Path, database: VehicleDatabase
) -> None:
    parameters = demo_parameters(database)
    frames = [
        ("HV_Battery", protected(database, "HV_Battery", k % 15, BatteryCurrent=3.0 * k - 400.0, BatteryVoltage=355.5))
        for k in range(300)
    ]
    wanted = by_the_node(database, gateway(database, parameters), frames)
    found = compiled(database, parameters, tmp_path).frames(frames)
    assert [payload[1:] for payload, _ in found] == [payload[1:] for payload in wanted]
    for (_, given), (payload, changed), want in zip(frames, found, wanted, strict=True):
        assert payload[0] == given[0], "the CRC is not touched"
        counter = decoded(database, "HV_Battery", payload)["AliveCounter"]
        anew = protected(database, "HV_Battery", counter, **_values(database, payload))
        assert (anew if changed else payload) == want


def _values(database: VehicleDatabase, payload: bytes) -> dict[str, float]:
    found = decoded(database, "HV_Battery", payload)
    return {name: value for name, value in found.items() if name not in {"Crc", "AliveCounter"}}


def test_a_power_is_corrected_with_its_voltage(make_database: MakeDatabase, tmp_path: Path) -> None:
    database, rng = make_database(), Random(4)
    parameters = parameters_for(database, battery=(0.05, 2.3), motor=(-0.031, 1.0), heater=(0.04, -2.0))
    frames = [
        rng.choice(
            [("Heater", rng.randbytes(4)), ("Net", rng.randbytes(2)), ("Net", b"\x40"), ("Pair", rng.randbytes(8))]
        )
        for _ in range(30_000)
    ]
    assert assert_same(compiled(database, parameters, tmp_path), frames) > 5_000


MULTIPLEXED = SMALL_DBC.replace(
    ' SG_ Battery : 7|16@0- (0.1,0) [-3000|3000] "A" Node\n SG_ Motor : 23|16@0- (-0.05,0) [-1600|1600] "A" Node\n',
    ' SG_ Which M : 28|12@1+ (1,0) [0|255] "" Node\n'
    ' SG_ Battery m1 : 15|16@0- (0.1,0) [-3000|3000] "A" Node\n'
    ' SG_ Motor m2 : 15|16@0- (-0.05,0) [-1600|1600] "A" Node\n',
)


def test_a_multiplexed_branch_is_rewritten_where_it_is(make_database: MakeDatabase, tmp_path: Path) -> None:
    database, rng = make_database(dbc=MULTIPLEXED), Random(5)
    parameters = parameters_for(database, battery=(0.3, 3.0), motor=(0.25, 0.0))
    frames = []
    for _ in range(5_000):
        which = rng.choice((1, 2, 3, 0x101)) << 4
        frames.append(("Pair", rng.randbytes(3) + which.to_bytes(2, "little") + rng.randbytes(3)))
    assert 2_000 < assert_same(compiled(database, parameters, tmp_path), frames) < 3_000


WIDE = SMALL_DBC.replace("7|16@0- (0.1,0) [-3000|3000]", "7|32@0- (0.001,0) [0|0]").replace(
    "23|16@0- (-0.05,0) [-1600|1600]", "32|32@1- (0.001,-3) [0|0]"
)


def test_currents_of_32_bits_are_exact(make_database: MakeDatabase, tmp_path: Path) -> None:
    database, rng = (
        make_database(dbc=WIDE.replace("VAL_ 256 Battery -32768", "VAL_ 256 Battery -2147483648")),
        Random(6),
    )
    parameters = parameters_for(database, battery=(0.0517, -2.3456789), motor=(-0.0312, 1.0))
    frames = [("Pair", rng.randbytes(8)) for _ in range(100_000)]
    frames += [
        ("Pair", (code & 0xFFFFFFFF).to_bytes(4, "big") + (code & 0xFFFFFFFF).to_bytes(4, "little"))
        for code in (*range(-5_000, 5_000), -(1 << 31), (1 << 31) - 1)
    ]
    assert assert_same(compiled(database, parameters, tmp_path), frames) > 100_000


def test_currents_of_48_bits_are_exact(make_database: MakeDatabase, tmp_path: Path) -> None:
    dbc = SMALL_DBC.replace("7|16@0- (0.1,0) [-3000|3000]", "7|48@0- (0.00001,0) [0|0]").replace("23|16@0-", "55|16@0-")
    database, rng = make_database(dbc=dbc.replace("VAL_ 256 Battery -32768", f"VAL_ 256 Battery {-1 << 47}")), Random(7)
    frames = [("Pair", rng.randbytes(8)) for _ in range(50_000)]
    export = compiled(database, parameters_for(database, battery=(0.0517, -2.3456789), motor=(0.0, 0.0)), tmp_path)
    assert assert_same(export, frames) > 45_000


def drawn(seed: int) -> FuzzVehicle:
    """A random vehicle without protection: signals of 1 to 64 bits anywhere, multiplexed, named, with any fault."""
    vehicle = draw_vehicle(Random(seed))
    for message in (*vehicle.sources, *vehicle.targets):
        message.protection = None
    return vehicle


def drawn_export(seed: int, folder: Path) -> CompiledExport | None:
    """The export of a random vehicle; None if C has no room for one of its signals."""
    try:
        return compiled(*drawn(seed).load(folder), folder)
    except ExportError:
        return None


def test_random_vehicles_are_the_same(tmp_path: Path) -> None:
    compared = 0
    for seed in range(40):
        folder, rng = tmp_path / str(seed), Random(seed)
        folder.mkdir()
        export = drawn_export(seed, folder)
        if export is not None:
            frames = [(item.name, rng.randbytes(item.length)) for item in rng.choices(export.messages, k=3_000)]
            assert_same(export, frames)
            compared += 1
    assert compared > 25
