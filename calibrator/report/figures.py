"""Figures of the fleet page: data and axes for plotly in the browser; ``assets/page.js`` adds fonts and grids."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibrator.drive import Array
from calibrator.report.fleet_table import FleetTable, ParameterDetails

__all__ = ["MOST_POINTS", "junction_figure", "sensor_figure"]

Figure = dict[str, Any]

BEFORE, AFTER, OTHER = "#D55E00", "#0072B2", "#767676"
"""Of Okabe and Ito's colours, which colour-blind readers can tell apart."""
MOST_POINTS = 1000
"""Sensors drawn one by one in each branch: those with the largest faults. A browser draws some thousand at once."""
MOST_BESIDE = 4
"""Panels beside each other: more leave no room for their titles."""
SMALLEST_A = 1e-3
"""Below what any sensor resolves; where a logarithmic axis begins. [A]"""
LEAST_LOAD_A = 0.05
"""Load without a sensor from which on it is worth a line. [A]"""
RIVAL = 0.02
"""Probability from which on another explanation of a sensor is drawn. [1]"""


def junction_figure(before_a: Array, after_a: Array, *, expected_a: float | None) -> Figure:
    """Distributions of the Kirchhoff sum's root mean square over vehicles, on a logarithmic axis.

    Counts in bins, so that a page holds no more for a million vehicles than for a hundred.
    """
    before_a, after_a = (np.maximum(values[np.isfinite(values)], SMALLEST_A) for values in (before_a, after_a))
    marks = [abs(expected_a)] if expected_a is not None and abs(expected_a) >= LEAST_LOAD_A else []
    both = np.concatenate([marks, before_a, after_a, [] if len(before_a) else [SMALLEST_A]])
    bins = int(np.clip(3.0 * np.sqrt(len(before_a)), 12, 60))  # few bins for few vehicles
    edges = np.geomspace(both.min() / 1.05, both.max() * 1.05, bins + 1)
    line = {"type": "scatter", "mode": "lines"}
    data: list[Figure] = [
        {
            **line,
            "name": name,
            "x": [float(edges[0]), *edges.tolist()],
            "y": [0, *np.histogram(values, edges)[0].tolist(), 0],
            "line": {"shape": "hv", "color": colour, "width": 1.5},
            "fill": "tozeroy",
            "hovertemplate": f"{name}<br>from %{{x:.3g}} A: %{{y}} vehicles<extra></extra>",
        }
        for name, values, colour in (("as measured", before_a, BEFORE), ("after correction", after_a, AFTER))
    ]
    for x in marks:
        top, style = max(max(trace["y"]) for trace in data), {"color": OTHER, "dash": "dash", "width": 1.5}
        data.append({**line, "name": f"load without a sensor: {x:.1f} A", "x": [x, x], "y": [0, top], "line": style})
    axis = {"type": "log", "dtick": "D2", "title": {"text": "RMS of a vehicle's Kirchhoff sum [A]"}}
    return {
        "data": data,
        "layout": {"height": 260, "xaxis": axis, "yaxis": {"title": {"text": "vehicles"}, "rangemode": "tozero"}},
    }


def sensor_figure(table: FleetTable, files: Mapping[int, ParameterDetails]) -> Figure:
    """Gain error over offset of the largest faults, one panel per branch, and what else the undecided ones may be."""
    K, error_a = len(table.branches), table.error_a
    traces: list[Figure] = []
    rows = -(-K // MOST_BESIDE)
    layout: Figure = {
        "height": 340 * rows,
        "grid": {"rows": rows, "columns": -(-K // rows), "pattern": "independent", "ygap": 0.25},
    }
    for k, name in enumerate(table.branches):
        axis, shown = "" if k == 0 else str(k + 1), np.flatnonzero(table.faulty[:, k])
        shown = shown[np.argsort(-error_a[shown, k], kind="stable")][:MOST_POINTS]
        applied = table["applied"][shown, k]
        kept = shown[~applied].tolist()
        for label, colour, points in (
            ("corrected", AFTER, _estimates(table, k, shown[applied].tolist())),
            ("not corrected", BEFORE, _estimates(table, k, kept)),
            ("what it may be instead", BEFORE, _rivals(table, k, kept, files)),
        ):
            hollow = label.startswith("what")
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": label,
                    "legendgroup": label,
                    "showlegend": label not in {trace["name"] for trace in traces if trace["x"]},
                    "xaxis": f"x{axis}",
                    "yaxis": f"y{axis}",
                    "marker": {
                        "color": colour,
                        "size": 7,
                        "opacity": 0.7,
                        "symbol": "circle-open" if hollow else "circle",
                    },
                    "hovertemplate": "%{text}<br>gain error %{x:.2f} %<br>offset %{y:.2f} A<extra></extra>",
                    **points,
                }
            )
        drift, offset_a = 100.0 * np.abs(table["drift"][:, k]), np.abs(table["offset_a"][:, k])
        layout[f"xaxis{axis}"] = {"title": {"text": f"{name}: gain error [%]"}, "range": _about_zero(drift)}
        layout[f"yaxis{axis}"] = {"title": {"text": "offset [A]" if k == 0 else ""}, "range": _about_zero(offset_a)}
    return {"data": [trace for trace in traces if trace["x"]], "layout": layout}


def _estimates(table: FleetTable, k: int, rows: Sequence[int]) -> Figure:
    def known(column: str, factor: float) -> list[float]:
        return [round(factor * value, 3) for value in np.nan_to_num(table[column][rows, k]).tolist()]

    error = {"type": "data", "thickness": 0.7, "width": 0}
    return {
        "x": known("drift", 100.0),
        "y": known("offset_a", 1.0),
        "error_x": {**error, "array": known("drift_sd", 100.0)},
        "error_y": {**error, "array": known("offset_sd_a", 1.0)},
        "text": [str(table.vehicle[j]) for j in rows],
    }


def _rivals(table: FleetTable, k: int, rows: Sequence[int], files: Mapping[int, ParameterDetails]) -> Figure:
    """What the explanations after the first say of a sensor."""
    name = table.branches[k]
    found = [
        (round(100.0 * each.drift.get(name, 0.0), 3), round(each.offset_a.get(name, 0.0), 3), j, each.probability)
        for j in rows
        for each in (files[j].explanations[1:] if j in files else ())
        if each.probability >= RIVAL
    ]
    text = [f"{table.vehicle[j]}, {p:.0%}" for _, _, j, p in found]
    return {"x": [x for x, *_ in found], "y": [y for _, y, *_ in found], "text": text}


def _about_zero(sizes: Array) -> list[float]:
    """Range of an axis that holds values of some sizes on both sides of zero, whatever their standard deviations."""
    largest = 1.1 * max(float(sizes.max(initial=0.0)), 1.0)
    return [-largest, largest]
