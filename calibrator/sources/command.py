"""``calibrator import``: logs become drives."""

from pathlib import Path
from typing import Annotated

import typer

from calibrator.errors import LogError
from calibrator.files.folders import require_possible_folder
from calibrator.files.layout_files import vehicle_database
from calibrator.files.storage import is_url
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import (
    TIME_LIMIT_S,
    JsonOption,
    LayoutOption,
    SchedulerOption,
    TimeLimitOption,
    WorkersOption,
)
from calibrator.terminal.text import end_if_internal, print_report

__all__ = ["import_"]


def import_(
    logs: Annotated[
        list[str], typer.Argument(help="Logs, or folders of them; a log's folder names its vehicle. Paths or URLs.")
    ],
    layout: LayoutOption,
    out: Annotated[str, typer.Option("--out", help="Drive store, path or URL; drives are added to one that exists.")],
    workers: WorkersOption = 2,
    scheduler: SchedulerOption = None,
    time_limit: TimeLimitOption = TIME_LIMIT_S,
    json: JsonOption = False,
) -> None:
    """Turn CAN logs of one or many vehicles into drives."""
    with importing():
        from calibrator.processes.run_many import Workers
        from calibrator.sources.import_logs import import_logs

    if not is_url(out):
        require_possible_folder(Path(out))
    where = Workers(processes=workers, scheduler=scheduler)
    report = import_logs(logs, vehicle_database(layout), out, workers=where, limit_s=time_limit)
    print_report(report, json=json)
    end_if_internal(report.left_out)
    if not report.drives and not report.already_there:
        raise LogError(f"none of the logs could be used, for the reasons given above; {out} was not changed")
