"""``calibrator import``: logs become drives."""

from pathlib import Path
from typing import Annotated

import typer

from calibrator.errors import LogError
from calibrator.files.folders import require_possible_folder
from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.processes.reading import TIME_LIMIT_S
from calibrator.terminal.options import JsonOption, LayoutOption, TimeLimitOption, WorkersOption
from calibrator.terminal.text import print_report

__all__ = ["import_"]


def import_(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or folders of them; a log's folder names its vehicle.")],
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Drive store to write to; drives are added to one that exists.")],
    workers: WorkersOption = 2,
    time_limit: TimeLimitOption = TIME_LIMIT_S,
    json: JsonOption = False,
) -> None:
    """Turn CAN logs of one or many vehicles into drives."""
    with importing():
        from calibrator.sources.import_logs import import_logs

    require_possible_folder(out)
    report = import_logs(logs, vehicle_database(layout), out, workers=workers, limit_s=time_limit)
    print_report(report, json=json)
    if not report.drives and not report.already_there:
        raise LogError(f"none of the logs could be used, for the reasons given above; {out} was not changed")
