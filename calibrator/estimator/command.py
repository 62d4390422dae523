"""``calibrator calibrate``, ``params`` and ``identify``: parameter files of a fleet or junction, and a filter bank."""

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from calibrator.estimator.settings import Method
from calibrator.files.folders import require_possible_file, require_possible_folder, write_files
from calibrator.files.layout_files import vehicle_database
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import (
    TIME_LIMIT_S,
    BranchesOption,
    FleetArgument,
    FleetOrSummariesArgument,
    JsonOption,
    LayoutOption,
    SchedulerOption,
    TimeLimitOption,
    WorkersOption,
    given_options,
    number_option,
)
from calibrator.terminal.text import dumps, end_if_internal, print_report
from ecu_node.layout import UnmeasuredLoad
from ecu_node.program import say_error, write_output

__all__ = ["calibrate", "identify", "params"]

OF_POSTERIOR = ("harm_limit", "trusted", "readings", "load", "charge", "meter", "expected_faults", "scheduler", "since")
"""Options that only the posterior method uses."""


def calibrate(
    context: typer.Context,
    fleet: FleetOrSummariesArgument,
    layout: LayoutOption,
    out: Annotated[Path, typer.Option("--out", help="Folder of the result, new or empty.")],
    method: Annotated[Method, typer.Option("--method", help="Estimator.")] = Method.POSTERIOR,
    harm_limit: Annotated[
        float, number_option("--harm-limit", 0, 1, "Correct a branch if harm is less probable (posterior)")
    ] = 0.001,
    trusted: Annotated[
        list[str] | None,
        typer.Option(
            "--trusted",
            metavar="NAME",
            help="Vehicles with bench-checked sensors, three carry the reference; or branches whose sensor is right: "
            "each vehicle is then calibrated by itself (posterior).",
        ),
    ] = None,
    readings: Annotated[
        Path | None,
        typer.Option(
            "--readings",
            help="Bench readings: CSV with columns vehicle, branch, drift, drift_sd, offset_a, offset_sd_a "
            "(posterior).",
        ),
    ] = None,
    load: Annotated[
        str | None,
        typer.Option(
            "--load", metavar="A[:SD]", help="Load that no branch measures, and its standard deviation [A] (posterior)."
        ),
    ] = None,
    charge: Annotated[
        list[str] | None,
        typer.Option(
            "--charge",
            metavar="BRANCH=AH:SD",
            help="Charge into the junction through a branch over the recordings of one vehicle [Ah] (posterior).",
        ),
    ] = None,
    meter: Annotated[
        str | None,
        typer.Option(
            "--meter",
            metavar="BRANCH",
            help="Branch with another sensor in each folder of one car's recordings, such as a charger (posterior).",
        ),
    ] = None,
    expected_faults: Annotated[
        float | None,
        number_option("--expected-faults", 0, 1, "Share of vehicles with a sensor fault, if known (posterior)"),
    ] = None,
    branches: BranchesOption = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option("--hold-out", metavar="NAME", help="Vehicle to calibrate, but to learn nothing from for others."),
    ] = None,
    workers: WorkersOption = 2,
    scheduler: SchedulerOption = None,
    since: Annotated[
        Path | None,
        typer.Option("--since", help="Earlier result: vehicles without new drives keep its parameters (posterior)."),
    ] = None,
    time_limit: TimeLimitOption = TIME_LIMIT_S,
    json: JsonOption = False,
) -> None:
    """Estimate the sensor faults of every vehicle and write its parameter file.

    The default method, posterior, says how sure it is and corrects a branch only if that is unlikely to make it worse.
    The published method is kept as a reference.
    """
    with importing():
        from calibrator.estimator.results import left_out_of
        from calibrator.estimator.run import calibrate_fleet
        from calibrator.estimator.settings import CalibrationSettings
        from calibrator.processes.run_many import Workers

    if method is Method.PUBLISHED and (given := given_options(context, OF_POSTERIOR)):  # it would be ignored
        raise typer.BadParameter(
            "belongs to --method posterior, not published; leave it out or change the method", param_hint=given[0]
        )
    settings = CalibrationSettings(
        method=method,
        harm_limit=harm_limit,
        trusted=_named(trusted),
        readings=readings,
        load=None if load is None else _load(load),
        charge_ah=_charges(charge or ()),
        meter=meter,
        expected_faults=expected_faults,
        branches=tuple(branches.split(",")) if branches else None,
        hold_out=_named(hold_out),
        time_limit_s=time_limit,
    )
    where = Workers(processes=workers, scheduler=scheduler)
    report = calibrate_fleet(fleet, vehicle_database(layout), out, settings, workers=where, since=since)
    print_report(report, json=json)
    end_if_internal(left_out_of(out))
    say_error(f"next: calibrator report {shlex.quote(str(out))}")


