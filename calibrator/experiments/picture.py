"""Results of experiments as pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from calibrator.drive import Array
from calibrator.experiments.calibration_experiment import ALL
from calibrator.experiments.caption import PAPER
from calibrator.experiments.delay_experiment import LEFT_IN
from calibrator.experiments.methods import CEILING, PERFECT, POSTERIOR, THRESHOLD, TREE
from calibrator.experiments.outcome import BINS
from calibrator.experiments.result import Bin, ExperimentResult, Row
from calibrator.experiments.result import Figure as Merit

__all__ = ["draw_result", "write_picture"]

RATE = "recovery_rate"
SHOWN = {RATE: "recovery rate", "confidence": "mean confidence"}
SHARES = (-0.03, 1.03)
"""Axis of a share: 0 to 1, with room for the markers at its ends. [1]"""
LOGARITHMIC = 20.0
"""Ratio of the largest to the smallest value from which on an axis is logarithmic. [1]"""
MOST_TICKS = 10
"""Up to so many values that an experiment varies are each a tick."""
DODGE_PT = 5.0
"""Curves stand side by side, so that equal ones do not hide each other. [pt]"""
FEW = 30
"""With fewer vehicles the share recovered is uncertain by more than about 0.1; their markers are hollow."""
MARGIN = 0.08
"""Of the range of values, left and right of them. [1]"""
SPREAD = "error bars: sd over repetitions"
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
)
"""More than there are experiments that can be pooled."""
METHODS = tuple(method.name for method in (POSTERIOR, PERFECT, CEILING, TREE, THRESHOLD, LEFT_IN))
"""Each has its style in all pictures."""


@dataclass(frozen=True, kw_only=True)
class _Curve:
    """Rows that a line joins."""

    label: str
    rows: Sequence[Row]
    style: _Style


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
    drawings = {"phase": _draw_phase, "calibration": _draw_reliability, "real": _draw_bars, "classifier": _draw_bars}
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(result.title)
    drawings.get(result.name, _draw_lines)(figure, result)
    return figure


def _draw_lines(figure: Figure, result: ExperimentResult) -> None:
    """Recovery rate and confidence over what is varied; with several series, a panel for each method."""
    several = len({row.series for row in result.rows}) > 1
    groups = [(method,) for method in result.methods] if several else [result.methods]
    panels = [(name, group, curves) for name in SHOWN for group in groups if (curves := _curves(result, group, name))]
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (name, group, curves) in zip(all_axes, panels, strict=True):
        for number, curve in enumerate(curves):
            _draw_curve(axes, curve, name, aside_pt=DODGE_PT * (number - (len(curves) - 1) / 2.0))
        title = f"{SHOWN[name]}, {group[0]}" if several else SHOWN[name]
        axes.set(title=title, xlabel=result.x_label, ylim=SHARES)
        axes.tick_params(labelleft=True)
        axes.grid(visible=True, alpha=0.3)
        _set_x_axis(axes, sorted({row.x for row in result.rows}))
    all_axes[0].set_ylabel(f"share of vehicles; {SPREAD}")
    _legend(figure, all_axes, title=result.series_label if several else None)


def _curves(result: ExperimentResult, methods: Sequence[str], name: str) -> list[_Curve]:
    """Curves of a panel: of one method by series, or of several methods."""
    series = list(dict.fromkeys(row.series for row in result.rows))
    keys = [(method, one) for method in methods for one in series]
    curves = []
    for number, (method, one) in enumerate(keys):
        rows = [row for row in result.rows if (row.method, row.series) == (method, one) and name in row.figures]
        style = _style_of(method) if len(series) == 1 else STYLES[number % len(STYLES)]
        if rows:
            curves.append(_Curve(label=method if len(series) == 1 else one, rows=rows, style=style))
    return curves


def _style_of(method: str) -> _Style:
    return STYLES[METHODS.index(method)] if method in METHODS else STYLES[-1]


def _draw_curve(axes: Axes, curve: _Curve, name: str, *, aside_pt: float) -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    aside = axes.transData + ScaledTranslation(aside_pt / 72.0, 0.0, figure.dpi_scale_trans)
    figures, x = [row.figures[name] for row in curve.rows], [row.x for row in curve.rows]
    axes.errorbar(
        x,
        [f.mean for f in figures],
        yerr=_within_shares(figures),
        marker=curve.style.marker,
        markeredgecolor="white",
        markeredgewidth=0.5,
        markersize=5.5,
        capsize=2.5,
        elinewidth=1.0,
        linewidth=1.4,
        color=curve.style.colour,
        linestyle=curve.style.line,
        label=curve.label,
        transform=aside,
    )
    papers = [(row.x, f.paper) for row, f in zip(curve.rows, figures, strict=True) if f.paper is not None]
    if papers:
        axes.scatter(
            [x for x, _ in papers],
            [value for _, value in papers],
            marker="o",
            s=110.0,
            facecolors="none",
            edgecolors=curve.style.colour,
            linewidths=1.5,
            zorder=4,
            transform=aside,
            label=f"{PAPER}, {curve.label}",
        )


def _within_shares(figures: Sequence[Merit]) -> Array:
    """Lengths of the error bars down and up, shape (2, n): a share cannot be below 0 or above 1."""
    room = np.clip([[f.mean, 1.0 - f.mean] for f in figures], 0.0, None).T
    return np.asarray(np.minimum(room, [f.sd for f in figures]))


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


def _legend(figure: Figure, all_axes: Sequence[Axes], *, title: str | None = None) -> None:
    """One legend below all axes, each label once."""
    found: dict[str, Artist] = {}
    for axes in all_axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    labels = sorted(found, key=lambda label: label.startswith((PAPER, SHOWN["confidence"])))
    handles = [found[label] for label in labels]
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 6), fontsize="small", title=title)


def _draw_bars(figure: Figure, result: ExperimentResult) -> None:
    """A group of bars per setting; on each the mean confidence, where the method has one, and the paper's figure."""
    axes = figure.subplots()
    keys = list(dict.fromkeys((row.series, row.x) for row in result.rows))
    width = 0.8 / len(result.methods)
    for m, method in enumerate(result.methods):
        rows = [row for row in result.rows if row.method == method]
        place = np.array([keys.index((row.series, row.x)) + (m + 0.5) * width - 0.4 for row in rows])
        figures, colour = [row.figures[RATE] for row in rows], _style_of(method).colour
        axes.bar(place, [f.mean for f in figures], 0.92 * width, color=colour, alpha=0.75, label=method)
        axes.errorbar(
            place, [f.mean for f in figures], _within_shares(figures), fmt="none", ecolor="black", capsize=2.5
        )
        _mark(axes, place + 0.25 * width, [_mean(row, "confidence") for row in rows], "D", SHOWN["confidence"])
        _mark(axes, place - 0.25 * width, [f.paper for f in figures], "o", f"{PAPER}, {SHOWN[RATE]}")
    axes.set_xticks(range(len(keys)), [_tick(series, x) for series, x in keys], fontsize="small")
    axes.set(ylabel=f"{SHOWN[RATE]}; {SPREAD}", ylim=(0.0, SHARES[1]), xlim=(-0.6, len(keys) - 0.4))
    axes.set_axisbelow(True)
    axes.grid(visible=True, axis="y", alpha=0.3)
    _legend(figure, [axes])


