"""``calibrator layout init``: databases with the units, names and ranges of real ones, logs, tables."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pandas as pd
import pytest

from calibrator.words import word_set
from ecu_node.database import read_database
from ecu_node.layout import Layout, read_layout
from tests.calibrator.command_here import calibrator, refused, reported, succeeded
from tests.calibrator.doctor.artificial_logs import DBC

HEAD = 'VERSION ""\nBU_: BMS INV OBC EMS CLIMA Battery\n'
PACK = """BO_ 1 PackStatus: 8 BMS
 SG_ PackCurrent : 0|16@1- (0.1,0) [-1000|1000] "A" INV
 SG_ PackVoltage : 16|16@1+ (0.1,0) [0|1000] "V" INV
"""
INVERTER = """BO_ 2 InverterStatus: 8 INV
 SG_ DcPower : 0|16@1- (0.02,0) [-300|300] "kW" BMS
 SG_ PhaseCurrent : 16|16@1+ (0.1,0) [0|900] "A" BMS
"""
HEATER = """BO_ 3 ClimaStatus: 8 CLIMA
 SG_ HeaterCurrent : 0|16@1+ (0.1,0) [0|50] "A" BMS
"""


def database_file(folder: Path, *messages: str, name: str = "car.dbc") -> Path:
    (folder / name).write_text(HEAD + "".join(messages))
    return folder / name


def found(path: Path, *arguments: object) -> Layout:
    """Return the layout that is written; the readers of layouts and databases must accept it."""
    out = path.parent / "found" / f"{path.stem}.toml"
    out.unlink(missing_ok=True)
    succeeded("layout", "init", path, "--out", out, *arguments)
    layout = read_layout(out)
    read_database(layout)
    return layout


def signed(layout: Layout) -> dict[str, tuple[str, int]]:
    return {branch.name: (branch.source, branch.sign) for branch in layout.branch}


PACK_AND_MOTOR = {"battery": ("PackStatus.PackCurrent", 1), "motor": ("InverterStatus.DcPower", -1)}
WITH_HEATER = PACK_AND_MOTOR | {"heater": ("ClimaStatus.HeaterCurrent", -1)}


# ---- from a database alone


def test_branches_and_inputs_of_the_built_in_vehicle_are_found_in_its_dbc(tmp_path: Path) -> None:
    (tmp_path / "hv_powertrain.dbc").write_bytes((DBC / "hv_powertrain.dbc").read_bytes())
    guessed = found(tmp_path / "hv_powertrain.dbc")
    by_hand = read_layout(DBC / "hv_powertrain.toml")
    proposed, wanted = ({(b.source, b.sign, b.timeout_s) for b in each.branch} for each in (guessed, by_hand))
    assert proposed == wanted
    needed = word_set("voltage torque speed heater_demand aircon_demand low_voltage_demand sensor_temperature")
    signals = {item.name: item.signal for item in guessed.input}
    assert signals.items() >= {item.name: item.signal for item in by_hand.input if item.name in needed}.items()
    assert set(by_hand.model_inputs) <= set(guessed.model_inputs)


BATTERIES = {
    "Amps": ('SG_ Battery_Current : 0|16@1+ (0.1,-819.2) [0|819] "Amps"', "BMS"),
    "A_DC": ('SG_ IBat : 0|16@1- (0.1,0) [-500|500] "A_DC"', "BMS"),
    "quantity in the unit": ('SG_ PackCurrent : 0|16@1- (0.1,0) [-500|500] "current:A"', "BMS"),
    "milliampere of 32 bits": ('SG_ PackCurrent : 0|32@1- (1,0) [0|0] "mA"', "BMS"),
    "no unit": ('SG_ Current : 0|12@1+ (0.25,-500) [0|0] ""', "Battery"),
    "German": ('SG_ BAT_StromIst : 0|16@1- (0.1,0) [-500|500] "A"', "BMS"),
    "French": ('SG_ CourantBatterie : 0|16@1- (0.1,0) [-500|500] "A"', "EMS"),
    "abbreviated": ('SG_ RdHVltBatPckCrnt : 0|13@1- (0.15,0) [-614.4|614.25] "A"', "EMS"),
    "8 bits": ('SG_ Pack_Current : 0|8@1- (0.1,-0.1) [0|0] "A"', "BMS"),
}


@pytest.mark.parametrize("kind", BATTERIES)
def test_battery_current_is_found_under_usual_names_and_units(kind: str, tmp_path: Path) -> None:
    signal, sender = BATTERIES[kind]
    message = f'BO_ 1 Status1: 8 {sender}\n {signal} INV\n SG_ HV_Voltage : 40|16@1+ (0.1,0) [0|900] "Volts" INV\n'
    limits = 'BO_ 7 Limits: 8 BMS\n SG_ MaxPackCurrent : 0|16@1- (0.1,0) [-500|500] "A" INV\n'
    layout = found(database_file(tmp_path, limits, INVERTER, message))
    name = signal.split()[1]
    assert [b.source for b in layout.branch] == [f"Status1.{name}", PACK_AND_MOTOR["motor"][0]]


@pytest.mark.parametrize(("message", "signals", "why"), [
    ("BAT11: 8 EMS", ('BAT_SNSR_I : 0|16@1+ (0.01,-327) [-327|328] "A"', 'BAT_SNSR_V : 16|14@1+ (0.001,6) [6|18] "V"'),
     "BAT_SNSR_V beside it is at most 18 V: not at the junction"),
    ("Mgmt: 8 EMS", ('BSBattCurrent : 0|14@1+ (0.0625,-512) [0|0] "Amps"',),
     "nothing says that it is of a high-voltage battery"),
    ("Pack: 8 BMS", ('PackMaxCurrent : 0|16@1- (0.1,0) [-500|500] "A"',),
     "'max': a limit, demand, estimate or part of one"),
    ("BMS_Limits: 8 BMS", ('Discharge_Current : 0|16@1+ (0.1,0) [0|0] "A"',),
     "its message has 'limits': no measured flow"),
    ("Shunt: 8 EMS", ('Current : 0|32@1- (1,0) [0|0] "mA"',), "neither name, comment nor sender says where it flows"),
])  # fmt: skip
def test_reason_is_given_why_a_current_is_not_taken_as_that_of_the_pack(
    message: str, signals: tuple[str, ...], why: str, tmp_path: Path
) -> None:
    lines = "".join(f" SG_ {signal} INV\n" for signal in signals)
    path = database_file(tmp_path, f"BO_ 1 {message}\n{lines}", INVERTER)
    run = calibrator("layout", "init", path, "--out", tmp_path / "car.toml")
    assert run.returncode == 1
    assert not (tmp_path / "car.toml").exists()
    *listed, last = run.stderr.splitlines()
    assert f"     {why}" in listed
    assert last.startswith(f"calibrator: {path}: no pack current found")


def test_charger_is_proposed_without_a_log_only_if_the_dbc_has_no_motor(tmp_path: Path) -> None:
    amps, volts = 'Amps : 0|16@1+ (0.1,0) [0|500] "Amps" BMS', 'Volts : 16|16@1+ (0.1,0) [0|1] "Volts" BMS'
    charger = f"BO_ 5 Chg: 8 OBC\n SG_ CHG_{amps}\n SG_ CHG_{volts}\n"
    assert found(database_file(tmp_path, PACK, charger)).find_branch("charger").source == "Chg.CHG_Amps"
    assert signed(found(database_file(tmp_path, PACK, charger, INVERTER))) == PACK_AND_MOTOR


def test_motor_current_is_computed_from_torque_and_speed_if_not_measured(tmp_path: Path) -> None:
    torque, speed = '0|11@1- (0.5,0) [-274|274] "Nm" BMS', '16|15@1- (1,0) [-16382|16382] "rpm" BMS'
    motor = f"BO_ 2 x1DA: 8 INV\n SG_ MG_EffectiveTorque : {torque}\n SG_ MG_OutputRevolution : {speed}\n"
    branch = found(database_file(tmp_path, PACK, motor)).find_branch("motor")
    assert (branch.formula, branch.uncertainty) == ("torque * motor_speed * 0.10472 / voltage", 0.1)


@pytest.mark.parametrize(
    ("comment", "sign"), [("Discharge positive", 1), ("positive while charge flows", -1), ("Current", 1)]
)
def test_sign_is_taken_from_the_comment_of_the_signal(comment: str, sign: int, tmp_path: Path) -> None:
    layout = found(database_file(tmp_path, PACK, INVERTER, f'CM_ SG_ 1 PackCurrent "{comment}";\n'))
    assert layout.find_branch("battery").sign == sign


# ---- with a log

Series = Mapping[str, Callable[[Any], Any]]


def motor_a(t: Any) -> Any:
    return 60.0 * np.sin(0.9 * t) + 30.0 * np.sin(2.1 * t + 1.0) + 20.0


def heater_a(t: Any) -> Any:
    return 8.0 + 4.0 * np.sign(np.sin(0.3 * t))


def battery_a(t: Any) -> Any:
    return motor_a(t) + heater_a(t) + 2.0


def nothing_a(_: float) -> float:
    return 0.0


def volts(t: Any) -> Any:
    return 390.0 - 0.1 * battery_a(t)


DRIVING: Series = {
    "PackCurrent": battery_a,
    "PackVoltage": volts,
    "DcPower": lambda t: 1e-3 * motor_a(t) * volts(t),
    "PhaseCurrent": lambda t: 1.5 * abs(motor_a(t)),
    "HeaterCurrent": heater_a,
}


def log_file(dbc: Path, series: Series) -> Path:
    """A minute of frames every 50 ms; signals without a series are 0; ranges of the database are not enforced."""
    database: Any = cantools.database.load_file(dbc, strict=False)
    written = []
    for step in range(1200):
        t = 0.05 * step
        for message in database.messages:
            raw = {}
            for signal in message.signals:
                codes = 1 << signal.length
                value: float = (series.get(signal.name, nothing_a)(t) - signal.offset) / signal.scale
                code = round(value) % codes
                raw[signal.name] = code - codes if signal.is_signed and code >= codes // 2 else code
            selectors = {signal.name: step % 2 for signal in message.signals if signal.is_multiplexer}
            data = message.encode(raw | selectors, scaling=False, strict=False)
            written.append(f"({1e9 + t:.6f}) can0 {message.frame_id:03X}#{data.hex().upper()}")
    path = dbc.with_suffix(".log")
    path.write_text("\n".join(written) + "\n")
    return path


def test_log_reveals_signs_contrary_to_convention(tmp_path: Path) -> None:
    dbc = database_file(tmp_path, PACK, INVERTER, HEATER)
    turned = {**DRIVING, "PackCurrent": lambda t: -battery_a(t), "HeaterCurrent": heater_a}
    layout = found(dbc, "--log", log_file(dbc, turned))
    assert signed(layout) == WITH_HEATER | {"battery": ("PackStatus.PackCurrent", -1)}
    assert layout.full_scale_a == 250.0


UNSIGNED = PACK.replace("@1- (0.1,0) [-1000|1000]", "@1+ (0.1,0) [0|0]")


@pytest.mark.parametrize(("pack", "motor_kw", "said"), [
    (PACK, lambda t: 15.0 * np.sin(5.3 * t), "of the greatest of them: a branch is missing or wrong; --branches"),
    (UNSIGNED, DRIVING["DcPower"], "PackStatus.PackCurrent signed; in the database it is unsigned: correct it"),
])  # fmt: skip
def test_log_that_contradicts_the_database_is_refused_with_the_reason(
    pack: str, motor_kw: Callable[[Any], Any], said: str, tmp_path: Path
) -> None:
    dbc = database_file(tmp_path, pack, INVERTER)
    run = calibrator("layout", "init", dbc, "--log", log_file(dbc, {**DRIVING, "DcPower": motor_kw}))
    assert (run.returncode, said in run.stderr) == (1, True), run.stderr


@pytest.mark.parametrize(("others", "said"), [((INVERTER,), "no pack current found"), ((), "none of its identifiers")])
def test_pack_current_from_another_j1939_source_address_is_named(
    others: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    dbc = database_file(tmp_path, PACK.replace("BO_ 1 ", f"BO_ {0x98FF5127} "), *others)
    log = log_file(dbc, DRIVING)
    database_file(tmp_path, PACK.replace("BO_ 1 ", f"BO_ {0x98FF51FE} "), *others)
    last = calibrator("layout", "init", dbc, "--log", log).stderr.splitlines()[-1]
    assert said in last
    assert "the log has 0x18FF5127: if that is PackStatus (0x18FF51FE) from another source address" in last


def test_wrong_range_in_the_dbc_is_found_by_the_log(tmp_path: Path) -> None:
    pack = PACK.replace("16@1- (0.1,0) [-1000|1000]", "16@1+ (0.1,-819.2) [0|819]")
    dbc = database_file(tmp_path, pack, INVERTER)
    log = log_file(dbc, DRIVING)
    layout = found(dbc, "--log", log)
    assert layout.wrong_ranges == ["PackStatus.PackCurrent"]
    sums = reported("kirchhoff", log, "--layout", layout.path)["before"]
    assert sums["sum"]["rmse_a"] < 20.0  # negative currents count: else 60 A


def test_multiplexed_battery_current_is_found(tmp_path: Path) -> None:
    pack = """BO_ 1 PackStatus: 8 BMS
 SG_ Page M : 0|8@1+ (1,0) [0|1] "" INV
 SG_ PackCurrent m1 : 8|16@1- (0.1,0) [-1000|1000] "A" INV
 SG_ PackVoltage m0 : 8|16@1+ (0.1,0) [0|1000] "V" INV
