"""The page of a fleet: everything that it shows, in one HTML file."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

from calibrator.drive import Array
from calibrator.report.evidence_columns import Evidence
from calibrator.report.figures import (
    MOST_POINTS,
    ageing_figure,
    duration_figure,
    junction_figure,
    margin_figure,
    sensor_figure,
    verdict_figure,
)
from calibrator.report.fleet_table import FleetTable
from calibrator.report.lists import (
    changes_since,
    comparison_rows,
    holding_up,
    largest_faults,
    left_out_rows,
    moved_texts,
    workshop_list,
)
from calibrator.report.overview import Overview, Protection
from calibrator.report.packing import as_text
from calibrator.report.protection import SIGMAS, Margins
from calibrator.report.templates import asset, template
from calibrator.report.vehicle_data import (
    columns_within,
    details_within,
    kinds_of,
    most_to_say_first,
    row_steps,
)
from calibrator.report.window import IdealWindow
from calibrator.report.words import moment

__all__ = ["MOST_BYTES", "FleetPage", "fleet_page"]

MOST_BYTES = 9_500_000
"""Size of a page that a mail and a browser still take well. [byte]"""
REST_BYTES = 500_000
"""Of the text and the tables around the data. [byte]"""
MOST_LISTED = 100_000
"""Vehicles that a page lists one by one."""
LISTED_SHARE = 0.8
"""Of the room that they may take, so that some is left for their evidence. [1]"""


@dataclass(frozen=True, kw_only=True)
class FleetPage:
    """What a page is made of.

    Attributes
    ----------
    table, overview : FleetTable, Overview
        The result.
    evidence_of : callable
        Reads the evidence of some of its vehicles.
    window : IdealWindow or None
        For the currents of single vehicles; None: they are not drawn.
    margins, protection : Margins and Protection, or None
        Of the battery; None: `no_protection` says why.
    no_protection : str
        Empty if there are margins.
    beside, earlier : FleetTable or None
        Results of another method, and of an earlier run.
    """

    table: FleetTable
    overview: Overview
    evidence_of: Callable[[NDArray[np.int64]], Evidence]
    window: IdealWindow | None
    margins: Margins | None
    protection: Protection | None
    no_protection: str = ""
    beside: FleetTable | None = None
    earlier: FleetTable | None = None


def fleet_page(page: FleetPage) -> str:
    """Write the page.

    Parameters
    ----------
    page : FleetPage
        What it shows.

    Returns
    -------
    str
        HTML. Of more than :data:`MOST_LISTED` vehicles those are listed of which there is most to say; where the page
        would be larger than :data:`MOST_BYTES`, the evidence of the others is left out.
    """
    table, plotly = page.table, _plotly()
    changes = changes_since(table, page.earlier)
    figures = _figures(page, changes)
    room = MOST_BYTES - REST_BYTES - len(plotly) - len(msgspec.json.encode(figures))
    order = most_to_say_first(table)[:MOST_LISTED]
    listed, columns = columns_within(table, page.beside, order, int(LISTED_SHARE * room))
    names = as_text(msgspec.json.encode(table.vehicle[listed].tolist()))
    evidence = page.evidence_of(listed)
    details = details_within(table.reason[listed], evidence, room - len(columns.data) - len(names))
    facts = {
        "branches": table.branches,
        "vehicles": len(listed),
        "full_scale_a": table.run.full_scale_a,
        "verdicts": kinds_of(table.verdict),
        "held_back": kinds_of(table.held_back),
        "columns": columns.columns,
        "evidence": evidence.names,
        "evidence_columns": details.evidence.columns,
        "evidence_steps": row_steps(evidence).tolist(),
        "ratios": evidence.ratios,
        "told": details.told,
        "window": _window_facts(page.window),
        "beside": page.beside.run.method if page.beside is not None else None,
        "figures": figures,
    }
    return template("fleet.html").render(
        **_texts(page, changes, listed=len(listed)),
        facts=_script_json(facts),
        columns=Markup(columns.data),  # noqa: S704 (base64)
        names=Markup(names),  # noqa: S704 (base64)
        details=Markup(details.texts),  # noqa: S704 (base64)
        evidence=Markup(details.evidence.data),  # noqa: S704 (base64)
        plotly=Markup(plotly),  # noqa: S704 (base64)
        style=Markup(asset("page.css")),  # noqa: S704 (of this package)
        script=Markup(asset("fleet.js")),  # noqa: S704 (of this package)
    )


def _texts(page: FleetPage, changes: Mapping[str, Array], *, listed: int) -> dict[str, Any]:
    """What stands in the page as text and tables."""
    table = page.table
    return {
        "run": table.run,
        "overview": page.overview,
        "beside": _beside(page),
        "ranked": largest_faults(table),
        "drawn_limited": bool((table.faulty.sum(axis=0) > MOST_POINTS).any()),
        "most_points": MOST_POINTS,
        "moved": moved_texts(table),
        "ageing": _ageing_caption(changes, page.earlier),
        "listed_limited": _listed_notice(listed, len(table)),
        "workshop": workshop_list(table),
        "protection": page.protection,
        "no_protection": page.no_protection,
        "holding_up": holding_up(table, page.margins),
        "sigmas": f"{SIGMAS:g}",
        "left_out": left_out_rows(table, page.overview),
        "left_out_more": _left_out_more(page.overview),
    }


def _figures(page: FleetPage, changes: Mapping[str, Array]) -> dict[str, Any]:
    table, overview = page.table, page.overview
    sums = {"as measured": table.measured_a, "after correction": table.deployed_a}
    if page.beside is not None:
        sums[f"after correction, {page.beside.run.method}"] = page.beside.deployed_a
    figures = {
        "verdicts": verdict_figure(overview.verdicts, left_out=overview.left_out),
        "junction": junction_figure(sums, expected_a=overview.unmeasured_a),
        "sensors": sensor_figure(table),
        "durations": duration_figure(table.duration_s),
    }
    if page.margins is not None:
        figures["margin"] = margin_figure(page.margins)
    if changes:
        figures["ageing"] = ageing_figure(changes)
    return figures


def _window_facts(window: IdealWindow | None) -> dict[str, Any] | None:
    if window is None:
        return None
    ideal_a = [
        [None if np.isnan(value) else round(value, 2) for value in branch] for branch in window.ideal_a.T.tolist()
    ]
    return {
        "vehicle": window.vehicle,
        "seconds": round(float(window.time_s[-1])),
        "time_s": [round(value, 3) for value in window.time_s.tolist()],
        "ideal_a": ideal_a,
    }


def _beside(page: FleetPage) -> dict[str, Any] | None:
    if page.beside is None:
        return None
    return {"method": page.beside.run.method, "rows": comparison_rows(page.table, page.beside)}


def _ageing_caption(changes: Mapping[str, Array], earlier: FleetTable | None) -> str:
    if earlier is None or not changes:
        return ""
    count = sum(map(len, changes.values()))
    since = moment(earlier.run.created)
    return f"{count:,} sensors whose parameters differ from those of {since}, of all vehicles in both results."


def _listed_notice(listed: int, vehicles: int) -> str:
    if listed == vehicles:
        return ""
    return (
        f"{listed:,} of {vehicles:,} vehicles are listed, those of which there is most to say; the page of any other: "
        f"calibrator report RESULT --vehicle NAME."
    )


def _left_out_more(overview: Overview) -> str:
    told = sum(overview.left_out_reasons.values())
    return f"{overview.left_out - told:,} more for other reasons: results.parquet." if told < overview.left_out else ""


def _script_json(value: Any) -> Markup:
    """JSON that ends no script element, whatever names are in it."""
    text = msgspec.json.encode(value).decode()
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))  # noqa: S704


@cache
def _plotly() -> str:
    return as_text(get_plotlyjs().encode())
