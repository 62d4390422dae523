"""Text, JSON and picture of a Kirchhoff comparison."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from rich.console import Console
from rich.table import Table

from calibrator.drive import Array
from calibrator.errors import DriveError
from calibrator.kirchhoff.sums import SUM, Comparison, Figures, figures_of

__all__ = ["kirchhoff_json", "kirchhoff_table", "kirchhoff_text", "plot_kirchhoff"]

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B", "#999999")
"""Okabe and Ito's colours, which colour-blind readers can tell apart; black is kept for the sum."""
_RESOLUTION_DPI = 150


def kirchhoff_text(comparison: Comparison, notices: Sequence[str]) -> str:
    """Table, notices, and the line that sums it up; see :func:`kirchhoff_table`."""
    console = Console()
    with console.capture() as capture:
        console.print(kirchhoff_table(comparison))
    lines = [capture.get().rstrip("\n"), *notices]
    after = comparison.after
    if after is not None:
        before_a, after_a = comparison.before[SUM].rmse_a, after[SUM].rmse_a
        ratio = f", {before_a / after_a:.1f} times less" if 0.0 < after_a < before_a else ""
        lines.append(f"RMSE of the sum: {before_a:.2f} A before, {after_a:.2f} A after{ratio}")
    return "\n".join(lines)


def kirchhoff_json(comparison: Comparison, notices: Sequence[str]) -> str:
    """Everything but the samples, and the notices."""
    return json.dumps(comparison.as_json() | {"notices": list(notices)}, indent=2)


def kirchhoff_table(comparison: Comparison) -> Table:
    """Figures before and after as a table that fits 80 columns.

    Parameters
    ----------
    comparison : Comparison
        What is compared.

    Returns
    -------
    rich.table.Table
        One row per branch and one for the sum, under *before*, *after* and *change*; A and % of full scale.
    """
    table = Table(box=None, pad_edge=False, title_justify="left", title_style="")
    table.title = f"Branch currents and their sum; % of the full scale of {comparison.full_scale_a:g} A"
    table.add_column("", overflow="fold")
    for heading in ("RMSE A", "%", "max A", "%", "mean A", "%", "sd A", "%"):
        table.add_column(heading, justify="right", no_wrap=True)
    sections = {"before": comparison.before, "after": comparison.after, "change": comparison.change}
    for title, figures in sections.items():
        if figures is None:
            continue
        table.add_row(title, style="bold")
        for name, item in figures.items():
            table.add_row(f"  {name}", *_cells(item, comparison.full_scale_a), style="bold" if name == SUM else "")
    return table


def plot_kirchhoff(comparison: Comparison, path: Path, *, title: str) -> None:
    """Draw all branch currents and their sum over time, as figure 3 of the paper does.

    Parameters
    ----------
    comparison : Comparison
        What is compared; one panel before and, where there are corrected currents, one after.
    path : Path
        Picture to write; the suffix says the format.
    title : str
        Stands above the panels.

    Raises
    ------
    DriveError
        If the picture cannot be written.
    """
    panels = {"before": comparison.measured_a, "after": comparison.corrected_a}
    drawn = {name: currents_a for name, currents_a in panels.items() if currents_a is not None}
    with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True}):
        figure = Figure(figsize=(8.0, 1.4 + 2.7 * len(drawn)), layout="constrained")
        axes = np.atleast_1d(figure.subplots(len(drawn), sharex=True, sharey=True))
        for panel, (name, currents_a) in zip(axes, drawn.items(), strict=True):
            _draw(panel, comparison, currents_a, name)
        axes[-1].set_xlabel("time [s]")
        figure.suptitle(title)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 6), frameon=False)
        try:
            figure.savefig(path, dpi=_RESOLUTION_DPI)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise DriveError(f"{path}: cannot write the picture: {reason}; use a writable folder and .png") from None


def _draw(panel: Axes, comparison: Comparison, currents_a: Array, name: str) -> None:
    percent = 100.0 / comparison.full_scale_a
    shown = np.where(comparison.valid[:, None], currents_a, np.nan)
    for k, branch in enumerate(comparison.branches):
        panel.plot(
            comparison.time_s, percent * shown[:, k], color=_COLOURS[k % len(_COLOURS)], linewidth=0.9, label=branch
        )
    panel.plot(comparison.time_s, percent * shown.sum(axis=1), color="black", linewidth=1.1, label="sum of all")
    total = figures_of(currents_a[comparison.valid].sum(axis=1))
    panel.set_title(
        f"{name}: RMSE of the sum {total.rmse_a:.2f} A = {percent * total.rmse_a:.2f} % of full scale",
        loc="left",
        fontsize=9,
    )
    panel.set_ylabel("current [% of full scale]")
    panel.margins(x=0.0)
    right = panel.secondary_yaxis("right", functions=(_scaling(1.0 / percent), _scaling(percent)))
    right.set_ylabel("current [A]")


def _scaling(factor: float) -> Callable[[ArrayLike], Array]:
    return lambda values: factor * np.asarray(values, np.float64)


def _cells(figures: Figures, full_scale_a: float) -> list[str]:
    cells: list[str] = []
    for value in (figures.rmse_a, figures.max_a, figures.mean_a, figures.sd_a):
        cells += [f"{value:.2f}", f"{100.0 * value / full_scale_a:.2f}"]
    return cells
