"""``calibrator doctor``: what of a user's layout and logs can be used."""

import shutil
import sys
from pathlib import Path
from typing import Annotated

import typer

from calibrator.files.layout_files import chosen_layout
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import DbcOption, JsonOption, LayoutOption
from ecu_node.standard_output import write_output

__all__ = ["doctor"]


def doctor(
    layout: LayoutOption,
    log: Annotated[
        list[Path], typer.Option("--log", help="Log of the vehicle (.log .asc .blf .trc .mf4, also .gz); or several.")
    ],
    dbc: DbcOption = None,
    json: JsonOption = False,
) -> None:
    """Tell what of a layout and of logs can be used, what is wrong with it, and what to do.

    Looks at frames, gaps and values of every branch and input, and at the sum of the currents: inverted signs, slips of
    units, delays. Exit code 1 if there is an error among the findings.
    """
    with importing():
        from calibrator.doctor.examine import examine
        from calibrator.doctor.text import examination_json, examination_text

    found = examine(chosen_layout(layout, dbc), log)
    width = shutil.get_terminal_size().columns if sys.stdout is not None and sys.stdout.isatty() else None
    write_output(examination_json(found) if json else examination_text(found, width))
    if found.has_errors:
        raise typer.Exit(1)
