"""``calibrator export``: from parameter files to files of other formats, each written whole or not at all."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrator.errors import ContradictionError, ExportError
from calibrator.export.c99 import c99_files
from calibrator.export.cdfx import cdfx_document
from calibrator.export.checked import Checked, read_checked
from calibrator.export.csv_table import csv_text
from calibrator.export.dcm import dcm_text
from calibrator.files.folders import require_possible_file, require_possible_folder
from calibrator.files.whole_files import made_folder, remove_abandoned, require_own_file, write_files
from calibrator.options import ExportFormat
from calibrator.terminal.options import JsonOption, LayoutOption
from calibrator.terminal.progress import shown
from calibrator.terminal.text import dumps
from ecu_node.database import node_database
from ecu_node.errors import printable
from ecu_node.program import say_error, write_output

__all__ = ["export", "exported_files"]


def export(
    params: Annotated[list[Path], typer.Argument(help="Parameter file, signed or not; of several vehicles for csv.")],
    layout: LayoutOption,
    format_: Annotated[ExportFormat, typer.Option("--format", help="What to write.")],
    output: Annotated[Path, typer.Option("--output", "--out", help="File to write; for c99 a folder.")],
    vehicle: Annotated[str | None, typer.Option("--vehicle", help="Refuse parameters of another vehicle.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace files that exist.")] = False,
    json: JsonOption = False,
) -> None:
    """Take parameters to other tools, and to control units without Python.

    dcm (DCM 2.0) and cdfx (ASAM CDF 2.0) are for calibration tools, csv is one row per branch, and c99 a header and a
    source that correct as 'ecu-node run' does as a gateway. Parameters that the node would not apply are refused.
    """
    database = node_database(layout)
    reading = shown(params, "read parameters", len(params), "files") if len(params) > 1 else params
    tables = [read_checked(path, database, vehicle) for path in reading]
    files = exported_files(tables, format_, output)
    is_folder = format_ is ExportFormat.C99
    _require_possible(files, output, is_folder=is_folder, replace=replace)
    with made_folder(output if is_folder else output.parent):
        remove_abandoned(files)
        write_files(files)
    notices = [text for checked in tables for text in checked.notices()]
    if json:
        write_output(dumps({"format": format_.value, "files": list(map(str, files)), "notices": notices}))
        return
    for text in notices:
        say_error(f"notice: {text}")
    write_output("\n".join(printable(str(path)) for path in files))


def exported_files(tables: Sequence[Checked], format_: ExportFormat, output: Path) -> dict[Path, bytes]:
    """Make the files of one export.

    Parameters
    ----------
    tables : sequence of Checked
        Parameter files.
    format_ : ExportFormat
        What to make of them.
    output : Path
        File to write; the folder for C99.

    Returns
    -------
    dict of Path to bytes
        Contents by file.

    Raises
    ------
    ContradictionError
        If a format of one vehicle is given several, or a table the same parameters twice.
    ExportError
        If the parameters cannot be written in the format.
    LayoutError, DatabaseError
        If the node refuses layout or DBC as a gateway; C99 alone.
    """
    if format_ is ExportFormat.CSV:
        _require_different(tables)
        return {output: csv_text(tables).encode()}
    if len(tables) != 1:
        raise ContradictionError(
            f"{len(tables)} parameter files: {format_.value} holds one vehicle; call it for each, or use --format csv"
        )
    (checked,) = tables
    match format_:
        case ExportFormat.DCM:
            return {output: dcm_text(checked).encode()}
        case ExportFormat.CDFX:
            return {output: cdfx_document(checked)}
        case ExportFormat.C99:
            return {output / name: text.encode() for name, text in c99_files(checked).items()}


def _require_different(tables: Sequence[Checked]) -> None:
    seen: dict[bytes, Checked] = {}
    for checked in tables:
        other = seen.setdefault(msgspec.json.encode(checked.parameters), checked)
        if other is not checked:
            raise ContradictionError(
                f"{printable(checked.name)}: says the same as {printable(other.name)}, so its rows would stand in the "
                f"table twice; give each parameter set once"
            )


def _require_possible(files: Mapping[Path, bytes], output: Path, *, is_folder: bool, replace: bool) -> None:
    """Refuse, before anything is written, files that hold something else or cannot be made."""
    for path, content in files.items():
        require_own_file(path)
        if path.exists() and not replace and path.read_bytes() != content:
            raise ExportError(f"{path}: exists; choose another --output, or replace it with --replace")
    if is_folder:
        require_possible_folder(output)
    else:
        require_possible_file(output)
