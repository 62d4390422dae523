#!/usr/bin/env python3
"""Recordings of a BMW i3 (CSV) as drives, and as CAN logs where asked. Each trip counts as a vehicle of its own."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from calibrator.drives.plain_names import require_plain_name
from calibrator.drives.store import has_drive, write_drive
from calibrator.errors import LogError
from calibrator.files.folders import require_possible_folder
from calibrator.recordings.bmw_i3 import BRANCHES, INPUTS, ImportedTrip, trip_from_table
from calibrator.recordings.drive_log import write_drive_log
from calibrator.recordings.signal_range import signal_ranges
from calibrator.recordings.tables import read_table
from calibrator.terminal.command_line import command_app, run_tool
from calibrator.terminal.progress import shown
from calibrator.terminal.text import told_once
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import LayoutError, UserError
from ecu_node.failures import say_error
from ecu_node.layout import read_layout
from ecu_node.standard_output import write_output, write_text

_SUFFIXES = (".csv", ".csv.gz")


app = command_app()


@app.command()
def main(
    *,
    csv: Annotated[list[Path], typer.Argument(help="CSV files (.csv, .csv.gz), or folders of them.")],
    layout: Annotated[Path, typer.Option(help="Layout with the branches battery, motor and auxiliary.")],
    out: Annotated[Path, typer.Option(help="Drive store to write to; trips that it has stay as they are.")],
    logs: Annotated[Path | None, typer.Option(help="Write CAN logs into this folder too: VEHICLE/TRIP.log.gz.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the account as JSON.")] = False,
) -> None:
    """Turn recordings of a BMW i3 into drives; each file becomes a vehicle named after it."""
    account = Account()
    try:
        for folder in (out, logs):
            if folder is not None:
                require_possible_folder(folder)
        database = read_database(read_layout(layout))
        _require_names(database)
        trips = _trips(csv)
        for name, paths in shown(trips.items(), "import", len(trips), "trips"):
            try:
                trip = _import_trip(name, paths, database, out, logs)
            except UserError as error:
                account.failed[name] = str(error)
            else:
                account.take(name, trip)
    except UserError as error:
        account.failed[""] = str(error)
    _print_account(account, as_json=as_json)
    raise typer.Exit(1 if account.failed else 0)


@dataclass(kw_only=True)
class Account:
    """What became of each trip."""

    done: dict[str, ImportedTrip] = field(default_factory=dict)
    already_there: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)

    def take(self, name: str, trip: ImportedTrip | None) -> None:
        """Count a trip that was imported now, or before (None)."""
        if trip is None:
            self.already_there.append(name)
        else:
            self.done[name] = trip


def _require_names(database: VehicleDatabase) -> None:
    layout = database.layout
    missing = [name for name in BRANCHES if name not in layout.branch_names]
    missing += [name for name in INPUTS if name not in {item.name for item in layout.input}]
    if missing:
        raise LayoutError(f"{layout.path}: no branch or input named {', '.join(missing)}; use dbc/hv_powertrain.toml")


def _trips(arguments: Iterable[Path]) -> dict[str, list[Path]]:
    """Files by the name of the trip; more than one file is an error of that trip."""
    trips: dict[str, list[Path]] = {}
    for argument in arguments:
        found = sorted(p for p in argument.iterdir() if p.name.endswith(_SUFFIXES)) if argument.is_dir() else [argument]
        if not found:
            raise LogError(f"{argument}: no CSV files in this folder; expected {' or '.join(_SUFFIXES)}")
        for path in found:
            paths = trips.setdefault(path.name.removesuffix(".gz").removesuffix(".csv"), [])
            if path.resolve() not in [other.resolve() for other in paths]:
                paths.append(path)
    return trips


def _import_trip(
    name: str, paths: list[Path], database: VehicleDatabase, out: Path, logs: Path | None
) -> ImportedTrip | None:
    """Import what is missing of drive and log; None if nothing is."""
    if len(paths) > 1:
        raise LogError(f"two files for one trip: {' and '.join(map(str, paths))}; remove or rename one")
    require_plain_name(name, f"{paths[0]}: the file's name, which names the trip,")
    log = None if logs is None else logs / name / f"{name}.log.gz"
    in_store = has_drive(out, name, name, database.layout)
    if in_store and (log is None or log.exists()):
        return None
    trip = trip_from_table(read_table(paths[0]), vehicle=name, name=name, ranges=signal_ranges(database))
    if not in_store:
        write_drive(out, trip.drive, database.layout)
    if log is not None and not log.exists():
        _write_log(log, trip, database)
    return trip


def _write_log(path: Path, trip: ImportedTrip, database: VehicleDatabase) -> None:
    try:
        write_drive_log(path, trip.drive, database)
    except OSError as error:
        raise LogError(f"{path}: cannot write the log: {error.strerror}; choose another --logs") from None


def _print_account(account: Account, *, as_json: bool) -> None:
    done, failed = account.done, account.failed
    duration_h = sum(trip.drive.duration_s for trip in done.values()) / 3600.0
    if as_json:
        values = {
            "drives": {
                name: {"duration_s": trip.drive.duration_s, "notices": trip.notices} for name, trip in done.items()
            },
            "already_there": account.already_there,
            "failed": failed,
        }
        write_output(json.dumps(values, indent=2))
    else:
        lines = told_once((name, notice) for name, trip in done.items() for notice in trip.notices)
        summary = (
            f"{len(done)} trips imported, {duration_h:.1f} h; {len(account.already_there)} already there; "
            f"{len(failed)} left out"
        )
        origin = "motor is minus the sum of battery and auxiliary: not independent of the battery's sensor"
        write_text("\n".join([*lines, summary, origin]))
    for text in failed.values():
        say_error(f"import_bmw_i3: {text}")


if __name__ == "__main__":
    run_tool(app, "import_bmw_i3")
