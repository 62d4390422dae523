"""A small drive with known sensor faults, and the output expected by fractions and cantools, without the node's code.

Three branches, sinusoidal currents that sum to zero; the sensors show (1 + d) i + o, quantised by the DBC. At each
instant every branch sends one frame.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from e2e.p01 import e2e_p01_check, e2e_p01_protect
from msgspec.structs import replace

from ecu_node.database import VehicleDatabase
from ecu_node.parameters import JunctionResidual, VehicleParameters
from tests.ecu_node.vehicles import parameters_for

PERIOD_S = 0.02
VEHICLE = "v0007"
STEP_A = Fraction(1, 50)
"""Scale of all currents in the DBC. [A]"""
LARGEST_CODE = 32500
"""650 A, the largest value in the DBC."""


@dataclass(frozen=True, kw_only=True)
class SmallBranch:
    """One branch: its signals in the DBC, its sign there, and the fault of its sensor."""

    message: str
    signal: str
    sign: int
    drift: str
    offset_a: str

    def measured(self, i: float) -> float:
        """What the sensor shows, in the direction of its signal. [A]"""
        return self.sign * ((1.0 + float(self.drift)) * i + float(self.offset_a))

    def corrected_code(self, code: int) -> int:
        """(25) in exact fractions, rounded half up to the DBC's step, kept in the DBC's range."""
        i = (self.sign * code * STEP_A - Fraction(self.offset_a)) / (1 + Fraction(self.drift))
        return min(max(math.floor(self.sign * i / STEP_A + Fraction(1, 2)), -LARGEST_CODE), LARGEST_CODE)


BRANCHES = {
    "battery": SmallBranch(message="HV_Battery", signal="BatteryCurrent", sign=1, drift="0.05", offset_a="3.3"),
    "motor": SmallBranch(message="HV_Motor", signal="MotorCurrent", sign=-1, drift="-0.08", offset_a="-4.0"),
    "auxiliary": SmallBranch(
        message="HV_Auxiliary", signal="AuxiliaryCurrent", sign=-1, drift="0.125", offset_a="1.5025"
    ),
}


def true_currents(t: float) -> dict[str, float]:
    """Currents into the junction at one instant [A]; their sum is 0."""
    motor = -120.0 - 100.0 * math.sin(2.0 * math.pi * 0.4 * t)
    auxiliary = -20.0 - 12.0 * math.sin(2.0 * math.pi * 0.15 * t + 1.0)
    return {"battery": -motor - auxiliary, "motor": motor, "auxiliary": auxiliary}


def true_parameters(database: VehicleDatabase) -> VehicleParameters:
    """A parameter file that states the true faults."""
    faults = {name: (float(branch.drift), float(branch.offset_a)) for name, branch in BRANCHES.items()}
    residual = JunctionResidual(measured_a=0.0, corrected_a=0.0)
    return replace(parameters_for(database, **faults), vehicle=VEHICLE, number=7, junction_residual=residual)


def protected(database: VehicleDatabase, message: str, counter: int, **codes: int) -> bytes:
    """A frame by cantools from raw codes, with counter and CRC; signals that are not given are 0."""
    definition = database.message(message)
    signals = {signal.name: 0 for signal in definition.signals} | codes | {"AliveCounter": counter % 15}
    data = bytearray(definition.encode(signals, scaling=False))
    e2e_p01_protect(data, definition.frame_id, increment_counter=False)
    return bytes(data)


def write_drive(
    path: Path, database: VehicleDatabase, instants: int, *, standing_at_s: float | None = None
) -> dict[str, list[int]]:
    """Write the drive as a candump log of can0, among frames of others; returns the measured codes per branch.

    With `standing_at_s` all instants have the currents of this one: their sum is right whenever it is looked at.
    """
    codes: dict[str, list[int]] = {name: [] for name in BRANCHES}
    lines = []
    for k in range(instants):
        t = k * PERIOD_S
        frames = list(_foreign_frames(database, k))
        for name, i in true_currents(t if standing_at_s is None else standing_at_s).items():
            branch = BRANCHES[name]
            code = round(branch.measured(i) / float(STEP_A))
            codes[name].append(code)
            data = protected(database, branch.message, k, **{branch.signal: code})
            frames.append((f"{database.message(branch.message).frame_id:03X}", data))
        lines += [f"({t + 0.001 * n:.6f}) can0 {name}#{data.hex().upper()}" for n, (name, data) in enumerate(frames)]
    path.write_text("\n".join(lines) + "\n")
    return codes


def passed_on(database: VehicleDatabase, identifier: str, data: bytes) -> bytes | None:
    """What a gateway makes of a frame of this drive: its current and its CRC another one; None if it holds it back."""
    for branch in BRANCHES.values():
        frame_id = database.message(branch.message).frame_id
        if identifier == f"{frame_id:03X}":
            if not e2e_p01_check(bytearray(data), frame_id):
                return None
            code = branch.corrected_code(int.from_bytes(data[2:4], "little", signed=True))
            rewritten = bytearray(data[:2] + code.to_bytes(2, "little", signed=True) + data[4:])
            e2e_p01_protect(rewritten, frame_id, increment_counter=False)
            return bytes(rewritten)
    return data


def _foreign_frames(database: VehicleDatabase, k: int) -> Iterator[tuple[str, bytes]]:
    """Frames that are none of the node's business, of all lengths; one is a branch's frame with a wrong CRC."""
    yield "200", protected(database, "VD_Motion", k, VehicleSpeed=k)
    yield "3AB", bytes((17 * k + n) % 256 for n in range(k % 9))
    yield "18FF1234", k.to_bytes(4, "big")
    if k % 10 == 3:
        damaged = bytearray(protected(database, "HV_Motor", k, MotorCurrent=-30000))
        damaged[4] ^= 1
        yield "120", bytes(damaged)
