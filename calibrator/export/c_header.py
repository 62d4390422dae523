"""The header of the C export: where it comes from, and a dozen lines of API."""

from collections.abc import Iterator

from calibrator.export.c_model import CBranch, CInput, CMessage, CProgram

__all__ = ["GUARD", "branch_prototype", "header_body", "input_prototype", "message_prototype"]

GUARD = "HV_CORRECTION_H"

_PREAMBLE = """\
/*
 * Correction of high-voltage current sensors in integers, for one vehicle.
 *
 * Written by 'calibrator export'; do not edit. C99 without floating point, heap, recursion or state: every function may
 * be called from any task. The results are those of 'ecu-node run' as a gateway, bit by bit.
 *
 * hv_rewrite_MESSAGE  writes the corrected codes into a payload in the place of the measured ones, and says whether a
 *                     bit has changed. Codes that are no values, and signals that the payload does not have, stay.
 * hv_correct_BRANCH   corrects one code; one that is no value comes back as it is.
 * hv_read_MESSAGE_SIGNAL
 *                     reads a voltage that others need. It returns true and writes the code if the payload has the
 *                     signal; else it returns false and leaves *code as it was, so that the code of the frame before
 *                     stays. Write HV_NO_CODE there yourself at the start, and when the last code
 *                     has become too old.
 *
 * End-to-end protection is NOT part of this. Check CRC and counter of a frame before, and write its CRC anew afterwards
 * where a bit has changed. Nor are the watch over the sum of the currents, time-outs, and the status message.
 */
"""


def header_body(program: CProgram) -> str:
    """Write the header between its guards.

    Parameters
    ----------
    program : CProgram
        What the functions do.

    Returns
    -------
    str
        Constants and prototypes.
    """
    blocks = [
        _PREAMBLE.rstrip(),
        "#include <stdbool.h>\n#include <stddef.h>\n#include <stdint.h>",
        "\n".join(_provenance(program)),
        "/* stands for a voltage of which no value is known */\n#define HV_NO_CODE INT64_MIN",
        *("\n".join(_message(message)) for message in program.messages),
        *("\n".join(_input(item)) for item in program.inputs),
    ]
    return "\n\n".join(blocks) + "\n"


def branch_prototype(branch: CBranch) -> str:
    """Prototype of the function of a branch, without semicolon."""
    more = ", int64_t voltage_code" if branch.voltage is not None else ""
    return f"int64_t hv_correct_{branch.name}(int64_t code{more})"


def message_prototype(item: CMessage) -> str:
    """Prototype of the function of a message, without semicolon."""
    more = "".join(f", int64_t {other.name}_code" for other in item.inputs)
    return f"bool hv_rewrite_{item.message.name}(uint8_t *payload, size_t length{more})"


def input_prototype(item: CInput) -> str:
    """Prototype of the function that reads a voltage, without semicolon."""
    return f"bool hv_read_{item.name}(const uint8_t *payload, size_t length, int64_t *code)"


def c_string(text: str) -> str:
    """Write a text as a string constant of plain ASCII; UTF-8, and whatever C might misread, as octal numbers."""
    plain = set(range(ord(" "), ord("~") + 1)) - set(b'"\\?')
    return '"' + "".join(chr(byte) if byte in plain else f"\\{byte:03o}" for byte in text.encode()) + '"'


def _provenance(program: CProgram) -> Iterator[str]:
    for name, value in program.checked.provenance.items():
        yield f"#define HV_{name.upper()} {f'{value}ULL' if name == 'parameter_set' else c_string(value)}"


def _message(item: CMessage) -> Iterator[str]:
    message = item.message
    kind = "extended identifier" if message.is_extended_frame else "identifier"
    yield f"/* {message.name}: {kind} 0x{message.frame_id:X}, {message.length} bytes */"
    yield f"#define HV_ID_{message.name} 0x{message.frame_id:X}UL"
    for branch in item.branches:
        what = "passes through" if branch.plan is None else "corrected"
        yield f"{branch_prototype(branch)}; /* {branch.signal}, {what} */"
    yield f"{message_prototype(item)};"


def _input(item: CInput) -> Iterator[str]:
    message = item.message
    kind = "extended identifier" if message.is_extended_frame else "identifier"
    yield f"/* {message.name}.{item.codes.name}: {kind} 0x{message.frame_id:X} */"
    yield f"{input_prototype(item)};"
