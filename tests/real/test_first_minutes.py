"""The first minutes of somebody with a DBC and a log: a recorded Tesla Model 3, and faults put into the recording."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.calibrator.command_here import calibrator, refused, reported, succeeded
from tests.calibrator.doctor.artificial_logs import examined

Change = Callable[[str], str]


def test_documented_commands_lead_from_dbc_and_log_to_the_picture(tesla: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The commands are those of docs/first_minutes.md."""
    monkeypatch.chdir(tesla)
    made = calibrator("layout", "init", "Model3CAN.dbc", "--log", "drive.log.gz", "--out", "my_car.toml")
    assert made.returncode == 0
    assert made.stdout.startswith("my_car.toml: branches battery, motor_rear, motor_front;")
    assert made.stderr.endswith("\nnext: calibrator doctor --layout my_car.toml --log drive.log.gz\n")
    again = refused("layout", "init", "Model3CAN.dbc", "--out", "my_car.toml")
    assert again.startswith("calibrator: my_car.toml: exists, and is not overwritten")
    doctor = succeeded("doctor", "--layout", "my_car.toml", "--log", "drive.log.gz")
    ready = "ready for: kirchhoff, import, calibrate --trusted, ecu-node --gateway"  # too short for a fleet
    assert ready in doctor.splitlines()
    drawn = reported("kirchhoff", "drive.log.gz", "--layout", "my_car.toml", "--plot", "sum.html")
    total = drawn["before"]["sum"]
    assert (round(total["mean_a"], 1), round(total["sd_a"], 1)) == (4.1, 1.2)
    assert (tesla / "sum.html").read_text().startswith("<html>")
    succeeded("import", "drive.log.gz", "--layout", "my_car.toml", "--out", "store")


def inverted(name: str) -> Change:
    """A layout with the other sign of one branch."""
    return lambda layout: re.sub(rf'("{name}", sign = )(-?1)', lambda match: match[1] + str(-int(match[2])), layout)


def exchanged(one: str, other: str) -> Change:
    """A layout in which two branches read each other's signal."""

    def change(layout: str) -> str:
        lines = {name: re.search(rf'"{name}", sign = .*?, (.*) }}', layout) for name in (one, other)}
        first, second = (match[1] for match in lines.values() if match is not None)
        return layout.replace(first, "@").replace(second, first).replace("@", second)

    return change


def with_unit(signal: str, unit: str) -> Change:
    """A DBC in which a signal has another unit."""
    return lambda dbc: re.sub(rf'( SG_ {signal} [^"]*)"[^"]*"', rf'\1"{unit}"', dbc)


def tenfold_voltage(dbc: str) -> str:
    return re.sub(r"(BattVoltage132 .*)\(0.01,0\) \[0\|655.35\]", r"\1(0.1,0) [0|6553.5]", dbc)


@pytest.mark.parametrize(("change_layout", "change_dbc", "findings"), [
    (str, str, [("hint", "mean", "sum")]),
    (inverted("battery"), str, [("error", "sign", "battery")]),
    (inverted("motor_rear"), str, [("error", "sign", "motor_rear")]),
    (exchanged("battery", "motor_rear"), str, [("warning", "exchanged", "battery")]),
    (exchanged("motor_rear", "motor_front"), str, [("warning", "exchanged", "motor_rear")]),
    (str, with_unit("RearPower266", "W"), [("error", "unit", "motor_rear")]),
    (str, with_unit("SmoothBattCurrent132", "kA"), [("error", "unit", "battery")]),
    (str, with_unit("FrontPower2E5", "MW"), [("error", "unit", "motor_front")]),
    (inverted("battery"), with_unit("RearPower266", "W"),
     [("error", "sign", "battery"), ("error", "unit", "motor_rear")]),
    (str, tenfold_voltage, [("error", "unit", "ID132HVBattAmpVolt.BattVoltage132")]),
])  # fmt: skip
def test_doctor_finds_each_injected_mistake_and_no_other(
    change_layout: Change, change_dbc: Change, findings: list[tuple[str, str, str]], tesla: Path, tmp_path: Path
) -> None:
    dbc, layout = (tesla / "Model3CAN.dbc").read_text(encoding="cp1252"), (tesla / "tesla_model3.toml").read_text()
    changed = change_layout(layout) != layout or change_dbc(dbc) != dbc
    assert changed or findings == [("hint", "mean", "sum")]
    (tmp_path / "Model3CAN.dbc").write_text(change_dbc(dbc), encoding="cp1252")
    (tmp_path / "layout.toml").write_text(change_layout(layout))
    found = examined(tmp_path / "layout.toml", tesla / "drive.log.gz").findings()
    grave = [item for item in found if item.severity == "error" or item.code == "exchanged"]
    assert sorted((item.severity, item.code, item.subject) for item in grave or found) == findings