def _mark(axes: Axes, place: Array, values: Sequence[float | None], marker: str, label: str) -> None:
    known = [(x, value) for x, value in zip(place.tolist(), values, strict=True) if value is not None]
    x, y = [x for x, _ in known], [value for _, value in known]
    if known:
        axes.scatter(x, y, marker=marker, s=26.0, color="white", edgecolors="black", zorder=4, label=label)


def _mean(row: Row, name: str) -> float | None:
    return row.figures[name].mean if name in row.figures else None


def _tick(series: str, x: float) -> str:
    lines = [*series.replace("+-", "±").split(", "), f"S = {x:g} %"]
    return "\n".join(line for line in lines if line)


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
            _draw_together(reliability, row.bins, label)
        else:
            _draw_singly(reliability, row.bins, STYLES[number % len(STYLES)], label)
    reliability.plot([], [], "o", color=GREY, markerfacecolor="white", label=f"hollow: fewer than {FEW} vehicles")
    reliability.set(xlabel="confidence", ylabel="share recovered", xlim=SHARES, ylim=SHARES)
    reliability.grid(visible=True, alpha=0.3)
    bins = result.rows[-1].bins
    bars = counts.bar([b.low + 0.5 / BINS for b in bins], [b.count for b in bins], width=0.9 / BINS, color=GREY)
    counts.bar_label(bars, fontsize="x-small")
    counts.set(xlabel="confidence", ylabel=f"vehicles, {ALL}", yscale="log", xlim=SHARES)
    counts.set_ylim(0.8, 3.0 * max(b.count for b in bins))
    _legend(figure, [reliability])


def _draw_singly(axes: Axes, bins: Sequence[Bin], style: _Style, label: str) -> None:
    """Markers of one experiment, hollow where there are few vehicles."""
    axes.plot([], [], style.marker, color=style.colour, label=label)
    for some in bins:
        face = style.colour if some.count >= FEW else "white"
        axes.plot(
            some.confidence, some.recovered, style.marker, color=style.colour, markerfacecolor=face, markersize=6.0
        )


def _draw_together(axes: Axes, bins: Sequence[Bin], label: str) -> None:
    """A line through all vehicles."""
    line = Line2D([b.confidence for b in bins], [b.recovered for b in bins], color="black", linewidth=1.2, marker=".")
    line.set_label(label)
    axes.add_line(line)
