"""Data of the C core (``ecu_node/c/hv_correction.h``): the layout to be compiled and the calibration to be flashed.

The calibration holds the integers with which the node itself corrects, scaled so that all have 58 fractional bits
below one code. So the results are the same, bit by bit, and one conversion serves all gains. It is written as a C
struct, or as the memory image of that struct, at the address of ``hv_calibration`` in a compiled program, in Intel HEX.
"""

import json
import struct
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Literal, NamedTuple

from cantools.database.can import Message
from elftools.common.exceptions import ELFError
from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection

from calibrator.errors import ExportError
from calibrator.files.templates import templates_of
from ecu_node.bus.wiring import (
    InForce,
    Mode,
    branch_signals,
    key_of,
    received,
    rewritten,
    wire,
)
from ecu_node.core.correction import SensorFault, correction_plan
from ecu_node.core.signals import Codes, PlacedSignal, placed_signal, writable_range
from ecu_node.database import VehicleDatabase
from ecu_node.documents import text_digest
from ecu_node.errors import ParameterError, printable
from ecu_node.layout import Branch, ProfileP01, ProfileP02
from ecu_node.parameters import VehicleParameters, check_fit, decode_parameters, parameter_bytes

__all__ = [
    "FRACTION_BITS",
    "BranchValues",
    "Checked",
    "Image",
    "branch_values",
    "c_text",
    "find_image",
    "foreign_protection",
    "image_bytes",
    "intel_hex",
    "read_checked",
    "rendered",
    "scaled_plan",
]

FRACTION_BITS = 58
"""Fractional bits of the core's fixed-point numbers, its ``SHIFT``."""
_BRANCHES, _DATA_IDS = 16, 16
_SYMBOL = "hv_calibration"
_LEAST, _GREATEST = -(1 << 63), (1 << 63) - 1
_WIDE = 1 << 127
_RECORD_BYTES = 32


@dataclass(frozen=True, kw_only=True)
class Checked:
    """Parameters that were checked, and the layout and DBC that they fit.

    Attributes
    ----------
    name : str
        Name of the parameter file.
    digest : str
        SHA-256 of the file's text with LF as line ends, hexadecimal.
    parameters : VehicleParameters
        Content of the file.
    database : VehicleDatabase
        Layout and DBC for which it was made.
    """

    name: str
    digest: str
    parameters: VehicleParameters
    database: VehicleDatabase

    @property
    def provenance(self) -> dict[str, str]:
        """Where the parameters come from, under short names that are the same in all formats."""
        parameters = self.parameters
        return {
            "vehicle": parameters.vehicle,
            "parameter_set": str(parameters.number),
            "verdict": parameters.verdict,
            "tool": parameters.provenance.tool,
            "method": parameters.provenance.method,
            "created": parameters.provenance.created,
            "fleet": parameters.provenance.fleet,
            "parameters_sha256": self.digest,
            "layout_sha256": parameters.layout.sha256,
            "dbc_sha256": parameters.dbc.sha256,
        }


def read_checked(path: Path, database: VehicleDatabase, vehicle: str | None) -> Checked:
    """Read a parameter file and refuse what the node would not apply.

    Parameters
    ----------
    path : Path
        The file.
    database : VehicleDatabase
        Layout and DBC in use.
    vehicle : str or None
        Identity of the vehicle; None: not checked.

    Returns
    -------
    Checked
        The parameters, which fit layout and DBC.

    Raises
    ------
    ParameterError
        If the file cannot be read, or its parameters are for another vehicle, layout or DBC, or implausible.
    """
    content = parameter_bytes(path)
    parameters = decode_parameters(content, str(path))
    try:
        check_fit(parameters, database, vehicle)
    except ParameterError as error:
        raise ParameterError(f"{path}: {error}") from None
    return Checked(name=path.name, digest=text_digest(content), parameters=parameters, database=database)


class BranchValues(NamedTuple):
    """Numbers flashed for one branch, in the order of the C struct ``hv_values_t``, which explains them."""

    gain: int
    voltage_gain: int
    bias: int
    fraction: int
    applied: int


_PASSED = BranchValues(1 << FRACTION_BITS, 0, 0, 1 << (FRACTION_BITS - 1), 0)
"""Values of a branch that is passed through."""
_VALUES = "qqqQQ"
_BYTES = struct.calcsize(f"<QQ{_BRANCHES * _VALUES}")


def branch_values(database: VehicleDatabase, branch: Branch, fault: SensorFault) -> BranchValues:
    """Return the numbers with which the core corrects a branch as the node does in gateway mode.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    branch : Branch
        A branch of the layout.
    fault : SensorFault
        Gain error and offset to be corrected.

    Returns
    -------
    BranchValues
        The node's own integers, scaled to :data:`FRACTION_BITS`; they give the same result for every code.

    Raises
    ------
    ExportError
        If the numbers do not fit into the core's integers.
    """
    found, signals = scaled_plan(database, branch, fault), branch_signals(database, branch, Mode.GATEWAY)
    largest, numbers = (abs(found.bias) + 1) << FRACTION_BITS, [*found[:3]]
    for gain, codes in ((found.gain, signals.source), (found.voltage_gain, signals.voltage)):
        if fault.applied and codes is not None:
            numbers += [codes.lowest, codes.highest]
            largest += abs(gain) * max(abs(codes.lowest), abs(codes.highest))
    if largest >= _WIDE or not all(_LEAST <= number <= _GREATEST for number in numbers):
        raise _too_large(branch, signals.source)
    return found


