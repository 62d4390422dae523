"""Exports for calibration tools, read by independent readers and flashed into a compiled program.

A program that was linked with another calibration gives the same bits as the node once HEX is flashed into
it, or the values of DCM or CDFX at the addresses of the A2L.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from random import Random

import bincopy
import pytest
from dcmReader.dcm_reader import DcmReader
from elftools.elf.elffile import ELFFile
from pya2l.parser import A2lParser

from bench.c_core import build, vehicle
from calibrator.errors import ExportError
from calibrator.export.core import Checked, find_image, image_bytes, intel_hex, read_checked
from ecu_node.parameters import write_parameters
from tests.calibrator.export.c_core import check_frames
from tests.calibrator.export.exports import export, needs, refused
from tests.ecu_node.vehicles import MakeDatabase, parameters_for

pytestmark = needs("gcc")


@pytest.fixture(scope="module")
def vehicles(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Checked]:
    """A program with a calibration that corrects nothing, and the parameters of the vehicle to be flashed into it."""
    folder = tmp_path_factory.mktemp("flash")
    checked = vehicle()
    write_parameters(parameters_for(checked.database, i8=(0.0, 0.0)), folder / "none.json")
    program = build(read_checked(folder / "none.json", checked.database, None), folder)
    write_parameters(checked.parameters, folder / "v1.json")
    return program, read_checked(folder / "v1.json", checked.database, None)


def written(vehicles: tuple[Path, Checked], form: str, out: Path) -> Path:
    """The vehicle's file in a format, from the command line."""
    program, checked = vehicles
    more, layout = ("--elf", program) if form in {"hex", "a2l"} else (), checked.database.layout.path
    run = export(program.with_name("v1.json"), "--format", form, "--output", out, *more, layout=layout)
    assert run.returncode == 0, run.stderr
    return out


def flashed(program: Path, out: Path, memory: Mapping[int, bytes]) -> Path:
    """A copy of a program with bytes written at these addresses."""
    content = bytearray(program.read_bytes())
    with program.open("rb") as file:
        elf = ELFFile(file)
        for address, data in memory.items():
            (at,) = elf.address_offsets(address, len(data))
            content[at : at + len(data)] = data
    out.write_bytes(content)
    out.chmod(0o755)
    return out


def test_hex_flashed_into_a_program_gives_the_right_correction(vehicles: tuple[Path, Checked], tmp_path: Path) -> None:
    program, checked = vehicles
    with pytest.raises(ValueError, match="C core"):
        check_frames(checked, program, Random(1), 1_000)
    file = bincopy.BinFile(str(written(vehicles, "hex", tmp_path / "v1.hex")))
    memory = {segment.address: bytes(segment.data) for segment in file.segments}
    assert check_frames(checked, flashed(program, tmp_path / "flashed", memory), Random(1), 20_000) > 5_000


@pytest.mark.parametrize("form", ["dcm", "cdfx"])
def test_dcm_and_cdfx_flashed_at_the_addresses_of_the_a2l_give_the_right_correction(
    form: str, vehicles: tuple[Path, Checked], tmp_path: Path
) -> None:
    program, checked = vehicles
    file, a2l = written(vehicles, form, tmp_path / "values"), written(vehicles, "a2l", tmp_path / "core.a2l")
    values = by_dcm_reader(file) if form == "dcm" else by_xml(file)
    memory = {}
    with A2lParser() as parser:
        (module,) = parser.tree_from_a2l(a2l.read_bytes()).PROJECT.MODULE
    methods = {item.Name.Value: item for item in module.COMPU_METHOD}
    layouts = {item.Name.Value: item.FNC_VALUES.DataType.Value for item in module.RECORD_LAYOUT}
    assert module.MOD_COMMON.BYTE_ORDER.ByteOrder == "MSB_LAST"
    for item in module.CHARACTERISTIC:
        value = values[item.Name.Value]
        assert item.LowerLimit.Value <= value <= item.UpperLimit.Value
        method, signed = methods[item.Conversion.Value], layouts[item.Deposit.Value] == "A_INT64"
        factor = int(method.COEFFS.B.Source) if method.ConversionType == "RAT_FUNC" else 1
        memory[item.Address.Value] = round(Fraction(value) * factor).to_bytes(8, "little", signed=signed)
    assert len(memory) == 1 + 4 * 14 + 2, "four numbers of each branch, five of a power"
    assert check_frames(checked, flashed(program, tmp_path / "flashed", memory), Random(1), 20_000) > 5_000


