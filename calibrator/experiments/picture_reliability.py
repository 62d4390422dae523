"""Share recovered over confidence: whether the confidence is honest."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from calibrator.experiments.calibration_experiment import ALL
from calibrator.experiments.outcome import BINS
from calibrator.experiments.picture_parts import SHARES, STYLES, Style, draw_legend
from calibrator.experiments.result import Bin, ExperimentResult

__all__ = ["draw_reliability"]

FEW = 30
"""With fewer vehicles the share recovered is uncertain by more than about 0.1; their markers are hollow."""
GREY = "0.6"


def draw_reliability(figure: Figure, result: ExperimentResult) -> None:
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
    draw_legend(figure, [reliability])


def _draw_singly(axes: Axes, bins: Sequence[Bin], style: Style, label: str) -> None:
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
