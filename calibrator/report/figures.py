"""Figures of the fleet page, made by plotly; ``assets/page.js`` adds fonts and grids."""

from collections.abc import Mapping

import msgspec
import numpy as np
import pandas as pd
import plotly.graph_objects as go

from calibrator.drive import Array
from calibrator.report.fleet_table import FleetTable, ParameterDetails

__all__ = ["MOST_POINTS", "junction_figure", "sensor_figure"]

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


def _json(figure: go.Figure) -> msgspec.Raw:
    return msgspec.Raw(figure.update_layout(template="none").to_json().encode())


def junction_figure(before_a: Array, after_a: Array, *, expected_a: float | None) -> msgspec.Raw:
    """Distributions of the Kirchhoff sum's root mean square over vehicles, on a logarithmic axis.

    Counts in bins, so that a page holds no more for a million vehicles than for a hundred.
    """
    before_a, after_a = (np.maximum(values[np.isfinite(values)], SMALLEST_A) for values in (before_a, after_a))
    load_a = abs(expected_a or 0.0)
    marks = [load_a] if load_a >= LEAST_LOAD_A else []
    both = np.concatenate([marks, before_a, after_a, [] if len(before_a) else [SMALLEST_A]])
    bins = int(np.clip(3.0 * np.sqrt(len(before_a)), 12, 60))  # few bins for few vehicles
    edges = np.geomspace(both.min() / 1.05, both.max() * 1.05, bins + 1)
    figure, most = go.Figure(), 0
    for name, values, colour in (("as measured", before_a, BEFORE), ("after correction", after_a, AFTER)):
        counts = np.histogram(values, edges)[0].tolist()
        most = max(most, *counts)
        figure.add_scatter(
            x=[float(edges[0]), *edges.tolist()],
            y=[0, *counts, 0],
            name=name,
            line={"shape": "hv", "color": colour, "width": 1.5},
            fill="tozeroy",
            hovertemplate=f"{name}<br>from %{{x:.3g}} A: %{{y}} vehicles<extra></extra>",
        )
    for x in marks:
        style, name = {"color": OTHER, "dash": "dash", "width": 1.5}, f"load without a sensor: {x:.1f} A"
        figure.add_scatter(x=[x, x], y=[0, most], mode="lines", line=style, name=name)
    figure.update_xaxes(type="log", dtick="D2", title_text="RMS of a vehicle's Kirchhoff sum [A]")
    figure.update_yaxes(title_text="vehicles", rangemode="tozero")
    return _json(figure.update_layout(height=260))


def sensor_figure(table: FleetTable, files: Mapping[int, ParameterDetails]) -> msgspec.Raw:
    """Gain error over offset of the largest faults, one panel per branch, and what else the undecided ones may be."""
    K, figure, named = len(table.branches), go.Figure(), set[str]()
    rows = -(-K // MOST_BESIDE)
    grid = {"rows": rows, "columns": -(-K // rows), "pattern": "independent", "ygap": 0.25}
    for k, branch in enumerate(table.branches):
        axis, shown = str(k + 1 if k else ""), np.flatnonzero(table.faulty[:, k])
        shown = shown[np.argsort(-table.error_a[shown, k], kind="stable")][:MOST_POINTS]
        columns = ("vehicle", "drift", "offset_a", "drift_sd", "offset_sd_a", "applied")
        points = pd.DataFrame({name: table[name][shown, k] for name in columns})
        rivals = pd.DataFrame(
            [
                (
                    f"{table.vehicle[j]}, {each.probability:.0%}",
                    each.drift.get(branch, 0.0),
                    each.offset_a.get(branch, 0.0),
                )
                for j in shown[~points["applied"].to_numpy(bool)].tolist()
                for each in (files[j].explanations[1:] if j in files else ())
                if each.probability >= RIVAL
            ],
            columns=["vehicle", "drift", "offset_a"],
        )
        for label, colour, symbol, part in (
            ("corrected", AFTER, "circle", points[points["applied"]]),
            ("not corrected", BEFORE, "circle", points[~points["applied"]]),
            ("what it may be instead", BEFORE, "circle-open", rivals),
        ):
            if part.empty:
                continue
            errors = (
                {}
                if symbol != "circle"
                else {
                    "error_x": {"array": _known(100.0 * part["drift_sd"]), "thickness": 0.7, "width": 0},
                    "error_y": {"array": _known(part["offset_sd_a"]), "thickness": 0.7, "width": 0},
                }
            )
            figure.add_scatter(
                x=_known(100.0 * part["drift"]),
                y=_known(part["offset_a"]),
                text=part["vehicle"].tolist(),
                mode="markers",
                marker={"color": colour, "size": 7, "opacity": 0.7, "symbol": symbol},
                name=label,
                legendgroup=label,
                showlegend=label not in named,
                xaxis=f"x{axis}",
                yaxis=f"y{axis}",
                hovertemplate="%{text}<br>gain error %{x:.2f} %<br>offset %{y:.2f} A<extra></extra>",
                **errors,
            )
            named.add(label)
        for letter, name, title, factor in (
            ("x", "drift", f"{branch}: gain error [%]", 100.0), ("y", "offset_a", "" if k else "offset [A]", 1.0),
        ):  # fmt: skip
            largest = 1.1 * max(factor * float(np.abs(table[name][:, k]).max(initial=0.0)), 1.0)
            figure.layout[f"{letter}axis{axis}"] = {"title": {"text": title}, "range": [-largest, largest]}
    return _json(figure.update_layout(height=340 * rows, grid=grid))


def _known(values: "pd.Series[float]") -> list[float]:
    return [round(value, 3) for value in values.fillna(0.0).tolist()]
