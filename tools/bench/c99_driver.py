"""The C export as a program: it reads frames or codes, corrects them, and writes what came of them.

It stands between the exported functions and whoever compares them with the node, or counts their instructions.
"""

import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from struct import Struct

from cantools.database.can import Message

from calibrator.export.c99 import c99_files
from calibrator.export.c_model import CProgram, c_program
from calibrator.export.checked import Checked

__all__ = ["COMPILER", "FLAGS", "NO_CODE", "CompiledExport", "Frame", "compile_export"]

COMPILER = "gcc"
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic")
NO_CODE = -(1 << 63)
"""HV_NO_CODE."""

Frame = tuple[str, bytes]
"""Name of a message, and a payload."""

_MOST_BYTES = 64
_FRAME = Struct(f"<BB{_MOST_BYTES}s")
"""Message or flag "changed", length, payload."""
_CODES, _RESULT = Struct("=3q"), Struct("=q")
"""Branch, code, voltage code; corrected code."""

_MAIN = """\
#include "hv_correction.h"
#include <stdio.h>
#include <string.h>

{inputs}

static bool one_frame(unsigned int message, uint8_t *payload, size_t length)
{{
    switch (message) {{
{messages}
    default:
        return false;
    }}
}}

static int64_t one_code(const int64_t *given)
{{
    switch (given[0]) {{
{branches}
    default:
        return 0;
    }}
}}

int main(int count, char **arguments)
{{
    uint8_t frame[66];
    int64_t given[3];

    if (count > 1 && strcmp(arguments[1], "codes") == 0) {{
        while (fread(given, sizeof given, 1, stdin) == 1) {{
            const int64_t result = one_code(given);
            fwrite(&result, sizeof result, 1, stdout);
        }}
        return 0;
    }}
    while (fread(frame, sizeof frame, 1, stdin) == 1) {{
        frame[0] = one_frame(frame[0], frame + 2, frame[1]) ? 1U : 0U;
        fwrite(frame, sizeof frame, 1, stdout);
    }}
    return 0;
}}
"""


@dataclass(frozen=True, kw_only=True)
class CompiledExport:
    """An exported parameter file, compiled.

    Attributes
    ----------
    program : CProgram
        What it does.
    executable, object_file : Path
        The driver; the exported source alone.
    """

    program: CProgram
    executable: Path
    object_file: Path

    @property
    def messages(self) -> list[Message]:
        """Messages that it takes, in the order of their numbers."""
        return _messages(self.program)

    def frames(self, frames: Sequence[Frame]) -> list[tuple[bytes, bool]]:
        """Send frames through it.

        Parameters
        ----------
        frames : sequence of Frame
            In the order of their arrival.

        Returns
        -------
        list of tuple
            The payload of each, and whether the function said that it has changed.
        """
        found = _FRAME.iter_unpack(self.run(self.encode(frames)))
        return [(payload[:length], bool(changed)) for changed, length, payload in found]

    def encode(self, frames: Sequence[Frame]) -> bytes:
        """Frames as the program reads them."""
        numbers = {message.name: number for number, message in enumerate(self.messages)}
        return b"".join(_FRAME.pack(numbers[name], len(payload), payload) for name, payload in frames)

    def codes(self, branch: str, codes: Sequence[tuple[int, int]]) -> list[int]:
        """Correct codes of a branch, each with that of the voltage (:data:`NO_CODE`: none)."""
        number = [item.name for item in self.program.branches].index(branch)
        found = self.run(b"".join(_CODES.pack(number, *item) for item in codes), "codes")
        return [code for (code,) in _RESULT.iter_unpack(found)]

    def run(self, given: bytes, *arguments: str) -> bytes:
        """Run it, and return what it writes."""
        return subprocess.run([self.executable, *arguments], input=given, stdout=subprocess.PIPE, check=True).stdout


def compile_export(checked: Checked, folder: Path, *, flags: Sequence[str] = ("-O2",)) -> CompiledExport:
    """Export a parameter file as C and compile it with all warnings as errors.

    Parameters
    ----------
    checked : Checked
        The parameter file.
    folder : Path
        For everything.
    flags : sequence of str
        Of the compiler, beside :data:`FLAGS`.

    Returns
    -------
    CompiledExport
        Ready for frames.

    Raises
    ------
    UserError
        If it cannot be exported.
    """
    program = c_program(checked)
    for name, text in c99_files(checked).items():
        (folder / name).write_text(text)
    (folder / "main.c").write_text(_driver(program))
    compiler = [shutil.which(COMPILER) or COMPILER, *FLAGS, *flags, "-g"]
    object_file, executable = folder / "hv_correction.o", folder / "driver"
    subprocess.run([*compiler, "-c", folder / "hv_correction.c", "-o", object_file], check=True)
    subprocess.run([*compiler, folder / "main.c", object_file, "-o", executable], check=True)
    return CompiledExport(program=program, executable=executable, object_file=object_file)


def _messages(program: CProgram) -> list[Message]:
    found = [item.message for item in program.messages] + [item.message for item in program.inputs]
    return list({message.name: message for message in found}.values())


def _driver(program: CProgram) -> str:
    inputs = [f"static int64_t {item.name}_code = HV_NO_CODE;" for item in program.inputs]
    return _MAIN.format(
        inputs="\n".join(inputs),
        messages="\n".join(_message_cases(program)),
        branches="\n".join(_branch_cases(program)),
    )


def _message_cases(program: CProgram) -> Iterator[str]:
    rewritten = {item.message.name: item for item in program.messages}
    for number, message in enumerate(_messages(program)):
        yield f"    case {number}:"
        for item in program.inputs:
            if item.message.name == message.name:
                yield f"        (void)hv_read_{item.name}(payload, length, &{item.name}_code);"
        if message.name in rewritten:
            more = "".join(f", {item.name}_code" for item in rewritten[message.name].inputs)
            yield f"        return hv_rewrite_{message.name}(payload, length{more});"
        else:
            yield "        return false;"


def _branch_cases(program: CProgram) -> Iterator[str]:
    for number, branch in enumerate(program.branches):
        yield f"    case {number}:"
        yield f"        return hv_correct_{branch.name}(given[1]{'' if branch.voltage is None else ', given[2]'});"
