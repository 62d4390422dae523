"""The C core gives the same bits as the node, is plain C99 within MISRA C:2012, and takes any calibration."""

import re
import subprocess
from pathlib import Path
from random import Random

import pytest
from msgspec.structs import replace

from bench import c_core
from calibrator.errors import ExportError
from calibrator.export.core import c_text, image_bytes
from ecu_node.errors import LayoutError
from tests.calibrator.export.exports import checked_with, needs
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT, MakeDatabase, parameters_for

SANITIZED = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@needs("gcc")
def test_c_core_matches_the_node_for_all_codes_and_frames(tmp_path: Path) -> None:
    checked = c_core.vehicle()
    program = c_core.build(checked, tmp_path)
    assert c_core.check_frames(checked, program, Random(2026), 100_000) > 30_000
    assert c_core.all_codes(checked, program, bits=20) > 1 << 20
    for voltage in (8000, 16383):  # the second is no value
        assert c_core.all_codes(checked, program, bits=16, voltage=voltage) == 1 << 16


@needs("clang")
def test_random_vehicles_are_the_same_and_nothing_is_undefined(tmp_path: Path) -> None:
    vehicles, changed = c_core.drawn_vehicles(Random(7), tmp_path), 0
    for _ in range(6):
        checked = next(vehicles)
        changed += c_core.check_frames(
            checked, c_core.build(checked, tmp_path, compiler="clang", flags=SANITIZED), Random(8), 3_000
        )
    assert changed > 2_000


@needs("clang")
def test_fuzzing_finds_nothing(tmp_path: Path) -> None:
    c_core.fuzz(tmp_path, 60)


@needs("gcc", "clang", "nm")
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_core_is_plain_c99_that_needs_no_library(compiler: str, tmp_path: Path) -> None:
    c_core.build(c_core.vehicle(), tmp_path, compiler=compiler, flags=("-Os",))
    names = subprocess.run(["nm", tmp_path / "hv_correction.o"], capture_output=True, text=True, check=True).stdout
    assert {line.split()[-2] for line in names.splitlines()} <= {"T", "t"}, "no symbol of others, no variable"
    code = "".join((c_core.CORE / name).read_text() for name in ("hv_correction.h", "hv_correction.c"))
    assert not re.search(r"\b(float|double|malloc|goto|while)\b", re.sub(r"/\*.*?\*/", "", code, flags=re.DOTALL))


@needs("cppcheck")
def test_only_the_written_down_rule_of_misra_is_deviated_from(tmp_path: Path) -> None:
    (tmp_path / "hv_calibration.c").write_text(c_text(c_core.vehicle()))
    options = ["--addon=misra", "--std=c99", "--enable=all", "--quiet", f"-I{c_core.CORE}", "--template={file}:{id}"]
    options += ["--suppress=missingIncludeSystem", "--suppress=unusedFunction", f"--cppcheck-build-dir={tmp_path}"]
    command: list[str | Path] = ["cppcheck", *options, c_core.CORE / "hv_correction.c", tmp_path / "hv_calibration.c"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = {line.split("/")[-1] for line in done.stderr.splitlines() if re.match(r"\S+:\S+$", line)}
    assert found == {"hv_correction.c:misra-c2012-8.7"}


@needs("gcc")
def test_calibration_of_another_layout_and_erased_memory_pass_everything_through(tmp_path: Path) -> None:
    checked = c_core.vehicle()
    text = c_text(checked)
    c_core.build(checked, tmp_path)
    at = text.rindex("UINT64_C(0x")
    (tmp_path / "hv_calibration.c").write_text(f"{text[:at]}UINT64_C(0xFFFFFFFFFFFFFFFF{text[text.index(')', at) :]}")
    subprocess.run(["gcc", *c_core.FLAGS, f"-I{c_core.CORE}", "-c", "hv_calibration.c"], cwd=tmp_path, check=True)
    subprocess.run(["gcc", *tmp_path.glob("*.o"), "-o", tmp_path / "driver"], check=True)
    given = b"".join(c_core.RECORD.pack(264, 8, 0, Random(k).randbytes(8)) for k in range(1000))
    assert c_core.run(tmp_path / "driver", given) == given


@needs("gcc")
def test_any_name_of_a_vehicle_compiles(make_database: MakeDatabase, tmp_path: Path) -> None:
    parameters = replace(parameters_for(make_database(), battery=(0.05, 2.3)), vehicle='Zoë\n*/ #error /*/ ??/ "\\')
    c_core.build(checked_with(make_database(), parameters, tmp_path), tmp_path)


@pytest.mark.parametrize("place", ["7|64@0- (0.0001,0) [0|0]", "0|64@1+ (0.0001,0) [0|0]"])
def test_too_wide_signal_is_refused_by_name(make_database: MakeDatabase, tmp_path: Path, place: str) -> None:
    motor = ' SG_ Motor : 23|16@0- (-0.05,0) [-1600|1600] "A" Node\n'
    dbc = SMALL_DBC.replace(motor, "").replace("7|16@0- (0.1,0) [-3000|3000]", place)
    dbc = dbc.replace("Net: 2 Node\n", "Net: 4 Node\n" + motor).replace('VAL_ 256 Battery -32768 "SNA";\n', "")
    database = make_database(SMALL_LAYOUT.replace("Pair.Motor", "Net.Motor"), dbc)
    with pytest.raises(ExportError, match=r"branch battery: signal Pair\.Battery has 64 bits, .* 58 bits below one"):
        c_text(checked_with(database, parameters_for(database, battery=(0.05, 2.3)), tmp_path))
    assert "battery" in c_text(checked_with(database, parameters_for(database, motor=(0.05, 2.3)), tmp_path))


def test_what_the_gateway_refuses_is_refused(make_database: MakeDatabase, tmp_path: Path) -> None:
    database = make_database(SMALL_LAYOUT + '\n[e2e]\nprofile = "P01"\nmessages = ["Pair"]\n')
    checked = checked_with(database, parameters_for(database, battery=(0.05, 2.3)), tmp_path)
    for write in (c_text, lambda item: image_bytes(item, "big")):
        with pytest.raises(LayoutError, match=r"branch battery: Pair\.Battery is written twice, or overlaps"):
            write(checked)


@needs("gcc", "size", "valgrind")
def test_size_and_instructions_are_those_of_a_small_program(tmp_path: Path) -> None:
    found = {row.name: row.value for row in c_core.measure(tmp_path, 100, ["-Os"])}
    assert 1_000 < found["C core, gcc -Os, hv_correction.o"] < 4_000
    assert all(100 < value < 2_000 for name, value in found.items() if "frame" in name)