def by_dcm_reader(file: Path) -> dict[str, float]:
    reader = DcmReader()
    reader.read(str(file))
    return {item.name: item.value for item in reader.get_parameters()}


def by_xml(file: Path) -> dict[str, float]:
    found = {}
    for item in ET.fromstring(file.read_bytes()).iter("SW-INSTANCE"):
        text = item.findtext(".//V") or {"true": "1", "false": "0"}.get(item.findtext(".//VT", ""), "")
        if item.findtext("CATEGORY") != "ASCII":
            found[item.findtext("SHORT-NAME", "")] = float(text)
    return found


def test_a2l_is_the_same_for_all_vehicles_of_a_layout(vehicles: tuple[Path, Checked], tmp_path: Path) -> None:
    program, checked = vehicles
    layout, more = checked.database.layout.path, ("--format", "a2l", "--elf", program)
    export(program.with_name("none.json"), *more, "--output", tmp_path / "none.a2l", layout=layout)
    text = written(vehicles, "a2l", tmp_path / "v1.a2l").read_text()
    assert (tmp_path / "none.a2l").read_text() == text


@pytest.mark.parametrize("address", [0, 0xFFF0, 0x00FF_FFF0, 0x8000_FFF1, (1 << 32) - 656])
def test_hex_file_holds_data_at_any_32_bit_address_and_is_refused_beyond(address: int) -> None:
    data = Random(1).randbytes(656)
    file = bincopy.BinFile()
    file.add(intel_hex(address, data))
    assert (file.minimum_address, bytes(file.as_binary())) == (address, data)
    with pytest.raises(ExportError, match="HEX reaches to 0xFFFFFFFF"):
        intel_hex((1 << 32) - 100, data)


def test_image_for_big_endian_units_has_its_64_bit_words_reversed(vehicles: tuple[Path, Checked]) -> None:
    little, big = (image_bytes(vehicles[1], order) for order in ("little", "big"))
    assert b"".join(little[at : at + 8][::-1] for at in range(0, len(little), 8)) == big


def test_program_without_a_matching_calibration_symbol_is_refused(
    vehicles: tuple[Path, Checked], make_database: MakeDatabase, tmp_path: Path
) -> None:
    program, checked = vehicles
    (tmp_path / "text").write_text("no ELF")
    cases = [
        (tmp_path / "none", "none: cannot be read: No such file or directory"),
        (tmp_path / "text", "text: cannot be read: it is no ELF file: Magic number does not match"),
        (program.with_name("hv_correction.o"), r"hv_correction\.o: has no symbol hv_calibration; link the core"),
        (program.with_name("hv_calibration.o"), r"hv_calibration\.o: has no fixed addresses \(ET_REL"),
    ]
    for elf, message in cases:
        with pytest.raises(ExportError, match=message):
            find_image(elf, checked.database)
    assert find_image(program, checked.database).order == "little"
    with pytest.raises(ExportError, match=r"driver: was compiled with another layout, or with the hv_correction\.h of"):
        find_image(program, make_database())


def test_numbers_with_more_digits_than_tools_have_are_refused(make_database: MakeDatabase, tmp_path: Path) -> None:
    dbc = Path(make_database().layout.dbc_path).read_text().replace("[-3000|3000]", "[-0.3|0.3]")
    database = make_database(dbc=dbc)
    write_parameters(parameters_for(database, battery=(0.051, 0.0)), tmp_path / "v1.json")
    said = refused(tmp_path / "v1.json", "--format", "dcm", "--output", tmp_path / "x", layout=database.layout.path)
    assert re.search("branch battery: gain has more digits than .* --format hex", said)
