"""``calibrator export``: write a parameter file in another format, whole or not at all."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from calibrator.errors import ContradictionError, ExportError
from calibrator.export.core import (
    c_text,
    find_image,
    foreign_protection,
    image_bytes,
    intel_hex,
    read_checked,
)
from calibrator.export.tool_formats import a2l_text, cdfx_text, dcm_text
from calibrator.files.folders import require_possible_file, write_files
from calibrator.terminal.options import JsonOption, LayoutOption
from calibrator.terminal.text import dumps
from ecu_node.database import node_database
from ecu_node.errors import printable
from ecu_node.program import say_error, write_output

__all__ = ["export"]


class ExportFormat(StrEnum):
    """Formats to which parameters can be exported."""

    C = "c"
    HEX = "hex"
    A2L = "a2l"
    DCM = "dcm"
    CDFX = "cdfx"


def export(
    params: Annotated[Path, typer.Argument(help="Parameter file.")],
    layout: LayoutOption,
    format_: Annotated[ExportFormat, typer.Option("--format", help="What to write.")],
    output: Annotated[Path, typer.Option("--out", "--output", help="File to write.")],
    elf: Annotated[
        Path | None, typer.Option("--elf", help="The control unit's linked program, for hex and a2l.")
    ] = None,
    vehicle: Annotated[str | None, typer.Option("--vehicle", help="Refuse parameters of another vehicle.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace files that exist.")] = False,
    json: JsonOption = False,
) -> None:
    """Take parameters to other tools, and to control units without Python.

    For the C core that comes with ecu_node: c is what is compiled with it, hex the calibration of one vehicle to be
    flashed, a2l tells calibration tools where it stands. dcm (DCM 2.0) and cdfx (ASAM CDF 2.0) are for these tools.
    Parameters that the node would not apply are refused.
    """
    needs_elf = format_ in {ExportFormat.HEX, ExportFormat.A2L}
    if (elf is not None) != needs_elf:
        verb = "needs" if needs_elf else "takes no"
        raise ContradictionError(f"--format {format_.value} {verb} --elf PROGRAM; hex and a2l alone have one")
    database = node_database(layout)
    checked = read_checked(params, database, vehicle)
    image = find_image(elf, database) if elf is not None else None
    if format_ is ExportFormat.CDFX:
        content = cdfx_text(checked)
    elif format_ is ExportFormat.DCM:
        content = dcm_text(checked)
    elif image is None:
        content = c_text(checked)
    elif format_ is ExportFormat.A2L:
        content = a2l_text(database, image)
    else:
        content = intel_hex(image.address, image_bytes(checked, image.order))
    require_possible_file(output)
    if output.exists() and not replace and output.read_bytes() != content.encode():
        raise ExportError(f"{output}: exists; choose another --out, or replace it with --replace")
    write_files({output: content.encode()})
    notices = []
    if format_ is ExportFormat.C and (foreign := foreign_protection(database)):
        notices.append(
            f"the C core knows the E2E profiles P01 and P02: check {', '.join(foreign)} before hv_forward, and protect "
            f"them anew after it"
        )
    if json:
        write_output(dumps({"format": format_.value, "files": [str(output)], "notices": notices}))
        return
    for text in notices:
        say_error(f"notice: {text}")
    write_output(printable(str(output)))
