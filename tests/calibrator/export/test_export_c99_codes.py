"""The exported C corrects codes as the integer plans do, in plain C99, and refuses what it could not do exactly."""

import re
import subprocess
from pathlib import Path
from random import Random

import pytest
from msgspec.structs import replace

from bench.c99_driver import COMPILER, FLAGS, NO_CODE
from calibrator.errors import ExportError
from calibrator.export.c99 import HEADER, SOURCE, c99_files
from calibrator.export.c_model import CBranch
from ecu_node.core.signals import Codes
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError, ParameterError
from tests.calibrator.export.exports import (
    MakeDatabase,
    checked_with,
    compiled,
    held_back,
    needs_compiler,
    parameters_for,
)
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT

FAULTS = {"battery": (0.05, 2.3), "motor": (-0.031, -1.234567890123), "auxiliary": (0.0, 0.5), "dcdc": (0.11, 0.0)}
SMALL_FAULTS = {"battery": (0.05, 2.3), "motor": (-0.031, 1.0), "heater": (0.04, -2.0)}
UNDEFINED_IS_FATAL = ("-O1", "-fsanitize=undefined", "-fno-sanitize-recover=all")
EXTREMES = (-(1 << 63), -(1 << 63) + 1, -(1 << 32), -1, 0, 1, (1 << 31) - 1, (1 << 62), (1 << 63) - 1)


def by_the_plan(branch: CBranch, code: int, voltage_code: int) -> int:
    """What the node writes for a code."""
    plan, voltage = branch.plan, branch.voltage
    if plan is None or not branch.codes.is_value(code):
        return code
    if not plan.needs_voltage:
        return plan.apply(code)
    return plan.apply(code, voltage_code) if voltage is not None and voltage.codes.is_value(voltage_code) else code


def width(codes: Codes) -> range:
    return range(codes.place.lowest, codes.place.highest + 1)


@needs_compiler
def test_all_codes_of_every_branch_are_those_of_its_plan(tmp_path: Path, database: VehicleDatabase) -> None:
    parameters = held_back(parameters_for(database, **FAULTS), "motor_rear")
    export = compiled(database, parameters, tmp_path)
    for branch in export.program.branches:
        codes = width(branch.codes)
        found = export.codes(branch.name, [(code, NO_CODE) for code in codes])
        assert found == [by_the_plan(branch, code, NO_CODE) for code in codes]
        assert (found == list(codes)) == (branch.name == "motor_rear")


@needs_compiler
def test_a_power_takes_every_voltage(make_database: MakeDatabase, tmp_path: Path) -> None:
    database, rng = make_database(), Random(1)
    parameters = parameters_for(database, **SMALL_FAULTS)
    export = compiled(database, parameters, tmp_path)
    heater = export.program.branches[2]
    pairs = [(rng.randrange(1 << 16), rng.randrange(1 << 16)) for _ in range(50_000)]
    found = export.codes("heater", pairs)
    assert found == [by_the_plan(heater, *pair) for pair in pairs]


@needs_compiler
def test_no_code_is_undefined_behaviour(make_database: MakeDatabase, tmp_path: Path) -> None:
    wide = SMALL_DBC.replace("7|16@0- (0.1,0) [-3000|3000]", "7|32@0- (0.001,0) [0|0]").replace("23|16@0-", "39|16@0-")
    database = make_database(dbc=wide.replace("VAL_ 256 Battery -32768", f"VAL_ 256 Battery {-1 << 31}"))
    export = compiled(database, parameters_for(database, **SMALL_FAULTS), tmp_path, flags=UNDEFINED_IS_FATAL)
    for branch in export.program.branches:
        whole = width(branch.codes)
        codes = (*whole[:: max(1, len(whole) >> 12)], *EXTREMES)
        given = [(code, voltage) for code in codes for voltage in EXTREMES]
        assert export.codes(branch.name, given) == [by_the_plan(branch, *pair) for pair in given]
    rng = Random(2)
    assert len(export.frames([("Pair", rng.randbytes(8)) for _ in range(10_000)])) == 10_000


@needs_compiler
def test_nothing_is_needed_of_any_library(tmp_path: Path, database: VehicleDatabase) -> None:
    export = compiled(database, parameters_for(database, **FAULTS), tmp_path)
    names = subprocess.run(["nm", "-u", export.object_file], capture_output=True, text=True, check=True)
    assert names.stdout == ""


def test_only_integers_of_c99_are_used(tmp_path: Path, database: VehicleDatabase) -> None:
    files = c99_files(checked_with(database, parameters_for(database, **FAULTS), tmp_path))
    code = re.sub(r"/\*.*?\*/", "", "".join(files.values()), flags=re.DOTALL)
    assert set(re.findall(r"#include (.*)", code)) == {f'"{HEADER}"', "<stdbool.h>", "<stddef.h>", "<stdint.h>"}
    assert not re.search(r"\b(float|double|malloc|goto|while|for)\b", code)


def test_the_same_parameters_give_the_same_text(tmp_path: Path, database: VehicleDatabase) -> None:
    checked = checked_with(database, parameters_for(database, **FAULTS), tmp_path)
    assert c99_files(checked) == c99_files(checked)


def test_the_header_says_where_it_comes_from(tmp_path: Path, database: VehicleDatabase) -> None:
    checked = checked_with(database, parameters_for(database, **FAULTS), tmp_path)
    header = c99_files(checked)[HEADER]
    constants = dict(re.findall(r'#define HV_(\w+) "?([^"\n]*)"?', header))
    assert constants["VEHICLE"] == "v1"
    assert constants["PARAMETER_SET"] == "300ULL"
    assert constants["PARAMETERS_SHA256"] == checked.digest
    assert (constants["LAYOUT_SHA256"], constants["DBC_SHA256"]) == (database.layout.digest, database.digest)
    assert constants["ID_HV_Battery"] == "0x110UL"
    assert "End-to-end protection is NOT part of this" in header