def scaled_plan(database: VehicleDatabase, branch: Branch, fault: SensorFault) -> BranchValues:
    """Return the numbers of :func:`branch_values` without a check of their size.

    ExportError only if they need more fractional bits than the core has.
    """
    if not fault.applied:
        return _PASSED
    signals = branch_signals(database, branch, Mode.GATEWAY)
    plan = correction_plan(signals, fault)
    up = FRACTION_BITS - plan.shift
    if up < 0:
        raise _too_large(branch, signals.source)
    bias, fraction = divmod((plan.bias << up) + (1 << (FRACTION_BITS - 1)), 1 << FRACTION_BITS)
    return BranchValues(plan.gain << up, plan.voltage_gain << up, bias, fraction, 1)


def _too_large(branch: Branch, codes: Codes) -> ExportError:
    return ExportError(
        f"branch {branch.name}: signal {branch.source} has {codes.place.length} bits, and its correction does not fit "
        f"into the C core, which has {FRACTION_BITS} bits below one code and gains below {1 << (63 - FRACTION_BITS)}; "
        f"give the signal its true range in the DBC"
    )


def image_bytes(checked: Checked, order: Literal["little", "big"]) -> bytes:
    """Return the calibration as it is stored in the memory of a control unit.

    Parameters
    ----------
    checked : Checked
        The parameter file.
    order : "little" or "big"
        Byte order of the control unit.

    Raises
    ------
    LayoutError, DatabaseError
        If the node refuses layout or DBC in gateway mode.
    ExportError
        If a number does not fit into the core's integers, as in :func:`branch_values`.
    """
    values = [number for item in _all_values(checked) for number in item]
    head = (_layout_digest(checked.database), checked.parameters.number)
    mark = "<" if order == "little" else ">"
    used = struct.pack(f"{mark}QQ{len(values) // len(_VALUES) * _VALUES}", *head, *values)
    return used.ljust(_BYTES, b"\0")


def _all_values(checked: Checked) -> list[BranchValues]:
    """Return the numbers of all branches, in the order of the layout; raises as :func:`image_bytes` does."""
    database = checked.database
    wire(database, InForce(parameters=checked.parameters), start_s=0.0, mode=Mode.GATEWAY)
    return [branch_values(database, branch, checked.parameters.fault(branch.name)) for branch in database.layout.branch]


def _layout_digest(database: VehicleDatabase) -> int:
    """Return a number that ties a calibration to its layout and DBC; the text's 1 is the version of the C structs."""
    text = f"1 {database.layout.digest} {database.digest}"
    return int.from_bytes(sha256(text.encode()).digest()[:8])


class Image(NamedTuple):
    """Address and byte order of the calibration data (symbol ``hv_calibration``) in a compiled program."""

    address: int
    order: Literal["little", "big"]


def find_image(elf: Path, database: VehicleDatabase) -> Image:
    """Find the calibration in a compiled program.

    Parameters
    ----------
    elf : Path
        ELF file with symbols, linked with the core and a calibration.
    database : VehicleDatabase
        Layout and DBC with which the program must have been compiled.

    Returns
    -------
    Image
        Address and byte order of the calibration.

    Raises
    ------
    ExportError
        If the file cannot be read, is not linked, or has no calibration of this core and layout.
    """
    try:
        with elf.open("rb") as file:
            program = ELFFile(file)
            table = program.get_section_by_name(".symtab")
            symbols = (table.get_symbol_by_name(_SYMBOL) or []) if isinstance(table, SymbolTableSection) else []
            found = [(symbol["st_value"], symbol["st_size"]) for symbol in symbols if symbol["st_size"]]
            order: Literal["little", "big"] = "little" if program.little_endian else "big"
            places = [*program.address_offsets(*found[0])] if found else []
            file.seek(places[0] if places else 0)
            kind, compiled = program["e_type"], int.from_bytes(file.read(8), order)
    except (OSError, ELFError) as error:
        why = error.strerror if isinstance(error, OSError) else f"it is no ELF file: {error}"
        raise ExportError(f"{elf}: cannot be read: {why}; name the linked program (ELF)") from None
    if len(found) != 1:
        raise ExportError(
            f"{elf}: has no symbol {_SYMBOL}; link the core with a calibration ('--format c'), and do not strip it"
        )
    if kind != "ET_EXEC":
        raise ExportError(
            f"{elf}: has no fixed addresses ({kind}: an object file, or position independent); link it, on a computer "
            f"with -no-pie, and name the program"
        )
    ((address, size),) = found
    if size != _BYTES or compiled != _layout_digest(database):
        raise ExportError(
            f"{elf}: was compiled with another layout, or with the hv_correction.h of another version; write its "
            f"'--format c' anew and build it again, or give the layout that it was built with"
        )
    return Image(address=address, order=order)


