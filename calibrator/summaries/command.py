"""``calibrator summarise``: drives become summaries."""

from typing import Annotated

import typer

from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.processes.reading import TIME_LIMIT_S
from calibrator.terminal.options import (
    BankOption,
    BranchesOption,
    FleetArgument,
    JsonOption,
    LayoutOption,
    StoreOption,
    TimeLimitOption,
    WorkersOption,
)
from calibrator.terminal.text import print_report

__all__ = ["summarise"]

MAX_PARTS = 1024


def _part(value: str) -> str:
    number, slash, count = value.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count) <= MAX_PARTS):
        raise typer.BadParameter(f"{value}: expected I/N with 1 <= I <= N <= {MAX_PARTS}, such as 3/8")
    return value


PartOption = Annotated[
    str,
    typer.Option(
        "--part", metavar="I/N", callback=_part, help="Part I of N of the vehicles, where N machines share the work."
    ),
]


def summarise(
    fleet: FleetArgument,
    layout: LayoutOption,
    out: StoreOption,
    branches: BranchesOption = None,
    bank: BankOption = None,
    part: PartOption = "1/1",
    workers: WorkersOption = 2,
    time_limit: TimeLimitOption = TIME_LIMIT_S,
    json: JsonOption = False,
) -> None:
    """Reduce drives to what the calibration needs of them: second moments, a few kilobytes per vehicle."""
    with importing():
        from calibrator.summaries.filter_bank import read_bank
        from calibrator.summaries.summarise_fleet import summarise_fleet

    report = summarise_fleet(
        fleet,
        vehicle_database(layout),
        out,
        branches=tuple(branches.split(",")) if branches else None,
        bank=read_bank(bank) if bank is not None else None,
        workers=workers,
        time_limit_s=time_limit,
        part=numbered_part(part),
    )
    print_report(report, json=json)


def numbered_part(value: str) -> tuple[int, int]:
    """Number and count of ``I/N``."""
    number, _, count = value.partition("/")
    return int(number), int(count)