"""
    dbc = database_file(tmp_path, pack, INVERTER, HEATER)
    layout = found(dbc, "--log", log_file(dbc, DRIVING))
    assert signed(layout) == WITH_HEATER
    assert layout.find_branch("battery").timeout_s == 0.5  # every 100 ms: every other frame


I3 = """BO_ 274 Battery112: 8 BMS
 SG_ Battery_Current : 0|16@1+ (0.1,-819.2) [0|819] "Amps" INV
 SG_ Battery_Volts : 16|16@1+ (0.1,0) [0|500] "Volts" INV
BO_ 690 Charger2B2: 8 OBC
 SG_ CHG_Volts : 0|16@1+ (0.1,0) [0|1] "Volts" BMS
 SG_ CHG_Amps : 16|16@1+ (0.1,0) [-500|500] "Amps" BMS
"""


@pytest.mark.parametrize("recording", ["Circontrol_end", "Circontrol_midpoint", "eacaec_enda", "efacaec_mida"])
def test_branches_and_signs_of_a_charging_i3_are_found(recording: str, shared_data: Path, tmp_path: Path) -> None:
    """Real recordings of 9 to 40 s; in two the current does not change, and only its mean reveals the signs."""
    log = shared_data / "bmw_i3_charging" / f"2019_{recording}.csv.gz"
    layout = found(database_file(tmp_path, I3), "--log", log)
    assert signed(layout) == {"battery": ("Battery112.Battery_Current", -1), "charger": ("Charger2B2.CHG_Amps", 1)}


# ---- tables and names


TIME_S = np.arange(0.0, 60.0, 0.1)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    columns = {"Batteriestrom [A]": -battery_a(TIME_S), "Motorstrom [A]": motor_a(TIME_S)}
    columns |= {"Heizungsstrom [A]": heater_a(TIME_S), "Batteriespannung [V]": volts(TIME_S)}
    frame = pd.DataFrame({"Zeit [s]": TIME_S, **columns, "Bordnetz [A]": 20.0 + np.arange(600) * 7 % 11})
    frame.to_csv(tmp_path / "drive.csv", sep=";", decimal=",", float_format="%.2f", index=False)
    return tmp_path / "drive.csv"


def test_branches_are_found_among_the_columns_of_a_table(table: Path) -> None:
    layout, columns = found(table), {"battery": "Batterie", "motor": "Motor", "heater": "Heizungs"}
    assert signed(layout) == {branch: (f"{name}strom [A]", -1) for branch, name in columns.items()}
    succeeded("kirchhoff", table, "--layout", layout.path)


def columns(path: Path, *names: str, delay_s: float = 0.0, scale: float = 1.0) -> Path:
    """A table of battery, motor and heater under other names."""
    time_s = np.arange(0.0, 90.0, 0.1)
    currents_a = battery_a(time_s) + 2.0, 1.03 * scale * motor_a(time_s), heater_a(time_s - delay_s)
    frame = pd.DataFrame({"time": time_s, **dict(zip(names, currents_a, strict=False))})
    frame.to_csv(path, float_format="%.4f", index=False)
    return path


def test_current_that_closes_the_sum_is_a_branch_under_any_name(tmp_path: Path) -> None:
    assert found(columns(tmp_path / "x.csv", "Ibat", "Imot", "I_x")).find_branch("auxiliary").source == "I_x"
    late = columns(tmp_path / "late.csv", "Ibat", "Imot", "I_x", delay_s=5.0)
    assert set(signed(found(late))) == {"battery", "motor"}


def test_current_1000_times_too_large_is_refused_with_a_guess_of_its_unit(tmp_path: Path) -> None:
    path = columns(tmp_path / "x.csv", "Ibat", "Imot", scale=1000.0)
    run = calibrator("layout", "init", path, "--out", tmp_path / "x.toml")
    assert run.returncode == 1
    assert "in mA?" in run.stderr
    assert not (tmp_path / "x.toml").exists()


def test_table_whose_columns_are_signals_of_the_database_serves_as_a_log(tmp_path: Path) -> None:
    dbc = database_file(tmp_path, PACK, INVERTER, HEATER)
    kilowatts = 1e-3 * motor_a(TIME_S) * volts(TIME_S)
    names = "time", "PackStatus.PackCurrent [mA]", "PackVoltage", "DcPower", "ClimaStatus.HeaterCurrent"
    values = TIME_S, 1e3 * battery_a(TIME_S), volts(TIME_S), kilowatts, heater_a(TIME_S)
    pd.DataFrame(dict(zip(names, values, strict=True))).to_csv(tmp_path / "x.csv", index=False)
    layout = found(dbc, "--log", tmp_path / "x.csv")
    assert signed(layout) == WITH_HEATER
    assert layout.full_scale_a == 250.0
    succeeded("kirchhoff", tmp_path / "x.csv", "--layout", layout.path)


def test_branches_given_by_the_user_keep_their_sign_and_need_no_confirmation(table: Path) -> None:
    layout = found(table, "--branches", "-battery=Batteriestrom,-motor=Motorstrom [A]")
    assert layout.path.read_text().count("# confirm:") == 2  # full scale, voltage
    assert signed(layout) == {"battery": ("Batteriestrom [A]", -1), "motor": ("Motorstrom [A]", -1)}


@pytest.mark.parametrize(("line", "said"), [
    ("none.dbc", "no such file"),
    ("car.dbc --log other.log", "none of its identifiers is in"),
    ("car.dbc --log other.csv", "none of its columns is in"),
    ("two.dbc --log two.csv", "column 'PackCurrent' could be PackStatus.PackCurrent and Twin.PackCurr"),
    ("other.log --log car.dbc", "the database comes first"),
    ("car.dbc --out there.toml", "exists, and is not overwritten"),
])  # fmt: skip
def test_unfit_files_are_refused(line: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    database_file(tmp_path, PACK, INVERTER)
    database_file(tmp_path, PACK, PACK.replace("1 PackStatus", "9 Twin"), name="two.dbc")
    (tmp_path / "other.log").write_text("(1.000000) can0 7FF#00\n")
    (tmp_path / "other.csv").write_text("time,a\n0,1\n1,2\n")
    (tmp_path / "two.csv").write_text("time,PackCurrent\n0,1\n1,2\n")
    (tmp_path / "there.toml").write_text("kept")
    monkeypatch.chdir(tmp_path)
    assert said in refused("layout", "init", *line.split())
    assert (tmp_path / "there.toml").read_text() == "kept"


def test_json_lists_every_candidate_and_states_why_there_is_no_layout(tmp_path: Path) -> None:
    report = reported("layout", "init", database_file(tmp_path, PACK, INVERTER))
    assert report["branches"] == ["battery", "motor"]
    assert {item["signal"]: item["branch"] for item in report["candidates"]} == {
        "PackStatus.PackCurrent": "battery",
        "InverterStatus.DcPower": "motor",
        "InverterStatus.PhaseCurrent": None,
    }
    run = calibrator("layout", "init", database_file(tmp_path, INVERTER), "--json")
    assert run.returncode == 1
    assert json.loads(run.stdout)["problem"].startswith("no pack current found")