@needs_compiler
@pytest.mark.parametrize("vehicle", ['a "b" \\ ??/', "Zoë\n*/ #error"])
def test_any_name_of_a_vehicle_is_a_string(vehicle: str, tmp_path: Path, database: VehicleDatabase) -> None:
    export = compiled(database, replace(parameters_for(database, **FAULTS), vehicle=vehicle), tmp_path)
    main = f'#include "{HEADER}"\n#include <stdio.h>\nint main(void) {{ fputs(HV_VEHICLE, stdout); return 0; }}\n'
    (tmp_path / "name.c").write_text(main)
    subprocess.run([COMPILER, *FLAGS, tmp_path / "name.c", "-o", tmp_path / "name"], check=True)
    assert export.object_file.exists()
    assert subprocess.run([tmp_path / "name"], capture_output=True, check=True).stdout.decode() == vehicle


@needs_compiler
def test_a_header_of_another_export_does_not_compile(tmp_path: Path, database: VehicleDatabase) -> None:
    first = c99_files(checked_with(database, parameters_for(database, battery=(0.05, 2.3)), tmp_path))
    second = c99_files(checked_with(database, parameters_for(database, battery=(0.05, 2.4)), tmp_path))
    (tmp_path / HEADER).write_text(first[HEADER])
    (tmp_path / SOURCE).write_text(second[SOURCE])
    run = subprocess.run([COMPILER, *FLAGS, "-c", SOURCE], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert f"{HEADER} is of another export" in run.stderr


@pytest.mark.parametrize("place", ["7|64@0- (0.0001,0) [0|0]", "0|64@1+ (0.0001,0) [0|0]"])
def test_a_signal_too_wide_is_refused_by_name(make_database: MakeDatabase, tmp_path: Path, place: str) -> None:
    motor = ' SG_ Motor : 23|16@0- (-0.05,0) [-1600|1600] "A" Node\n'
    dbc = SMALL_DBC.replace(motor, "").replace("7|16@0- (0.1,0) [-3000|3000]", place)
    dbc = dbc.replace("Net: 2 Node\n", "Net: 4 Node\n" + motor).replace('VAL_ 256 Battery -32768 "SNA";\n', "")
    database = make_database(SMALL_LAYOUT.replace("Pair.Motor", "Net.Motor"), dbc)
    checked = checked_with(database, parameters_for(database, battery=(0.05, 2.3)), tmp_path)
    with pytest.raises(
        ExportError, match=r"branch battery: signal Pair\.Battery has 64 bits, .* more than the 128 bits"
    ):
        c99_files(checked)
    passing = checked_with(database, parameters_for(database, motor=(0.05, 2.3)), tmp_path)
    assert "hv_correct_battery(int64_t code)" in c99_files(passing)[SOURCE], (
        "nothing is computed of what passes through"
    )


def test_what_the_gateway_refuses_is_refused(make_database: MakeDatabase, tmp_path: Path) -> None:
    layout = SMALL_LAYOUT + '\n[e2e]\nprofile = "P01"\nmessages = ["Pair"]\n'
    database = make_database(layout)
    checked = checked_with(database, parameters_for(database, **SMALL_FAULTS), tmp_path)
    with pytest.raises(LayoutError, match=r"branch battery: Pair\.Battery is written twice, or overlaps"):
        c99_files(checked)


def test_two_functions_with_one_name_are_refused(make_database: MakeDatabase, tmp_path: Path) -> None:
    database = make_database(SMALL_LAYOUT.replace('"battery"', '"input_Net_Voltage"'))
    checked = checked_with(database, parameters_for(database, input_Net_Voltage=(0.05, 2.3)), tmp_path)
    with pytest.raises(ExportError, match="present_input_Net_Voltage: two things would have this name in C"):
        c99_files(checked)


def test_a_name_ends_where_it_ends(make_database: MakeDatabase) -> None:
    with pytest.raises(LayoutError):
        make_database(SMALL_LAYOUT.replace('"battery"', r'"battery\n"'))


def test_the_largest_number_of_a_parameter_set_is_one_that_c_has(database: VehicleDatabase, tmp_path: Path) -> None:
    parameters = parameters_for(database, battery=(0.05, 2.3))
    largest = c99_files(checked_with(database, replace(parameters, number=(1 << 53) - 1), tmp_path))[HEADER]
    assert "9007199254740991ULL" in largest
    with pytest.raises(ParameterError, match="9007199254740991"):
        checked_with(database, replace(parameters, number=1 << 53), tmp_path)


def test_two_inputs_with_one_name_are_refused(make_database: MakeDatabase, tmp_path: Path) -> None:
    cooler = '    { name = "cooler", sign = -1, power = "Heater.Cooling", voltage = "Net_A.B" },\n]\n'
    layout = SMALL_LAYOUT.replace("Net.Voltage", "Net.A_B").replace("]\n", cooler)
    cooling = 'Heater: 4 Node\n SG_ Cooling : 16|16@1+ (1,0) [0|60000] "W" Node\n'
    net = 'BO_ 259 Net_A: 2 Node\n SG_ B : 0|16@1+ (0.01,0) [0|650] "V" Node\nBO_ 512 '
    dbc = SMALL_DBC.replace("SG_ Voltage", "SG_ A_B").replace("Heater: 4 Node\n", cooling).replace("BO_ 512 ", net)
    database = make_database(layout, dbc)
    checked = checked_with(database, parameters_for(database, **SMALL_FAULTS), tmp_path)
    with pytest.raises(ExportError, match="Net_A_B: two signals would have this name in C"):
        c99_files(checked)
