"""Results of experiments as pictures."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from calibrator.drive import Array
from calibrator.experiments.calibration_experiment import ALL
from calibrator.experiments.result import ExperimentResult, Row

__all__ = ["write_picture"]

SHOWN = {"recovery_rate": "recovery rate", "confidence": "mean confidence"}
LOGARITHMIC = 20.0
"""Ratio of the largest to the smallest value from which on an axis is logarithmic. [1]"""
GREY = "0.6"


def write_picture(result: ExperimentResult, path: Path) -> None:
    """Draw a result; crosses are the paper's figures.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    path : Path
        PNG file to write.
    """
    draw = {"phase": _draw_phase, "calibration": _draw_reliability, "real": _draw_bars}.get(result.name, _draw_lines)
    figure = Figure(figsize=(11.0, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(result.title)
    draw(figure, result)
    figure.savefig(path, dpi=110)


def _draw_lines(figure: Figure, result: ExperimentResult) -> None:
    """Recovery rate and confidence over what is varied: a colour per series, a line style per method."""
    series = list(dict.fromkeys(row.series for row in result.rows))
    styles = dict(zip(result.methods, ("--", "-", ":", "-.", "--"), strict=False))
    if len(series) == 1:
        styles = dict.fromkeys(result.methods, "-")
    panels = figure.subplots(1, len(SHOWN))
    for axes, (name, label) in zip(panels, SHOWN.items(), strict=True):
        for m, method in enumerate(result.methods):
            for k, one in enumerate(series):
                rows = [row for row in result.rows if (row.method, row.series) == (method, one) and name in row.figures]
                if rows:
                    text = f"{method}, {result.series_label} {one}" if one else method
                    colour = f"C{k if len(series) > 1 else m}"
                    _draw_line(axes, rows, name, label=text, colour=colour, style=styles[method])
        axes.set(xlabel=result.x_label, ylabel=label, ylim=(0.0, 1.02))
        axes.grid(visible=True, alpha=0.3)
        x = [row.x for row in result.rows]
        if min(x) > 0.0 and max(x) > LOGARITHMIC * min(x):
            axes.set_xscale("log")
    panels[0].legend(fontsize="x-small")


def _draw_line(axes: Axes, rows: list[Row], name: str, *, label: str, colour: str, style: str) -> None:
    figures, x = [row.figures[name] for row in rows], [row.x for row in rows]
    means, sds = [f.mean for f in figures], [f.sd for f in figures]
    axes.errorbar(x, means, yerr=sds, marker="o", capsize=3, color=colour, linestyle=style, label=label)
    papers = [(row.x, f.paper) for row, f in zip(rows, figures, strict=True) if f.paper is not None]
    if papers:
        axes.scatter(*zip(*papers, strict=True), marker="x", color=colour, zorder=3, label=f"paper, {label}")


def _draw_bars(figure: Figure, result: ExperimentResult) -> None:
    """A group of bars per setting."""
    axes = figure.subplots()
    keys = list(dict.fromkeys((row.series, row.x) for row in result.rows))
    width = 0.8 / len(result.methods)
    for m, method in enumerate(result.methods):
        rows = [row for row in result.rows if row.method == method]
        place = [keys.index((row.series, row.x)) + m * width for row in rows]
        figures = [row.figures["recovery_rate"] for row in rows]
        axes.bar(place, [f.mean for f in figures], width, yerr=[f.sd for f in figures], capsize=3, label=method)
    ticks = [f"{series}\nS = {x:g} %".replace(", ", "\n") for series, x in keys]
    axes.set_xticks(np.arange(len(keys)) + width * (len(result.methods) - 1) / 2.0, ticks, fontsize="x-small")
    axes.set(ylabel="recovery rate", ylim=(0.0, 1.02))
    axes.grid(visible=True, axis="y", alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")


def _draw_phase(figure: Figure, result: ExperimentResult) -> None:
    """A map of the recovery rate per method."""
    series = list(dict.fromkeys(row.series for row in result.rows))
    x = sorted({row.x for row in result.rows})
    for axes, method in zip(np.atleast_1d(figure.subplots(1, len(result.methods))), result.methods, strict=True):
        rates: Array = np.full((len(series), len(x)), np.nan)
        for row in result.rows:
            if row.method == method:
                rates[series.index(row.series), x.index(row.x)] = row.figures["recovery_rate"].mean
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
    for row in result.rows:
        together = row.series == ALL
        reliability.plot(
            [b.confidence for b in row.bins],
            [b.recovered for b in row.bins],
            marker="o" if together else ".",
            color="black" if together else None,
            linewidth=2.0 if together else 0.7,
            label=f"{row.series}, ECE {row.figures['ece'].mean:.3f}",
        )
    reliability.set(xlabel="confidence", ylabel="share recovered", xlim=(0.0, 1.0), ylim=(0.0, 1.02))
    reliability.grid(visible=True, alpha=0.3)
    reliability.legend(fontsize="x-small")
    bins = result.rows[-1].bins
    counts.bar([b.low + 0.05 for b in bins], [b.count for b in bins], width=0.09, color=GREY)
    counts.set(xlabel="confidence", ylabel="vehicles", yscale="log", xlim=(0.0, 1.0))
