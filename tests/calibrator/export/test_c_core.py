"""The C core gives the same bits as the node, is plain C99 within MISRA C:2012, and is harmed by no calibration."""

import os
import re
import subprocess
from pathlib import Path
from random import Random

import pytest
from msgspec.structs import replace

from bench.c_core import CORE, FLAGS, RECORD, build, fuzz, measure, record, run, vehicle
from calibrator.errors import ExportError
from calibrator.export.core import c_text, image_bytes
from ecu_node.core.e2e import protection_of
from ecu_node.errors import LayoutError
from tests.calibrator.export.c_core import all_codes, by_the_node, check_frames, drawn_vehicles, widths
from tests.calibrator.export.exports import checked_with, needs
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT, MakeDatabase, parameters_for

PARTS = range(-(-int(os.environ.get("HV_FRAMES", "100000")) // 100_000))
"""Numbers of the parts into which ``HV_FRAMES`` random frames are divided, 100,000 frames each."""
SANITIZED = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@needs("gcc")
def test_c_core_matches_the_node_for_all_codes(tmp_path: Path) -> None:
    checked = vehicle()
    program = build(checked, tmp_path)
    assert all_codes(checked, program, bits=20) > 1 << 20
    for voltage in (8000, 16383):  # the second is no value
        assert all_codes(checked, program, bits=16, voltage=voltage) == 1 << 16


@needs("gcc")
@pytest.mark.long
def test_c_core_matches_the_node_for_all_codes_of_8_to_24_bits(tmp_path: Path) -> None:
    codes = sum(all_codes(checked, build(checked, tmp_path)) for checked in widths(tmp_path))
    assert codes == 2 * sum(1 << bits for bits in range(8, 25)), "signed and unsigned"
    checked = vehicle()
    program = build(checked, tmp_path)
    assert all_codes(checked, program) > 1 << 24
    for voltage in (0, 1, 4000, 8000, 16383):
        assert all_codes(checked, program, voltage=voltage) == (1 << 16) + (1 << 20)


@needs("gcc")
@pytest.mark.parametrize("seed", PARTS)
def test_c_core_matches_the_node_for_random_frames(seed: int, tmp_path: Path) -> None:
    checked = vehicle()
    assert check_frames(checked, build(checked, tmp_path), Random(seed), 100_000) > 30_000


@needs("gcc")
def test_c_core_matches_the_node_in_many_runs_from_its_start(tmp_path: Path) -> None:
    checked = vehicle()
    program = build(checked, tmp_path)
    assert sum(check_frames(checked, program, Random(seed), 500) for seed in range(100)) > 15_000


@needs("gcc")
def test_c_core_leaves_a_power_as_it_is_while_the_message_of_its_voltage_is_invalid(tmp_path: Path) -> None:
    checked = vehicle()
    message = checked.database.message("J")
    protection, payload = protection_of(checked.database, message), bytearray(message.encode({"U12": 400, "P20": 9000}))
    assert protection is not None
    sent = list[tuple[int, bytes | None]]()
    for number in range(70):
        protection.advance(payload)
        sent.append((message.frame_id, bytes(payload) if number != 30 else bytes(8)))
    sent.insert(60, (message.frame_id, None))
    found = run(build(checked, tmp_path), b"".join(record(*frame) for frame in sent))
    assert found == b"".join(by_the_node(checked, sent))
    results = "".join(str(result) for _, _, result, _ in RECORD.iter_unpack(found))
    # one corrupt frame in three makes it INVALID, 44 frames of the last 64 VALID again; also after a silence
    assert results == "1" * 30 + "2" + "0" * 13 + "1" * 16 + "0" * 11


@needs("clang")
@pytest.mark.parametrize("seed", PARTS)
def test_c_core_matches_the_node_for_random_vehicles_under_sanitizers(seed: int, tmp_path: Path) -> None:
    vehicles, rng, changed = drawn_vehicles(Random(seed), tmp_path), Random(seed), 0
    for _ in range(6):
        checked = next(vehicles)
        changed += check_frames(checked, build(checked, tmp_path, compiler="clang", flags=SANITIZED), rng, 3_000)
    assert changed > 500


@needs("clang")
def test_fuzzing_of_the_c_core_finds_no_error(tmp_path: Path) -> None:
    fuzz(tmp_path, 12)


@needs("gcc", "clang", "nm")
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_c_core_is_plain_c99_without_libraries(compiler: str, tmp_path: Path) -> None:
    build(vehicle(), tmp_path, compiler=compiler, flags=("-Os",))
    names = subprocess.run(["nm", tmp_path / "hv_correction.o"], capture_output=True, text=True, check=True).stdout
    assert {line.split()[-2] for line in names.splitlines()} <= {"T", "t"}, "no symbol of others, no variable"
    code = "".join((CORE / name).read_text() for name in ("hv_correction.h", "hv_correction.c"))
    assert not re.search(r"\b(float|double|malloc|goto|while)\b", re.sub(r"/\*.*?\*/", "", code, flags=re.DOTALL))


@needs("cppcheck")
def test_c_core_deviates_only_from_the_documented_misra_rule(tmp_path: Path) -> None:
    (tmp_path / "hv_calibration.c").write_text(c_text(vehicle()))
    options = ["--addon=misra", "--std=c99", "--enable=all", "--quiet", f"-I{CORE}", "--template={file}:{id}"]
    options += ["-DUINT64_C(number)=number##U"]  # of <stdint.h>, which it does not read
    options += ["--suppress=missingIncludeSystem", "--suppress=unusedFunction", f"--cppcheck-build-dir={tmp_path}"]
    command: list[str | Path] = ["cppcheck", *options, CORE / "hv_correction.c", tmp_path / "hv_calibration.c"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = {line.split("/")[-1] for line in done.stderr.splitlines() if re.match(r"\S+:\S+$", line)}
    assert found == {"hv_correction.c:misra-c2012-8.7"}


@needs("gcc")
def test_c_core_passes_frames_through_if_the_calibration_is_not_of_its_layout(tmp_path: Path) -> None:
    checked = vehicle()
    text = c_text(checked)
    build(checked, tmp_path)
    at = text.rindex("UINT64_C(0x")
    (tmp_path / "hv_calibration.c").write_text(f"{text[:at]}UINT64_C(0xFFFFFFFFFFFFFFFF{text[text.index(')', at) :]}")
    subprocess.run(["gcc", *FLAGS, f"-I{CORE}", "-c", "hv_calibration.c"], cwd=tmp_path, check=True)
    subprocess.run(["gcc", *tmp_path.glob("*.o"), "-o", tmp_path / "driver"], check=True)
    given = b"".join(RECORD.pack(264, 8, 0, Random(k).randbytes(8)) for k in range(1000))
    assert run(tmp_path / "driver", given) == given


@needs("gcc")
def test_exported_c_compiles_with_any_vehicle_name(make_database: MakeDatabase, tmp_path: Path) -> None:
    parameters = replace(parameters_for(make_database(), battery=(0.05, 2.3)), vehicle='Zoë\n*/ #error /*/ ??/ "\\')
    build(checked_with(make_database(), parameters, tmp_path), tmp_path)


@pytest.mark.parametrize("place", ["7|64@0- (0.0001,0) [0|0]", "0|64@1+ (0.0001,0) [0|0]"])
def test_signal_too_wide_for_correction_is_refused(make_database: MakeDatabase, tmp_path: Path, place: str) -> None:
    motor = ' SG_ Motor : 23|16@0- (-0.05,0) [-1600|1600] "A" Node\n'
    dbc = SMALL_DBC.replace(motor, "").replace("7|16@0- (0.1,0) [-3000|3000]", place)
    dbc = dbc.replace("Net: 2 Node\n", "Net: 4 Node\n" + motor).replace('VAL_ 256 Battery -32768 "SNA";\n', "")
    database = make_database(SMALL_LAYOUT.replace("Pair.Motor", "Net.Motor"), dbc)
    with pytest.raises(ExportError, match=r"branch battery: signal Pair\.Battery has 64 bits, .* 58 bits below one"):
        c_text(checked_with(database, parameters_for(database, battery=(0.05, 2.3)), tmp_path))
    assert "battery" in c_text(checked_with(database, parameters_for(database, motor=(0.05, 2.3)), tmp_path))


def test_export_refuses_layouts_that_the_gateway_refuses(make_database: MakeDatabase, tmp_path: Path) -> None:
    database = make_database(SMALL_LAYOUT + '\n[e2e]\nprofile = "P01"\nmessages = ["Pair"]\n')
    checked = checked_with(database, parameters_for(database, battery=(0.05, 2.3)), tmp_path)
    for write in (c_text, lambda item: image_bytes(item, "big")):
        with pytest.raises(LayoutError, match=r"branch battery: signal Pair\.Battery overlaps the E2E header"):
            write(checked)


@needs("gcc", "size", "valgrind")
def test_c_core_is_small_and_needs_few_instructions_per_frame(tmp_path: Path) -> None:
    found = {row.name: row.value for row in measure(tmp_path, 100, ["-Os"])}
    assert 1_000 < found["C core, gcc -Os, hv_correction.o"] < 4_000
    assert all(100 < value < 2_000 for name, value in found.items() if "frame" in name)
