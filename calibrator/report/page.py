"""The page of a result: one HTML file of the whole fleet, or of one vehicle, that fetches nothing.

Numbers of the fleet stand in the page as text (``assets/page.html``), those of single vehicles as compressed JSON.
``assets/page.js`` makes tables and figures of these, with plotly.js, which is part of the page.
"""

import base64
import gzip
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.estimator.results import written_of
from calibrator.estimator.vehicle_report import REASONS
from calibrator.files.templates import templates_of
from calibrator.report.fleet_table import FleetTable, ParameterDetails, read_details, read_fleet_table
from calibrator.report.overview import (
    FLEET_CAUSES,
    SIGMAS,
    amperes,
    battery_margin,
    overview_of,
    percent,
    probability,
    share,
    steps_to_take,
    workshop_list,
)
from calibrator.terminal.text import counted, few
from calibrator.words import is_battery
from ecu_node.parameters import decode_parameters

__all__ = ["report_page"]

MOST_SENSORS = 300_000
"""Most sensors of vehicles that a page lists one by one: those of 100,000 vehicles with three branches."""
MOST_DETAILED = 5_000
"""Most vehicles of which a page has explanations and evidence; with so many it stays below 10 MB."""
MOST_WORKSHOP, MOST_MOVED = 500, 200
"""Most rows of the workshop list, and of the list of sensors that changed."""
BATTERY = "battery"
"""Usual name of the battery's branch, for a message; :func:`.is_battery` also knows it in other languages."""
METHOD_WITHOUT_SD = "published"
"""Method that gives no standard deviations: what it does not find is taken for 0."""
DIGITS = {"drift": 6, "drift_sd": 4, "offset_a": 2, "offset_sd_a": 2, "fault_probability": 3, "harm_probability": 4}
DIGITS_OF_VEHICLE = {"confidence": 3, "hardware_probability": 3, "hardware_fault": 0}
DIGITS_OF_VEHICLE |= {"junction_rms_measured_a": 2, "duration_s": 1}
"""Decimals of the columns of sensors and of vehicles: what a reader can see."""
MOST_POINTS = 1000
"""Sensors drawn one by one in each branch: those with the largest faults. A browser draws some thousand at once."""
SMALLEST_A = 1e-3
"""Start of a logarithmic axis, below what any sensor resolves. [A]"""
LEAST_LOAD_A = 0.05
"""Least load without a sensor that gets a line in the figure. [A]"""


