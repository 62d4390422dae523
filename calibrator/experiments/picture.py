"""Results of experiments as pictures: each kind of experiment has its drawing."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from calibrator.drive import Array
from calibrator.experiments.baselines import BASELINES
from calibrator.experiments.calibration_experiment import ALL
from calibrator.experiments.methods import CEILING, LEFT_IN, PERFECT, POSTERIOR, THRESHOLD, TREE
from calibrator.experiments.outcome import BINS
from calibrator.experiments.result import ExperimentResult, Row
from calibrator.experiments.result import Figure as Merit
from calibrator.experiments.table import PAPER

__all__ = ["draw_result", "write_picture"]

RATE = "recovery_rate"
SHOWN = {RATE: "recovery rate", "confidence": "mean confidence"}
PANELS = {
    "attacks": {"harmed": "harmed of the corrected; bars to the 95 % bound", "named": "cause named"},
    "coverage": {"gain_within_1": "gain errors within 1 sd", "offset_within_1": "offsets within 1 sd"},
}
SHARES = (-0.03, 1.03)
"""Axis of a share: 0 to 1, with room for the markers at its ends. [1]"""
SPREAD = "error bars: sd over repetitions"
LOGARITHMIC = 20.0
"""Ratio of the largest to the smallest value from which on an axis is logarithmic. [1]"""
MOST_TICKS = 10
"""Up to so many values that an experiment varies are each a tick."""
DODGE_PT = 5.0
"""Curves stand side by side, so that equal ones do not hide each other. [pt]"""
MARGIN = 0.08
"""Of the range of values, left and right of them. [1]"""
FEW = 30
"""With fewer vehicles the share recovered is uncertain by more than about 0.1; their markers are hollow."""
GREY = "0.6"


@dataclass(frozen=True)
class _Style:
    """How a curve is told from others, also without colours; the first are those of Okabe and Ito, for all eyes."""

    colour: str
    marker: str
    line: str


STYLES = (
    _Style("#0072B2", "o", "-"),
    _Style("#D55E00", "s", "--"),
    _Style("#009E73", "^", "-."),
    _Style("#CC79A7", "D", ":"),
    _Style("#E69F00", "v", "--"),
    _Style("#56B4E9", "P", "-."),
    _Style("#000000", "p", ":"),
    _Style("#882255", "<", "-"),
    _Style("#999999", "h", "--"),
    _Style("#332288", ">", "-."),
    _Style("#117733", "X", ":"),
    _Style("#AA4499", "d", "--"),
)
"""More than there are experiments that can be pooled, or methods that are compared."""
METHODS = tuple(method.name for method in (POSTERIOR, PERFECT, CEILING, TREE, THRESHOLD, LEFT_IN, *BASELINES))
"""Each has its style in all pictures."""


def _style_of(method: str) -> _Style:
    """Style of a method in all pictures."""
    return STYLES[METHODS.index(method)] if method in METHODS else STYLES[-1]


def _within_shares(figures: Sequence[Merit]) -> Array:
    """Lengths of the error bars down and up, shape (2, n): a share cannot be below 0 or above 1."""
    room = np.clip([[f.mean, 1.0 - f.mean] for f in figures], 0.0, None).T
    return np.asarray(np.minimum(room, [f.sd for f in figures]))


def _draw_legend(figure: Figure, all_axes: Sequence[Axes], *, title: str | None = None) -> None:
    """One legend below all axes, each label once."""
    found: dict[str, Artist] = {}
    for axes in all_axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    labels = sorted(found, key=lambda label: label.startswith((PAPER, SHOWN["confidence"])))
    handles = [found[label] for label in labels]
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 6), fontsize="small", title=title)


def write_picture(result: ExperimentResult, path: Path) -> None:
    """Draw a result into a PNG file.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    path : Path
        PNG file to write.
    """
    draw_result(result).savefig(path, dpi=110)


def draw_result(result: ExperimentResult) -> Figure:
    """Draw a result; error bars are standard deviations over repetitions, rings are the paper's figures.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.

    Returns
    -------
    matplotlib.figure.Figure
        With a legend beside the data.
    """
    drawings = {
        "phase": _draw_phase,
        "calibration": _draw_reliability,
        "real": _draw_dots,
        "classifier": _draw_dots,
        "attacks": _draw_dots,
        "coverage": _draw_dots,
    }
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(result.title)
    drawings.get(result.name, _draw_lines)(figure, result)
    return figure


def _draw_dots(figure: Figure, result: ExperimentResult) -> None:
    """A line of dots per setting and a panel per figure, where settings are no numbers; rings are of the paper."""
    attacks = result.name == "attacks"  # of these few are harmed: bars go to the upper bound of the share
    panels = PANELS.get(result.name, SHOWN)
    keys = list(dict.fromkeys((row.series, row.x) for row in result.rows))
    figure.set_size_inches(11.0, 2.0 + max(3.0, 0.3 * len(keys)))
    all_axes = figure.subplots(1, len(panels), sharey=True)
    for axes, (name, title) in zip(all_axes, panels.items(), strict=True):
        for number, method in enumerate(result.methods):
            rows = [row for row in result.rows if row.method == method and name in row.figures]
            aside = 0.6 * ((number + 0.5) / len(result.methods) - 0.5)
            place = [keys.index((row.series, row.x)) + aside for row in rows]
            figures, style = [row.figures[name] for row in rows], _style_of(method)
            spread = _within_shares(figures)
            if attacks:
                spread = np.array([[0.0, (f.upper or f.mean) - f.mean] for f in figures]).reshape(-1, 2).T
            line: dict[str, Any] = {"fmt": style.marker, "color": style.colour, "markersize": 5.0, "elinewidth": 1.0}
            axes.errorbar([f.mean for f in figures], place, xerr=spread, label=method, **line)
            papers = [(f.paper, y) for f, y in zip(figures, place, strict=True) if f.paper is not None]
            _draw_rings(axes, papers, style, f"{PAPER}, {method}")
        axes.set(title=title, xlim=SHARES)
        axes.grid(visible=True, alpha=0.3)
    all_axes[0].set_yticks(range(len(keys)), [_tick(result, *key) for key in keys], fontsize="small")
    all_axes[0].invert_yaxis()
    _draw_legend(figure, all_axes)


def _draw_rings(axes: Axes, papers: Sequence[tuple[float, float]], style: _Style, label: str, **more: Any) -> None:
    """Figures of the paper: rings that hide nothing."""
    if papers:
        ring: dict[str, Any] = {"marker": "o", "s": 110.0, "facecolors": "none", "linewidths": 1.5, "zorder": 4}
        x, y = ([*values] for values in zip(*papers, strict=True))
        axes.scatter(x, y, edgecolors=style.colour, label=label, **ring, **more)


def _tick(result: ExperimentResult, series: str, x: float) -> str:
    varied = f"K = {x:g}" if result.name == "attacks" else f"S = {x:g} %"
    return ", ".join(part for part in (series.replace("+-", "±"), varied) if part)


def _draw_lines(figure: Figure, result: ExperimentResult) -> None:
    """Recovery rate and confidence over what is varied; with several series, a panel for each method."""
    series = list(dict.fromkeys(row.series for row in result.rows))
    several = len(series) > 1
    panels = []
    for name in SHOWN:
        for group in [(method,) for method in result.methods] if several else [result.methods]:
            keys = [(method, one) for method in group for one in series]
            found = {key: [r for r in result.rows if (r.method, r.series) == key and name in r.figures] for key in keys}
            panels += [(name, group, {key: rows for key, rows in found.items() if rows})] if any(found.values()) else []
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (name, group, curves) in zip(all_axes, panels, strict=True):
        for number, ((method, one), rows) in enumerate(curves.items()):
            style = STYLES[number % len(STYLES)] if several else _style_of(method)
            aside_pt = DODGE_PT * (number - (len(curves) - 1) / 2.0)
            _draw_curve(axes, rows, name, style, label=(one or "as S says") if several else method, aside_pt=aside_pt)
        axes.set(title=f"{SHOWN[name]}, {group[0]}" if several else SHOWN[name], xlabel=result.x_label, ylim=SHARES)
        axes.tick_params(labelleft=True)
        axes.grid(visible=True, alpha=0.3)
        _set_x_axis(axes, sorted({row.x for row in result.rows}))
    all_axes[0].set_ylabel(f"share of vehicles; {SPREAD}")
    _draw_legend(figure, all_axes, title=result.series_label if several else None)


def _draw_curve(axes: Axes, rows: Sequence[Row], name: str, style: _Style, *, label: str, aside_pt: float) -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    aside = axes.transData + ScaledTranslation(aside_pt / 72.0, 0.0, figure.dpi_scale_trans)
    figures, x = [row.figures[name] for row in rows], [row.x for row in rows]
    look: dict[str, Any] = {"marker": style.marker, "color": style.colour, "linestyle": style.line, "label": label}
    sizes: dict[str, Any] = {
        "markersize": 5.5,
        "markeredgewidth": 0.5,
        "capsize": 2.5,
        "elinewidth": 1.0,
        "linewidth": 1.4,
    }
    spread = _within_shares(figures)
    axes.errorbar(x, [f.mean for f in figures], yerr=spread, markeredgecolor="white", transform=aside, **look, **sizes)
    papers = [(row.x, f.paper) for row, f in zip(rows, figures, strict=True) if f.paper is not None]
    _draw_rings(axes, papers, style, f"{PAPER}, {label}", transform=aside)


def _set_x_axis(axes: Axes, values: Sequence[float]) -> None:
    """Logarithmic if the values are far apart; a tick for each value if they are few."""
    lowest, highest = values[0], values[-1]
    margin = MARGIN * (highest - lowest) or 1.0
    axes.set_xlim(lowest - margin, highest + margin)
    if lowest > 0.0 and highest > LOGARITHMIC * lowest:
        factor = (highest / lowest) ** MARGIN
        axes.set(xscale="log", xlim=(lowest / factor, highest * factor))
    if len(values) <= MOST_TICKS:
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.set_xticks([], minor=True)


def _draw_phase(figure: Figure, result: ExperimentResult) -> None:
    """A map of the recovery rate per method."""
    series = list(dict.fromkeys(row.series for row in result.rows))
    x = sorted({row.x for row in result.rows})
    for axes, method in zip(np.atleast_1d(figure.subplots(1, len(result.methods))), result.methods, strict=True):
        rates: Array = np.full((len(series), len(x)), np.nan)
        for row in result.rows:
            if row.method == method:
                rates[series.index(row.series), x.index(row.x)] = row.figures[RATE].mean
        axes.imshow(rates, vmin=0.0, vmax=1.0, origin="lower", aspect="auto", cmap="viridis")
        for (i, j), rate in np.ndenumerate(rates):
            axes.text(j, i, f"{rate:.2f}", ha="center", va="center", color="black" if rate > 0.6 else "white")
        axes.set_xticks(range(len(x)), [f"{value:g}" for value in x])
        axes.set_yticks(range(len(series)), series)
        axes.set(title=f"recovery rate, {method}", xlabel=result.x_label, ylabel=result.series_label)


def _draw_reliability(figure: Figure, result: ExperimentResult) -> None:
    """Share recovered over confidence, experiment by experiment and all together, with the numbers of vehicles."""
    reliability, counts = figure.subplots(1, 2)
    reliability.plot([0.0, 1.0], [0.0, 1.0], color=GREY, linewidth=1.0)
    for number, row in enumerate(result.rows):
        label = f"{row.series}, ECE {row.figures['ece'].mean:.3f}"
        if row.series == ALL:
            reliability.plot([b.confidence for b in row.bins], [b.recovered for b in row.bins], "k.-", label=label)
            continue
        style = STYLES[number % len(STYLES)]
        reliability.plot([], [], style.marker, color=style.colour, label=label)
        for b in row.bins:
            face = style.colour if b.count >= FEW else "white"
            reliability.plot(b.confidence, b.recovered, style.marker, color=style.colour, markerfacecolor=face)
    reliability.plot([], [], "o", color=GREY, markerfacecolor="white", label=f"hollow: fewer than {FEW} vehicles")
    reliability.set(xlabel="confidence", ylabel="share recovered", xlim=SHARES, ylim=SHARES)
    reliability.grid(visible=True, alpha=0.3)
    bins = result.rows[-1].bins
    bars = counts.bar([b.low + 0.5 / BINS for b in bins], [b.count for b in bins], width=0.9 / BINS, color=GREY)
    counts.bar_label(bars, fontsize="x-small")
    counts.set(xlabel="confidence", ylabel=f"vehicles, {ALL}", yscale="log", xlim=SHARES)
    counts.set_ylim(0.8, 3.0 * max(b.count for b in bins))
    _draw_legend(figure, [reliability])
