"""A junction of three branches in simulated time: true currents in, frames of sensors with faults to a node."""

import struct
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import numpy as np

from ecu_node.bus.wiring import InForce, wire
from ecu_node.core.signals import FrameKey
from ecu_node.core.status import Quality, Reason, State
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from tests.ecu_node.vehicles import parameters_for

NAMES = ("battery", "motor", "heater")
LAYOUT = """
schema = 1
name = "three"
dbc = "three.dbc"
full_scale_a = 400.0
branch = [
    { name = "battery", sign = 1, signal = "B.I", corrected = "BC.I", quality = "BC.Q" },
    { name = "motor", sign = -1, signal = "M.I", corrected = "MC.I", quality = "MC.Q" },
    { name = "heater", sign = -1, signal = "H.I", corrected = "HC.I", quality = "HC.Q" },
]
[status]
message = "S"
state = "State"
reason = "Reason"
"""
_STATUS = """BO_ 48 S: 2 C
 SG_ State : 0|4@1+ (1,0) [0|15] "" X
 SG_ Reason : 8|8@1+ (1,0) [0|255] "" X
"""
_CURRENT = ' SG_ I : 0|16@1- (0.1,0) [-3000|3000] "A" X\n'
KEYS = {name: FrameKey(16 + number, False) for number, name in enumerate(NAMES)}
PHASE_S = {"battery": 0.0, "motor": 0.003, "heater": 0.007}
"""Time from the begin of a period to the frame of each branch: control units send one after the other. [s]"""
BREAK_S = 15.0
"""Time from the start at which sensors break in :meth:`Junction.break_sensors`. [s]"""


def three_branches(folder: Path, quality_bits: int = 3) -> VehicleDatabase:
    """Layout and DBC of the junction."""
    measured = (f"BO_ {16 + number} {letter}: 2 N\n{_CURRENT}" for number, letter in enumerate("BMH"))
    quality = f' SG_ Q : 16|{quality_bits}@1+ (1,0) [0|7] "" X\n'
    corrected = (f"BO_ {32 + number} {letter}C: 3 C\n{_CURRENT}{quality}" for number, letter in enumerate("BMH"))
    values = (f'VAL_ {32 + number} I -32768 "SNA";\n' for number in range(3))
    dbc = "".join(['VERSION ""\nBU_: N C X\n', *measured, *corrected, _STATUS, *values])
    (folder / "three.dbc").write_text(dbc)
    (folder / "three.toml").write_text(LAYOUT)
    return read_database(read_layout(folder / "three.toml"))


class Junction:
    """A node at its junction.

    Parameters
    ----------
    database : VehicleDatabase
        From :func:`three_branches`.
    sd_a, sd_per_a : float or None
        What the parameter file says of the corrected sum. [A, 1]
    noise_a : float
        Standard deviation of each sensor. [A]
    """

    def __init__(
        self,
        database: VehicleDatabase,
        *,
        sd_a: float | None = 1.0,
        sd_per_a: float | None = 0.01,
        noise_a: float = 0.3,
        period_s: float = 0.01,
        seed: int = 1,
        corrected_a: float = 0.1,
    ) -> None:
        parameters = parameters_for(database, battery=(0.05, 2.0), motor=(0.01, 0.0), heater=(-0.02, 0.5))
        residual = msgspec.structs.replace(
            parameters.junction_residual, corrected_a=corrected_a, corrected_sd_a=sd_a, corrected_sd_per_a=sd_per_a
        )
        parameters = msgspec.structs.replace(parameters, junction_residual=residual)
        self.corrector = wire(database, InForce(parameters=parameters), 0.0)
        self.period_s, self.noise_a, self.random, self.step = period_s, noise_a, np.random.default_rng(seed), 0
        self.wrong: dict[str, Callable[[float], float]] = {}
        """By branch, what its broken sensor makes of the current that it showed before. [A]"""
        self.forged: dict[str, float] = {}
        """By branch: a forged frame comes before each real one, and its current is greater by this. [A]"""
        self.fell_back_s: float | None = None
        self.corrected_after = 0
        """Answers with quality CORRECTED after the fall-back."""
        self.qualities: dict[str, int] = {}

    @property
    def now_s(self) -> float:
        return self.step * self.period_s

    def run(self, seconds: float, true_a: Callable[[float], Mapping[str, float]], *, look_s: float = 0.02) -> None:
        """Send frames of these true currents [A] into the node, with positive directions as the sensors have them."""
        every = max(round(look_s / self.period_s), 1)
        for self.step in range(self.step, self.step + round(seconds / self.period_s)):  # noqa: B020
            for name, phase_s in PHASE_S.items():
                now_s = self.now_s + phase_s
                gain, offset_a = {"battery": (1.05, 2.0), "motor": (1.01, 0.0), "heater": (0.98, -0.5)}[name]
                shown_a = gain * true_a(now_s)[name] + offset_a + self.noise_a * self.random.standard_normal()
                shown_a = self.wrong[name](shown_a) if name in self.wrong else shown_a
                if name in self.forged:
                    self._send(name, shown_a + self.forged[name], now_s - 0.0002)
                self._send(name, shown_a, now_s)
            if self.step % every == 0:
                self.corrector.look(self.now_s + 0.009)
                if self.fell_back_s is None and self.corrector.latched:
                    self.fell_back_s = self.now_s
        self.step += 1

    def break_sensors(
        self, seconds: float, true_a: Callable[[float], Mapping[str, float]], **wrong: Callable[[float], float]
    ) -> None:
        """Run for 15 s with the sensors as they are, and so many seconds with some that are broken."""
        self.run(BREAK_S, true_a)
        assert self.corrector.state() == (State.CORRECTING, Reason.NONE)
        self.wrong = wrong
        self.run(seconds, true_a)

    @property
    def corrected_for_s(self) -> float:
        """How long the node continued to correct after the sensors broke. [s]"""
        return float("inf") if self.fell_back_s is None else self.fell_back_s - BREAK_S

    def _send(self, name: str, shown_a: float, now_s: float) -> None:
        code = min(max(round(10.0 * shown_a), -30000), 30000)
        for target in self.corrector.sources[KEYS[name]].answer(bytearray(struct.pack("<h", code)), now_s):
            self.qualities[name] = target.data[2]
            if self.fell_back_s is not None:
                self.corrected_after += target.data[2] == Quality.CORRECTED


def driving(time_s: float) -> dict[str, float]:
    """A vehicle in town: positive in the directions of the sensors, so that battery = motor + heater. [A]"""
    motor_a = 60.0 + 40.0 * np.sin(0.7 * time_s) + 15.0 * np.sin(3.1 * time_s)
    heater_a = 12.0 if time_s % 7.0 < 4.0 else 4.0
    return {"battery": motor_a + heater_a, "motor": motor_a, "heater": heater_a}
