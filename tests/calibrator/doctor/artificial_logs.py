"""A drive of known currents as a log of dbc/hv_powertrain, and copies of its layout with faults put in."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from calibrator.drive import Array, Channel, Drive
from ecu_node.database import VehicleDatabase
from tests.calibrator.command_here import calibrator
from tests.calibrator.drive_logs import write_drive_log

DBC = Path(__file__).parents[3] / "dbc"
DURATION_S = 120.0
PERIOD_S = {"battery": 0.02, "motor": 0.02, "auxiliary": 0.05, "dcdc": 0.1}


def channel(value: Array, period_s: float, delay_s: float = 0.0) -> Channel:
    return Channel(time_s=period_s * np.arange(len(value)) + delay_s, value=value, good=np.isfinite(value))


def currents(time_s: Array) -> dict[str, Array]:
    """True currents at some instants, positive into the junction; a load of 2.5 A has no sensor. [A]"""
    motor = -60.0 * np.sin(0.7 * time_s) - 25.0 * np.sin(2.3 * time_s + 1.0) - 20.0
    auxiliary = -8.0 - 7.0 * np.sign(np.sin(0.4 * time_s + 0.3))
    dcdc = -3.0 - 0.5 * np.sin(0.11 * time_s)
    return {"battery": 2.5 - motor - auxiliary - dcdc, "motor": motor, "auxiliary": auxiliary, "dcdc": dcdc}


def true_drive(*, delay_s: Mapping[str, float] | None = None) -> Drive:
    """The drive as sensors with 0.2 A of noise show it, some of them late."""
    noise = np.random.default_rng(1)
    branches = {}
    for name, period_s in PERIOD_S.items():
        time_s = np.arange(0.0, DURATION_S, period_s)
        value = currents(time_s)[name]
        branches[name] = channel(value + noise.normal(0.0, 0.2, len(value)), period_s, (delay_s or {}).get(name, 0.0))
    time_s = np.arange(0.0, DURATION_S, 0.02)
    now = currents(time_s)
    speed = 50.0 + 20.0 * np.sin(0.05 * time_s)
    inputs = {
        "voltage": channel(380.0 - 0.1 * now["battery"], 0.02),
        "torque": channel(-now["motor"] * 380.0 / speed / 10.0, 0.02),
        "speed": channel(speed, 0.02),
        "heater_demand": channel(-now["auxiliary"] * 380.0, 0.02),
        "aircon_demand": channel(np.full(len(time_s), 500.0) + 10.0 * np.sin(time_s), 0.02),
        "low_voltage_demand": channel(-now["dcdc"] * 380.0, 0.02),
    }
    return Drive(vehicle="V1", name="drive", branches=branches, inputs=inputs)


def with_branch(drive: Drive, name: str, value: Array) -> Drive:
    """The same drive with other values of one branch."""
    changed = replace(drive.branches[name], value=value, good=np.isfinite(value))
    return replace(drive, branches={**drive.branches, name: changed})


def write_log(folder: Path, drive: Drive, database: VehicleDatabase) -> Path:
    """Write the drive as a log, and return the path of it."""
    write_drive_log(folder / "drive.log", drive, database)
    return folder / "drive.log"


def write_layout(
    folder: Path, *, inverted: tuple[str, ...] = (), units: Mapping[str, str] | None = None, full_scale_a: float = 400.0
) -> Path:
    """Write the layout, with some signs inverted, and its DBC, with other units of some signals."""
    dbc = (DBC / "hv_powertrain.dbc").read_text()
    for signal, unit in (units or {}).items():
        dbc, count = re.subn(rf'( SG_ {signal} :[^"]*)"[^"]*"', rf'\1"{unit}"', dbc)
        assert count == 1
    (folder / "hv_powertrain.dbc").write_text(dbc)
    layout = (DBC / "hv_powertrain.toml").read_text()
    layout = layout.replace("full_scale_a = 400.0", f"full_scale_a = {full_scale_a}")
    for name in inverted:
        sign = rf'(name = "{name}".*\nsignal = .*\nsign = )(-?1)'
        layout, count = re.subn(sign, lambda match: match[1] + str(-int(match[2])), layout)
        assert count == 1
    (folder / "layout.toml").write_text(layout)
    return folder / "layout.toml"


@dataclass(frozen=True, kw_only=True)
class DoctorRun:
    """What ``calibrator doctor --json`` reported."""

    code: int
    report: dict[str, Any]

    def findings(self, *kinds: str) -> list[SimpleNamespace]:
        """Findings with one of these codes; all findings if none is given."""
        found = [SimpleNamespace(**item) for item in self.report["findings"]]
        return [item for item in found if item.code in kinds or not kinds]

    @property
    def errors(self) -> list[tuple[str, str]]:
        """Kind and subject of each error."""
        return [(item.code, item.subject) for item in self.findings() if item.severity == "error"]


Examine = Callable[[Drive], DoctorRun]


def examined(layout: Path, *logs: Path) -> DoctorRun:
    """Run the doctor; its exit code must be 1 if there is an error among the findings, else 0."""
    done = calibrator("doctor", "--layout", layout, *(word for log in logs for word in ("--log", log)), "--json")
    assert not done.stderr, done.stderr
    doctor = DoctorRun(code=done.returncode, report=json.loads(done.stdout))
    assert doctor.code == (1 if doctor.errors else 0)
    return doctor