def report_page(
    result: Path,
    vehicle: str | None = None,
    *,
    battery: str | None = None,
    limit_a: float | None = None,
    voltage_v: float | None = None,
) -> tuple[str, dict[str, Any]]:
    """Make the page of a result, or of one of its vehicles.

    Parameters
    ----------
    result : Path
        Folder that ``calibrator calibrate`` wrote.
    vehicle : str or None
        Name of the vehicle; None: all. A result with one vehicle always gives the page of this vehicle.
    battery : str or None
        Branch of the battery; None: the first one whose name is that of a battery.
    limit_a, voltage_v : float or None
        Current limit of the battery, None: full scale; its voltage, None: the margin is shown in A alone. [A], [V]

    Returns
    -------
    page : str
        HTML.
    numbers : dict
        ``overview``, ``next_steps``, ``workshop``, ``protection`` (see overview.py); if a vehicle is named, its
        ``parameters`` instead.

    Raises
    ------
    FleetError
        If the folder is no result, ``battery`` is none of its branches, or the vehicle is not in it or left out.
    """
    parameters = None
    if vehicle is not None:
        parameters = decode_parameters(written_of(result, vehicle).text, f"{result}: parameters of {vehicle}")
    fleet = read_fleet_table(result)
    table = fleet if vehicle is None else fleet.only(vehicle)
    branch, protection = battery or next((name for name in table.branches if is_battery(name, "")), ""), None
    no_protection = f"No branch is called {BATTERY!r} or alike; name the battery's with --battery to see its margin."
    if branch in table.branches:
        protection = battery_margin(table, branch, limit_a=limit_a, voltage_v=voltage_v)
        no_protection = f"How wrong the {branch} sensor can be is not known, so no margin follows."
    elif battery is not None:
        raise FleetError(f"--battery {branch}: no such branch; expected one of {few(list(table.branches))}")
    # Vehicles with a suspicion, a question or a fault come before those without, the largest faults first.
    plain = (table.of_vehicles("verdict") == "no sensor fault") & ~table.of_vehicles("hardware_fault")
    order = np.lexsort((-table["error_a"].max(axis=1), plain))
    listed: NDArray[np.int64] = order[: MOST_SENSORS // len(table.branches)]
    (files, names, rows), overview, alone = read_details(table, listed), overview_of(table), len(table) == 1
    workshop = workshop_list(table, files)
    steps = steps_to_take(table, workshop)
    numbers = {"overview": overview, "next_steps": steps, "workshop": workshop, "protection": protection}
    reasons = dict[str, str](REASONS.items())
    if "reference" not in table.run.details:  # no fleet
        reasons["reference in doubt"] = "only ratios of gains are known"
    sums_a = table.of_vehicles("junction_rms_measured_a"), table.deployed_a
    detailed = [
        {
            "explanations": files[j].explanations,
            "findings": files[j].findings,
            "delays_ms": (1e3 * table["delay_s"][j]).round().tolist(),
            "reason": table["reason"][j, 0],
            "evidence": rows[i].round(4).tolist(),
        }
        for i, j in enumerate(listed[:MOST_DETAILED].tolist())
    ]
    facts = {
        "branches": table.branches,
        "alone": alone,
        "full_scale_a": table.run.full_scale_a,
        "fleet_causes": FLEET_CAUSES,
        "evidence": names,
        "ratios": sum(not name.startswith(("intercept ", "junction ", "offset ")) for name in names),
        "junction": _junction_bins(*sums_a, expected_a=overview["unmeasured_a"]),
        "most_points": MOST_POINTS,
    }
    packed = {"columns": _columns(table, listed, files, reasons), "details": detailed}
    moved = np.argwhere(table["moved"] != "")[:MOST_MOVED].tolist()
    text: str = _template().render(
        run=table.run,
        fleet_size=len(fleet),
        alone=alone,
        table=table,
        listed=len(listed),
        **numbers,
        moved=[f"{table.vehicle[j]}, {table.branches[k]}: {table['moved'][j, k]}" for j, k in moved],
        reasons=reasons,
        no_protection=no_protection,
        facts=facts,
        data={name: _as_text(msgspec.json.encode(each)) for name, each in packed.items()} | {"plotly": _plotly()},
    )
    return text, numbers if parameters is None else {"parameters": parameters}


def _columns(
    table: FleetTable, listed: NDArray[np.int64], files: Mapping[int, ParameterDetails], reasons: Mapping[str, str]
) -> dict[str, list[Any]]:
    """Return the columns of the listed vehicles as lists; those of sensors have K values for each vehicle in turn."""
    gain = np.array([[not files[j].branches[name].identifiable for name in table.branches] for j in listed])
    unknown = 1 * gain
    if table.run.method != METHOD_WITHOUT_SD:
        unknown = 1 * (gain | table["open_gain"][listed]) + 2 * table["open_offset"][listed]
    numbers = {
        **{name: (table[name][listed], digits) for name, digits in DIGITS.items()},
        **{name: (table.of_vehicles(name)[listed], digits) for name, digits in DIGITS_OF_VEHICLE.items()},
        "deployed_a": (table.deployed_a[listed], 2),
        "applied": (table["applied"][listed], 0),
        "faulty": (table["faulty"][listed], 0),
        "corrected": (table.corrected[listed], 0),
        "unknown": (unknown, 0),  # 1 the gain error, 2 the offset, 3 both
    }
    return {
        "vehicle": table.vehicle[listed].tolist(),
        "verdict": table.of_vehicles("verdict")[listed].tolist(),
        "held_back": [reasons.get(each, "") for each in table["held_back"][listed].ravel()],
        **{
            name: (np.asarray(values, int) if digits == 0 else np.round(values, digits) + 0.0).ravel().tolist()
            for name, (values, digits) in numbers.items()
        },
    }


def _as_text(content: bytes) -> str:
    """Compress bytes with gzip and write them as base64; the same bytes give the same text."""
    # The highest level takes four times as long and saves one percent.
    return base64.b64encode(gzip.compress(content, compresslevel=6, mtime=0)).decode()


@cache
def _plotly() -> str:
    return _as_text(get_plotlyjs().encode())


@cache
def _template() -> Any:
    """Return the template of the page; it escapes all values but base64 and the files of this package."""
    environment = templates_of("calibrator.report", "assets", autoescape=True)
    environment.policies["json.dumps_function"] = lambda value, **_: msgspec.json.encode(value).decode()
    environment.globals |= {each.__name__: each for each in (amperes, counted, few, percent, probability, share)}
    environment.globals |= {"MOST_POINTS": MOST_POINTS, "MOST_WORKSHOP": MOST_WORKSHOP, "SIGMAS": SIGMAS}
    return environment.get_template("page.html")


def _junction_bins(before_a: Array, after_a: Array, *, expected_a: float | None) -> dict[str, Any]:
    """Return histograms of the vehicles' root mean square Kirchhoff sums: B + 1 edges [A], and counts in the B bins.

    With these a page holds no more for a million vehicles than for a hundred. The load without a sensor [A] lies
    between the edges; None if it is too small for a line.
    """
    before_a, after_a = (np.maximum(values[np.isfinite(values)], SMALLEST_A) for values in (before_a, after_a))
    load_a = abs(expected_a or 0.0)
    load = [load_a] if load_a >= LEAST_LOAD_A else []
    both = np.concatenate([load, before_a, after_a, [] if len(before_a) else [SMALLEST_A]])
    bins = int(np.clip(3.0 * np.sqrt(len(before_a)), 12, 60))  # few bins for few vehicles
    edges = np.geomspace(both.min() / 1.05, both.max() * 1.05, bins + 1)
    before, after = (np.histogram(values, edges)[0].tolist() for values in (before_a, after_a))
    return {"edges": edges.tolist(), "before": before, "after": after, "load": load[0] if load else None}
