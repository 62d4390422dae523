"""What the pictures of experiments have in common: axes of shares, styles, error bars, legend."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibrator.drive import Array
from calibrator.experiments.caption import PAPER
from calibrator.experiments.delay_experiment import LEFT_IN
from calibrator.experiments.methods import CEILING, PERFECT, POSTERIOR, THRESHOLD, TREE
from calibrator.experiments.result import Figure as Merit

__all__ = ["RATE", "SHARES", "SHOWN", "SPREAD", "STYLES", "Style", "draw_legend", "style_of", "within_shares"]

RATE = "recovery_rate"
SHOWN = {RATE: "recovery rate", "confidence": "mean confidence"}
SHARES = (-0.03, 1.03)
"""Axis of a share: 0 to 1, with room for the markers at its ends. [1]"""
SPREAD = "error bars: sd over repetitions"


@dataclass(frozen=True)
class Style:
    """How a curve is told from others, also without colours; the first are those of Okabe and Ito, for all eyes."""

    colour: str
    marker: str
    line: str


STYLES = (
    Style("#0072B2", "o", "-"),
    Style("#D55E00", "s", "--"),
    Style("#009E73", "^", "-."),
    Style("#CC79A7", "D", ":"),
    Style("#E69F00", "v", "--"),
    Style("#56B4E9", "P", "-."),
    Style("#000000", "p", ":"),
    Style("#882255", "<", "-"),
    Style("#999999", "h", "--"),
    Style("#332288", ">", "-."),
)
"""More than there are experiments that can be pooled."""
METHODS = tuple(method.name for method in (POSTERIOR, PERFECT, CEILING, TREE, THRESHOLD, LEFT_IN))
"""Each has its style in all pictures."""


def style_of(method: str) -> Style:
    """Style of a method in all pictures."""
    return STYLES[METHODS.index(method)] if method in METHODS else STYLES[-1]


def within_shares(figures: Sequence[Merit]) -> Array:
    """Lengths of the error bars down and up, shape (2, n): a share cannot be below 0 or above 1."""
    room = np.clip([[f.mean, 1.0 - f.mean] for f in figures], 0.0, None).T
    return np.asarray(np.minimum(room, [f.sd for f in figures]))


def draw_legend(figure: Figure, all_axes: Sequence[Axes], *, title: str | None = None) -> None:
    """One legend below all axes, each label once."""
    found: dict[str, Artist] = {}
    for axes in all_axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    labels = sorted(found, key=lambda label: label.startswith((PAPER, SHOWN["confidence"])))
    handles = [found[label] for label in labels]
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 6), fontsize="small", title=title)
