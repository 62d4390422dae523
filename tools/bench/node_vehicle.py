"""The vehicle of the node's benchmarks: a message with two currents of 16 bits and E2E profile P01, sent in a cycle.

Also here is the node's work as most programs would do it: cantools decodes the message and encodes it again.

The true currents sum to zero and the parameters are those of the sensors' faults, so that the node has no reason to
doubt its corrections, however long it runs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.true_parameters import true_parameters
from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.core.corrector import Corrector
from ecu_node.core.e2e import Check, Protection, Receiver, protection_of
from ecu_node.core.status import Quality
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, VehicleParameters, write_parameters

__all__ = ["IDENTIFIER", "BenchVehicle", "make_vehicle", "plain_job"]

IDENTIFIER = 0x100
"""Identifier of the message with the currents."""
NUMBERS = 1500
"""Number of different frames, after which they repeat: a multiple of the 15 codes of the counter."""
FAULTS = {"battery": (0.02, 3.0), "motor": (-0.03, 1.0)}
"""Drift [1] and offset [A] of the sensors, positive into the junction."""
_AMPLITUDE_A = 200.0
_A_PER_CODE = {"battery": 0.1, "motor": 0.05}
"""Current of one code of each signal, positive into the junction. [A]"""

_LAYOUT = """schema = 1
name = "bench"
dbc = "bench.dbc"
full_scale_a = 400.0
branch = [
    { name = "battery", sign = 1, signal = "Pair.Battery", corrected = "PairOut.Battery", quality = "PairOut.Quality" },
    { name = "motor", sign = -1, signal = "Pair.Motor", corrected = "PairOut.Motor" },
]
status = { message = "Status", state = "State", reason = "Reason" }
e2e = { profile = "P01", messages = ["Pair", "PairOut", "Status"] }
"""
_HEADER = """ SG_ Crc : 0|8@1+ (1,0) [0|255] "" X
 SG_ Counter : 8|4@1+ (1,0) [0|14] "" X
"""
_CURRENTS = """ SG_ Battery : 16|16@1- (0.1,0) [-3000|3000] "A" X
 SG_ Motor : 32|16@1- (-0.05,0) [-1600|1600] "A" X
"""
_DBC = f"""VERSION ""
BU_: Sensor Corrector X
BO_ 256 Pair: 8 Sensor
{_HEADER}{_CURRENTS} SG_ Number : 48|16@1+ (1,0) [0|65535] "" X
BO_ 512 PairOut: 8 Corrector
{_HEADER}{_CURRENTS} SG_ Quality : 48|2@1+ (1,0) [0|3] "" X
BO_ 513 Status: 8 Corrector
{_HEADER} SG_ State : 16|3@1+ (1,0) [0|7] "" X
 SG_ Reason : 24|8@1+ (1,0) [0|255] "" X
VAL_ 256 Battery -32768 "SNA";
VAL_ 512 Battery -32768 "SNA";
VAL_ 512 Motor -32768 "SNA";
"""


@dataclass(frozen=True, kw_only=True)
class BenchVehicle:
    """Layout, DBC and parameters, and the frames of the sensors.

    Attributes
    ----------
    database : VehicleDatabase
        Layout and DBC; the parameters stand beside the layout, in ``params.json``.
    parameters : VehicleParameters
        The true faults.
    frames : list of bytearray
        One round of payloads; the last is followed by the first. The last two bytes are the frame's number.
    """

    database: VehicleDatabase
    parameters: VehicleParameters
    frames: list[bytearray]

    def corrector(self, mode: Mode) -> Corrector:
        """Return a node's core that corrects this vehicle."""
        return wire(self.database, InForce(parameters=self.parameters), 0.0, mode=mode)

    def corrected(self, mode: Mode) -> list[bytes]:
        """Return the payloads that the node makes of one round of frames."""
        source = self.corrector(mode).sources[IDENTIFIER, False]
        if mode is Mode.OVERLAY:
            return [bytes(target.data) for frame in self.frames for target in source.answer(frame, 0.0)]
        found = [source.forward(frame, 0.0) for frame in self.frames]
        return [bytes(payload) for payload in found if payload is not None]

    def command(self, *options: str) -> list[str]:
        """Return the arguments with which ``ecu-node`` runs for this vehicle."""
        layout = self.database.layout.path
        return ["run", "--unsigned", "--params", f"{layout.parent}/params.json", "--layout", str(layout), *options]

    def protection(self, name: str) -> Protection:
        """Return the end-to-end protection of a message."""
        found = protection_of(self.database, self.database.message(name))
        assert found is not None
        return found


def make_vehicle(folder: Path) -> BenchVehicle:
    """Write layout, DBC and parameters into a folder, and make the frames."""
    (folder / "bench.dbc").write_text(_DBC)
    (folder / "bench.toml").write_text(_LAYOUT)
    database = read_database(read_layout(folder / "bench.toml"))
    faults = {name: BranchParameters(drift=d, offset_a=o_a, apply=True) for name, (d, o_a) in FAULTS.items()}
    parameters = true_parameters(database, faults)
    write_parameters(parameters, folder / "params.json")
    vehicle = BenchVehicle(database=database, parameters=parameters, frames=[])
    protection = vehicle.protection("Pair")
    for number in range(NUMBERS):  # this current flows from the battery into the motor
        battery_a = _AMPLITUDE_A * math.sin(2.0 * math.pi * number / NUMBERS)
        payload = bytearray((0, number % protection.modulus))
        for (name, (drift, offset_a)), current_a in zip(FAULTS.items(), (battery_a, -battery_a), strict=True):
            code = round(((1.0 + drift) * current_a + offset_a) / _A_PER_CODE[name])
            payload += code.to_bytes(2, "little", signed=True)
        payload += number.to_bytes(2, "little")
        protection.seal(payload)
        vehicle.frames.append(payload)
    return vehicle


def plain_job(vehicle: BenchVehicle, mode: Mode) -> Callable[[bytearray], bytearray | None]:
    """Return a function that does the node's work with cantools, and with the node's own end-to-end protection.

    Parameters
    ----------
    vehicle : BenchVehicle
        Vehicle whose currents are corrected.
    mode : Mode
        Mode of the node: a gateway rewrites the message, an overlay fills another one.

    Returns
    -------
    callable
        Takes the payload of a frame and makes the one to send; None if the frame is not used.
    """
    (battery, battery_a), (motor, motor_a) = FAULTS.values()
    message, answer = vehicle.database.message("Pair"), vehicle.database.message("PairOut")
    check, count = Receiver(vehicle.protection("Pair")).check, -1
    seal, advance = vehicle.protection("Pair").seal, vehicle.protection("PairOut").advance

    def job(payload: bytearray) -> bytearray | None:
        nonlocal count
        if check(payload) not in {Check.OK, Check.LOST}:
            return None
        values: dict[str, Any] = message.decode(payload)  # type: ignore[arg-type, assignment]
        values["Battery"] = (values["Battery"] - battery_a) / (1.0 + battery)
        values["Motor"] = -(-values["Motor"] - motor_a) / (1.0 + motor)
        if mode is Mode.GATEWAY:
            out = bytearray(message.encode(values))
            seal(out)
            return out
        values |= {"Crc": 0, "Counter": count % 15, "Quality": int(Quality.CORRECTED)}
        del values["Number"]
        out = bytearray(answer.encode(values))
        advance(out)
        count += 1
        return out

    return job
