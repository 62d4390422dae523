"""``calibrator summarise`` makes summaries of drives; ``calibrator store`` shows what a store of them holds."""

from typing import Annotated

import typer

from calibrator.errors import FleetError
from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.terminal.command_line import example
from calibrator.terminal.options import (
    TIME_LIMIT_S,
    BankOption,
    BranchesOption,
    FleetArgument,
    JsonOption,
    LayoutOption,
    SchedulerOption,
    StoreOption,
    TimeLimitOption,
    WorkersOption,
)
from calibrator.terminal.text import counted, dumps, end_if_internal, print_report
from ecu_node.program import write_output

__all__ = ["store_app", "summarise"]

StoreArgument = Annotated[str, typer.Argument(help="Store of summaries, path or URL.")]
store_app = typer.Typer(no_args_is_help=True, help="Look at a store of summaries, check it, and tidy it up.")


def summarise(
    fleet: FleetArgument,
    layout: LayoutOption,
    out: StoreOption,
    branches: BranchesOption = None,
    bank: BankOption = None,
    workers: WorkersOption = 2,
    scheduler: SchedulerOption = None,
    time_limit: TimeLimitOption = TIME_LIMIT_S,
    json: JsonOption = False,
) -> None:
    """Reduce drives to what the calibration needs of them: second moments, some ten kilobytes per vehicle."""
    with importing():
        from calibrator.processes.run_many import Workers
        from calibrator.summaries.filter_bank import read_bank
        from calibrator.summaries.summarise_fleet import summarise_fleet
        from calibrator.summaries.summary_store import existing_store

    report = summarise_fleet(
        fleet,
        vehicle_database(layout),
        out,
        branches=tuple(branches.split(",")) if branches else None,
        bank=read_bank(bank) if bank is not None else None,
        workers=Workers(processes=workers, scheduler=scheduler),
        time_limit_s=time_limit,
    )
    print_report(report, json=json)
    end_if_internal(report.left_out)
    if not report.vehicles and existing_store(out).is_empty():
        raise FleetError(f"no vehicle could be summarised, for the reasons given above; {out} holds only these reasons")


@store_app.command(epilog=example("calibrator store info summaries"))
def info(store: StoreArgument, json: JsonOption = False) -> None:
    """Show the layout, branches and inputs of a store, how many vehicles, drives and hours it holds, and its size."""
    with importing():
        from calibrator.summaries.summary_store import look_at_store

    print_report(look_at_store(store), json=json)


@store_app.command(epilog=example("calibrator store check summaries"))
def check(store: StoreArgument, json: JsonOption = False) -> None:
    """Read a whole store; exit code 1 if something is damaged, or two vehicles share a recording."""
    with importing():
        from calibrator.summaries.summary_store import look_at_store

    report = look_at_store(store, whole=True)
    print_report(report, json=json)
    if report.faults:
        raise typer.Exit(1)


@store_app.command(epilog=example("calibrator store compact summaries"))
def compact(store: StoreArgument, json: JsonOption = False) -> None:
    """Merge the files of each bucket, which holds a part of the vehicles, into one."""
    with importing():
        from calibrator.summaries.summary_store import compact_store

    buckets = compact_store(store)
    facts = {"store": store, "buckets": buckets}
    write_output(dumps(facts) if json else f"{store}: {counted(buckets, 'bucket')} written anew")
