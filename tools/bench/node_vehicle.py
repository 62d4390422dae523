"""The vehicle of the node's benchmarks: a message with two currents of 16 bits and E2E profile P01, sent in a circle.

Beside it the node's work as most programs would do it: cantools decodes the message, cantools encodes it again.

The true currents sum to zero and the parameters are those of the sensors' faults, so that the node has no reason to
doubt its corrections, however long it runs. Nothing here needs numpy: it is loaded beside a node whose memory counts.
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
from ecu_node.parameters import BranchParameters, VehicleParameters

__all__ = ["FAULTS", "IDENTIFIER", "NUMBERS", "OUT_IDENTIFIER", "BenchVehicle", "PlainJob", "make_vehicle", "plain_job"]

IDENTIFIER, OUT_IDENTIFIER = 0x100, 0x200
"""Of the message with the currents, and of the one that answers it."""
NUMBERS = 1500
"""Frames until they come round again: a multiple of the 15 codes of the counter."""
FAULTS = {"battery": (0.02, 3.0), "motor": (-0.03, 1.0)}
"""Drift [1] and offset [A] of the sensors, positive into the junction."""

_AMPLITUDE_A = 200.0
_STEPS_A = {"battery": 0.1, "motor": -0.05}
_SIGNS = {"battery": 1, "motor": -1}

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
_NUMBER = '\n SG_ Number : 48|16@1+ (1,0) [0|65535] "" Corrector'
_DBC = """VERSION ""
BU_: Sensor Corrector
BO_ 256 Pair: 8 Sensor
 SG_ Crc : 0|8@1+ (1,0) [0|255] "" Corrector
 SG_ Counter : 8|4@1+ (1,0) [0|14] "" Corrector
 SG_ Battery : 16|16@1- (0.1,0) [-3000|3000] "A" Corrector
 SG_ Motor : 32|16@1- (-0.05,0) [-1600|1600] "A" Corrector{number}
BO_ 512 PairOut: 8 Corrector
 SG_ Crc : 0|8@1+ (1,0) [0|255] "" Sensor
 SG_ Counter : 8|4@1+ (1,0) [0|14] "" Sensor
 SG_ Battery : 16|16@1- (0.1,0) [-3000|3000] "A" Sensor
 SG_ Motor : 32|16@1- (-0.05,0) [-1600|1600] "A" Sensor
 SG_ Quality : 48|2@1+ (1,0) [0|3] "" Sensor
BO_ 513 Status: 8 Corrector
 SG_ Crc : 0|8@1+ (1,0) [0|255] "" Sensor
 SG_ Counter : 8|4@1+ (1,0) [0|14] "" Sensor
 SG_ State : 16|3@1+ (1,0) [0|7] "" Sensor
 SG_ Reason : 24|4@1+ (1,0) [0|15] "" Sensor
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
        Layout and DBC.
    parameters : VehicleParameters
        The true faults.
    frames : list of bytearray
        One round of payloads; the last is followed by the first. The last two bytes are the frame's number.
    """

    database: VehicleDatabase
    parameters: VehicleParameters
    frames: list[bytearray]

    def corrector(self, mode: Mode) -> Corrector:
        """A node's core that corrects this vehicle."""
        return wire(self.database, InForce(parameters=self.parameters), 0.0, mode=mode)

    def corrected(self, mode: Mode) -> list[bytes]:
        """What the node makes of one round of frames."""
        source = self.corrector(mode).sources[IDENTIFIER, False]
        if mode is Mode.OVERLAY:
            return [bytes(target.data) for frame in self.frames for target in source.answer(frame, 0.0)]
        found = [source.forward(frame, 0.0) for frame in self.frames]
        return [bytes(payload) for payload in found if payload is not None]


def make_vehicle(folder: Path, *, numbered: bool) -> BenchVehicle:
    """Write layout and DBC, and make the frames.

    Parameters
    ----------
    folder : Path
        Where ``bench.toml`` and ``bench.dbc`` are written.
    numbered : bool
        Whether the DBC has a signal for the frame's number; without it the frames have none.

    Returns
    -------
    BenchVehicle
        The vehicle.
    """
    (folder / "bench.dbc").write_text(_DBC.format(number=_NUMBER if numbered else ""))
    (folder / "bench.toml").write_text(_LAYOUT)
    database = read_database(read_layout(folder / "bench.toml"))
    protection = protection_of(database, database.message("Pair"))
    assert protection is not None
    frames = []
    for number in range(NUMBERS):
        codes = _codes(_AMPLITUDE_A * math.sin(2.0 * math.pi * number / NUMBERS))
        payload = bytearray((0, number % protection.modulus))
        payload += b"".join(code.to_bytes(2, "little", signed=True) for code in codes)
        payload += (number if numbered else 0).to_bytes(2, "little")
        protection.seal(payload)
        frames.append(payload)
    faults = {
        name: BranchParameters(drift=drift, offset_a=offset, apply=True) for name, (drift, offset) in FAULTS.items()
    }
    return BenchVehicle(database=database, parameters=true_parameters(database, faults), frames=frames)


def _codes(current_a: float) -> list[int]:
    """What the sensors send while this current flows from the battery into the motor."""
    return [
        round(sign * ((1.0 + FAULTS[name][0]) * sign * current_a + FAULTS[name][1]) / _STEPS_A[name])
        for name, sign in _SIGNS.items()
    ]


PlainJob = Callable[[bytearray], bytearray | None]
"""Takes the payload of a frame and makes the one to send; None if the frame is not used."""

_USABLE = frozenset({Check.OK, Check.LOST})


def plain_job(vehicle: BenchVehicle, mode: Mode) -> PlainJob:
    """The work of one mode, with the node's own end-to-end protection.

    Parameters
    ----------
    vehicle : BenchVehicle
        Whose currents are corrected.
    mode : Mode
        In a gateway the message is rewritten; else another one is filled.

    Returns
    -------
    callable
        The work of one frame.
    """
    (battery, battery_a), (motor, motor_a) = FAULTS.values()
    database = vehicle.database
    message, answer = database.message("Pair"), database.message("PairOut")
    check = Receiver(_protection(vehicle, "Pair")).check
    seal, advance = _protection(vehicle, "Pair").seal, _protection(vehicle, "PairOut").advance

    def corrected(payload: bytearray) -> dict[str, Any]:
        values: dict[str, Any] = message.decode(payload)  # type: ignore[arg-type, assignment]
        values["Battery"] = (values["Battery"] - battery_a) / (1.0 + battery)
        values["Motor"] = -(-values["Motor"] - motor_a) / (1.0 + motor)
        return values

    def rewrite(payload: bytearray) -> bytearray | None:
        if check(payload) not in _USABLE:
            return None
        out = bytearray(message.encode(corrected(payload)))
        seal(out)
        return out

    counter = -1

    def fill(payload: bytearray) -> bytearray | None:
        nonlocal counter
        if check(payload) not in _USABLE:
            return None
        values = corrected(payload)
        out = bytearray(
            answer.encode(
                {
                    "Crc": 0,
                    "Counter": counter % 15,
                    "Battery": values["Battery"],
                    "Motor": values["Motor"],
                    "Quality": int(Quality.CORRECTED),
                }
            )
        )
        advance(out)
        counter += 1
        return out

    return rewrite if mode is Mode.GATEWAY else fill


def _protection(vehicle: BenchVehicle, name: str) -> Protection:
    found = protection_of(vehicle.database, vehicle.database.message(name))
    assert found is not None
    return found
