"""Figures of the fleet report as plotly takes them: plain data, drawn in the browser."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.report.fleet_table import FleetTable
from calibrator.report.protection import Margins

__all__ = [
    "ageing_figure",
    "duration_figure",
    "junction_figure",
    "margin_figure",
    "sensor_figure",
    "verdict_figure",
]

Figure = dict[str, Any]

COLOURS = {
    "corrected": "#0072B2",
    "no sensor fault": "#009E73",
    "cannot tell": "#E69F00",
    "not enough data": "#8C6BB1",
    "left out": "#767676",
}
"""Of Okabe and Ito's, which colour-blind readers can tell apart."""
BEFORE, AFTER, OTHER = "#D55E00", "#0072B2", "#767676"
BRANCH_COLOURS = (AFTER, BEFORE, "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B")
BINS = 60
MOST_POINTS = 1000
"""Sensors drawn one by one in each branch: those with the largest faults. A browser draws some thousand at once."""
MOST_BESIDE = 4
"""Panels beside each other: more leave no room for their titles."""
SMALLEST_A = 1e-3
"""Below what any sensor resolves; where a logarithmic axis begins. [A]"""


def verdict_figure(verdicts: Mapping[str, int], *, left_out: int) -> Figure:
    """Vehicles per verdict, as one bar."""
    counts = dict(verdicts) | ({"left out": left_out} if left_out else {})
    total = sum(counts.values())
    traces = [
        {
            "type": "bar",
            "orientation": "h",
            "name": name,
            "x": [count],
            "y": ["vehicles"],
            "marker": {"color": COLOURS.get(name, OTHER)},
            "text": [f"{name}<br>{count} ({count / total:.0%})"],
            "textposition": "inside",
            "insidetextanchor": "middle",
            "hovertemplate": f"{name}: {count} of {total}<extra></extra>",
        }
        for name, count in counts.items()
    ]
    layout = _layout(height=130, x="vehicles", y="") | {"barmode": "stack", "showlegend": False}
    layout["yaxis"] |= {"showticklabels": False}
    return {"data": traces, "layout": layout}


def junction_figure(sums: Mapping[str, Array], *, expected_a: float | None) -> Figure:
    """Distributions of the Kirchhoff sum's root mean square over vehicles, on a logarithmic axis."""
    colours = dict(zip(sums, (BEFORE, AFTER, OTHER), strict=False))
    known = {name: np.maximum(values[np.isfinite(values)], SMALLEST_A) for name, values in sums.items()}
    everything = np.concatenate([[SMALLEST_A] if not any(map(len, known.values())) else [], *known.values()])
    low, high = float(everything.min()), float(everything.max())
    edges = np.geomspace(low / 1.05, high * 1.05, BINS + 1)
    traces = [_histogram(values, edges, name, colours[name]) for name, values in known.items()]
    layout = _layout(height=300, x="RMS of the Kirchhoff sum of a vehicle [A]", y="vehicles")
    layout["xaxis"] |= {"type": "log"}
    if expected_a and edges[0] < expected_a < edges[-1]:
        layout |= _marks({f"load without a sensor, {expected_a:.1f} A": (float(np.log10(expected_a)), OTHER)})
        layout["shapes"][0] |= {"x0": expected_a, "x1": expected_a}
    return {"data": traces, "layout": layout}


