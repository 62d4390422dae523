"""Drawings of the vehicle page, as SVG that stands in the page."""

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibrator.drive import Array
from calibrator.estimator.vehicle_evidence import VehicleEvidence
from calibrator.report.figures import AFTER, BEFORE
from calibrator.report.traces import Traces

__all__ = ["draw_evidence", "draw_traces"]

IDEAL = "#1b1f24"
STYLE: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#57606a",
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 9,
    "grid.color": "#e3e6ea",
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "calibrator",  # the same page for the same result
}
WIDTH_IN, PANEL_IN, ROW_IN = 9.0, 1.15, 0.27
"""Of a page, of one current, and of one row of evidence. [inch]"""


def draw_traces(traces: Traces, *, expected_a: float) -> Markup:
    """Draw each current measured, corrected and ideal, and the sum of all before and after.

    Parameters
    ----------
    traces : Traces
        The currents.
    expected_a : float
        Sum of right sensors: the load that none of them sees. [A]

    Returns
    -------
    Markup
        SVG.
    """
    K = len(traces.branches)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, PANEL_IN * (K + 1) + 0.7), layout="constrained")
        panels = figure.subplots(K + 1, sharex=True)
        for k, (panel, name) in enumerate(zip(panels, traces.branches, strict=False)):
            _lines(panel, traces.time_s, traces.measured_a[:, k], traces.corrected_a[:, k])
            if traces.ideal_a is not None:
                panel.plot(traces.time_s, traces.ideal_a[:, k], ":", color=IDEAL, linewidth=1.2, label="ideal")
            panel.set_ylabel(f"{name} [A]")
        _lines(panels[K], traces.time_s, traces.measured_a.sum(axis=1), traces.corrected_a.sum(axis=1))
        panels[K].axhline(expected_a, color=IDEAL, linestyle=":", linewidth=1.2)
        panels[K].set_ylabel("sum [A]")
        panels[K].set_xlabel("time [s]")
        panels[K].margins(x=0.0)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=3, frameon=False)
        return _svg(figure)


def draw_evidence(evidence: VehicleEvidence, names: Sequence[str], *, ratios: int) -> Markup:
    """Draw what the recordings say with its standard deviation, and what the estimate explains of it.

    Parameters
    ----------
    evidence : VehicleEvidence
        Of the vehicle.
    names : sequence of str
        Of its rows.
    ratios : int
        How many of them are ratios [1]; the others are constants [A].

    Returns
    -------
    Markup
        SVG.
    """
    value = np.array([np.nan if item is None else item for item in evidence.value])
    sd = np.array([np.nan if item is None else item for item in evidence.sd])
    explained = np.array(evidence.explained)
    told = np.isfinite(value)
    parts = (
        (np.arange(len(names)) < ratios, 1.0, 100.0, "gains: deviation from 1 [%]"),
        (np.arange(len(names)) >= ratios, 0.0, 1.0, "constants [A]"),
    )
    rows = max(int((chosen & told).sum()) for chosen, *_ in parts)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, ROW_IN * rows + 1.0), layout="constrained")
        for panel, (chosen, less, factor, label) in zip(figure.subplots(1, 2), parts, strict=True):
            here = np.flatnonzero(chosen & told)
            x = [factor * (values[here] - less) for values in (value, explained)]
            _rows(panel, [names[r] for r in here.tolist()], x[0], factor * sd[here], x[1])
            panel.set_xlabel(label)
        handles, labels = panel.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=2, frameon=False)
        return _svg(figure)


def _lines(panel: Axes, time_s: Array, before_a: Array, after_a: Array) -> None:
    panel.plot(time_s, before_a, color=BEFORE, linewidth=1.0, label="measured")
    panel.plot(time_s, after_a, color=AFTER, linewidth=1.0, label="corrected")


def _rows(panel: Axes, names: Sequence[str], value: Array, sd: Array, explained: Array) -> None:
    y = np.arange(len(names))
    panel.axvline(0.0, color="#6b7682", linewidth=0.8)
    panel.errorbar(value, y, xerr=sd, fmt="o", color=BEFORE, markersize=4, capsize=3, label="recordings")
    panel.plot(explained, y, "D", markerfacecolor="none", color=AFTER, markersize=8, label="explained by the estimate")
    panel.set_yticks(y, names)
    panel.set_ylim(len(names) - 0.5, -0.5)


def _svg(figure: Figure) -> Markup:
    """The drawing without its XML head, as an image whose texts can be read."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return Markup(text[text.index("<svg") :])  # noqa: S704 (matplotlib escapes texts)
