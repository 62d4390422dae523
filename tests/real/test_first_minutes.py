"""The first minutes of somebody with a DBC and a log: a recorded Tesla Model 3, and faults put into the recording."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from calibrator.drives.store import iterate_drives
from calibrator.files.layout_files import vehicle_database
from tests.calibrator.command_here import calibrator as calibrator_here
from tests.calibrator.doctor.artificial_logs import examined
from tests.calibrator.drive_logs import write_drive_log
from tests.real.conftest import LAYOUT, ROOT

Change = Callable[[str], str]


def calibrator(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run a command in a folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return calibrator_here(*arguments)


def test_documented_commands_lead_from_dbc_and_log_to_the_picture(tesla: Path) -> None:
    """The commands are those of docs/first_minutes.md."""
    made = calibrator(tesla, *["layout", "init", "Model3CAN.dbc", "--log", "drive.log.gz", "--out", "my_car.toml"])
    assert (made.returncode, made.stdout.partition(";")[0]) == (
        0,
        "my_car.toml: branches battery, motor_rear, motor_front",
    )
    assert made.stderr.endswith("\nnext: calibrator doctor --layout my_car.toml --log drive.log.gz\n")
    again = calibrator(tesla, *["layout", "init", "Model3CAN.dbc", "--out", "my_car.toml"])
    assert again.returncode == 1
    assert again.stderr.startswith("calibrator: my_car.toml: exists, and is not overwritten")
    doctor = calibrator(tesla, *["doctor", "--layout", "my_car.toml", "--log", "drive.log.gz"])
    assert doctor.returncode == 0, doctor.stdout
    ready = "ready for: kirchhoff, import, calibrate --trusted, ecu-node --gateway"  # too short for a fleet
    assert ready in doctor.stdout.splitlines()
    drawn = calibrator(tesla, *["kirchhoff", "drive.log.gz", "--layout", "my_car.toml", "--plot", "sum.html", "--json"])
    assert drawn.returncode == 0, drawn.stderr
    total = json.loads(drawn.stdout)["before"]["sum"]
    assert (round(total["mean_a"], 1), round(total["sd_a"], 1)) == (4.1, 1.2)
    assert (tesla / "sum.html").read_text().startswith("<html>")
    imported = calibrator(tesla, *["import", "drive.log.gz", "--layout", "my_car.toml", "--out", "store"])
    assert imported.returncode == 0, imported.stderr


def test_power_from_which_a_current_is_computed_is_the_only_input_that_is_named(tesla: Path) -> None:
    signals = {
        "voltage": "ID132HVBattAmpVolt.BattVoltage132", "rear_power": "ID266RearInverterPower.RearPower266",
        "torque": "ID108DIR_torque.DIR_torqueActual", "speed": "ID108DIR_torque.DIR_axleSpeed",
    }  # fmt: skip
    inputs = "".join(f'\n[[input]]\nname = "{name}"\nsignal = "{signal}"\n' for name, signal in signals.items())
    layout = tesla / "with_power.toml"
    plain = (tesla / "tesla_model3.toml").read_text()
    layout.write_text(plain.replace("branch = [", f"model_inputs = {json.dumps([*signals])}\nbranch = [") + inputs)
    found = examined(layout, tesla / "drive.log.gz").findings("computed input")
    assert [(each.subject, each.text.rpartition(" ")[2]) for each in found] == [("rear_power", "motor_rear")]


@pytest.mark.long
def test_documented_node_commands_work_with_the_guessed_layout(tesla: Path) -> None:
    """The commands of docs/first_minutes.md that need no bus; before them the load that it names."""
    calibrator(tesla, *["layout", "init", "Model3CAN.dbc", "--log", "drive.log.gz", "--out", "one_car.toml"])
    with (tesla / "one_car.toml").open("a") as file:
        file.write("\n[unmeasured_load]\nmean_a = 4.1\nsd_a = 1.0\n")
    section = (ROOT / "docs" / "first_minutes.md").read_text().partition("\n## With one car\n")[2]
    typed = re.findall(r"(?m)^ecu-node (?:template|check) [^#\n]*", section.partition("\n## ")[0])
    assert len(typed) == 2
    environment = {"PYTHONPATH": str(ROOT), "PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin", "HOME": str(tesla)}
    for command in typed:
        line = command.replace("my_car.toml", "one_car.toml")
        done = subprocess.run(
            line, shell=True, capture_output=True, text=True, check=False, cwd=tesla, env=environment, timeout=60
        )
        assert (done.returncode, done.stderr) == (0, ""), command
    assert done.stdout.startswith("vehicle V1, parameter set 1: fit\n")
    assert json.loads((tesla / "V1.json").read_text())["junction_residual"]["expected_a"] == 4.1


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
    pytest.param(inverted("battery"), with_unit("RearPower266", "W"),
                 [("error", "sign", "battery"), ("error", "unit", "motor_rear")], id="sign and unit"),
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


@pytest.mark.parametrize("trip", ["TripA07", "TripA24"])
def test_doctor_finds_no_error_in_i3_trips_and_names_an_inverted_motor(
    trip: str, i3_store: Path, tmp_path: Path
) -> None:
    """The motor current of these trips is minus the sum of the others, so the junction sum is exactly 0.

    Which sign is wrong, that of battery or motor, follows from the voltage.
    """
    database = vehicle_database(LAYOUT)
    drive = next(d for d in iterate_drives(i3_store, database.layout) if d.name == trip)
    write_drive_log(tmp_path / "trip.log.gz", drive, database)
    assert examined(LAYOUT, tmp_path / "trip.log.gz").errors == []
    text = LAYOUT.read_text().replace('dbc = "hv', f'dbc = "{ROOT}/dbc/hv')
    changed = re.sub(r'("HV_Motor.MotorCurrent"\nsign = )-1', r"\g<1>1", text)
    (tmp_path / "wrong.toml").write_text(changed)
    assert examined(tmp_path / "wrong.toml", tmp_path / "trip.log.gz").errors == [("sign", "motor")]
