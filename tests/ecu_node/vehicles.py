"""Small vehicles for the node's tests: layouts and DBCs made to measure, parameters, and frames with cantools."""

import re
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
from e2e.p01 import e2e_p01_protect

from ecu_node.bus.wiring import InForce, Mode, key_of, wire
from ecu_node.core.corrector import Corrector
from ecu_node.core.signals import FrameKey
from ecu_node.core.status import Quality, Reason
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import (
    BranchParameters,
    FileReference,
    HardwareFault,
    JunctionResidual,
    Provenance,
    VehicleParameters,
)

BATTERY, MOTOR = FrameKey(0x110, False), FrameKey(0x120, False)
"""Identifiers of messages of the project's own layout."""
PAIR, HEATER, NET = FrameKey(256, False), FrameKey(512, True), FrameKey(258, False)
"""Identifiers of messages of the small vehicle."""
LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
MakeDatabase = Callable[..., VehicleDatabase]
"""Makes a database from the texts of layout and DBC; without them, those of the small vehicle."""


class Frame(NamedTuple):
    """One data frame."""

    key: FrameKey
    data: bytes


SMALL_LAYOUT = """
schema = 1
name = "small"
dbc = "small.dbc"
full_scale_a = 400.0
branch = [
    { name = "battery", sign = 1, signal = "Pair.Battery", corrected = "PairOut.Battery", quality = "PairOut.Quality" },
    { name = "motor", sign = -1, signal = "Pair.Motor", corrected = "PairOut.Motor" },
    { name = "heater", sign = -1, power = "Heater.Power", voltage = "Net.Voltage" },
]
"""
SMALL_DBC = """VERSION ""
BU_: Node Corrector
BO_ 256 Pair: 8 Node
 SG_ Battery : 7|16@0- (0.1,0) [-3000|3000] "A" Node
 SG_ Motor : 23|16@0- (-0.05,0) [-1600|1600] "A" Node
BO_ 2147484160 Heater: 4 Node
 SG_ Power : 0|16@1+ (1,0) [0|60000] "W" Node
BO_ 258 Net: 2 Node
 SG_ Voltage : 0|16@1+ (0.01,0) [0|650] "V" Node
BO_ 512 PairOut: 8 Corrector
 SG_ Battery : 0|16@1- (0.1,0) [-3000|3000] "A" Node
 SG_ Motor : 16|16@1- (-0.05,0) [-1600|1600] "A" Node
 SG_ Quality : 32|2@1+ (1,0) [0|3] "" Node
VAL_ 256 Battery -32768 "SNA";
VAL_ 512 Battery -32768 "SNA";
VAL_ 512 Motor -32768 "SNA";
"""


def whole_vehicle(make_database: MakeDatabase, more: str, *changes: tuple[str, str]) -> VehicleDatabase:
    """The project's own layout with some lines at its end, and some patterns replaced; with its DBC."""
    text = f"{LAYOUT.read_text()}{more}".replace("hv_powertrain.dbc", "small.dbc")
    for pattern, new in changes:
        text = re.sub(pattern, new, text)
    return make_database(text, LAYOUT.with_suffix(".dbc").read_text())


def parameters_for(database: VehicleDatabase, **faults: tuple[float, float]) -> VehicleParameters:
    """Parameters with drift and offset [A] per branch."""
    layout = database.layout
    branches = {name: BranchParameters(drift=fault[0], offset_a=fault[1], apply=True) for name, fault in faults.items()}
    provenance = Provenance(
        tool="test", method="truth", created="2026-01-01T00:00:00Z", fleet="f", fleet_size=1, drives=[], duration_s=1
    )
    return VehicleParameters(
        vehicle="v1",
        number=300,
        layout=FileReference(name=layout.path.name, sha256=layout.digest),
        dbc=FileReference(name=layout.dbc_path.name, sha256=database.digest),
        verdict="corrected",
        branches=branches,
        hardware_fault=HardwareFault(suspected=False),
        junction_residual=JunctionResidual(measured_a=1.0, corrected_a=0.1),
        provenance=provenance,
    )


def as_document(parameters: VehicleParameters) -> dict[str, Any]:
    """Parameters as the JSON document they are written as."""
    return dict(msgspec.to_builtins(parameters))


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every container of a JSON document with each of its keys."""
    for key in range(len(value)) if isinstance(value, list) else list(value) if isinstance(value, dict) else ():
        yield value, key
        yield from places(value[key])


def protected(database: VehicleDatabase, message: str, counter: int, **values: float) -> bytes:
    """A frame of the project's DBC by cantools, with E2E protection; signals that are not given are 0."""
    definition = database.message(message)
    signals = {signal.name: 0 for signal in definition.signals} | values | {"AliveCounter": counter}
    data = bytearray(definition.encode(signals, scaling=True, strict=False))
    e2e_p01_protect(data, definition.frame_id, increment_counter=False)
    return bytes(data)