def intel_hex(address: int, data: bytes) -> str:
    """Return data at an address as Intel HEX, in records of at most 32 bytes that cross no multiple of 32.

    ExportError if the data reach beyond the 32 bits of HEX addresses.
    """
    if address + len(data) > 1 << 32:
        raise ExportError(f"{_SYMBOL} stands at 0x{address:X}; HEX reaches to 0xFFFFFFFF, link it below")

    def record(kind: int, at: int, content: bytes) -> str:
        line = bytes([len(content)]) + at.to_bytes(2) + bytes([kind]) + content
        return f":{line.hex()}{-sum(line) & 0xFF:02x}\n".upper()

    text, above, start = "", -1, address
    while start < address + len(data):
        end = start + _RECORD_BYTES - start % _RECORD_BYTES
        if start >> 16 != above:
            above = start >> 16
            text += record(4, 0, above.to_bytes(2))
        text += record(0, start & 0xFFFF, data[start - address : end - address])
        start = end
    return text + record(1, 0, b"")


def foreign_protection(database: VehicleDatabase) -> list[str]:
    """Return the names of the received messages whose end-to-end protection the C core does not support."""
    entries = {message.name: database.layout.protection(message.name) for message in received(database).values()}
    return [name for name, entry in entries.items() if not isinstance(entry, ProfileP01 | ProfileP02 | None)]


def c_text(checked: Checked) -> str:
    """Return layout and calibration as C source, to be compiled with the core.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    str
        One source file, ASCII.

    Raises
    ------
    LayoutError, DatabaseError, ExportError
        In the cases of :func:`image_bytes`.
    """
    database, values = checked.database, _all_values(checked)
    messages, carriers = received(database), rewritten(database)
    numbers = {key: number for number, key in enumerate(messages)}

    def read(name: str, codes: Codes) -> tuple[int, PlacedSignal, Codes]:
        message, signal = database.signal(name)
        return numbers[key_of(message)], placed_signal(message, signal), codes

    branches = []
    for branch in database.layout.branch:
        signals, voltage = branch_signals(database, branch, Mode.GATEWAY), None
        if branch.voltage is not None and signals.voltage is not None:
            voltage = read(branch.voltage, signals.voltage)
        ends = writable_range(signals.target, branch.source)
        branches.append((branch, read(branch.source, signals.source), voltage, ends))
    unused = _BRANCHES - len(values)
    names = [*database.layout.branch_names, *["not used"] * unused]
    judged = {voltage[0] for _, _, voltage, _ in branches if voltage is not None}
    return rendered(
        "hv_calibration.c",
        provenance=checked.provenance,
        messages=[
            _message(database, message, key in carriers, numbers[key] in judged) for key, message in messages.items()
        ],
        branches=branches,
        calibration=zip(names, values + [BranchValues(0, 0, 0, 0, 0)] * unused, strict=True),
        digest=f"0x{_layout_digest(database):016X}",
        greatest=_GREATEST,
    )


def _message(database: VehicleDatabase, message: Message, has_branches: bool, has_voltage: bool) -> tuple[object, ...]:
    """Return the name of a message and the values of the fields of its C struct ``hv_message_t``."""
    entry, key = database.layout.protection(message.name), key_of(message)
    profile, offset, step, data_id, windows = "HV_UNPROTECTED", 0, 0, [0], [(0, 0, 0)] * 3
    if isinstance(entry, ProfileP01):
        profile, offset, step = f"HV_P01_{entry.data_id_mode.upper()}", entry.offset, entry.max_delta_counter
        data_id = [*entry.data_id.get(message.name, message.frame_id & 0xFFFF).to_bytes(2, "little")]
    elif isinstance(entry, ProfileP02):
        profile, step, data_id = "HV_P02", entry.max_delta_counter, entry.data_id_list[message.name]
    if isinstance(entry, ProfileP01 | ProfileP02) and has_voltage:
        windows = [(item.window, item.min_ok, item.max_error) for item in (entry.init, entry.valid, entry.invalid)]
    data_ids = data_id + [0] * (_DATA_IDS - len(data_id))
    return message.name, key.identifier | key.extended << 31, profile, offset, step, data_ids, has_branches, windows


def rendered(template: str, **values: object) -> str:
    """Return the text of a file of ``templates/`` with ``[[ name ]]`` replaced by values; braces are part of C."""
    braces = {"variable_start_string": "[[", "variable_end_string": "]]"}
    environment = templates_of("calibrator.export", autoescape=template.endswith(".cdfx"), **braces)
    environment.filters |= {"comment": _comment, "int64": _int64, "printable": printable}
    return environment.get_template(template).render(**values)


def _int64(number: int) -> str:
    return "INT64_MIN" if number == _LEAST else f"INT64_C({number})"


def _comment(text: str) -> str:
    """Change a text so that it neither ends nor begins a C comment."""
    return json.dumps(text)[1:-1].replace("*/", "*_/").replace("/*", "/_*")
