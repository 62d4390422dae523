"""A map of the recovery rate over both numbers that an experiment varies."""

import numpy as np
from matplotlib.figure import Figure

from calibrator.drive import Array
from calibrator.experiments.picture_parts import RATE
from calibrator.experiments.result import ExperimentResult

__all__ = ["draw_phase"]


def draw_phase(figure: Figure, result: ExperimentResult) -> None:
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