def frame_of(database: VehicleDatabase, message: str, **values: float) -> Frame:
    """A frame by cantools, without protection."""
    definition = database.message(message)
    return Frame(key_of(definition), definition.encode(values))


def decoded(database: VehicleDatabase, message: str, data: bytes) -> dict[str, Any]:
    """The signals of a frame by cantools; named codes as numbers."""
    return cast("dict[str, Any]", database.message(message).decode(data, decode_choices=False))


class AtOnce(Executor):
    """Runs work that is meant for the background at once, in the caller's thread."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        try:
            done.set_result(fn(*args, **kwargs))
        except UserError as error:
            done.set_exception(error)
        return done


def answers(corrector: Corrector, frame: Frame, now_s: float) -> list[Frame]:
    """What an overlay node sends when it receives a frame."""
    source = corrector.sources.get(frame.key)
    if source is None:
        return []
    return [Frame(target.key, bytes(target.data)) for target in source.answer(bytearray(frame.data), now_s)]


def passed_on(corrector: Corrector, frame: Frame, now_s: float) -> bytes | None:
    """What a gateway sends on when it receives a frame."""
    source = corrector.sources.get(frame.key)
    if source is None:
        return frame.data
    data = source.forward(bytearray(frame.data), now_s)
    return None if data is None else bytes(data)


def battery(database: VehicleDatabase, counter: int, current: float = 100.0, **more: float) -> Frame:
    """A frame of the battery of the project's own layout. [A]"""
    return Frame(BATTERY, protected(database, "HV_Battery", counter, BatteryCurrent=current, **more))


def damaged(frame: Frame) -> Frame:
    """The frame with a wrong CRC."""
    return Frame(frame.key, bytes([frame.data[0] ^ 1]) + frame.data[1:])


def motor(database: VehicleDatabase, counter: int, current: float = 100.0) -> Frame:
    """A frame of the motor of the project's own layout. [A]"""
    return Frame(MOTOR, protected(database, "HV_Motor", counter, MotorCurrent=current))


def corrector_for(
    database: VehicleDatabase, mode: Mode = Mode.OVERLAY, start_s: float = 0.0, /, **faults: tuple[float, float]
) -> Corrector:
    """The node's core with drift and offset [A] per branch in force; without any there are no parameters."""
    parameters = parameters_for(database, **faults) if faults else None
    in_force = InForce(parameters=parameters, reason=Reason.NONE if faults else Reason.NO_PARAMETERS)
    return wire(database, in_force, start_s, mode=mode)


Current = float | Callable[[int], float]
"""A current that is the same in all frames, or a function that returns that of a frame by its number. [A]"""


def drive(
    database: VehicleDatabase,
    corrector: Corrector,
    start_s: float,
    end_s: float,
    *,
    silent: Collection[str] = (),
    battery_a: Current = 80.0,
    motor_a: Current = 60.0,
    period_s: float = 0.05,
    spoil: int = 0,
    look: Callable[[Corrector, float], object] = lambda *_: None,
    **more: float,
) -> list[Quality]:
    """Send battery and motor frames of the project's own layout; after each pair the core looks, then `look` is called.

    Branches in `silent` send nothing; every `spoil`-th frame of the battery is damaged. `more` are further signals of
    the battery's message. Returns the qualities in the answers to the battery's frames.
    """
    qualities = []
    for k in range(round(start_s / period_s), round(end_s / period_s)):
        battery_now_a, motor_now_a = (item(k) if callable(item) else item for item in (battery_a, motor_a))
        if "battery" not in silent:
            frame = battery(database, k % 15, battery_now_a, **more)
            found = answers(corrector, damaged(frame) if spoil and k % spoil == 0 else frame, k * period_s)
            values = [decoded(database, "HV_BatteryCorrected", answer.data) for answer in found]
            qualities += [item["BatteryCurrentQuality"] for item in values]
        if "motor" not in silent:
            answers(corrector, motor(database, k % 15, motor_now_a), k * period_s)
        now_s = (k + 0.5) * period_s
        corrector.look(now_s)
        look(corrector, now_s)
    return qualities
