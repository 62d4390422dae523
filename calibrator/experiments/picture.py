"""Results of experiments as pictures: one function per kind. Bars are 95 % intervals, rings the paper's figures."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from calibrator.drive import Array
from calibrator.experiments.figures import ALL
from calibrator.experiments.methods import BASELINES, CEILING, LEFT_IN, PERFECT, POSTERIOR, THRESHOLD, TREE

if TYPE_CHECKING:
    from calibrator.experiments.experiments import ExperimentResult

__all__ = ["draw_result", "write_picture"]

TITLES = {
    "recovery_rate": "recovery rate",
    "confidence": "mean confidence",
    "harmed": "harmed of the corrected",
    "named": "cause named",
    "gain_within_1": "gain errors within 1 sd",
    "offset_within_1": "offsets within 1 sd",
}
SHARES = (-0.03, 1.03)
"""Axis of a share: 0 to 1, with room for the markers at its ends. [1]"""
LOGARITHMIC = 20.0
"""Ratio of the largest to the smallest value from which on an axis is logarithmic. [1]"""
MARGIN = 0.08
"""Of the range of values, left and right of them. [1]"""
DODGE_PT = 5.0
"""Curves stand side by side, so that equal ones do not hide each other. [pt]"""
FEW = 30
"""With fewer vehicles the share recovered is uncertain by more than about 0.1; their markers are hollow."""
COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#882255", "#999999", "#332288",
    "#117733", "#AA4499",
)  # fmt: skip
"""The first are those of Okabe and Ito, for all eyes."""
MARKERS, LINES = "os^DvPp<h>Xd", ("-", "--", "-.", ":")
METHODS = [method.name for method in (POSTERIOR, PERFECT, CEILING, TREE, THRESHOLD, LEFT_IN, *BASELINES)]
"""Each has its style in all pictures."""


def _style(of: int | str) -> dict[str, Any]:
    """How a curve, by its number, or a method is told from others, also without colours."""
    number = of if isinstance(of, int) else METHODS.index(of) if of in METHODS else len(METHODS)
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def write_picture(result: "ExperimentResult", path: Path) -> None:
    """Draw a result into a PNG file."""
    draw_result(result).savefig(path, dpi=110)


def draw_result(result: "ExperimentResult") -> Figure:
    """Draw a result of an experiment as its row in the table says, with one legend beside the data."""
    kinds = {"lines": _draw_lines, "dots": _draw_dots, "map": _draw_map, "reliability": _draw_reliability}
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(result.experiment.title)
    kinds[result.experiment.picture](figure, result)
    return figure


def _bars(rows: pd.DataFrame) -> Array:
    """Lengths of the 95 % intervals down and up, shape (2, n); 0 where there is none."""
    lengths = np.stack([rows["value"] - rows["low"], rows["high"] - rows["value"]])
    return np.asarray(np.maximum(np.nan_to_num(lengths), 0.0))


def _rings(
    axes: Axes, result: "ExperimentResult", rows: pd.DataFrame, places: Iterable[float], *, label: str, colour: str,
    across: bool = False, **more: Any,
) -> None:  # fmt: skip
    """Figures of the paper for these rows, where it prints any: rings that hide nothing."""
    paper, keys = result.experiment.paper, zip(rows["x"], rows["method"], rows["figure"], strict=True)
    found = [paper.get((x, method), {}).get(figure) for x, method, figure in keys]
    known = [(place, value) for place, value in zip(places, found, strict=True) if value is not None]
    if known:
        x, y = zip(*(pair[::-1] if across else pair for pair in known), strict=True)
        look: dict[str, Any] = {"s": 110.0, "facecolors": "none", "edgecolors": colour, "linewidths": 1.5, "zorder": 4}
        axes.scatter(x, y, label=f"paper, {label}", **look, **more)


def _legend(figure: Figure, *, title: str | None = None) -> None:
    """One legend below all axes, each label once."""
    found: dict[str, Artist] = {}
    for axes in figure.axes:
        found = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True)) | found
    labels = sorted(found, key=lambda label: label.startswith("paper"))
    handles, columns = [found[label] for label in labels], min(len(labels), 6)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize="small", title=title)


def _draw_dots(figure: Figure, result: "ExperimentResult") -> None:
    """A line of dots per setting and a panel per figure, where settings are no numbers."""
    table, panels, x_label = result.figures, result.experiment.panels, result.experiment.x_label
    keys = list(dict.fromkeys(zip(table["series"], table["x"], strict=True)))
    figure.set_size_inches(11.0, 2.0 + max(3.0, 0.3 * len(keys)))
    all_axes = figure.subplots(1, len(panels), sharey=True)
    for axes, name in zip(all_axes, panels, strict=True):
        for number, method in enumerate(result.methods):
            rows, style = table[(table["method"] == method) & (table["figure"] == name)], _style(method)
            aside = 0.6 * ((number + 0.5) / len(result.methods) - 0.5)
            place = [keys.index(key) + aside for key in zip(rows["series"], rows["x"], strict=True)]
            if place:
                bars = {"xerr": _bars(rows), "label": method, "linestyle": "", "markersize": 5.0}
                axes.errorbar(rows["value"], place, **bars, **style)
            _rings(axes, result, rows, place, label=method, colour=style["color"], across=True)
        axes.set(title=TITLES[name], xlim=SHARES)
        axes.grid(visible=True, alpha=0.3)
    ticks = [f"{series}, {x_label.split()[0]} {x:g}".removeprefix(", ") for series, x in keys]
    all_axes[0].set_yticks(range(len(keys)), ticks, fontsize="small")
    all_axes[0].invert_yaxis()
    _legend(figure)


def _draw_lines(figure: Figure, result: "ExperimentResult") -> None:
    """Figures over what is varied: a curve per method; with several series a panel per method, a curve per series."""
    table, several = result.figures, result.figures["series"].nunique() > 1
    groups = [[method] for method in result.methods] if several else [list(result.methods)]
    drawn = [
        (name, group, panel)
        for name in result.experiment.panels
        for group in groups
        if len(panel := table[(table["figure"] == name) & table["method"].isin(group)])
    ]
    all_axes, values = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0], sorted(set(table["x"]))
    for axes, (name, group, panel) in zip(all_axes, drawn, strict=True):
        curves = list(panel.groupby(["method", "series"], sort=False))
        for number, ((method, one), rows) in enumerate(curves):
            label, style = ((one or "as S says"), _style(number)) if several else (method, _style(method))
            aside_pt = DODGE_PT * (number - (len(curves) - 1) / 2.0)
            transform = axes.transData + ScaledTranslation(aside_pt / 72.0, 0.0, figure.dpi_scale_trans)
            axes.errorbar(
                rows["x"], rows["value"], yerr=_bars(rows), label=label, transform=transform,
                linestyle=LINES[number % len(LINES)], markersize=5.5, capsize=2.5, elinewidth=1.0, **style,
            )  # fmt: skip
            _rings(axes, result, rows, rows["x"], label=label, colour=style["color"], transform=transform)
        axes.set(title=f"{TITLES[name]}, {group[0]}" if several else TITLES[name], ylim=SHARES)
        axes.set_xlabel(result.experiment.x_label)
        axes.tick_params(labelleft=True)
        axes.grid(visible=True, alpha=0.3)
        margin = MARGIN * (values[-1] - values[0]) or 1.0
        axes.set_xlim(values[0] - margin, values[-1] + margin)
        if values[0] > 0.0 and values[-1] > LOGARITHMIC * values[0]:
            factor = (values[-1] / values[0]) ** MARGIN
            axes.set(xscale="log", xlim=(values[0] / factor, values[-1] * factor))
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.set_xticks([], minor=True)
    all_axes[0].set_ylabel("share of vehicles; bars: 95 % intervals")
    _legend(figure, title=result.experiment.series_label if several else None)


def _draw_map(figure: Figure, result: "ExperimentResult") -> None:
    """A map of the recovery rate per method."""
    table, experiment = result.figures, result.experiment
    all_axes = np.atleast_1d(figure.subplots(1, len(result.methods)))
    for axes, method in zip(all_axes, result.methods, strict=True):
        rates = table[(table["method"] == method) & (table["figure"] == "recovery_rate")]
        grid = rates.pivot_table(index="series", columns="x", values="value", sort=False).sort_index(axis=1)
        axes.imshow(grid, vmin=0.0, vmax=1.0, origin="lower", aspect="auto", cmap="viridis")
        for (i, j), rate in np.ndenumerate(grid.to_numpy()):
            axes.text(j, i, f"{rate:.2f}", ha="center", va="center", color="black" if rate > 0.6 else "white")
        axes.set_xticks(range(grid.shape[1]), [f"{x:g}" for x in grid.columns])
        axes.set_yticks(range(len(grid)), grid.index)
        axes.set(title=f"recovery rate, {method}", xlabel=experiment.x_label, ylabel=experiment.series_label)


def _draw_reliability(figure: Figure, result: "ExperimentResult") -> None:
    """Share recovered over confidence, experiment by experiment and all together, with the numbers of vehicles."""
    reliability, counts = figure.subplots(1, 2)
    reliability.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1.0)
    errors = result.figures[result.figures["figure"] == "ece"].set_index("series")["value"]
    for number, (series, tenths) in enumerate(result.tenths.groupby("series", sort=False)):
        label = f"{series}, ECE {errors[series]:.3f}"
        if series == ALL:
            reliability.plot(tenths["confidence"], tenths["recovered"], "k.-", label=label)
            bars = counts.bar(tenths["low"] + 0.05, tenths["vehicles"], width=0.09, color="0.6")
            counts.bar_label(bars, fontsize="x-small")
            counts.set_ylim(0.8, 3.0 * tenths["vehicles"].max())
            continue
        style = _style(number)
        reliability.plot([], [], linestyle="", label=label, **style)
        for tenth in tenths.itertuples():
            face = style["color"] if tenth.vehicles >= FEW else "white"
            reliability.plot(tenth.confidence, tenth.recovered, linestyle="", markerfacecolor=face, **style)
    reliability.plot([], [], "o", color="0.6", markerfacecolor="white", label=f"hollow: fewer than {FEW} vehicles")
    reliability.set(xlabel="confidence", ylabel="share recovered", xlim=SHARES, ylim=SHARES)
    reliability.grid(visible=True, alpha=0.3)
    counts.set(xlabel="confidence", ylabel=f"vehicles, {ALL}", yscale="log", xlim=SHARES)
    _legend(figure)
