"""The page of a result: one HTML file of the whole fleet, or of one vehicle, that fetches nothing.

Numbers of the fleet stand in the page as text (``assets/page.html``); those of single vehicles as packed columns, of
which ``assets/page.js`` makes tables and figures, with plotly.js from the same file.
"""

import base64
import gzip
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.estimator.results import written_of
from calibrator.estimator.vehicle_report import REASONS, faults_of
from calibrator.report.figures import MOST_POINTS, junction_figure, margin_figure, sensor_figure
from calibrator.report.fleet_table import Details, FleetTable, read_details, read_fleet_table
from calibrator.report.overview import (
    FLEET_CAUSES,
    Overview,
    WorkshopRow,
    amperes,
    next_steps,
    overview_of,
    percent,
    probability,
    workshop_list,
)
from calibrator.report.protection import SIGMAS, Margins, Protection, margins, protection_of
from calibrator.summaries.unity import UNITY_FILE, UnityWindow, decode_window
from calibrator.terminal.text import counted, few
from ecu_node.parameters import Explanation, VehicleParameters, decode_parameters

__all__ = ["FleetReport", "fleet_report", "vehicle_report"]

MOST_BYTES = 9_500_000
"""Size of a page that a mail and a browser still take well. [byte]"""
REST_BYTES = 500_000
"""Of the text and the tables around the data. [byte]"""
MOST_SENSORS = 300_000
"""Sensors of the vehicles that a page lists one by one: those of 100,000 vehicles with three branches."""
MOST_WORKSHOP, MOST_MOVED, MOST_HOLDING = 500, 200, 10
"""Rows of the lists."""
BATTERY = "battery"
"""What a layout calls the branch of the battery, unless the user says otherwise."""
METHOD_WITHOUT_SD = "published"
"""Method that gives no standard deviations: what it does not find is taken for 0."""
OPEN_GAIN, OPEN_OFFSET = 0.1, 0.05
"""Standard deviations beyond which a gain, and an offset over full scale, are as open as before the recordings. [1]"""
MISSING = -(2**31)
"""Stands in a packed column for what is not known."""
DURATION_STEP_S = 0.1
GAIN_STEP, CURRENT_STEP_A, SHARE_STEP = 1e-5, 1e-3, 1e-5
"""Steps that packed numbers are rounded to: what a reader can see. [1], [A], [1]"""


@dataclass(frozen=True, kw_only=True)
class FleetReport:
    """Numbers of the page of a fleet."""

    overview: Overview
    next_steps: list[str]
    workshop: list[WorkshopRow]
    protection: Protection | None


def fleet_report(
    result: Path, *, battery: str | None = None, limit_a: float | None = None, voltage_v: float | None = None
) -> tuple[str, FleetReport]:
    """Make the page of a result.

    Parameters
    ----------
    result : Path
        Folder that ``calibrator calibrate`` wrote.
    battery : str or None
        Branch of the battery; None: :data:`BATTERY`.
    limit_a : float or None
        Its current limit; None: full scale. [A]
    voltage_v : float or None
        Its voltage; None: that of the unity window. [V]

    Returns
    -------
    page : str
        HTML. A result of one vehicle gives the page of this vehicle.
    report : FleetReport
        Its numbers.

    Raises
    ------
    FleetError
        If the folder is no result, or no branch has this name.
    """
    table, unity = read_fleet_table(result), _read_unity(result)
    found, protection, why = _protection(table, unity, battery, limit_a, voltage_v)
    page = _Page(table, table, unity)
    report = FleetReport(
        overview=page.overview, next_steps=page.next_steps, workshop=page.workshop, protection=protection
    )
    holding = _holding_up(table, found) if found is not None and len(table) > 1 else []
    return page.html(protection=protection, no_protection=why, margins=found, holding_up=holding), report


def vehicle_report(result: Path, vehicle: str) -> tuple[str, VehicleParameters]:
    """Make the page of one vehicle of a result, with its parameters; FleetError if it is not in it, or left out."""
    written = written_of(result, vehicle)
    parameters = decode_parameters(written.text, f"{result}: parameters of {vehicle}")
    table = read_fleet_table(result)
    return _Page(table.only(vehicle), table, _read_unity(result)).html(), parameters


def _read_unity(result: Path) -> UnityWindow | None:
    """Unity window of a result; None if it has none, FleetError if it is damaged."""
    path = result / UNITY_FILE
    try:
        return decode_window(path.read_bytes(), str(path))
    except FileNotFoundError:
        return None


