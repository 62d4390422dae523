"""From a result folder to its pages."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from calibrator.errors import FleetError
from calibrator.estimator.results import read_run, written_of
from calibrator.report.evidence_columns import ratio_count, read_evidence
from calibrator.report.fleet_table import FleetTable, read_fleet_table
from calibrator.report.overview import Overview, Protection, overview_of, protection_of
from calibrator.report.page import FleetPage, fleet_page
from calibrator.report.protection import Margins, margins
from calibrator.report.traces import recorded_traces, unity_traces
from calibrator.report.vehicle_page import vehicle_page
from calibrator.report.window import ideal_window, read_out_of, read_unity
from calibrator.summaries.unity import UnityWindow
from calibrator.terminal.text import few
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters, decode_parameters

__all__ = ["FleetReport", "ReportOptions", "VehicleReport", "fleet_report", "vehicle_report"]

BATTERY = "battery"
"""What a layout calls the branch of the battery, unless the user says otherwise."""


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """What a user chose.

    Attributes
    ----------
    beside, earlier : Path or None
        Results of another method, and of an earlier run.
    battery : str or None
        Branch of the battery; None: :data:`BATTERY`.
    limit_a : float or None
        Its current limit; None: full scale. [A]
    voltage_v : float or None
        Its voltage; None: that of the unity window. [V]
    """

    beside: Path | None = None
    earlier: Path | None = None
    battery: str | None = None
    limit_a: float | None = None
    voltage_v: float | None = None


@dataclass(frozen=True, kw_only=True)
class FleetReport:
    """Numbers of the page of a fleet."""

    overview: Overview
    protection: Protection | None


def fleet_report(result: Path, options: ReportOptions) -> tuple[str, FleetReport]:
    """Make the page of a fleet.

    Parameters
    ----------
    result : Path
        Folder that ``calibrator calibrate`` wrote.
    options : ReportOptions
        What the user chose.

    Returns
    -------
    page : str
        HTML.
    report : FleetReport
        Its numbers.

    Raises
    ------
    FleetError
        If a folder is no result, or they are not of one fleet.
    """
    table = read_fleet_table(result)
    beside, earlier = (_other(path, table) for path in (options.beside, options.earlier))
    if beside is not None and beside.run.method == table.run.method:
        raise FleetError(f"{options.beside}: of method {table.run.method} too; expected one of another for --beside")
    if earlier is not None and (earlier.run.method != table.run.method or earlier.run.created >= table.run.created):
        raise FleetError(
            f"{options.earlier}: of method {earlier.run.method}, made {earlier.run.created}; expected one of method "
            f"{table.run.method} from before {table.run.created} for --earlier"
        )
    overview, unity = overview_of(table), read_unity(result)
    found, protection, why = _protection(table, options, unity)
    page = FleetPage(
        table=table,
        overview=overview,
        evidence_of=partial(read_evidence, result, table),
        window=ideal_window(unity, table.run),
        margins=found,
        protection=protection,
        no_protection=why,
        beside=beside,
        earlier=earlier,
    )
    return fleet_page(page), FleetReport(overview=overview, protection=protection)


@dataclass(frozen=True, kw_only=True)
class VehicleReport:
    """What the page of a vehicle shows: its parameters."""

    parameters: VehicleParameters


def vehicle_report(
    result: Path, vehicle: str, *, drives: Path | None = None, database: VehicleDatabase | None = None
) -> tuple[str, VehicleReport]:
    """Make the page of one vehicle.

    Parameters
    ----------
    result : Path
        Folder that ``calibrator calibrate`` wrote.
    vehicle : str
        Its name.
    drives : Path or None
        Drives of the fleet, of which one of the vehicle's is shown; None: only the unity window.
    database : VehicleDatabase or None
        DBC and layout of these drives.

    Returns
    -------
    page : str
        HTML.
    report : VehicleReport
        What it shows.

    Raises
    ------
    UserError
        If there is no such vehicle in the result, or no usable drive of it.
    """
    written, run = written_of(result, vehicle), read_run(result)
    parameters = decode_parameters(written.text, f"{result}: parameters of {vehicle}")
    if database is not None:
        _require_made_with(database, parameters)
    names, unity = run.details.get("evidence", []), read_unity(result)
    window = ideal_window(unity, run)
    traces = []
    if drives is not None and database is not None:
        traces.append(recorded_traces(parameters, drives, database, unity, read_out_of(run)))
    if window is not None and written.evidence is not None:
        traces.append(unity_traces(parameters, written.evidence, names, window))
    missing = []
    if not traces:
        missing.append("No currents are drawn: the result has no unity window; give --drives and --layout.")
    if written.evidence is None:
        missing.append(
            f"No evidence is drawn: method {run.method} keeps none, or its parameters are of an earlier run."
        )
    page = vehicle_page(
        parameters, evidence=written.evidence, names=names, ratios=ratio_count(names), traces=traces, missing=missing
    )
    return page, VehicleReport(parameters=parameters)


def _require_made_with(database: VehicleDatabase, parameters: VehicleParameters) -> None:
    """Refuse a layout or DBC with which the parameters do not belong together, as the node does."""
    layout = database.layout
    for path, digest, expected in (
        (layout.path, layout.digest, parameters.layout.sha256),
        (layout.dbc_path, database.digest, parameters.dbc.sha256),
    ):
        if digest != expected:
            raise FleetError(
                f"{path}: not the file that vehicle {parameters.vehicle} was calibrated with (SHA-256 {digest[:12]}, "
                f"expected {expected[:12]}); give the one it was"
            )


def _other(path: Path | None, table: FleetTable) -> FleetTable | None:
    """Another result of the same fleet."""
    if path is None:
        return None
    other = read_fleet_table(path)
    if other.branches != table.branches:
        raise FleetError(
            f"{path}: a result with branches {', '.join(other.branches)}, and this one has "
            f"{', '.join(table.branches)}; expected another result of this fleet"
        )
    if not set(other.vehicle) & set(table.vehicle):
        raise FleetError(
            f"{path}: none of its {len(other)} vehicles is among the {len(table)} of this result; expected another "
            f"result of this fleet"
        )
    return other


def _protection(
    table: FleetTable, options: ReportOptions, unity: UnityWindow | None
) -> tuple[Margins | None, Protection | None, str]:
    """Margins of the battery, or why there are none."""
    branch = options.battery or BATTERY
    if branch not in table.branches:
        if options.battery is not None:
            raise FleetError(f"--battery {branch}: no such branch; expected one of {few(list(table.branches))}")
        return None, None, f"No branch is called {BATTERY!r}; name the battery's with --battery to see its margin."
    limit_a = options.limit_a or table.run.full_scale_a
    k = table.branches.index(branch)
    if not np.isfinite(table.drift_sd[:, k]).all() or not np.isfinite(table.offset_sd_a[:, k]).all():
        return None, None, f"Method {table.run.method} does not say how sure its estimates are, so no margin follows."
    found = margins(
        table.drift[:, k],
        table.offset_a[:, k],
        table.drift_sd[:, k],
        table.offset_sd_a[:, k],
        table.applied[:, k],
        limit_a=limit_a,
    )
    voltage_v = options.voltage_v or (None if unity is None else unity.voltage_v)
    corrected = table.applied[:, k] & table.faulty[:, k]
    return found, protection_of(found, corrected, branch=branch, voltage_v=voltage_v), ""
