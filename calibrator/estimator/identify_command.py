"""``calibrator identify``: the filter bank that a fleet's vehicles share."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from calibrator.files.folders import require_possible_file
from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import BankOption, FleetArgument, JsonOption, LayoutOption, WorkersOption
from calibrator.terminal.text import print_report
from ecu_node.user_files import write_atomically

__all__ = ["identify"]

SHORTEST_POLE_S, LONGEST_POLE_S = 0.01, 600.0
"""Time constants of low-passes: from below the time base of any layout to ten minutes. [s]"""
POLES_HELP = f"Low-passes to use: time constants with commas, each {SHORTEST_POLE_S:g} to {LONGEST_POLE_S:g} [s]."


def _time_constants_s(value: str) -> list[float]:
    """Read the option ``--poles``."""
    with suppress(ValueError):
        numbers = [float(number) for number in value.split(",")]
        if all(SHORTEST_POLE_S <= number <= LONGEST_POLE_S for number in numbers):  # nor is not-a-number
            return numbers
    expected = f"time constants with commas, each from {SHORTEST_POLE_S:g} to {LONGEST_POLE_S:g} s"
    raise typer.BadParameter(f"{value}: expected {expected}", param_hint="'--poles'")


def identify(
    fleet: FleetArgument,
    layout: LayoutOption,
    bank: BankOption = None,
    poles: Annotated[str | None, typer.Option("--poles", help=POLES_HELP)] = None,
    out: Annotated[Path | None, typer.Option("--out", help="File to write the filter bank to (JSON).")] = None,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Choose the filter bank that a fleet's vehicles share, and tell how well it simulates each of them.

    Without --bank or --poles it is chosen from some vehicles, by how well it simulates blocks of their drives that were
    held out.
    """
    if bank is not None and poles is not None:
        raise typer.BadParameter("a bank has its own poles; give --bank or --poles", param_hint="--poles")
    time_constants_s = [] if poles is None else _time_constants_s(poles)
    if out is not None:
        require_possible_file(out)
    with importing():
        from calibrator.estimator.fleet_identification import identify_fleet
        from calibrator.summaries.filter_bank import read_bank

    given = None if bank is None else read_bank(bank)
    report = identify_fleet(
        fleet, vehicle_database(layout), bank=given, time_constants_s=time_constants_s, workers=workers
    )
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, report.bank.to_json())
    print_report(report, json=json)