def sensor_figure(table: FleetTable) -> Figure:
    """Drift over offset of the sensors with the largest faults, one panel per branch, with standard deviations."""
    K, traces = len(table.branches), []
    rows = -(-K // MOST_BESIDE)
    layout = _layout(height=360 * rows, x="", y="")
    grid = {"rows": rows, "columns": -(-K // rows), "pattern": "independent", "ygap": 0.25}
    layout |= {"grid": grid, "yaxis": {}}
    for k, name in enumerate(table.branches):
        first, axis = k == 0, "" if k == 0 else str(k + 1)
        for label, colour, of in (("corrected", AFTER, True), ("held back", BEFORE, False)):
            drawn = _largest(table, k, table.applied[:, k] == of)
            traces.append(_points(table, k, drawn) | _point_style(label, colour, axis, first=first))
        drift, offset_a = (_about_zero(values[:, k]) for values in (100.0 * table.drift, table.offset_a))
        layout[f"xaxis{axis}"] = {"title": {"text": f"{name}: drift [%]"}, "range": drift, **_GRID}
        layout[f"yaxis{axis}"] = {"title": {"text": "offset [A]" if first else ""}, "range": offset_a, **_GRID}
    return {"data": traces, "layout": layout}


def margin_figure(found: Margins) -> Figure:
    """Distributions of the margins that vehicles need, and the margins that are one for all."""
    edges = np.linspace(0.0, 1.02 * float(max(found.before_a.max(), found.after_a.max(), SMALLEST_A)), BINS + 1)
    traces = [
        _histogram(found.before_a, edges, "as measured", BEFORE),
        _histogram(found.after_a, edges, "after correction", AFTER),
    ]
    layout = _layout(
        height=300,
        x=f"off by as measured, margin needed after correction, at {found.limit_a:g} A [A]",
        y="vehicles",
    )
    layout |= _marks(
        {
            f"one for all as measured: {found.common_before_a:.1f} A": (found.common_before_a, BEFORE),
            f"one for all after correction: {found.common_after_a:.1f} A": (found.common_after_a, AFTER),
        }
    )
    return {"data": traces, "layout": layout}


def duration_figure(duration_s: Array) -> Figure:
    """How long vehicles were recorded."""
    hours = duration_s / 3600.0
    edges = np.linspace(0.0, 1.02 * float(hours.max()), BINS + 1)
    layout = _layout(height=220, x="usable drives of a vehicle [h]", y="vehicles")
    return {"data": [_histogram(hours, edges, "vehicles", AFTER)], "layout": layout | {"showlegend": False}}


def ageing_figure(changes: Mapping[str, Array]) -> Figure:
    """By how much what sensors show at full scale has changed since an earlier result, by branch. [A]"""
    largest = max((float(np.abs(values).max(initial=SMALLEST_A)) for values in changes.values()), default=SMALLEST_A)
    edges = np.linspace(-1.02 * largest, 1.02 * largest, BINS + 1)
    traces = [
        _histogram(values, edges, name, BRANCH_COLOURS[k % len(BRANCH_COLOURS)])
        for k, (name, values) in enumerate(changes.items())
    ]
    layout = _layout(height=240, x="change of what a sensor shows at full scale [A]", y="sensors")
    return {"data": traces, "layout": layout}


_GRID = {"gridcolor": "#e3e6ea", "zerolinecolor": "#9aa3ad", "automargin": True}


def _layout(*, height: int, x: str, y: str) -> Figure:
    return {
        "height": height,
        "margin": {"l": 55, "r": 15, "t": 25, "b": 45},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": "#1b1f24"},
        "legend": {"orientation": "h", "y": 1.12, "x": 0},
        "xaxis": {"title": {"text": x}, **_GRID},
        "yaxis": {"title": {"text": y}, **_GRID},
    }


def _histogram(values: Array, edges: Array, name: str, colour: str) -> Figure:
    """Counts in bins as steps, so that a page holds no more for a million vehicles than for a hundred."""
    counts, _ = np.histogram(values, edges)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": edges.tolist(),
        "y": [*counts.tolist(), 0],
        "line": {"shape": "hv", "color": colour, "width": 1.5},
        "fill": "tozeroy",
        "hovertemplate": f"{name}<br>from %{{x:.3g}}: %{{y}}<extra></extra>",
    }


def _marks(lines: Mapping[str, tuple[float, str]]) -> Figure:
    """Vertical lines with their names."""
    shapes = [
        {"type": "line", "yref": "paper", "x0": x, "x1": x, "y0": 0, "y1": 1, "line": {"color": colour, "dash": "dash"}}
        for x, colour in lines.values()
    ]
    notes = [
        {
            "x": x,
            "y": 0.98 - 0.12 * row,
            "yref": "paper",
            "text": text,
            "showarrow": False,
            "xanchor": "right" if row == 0 and len(lines) > 1 else "left",
            "bgcolor": "rgba(255,255,255,0.85)",
            "font": {"color": colour},
        }
        for row, (text, (x, colour)) in enumerate(lines.items())
    ]
    return {"shapes": shapes, "annotations": notes}


def _about_zero(values: Array) -> list[float]:
    """Range of an axis that holds some values, whatever their standard deviations."""
    largest = 1.1 * max(float(np.abs(values).max()), 1.0)
    return [-largest, largest]


def _largest(table: FleetTable, k: int, chosen: Mask) -> Sequence[int]:
    """Faulty sensors of a branch by falling full-scale error, as many as are drawn."""
    rows = np.flatnonzero(chosen & table.faulty[:, k])
    kept: list[int] = rows[np.argsort(-table.error_a[rows, k], kind="stable")][:MOST_POINTS].tolist()
    return kept


def _points(table: FleetTable, k: int, rows: Sequence[int]) -> Figure:
    def told(values: Array, digits: int) -> list[float]:
        return [round(float(value), digits) for value in np.nan_to_num(values[rows, k])]

    return {
        "x": told(100.0 * table.drift, 3),
        "y": told(table.offset_a, 3),
        "error_x": {"type": "data", "array": told(100.0 * table.drift_sd, 3), "thickness": 0.7, "width": 0},
        "error_y": {"type": "data", "array": told(table.offset_sd_a, 3), "thickness": 0.7, "width": 0},
        "text": [str(table.vehicle[j]) for j in rows],
    }


def _point_style(label: str, colour: str, axis: str, *, first: bool) -> Figure:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": label,
        "legendgroup": label,
        "showlegend": first,
        "xaxis": f"x{axis}",
        "yaxis": f"y{axis}",
        "marker": {"color": colour, "size": 6, "opacity": 0.7},
        "hovertemplate": "%{text}<br>drift %{x:.2f} %<br>offset %{y:.2f} A<extra></extra>",
    }
