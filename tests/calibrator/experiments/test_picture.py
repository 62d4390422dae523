"""Pictures of results: nothing is hidden, cut off or indistinguishable."""

from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from calibrator.experiments.experiments import EXPERIMENTS, ExperimentResult
from calibrator.experiments.figures import figure_rows
from calibrator.experiments.methods import PERFECT, POSTERIOR
from calibrator.experiments.pages import draw_result

BIASES = ("0", "0.2", "0.4", "0.5")


@pytest.fixture(scope="module")
def equal() -> ExperimentResult:
    """Recovery rates of 0 and 1, the same for all series and both methods, of 30 vehicles each.

    Only the default has a confidence.
    """
    tables = []
    for series, (x, rate), method in product(BIASES, ((20.0, 0.0), (2000.0, 1.0)), (PERFECT, POSTERIOR)):
        within = np.full(30, rate > 0.0)
        values = {"recovery_rate": within}
        if method is POSTERIOR:
            values |= {"confidence": within + 0.0, "sure": within, "sure_confidence": within[within] + 0.0}
            values |= {"ece": np.column_stack([np.where(within, 0.99, 0.25), within])}
        tables.append([table.assign(series=series, x=x, method=method.name) for table in figure_rows([values])])
    figures, tenths = (pd.concat(some, ignore_index=True) for some in zip(*tables, strict=True))
    return ExperimentResult(experiment=EXPERIMENTS["asymmetry"], settings={"seed": 0}, figures=figures, tenths=tenths)


def drawn(result: ExperimentResult) -> Figure:
    figure = draw_result(result)
    figure.draw_without_rendering()
    return figure


def test_dots_of_methods_stand_side_by_side(equal: ExperimentResult) -> None:
    for axes in drawn(equal).axes[:1]:
        dots = [container.lines[0] for container in axes.containers if isinstance(container, ErrorbarContainer)]
        assert len(dots) == len({*equal.methods})
        for looks in (Line2D.get_color, Line2D.get_marker):
            assert len({looks(dot) for dot in dots}) == len(dots)
        places = axes.transData.transform(np.concatenate([np.asarray(dot.get_xydata())[:1] for dot in dots]))
        assert np.all(np.abs(np.diff(places[:, 1])) > 5.0)


def test_error_bars_are_the_95_percent_intervals(equal: ExperimentResult) -> None:
    lines = [c for c in drawn(equal).axes[0].collections if isinstance(c, LineCollection)]
    ends = np.concatenate([np.ravel([s[:, 0] for s in line.get_segments()]) for line in lines])
    assert {0.0, 0.116, 0.884, 1.0} == {round(float(end), 3) for end in ends}, "of 0 and of 30 of 30 vehicles"


def test_legend_covers_no_data_and_names_each_method_once(equal: ExperimentResult) -> None:
    for result in (equal, replace(equal, experiment=EXPERIMENTS["sparsity"])):
        figure = drawn(result)
        (legend,) = figure.legends
        assert not any(legend.get_window_extent().overlaps(axes.get_window_extent()) for axes in figure.axes)
        names = [text.get_text() for text in legend.get_texts()]
        assert len(names) == len(set(names))
        assert {*result.methods} <= {*names}