def _protection(
    table: FleetTable,
    unity: UnityWindow | None,
    battery: str | None,
    limit_a: float | None,
    voltage_v: float | None,
) -> tuple[Margins | None, Protection | None, str]:
    """Margins of the battery, or why there are none."""
    branch = battery or BATTERY
    if branch not in table.branches:
        if battery is not None:
            raise FleetError(f"--battery {branch}: no such branch; expected one of {few(list(table.branches))}")
        return None, None, f"No branch is called {BATTERY!r}; name the battery's with --battery to see its margin."
    k = table.branches.index(branch)
    drift, offset_a, drift_sd, offset_sd_a = (
        table[name][:, k] for name in ("drift", "offset_a", "drift_sd", "offset_sd_a")
    )
    known = (drift_sd <= OPEN_GAIN) & (offset_sd_a <= OPEN_OFFSET * table.run.full_scale_a)
    if not known.any() or np.isnan(drift_sd + offset_sd_a).any():
        return None, None, f"How wrong the {branch} sensor can be is not known, so no margin follows."
    applied, limit_a = table["applied"][:, k], limit_a or table.run.full_scale_a
    found = margins(drift, offset_a, drift_sd, offset_sd_a, applied, limit_a=limit_a)
    known_v = voltage_v or (None if unity is None else unity.voltage_v)
    corrected = applied & table.faulty[:, k]
    return found, protection_of(found, corrected, branch=branch, voltage_v=known_v), ""


def _holding_up(table: FleetTable, found: Margins) -> list[tuple[str, float, str, str]]:
    """Vehicles that need more than half of the margin that is one for all after correction, the largest first."""
    order = np.argsort(-found.after_a, kind="stable")[:MOST_HOLDING]
    order = order[found.after_a[order] > found.common_after_a / 2.0]
    said = (table.of_vehicles(name)[order].tolist() for name in ("verdict", "reason"))
    return list(zip(table.vehicle[order].tolist(), found.after_a[order].tolist(), *said, strict=True))


