"""The source file of the C export: one function per branch, per message, and per voltage."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping

from calibrator.errors import ExportError
from calibrator.export import c_helpers
from calibrator.export.c_arithmetic import Arithmetic, arithmetic_of, is_no_value, outcome
from calibrator.export.c_bits import literal, presence_function, put_function, reading_function
from calibrator.export.c_header import branch_prototype, input_prototype, message_prototype
from calibrator.export.c_model import CBranch, CInput, CMessage, CProgram
from ecu_node.core.signals import BitPlace

__all__ = ["source_body"]

_LONGEST_CODE = 64
"""[bit]"""
_DEFINED = re.compile(r"^(?:static )?\w+ (\w+)\(", re.MULTILINE)
"""Begin of a function."""


def source_body(program: CProgram) -> str:
    """Write the functions.

    Parameters
    ----------
    program : CProgram
        What they do.

    Returns
    -------
    str
        What follows the includes.

    Raises
    ------
    ExportError
        If a signal is too wide for exact arithmetic, naming it, or two things would have one name.
    """
    corrected = {branch.name: arithmetic_of(branch) for branch in program.branches if branch.plan is not None}
    blocks = [text.rstrip() for text in _helpers(program, corrected)]
    for branch in program.branches:
        if branch.plan is not None:
            blocks += _bit_functions(branch)
        blocks.append("\n".join(_branch_function(branch, corrected.get(branch.name))))
    blocks += ["\n".join(_message_function(message)) for message in program.messages]
    for item in program.inputs:
        blocks.append("\n".join(reading_function(f"input_{item.name}", item.placed.place)))
        blocks.append("\n".join(presence_function(f"present_input_{item.name}", item.placed)))
        blocks.append("\n".join(_input_function(item)))
    text = "\n\n".join(blocks) + "\n"
    _require_own_names(text)
    return text


def _require_own_names(text: str) -> None:
    """Refuse names of branches and signals of which two functions would have one name."""
    names = Counter(_DEFINED.findall(text))
    name, times = names.most_common(1)[0]
    if times > 1:
        raise ExportError(f"{name}: two things would have this name in C; rename a branch, or a signal in the DBC")


def _helpers(program: CProgram, corrected: Mapping[str, Arithmetic]) -> Iterator[str]:
    wide = any(item.wide for item in corrected.values())
    if wide or any(place.length == _LONGEST_CODE for place in _places_read(program)):
        yield c_helpers.AS_SIGNED
    if corrected:
        yield c_helpers.CLAMP
    if not all(item.wide for item in corrected.values()):
        yield c_helpers.FLOOR_SHIFT
    if wide:
        yield c_helpers.WIDE


def _places_read(program: CProgram) -> Iterator[BitPlace]:
    corrected = [branch.placed for branch in program.branches if branch.plan is not None]
    for signal in [*corrected, *(item.placed for item in program.inputs)]:
        yield signal.place
        yield from (item.place for item in signal.above)


def _bit_functions(branch: CBranch) -> Iterator[str]:
    place = branch.placed.place
    yield "\n".join(presence_function(f"present_{branch.name}", branch.placed))
    yield "\n".join(reading_function(f"measured_{branch.name}", place))
    yield "\n".join(put_function(f"put_{branch.name}", place))


def _branch_function(branch: CBranch, arithmetic: Arithmetic | None) -> Iterator[str]:
    yield branch_prototype(branch)
    yield "{"
    needs_voltage = branch.plan is not None and branch.plan.needs_voltage
    if branch.voltage is not None and not needs_voltage:
        yield "    (void)voltage_code;"
    if branch.plan is None or arithmetic is None:
        yield "    return code;"
    else:
        yield from _return_unless_value("code", is_no_value("code", branch.codes))
        if branch.voltage is not None and needs_voltage:
            yield from _return_unless_value("voltage_code", is_no_value("voltage_code", branch.voltage.codes))
        text = outcome(branch.plan, wide=arithmetic.wide, with_voltage=branch.voltage is not None)
        yield f"    return clamp({text},\n        {literal(arithmetic.lowest)}, {literal(arithmetic.highest)});"
    yield "}"


def _return_unless_value(name: str, condition: str) -> Iterator[str]:
    yield f"    if ({condition}) {{"
    yield f"        return code; /* {name} is no value */"
    yield "    }"


def _message_function(item: CMessage) -> Iterator[str]:
    corrected = [branch for branch in item.branches if branch.plan is not None]
    used = {branch.voltage.name for branch in corrected if branch.voltage is not None}
    yield message_prototype(item)
    yield "{"
    if corrected:
        yield "    bool changed = false;"
    else:
        yield "    (void)payload;"
        yield "    (void)length;"
    for branch in corrected:
        name, more = branch.name, "" if branch.voltage is None else f", {branch.voltage.name}_code"
        yield f"    const bool there_{name} = present_{name}(payload, length);"
        yield f"    const int64_t from_{name} = there_{name} ? measured_{name}(payload) : 0;"
        yield f"    const int64_t to_{name} = there_{name} ? hv_correct_{name}(from_{name}{more}) : 0;"
    yield ""
    yield from (f"    (void){other.name}_code;" for other in item.inputs if other.name not in used)
    for branch in corrected:
        yield f"    if (to_{branch.name} != from_{branch.name}) {{"
        yield f"        put_{branch.name}(payload, to_{branch.name});"
        yield "        changed = true;"
        yield "    }"
    yield f"    return {'changed' if corrected else 'false'};"
    yield "}"


def _input_function(item: CInput) -> Iterator[str]:
    yield input_prototype(item)
    yield "{"
    yield f"    if (!present_input_{item.name}(payload, length)) {{"
    yield "        return false;"
    yield "    }"
    yield f"    *code = input_{item.name}(payload);"
    yield "    return true;"
    yield "}"
