"""Lines over what an experiment varies, with error bars and the paper's figures."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from calibrator.experiments.caption import PAPER
from calibrator.experiments.picture_parts import (
    SHARES,
    SHOWN,
    SPREAD,
    STYLES,
    Style,
    draw_legend,
    style_of,
    within_shares,
)
from calibrator.experiments.result import ExperimentResult, Row

__all__ = ["draw_lines"]

LOGARITHMIC = 20.0
"""Ratio of the largest to the smallest value from which on an axis is logarithmic. [1]"""
MOST_TICKS = 10
"""Up to so many values that an experiment varies are each a tick."""
DODGE_PT = 5.0
"""Curves stand side by side, so that equal ones do not hide each other. [pt]"""
MARGIN = 0.08
"""Of the range of values, left and right of them. [1]"""


@dataclass(frozen=True, kw_only=True)
class _Curve:
    """Rows that a line joins."""

    label: str
    rows: Sequence[Row]
    style: Style


def draw_lines(figure: Figure, result: ExperimentResult) -> None:
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
    draw_legend(figure, all_axes, title=result.series_label if several else None)


def _curves(result: ExperimentResult, methods: Sequence[str], name: str) -> list[_Curve]:
    """Curves of a panel: of one method by series, or of several methods."""
    series = list(dict.fromkeys(row.series for row in result.rows))
    keys = [(method, one) for method in methods for one in series]
    curves = []
    for number, (method, one) in enumerate(keys):
        rows = [row for row in result.rows if (row.method, row.series) == (method, one) and name in row.figures]
        style = style_of(method) if len(series) == 1 else STYLES[number % len(STYLES)]
        if rows:
            curves.append(_Curve(label=method if len(series) == 1 else one, rows=rows, style=style))
    return curves


def _draw_curve(axes: Axes, curve: _Curve, name: str, *, aside_pt: float) -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    aside = axes.transData + ScaledTranslation(aside_pt / 72.0, 0.0, figure.dpi_scale_trans)
    figures, x = [row.figures[name] for row in curve.rows], [row.x for row in curve.rows]
    axes.errorbar(
        x,
        [f.mean for f in figures],
        yerr=within_shares(figures),
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
