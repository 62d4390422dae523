"""A small drive with known sensor faults among frames of others, and what a node makes of it.

Three branches, sinusoidal currents that sum to zero; the sensors show (1 + d) i + o, quantised by the DBC. At each
instant every branch sends one frame. What is expected of the node is what its core makes of the frames:
tests/ecu_node/test_random_vehicles.py compares that with fractions and cantools.
"""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.core.signals import FrameKey
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import JunctionResidual, VehicleParameters
from tests.ecu_node.vehicles import Frame, answers, parameters_for, passed_on, protected
from tests.vcan.processes import LoggedFrame, frames_of

PERIOD_S = 0.02
VEHICLE = "v0007"


class SmallBranch(NamedTuple):
    """One branch: its message, its sign there, and the fault of its sensor."""

    message: str
    sign: int
    drift: float
    offset_a: float

    def frame(self, database: VehicleDatabase, k: int, i: float) -> LoggedFrame:
        """Frame k of the sensor while the true current `i` flows into the junction. [A]"""
        shown_a = self.sign * ((1.0 + self.drift) * i + self.offset_a)
        signal = f"{self.message.removeprefix('HV_')}Current"
        data = protected(database, self.message, k % 15, **{signal: shown_a})
        return LoggedFrame(f"{database.message(self.message).frame_id:03X}", data.hex().upper())


BRANCHES = {
    "battery": SmallBranch("HV_Battery", 1, 0.05, 3.3),
    "motor": SmallBranch("HV_Motor", -1, -0.08, -4.0),
    "auxiliary": SmallBranch("HV_Auxiliary", -1, 0.125, 1.5025),
}


def true_currents(t: float) -> dict[str, float]:
    """Currents into the junction at one instant [A]; their sum is 0."""
    motor = -120.0 - 100.0 * math.sin(2.0 * math.pi * 0.4 * t)
    auxiliary = -20.0 - 12.0 * math.sin(2.0 * math.pi * 0.15 * t + 1.0)
    return {"battery": -motor - auxiliary, "motor": motor, "auxiliary": auxiliary}


def frames_at(database: VehicleDatabase, k: int) -> list[LoggedFrame]:
    """Frame k of each branch."""
    return [BRANCHES[name].frame(database, k, i) for name, i in true_currents(k * PERIOD_S).items()]


def true_parameters(database: VehicleDatabase) -> VehicleParameters:
    """A parameter file that states the true faults."""
    faults = {name: (branch.drift, branch.offset_a) for name, branch in BRANCHES.items()}
    residual = JunctionResidual(measured_a=0.0, corrected_a=0.0)
    return replace(parameters_for(database, **faults), vehicle=VEHICLE, number=7, junction_residual=residual)


def write_drive(path: Path, database: VehicleDatabase, instants: int) -> list[LoggedFrame]:
    """Write the drive as a candump log of can0, among frames of others; returns all frames."""
    lines = []
    for k in range(instants):
        t = k * PERIOD_S
        frames = [*_foreign_frames(database, k), *frames_at(database, k)]
        lines += [f"({t + 0.001 * n:.6f}) can0 {'#'.join(frame)}" for n, frame in enumerate(frames)]
    path.write_text("\n".join(lines) + "\n")
    return frames_of(path)


def sent_by_core(database: VehicleDatabase, mode: Mode, frames: Iterable[LoggedFrame]) -> list[LoggedFrame]:
    """What a node with the true parameters sends for some frames."""
    corrector = wire(database, InForce(parameters=true_parameters(database)), 0.0, mode=mode)
    sent = []
    for number, (identifier, data) in enumerate(frames):
        frame, now_s = Frame(FrameKey(int(identifier, 16), len(identifier) == 8), bytes.fromhex(data)), 1e-3 * number
        if mode is Mode.OVERLAY:
            sent += [(f"{answer.key.identifier:03X}", answer.data) for answer in answers(corrector, frame, now_s)]
        elif (passed := passed_on(corrector, frame, now_s)) is not None:
            sent.append((identifier, passed))
    return [LoggedFrame(identifier, data.hex().upper()) for identifier, data in sent]


def _foreign_frames(database: VehicleDatabase, k: int) -> Iterator[LoggedFrame]:
    """Frames that are none of the node's business, of all lengths; one is a branch's frame with a wrong CRC."""
    yield LoggedFrame("200", protected(database, "VD_Motion", k % 15, VehicleSpeed=k % 50).hex().upper())
    yield LoggedFrame("3AB", bytes((17 * k + n) % 256 for n in range(k % 9)).hex().upper())
    yield LoggedFrame("18FF1234", k.to_bytes(4, "big").hex().upper())
    if k % 10 == 3:
        damaged = bytearray(protected(database, "HV_Motor", k % 15, MotorCurrent=-600.0))
        damaged[4] ^= 1
        yield LoggedFrame("120", damaged.hex().upper())