def params(
    result: Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")],
    vehicles: Annotated[list[str], typer.Argument(help="Vehicles.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for VEHICLE.json; files of that name are replaced.")],
    json: JsonOption = False,
) -> None:
    """Write the parameter files of some vehicles; the result of a large fleet has no file for each vehicle."""
    with importing():
        from calibrator.estimator.results import written_of

    texts = {vehicle: written_of(result, vehicle).text for vehicle in vehicles}
    require_possible_folder(out)
    files = {vehicle: str(out / f"{vehicle}.json") for vehicle in texts}
    write_files({Path(files[vehicle]): text for vehicle, text in texts.items()})
    write_output(dumps({"files": files}) if json else "\n".join(files.values()))


def _named(values: list[str] | None) -> frozenset[str]:
    """Return the names given by an option several times, or once with commas; no name has a comma."""
    return frozenset(name.strip() for value in values or () for name in value.split(","))


def _value(text: str, option: str) -> tuple[float, float]:
    """Read a number with its standard deviation, MEAN:SD; without SD the number is exact."""
    mean, _, sd = text.partition(":")
    try:
        found = float(mean), float(sd or 0.0)
    except ValueError:
        found = math.nan, math.nan
    if not (math.isfinite(found[0]) and 0.0 <= found[1] < math.inf):
        raise typer.BadParameter(
            f"{text!r}: expected a number and its standard deviation, such as 1.5:0.3", param_hint=option
        )
    return found


def _load(text: str) -> UnmeasuredLoad:
    mean_a, sd_a = _value(text, "--load")
    if mean_a < 0.0:
        raise typer.BadParameter(
            f"{text!r}: expected what flows out of the junction, 0 A or more; a source is a branch of its own",
            param_hint="--load",
        )
    return UnmeasuredLoad(mean_a=mean_a, sd_a=sd_a)


def _charges(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    found = dict(map(_charge, texts))
    if len(found) < len(texts):
        raise typer.BadParameter(f"{', '.join(texts)}: a branch is named twice; name it once", param_hint="--charge")
    return found


def _charge(text: str) -> tuple[str, tuple[float, float]]:
    branch, equals, value = text.partition("=")
    if not (equals and branch.strip()):
        raise typer.BadParameter(
            f"{text!r}: expected a branch with its charge, such as battery=-12.5:0.2", param_hint="--charge"
        )
    mean, sd = _value(value, "--charge")
    if not sd:
        raise typer.BadParameter(f"{text!r}: give its standard deviation as well, {text}:0.1", param_hint="--charge")
    return branch.strip(), (mean, sd)


def identify(
    fleet: FleetArgument,
    layout: LayoutOption,
    out: Annotated[Path | None, typer.Option("--out", help="File to write the filter bank to (JSON).")] = None,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Choose the filter bank that a fleet's vehicles share, and tell how well it simulates each of them.

    It is chosen from some vehicles, by how well it simulates blocks of their drives that were held out.
    """
    if out is not None:
        require_possible_file(out)
    with importing():
        from calibrator.estimator.fleet_identification import identify_fleet
        from calibrator.processes.run_many import Workers

    report = identify_fleet(fleet, vehicle_database(layout), workers=Workers(processes=workers))
    if out is not None:
        write_files({out: report.bank.to_json()})
    print_report(report, json=json)
