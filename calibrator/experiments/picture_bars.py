"""Bars per setting of an experiment, with the mean confidence and the paper's figures on them."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibrator.drive import Array
from calibrator.experiments.caption import PAPER
from calibrator.experiments.picture_parts import RATE, SHARES, SHOWN, SPREAD, draw_legend, style_of, within_shares
from calibrator.experiments.result import ExperimentResult, Row

__all__ = ["draw_bars"]


def draw_bars(figure: Figure, result: ExperimentResult) -> None:
    """A group of bars per setting; on each the mean confidence, where the method has one, and the paper's figure."""
    axes = figure.subplots()
    keys = list(dict.fromkeys((row.series, row.x) for row in result.rows))
    width = 0.8 / len(result.methods)
    for m, method in enumerate(result.methods):
        rows = [row for row in result.rows if row.method == method]
        place = np.array([keys.index((row.series, row.x)) + (m + 0.5) * width - 0.4 for row in rows])
        figures, colour = [row.figures[RATE] for row in rows], style_of(method).colour
        axes.bar(place, [f.mean for f in figures], 0.92 * width, color=colour, alpha=0.75, label=method)
        axes.errorbar(place, [f.mean for f in figures], within_shares(figures), fmt="none", ecolor="black", capsize=2.5)
        _mark(axes, place + 0.25 * width, [_mean(row, "confidence") for row in rows], "D", SHOWN["confidence"])
        _mark(axes, place - 0.25 * width, [f.paper for f in figures], "o", f"{PAPER}, {SHOWN[RATE]}")
    axes.set_xticks(range(len(keys)), [_tick(series, x) for series, x in keys], fontsize="small")
    axes.set(ylabel=f"{SHOWN[RATE]}; {SPREAD}", ylim=(0.0, SHARES[1]), xlim=(-0.6, len(keys) - 0.4))
    axes.set_axisbelow(True)
    axes.grid(visible=True, axis="y", alpha=0.3)
    draw_legend(figure, [axes])


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