class _Page:
    """What a page shows of some vehicles: all of a fleet, or one of them; `fleet` is all of the result."""

    def __init__(self, table: FleetTable, fleet: FleetTable, unity: UnityWindow | None) -> None:
        self.table, self.fleet, self.unity = table, fleet, unity
        # Vehicles with a suspicion, a question or a fault come before those without, the largest faults first.
        plain = (table.of_vehicles("verdict") == "no sensor fault") & ~table.of_vehicles("hardware_fault")
        order = np.lexsort((-table.error_a.max(axis=1), plain))
        self.listed: NDArray[np.int64] = order[: MOST_SENSORS // len(table.branches)]
        self.details = read_details(table, self.listed)
        self.overview = overview_of(table)
        self.reasons = {str(reason): why for reason, why in REASONS.items()}
        if "reference" not in table.run.details:  # no fleet
            self.reasons["reference in doubt"] = "only ratios of gains are known"
        self.workshop = workshop_list(table, self.details.files)
        self.next_steps = next_steps(table, self.workshop)

    def html(
        self,
        *,
        protection: Protection | None = None,
        no_protection: str = "",
        margins: Margins | None = None,
        holding_up: list[tuple[str, float, str, str]] | None = None,
    ) -> str:
        """Write the page; where it would be larger than :data:`MOST_BYTES`, the last vehicles have no evidence."""
        table, details, alone = self.table, self.details, len(self.table) == 1
        figures = self._figures(margins)
        kinds = {name: _kinds(table[name]) for name in ("verdict", "held_back")}
        columns, about = _packed(self._columns(kinds))
        names = _as_text(msgspec.json.encode(table.vehicle[self.listed].tolist()))
        plotly = _plotly()
        room = MOST_BYTES - REST_BYTES - len(plotly) - len(columns) - len(names) - len(msgspec.json.encode(figures))
        count, texts, evidence, evidence_about = self._details_within(room)
        facts = {
            "branches": table.branches,
            "vehicles": len(self.listed),
            "alone": alone,
            "full_scale_a": table.run.full_scale_a,
            "verdicts": kinds["verdict"],
            "held_back": [self.reasons[each] for each in kinds["held_back"]],
            "fleet_causes": FLEET_CAUSES,
            "columns": about,
            "evidence": details.names,
            "ratios": details.ratios,
            "evidence_columns": evidence_about,
            "evidence_steps": _evidence_steps(details).tolist(),
            "detailed": count,
            "window": self._window(),
            "figures": figures,
        }
        text: str = _template().render(
            run=table.run,
            fleet_size=len(self.fleet),
            alone=alone,
            table=table,
            overview=self.overview,
            listed=len(self.listed),
            next_steps=self.next_steps,
            workshop=self.workshop,
            most_workshop=MOST_WORKSHOP,
            drawn_limited=bool((table.faulty.sum(axis=0) > MOST_POINTS).any()),
            most_points=MOST_POINTS,
            moved=self._moved(),
            reasons=self.reasons,
            left_out=self._left_out(),
            protection=protection,
            no_protection=no_protection,
            holding_up=holding_up,
            sigmas=f"{SIGMAS:g}",
            facts=_script_json(facts),
            data={"columns": columns, "names": names, "details": texts, "evidence": evidence, "plotly": plotly},
        )
        return text

    def _figures(self, margins: Margins | None) -> dict[str, Any]:
        table = self.table
        if len(table) <= 1:
            return {}
        sums = table.of_vehicles("junction_rms_measured_a"), table.deployed_a
        figures = {
            "junction": junction_figure(*sums, expected_a=self.overview.unmeasured_a),
            "sensors": sensor_figure(table, self.details.files),
        }
        return figures if margins is None else figures | {"margin": margin_figure(margins)}

    def _columns(self, kinds: Mapping[str, list[str]]) -> dict[str, tuple[Array, float]]:
        """Columns of the vehicles that are listed, and the step that each is rounded to."""
        table, listed = self.table, self.listed
        steps = {
            **dict.fromkeys(("drift", "drift_sd"), GAIN_STEP),
            **dict.fromkeys(("offset_a", "offset_sd_a"), CURRENT_STEP_A),
            **dict.fromkeys(("fault_probability", "harm_probability"), SHARE_STEP),
            "applied": 1.0,
        }
        shared = {"confidence": SHARE_STEP, "hardware_probability": SHARE_STEP, "hardware_fault": 1.0}
        shared |= {"junction_rms_measured_a": CURRENT_STEP_A, "duration_s": DURATION_STEP_S}
        return {
            **{name: (table[name][listed], step) for name, step in steps.items()},
            **{name: (table.of_vehicles(name)[listed], step) for name, step in shared.items()},
            "verdict": (_codes(table.of_vehicles("verdict")[listed], kinds["verdict"]), 1.0),
            "held_back": (_codes(table["held_back"][listed], kinds["held_back"]), 1.0),
            "faulty": (table.faulty[listed], 1.0),
            "corrected": (table.corrected[listed], 1.0),
            "deployed_a": (table.deployed_a[listed], CURRENT_STEP_A),
            "unknown": (self._unknown(), 1.0),
        }

    def _unknown(self) -> NDArray[Any]:
        """What is not known of the sensors that are listed, shape (n, K): 1 the gain error, 2 the offset, 3 both."""
        table, listed, files = self.table, self.listed, self.details.files
        gain = np.array(
            [[not files[j].branches[name].identifiable for name in table.branches] for j in listed.tolist()]
        )
        if table.run.method == METHOD_WITHOUT_SD:
            return np.asarray(1 * gain)
        drift_sd, offset_sd_a = table["drift_sd"][listed], table["offset_sd_a"][listed]
        offset = ~(offset_sd_a <= OPEN_OFFSET * table.run.full_scale_a)
        return np.asarray(1 * (gain | ~(drift_sd <= OPEN_GAIN)) + 2 * offset)

    def _details_within(self, room: int) -> tuple[int, str, str, list[dict[str, Any]]]:
        """Explanations, findings, reasons and evidence of as many vehicles as there is room for, the first ones."""
        table, details = self.table, self.details
        count = min(len(self.listed), max(room, 0) // (3 * len(details.names) + 1))  # a number needs a byte at least
        while True:
            first = self.listed[:count].tolist()
            texts = {
                "explanations": [self._explanations(details.files[j].explanations) for j in first],
                "findings": [[msgspec.structs.astuple(each) for each in details.files[j].findings] for j in first],
                "delays_ms": (1e3 * table["delay_s"][first]).round().tolist(),
                "reasons": table.of_vehicles("reason")[first].tolist(),
            }
            text, steps = _as_text(msgspec.json.encode(texts)), _evidence_steps(details)
            rows = {"value": details.value, "sd": details.sd, "explained": details.explained}
            evidence, about = _packed({name: (values[:count] / steps, 1.0) for name, values in rows.items()})
            size = len(text) + len(evidence)
            if size <= room or not count:
                return count, text, evidence, about
            count = int(0.97 * count * max(room, 0) / size)

    def _explanations(self, found: list[Explanation]) -> list[list[Any]]:
        """Of each: probability; drifts, offsets of the K sensors; hardware drift and offsets. [1], [A]"""
        branches = self.table.branches
        rows = []
        for each in found:
            drift, offset_a = faults_of(each, branches)
            hardware_a = np.array([each.hardware_offset_a.get(name, 0.0) for name in branches])
            parts = [drift.round(5).tolist(), offset_a.round(2).tolist()]
            rows.append(
                [round(each.probability, 5), *parts, round(each.hardware_drift, 5), hardware_a.round(2).tolist()]
            )
        return rows

    def _window(self) -> dict[str, Any] | None:
        """Unity window with the ideal currents of the fleet; None if the result has no window or no fleet model."""
        run, unity = self.table.run, self.unity
        read_out = run.details.get("reference", {}).get("read_out", {})
        if unity is None or set(read_out) != set(run.branches):
            return None
        of_columns = np.array([read_out[name] for name in run.branches]).T
        if len(of_columns) != unity.columns.shape[1] + 1:
            return None
        ideal_a = np.column_stack([unity.columns, np.ones(len(unity.columns))]) @ of_columns
        return {
            "vehicle": unity.vehicle,
            "seconds": round(float(unity.time_s[-1])),
            "time_s": unity.time_s.round(3).tolist(),
            "ideal_a": ideal_a.T.round(2).tolist(),  # what is not a number becomes null
        }

    def _moved(self) -> list[str]:
        """Sensors that have changed since an earlier result, in words."""
        table = self.table
        places = np.argwhere(table["moved"].astype(bool))[:MOST_MOVED].tolist()
        return [f"{table.vehicle[j]}, {table.branches[k]}: {table['moved'][j, k]}" for j, k in places]

    def _left_out(self) -> list[tuple[int, str, str]]:
        """Vehicles without parameters by reason: how many, why, which."""
        return [
            (count, reason, few([name for name, why in self.table.left_out.items() if why == reason]))
            for reason, count in self.overview.left_out_reasons.items()
        ]


def _kinds(texts: NDArray[Any]) -> list[str]:
    """Different texts, the most frequent first."""
    found, counts = np.unique(texts[texts.astype(bool)].astype(str), return_counts=True)
    return [str(text) for text in found[np.argsort(-counts, kind="stable")]]


def _codes(texts: NDArray[Any], kinds: list[str]) -> Array:
    """Number of each text among the kinds, not a number for none."""
    code = {kind: float(number) for number, kind in enumerate(kinds)}
    return np.array([code.get(text, np.nan) for text in texts.ravel()])


def _evidence_steps(details: Details) -> Array:
    """Steps that the rows of the evidence are rounded to, shape (R,). [1], [A]"""
    return np.where(np.arange(len(details.names)) < details.ratios, GAIN_STEP, CURRENT_STEP_A)


def _packed(columns: Mapping[str, tuple[NDArray[Any], float]]) -> tuple[str, list[dict[str, Any]]]:
    """Pack columns of numbers, each with the step that it is rounded to.

    A page of 100,000 vehicles has some ten million numbers. As whole multiples of their steps, bytes of equal weight
    beside each other, they need about a tenth of what they need as text.

    Returns
    -------
    data : str
        Base64 of gzip of the columns, each as its four planes of bytes, little-endian int32.
    columns : list of dict
        Name, step and length of each, in the order in which they stand in the data; ``value = step * number``.
    """
    about: list[dict[str, Any]] = []
    planes: list[bytes] = []
    for name, (values, step) in columns.items():
        scaled = np.asarray(values, np.float64).ravel() / step
        whole = np.clip(np.rint(np.nan_to_num(scaled)), MISSING + 1, -MISSING - 1)
        whole = np.where(np.isfinite(scaled), whole, MISSING).astype("<i4")
        planes.append(np.ascontiguousarray(whole.view(np.uint8).reshape(-1, 4).T).tobytes())
        about.append({"name": name, "step": step, "length": len(whole)})
    return _as_text(b"".join(planes)), about


def _as_text(content: bytes) -> str:
    """Base64 of gzip of some bytes; the same for the same bytes."""
    # The highest level takes four times as long for a hundredth less.
    return base64.b64encode(gzip.compress(content, compresslevel=6, mtime=0)).decode()


def _script_json(value: Any) -> Markup:
    """JSON that ends no script element, whatever names are in it."""
    text = msgspec.json.encode(value).decode()
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))  # noqa: S704


def _moment(text: str) -> str:
    """A time of ISO 8601 to the minute; as it is if it is none."""
    try:
        return f"{datetime.fromisoformat(text):%Y-%m-%d %H:%M %Z}".strip()
    except ValueError:
        return text


@cache
def _plotly() -> str:
    return _as_text(get_plotlyjs().encode())


@cache
def _template() -> Any:
    """Template of the page: what is put into it is escaped, but for files of this package and base64."""

    def asset(name: str) -> str:
        return (files("calibrator.report") / "assets" / name).read_text("utf-8")

    environment = Environment(
        loader=FunctionLoader(asset), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= {
        "amperes": amperes,
        "asset": lambda name: Markup(asset(name)),  # noqa: S704 (of this package)
        "counted": counted,
        "moment": _moment,
        "percent": percent,
        "probability": probability,
    }
    return environment.get_template("page.html")
